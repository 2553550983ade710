"""Separate joints (5.52): each joint's generator from its own trial, at the configuration of that trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.displacements import (
    exp_generator,
    nearest_rotation_generator,
    nearest_translation_generator,
)
from stereoservo.geometry.errors import GeometryError
from stereoservo.kinematics.calibration.bundle import Measurements, Rig, residuals, solve
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData, finite_rows

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

MIN_STOPS = 4
"""Stops with three markers or more that a joint's trial needs."""
MIN_MARKERS = 3
MIN_RANGE = 0.02
"""Smallest motion of a joint in its trial [rad or m]."""
MIN_IMAGE_MOTION = 10.0
"""Smallest motion of the markers over a trial [sigmas]."""
STILL = 2e-3
"""How far other joints may stray during a trial [rad or m] and still count as locked."""
MISFIT = 20.0
"""Median residual [sigmas] of a joint's own trial above which the joint is not what it is said to be."""


@dataclass(frozen=True)
class JointTrial:
    """A joint's own trial: ``stops`` (k,), ``base`` (n,) the locked configuration, ``reference`` its middle
    position.

    ``generator`` (4, 4) at the base; ``points`` (m, 4) at the base with the joint at ``reference``, NaN for
    markers that the trial does not show.
    """

    joint: int
    stops: IntArray
    base: FloatArray
    generator: FloatArray
    points: FloatArray


def measurements(trials: TrialData, usable: BoolArray, offsets: FloatArray) -> Measurements:
    """The usable pixels (c, s, m) as a flat list."""
    camera, stop, marker = np.nonzero(usable)
    return Measurements(
        offsets, camera, stop, marker, trials.pixels[usable].reshape(-1, 2), trials.sigmas[usable].ravel()
    )


def trial_stops(trials: TrialData, points: FloatArray, joint: int) -> tuple[IntArray, FloatArray]:
    """Stops (k,) at which only ``joint`` differs from the trial's base (n,). Raises CalibrationError.

    Stops of other trials that happen to stand on the base belong to it, too.
    """
    name, unit = trials.joint_names[joint], _unit(trials, joint)
    own = trials.trials == joint
    positions = trials.positions
    if not own.any():
        raise CalibrationError(
            "too_few_stops",
            f"joint {name!r} has no trial stops; at least {MIN_STOPS} are needed",
            joint=name,
            stops=0,
            minimum=MIN_STOPS,
        )
    moved = float(np.ptp(positions[own, joint]))
    if moved < MIN_RANGE:
        raise CalibrationError(
            "joint_did_not_move",
            f"joint {name!r} moved {moved:.4g} {unit} in its trial; at least {MIN_RANGE:g} {unit} is needed",
            joint=name,
            range=moved,
            minimum=MIN_RANGE,
        )
    base = np.median(positions[own], axis=0)
    others = np.delete(np.abs(positions - base), joint, axis=1).max(axis=1, initial=0.0)
    still = others <= STILL
    shown = np.isfinite(points).all(axis=2).sum(axis=1) >= MIN_MARKERS
    stops = np.flatnonzero(still & shown)
    distinct = len(np.unique(np.round(positions[stops, joint] / STILL)))
    if distinct < MIN_STOPS:
        lost, strayed = int((own & ~shown).sum()), int((own & ~still).sum())
        raise CalibrationError(
            "too_few_stops",
            f"joint {name!r}: {distinct} different usable stops; at least {MIN_STOPS} are needed. Of "
            f"{int(own.sum())} stops, "
            f"{lost} show fewer than {MIN_MARKERS} markers in two cameras and at {strayed} other joints "
            "strayed by more "
            f"than {STILL:g}",
            joint=name,
            stops=distinct,
            minimum=MIN_STOPS,
            markers_lost=lost,
            strayed=strayed,
        )
    if float(np.ptp(positions[stops, joint])) < MIN_RANGE:
        raise CalibrationError(
            "joint_did_not_move",
            f"joint {name!r}: the stops that show markers span {np.ptp(positions[stops, joint]):.4g} "
            f"{unit}; at least "
            f"{MIN_RANGE:g} {unit} is needed",
            joint=name,
            range=float(np.ptp(positions[stops, joint])),
            minimum=MIN_RANGE,
        )
    _check_effect(trials, stops, joint)
    return stops, base


def separate_joint(
    trials: TrialData, cameras: FloatArray, points: FloatArray, usable: BoolArray, joint: int
) -> JointTrial:
    """Generator of ``joint`` and the markers from its own trial, cameras (c, 3, 4) fixed (5.52).

    ``points`` (s, m, 4) triangulated, ``usable`` (c, s, m). A linear start over all pairs of stops, then
    least squares with free markers. Raises CalibrationError naming the joint.
    """
    name, kind = trials.joint_names[joint], trials.joint_kinds[joint]
    stops, base = trial_stops(trials, points, joint)
    angles = trials.positions[stops, joint] - base[joint]
    here: BoolArray = usable[:, stops] & np.isfinite(points[stops]).all(axis=2)
    generator = linear_generator(trials, cameras, points[stops], here, stops, angles, joint)
    structure = _common_points(generator, kind, points[stops], angles)
    seen = finite_rows(structure)
    if int(seen.sum()) < MIN_MARKERS:
        raise CalibrationError(
            "too_few_markers",
            f"joint {name!r}: {int(seen.sum())} markers are seen by two cameras in its trial; at least "
            f"{MIN_MARKERS} are needed",
            joint=name,
            markers=int(seen.sum()),
            minimum=MIN_MARKERS,
        )
    offsets = np.zeros((len(trials.positions), 1))
    offsets[stops, 0] = angles
    mask: BoolArray = np.zeros(usable.shape, dtype=bool)
    mask[:, stops] = here
    data = measurements(trials, mask, offsets)
    rig = Rig(
        (kind,), generator[None], cameras, np.where(seen[:, None], structure, np.array([0.0, 0.0, 1.0, 0.0]))
    )
    fit = solve(
        rig, data, "projective", cameras=False, loss="soft_l1", loss_scale=3.0, rounds=2, max_evaluations=40
    )
    typical = float(np.median(np.hypot(*residuals(fit.rig, data).reshape(-1, 2).T)) / np.sqrt(np.log(4.0)))
    if not typical < MISFIT:
        raise CalibrationError(
            "joint_kind",
            f"joint {name!r}: its trial does not look like a "
            f"{'rotation' if kind == 'revolute' else 'translation'} by the "
            f"reported positions: typical residual {typical:.3g} sigmas, at most {MISFIT:g} expected. Is "
            "the joint "
            f"{kind}, are its positions right, did only it move?",
            joint=name,
            residual_sigmas=typical,
            maximum=MISFIT,
        )
    return JointTrial(
        joint, stops, base, fit.rig.generators[0], np.where(seen[:, None], fit.rig.points, np.nan)
    )


def linear_generator(
    trials: TrialData,
    cameras: FloatArray,
    points: FloatArray,
    usable: BoolArray,
    stops: IntArray,
    angles: FloatArray,
    joint: int,
) -> FloatArray:
    """Generator (4, 4) by linear least squares over all ordered pairs of stops, then the nearest exact one.

    A revolute joint takes a point ``M_k`` of stop k to ``M_k + sin Δ Ĥ M_k + (1 - cos Δ) Ĥ² M_k`` at stop l
    (4.27), linear in ``Ĥ`` and ``Ĥ²`` taken as unknowns of their own; seen in pixels of stop l, the heights
    drop out. Any steps will do, equal or not, and the union over pairs spans space for a planar target, too
    (5.4). ``points`` (k, m, 4), ``usable`` (c, k, m). Raises CalibrationError (``joint_kind``).
    """
    kind = trials.joint_kinds[joint]
    span = float(np.ptp(angles))
    first, second = np.nonzero(np.abs(angles[:, None] - angles[None, :]) > 0.2 * span)
    valid = finite_rows(points)
    pair, marker = np.nonzero(valid[first] & valid[second])
    here, there = first[pair], second[pair]
    step = angles[there] - angles[here]
    source = points[here, marker]
    blocks, rights = [], []
    for c, P in enumerate(cameras):
        keep = usable[c, there, marker]
        target = trials.pixels[c, stops[there], marker][keep]
        weight = 1.0 / (trials.sigmas[c, stops[there], marker][keep] * (points[there, marker][keep] @ P[2]))
        rows = (P[None, :2] - target[:, :, None] * P[None, 2:]) * weight[:, None, None]
        moment = rows[:, :, :, None] * source[keep][:, None, None, :]
        parts = (
            [np.sin(step[keep]), 2.0 * np.sin(0.5 * step[keep]) ** 2] if kind == "revolute" else [step[keep]]
        )
        blocks.append(
            np.concatenate([(part[:, None, None, None] * moment).reshape(-1, 16) for part in parts], axis=1)
        )
        rights.append(-np.einsum("kij,kj->ki", rows, source[keep]).ravel())
    system, right = np.concatenate(blocks), np.concatenate(rights)
    # The scale of a point moved by the identity alone is fixed: the system is inhomogeneous, its unit
    # eigenvalue exact.
    solution = _robust_least_squares(system, right)
    try:
        matrix = solution[:16].reshape(4, 4)
        return (
            nearest_rotation_generator(matrix)
            if kind == "revolute"
            else nearest_translation_generator(matrix)
        )
    except GeometryError as error:
        name = trials.joint_names[joint]
        raise CalibrationError(
            "joint_kind", f"joint {name!r}: its trial does not look like a rotation: {error}", joint=name
        ) from error


def _robust_least_squares(system: FloatArray, right: FloatArray, rounds: int = 8) -> FloatArray:
    """Iteratively re-weighted least squares with Cauchy weights at the median residual."""
    scale = np.linalg.norm(system, axis=0)
    scale[scale == 0] = 1.0
    weights = np.ones(len(right))
    solution = np.zeros(system.shape[1])
    for _ in range(rounds):
        scaled = system / scale * weights[:, None]
        solution = np.linalg.lstsq(scaled, right * weights, rcond=1e-12)[0] / scale
        error = np.abs(system @ solution - right)
        typical = float(np.median(error))
        if typical <= 0.0:
            break
        weights = 1.0 / np.sqrt(1.0 + (error / (3.0 * typical)) ** 2)
    return solution


def _common_points(generator: FloatArray, kind: str, points: FloatArray, angles: FloatArray) -> FloatArray:
    """Markers (m, 4) at angle 0: the median over stops of the points (k, m, 4) brought there, depth 1; NaN
    if never seen.
    """
    back = exp_generator(kind, generator, -angles)
    moved = np.einsum("kij,kmj->kmi", back, points)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = moved / moved[..., 2:3]
    result = np.full(points.shape[1:], np.nan)
    for i in range(points.shape[1]):
        known = np.isfinite(moved[:, i]).all(axis=1)
        if known.any():
            result[i] = np.median(moved[known, i], axis=0)
    return result


def _check_effect(trials: TrialData, stops: IntArray, joint: int) -> None:
    """Refuse a joint whose trial leaves the images as they are: nothing can be learnt of it."""
    name = trials.joint_names[joint]
    sigmas = np.where(trials.visible, trials.sigmas, np.nan)[:, stops]
    pixels = trials.pixels[:, stops]
    largest = 0.0
    for c in range(pixels.shape[0]):
        for i in range(pixels.shape[2]):
            seen = np.isfinite(pixels[c, :, i]).all(axis=1)
            if int(seen.sum()) >= 2:
                motion = np.linalg.norm(np.ptp(pixels[c, seen, i], axis=0))
                largest = max(largest, float(motion / np.median(sigmas[c, seen, i])))
    if largest < MIN_IMAGE_MOTION:
        raise CalibrationError(
            "joint_without_effect",
            f"joint {name!r} reports motion, but no marker moved by more than {largest:.3g} sigmas in any "
            "image; at "
            f"least {MIN_IMAGE_MOTION:g} are needed. Does it drive what the cameras see?",
            joint=name,
            motion_sigmas=largest,
            minimum=MIN_IMAGE_MOTION,
        )


def _unit(trials: TrialData, joint: int) -> str:
    return "rad" if trials.joint_kinds[joint] == "revolute" else "m"
