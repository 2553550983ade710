"""Joint angles estimated from images of known points without an initial guess: all configurations that fit, homing
displacements, and encoder zeros, with covariances (thesis 4.5.4, (4.45)).

The search starts from points distributed over the joint space and returns every configuration that is consistent with
the pixels. Angles of revolute joints are modulo 2π, nearest to the centre of their limits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.special import gammainccinv
from scipy.stats import qmc

from stereoservo.kinematics.joint_reprojection import (
    JointAnglesError,
    JointProblem,
    ObservedChain,
    joint_problem,
    observed_chain,
    predicted_pixels,
    reconstruct_points,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import BoolArray, FloatArray

STARTS = 512
"""Number of starts of a global search; ``GRID`` per joint if that is fewer."""
GRID = 16
RAY_STEPS = 25
"""Number of steps with ray residuals, before those with pixel residuals."""
PIXEL_STEPS = 60
VALLEY_STEPS = 400
"""Number of further steps for the end points that are consistent with the pixels."""
SETTLED = 1e-12
"""Relative change of the cost, or step [rad or m], at which a descent has converged."""
LONGEST_STEP = 0.5
"""Largest change of a joint in one step [rad or m]."""
AMBIGUOUS = 25.0
"""Increase of chi-square up to which another configuration counts as possible."""
MAX_SIGMA_FACTOR = 3.0
"""Residual [stated sigmas, rms] above which the pixels do not belong to this chain and these points."""
EXACT = 1e-4
"""Cost at which equations without redundancy count as solved."""
RESIDUAL_TAIL = 1e-6
"""Probability below which a cost is not explained by noise."""
LARGEST_DEVIATION = 0.1
"""Standard deviation [rad or m] above which a joint counts as not observable."""

Linearise = Callable[[FloatArray], tuple[FloatArray, FloatArray, BoolArray]]


@dataclass(frozen=True, eq=False)
class JointAngles:
    """Joints ``q`` (n,) [rad or m] of least reprojection error, with ``covariance`` (n, n) at the stated noise.

    ``cost``: sum of squared residuals divided by the stated variances; ``freedom``: number of measurements minus number
    of joints.
    """

    q: FloatArray
    covariance: FloatArray
    cost: float
    freedom: int

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations (n,) [rad or m]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)


def measured_joints(
    problem: JointProblem,
    *,
    limits: FloatArray | None = None,
    start: FloatArray | None = None,
    largest_deviation: float = LARGEST_DEVIATION,
) -> tuple[JointAngles, ...]:
    """All configurations that are consistent with the pixels of ``problem``, the best first.

    ``limits`` (n, 2) [rad or m] bound the search; without them revolute joints are unbounded, prismatic joints require
    limits. With ``start`` (n,) only the configuration near it is searched. Raises JointAnglesError: ``limits``,
    ``too_few`` (fewer coordinates than joints), ``no_agreement`` (no configuration explains the pixels),
    ``outside_limits``, ``not_observable`` with the joints whose deviation exceeds ``largest_deviation`` [rad or m].
    """
    seen = problem.seen
    n = seen.chain.joints
    _require_enough(problem)
    bounds = _bounds(seen, limits, local=start is not None)
    if start is None:
        near = _distinct(_descent(problem.linearise_rays, _starts(bounds), RAY_STEPS)[0], seen)
    else:
        near = np.asarray(start, dtype=np.float64).reshape(1, n)
    ends, costs, front = _descent(problem.linearise, near, PIXEL_STEPS)
    if not front.any():
        raise _behind()
    q, costs = _wrapped(ends[front], bounds, seen), costs[front]
    ordered = _possible(problem, costs)
    _refuse_undetermined(problem, q[ordered[0]], largest_deviation)
    # Few are left: those in a narrow valley are refined to its minimum, where they are one configuration.
    ends, costs, _ = _descent(problem.linearise, q[ordered], VALLEY_STEPS)
    ordered = np.argsort(costs, kind="stable")
    found = _distinct_configurations(problem, _wrapped(ends, bounds, seen)[ordered], costs[ordered])
    inside = tuple(angles for angles in found if _inside(angles, bounds))
    if not inside:
        raise _outside(found[0].q, bounds)
    return inside


def refined_joints(
    problem: JointProblem, starts: FloatArray, *, limits: FloatArray | None = None
) -> tuple[JointAngles | JointAnglesError, ...]:
    """For each of ``starts`` (s, n) the configuration near it that fits the pixels of ``problem`` best, or the error:
    ``no_agreement``, ``outside_limits``. All starts are refined together.

    Joints that the pixels do not determine have a large standard deviation. Raises JointAnglesError: ``limits``,
    ``too_few``.
    """
    seen = problem.seen
    _require_enough(problem)
    bounds = _bounds(seen, limits, local=True)
    if not len(starts):
        return ()
    ends, costs, front = _descent(problem.linearise, np.asarray(starts, dtype=np.float64), PIXEL_STEPS)
    ends = _wrapped(ends, bounds, seen)
    slopes = problem.linearise(ends)[1]
    covariances = np.linalg.pinv(slopes.swapaxes(-1, -2) @ slopes, rcond=1e-13, hermitian=True)
    found: list[JointAngles | JointAnglesError] = []
    for q, cost, ahead, covariance in zip(ends, costs, front, covariances, strict=True):
        try:
            if not ahead:
                raise _behind()
            _possible(problem, np.array([cost]))
        except JointAnglesError as error:
            found.append(error)
            continue
        angles = JointAngles(q, covariance, float(cost), max(0, problem.freedom))
        found.append(angles if _inside(angles, bounds) else _outside(q, bounds))
    return tuple(found)


def _require_enough(problem: JointProblem) -> None:
    """Raise JointAnglesError if there are fewer coordinates than joints."""
    n = problem.seen.chain.joints
    if problem.measurements < n:
        raise JointAnglesError(
            "too_few",
            f"{problem.measurements} pixel coordinates for {n} joints; more points or cameras are needed",
            measurements=problem.measurements,
            joints=problem.seen.joint_names,
        )


def _behind() -> JointAnglesError:
    return JointAnglesError(
        "no_agreement", "no configuration puts the points before the cameras that see them", cost=None
    )


def _outside(q: FloatArray, bounds: FloatArray) -> JointAnglesError:
    return JointAnglesError(
        "outside_limits",
        f"the pixels give {np.round(q, 4).tolist()}, outside of the limits {bounds.tolist()}",
        q=q.tolist(),
        limits=bounds.tolist(),
    )


def _possible(problem: JointProblem, costs: FloatArray) -> npt.NDArray[np.int64]:
    """Indices of the end points of a search, with ``costs`` (s,), that are consistent with the pixels, the best first.
    Raises JointAnglesError if even the best does not explain the pixels.
    """
    best = float(costs.min())
    freedom = max(0, problem.freedom)
    factor = max(1.0, best / max(1, freedom))
    # As many equations as joints are solved exactly or not at all.
    chance = 2.0 * float(gammainccinv(0.5 * freedom, RESIDUAL_TAIL)) if freedom else EXACT  # of chi-square
    if best > MAX_SIGMA_FACTOR**2 * chance:
        raise JointAnglesError(
            "no_agreement",
            f"no configuration explains the pixels: the residual is {np.sqrt(factor):.3g} times the stated noise, at "
            f"most {MAX_SIGMA_FACTOR:g} is believed. Are these the points, the cameras, the chain?",
            sigma_factor=float(np.sqrt(factor)),
            maximum=MAX_SIGMA_FACTOR,
        )
    possible = np.flatnonzero(costs - best <= AMBIGUOUS * factor)
    return np.asarray(possible[np.argsort(costs[possible], kind="stable")], dtype=np.int64)


def _distinct_configurations(problem: JointProblem, q: FloatArray, costs: FloatArray) -> list[JointAngles]:
    """Distinct configurations among the end points ``q`` (s, n), in order of their ``costs`` (s,)."""
    found: list[JointAngles] = []
    for end, cost in zip(q, costs, strict=True):
        slope = problem.linearise(end[None])[1][0]
        information: FloatArray = slope.T @ slope
        if any(_same(end - other.q, float(cost) - other.cost, information, problem.seen) for other in found):
            continue
        covariance = np.asarray(np.linalg.pinv(information, rcond=1e-13, hermitian=True), dtype=np.float64)
        found.append(JointAngles(end, covariance, float(cost), max(0, problem.freedom)))
    return found


@dataclass(frozen=True, eq=False)
class Homing:
    """Result of homing: ``displacement`` (n,) = home minus current joints [rad or m], with ``covariance`` (n, n) that
    includes the noise of both images; ``current``: the measured joints; ``alternatives``: other displacements that are
    consistent with the image.
    """

    displacement: FloatArray
    covariance: FloatArray
    current: JointAngles
    alternatives: tuple[JointAngles, ...]


def homing_problem(
    seen: ObservedChain,
    home: FloatArray,
    home_pixels: FloatArray,
    pixels: FloatArray,
    sigma: FloatArray | float,
) -> JointProblem:
    """The problem (4.45) of pixels (c, m, 2) [px] of one or more static points, which were at ``home_pixels`` (c, m, 2)
    in the configuration ``home`` (n,).

    The points are reconstructed from the home images and weighted by their covariance. Raises JointAnglesError if no
    point is seen by two cameras at home.
    """
    points, covariance = reconstruct_points(seen, home, home_pixels, sigma)
    if not np.isfinite(points).all(axis=1).any():
        raise JointAnglesError("too_few", "no point is seen by two cameras in the home image; one is needed")
    return joint_problem(seen, points, pixels, sigma, point_covariance=covariance)


def homing_displacement(
    problem: JointProblem,
    home: FloatArray,
    *,
    limits: FloatArray | None = None,
    start: FloatArray | None = None,
    largest_deviation: float = LARGEST_DEVIATION,
) -> Homing:
    """Joint displacement back to ``home`` (n,) of a `homing_problem`, from any configuration.

    Raises JointAnglesError as `measured_joints` does.
    """
    found = measured_joints(problem, limits=limits, start=start, largest_deviation=largest_deviation)
    return Homing(home - found[0].q, found[0].covariance, found[0], found[1:])


@dataclass(frozen=True, eq=False)
class JointZeros:
    """``offset`` (n,) [rad or m] to add to the encoder readings so that they agree with the cameras, with its
    ``deviations`` (n,) and ``covariance`` (n, n); ``cost``, ``freedom``; ``alternatives``: other offsets that are
    consistent with the images, farther from the readings. If there is one, the zeros are not determined.
    """

    offset: FloatArray
    deviations: FloatArray
    covariance: FloatArray
    cost: float
    freedom: int
    alternatives: tuple[FloatArray, ...]


def joint_zeros(
    seen: ObservedChain,
    points: FloatArray,
    pixels: FloatArray,
    sigma: FloatArray | float,
    encoders: FloatArray,
    *,
    limits: FloatArray | None = None,
    point_covariance: FloatArray | None = None,
    largest_deviation: float = LARGEST_DEVIATION,
) -> JointZeros:
    """Offsets of the joints' zeros from raw ``pixels`` (k, c, m, 2) [px] at readings ``encoders`` (k, n) [rad or m].

    One stop is enough if it determines all joints; further stops are combined with it. ``limits`` (n, 2): limits of the
    offsets, by default one full turn and, for prismatic joints, ± 1 m. Raises JointAnglesError as `measured_joints`
    does: ``not_observable`` names the joints that the images do not determine.
    """
    kinds = seen.chain.kinds
    default = np.array([[-np.pi, np.pi] if kind == "revolute" else [-1.0, 1.0] for kind in kinds])
    problem = joint_problem(
        seen,
        points,
        pixels,
        sigma,
        offsets=np.atleast_2d(encoders),
        point_covariance=point_covariance,
    )
    found = measured_joints(problem, limits=default if limits is None else limits, largest_deviation=largest_deviation)
    # Differences between these in the images are within the noise.
    nearest, *others = sorted(found, key=lambda angles: float(np.linalg.norm(angles.q)))
    return JointZeros(
        nearest.q,
        nearest.deviations,
        nearest.covariance,
        nearest.cost,
        nearest.freedom,
        tuple(other.q for other in others),
    )


@dataclass(frozen=True)
class DistinguishingMotion:
    """A motion of one joint (by index) by ``step`` [rad or m] that distinguishes postures with the same images: after
    it, ``distinguished`` pairs of postures differ in their images, by at least ``pixels`` [px].
    """

    joint: int
    step: float
    distinguished: int
    pixels: float


def distinguishing_motion(
    model: CellModel,
    postures: FloatArray,
    readings: FloatArray,
    limits: FloatArray,
    step: float,
    least_px: float,
) -> DistinguishingMotion | None:
    """Motion of one joint by ±``step`` [rad or m] that distinguishes the most pairs of the ``postures`` (p, n), which
    have the same images: a marker inside an image then differs by ``least_px`` or more. None if there is no such
    motion.

    ``readings`` (n,) stay within ``limits`` (n, 2), the joint limits of the cell.
    """
    first, second = np.triu_indices(len(postures), 1)
    sizes = np.array([[camera.width, camera.height] for camera in model.cameras], dtype=np.float64)
    found: list[DistinguishingMotion] = []
    for joint, by in product(range(len(readings)), (step, -step)):
        if not limits[joint, 0] <= readings[joint] + by <= limits[joint, 1]:
            continue
        moved = postures + by * np.eye(len(readings))[joint]
        pixels = predicted_pixels(observed_chain(model), moved, model.marker_points)
        inside: BoolArray = np.asarray(((pixels > -0.5) & (pixels < sizes[:, None] - 0.5)).all(axis=-1))
        pixel_distances = np.linalg.norm(pixels[first] - pixels[second], axis=-1)
        pixel_distances = np.where(inside[first] & inside[second], pixel_distances, 0.0).max(axis=(1, 2))
        distinguished = pixel_distances >= least_px
        if distinguished.any():
            found.append(
                DistinguishingMotion(joint, by, int(distinguished.sum()), float(pixel_distances[distinguished].min()))
            )
    return max(found, key=lambda motion: (motion.distinguished, motion.pixels), default=None)


def sensitivity(problem: JointProblem, changed: JointProblem, opposite: JointProblem, q: FloatArray) -> FloatArray:
    """Change (n,) of the measured joints at ``q`` (n,) for half the difference of two calibrations.

    First order: ``-(JᵀJ)⁻¹ Jᵀ (r₊ - r₋)/2``. If the calibrations differ by the columns of a root of the calibration's
    covariance, the sum of the outer products is the calibration's contribution to the joints' covariance.
    """
    _, slope, _ = problem.linearise(q[None])
    plus, minus = (p.linearise(q[None])[0][0] for p in (changed, opposite))
    return np.asarray(-np.linalg.lstsq(slope[0], 0.5 * (plus - minus), rcond=None)[0], dtype=np.float64)


def _bounds(seen: ObservedChain, limits: FloatArray | None, *, local: bool) -> FloatArray:
    """Limits (n, 2); by default a full turn about the zero."""
    n = seen.chain.joints
    if limits is not None:
        bounds = np.asarray(limits, dtype=np.float64)
        if bounds.shape != (n, 2) or not (bounds[:, 0] < bounds[:, 1]).all():
            raise JointAnglesError(
                "limits",
                f"limits {bounds.tolist()}; {n} pairs are needed, the lower first",
                limits=bounds.tolist(),
            )
        return bounds
    free = [name for name, kind in zip(seen.joint_names, seen.chain.kinds, strict=True) if kind == "prismatic"]
    if free and not local:
        raise JointAnglesError(
            "limits", f"prismatic joints {free} need limits for a search without a start", joints=free
        )
    return np.array(
        [
            [z - np.pi, z + np.pi] if kind == "revolute" else [-np.inf, np.inf]
            for z, kind in zip(seen.chain.zero, seen.chain.kinds, strict=True)
        ]
    )


def _starts(bounds: FloatArray) -> FloatArray:
    """Start configurations (s, n): a grid, or a low-discrepancy sequence, over the limits (n, 2)."""
    n = len(bounds)
    per_joint = min(GRID, int(STARTS ** (1.0 / n) + 1e-9))
    if per_joint >= 8:
        cells = (np.arange(per_joint) + 0.5) / per_joint
        unit = np.stack(np.meshgrid(*[cells] * n, indexing="ij"), axis=-1).reshape(-1, n)
    else:
        unit = qmc.Sobol(n, scramble=False).random(STARTS)
    return np.asarray(bounds[:, 0] + unit * np.ptp(bounds, axis=1), dtype=np.float64)


def _descent(linearise: Linearise, q: FloatArray, steps: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Levenberg-Marquardt from all starts ``q`` (s, n) at once: end configurations, costs (s,), if in front (s,)."""
    q = q.copy()
    error, slope, front = linearise(q)
    cost = (error**2).sum(axis=1)
    damping = np.full(len(q), 1e-3)
    active = np.arange(len(q))
    identity = np.eye(q.shape[1])
    for _ in range(steps):
        normal = slope[active].swapaxes(-1, -2) @ slope[active]
        size = np.sqrt(np.einsum("sii->si", normal))
        size = np.where(size > 0.0, size, 1.0)
        scaled = normal / (size[:, :, None] * size[:, None, :]) + damping[active, None, None] * identity
        gradient = np.einsum("srn,sr->sn", slope[active], error[active])
        step = -np.linalg.solve(scaled, (gradient / size)[..., None])[..., 0] / size
        length = np.abs(step).max(axis=1)
        step *= np.minimum(1.0, LONGEST_STEP / np.maximum(length, 1e-300))[:, None]
        new_error, new_slope, new_front = linearise(q[active] + step)
        new_cost = (new_error**2).sum(axis=1)
        before = cost[active]
        better = new_cost <= before
        won = active[better]
        q[won] += step[better]
        error[won], slope[won], front[won] = new_error[better], new_slope[better], new_front[better]
        # At the minimum, the next cost may be larger by rounding.
        settled = np.abs(new_cost - before) <= SETTLED * (new_cost + 1e-18)
        settled |= np.abs(step).max(axis=1) < SETTLED
        cost[won] = new_cost[better]
        damping[active] *= np.where(better, 0.1, 10.0)
        damping[active] = np.clip(damping[active], 1e-14, 1e12)
        active = active[~settled]
        if not len(active):
            break
    return q, cost, front


def _distinct(q: FloatArray, seen: ObservedChain) -> FloatArray:
    """One of each group of configurations (s, n) that agree within a hundredth."""
    full_turn = np.array([2.0 * np.pi if kind == "revolute" else np.inf for kind in seen.chain.kinds])
    folded = np.where(np.isfinite(full_turn), np.mod(q, full_turn), q)
    _, first = np.unique(np.round(folded / 0.01).astype(np.int64), axis=0, return_index=True)
    return q[np.sort(first)]


def _wrapped(q: FloatArray, bounds: FloatArray, seen: ObservedChain) -> FloatArray:
    """Revolute angles (s, n) wrapped to within half a turn of the centre of their limits."""
    revolute = np.array([kind == "revolute" for kind in seen.chain.kinds])
    centre = np.where(revolute, bounds.mean(axis=1), 0.0)
    wrapped = centre + np.mod(q - centre + np.pi, 2.0 * np.pi) - np.pi
    return np.where(revolute, wrapped, q)


def _refuse_undetermined(problem: JointProblem, q: FloatArray, largest: float) -> None:
    """Raise JointAnglesError if the pixels do not determine a joint's position at ``q`` (n,)."""
    slope = problem.linearise(q[None])[1][0]
    _, singular, rows = np.linalg.svd(slope, full_matrices=len(slope) < len(q))
    padded = np.zeros(len(q))
    padded[: len(singular)] = singular
    padded = np.maximum(padded, max(1e-12 * float(padded[0]), 1e-300))
    deviations = np.sqrt(((rows.T / padded) ** 2).sum(axis=1))
    open_joints = [name for name, d in zip(problem.seen.joint_names, deviations, strict=True) if d > largest]
    if open_joints:
        raise JointAnglesError(
            "not_observable",
            f"the images do not determine joint(s) {', '.join(open_joints)}: standard deviation above {largest:g}. "
            "More points, points farther from their axes, or another stop are needed",
            joints=open_joints,
            deviations=[float(d) if d < 1e6 else None for d in deviations],
            maximum=largest,
        )


def _same(difference: FloatArray, worse: float, information: FloatArray, seen: ObservedChain) -> bool:
    """Whether two end points of a search are the same configuration; they differ by ``difference`` (n,) and in cost by
    ``worse``. They are the same within a tenth of a standard deviation, or in one basin of attraction, where the cost
    grows as the square of the distance.
    """
    revolute = np.array([kind == "revolute" for kind in seen.chain.kinds])
    difference = np.where(revolute, np.mod(difference + np.pi, 2.0 * np.pi) - np.pi, difference)
    return bool(np.abs(difference).max() < 1e-6 or difference @ information @ difference < 1e-2 + 4.0 * worse)


def _inside(angles: JointAngles, bounds: FloatArray) -> bool:
    slack = 1e-6 + 5.0 * angles.deviations
    return bool(((angles.q >= bounds[:, 0] - slack) & (angles.q <= bounds[:, 1] + slack)).all())
