"""Fault isolation from frames that contradict the model: which change (camera, marker, joint zero, marker body)
explains the innovations best, and whether moved cameras can be distinguished from a moved arm.

A common displacement of all cameras, and a deviation of the arm from its joint readings (play, a zero, the marker
body), look alike in the images of the arm. `doubt` decides whether other evidence distinguishes them.

Innovations explained by the errors of joint readings that the model states are no change. With such errors, a camera or
a marker is named if it alone disagrees with the joints as the others see them.
"""

from __future__ import annotations

import math
from copy import copy
from functools import lru_cache
from typing import Literal

import numpy as np

from stereoservo.calibration.change.change_detection import ChangeDiagnosis, IsolatedChange, diagnose
from stereoservo.calibration.change.hypothesis_test import Thresholds, alarm_thresholds
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitor_state import ModelDiagnosis, VerdictKind
from stereoservo.core.prediction import MODEL_SIGMA_PX, chain_at, gate_threshold, improbable, used_rows
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState
from stereoservo.core.target.motion import variance_of_carried
from stereoservo.kinematics.kernels import image_jacobian, transform_points
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.linear import damped_least_squares

FALSE_ALARMS_PER_HOUR = 1e-3
"""False alarms per hour of single rounds, with noise as stated; a diagnosis requires two of three rounds
in addition.
"""
LEAST_PX = 0.5
"""Rms change of the pixels [px] below which no cause is reported: models have errors of that size
without any change.
"""
SUSPECT_MARKERS = 3
"""Number of suspect markers, each of which is left out in turn."""
FEWEST_ON_ARM = 4
"""Least number of markers on the arm for a camera to confirm that the arm agrees with its joint readings."""
REMEDIES = (
    "Where cameras moved: put them back and resume, or calibrate. Where joints are off: calibrate --check "
    "--reset-zeros. Where the marker body moved on the arm: put it back and resume, or calibrate. Static markers in "
    "view of every camera ([scene] static) distinguish them"
)
"""Possible remedies, cause by cause, if moved cameras and a moved arm cannot be distinguished."""
FEWEST_STATIC = 3
"""Number of static points that must have moved in the image of a camera to prove that the camera has moved: one or two
may have been pushed themselves.
"""


@lru_cache(maxsize=64)
def _thresholds(rate_hz: float, cameras: int, markers: int, joints: int) -> Thresholds:
    return alarm_thresholds(
        false_alarms_per_hour=FALSE_ALARMS_PER_HOUR,
        decisions_per_hour=3600.0 * rate_hz,
        cameras=cameras,
        markers=markers,
        joints=joints,
        least_px=LEAST_PX,
    )


def thresholds_of(settings: CoreSettings, markers: int, cameras: int) -> Thresholds:
    """Thresholds of the model monitor for ``markers`` in so many of the cell's cameras."""
    rate_hz = min((camera.rate_hz for camera in settings.cameras), default=30.0)
    return _thresholds(rate_hz, cameras, markers, len(settings.joint_names))


def diagnosed(problem: LinearisedProblem) -> ModelDiagnosis:
    """The diagnosis of the innovations of one instant."""
    found = problem.diagnose()
    cause, other = found.cause, found.runner_up
    if found.kind == "nothing":
        return ModelDiagnosis()
    if cause is not None and other is not None and {cause.kind, other.kind} == {"cameras", "joints"}:
        # Either the cameras or the arm moved: `doubt` examines the static points.
        cause, other = (cause if cause.kind == "cameras" else other), None
        words = " moved together"
    elif cause is not None and other is not None and {cause.kind, other.kind} == {"camera", "joints"}:
        cause, other = (cause if cause.kind == "camera" else other), None
        words = ", or the arm before it, moved"
    else:
        words = " moved together" if cause is not None and cause.kind == "cameras" else " moved"
    if found.kind == "unexplained" or cause is None or other is not None:
        return _each_by_itself(problem) or _unclear(found, other)
    if cause.kind == "joints" and other is None:
        return ModelDiagnosis(
            "unclear",
            moved_px=cause.effect_px,
            text=f"the arm, or the marker body on it, is not where its joints report ({cause.effect_px:.3g} px "
            "rms): was the body remounted, was the arm pushed? Calibrate again",
        )
    return _described(problem, cause, words)


class LinearisedProblem:
    """The observations of one instant, with the arm at ``q`` (n,), in the cameras ``known``, prepared for several
    tests.

    ``innovation`` (c, k, 2) [px] with ``weights`` (c, k) [1/px]; rows as in `prediction.FrameResiduals`.
    """

    def __init__(
        self,
        arrays: ModelArrays,
        settings: CoreSettings,
        known: list[int],
        q: FloatArray,
        innovation: FloatArray,
        weights: FloatArray,
    ) -> None:
        self.arrays, self.settings, self.known, self.q = arrays, settings, known, q
        H, self.operators = chain_at(arrays, q)
        self.points = transform_points(H, arrays.marker_points)
        self.innovation, self.weights = innovation, weights

    def with_innovation(self, innovation: FloatArray) -> LinearisedProblem:
        """The same instant with other innovations (c, k, 2) [px]."""
        other = copy(self)
        other.innovation = innovation
        return other

    def explained(self, believed: FloatArray) -> bool:
        """Whether observations of weight ``believed`` (c, k) [1/px] are noise: in each camera together, and each of
        them.
        """
        value, limit, _ = self.worst_test(believed)
        return value <= limit

    def worst_test(self, believed: FloatArray) -> tuple[float, float, int]:
        """Chi-square and limit of that test of `explained` which is largest relative to its limit, and the camera's
        row.
        """
        squares = ((self.innovation * believed[..., None]) ** 2).sum(axis=-1)
        squares[np.isnan(squares)] = np.inf
        gate = gate_threshold(self.settings.gate_sigma)
        tests = []
        for row, (each, count) in enumerate(zip(squares, (believed > 0.0).sum(axis=1), strict=True)):
            tests.append((float(each.max()), gate, row))
            if count:
                tests.append((float(each.sum()), improbable(2.0 * float(count)), row))
        return max(tests, key=lambda test: test[0] / test[1])

    def diagnose(self, row: int | None = None, *, static_alone: bool = False) -> ChangeDiagnosis:
        """The most probable change seen by all cameras, or by the one of a ``row``; ``static_alone``: without the
        markers on the arm.
        """
        arrays, m = self.arrays, len(self.points)
        rows = list(range(len(self.known))) if row is None else [row]
        on_arm = self.weights[rows][:, :m] * (0.0 if static_alone else 1.0)
        cameras = [self.known[r] for r in rows]
        return diagnose(
            arrays.matrices[cameras], self.points, self.innovation[rows][:, :m], on_arm,
            self.operators, arrays.metric_basis, thresholds_of(self.settings, m, len(cameras)),
            arrays.scene_points, self.innovation[rows][:, m:], self.weights[rows][:, m:],
        )  # fmt: skip


def doubt(problem: LinearisedProblem, moved: list[int], px: float) -> str:
    """Why it is not proven that the cameras ``moved``, and not the arm, have moved; empty if it is proven.

    Proof is another camera that sees the arm where its joint readings predict it or, in the image of each moved camera,
    static points that moved by the camera's own displacement together with the arm. ``px``: rms disagreement.
    """
    if any(camera not in moved and _confirms_the_arm(problem, row) for row, camera in enumerate(problem.known)):
        return ""
    found = [(problem.settings.cameras[camera].name, *_static_evidence(problem, camera)) for camera in moved]
    wanting = [(name, kind, count) for name, kind, count in found if kind != "moved"]
    if not wanting:
        return ""
    names, some = tuple(name for name, _, _ in found), len(found) > 1
    disagree = (
        f"{named(names)} {'disagree' if some else 'disagrees'} with the joints by {px:.3g} px rms (limit "
        f"{LEAST_PX:g} px)"
    )
    arm = "the arm is not where its joints report (play, joint zeros, the marker body)"
    for name, kind, count in wanting:
        if kind == "stand":
            return (
                f"{disagree}, but the {count} static points that camera {name} sees are where they were: that "
                f"camera has not moved, {arm}. Nothing is relocalized: run calibrate --check, or calibrate"
            )
    name, kind, count = wanting[0]
    why = (
        f"camera {name} sees {count} static points, {FEWEST_STATIC} are needed"
        if kind == "few"
        else f"no one displacement of camera {name} explains its {count} static points and the arm"
    )
    return (
        f"{disagree}: either {'all of them' if some else 'it'} moved, or {arm}; these cannot be distinguished, "
        f"for no other camera confirms the joints and {why}. {REMEDIES}"
    )


def _confirms_the_arm(problem: LinearisedProblem, row: int) -> bool:
    """Whether a camera sees enough of the arm, and all of it where the joint readings predict it."""
    seen = int((problem.weights[row, : len(problem.points)] > 0.0).sum())
    return seen >= FEWEST_ON_ARM and problem.diagnose(row).kind == "nothing"


def _static_evidence(
    problem: LinearisedProblem, camera: int
) -> tuple[Literal["moved", "stand", "few", "unexplained"], int]:
    """What the static points in a camera's image prove about the camera, and how many it sees."""
    if camera not in problem.known:
        return "few", 0
    row = problem.known.index(camera)
    count = int((problem.weights[row, len(problem.points) :] > 0.0).sum())
    if count < FEWEST_STATIC:
        return "few", count
    if problem.diagnose(row, static_alone=True).kind == "nothing":
        return "stand", count
    return ("moved" if problem.diagnose(row).kind == "camera" else "unexplained"), count


def named(cameras: tuple[str, ...]) -> str:
    """The names of cameras as text."""
    return f"camera{'s' if len(cameras) > 1 else ''} {', '.join(cameras)}"


def _proven(verdict: ModelDiagnosis, problem: LinearisedProblem) -> ModelDiagnosis:
    """The diagnosis that cameras have moved; ``cameras_or_arm`` if a motion of the arm explains the same."""
    moved = [c for c, camera in enumerate(problem.settings.cameras) if camera.name in verdict.subjects]
    why = doubt(problem, moved, verdict.moved_px)
    if not why:
        return verdict
    return ModelDiagnosis("cameras_or_arm", verdict.subjects, moved_px=verdict.moved_px, text=why)


def _each_by_itself(problem: LinearisedProblem) -> ModelDiagnosis | None:
    """The diagnosis that two or more cameras moved independently: a displacement of its own explains each one's frame.
    None if it does not apply.
    """
    moved, effects = [], []
    for row, camera in enumerate(problem.known):
        alone = problem.diagnose(row)
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
    names = tuple(problem.settings.cameras[c].name for c in moved)
    size = max(effects)
    text = f"{named(names)} moved, each by itself"
    return _proven(ModelDiagnosis("camera_moved", names, moved_px=size, text=text), problem)


def _unclear(found: ChangeDiagnosis, other: IsolatedChange | None) -> ModelDiagnosis:
    size = 0.0 if found.cause is None else found.cause.effect_px
    chi2 = found.chi2 / max(found.measurements, 1)
    why = "two causes explain the images equally well" if other is not None else "no single cause explains the images"
    return ModelDiagnosis(
        "unclear",
        size=chi2,
        unit="of the expected variance",
        moved_px=size,
        text=f"{why} (chi-square {chi2:.3g} times what noise gives): check the cell with calibrate --check",
    )


def _described(problem: LinearisedProblem, cause: IsolatedChange, words: str) -> ModelDiagnosis:
    arrays, settings, known, px = problem.arrays, problem.settings, problem.known, cause.effect_px
    by = f"by {px:.3g} px rms"
    if cause.kind in ("camera", "cameras"):
        names = tuple(settings.cameras[c].name for c in (known if cause.kind == "cameras" else [known[cause.index]]))
        degrees = math.degrees(cause.amount) if math.isfinite(cause.amount) else 0.0
        turned = f", turned by {degrees:.3g} degrees" if math.isfinite(cause.amount) else ""
        kind: VerdictKind = "cameras_moved_together" if cause.kind == "cameras" and len(names) > 1 else "camera_moved"
        text = f"{named(names)}{words} {by}{turned}"
        return _proven(ModelDiagnosis(kind, names, degrees, 0.0, "degrees", px, text), problem)
    if cause.kind == "marker":
        marker = arrays.marker_ids[cause.index]
        text = f"marker {marker} has slipped {by}: fix it where it was, or calibrate again"
        return ModelDiagnosis("marker_slipped", (str(marker),), px, 0.0, "px", px, text)
    joint = settings.joint_names[cause.index]
    deviation = _joint_deviation(problem, cause.index)
    if settings.joint_kinds[cause.index] == "revolute":
        size, sigma, unit = math.degrees(cause.amount), math.degrees(deviation), "degrees"
    else:
        size, sigma, unit = 1e3 * cause.amount, 1e3 * deviation, "mm"
    text = (
        f"the zero of joint {joint} is off by {size:+.3g} ± {sigma:.1g} {unit} ({px:.3g} px rms): calibrate "
        "--check --reset-zeros"
    )
    return ModelDiagnosis("joint_zero", (joint,), size, sigma, unit, px, text)


def _joint_deviation(problem: LinearisedProblem, joint: int) -> float:
    """Standard deviation [rad or m] of a joint's zero, estimated alone."""
    jacobian = image_jacobian(problem.operators, problem.arrays.matrices[problem.known], problem.points)
    weights = problem.weights[:, : len(problem.points)]
    information = float((weights[..., None] ** 2 * jacobian[..., joint] ** 2).sum())
    return 1.0 / math.sqrt(information) if information > 0.0 else 0.0


def without_joint_errors(problem: LinearisedProblem, believed: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Innovations (c, k, 2) [px] without the part explained by errors of joint readings, and these errors (n,) relative
    to the standard deviations that the model states; None if it states none.

    The most probable joint positions are estimated from the observations of weight ``believed`` (c, k) [1/px].
    """
    arrays = problem.arrays
    if arrays.joint_accuracy is None:
        return None
    n, m = len(problem.q), len(problem.points)
    deviations = arrays.joint_accuracy.deviations((problem.q - arrays.zero)[None])[0]
    J = np.zeros((*problem.innovation.shape, n))
    J[:, :m] = image_jacobian(problem.operators, arrays.matrices[problem.known], problem.points) * deviations
    J = np.where(np.isfinite(J), J, 0.0)
    weights = np.concatenate([np.repeat(believed.reshape(-1), 2), np.ones(n)])
    rows = np.concatenate([J.reshape(-1, n), np.eye(n)])
    errors = np.concatenate([problem.innovation.reshape(-1), np.zeros(n)])
    found, _ = damped_least_squares(rows, errors, weights, 0.0)
    return problem.innovation - (J * found).sum(axis=-1), found


def diagnosed_beside_joint_errors(problem: LinearisedProblem, *, proven: bool) -> ModelDiagnosis:
    """The diagnosis of the innovations of one instant for an arm whose joint readings may have errors; no diagnosis if
    these explain the innovations.
    ``proven``: a camera is known to have moved; then errors of the joints alone do not revoke it.

    If the innovations name neither a camera nor a marker, the joints are estimated without each camera, and without
    each of the markers that fit them worst, in turn. The one left out is named if it alone has changed, and no other
    candidate has the same effect.
    """
    fitted = without_joint_errors(problem, problem.weights)
    if fitted is None:
        return diagnosed(problem)
    if not proven and _likely_errors(fitted[1]) and problem.with_innovation(fitted[0]).explained(problem.weights):
        return ModelDiagnosis()
    plain = diagnosed(problem)
    if plain.kind in ("camera_moved", "marker_slipped", "joint_zero"):
        return plain
    named_by: dict[tuple[str, tuple[str, ...]], ModelDiagnosis] = {}
    for believed in _with_one_left_out(problem, fitted[0]):
        found = without_joint_errors(problem, believed)
        if found is None or not _likely_errors(found[1]):
            continue
        cleared = problem.with_innovation(found[0])
        if not cleared.explained(believed):
            continue
        again = diagnosed(cleared)
        if again.kind in ("camera_moved", "marker_slipped"):
            named_by.setdefault((again.kind, again.subjects), again)
    return next(iter(named_by.values())) if len(named_by) == 1 else plain


def _with_one_left_out(problem: LinearisedProblem, left: FloatArray) -> list[FloatArray]:
    """Weights (c, k) without each camera, if there are others, and without each of the markers that fit the joints
    worst, by their residuals ``left`` (c, k, 2) [px].
    """
    weights = problem.weights
    cameras, markers = np.arange(len(problem.known)), np.arange(weights.shape[1])
    found = [weights * (cameras != row)[:, None] for row in cameras] if len(cameras) > 1 else []
    distance = ((left * weights[..., None]) ** 2).sum(axis=(0, 2))[: len(problem.points)]
    worst = np.argsort(-distance, kind="stable")[:SUSPECT_MARKERS]
    return found + [weights * (markers != marker) for marker in worst]


def _likely_errors(found: FloatArray) -> bool:
    """Whether errors of joint readings are likely, by the deviations ``found`` (n,) in standard deviations."""
    return float((found * found).sum()) <= improbable(float(found.size))


def present_problem(
    state: CoreState, known: list[int], arrays: ModelArrays, settings: CoreSettings
) -> LinearisedProblem:
    """The newest frames of the cameras ``known``; the uncertainty of a body that moves on its own is added to their
    noise.
    """
    watching, beside_px2 = state.watching, MODEL_SIGMA_PX**2 + variance_of_carried(state.target)
    weights = np.zeros((len(known), len(arrays.row_ids)))
    innovation = np.zeros((len(known), len(arrays.row_ids), 2))
    for row, c in enumerate(known):
        sighting = watching.sightings[c]
        variance = 0.5 * (sighting.spread[:, 0, 0] + sighting.spread[:, 1, 1]) + beside_px2
        weights[row] = used_rows(watching, sighting) / np.sqrt(variance)
        innovation[row] = sighting.innovation
    newest = max(known, key=lambda c: watching.sightings[c].t_ns)
    return LinearisedProblem(arrays, settings, known, watching.sightings[newest].q, innovation, weights)
