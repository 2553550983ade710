"""Causes of the outliers of a calibration's fit: exchanged views or marker ids, wrong joint positions at a stop, a
moved camera or marker.

The model that fits the other pixels predicts where the outliers should be, which identifies the cause.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.moved_parts import every_pixel, moved_part
from stereoservo.calibration.rig_model import RigModel, expected_pixels, projective_rig
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.numerics.arrays import BoolArray, FloatArray

NEAR = 6.0
"""Distance [sigmas] at which a pixel is where it is expected."""
MOST = 0.6
"""Share of a stop's pixels that must be outliers for the stop, or its image, to be wrong as a whole."""
LASTING = 0.75
"""Share of outliers from a stop on that makes a camera or a marker a moved one; before it, a tenth at most."""
LASTING_STOPS = 3
"""Stops, the last ones, that such a move must be seen at."""


@dataclass(frozen=True)
class PredictedTrials:
    """Predictions of a model for its trials: which pixels are outliers (c, s, m), expected pixels (c, s, m, 2), and
    the distance [px] within which a pixel agrees with its prediction (c, s, m).
    """

    rig: RigModel
    zero: FloatArray
    marker_ids: tuple[int, ...]
    pixels: FloatArray
    sigmas: FloatArray
    seen: BoolArray
    outliers: BoolArray
    expected: FloatArray

    def near(self, pixels: FloatArray, where: FloatArray) -> BoolArray:
        """Whether pixels (c, s, m, 2) agree with expected ones."""
        distance = np.linalg.norm(pixels - where, axis=-1)
        return np.asarray(np.where(np.isfinite(distance), distance, np.inf) <= NEAR * self.sigmas)


def predictions(trials: TrialData, result: CalibrationFit) -> PredictedTrials:
    """The fit's predictions at the trials' stops."""
    model = result.model
    kept = [trials.marker_ids.index(i) for i in model.marker_ids]
    seen = trials.visible[:, :, kept]
    outliers = np.zeros_like(seen)
    names = [camera.name for camera in trials.cameras]
    for outlier in result.report.outliers:
        outliers[names.index(outlier.camera), outlier.stop, model.marker_ids.index(outlier.marker)] = True
    rig = projective_rig(model)
    return PredictedTrials(
        rig,
        model.zero,
        model.marker_ids,
        trials.pixels[:, :, kept],
        trials.sigmas[:, :, kept] * max(1.0, result.report.sigma_factor),
        seen,
        outliers,
        expected_pixels(rig, trials.positions - model.zero),
    )


def explain_outliers(trials: TrialData, result: CalibrationFit) -> tuple[str, ...]:
    """Notes on the causes of the outliers of ``result``.

    Raises CalibrationError (``camera_moved``, ``marker_slipped``, ``moved_together``, ``camera_or_body_moved``) for
    what has changed for good during the trials: the model describes the cell before that.
    """
    found = predictions(trials, result)
    if not found.outliers.any():
        return ()
    check_lasting_outliers(trials, result, found)
    notes: list[str] = []
    rest = found.outliers.copy()
    crossed = _exchanged_stops(found)
    if len(crossed):
        rest[:, crossed] = False
        notes.append(f"the images of two cameras are exchanged at {_stops(crossed)}; they were left out")
    for camera, a, b, stops in _exchanged_ids(found, rest):
        rest[camera, stops, a] = rest[camera, stops, b] = False
        ids = result.model.marker_ids
        notes.append(
            f"markers {ids[a]} and {ids[b]} are exchanged in camera {trials.cameras[camera].name!r} at "
            f"{_stops(stops)}; they were left out"
        )
    wrong = _share(rest, found.seen, axis=(0, 2)) >= MOST
    for stop in np.flatnonzero(wrong):
        notes.append(_wrong_stop(trials, found, int(stop)))
    return tuple(notes)


def check_lasting_outliers(trials: TrialData, result: CalibrationFit, found: PredictedTrials) -> None:
    """Raise CalibrationError where outliers begin at a stop and last: of one camera, of one marker, or of
    everything.
    """
    c, _, m = found.seen.shape
    cameras = [_lasting(found.outliers[k], found.seen[k]) for k in range(c)]
    moved = [stop for stop in cameras if stop is not None]
    if moved:
        raise moved_part(trials, every_pixel(trials, result), min(moved))
    slipped = {}
    for marker in range(m):
        stop = _lasting(found.outliers[:, :, marker].T, found.seen[:, :, marker].T)
        if stop is not None:
            slipped[found.marker_ids[marker]] = stop
    if len(slipped) > max(1, m // 4):
        raise CalibrationError(
            "markers_disagree",
            f"markers {sorted(slipped)} do not fit before or after stop {min(slipped.values())}, the others do: "
            "they are not one rigid body, or the images of that stretch lead a joint's axis astray. Run the trials "
            "again, with larger motions or less noise",
            markers=sorted(slipped),
            stop=min(slipped.values()),
        )
    if slipped:
        raise marker_slipped(*next(iter(slipped.items())))


def marker_slipped(marker: int, stop: int) -> CalibrationError:
    """Error that a marker was moved on its body before ``stop``."""
    return CalibrationError(
        "marker_slipped",
        f"marker {marker} slipped between stops {stop - 1} and {stop}: it jumps in all cameras and stays off, the "
        "others do not. Fasten it, or leave it out, and run the trials again",
        marker=marker,
        stop=stop,
    )


def _lasting(outliers: BoolArray, seen: BoolArray) -> int | None:
    """Stop that separates pixels (s, ...), most of which are outliers, from others of which few are, on either side
    (the model follows the longer part); None where there is none.
    """
    after = _begun(outliers, seen)
    if after is not None:
        return after
    before = _begun(outliers[::-1], seen[::-1])
    return None if before is None else len(outliers) - before


def _begun(outliers: BoolArray, seen: BoolArray) -> int | None:
    """First stop from which most of the pixels (s, ...) are outliers while few are before; None where there is
    none.
    """
    s = len(outliers)
    bad = outliers.reshape(s, -1).sum(axis=1)
    shown = seen.reshape(s, -1).sum(axis=1)
    # Of each stop k: outliers from k on, less inliers from k on, less twice the outliers before it.
    gain = 2 * bad - shown
    score = gain.sum() - (np.cumsum(gain) - gain) - 2 * (np.cumsum(bad) - bad)
    k = int(score.argmax())
    stops_after = int((shown[k:] > 0).sum())
    if k == 0 or stops_after < LASTING_STOPS:
        return None
    lasting = bad[k:].sum() >= LASTING * shown[k:].sum() and bad[:k].sum() <= 0.1 * max(1, shown[:k].sum())
    return k if lasting else None


def _exchanged_stops(found: PredictedTrials) -> npt.NDArray[np.int64]:
    """Stops at which cameras 0 and 1 show each other's predictions."""
    pair = found.expected[[1, 0]]
    crossed = found.near(found.pixels, np.concatenate([pair, found.expected[2:]]))[:2]
    both = found.outliers[:2].sum(axis=(0, 2))
    hits = (crossed & found.outliers[:2]).sum(axis=(0, 2))
    return np.flatnonzero((both > 0) & (hits >= MOST * both) & (hits >= 2))


def _exchanged_ids(
    found: PredictedTrials, rest: BoolArray
) -> list[tuple[int, int, int, npt.NDArray[np.int64]]]:
    """Cameras and pairs of markers that lie at each other's prediction, with the stops (k,)."""
    pairs: dict[tuple[int, int, int], list[int]] = {}
    for camera, stop, a in np.argwhere(rest):
        distance = np.linalg.norm(found.expected[camera, stop] - found.pixels[camera, stop, a], axis=1)
        b = int(distance.argmin())
        if b <= a or distance[b] > NEAR * found.sigmas[camera, stop, a] or not rest[camera, stop, b]:
            continue
        back = np.linalg.norm(found.expected[camera, stop, a] - found.pixels[camera, stop, b])
        if back <= NEAR * found.sigmas[camera, stop, b]:
            pairs.setdefault((int(camera), int(a), b), []).append(int(stop))
    return [(*key, np.array(stops)) for key, stops in pairs.items()]


def _wrong_stop(trials: TrialData, found: PredictedTrials, stop: int) -> str:
    """Description of a stop whose pixels are all outliers: the positions of a neighbouring stop explain them, or
    none do.
    """
    joint = int(trials.trials[stop])
    prefix = f"stop {stop} does not fit in any camera and was left out"
    if joint < 0:
        return f"{prefix}: are its joint positions right?"
    name, unit = trials.joint_names[joint], "rad" if trials.joint_kinds[joint] == "revolute" else "m"
    own = trials.positions[trials.trials == joint, joint]
    tried = np.linspace(own.min(), own.max(), 401)
    offsets = np.repeat((trials.positions[stop] - found.zero)[None], len(tried), axis=0)
    offsets[:, joint] = tried - found.zero[joint]
    distance = np.linalg.norm(expected_pixels(found.rig, offsets) - found.pixels[:, stop][:, None], axis=-1)
    typical = np.nanmedian(
        distance.reshape(len(found.pixels), len(tried), -1).transpose(1, 0, 2).reshape(len(tried), -1), axis=1
    )
    best = int(typical.argmin())
    step = float(tried[1] - tried[0])
    nearest = float(np.median(found.sigmas[:, stop])) * NEAR
    # The grid is coarse: half a step of motion in the image is not the stop's fault.
    slack = float(np.abs(np.diff(typical)).max())
    if typical[best] > nearest + slack:
        return f"{prefix}: no position of joint {name!r} explains its images"
    return (
        f"{prefix}: its images show joint {name!r} near {tried[best]:.4g} ± {step:.2g} {unit}, reported was "
        f"{trials.positions[stop, joint]:.4g} {unit} (late, or early)"
    )


def _share(outliers: BoolArray, seen: BoolArray, axis: tuple[int, ...]) -> FloatArray:
    return np.asarray(outliers.sum(axis=axis) / np.maximum(1, seen.sum(axis=axis)))


def _stops(stops: npt.NDArray[np.int64]) -> str:
    """Stop numbers as text."""
    listed = ", ".join(str(int(stop)) for stop in stops[:12])
    return f"stop{'s' if len(stops) > 1 else ''} {listed}" + (
        f" and {len(stops) - 12} more" if len(stops) > 12 else ""
    )
