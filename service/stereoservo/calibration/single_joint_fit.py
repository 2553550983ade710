"""Fit of a single joint's generator (its projective twist) and the markers to the joint's own trial, with the cameras
fixed (thesis 5.52).

A trial may be driven several times, each time with the joints behind the moving one (towards the markers) at different
fixed positions. In each such *distal configuration* the markers form a rigid structure of their own, so that four
dots of a plate become sixteen virtual markers that are not coplanar (5.5, fig. 5.16).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from stereoservo.calibration.bundle_adjustment import solve
from stereoservo.calibration.initial_reconstruction import twist_between
from stereoservo.calibration.least_squares import RobustLoss
from stereoservo.calibration.rig_model import Measurements, RigModel
from stereoservo.calibration.trial_data import CalibrationError, TrialData, finite_rows
from stereoservo.geometry.cameras import NOMINAL_FOCAL
from stereoservo.geometry.displacements import (
    exp_generator,
    nearest_rotation_generator,
    nearest_translation_generator,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.parameterization import Kind
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

MAX_PAIRS = 150
"""Most pairs of stops for a start: sufficient, and keeps its cost linear in the stops."""
DIRECTIONS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=np.float64
)
"""Start directions (26, 3): faces, edges and corners of a cube."""


def distant_pairs(distant: BoolArray) -> tuple[IntArray, IntArray]:
    """First and second stops of the pairs where ``distant`` (k, k) holds, at most ``MAX_PAIRS``, evenly spread."""
    first, second = np.nonzero(distant)
    if len(first) <= MAX_PAIRS:
        return first, second
    # Multiples of the golden section spread evenly over the list and contain all steps between stops about equally.
    chosen = np.unique((np.arange(MAX_PAIRS) * 0.6180339887498949 % 1.0 * len(first)).astype(np.int64))
    return first[chosen], second[chosen]


def linear_generator(
    kind: Kind,
    cameras: FloatArray,
    points: FloatArray,
    usable: BoolArray,
    pixels: FloatArray,
    sigmas: FloatArray,
    angles: FloatArray,
) -> FloatArray | None:
    """Generator (4, 4) by linear least squares over ordered pairs of stops, then the nearest exact one.

    A revolute joint moves a point ``M_k`` of stop k to ``M_k + sin Δ Ĥ M_k + (1 - cos Δ) Ĥ² M_k`` at stop l
    (4.27), linear in ``Ĥ`` and ``Ĥ²`` as independent unknowns; in pixels of stop l, the heights
    cancel. Any steps are suitable, equal or not, and the union over pairs spans space for a planar target, too
    (5.4). ``points`` (k, m, 4), ``usable`` (c, k, m), ``pixels`` (c, k, m, 2), ``sigmas`` (c, k, m) [px],
    ``angles`` (k,). None if the solution is no rotation.
    """
    span = float(np.ptp(angles))
    first, second = distant_pairs(np.abs(angles[:, None] - angles[None, :]) > 0.2 * span)
    valid = finite_rows(points)
    pair, marker = np.nonzero(valid[first] & valid[second])
    start, end = first[pair], second[pair]
    step = angles[end] - angles[start]
    source = points[start, marker]
    blocks, rights = [], []
    for c, P in enumerate(cameras):
        keep = usable[c, end, marker]
        target = pixels[c, end, marker][keep]
        weight = 1.0 / (sigmas[c, end, marker][keep] * (points[end, marker][keep] @ P[2]))
        rows = (P[None, :2] - target[:, :, None] * P[None, 2:]) * weight[:, None, None]
        terms = rows[:, :, :, None] * source[keep][:, None, None, :]
        parts = [np.sin(step[keep]), 2.0 * np.sin(0.5 * step[keep]) ** 2] if kind == "revolute" else [step[keep]]
        blocks.append(np.concatenate([(part[:, None, None, None] * terms).reshape(-1, 16) for part in parts], axis=1))
        rights.append(-np.einsum("kij,kj->ki", rows, source[keep]).ravel())
    system, right = np.concatenate(blocks), np.concatenate(rights)
    if not right.size:  # no two distant stops have a marker in common
        return None
    # The scale of a point moved by the identity alone is fixed: the system is inhomogeneous, its unit
    # eigenvalue exact.
    solution = _robust_least_squares(system, right)
    try:
        matrix = solution[:16].reshape(4, 4)
        return nearest_rotation_generator(matrix) if kind == "revolute" else nearest_translation_generator(matrix)
    except GeometryError:
        return None  # no rotation; another start may give one


def nominal_generator(
    kind: Kind,
    cameras: FloatArray,
    points: FloatArray,
    usable: BoolArray,
    pixels: FloatArray,
    sigmas: FloatArray,
    angles: FloatArray,
) -> FloatArray | None:
    """Generator (4, 4) under the assumption that the canonical frame's nominal cameras are correct: a rigid motion.

    The motion between two distant stops that explains all stops best; arguments as for
    :func:`linear_generator`. Coarse, but bounded: it needs three markers at two stops, and is None without them.
    """
    upgrade = np.diag([1.0 / NOMINAL_FOCAL, 1.0 / NOMINAL_FOCAL, 1.0, 1.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        euclidean = points @ upgrade.T / points[..., 3:]
    valid = finite_rows(euclidean)
    first, second = distant_pairs(angles[None, :] - angles[:, None] > 0.5 * np.ptp(angles))
    best, least = None, np.inf
    for k, n in zip(first, second, strict=True):
        both = valid[k] & valid[n]
        if int(both.sum()) < 3:
            continue
        before, after = euclidean[k, both, :3], euclidean[n, both, :3]
        if kind == "revolute":
            twist = twist_between(before, after)
        else:
            twist = np.zeros((4, 4))
            twist[:3, 3] = (after - before).mean(axis=0) / (angles[n] - angles[k])
        generator = np.linalg.inv(upgrade) @ twist @ upgrade
        structure = common_points(generator, kind, points, angles)
        moved = np.einsum("kij,mj->kmi", exp_generator(kind, generator, angles), structure)
        images = np.einsum("cij,kmj->ckmi", cameras, moved)
        error = np.linalg.norm(images[..., :2] / images[..., 2:] - pixels, axis=-1)[usable]
        typical = float(np.median(error[np.isfinite(error)]))
        if typical < least:
            best, least = generator, typical
    return best


def rotation_generators(points: FloatArray, angles: FloatArray) -> list[FloatArray]:
    """Generators (4, 4) of rotations about ``DIRECTIONS``, assuming the nominal cameras: each moves the
    markers' centroid along the trial's chord.

    ``points`` (k, m, 4), ``angles`` (k,). Noise excludes none of them, however small the rotation of the markers.
    Empty if no two distant stops have three markers in common.
    """
    upgrade = np.diag([1.0 / NOMINAL_FOCAL, 1.0 / NOMINAL_FOCAL, 1.0, 1.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        euclidean = points @ upgrade.T / points[..., 3:]
    valid = finite_rows(euclidean)
    common = valid.astype(np.int64) @ valid.T.astype(np.int64)
    spans = np.where(common >= 3, angles[None, :] - angles[:, None], 0.0)
    k, n = np.unravel_index(int(spans.argmax()), spans.shape)
    span = float(spans[k, n])
    if span < 0.5 * np.ptp(angles):
        return []
    both = valid[k] & valid[n]
    centroids = [euclidean[stop, both, :3].mean(axis=0) for stop in (k, n)]
    return [np.linalg.inv(upgrade) @ twist_about(one, centroids, span) @ upgrade for one in DIRECTIONS]


def twist_about(direction: FloatArray, centroids: Sequence[FloatArray], span: float) -> FloatArray:
    """Unit twist (4, 4) about a ``direction`` (3,) that moves the markers' centroid as observed in the trial.

    The centre lies on the bisector of the chord, at half its length over tan(θ/2) to the side.
    """
    axis = direction / np.linalg.norm(direction)
    chord = centroids[1] - centroids[0]
    chord = chord - axis * (axis @ chord)
    centre = 0.5 * (centroids[0] + centroids[1]) + 0.5 * np.cross(axis, chord) / np.tan(0.5 * span)
    x, y, z = axis
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    twist[:3, 3] = -np.cross(axis, centre)
    return twist


def _robust_least_squares(system: FloatArray, right: FloatArray, rounds: int = 8) -> FloatArray:
    """Least squares by iterative re-weighting with Cauchy weights at the median residual."""
    scale = np.linalg.norm(system, axis=0)
    scale[scale == 0] = 1.0
    weights = np.ones(len(right))
    solution = np.zeros(system.shape[1])
    for _ in range(rounds):
        scaled = system / scale * weights[:, None]
        before, solution = solution, np.linalg.lstsq(scaled, right * weights, rcond=1e-12)[0] / scale
        if float(np.linalg.norm((solution - before) * scale)) < 1e-4 * float(np.linalg.norm(solution * scale)):
            break
        error = np.abs(system @ solution - right)
        typical = float(np.median(error))
        if typical <= 0.0:
            break
        weights = 1.0 / np.sqrt(1.0 + (error / (3.0 * typical)) ** 2)
    return solution


def common_points(generator: FloatArray, kind: str, points: FloatArray, angles: FloatArray) -> FloatArray:
    """Markers (m, 4) at angle 0: median over stops of the points (k, m, 4) moved back there, depth 1; NaN if never
    seen.
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


MIN_STOPS = 4
"""Least number of distinct positions with visible markers in a joint's trial."""
MIN_SHOWN = 2
"""Number of markers that two cameras must see for a stop to count."""
MIN_OBSERVATIONS = 2
"""Number of stops of joint trials at which two cameras must see a marker for it to enter the model."""
MIN_MARKERS = 3
"""Least number of markers seen in a trial."""
MIN_IMAGE_MOTION = 6.0
"""Least motion of the markers over a trial, between inner quantiles of the stops [sigmas]: noise alone gives 4."""
LOCKED_RANGE = 2e-3
"""Largest motion [rad or m] of other joints during a trial with which they count as locked."""
LOCKED_SHARE = 0.05
"""Likewise, as a share of the motion in their own trials: two millimetres are large relative to a short stroke."""
NORMAL_MEDIAN = 0.6745
"""Median of the absolute value of a standard normal variable."""
GOOD_FIT = 1.3
"""Median residual [sigmas] of a joint's own trial below which no other start is tried."""
ALIKE = 1e-3
"""Relative difference of residuals up to which two starts have converged to the same result."""
FULL, SHORT = 80, 20
"""Evaluations of the cost for a single start, and for each of many."""
WRONG_SQUARE = 100.0
"""Squared residual, relative to the typical one or to sigmas², at which the cost of a pixel saturates."""
POOR_FIT = 20.0
"""Median residual [sigmas] of a joint's own trial above which its stated kind is rejected."""
POOR_FIT_SHARE = 0.02
"""Likewise, as a share of the images' motion, if readings may have errors."""


@dataclass(frozen=True)
class JointTrial:
    """A joint's own trial: ``stops`` (k,), the distal configuration ``groups`` (k,) of each, ``base`` (n,) the
    configuration of group 0 with the joint in the middle.

    ``generator`` (4, 4) at the base; ``points`` (m, 4) at the base, NaN for markers that are not seen in the trial
    there.
    """

    joint: int
    stops: IntArray
    groups: IntArray
    base: FloatArray
    generator: FloatArray
    points: FloatArray


def measurements(trials: TrialData, usable: BoolArray, offsets: FloatArray) -> Measurements:
    """The usable pixels (c, s, m) as a flat list."""
    camera, stop, marker = np.nonzero(usable)
    return Measurements(
        offsets, camera, stop, marker, trials.pixels[usable].reshape(-1, 2), trials.sigmas[usable].ravel()
    )


def trial_stops(
    trials: TrialData, points: FloatArray, joint: int, *, inexact: bool = False
) -> tuple[IntArray, IntArray, FloatArray]:
    """Stops (k,) at which only ``joint`` moves, the distal configuration of each (k,), and the base (n,).

    Joints before ``joint`` are as at the base; joints behind it are in one of the configurations in which the
    trial was driven, counted from 0, the base's own. Stops of other trials in such a configuration are included.
    ``inexact``: see `locked_ranges`. Raises CalibrationError.
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
    if moved <= LOCKED_RANGE:
        raise CalibrationError(
            "joint_did_not_move",
            f"joint {name!r} moved {moved:.4g} {unit} in its trial; more than {LOCKED_RANGE:g} {unit}, which a joint "
            "that stands may stray, is needed",
            joint=name,
            range=moved,
            minimum=LOCKED_RANGE,
        )
    locked = locked_ranges(trials, inexact=inexact)
    base, groups = _distal_groups(positions, own, joint, locked)
    shown = finite_rows(points).sum(axis=1) >= MIN_SHOWN
    stops = np.flatnonzero((groups >= 0) & shown)
    distinct = len(np.unique(np.round(positions[stops, joint] / locked[joint])))
    if distinct < MIN_STOPS:
        lost, left_trial = int((own & ~shown).sum()), int((own & (groups < 0)).sum())
        raise CalibrationError(
            "too_few_stops",
            f"joint {name!r}: {distinct} different usable stops; at least {MIN_STOPS} are needed. Of "
            f"{int(own.sum())} stops, {lost} show fewer than {MIN_SHOWN} markers that two cameras agree "
            f"on, and at {left_trial} other joints strayed by more than {locked.max():g}",
            joint=name,
            stops=distinct,
            minimum=MIN_STOPS,
            markers_lost=lost,
            strayed=left_trial,
        )
    by_group = [stops[groups[stops] == group] for group in np.unique(groups[stops])]
    _check_effect(trials, max(by_group, key=lambda own: float(np.ptp(positions[own, joint]))), joint)
    return stops, groups[stops], base


def locked_ranges(trials: TrialData, *, inexact: bool = False) -> FloatArray:
    """Largest deviation of each joint (n,) from its position in other joints' trials [rad or m]; ``inexact``: for arms
    that are compliant under load.
    """
    locked = np.full(len(trials.joint_names), LOCKED_RANGE)
    for joint in np.unique(trials.trials[trials.trials >= 0]):
        moved = float(np.ptp(trials.positions[trials.trials == joint, joint]))
        if moved > LOCKED_RANGE:
            locked[joint] = LOCKED_SHARE * moved if inexact else min(LOCKED_RANGE, LOCKED_SHARE * moved)
    return locked


def _distal_groups(
    positions: FloatArray, own: BoolArray, joint: int, locked: FloatArray
) -> tuple[FloatArray, IntArray]:
    """The base (n,) of the trial ``own`` (s,), and the distal configuration (s,) of each stop, -1 off the trial.

    A configuration needs two of the trial's stops: one shows no motion. ``locked`` (n,): see `locked_ranges`.
    """
    base = np.median(positions[own], axis=0)
    still = np.asarray((np.abs(positions[:, :joint] - base[:joint]) <= locked[:joint]).all(axis=1))
    distal = positions[:, joint + 1 :]
    groups = np.full(len(positions), -1)
    count, left = 0, np.asarray(own & still)
    # The configuration nearest to the mean comes first, and is the base's.
    order = np.argsort(np.abs(distal - base[joint + 1 :]).sum(axis=1), kind="stable")
    for k in order[left[order]]:
        if not left[k]:
            continue
        start = np.asarray((np.abs(distal - distal[k]) <= locked[joint + 1 :]).all(axis=1) & still)
        left &= ~start
        if int((start & own).sum()) >= 2:
            groups[start] = count
            if count == 0 and (np.abs(distal[k] - base[joint + 1 :]) > locked[joint + 1 :]).any():
                base[joint + 1 :] = distal[k]
            count += 1
    return base, groups


def fit_single_joint(
    trials: TrialData,
    cameras: FloatArray,
    points: FloatArray,
    usable: BoolArray,
    joint: int,
    *,
    inexact: bool = False,
) -> JointTrial:
    """Generator of ``joint`` and the markers from its own trial, cameras (c, 3, 4) fixed (5.52).

    ``points`` (s, m, 4) triangulated, ``usable`` (c, s, m). Starts are tried until one fits: linear
    over all pairs of stops; assuming the nominal cameras; axes in all directions. Then least squares with free
    markers, separate ones for each distal configuration. ``inexact``: readings may have errors that are small relative
    to the motion. Raises CalibrationError naming the joint.
    """
    name, kind = trials.joint_names[joint], trials.joint_kinds[joint]
    stops, groups, base = trial_stops(trials, points, joint, inexact=inexact)
    observations = virtual_markers(trials, points, usable, stops, groups)
    angles = trials.positions[stops, joint] - base[joint]
    m = len(trials.marker_ids)
    seen = np.asarray(observations.usable.any(axis=(0, 1)).reshape(-1, m).any(axis=0), dtype=bool)
    if int(seen.sum()) < MIN_MARKERS:
        raise CalibrationError(
            "too_few_markers",
            f"joint {name!r}: {int(seen.sum())} markers are seen by two cameras in its trial; at least "
            f"{MIN_MARKERS} are needed",
            joint=name,
            markers=int(seen.sum()),
            minimum=MIN_MARKERS,
        )
    best, least = best_single_joint(kind, cameras, observations, angles, thorough=True)
    if best is None and (common := _common_markers(observations, angles)) < MIN_MARKERS:
        raise CalibrationError(
            "too_few_markers",
            f"joint {name!r}: any two stops of its trial far apart show {common} markers in common to two cameras; at "
            f"least {MIN_MARKERS} are needed",
            joint=name,
            markers=common,
            minimum=MIN_MARKERS,
        )
    largest = max(POOR_FIT, POOR_FIT_SHARE * _image_motion(trials, stops, joint)[0]) if inexact else POOR_FIT
    if best is None or not least < largest:
        raise CalibrationError(
            "joint_kind",
            f"joint {name!r}: its trial does not look like a "
            f"{'rotation' if kind == 'revolute' else 'translation'} by the reported positions: typical "
            f"residual {least:.3g} sigmas, at most {largest:.3g} expected. Is the joint {kind}, are its "
            "positions right, did only it move?",
            joint=name,
            residual_sigmas=least,
            maximum=largest,
        )
    shown = np.asarray(observations.usable[:, :, :m].any(axis=(0, 1)))
    return JointTrial(joint, stops, groups, base, best.generators[0], np.where(shown[:, None], best.points[:m], np.nan))


def _common_markers(observations: VirtualObservations, angles: FloatArray) -> int:
    """Largest number of virtual markers common to two stops that are half of the trial's range apart."""
    shown = finite_rows(observations.points).astype(np.int64)
    distant = np.abs(angles[:, None] - angles[None, :]) > 0.5 * np.ptp(angles)
    return int((shown @ shown.T)[distant].max(initial=0))


@dataclass(frozen=True)
class VirtualObservations:
    """Observations of the virtual markers in a joint's trial, those of group g at indices ``g m`` to ``g m + m - 1``.

    ``points`` (k, v, 4), NaN where not usable; ``usable`` (c, k, v); ``pixels`` (c, k, v, 2) [px]; ``sigmas``
    (c, k, v) [px].
    """

    points: FloatArray
    usable: BoolArray
    pixels: FloatArray
    sigmas: FloatArray


def virtual_markers(
    trials: TrialData, points: FloatArray, usable: BoolArray, stops: IntArray, groups: IntArray
) -> VirtualObservations:
    """The markers (m) of G distal ``groups`` (k,) at ``stops`` (k,) as G m virtual markers of one rigid body."""
    c, m, k = len(trials.cameras), len(trials.marker_ids), len(stops)
    count = int(groups.max()) + 1
    virtual = VirtualObservations(
        np.full((k, count * m, 4), np.nan),
        np.zeros((c, k, count * m), dtype=bool),
        np.full((c, k, count * m, 2), np.nan),
        np.ones((c, k, count * m)),
    )
    start: BoolArray = usable[:, stops] & finite_rows(points[stops])
    for g in range(count):
        at, rows = slice(g * m, (g + 1) * m), np.flatnonzero(groups == g)
        virtual.points[rows, at] = points[stops[rows]]
        virtual.usable[:, rows, at] = start[:, rows]
        virtual.pixels[:, rows, at] = trials.pixels[:, stops[rows]]
        virtual.sigmas[:, rows, at] = trials.sigmas[:, stops[rows]]
    return virtual


def own_trials(
    trials: TrialData, points: FloatArray, usable: BoolArray
) -> Iterator[tuple[int, VirtualObservations, FloatArray]]:
    """Each joint that has enough stops in its own trial, its observations, and its positions (k,) there relative to
    its middle one.
    """
    for joint in range(len(trials.joint_names)):
        try:
            stops, groups, base = trial_stops(trials, points, joint)
        except CalibrationError:
            continue
        markers = virtual_markers(trials, points, usable, stops, groups)
        yield joint, markers, trials.positions[stops, joint] - base[joint]


def best_single_joint(
    kind: Kind,
    cameras: FloatArray,
    observations: VirtualObservations,
    angles: FloatArray,
    *,
    thorough: bool = False,
) -> tuple[RigModel | None, float]:
    """Single joint of ``kind`` that best fits the ``observations`` at ``angles`` (k,), and its median residual
    [sigmas]; start values are tried until one fits. ``thorough``: unless one fits, or two converge to the same result,
    rotations about axes in all directions are tried, too.
    """
    camera, stop, marker = np.nonzero(observations.usable)
    data = Measurements(
        angles[:, None],
        camera,
        stop,
        marker,
        observations.pixels[observations.usable].reshape(-1, 2),
        observations.sigmas[observations.usable].ravel(),
    )
    found: list[_StartResult] = []
    for start in (linear_generator, nominal_generator):
        generator = start(
            kind,
            cameras,
            observations.points,
            observations.usable,
            observations.pixels,
            observations.sigmas,
            angles,
        )
        if generator is not None:
            found += _solve_from(kind, generator, cameras, observations, data, FULL)
            if found and found[-1].fits:
                break
    if thorough and kind == "revolute" and not _is_certain(found):
        rotated: list[_StartResult] = []
        for generator in rotation_generators(observations.points, angles):
            rotated += _solve_from(kind, generator, cameras, observations, data, SHORT)
        if rotated:
            rig = min(rotated, key=lambda one: one.score).rig
            found += _solve_from(kind, rig.generators[0], cameras, observations, data, FULL)
    best = min(found, key=lambda one: one.score, default=None)
    return (best.rig, best.median_residual) if best is not None else (None, np.inf)


@dataclass(frozen=True)
class _StartResult:
    """Result of a start: ``median_residual`` median residual and ``score``, that of all pixels, both [sigmas]."""

    rig: RigModel
    median_residual: float
    score: float
    converged: bool

    @property
    def fits(self) -> bool:
        return self.median_residual < GOOD_FIT and self.score < GOOD_FIT


def _is_certain(found: list[_StartResult]) -> bool:
    """Whether the best result fits, or two start values converged to it."""
    if not found:
        return False
    best = min(found, key=lambda one: one.score)
    alike = [one for one in found if one.score < (1.0 + ALIKE) * best.score]
    return best.converged and (best.fits or len(alike) > 1)


def _solve_from(
    kind: Kind,
    generator: FloatArray,
    cameras: FloatArray,
    observations: VirtualObservations,
    data: Measurements,
    evaluations: int,
) -> list[_StartResult]:
    """Result from start value ``generator`` (4, 4) after at most ``evaluations``; empty if the fit fails."""
    structure = common_points(generator, kind, observations.points, data.offsets[:, 0])
    structure[~observations.usable.any(axis=(0, 1))] = [0.0, 0.0, 1.0, 1.0]
    try:
        fit = solve(
            RigModel((kind,), generator[None], cameras, structure),
            data,
            "projective",
            cameras=False,
            loss=RobustLoss("soft_l1", 3.0),
            max_evaluations=evaluations,
        )
    except np.linalg.LinAlgError:
        return []  # a point of this start lies in a focal plane; the next start may succeed
    # The median of a chi-square with two degrees of freedom is ln 4.
    squares = (fit.residuals.reshape(-1, 2) ** 2).sum(axis=1)
    typical = float(np.sqrt(np.median(squares) / np.log(4.0)))
    # A wrong axis may fit the half of the markers that move least.
    score = float(np.sqrt(np.minimum(squares, WRONG_SQUARE * max(1.0, typical**2)).mean() / 2.0))
    if not np.isfinite(score):
        return []
    return [_StartResult(fit.rig, typical, score, fit.converged)]


def _check_effect(trials: TrialData, stops: IntArray, joint: int) -> None:
    """Raise CalibrationError for a joint whose trial changes the images by no more than their noise does."""
    name, unit = trials.joint_names[joint], _unit(trials, joint)
    motion, noise = _image_motion(trials, stops, joint)
    if motion < MIN_IMAGE_MOTION * noise:
        needed = MIN_IMAGE_MOTION * noise
        raise CalibrationError(
            "joint_without_effect",
            f"joint {name!r} reports a motion of {np.ptp(trials.positions[stops, joint]):.3g} {unit}, but the markers "
            f"moved by {motion:.3g} sigmas only in the images, which noise alone may do; at least {needed:.3g} are "
            "needed. Does it drive what the cameras see? If it does, a larger range, or less noise by more frames at "
            "each stop, shows it",
            joint=name,
            motion_sigmas=motion,
            minimum=needed,
        )


def _image_motion(trials: TrialData, stops: IntArray, joint: int) -> tuple[float, float]:
    """Motion of the markers in the images over a joint's ``stops`` (k,) [sigmas], and noise of the images, 1 if it
    is as stated.
    """
    stops = stops[np.argsort(trials.positions[stops, joint], kind="stable")]
    visible = trials.visible[:, stops]
    motions, bends = [], [np.zeros(0)]
    for c, i in zip(*np.nonzero(visible.sum(axis=1) >= 2), strict=True):
        # Inner quantiles of stops and an upper one of markers: single wrong pixels must not look like motion.
        seen = stops[visible[c, :, i]]
        pixels = trials.pixels[c, seen, i] / np.median(trials.sigmas[c, seen, i])
        motions.append(float(np.linalg.norm(np.ptp(np.quantile(pixels, [0.1, 0.9], axis=0), axis=0))))
        bends.append(np.diff(pixels, n=2, axis=0).ravel() / np.sqrt(6.0))
    # If the detector understates its noise, second differences show it; a motion's own are far below its range.
    scatter = np.abs(np.concatenate(bends))
    noise = max(1.0, float(np.median(scatter)) / NORMAL_MEDIAN) if len(scatter) else 1.0
    return (float(np.quantile(motions, 0.8)) if motions else 0.0), noise


def _unit(trials: TrialData, joint: int) -> str:
    return "rad" if trials.joint_kinds[joint] == "revolute" else "m"


def link_joints(trials: TrialData, cameras: FloatArray, separate: list[JointTrial], zero: FloatArray) -> RigModel:
    """Rig of all joints, base to tip: generators transformed from their trials' bases to one zero (5.21), one
    marker structure (5.53).

    Raises CalibrationError (``too_few_markers``) for a marker that no trial shows.
    """
    kinds = trials.joint_kinds
    generators = np.zeros((len(kinds), 4, 4))
    for j, trial in enumerate(separate):
        moved = _chain(kinds[:j], generators[:j], trial.base[:j] - zero[:j])
        generators[j] = np.linalg.inv(moved) @ trial.generator @ moved
    # Every trial gives the markers in its own base configuration; move them all to the zero.
    clouds = np.array(
        [trial.points @ np.linalg.inv(_chain(kinds, generators, trial.base - zero)).T for trial in separate]
    )
    clouds /= clouds[:, :, 2:3]
    points = np.empty((len(trials.marker_ids), 4))
    for i, marker in enumerate(trials.marker_ids):
        seen = clouds[np.isfinite(clouds[:, i]).all(axis=1), i]
        if not len(seen):
            raise CalibrationError(
                "too_few_markers", f"marker {marker} is shown by no joint's usable stops", marker=marker
            )
        points[i] = np.median(seen, axis=0)
    return RigModel(kinds, generators, cameras, points)


def _chain(kinds: tuple[str, ...], generators: FloatArray, offsets: FloatArray) -> FloatArray:
    product = np.eye(4)
    for kind, generator, offset in zip(kinds, generators, offsets, strict=True):
        product = product @ exp_generator(kind, generator, offset)
    return product


def without_rare_markers(
    trials: TrialData, points: FloatArray, usable: BoolArray
) -> tuple[TrialData, FloatArray, BoolArray, tuple[int, ...]]:
    """Leave out markers that two cameras see at fewer than two stops of joint trials. Raises
    CalibrationError.
    """
    often = np.isfinite(points[trials.trials >= 0]).all(axis=2).sum(axis=0) >= MIN_OBSERVATIONS
    if int(often.sum()) < MIN_MARKERS:
        raise CalibrationError(
            "too_few_markers",
            f"two cameras see {int(often.sum())} markers at {MIN_OBSERVATIONS} stops or more; at least "
            f"{MIN_MARKERS} are needed",
            markers=int(often.sum()),
            minimum=MIN_MARKERS,
        )
    left_out = tuple(i for i, keep in zip(trials.marker_ids, often, strict=True) if not keep)
    kept = msgspec.structs.replace(
        trials,
        marker_ids=tuple(i for i, keep in zip(trials.marker_ids, often, strict=True) if keep),
        pixels=trials.pixels[:, :, often],
        sigmas=trials.sigmas[:, :, often],
    )
    return kept, points[:, often], usable[:, :, often], left_out
