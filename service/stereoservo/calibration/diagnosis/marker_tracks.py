"""Faults of calibration data that are visible in the markers' image tracks without a model: collinear markers, frozen
encoders, steps of a camera or marker, noise of the tracks.

Markers of a moving joint have smooth tracks, and equal positions give equal images.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from stereoservo.calibration.single_joint_fit import LOCKED_RANGE
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.numerics.arrays import FloatArray, IntArray

ON_A_LINE = 3.0
"""Rms distance [sigmas] from their common line up to which markers count as collinear: detectors misjudge their noise.
"""
MIN_IMAGE_MOTION = 10.0
"""Motion of the markers between two stops [sigmas] from which a joint has moved, whatever its encoder reports."""
FROZEN_STOPS = 3
"""Number of successive stops with equal reported positions and moving images from which an encoder is frozen."""
SAME_POSITION = 1e-5
"""Difference of positions [rad or m] below which an encoder has not moved."""
PATH_DEGREE = 4
"""Degree of the polynomials to which the markers' tracks over one joint are compared."""
SMOOTH = 10.0
"""Largest noise [stated sigmas] about smooth tracks; wrong detections cause hundreds."""
STEP_STATISTIC = 60.0
"""Gain in chi-square, at the residual noise, from which a track has a step."""
STEP_SHARE = 0.75
"""Share of a camera's tracks that must step for the camera to have moved; of all other tracks at most a quarter may."""


def off_line_sigmas(trials: TrialData) -> float:
    """Rms distance [sigmas] of the markers from their best common line in each image; infinite with fewer than
    three.
    """
    squares, freedom = 0.0, 0
    for pixels, sigmas in zip(trials.pixels, trials.sigmas, strict=True):
        for dots, noise in zip(pixels, sigmas, strict=True):
            seen = np.isfinite(dots).all(axis=1)
            count = int(seen.sum())
            if count < 3:
                continue
            scaled = (dots[seen] - dots[seen].mean(axis=0)) / noise[seen, None]
            squares += float(np.linalg.svd(scaled, compute_uv=False)[1] ** 2)
            freedom += count - 2
    return float(np.sqrt(squares / freedom)) if freedom else np.inf


def image_motion(trials: TrialData, first: int, second: int) -> float:
    """Median distance [sigmas] of the markers between two stops, over all cameras; 0 where none is seen at both."""
    shift = np.linalg.norm(trials.pixels[:, first] - trials.pixels[:, second], axis=-1)
    sigmas = np.hypot(trials.sigmas[:, first], trials.sigmas[:, second])
    known = np.isfinite(shift)
    return float(np.median(shift[known] / sigmas[known])) if known.any() else 0.0


def frozen_stops(trials: TrialData, joint: int) -> IntArray:
    """Longest run of a joint's trial stops (k,) with equal reported positions and moving images: a frozen encoder."""
    own = np.flatnonzero(trials.trials == joint)
    longest: list[int] = []
    run: list[int] = own[:1].tolist()
    for before, stop in pairwise(own.tolist()):
        same = float(np.abs(trials.positions[stop] - trials.positions[before]).max()) <= SAME_POSITION
        if not (same and image_motion(trials, before, stop) > MIN_IMAGE_MOTION):
            run = []
        run.append(stop)
        if len(run) > len(longest):
            longest = list(run)
    return np.array(longest, dtype=np.int64) if len(longest) >= FROZEN_STOPS else np.zeros(0, dtype=np.int64)


def check_motions(trials: TrialData) -> None:
    """Check images and positions for faults that are visible before any fit. Raises CalibrationError.

    ``too_few_markers``, ``markers_collinear``, ``encoder_frozen``, ``joints_exchanged``.
    """
    if len(trials.marker_ids) < 3:
        one = len(trials.marker_ids) == 1
        raise CalibrationError(
            "too_few_markers",
            f"{'one marker' if one else f'{len(trials.marker_ids)} markers'}: "
            f"{'a point shows' if one else 'two points show'} where a joint takes "
            f"{'it' if one else 'them'}, not how it turns space. At least 3 markers off one line are needed",
            markers=len(trials.marker_ids),
            minimum=3,
        )
    off = off_line_sigmas(trials)
    if off <= ON_A_LINE:
        raise CalibrationError(
            "markers_collinear",
            f"all markers lie on one line, to {off:.2g} sigmas in the images; more than {ON_A_LINE:g} are needed. "
            "A line does not show turns about itself: add a marker beside it",
            off_line_sigmas=off,
            minimum=ON_A_LINE,
        )
    for joint, name in enumerate(trials.joint_names):
        _refuse_frozen(trials, joint, name)
        _refuse_exchanged(trials, joint, name)


def _refuse_frozen(trials: TrialData, joint: int, name: str) -> None:
    stops = frozen_stops(trials, joint)
    if not len(stops):
        return
    own = int((trials.trials == joint).sum())
    where = "throughout its trial" if len(stops) == own else f"at stops {stops[0]} to {stops[-1]}"
    raise CalibrationError(
        "encoder_frozen",
        f"joint {name!r}: the markers move, but its reported position stays at "
        f"{trials.positions[stops[0], joint]:.6g} {where} ({len(stops)} of {own} stops). "
        "Does its encoder report, and at the time of the images?",
        joint=name,
        stops=stops.tolist(),
        position=float(trials.positions[stops[0], joint]),
    )


def _refuse_exchanged(trials: TrialData, joint: int, name: str) -> None:
    own = trials.trials == joint
    if not own.any():
        return
    ranges = np.ptp(trials.positions[own], axis=0)
    other = int(ranges.argmax())
    if other == joint or ranges[joint] > LOCKED_RANGE or ranges[other] <= LOCKED_RANGE:
        return
    moving = trials.joint_names[other]
    raise CalibrationError(
        "joints_exchanged",
        f"in the trial of joint {name!r} its own position changes by {ranges[joint]:.3g}, that of joint {moving!r} by "
        f"{ranges[other]:.3g}. Are the two exchanged, in the drives' order or in the trials?",
        joint=name,
        moving=moving,
        ranges=dict(zip(trials.joint_names, ranges.tolist(), strict=True)),
    )


@dataclass(frozen=True)
class TrackStep:
    """A step in the tracks: they jump before ``stop`` and stay there. ``cameras``, ``markers``: indices of the
    affected ones, all of them if they moved together; ``pixels``: median size [px].
    """

    stop: int
    cameras: tuple[int, ...]
    markers: tuple[int, ...]
    pixels: float


def path_noise(trials: TrialData) -> FloatArray:
    """Noise of each track (c, m), estimated over stated, from its distance to a smooth polynomial; 1 if too few
    stops show a marker.
    """
    basis = path_basis(trials)
    used = basis.any(axis=1)
    noise = np.ones((len(trials.cameras), len(trials.marker_ids)))
    for camera, marker in np.ndindex(noise.shape):
        rows = np.flatnonzero(used & trials.visible[camera, :, marker])
        freedom = len(rows) - basis.shape[1]
        if freedom <= 0:
            continue
        pixels = trials.pixels[camera, rows, marker]
        rest = pixels - basis[rows] @ np.linalg.lstsq(basis[rows], pixels, rcond=None)[0]
        squares = (rest**2).sum(axis=1) / trials.sigmas[camera, rows, marker] ** 2
        # The median of a chi-square with two degrees of freedom is ln 4.
        noise[camera, marker] = np.sqrt(np.median(squares) / np.log(4.0) * len(rows) / freedom)
    return noise


def paths_are_smooth(trials: TrialData) -> bool:
    """Whether the tracks are smooth up to noise, as those of moving joints are: without wrong detections."""
    return float(np.median(path_noise(trials))) < SMOOTH


def find_step(trials: TrialData, share: float = 0.0) -> TrackStep | None:
    """A step at one stop of all markers in one camera, of one marker in all cameras, or of all in all; None if
    there is none.

    Stops are in order of time. Each track is compared with polynomials in the moving joint about the common
    base, one for each trial; None if no step explains their residuals, or less than a ``share`` of them.
    """
    gains, sizes, shares = _step_gains(trials)
    c, m = gains.shape[:2]
    found: list[tuple[float, TrackStep]] = []
    candidates: list[tuple[tuple[int, ...], tuple[int, ...]]] = [((camera,), tuple(range(m))) for camera in range(c)]
    candidates += [(tuple(range(c)), (marker,)) for marker in range(m)]
    candidates.append((tuple(range(c)), tuple(range(m))))
    for cameras, markers in candidates:
        inside = np.zeros((c, m), dtype=bool)
        inside[np.ix_(cameras, markers)] = True
        stop = int(np.argmax(np.minimum(gains[inside], 1e6).sum(axis=0)))
        steps = (gains[:, :, stop] > STEP_STATISTIC) & (shares[:, :, stop] >= share)
        elsewhere = steps[~inside]
        if steps[inside].mean() >= STEP_SHARE and (not elsewhere.size or elsewhere.mean() <= 1 - STEP_SHARE):
            size = float(np.median(sizes[inside, stop]))
            found.append((float(gains[inside, stop].sum()), TrackStep(stop, cameras, markers, size)))
    return max(found, key=lambda entry: entry[0])[1] if found else None


def path_basis(trials: TrialData) -> FloatArray:
    """Basis columns (s, p) of smooth tracks: a constant for each base at which trials start, and powers of the
    moving joint's displacement from it; zero for stops of no trial, no columns without any.
    """
    positions, columns = trials.positions, []
    bases: dict[tuple[int, ...], FloatArray] = {}
    for joint in range(positions.shape[1]):
        own = np.flatnonzero(trials.trials == joint)
        if not len(own):
            continue
        median = float(np.median(positions[own, joint]))
        others = np.delete(positions[own], joint, axis=1)
        keys = np.round(others / LOCKED_RANGE).astype(np.int64)
        for key in np.unique(keys, axis=0):
            group = own[(keys == key).all(axis=1)]
            base = np.median(positions[group], axis=0)
            base[joint] = median
            name = tuple(np.round(base / (10 * LOCKED_RANGE)).astype(np.int64).tolist())
            bases.setdefault(name, np.zeros(len(positions)))[group] = 1.0
            displacement = np.zeros(len(positions))
            span = max(float(np.ptp(positions[group, joint])), LOCKED_RANGE)
            displacement[group] = 2.0 * (positions[group, joint] - median) / span
            degree = min(PATH_DEGREE, (len(group) - 1) // 2)
            columns += [displacement**power for power in range(1, degree + 1)]
    return np.stack([*bases.values(), *columns], axis=1) if bases else np.zeros((len(positions), 0))


def _step_gains(trials: TrialData) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Reduction of chi-square by a step before each stop in each track (c, m, s), the step's size [px], and the
    reduction relative to the residuals of the polynomials.
    """
    c, s, m = trials.sigmas.shape
    basis = path_basis(trials)
    used = basis.any(axis=1)
    after = np.tri(s, s).astype(np.float64)  # column k: from stop k on
    gains, sizes, shares = np.zeros((c, m, s)), np.zeros((c, m, s)), np.zeros((c, m, s))
    for camera in range(c):
        for marker in range(m):
            rows = np.flatnonzero(used & trials.visible[camera, :, marker])
            design = basis[rows]
            design = design[:, design.any(axis=0)]
            freedom = 2 * (len(rows) - design.shape[1] - 1)
            if freedom < 2:
                continue
            weights = 1.0 / trials.sigmas[camera, rows, marker]
            q, r = np.linalg.qr(design * weights[:, None])
            q = q[:, np.abs(np.diag(r)) > 1e-9 * np.abs(np.diag(r)).max()]
            pixels = trials.pixels[camera, rows, marker] * weights[:, None]
            rest = pixels - q @ (q.T @ pixels)
            steps = after[rows] * weights[:, None]
            steps = steps - q @ (q.T @ steps)
            square = (steps**2).sum(axis=0)
            # A step that the polynomials can imitate is no evidence.
            known = square > 0.2 * (weights**2).mean()
            size = np.where(known[:, None], steps.T @ rest, 0.0) / np.where(known, square, 1.0)[:, None]
            gain = (size**2).sum(axis=1) * square
            noise = np.maximum(1.0, ((rest**2).sum() - gain) / freedom)
            noise = np.maximum(noise, _trial_noise(rest, steps, size, trials.trials[rows], trials.trials))
            gains[camera, marker] = gain / noise
            shares[camera, marker] = gain / max(float((rest**2).sum()), 1e-300)
            sizes[camera, marker] = np.linalg.norm(size, axis=1)
    return gains, sizes, shares


def _trial_noise(
    rest: FloatArray, steps: FloatArray, size: FloatArray, of_row: IntArray, of_stop: IntArray
) -> FloatArray:
    """Mean squared residual (s,) of the track in each stop's own trial, with a step at that stop.

    Polynomials do not follow a large rotation well, but only in that trial: their residuals there are no step.
    ``rest`` (k, 2), ``steps`` (k, s) [sigmas], ``size`` (s, 2); ``of_row`` (k,) and ``of_stop`` (s,) number the trials.
    """
    noise = np.zeros(len(size))
    for trial in np.unique(of_row[of_row >= 0]):
        own, stops = of_row == trial, np.flatnonzero(of_stop == trial)
        left = rest[own]
        shape, step = steps[np.ix_(own, stops)], size[stops]
        squares = (
            (left**2).sum()
            - 2.0 * ((shape.T @ left) * step).sum(axis=1)
            + (shape**2).sum(axis=0) * (step**2).sum(axis=1)
        )
        noise[stops] = squares / max(2, 2 * (int(own.sum()) - PATH_DEGREE - 1))
    return noise
