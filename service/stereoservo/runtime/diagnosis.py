"""One round of frames that the model does not explain: which change does, in the cell's names and in words."""

from __future__ import annotations

import math
from functools import lru_cache

from stereoservo.kinematics.kernels import image_jacobian, transform_points
from stereoservo.kinematics.moved import Cause, Diagnosis, diagnose
from stereoservo.kinematics.moved_thresholds import Thresholds, alarm_thresholds
from stereoservo.runtime.estimate import ModelArrays, chain_at
from stereoservo.runtime.health_state import Verdict, VerdictKind
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.settings import CoreSettings

FALSE_ALARMS_PER_HOUR = 1e-3
"""Of one round, in noise as stated; a verdict needs two of three besides."""
LEAST_PX = 0.5
"""Rms change of the pixels below which no cause is told: models are off by as much where nothing has changed."""


@lru_cache(maxsize=64)
def _thresholds(rate_hz: float, cameras: int, markers: int, joints: int) -> Thresholds:
    return alarm_thresholds(
        false_alarms_per_hour=FALSE_ALARMS_PER_HOUR, decisions_per_hour=3600.0 * rate_hz, cameras=cameras,
        markers=markers, joints=joints, least_px=LEAST_PX,
    )  # fmt: skip


def thresholds_of(settings: CoreSettings, markers: int, cameras: int) -> Thresholds:
    """Thresholds of the watch over ``markers`` in so many of the cell's cameras."""
    rate_hz = min((camera.rate_hz for camera in settings.cameras), default=30.0)
    return _thresholds(rate_hz, cameras, markers, len(settings.joint_names))


def diagnosed(
    arrays: ModelArrays, settings: CoreSettings, known: list[int], q: FloatArray, innovation: FloatArray,
    weights: FloatArray,
) -> Verdict:  # fmt: skip
    """What explains the innovations (c, k, 2) with ``weights`` (c, k) of the cameras ``known``, with the arm at ``q``.

    Rows as in `estimate.FrameSights`.
    """
    H, operators = chain_at(arrays, q)
    points = transform_points(H, arrays.marker_points)
    bench = _Bench(arrays, settings, points, operators, innovation, weights)
    found = bench.diagnose(known, list(range(len(known))))
    cause, other = found.cause, found.runner_up
    if found.kind == "nothing":
        return Verdict()
    if cause is not None and other is not None and {cause.kind, other.kind} == {"cameras", "joints"}:
        # What stands between arm and cameras has moved: whichever it was, the cameras are found anew on the arm.
        cause, other = (cause if cause.kind == "cameras" else other), None
        words = ", or the whole arm, moved together"
    elif cause is not None and other is not None and {cause.kind, other.kind} == {"camera", "joints"}:
        cause, other = (cause if cause.kind == "camera" else other), None
        words = ", or the arm before it, moved"
    else:
        words = " moved together" if cause is not None and cause.kind == "cameras" else " moved"
    if found.kind == "unexplained" or cause is None or other is not None:
        return _each_by_itself(bench, known, found) or _unclear(found, other)
    if cause.kind == "joints" and other is None:
        return Verdict(
            "unclear", moved_px=cause.effect_px,
            text=f"the arm, or the marker body on it, stands elsewhere than its joints say ({cause.effect_px:.3g} px "
            "rms): was the body mounted anew, was the arm pushed? Calibrate anew",
        )  # fmt: skip
    return _told(bench, cause, known, words, q)


class _Bench:
    """One moment, for several questions."""

    def __init__(
        self, arrays: ModelArrays, settings: CoreSettings, points: FloatArray, operators: FloatArray,
        innovation: FloatArray, weights: FloatArray,
    ) -> None:  # fmt: skip
        self.arrays, self.settings = arrays, settings
        self.points, self.operators = points, operators
        self.innovation, self.weights = innovation, weights

    def diagnose(self, cameras: list[int], rows: list[int]) -> Diagnosis:
        """Of some cameras, and the rows where they stand."""
        arrays, m = self.arrays, len(self.points)
        return diagnose(
            arrays.matrices[cameras], self.points, self.innovation[rows][:, :m], self.weights[rows][:, :m],
            self.operators, arrays.metric_basis, thresholds_of(self.settings, m, len(cameras)),
            arrays.scene_points, self.innovation[rows][:, m:], self.weights[rows][:, m:],
        )  # fmt: skip


def _each_by_itself(bench: _Bench, known: list[int], found: Diagnosis) -> Verdict | None:
    """Two cameras or more may have moved, each in its own way: a displacement of its own explains each one's frame."""
    moved, effects = [], []
    for row, camera in enumerate(known):
        alone = bench.diagnose([camera], [row])
        causes = [cause for cause in (alone.cause, alone.runner_up) if cause is not None]
        of_camera = [cause for cause in causes if cause.kind == "camera"]
        if alone.kind == "nothing":
            continue
        if alone.kind == "unexplained" or not of_camera:
            return None
        moved.append(camera)
        effects.append(of_camera[0].effect_px)
    if len(moved) < 2:
        return None
    names = tuple(bench.settings.cameras[c].name for c in moved)
    size = max(effects)
    return Verdict(
        "camera_moved", names, moved_px=size, text=f"cameras {', '.join(names)} moved, each by itself"
    )


def _unclear(found: Diagnosis, other: Cause | None) -> Verdict:
    size = 0.0 if found.cause is None else found.cause.effect_px
    chi2 = found.chi2 / max(found.measurements, 1)
    why = (
        "two causes explain the images equally well"
        if other is not None
        else "no single cause explains the images"
    )
    return Verdict(
        "unclear", size=chi2, unit="of the expected variance", moved_px=size,
        text=f"{why} (chi-square {chi2:.3g} times what noise gives): check the cell with calibrate --check",
    )  # fmt: skip


def _told(bench: _Bench, cause: Cause, known: list[int], words: str, q: FloatArray) -> Verdict:
    arrays, settings, px = bench.arrays, bench.settings, cause.effect_px
    by = f"by {px:.3g} px rms"
    if cause.kind in ("camera", "cameras"):
        names = tuple(
            settings.cameras[c].name for c in (known if cause.kind == "cameras" else [known[cause.index]])
        )
        degrees = math.degrees(cause.amount) if math.isfinite(cause.amount) else 0.0
        turned = f", turned by {degrees:.3g} degrees" if math.isfinite(cause.amount) else ""
        named = f"camera{'s' if len(names) > 1 else ''} {', '.join(names)}"
        kind: VerdictKind = (
            "cameras_moved_together" if cause.kind == "cameras" and len(names) > 1 else "camera_moved"
        )
        return Verdict(
            kind,
            names,
            degrees,
            0.0,
            "degrees",
            px,
            f"{named}{words} {by}{turned}",
        )
    if cause.kind == "marker":
        marker = arrays.marker_ids[cause.index]
        text = f"marker {marker} has slipped {by}: fix it where it was, or calibrate anew"
        return Verdict("marker_slipped", (str(marker),), px, 0.0, "px", px, text)
    joint = settings.joint_names[cause.index]
    deviation = _joint_deviation(bench, cause.index, known)
    if settings.joint_kinds[cause.index] == "revolute":
        size, spread, unit = math.degrees(cause.amount), math.degrees(deviation), "degrees"
    else:
        size, spread, unit = 1e3 * cause.amount, 1e3 * deviation, "mm"
    text = (
        f"the zero of joint {joint} is off by {size:+.3g} ± {spread:.1g} {unit} ({px:.3g} px rms): calibrate "
        "--check --reset-zeros"
    )
    return Verdict("joint_zero", (joint,), size, spread, unit, px, text)


def _joint_deviation(bench: _Bench, joint: int, known: list[int]) -> float:
    """Standard deviation [rad or m] of a joint's zero, estimated alone."""
    jacobian = image_jacobian(bench.operators, bench.arrays.matrices[known], bench.points)
    weights = bench.weights[:, : len(bench.points)]
    information = float((weights[..., None] ** 2 * jacobian[..., joint] ** 2).sum())
    return 1.0 / math.sqrt(information) if information > 0.0 else 0.0
