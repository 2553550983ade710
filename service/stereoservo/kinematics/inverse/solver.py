"""Inverse kinematics of an arm in the cameras' projective frame, all configurations that reach a goal: recognition of
the arm's structure, closed-form or numerical candidates, refinement, checks.

Valid in every stratum: operators and points suffice (thesis 6); neither a metric nor the plane at infinity is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.screws import exp_twist
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.inverse import numerical
from stereoservo.kinematics.inverse.closed_forms import (
    Branches,
    arm,
    arm_with_wrist,
    concatenate,
    gantry_with_wrist,
    prismatic_joints,
    turn_between,
    two_general,
    two_parallel,
    wrist,
)
from stereoservo.kinematics.inverse.numerical import POLISH, equivalent_points, linearised, run_descent
from stereoservo.kinematics.inverse.recognition import Recognition, chain_of, recognise
from stereoservo.kinematics.inverse.self_motion import (
    NO_MOTION,
    moved_within_limits,
    nearest_by_self_motion,
    self_motions,
)
from stereoservo.kinematics.inverse.solutions import (
    Case,
    InverseKinematicsError,
    InverseSolutions,
    Shortfall,
    distinct,
    within_limits,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

TOLERANCE = 1e-8
"""Residual up to which a goal counts as reached: rounding, for exact goals."""
WITNESSES = 4
"""Number of points of a goal that are tried in the cases that use a single point."""
RIGID = 3
"""Number of points from which on it can be tested whether a goal is a rigid motion."""
ROUNDING = 1e-9
FREEDOMS = 6
EXACT_GOALS = 1e-6
"""Tolerance up to which goals and chain count as exact."""

Solver = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], Branches]
SINGLE_POINT: dict[Case, Solver] = {"two_revolute": two_general, "two_parallel": two_parallel, "arm": arm}
WHOLE_ROTATION: dict[Case, Callable[[FloatArray, FloatArray, FloatArray], Branches]] = {
    "wrist": wrist,
    "arm_with_wrist": arm_with_wrist,
    "gantry_with_wrist": gantry_with_wrist,
}


@dataclass(frozen=True, eq=False)
class _Problem:
    """A goal in normal form: points and targets (m, 4) of equal scales; the displacement if they determine it."""

    chain: ProjectiveChain
    points: FloatArray
    targets: FloatArray
    displacement: FloatArray | None
    seed: FloatArray
    limits: FloatArray | None
    tolerance: float


def inverse_kinematics(
    mechanism: ProjectiveChain | CellModel,
    *,
    displacement: FloatArray | None = None,
    points: FloatArray | None = None,
    targets: FloatArray | None = None,
    seed: FloatArray | None = None,
    limits: FloatArray | None = None,
    tolerance: float = TOLERANCE,
    recognition: Recognition | None = None,
) -> InverseSolutions:
    """Inverse kinematics: all configurations that reach a goal.

    The goal is a ``displacement`` (4, 4) from the chain's zero, of any scale, or ``targets`` (m, 4) of ``points``
    (m, 4) at the zero, of any heights. ``seed`` (n,), default the zero, orders the solutions; joints that the goal does
    not determine stay there. ``limits`` (n, 2) [rad or m]; required for prismatic joints if there is no closed form.
    ``tolerance``: residual up to which a goal counts as reached; for measured goals it must correspond to their noise.
    ``recognition``: of this arm, if already known (for a model with a covariance it takes a second).

    Raises InverseKinematicsError for goals that no motion of this kind of arm explains (mirrored, another body), for
    wrong shapes and for values that are not finite. Out of reach and out of limits are results, not errors.
    """
    chain = chain_of(mechanism)
    problem = _problem(chain, displacement, points, targets, seed, limits, tolerance)
    known = recognise(mechanism) if recognition is None else recognition
    problem = replace(problem, displacement=_displacement(problem, known))
    branches = _closed_form(problem, known)
    if len(problem.points) > problem.points.shape[1]:
        at_zero, at_goal = equivalent_points(problem.points, problem.targets)
        problem = replace(problem, points=at_zero, targets=at_goal)
    if branches is None:
        return _searched(problem)
    starts = chain.zero + branches.steps
    ends, left = run_descent(chain, problem.points, problem.targets, starts, damping=POLISH)
    solved = left <= tolerance
    if not solved.any():
        return _unreachable(problem, known, ends, left, branches)
    return _answer(problem, known.case, ends[solved], left[solved])


def _problem(
    chain: ProjectiveChain,
    displacement: FloatArray | None,
    points: FloatArray | None,
    targets: FloatArray | None,
    seed: FloatArray | None,
    limits: FloatArray | None,
    tolerance: float,
) -> _Problem:
    n = chain.joints
    if n == 0:
        raise InverseKinematicsError("shape", "the chain has no joint; one or more are needed")
    seed = chain.zero if seed is None else finite("seed", seed, (n,))
    if limits is not None:
        limits = np.asarray(limits, dtype=np.float64)
        if limits.shape != (n, 2) or not (limits[:, 0] <= limits[:, 1]).all():
            raise InverseKinematicsError("limits", f"limits {limits.tolist()}; {n} pairs are needed, the lower first")
    if not 0.0 < tolerance < 1.0:
        raise InverseKinematicsError("shape", f"tolerance {tolerance}; between 0 and 1 is needed")
    if displacement is not None and points is None and targets is None:
        H = scaled_displacement(chain.generators, displacement)
        # A displacement is represented by its images of the columns of the identity.
        return _Problem(chain, np.eye(4), np.ascontiguousarray(H.T), H, seed, limits, tolerance)
    if displacement is None and points is not None and targets is not None:
        at_zero, at_goal = equal_scales(chain.generators, points, targets)
        return _Problem(chain, at_zero, at_goal, None, seed, limits, tolerance)
    raise InverseKinematicsError("shape", "give a displacement, or points and targets: one goal is needed")


def _displacement(problem: _Problem, known: Recognition) -> FloatArray | None:
    """The displacement that the goal's points determine, if the closed form needs it or they belong to a rigid body."""
    if problem.displacement is not None:
        return problem.displacement
    needless = not known.inverted and known.case not in WHOLE_ROTATION
    if needless and len(problem.points) < RIGID:
        return None
    # The motion group of a calibrated arm of few joints is unknown: noise of its operators generates all motions.
    if needless and problem.chain.joints < FREEDOMS and problem.tolerance > EXACT_GOALS:
        return None
    max_residual = max(problem.tolerance, ROUNDING)
    return displacement_between(problem.chain.generators, problem.points, problem.targets, max_residual=max_residual)


def _closed_form(problem: _Problem, known: Recognition) -> Branches | None:
    """Candidates of the recognised case, columns in the order of the chain's joints; None if there is no closed form,
    or none for this goal.
    """
    order = list(problem.chain.order[::-1] if known.inverted else problem.chain.order)
    sense = -1.0 if known.inverted else 1.0
    G = sense * problem.chain.generators[order]
    seed = (problem.seed - problem.chain.zero)[order]
    if known.inverted:
        if problem.displacement is None:
            return None
        back = np.asarray(np.linalg.inv(problem.displacement), dtype=np.float64)
        found = _candidates(known.case, G, back, np.eye(4), back.T, seed)
    else:
        found = _candidates(known.case, G, problem.displacement, problem.points, problem.targets, seed)
    if found is None:
        return None
    base_first = np.argsort(order)
    return Branches(found.steps[:, base_first], found.excess[:, base_first], found.free[:, base_first])


def _candidates(
    case: Case,
    G: FloatArray,
    H: FloatArray | None,
    points: FloatArray,
    targets: FloatArray,
    seed: FloatArray,
) -> Branches | None:
    if case == "prismatic":
        return prismatic_joints(G, points, targets)
    if case == "revolute":
        return turn_between(G[0], points, targets, float(seed[0]))
    if case in SINGLE_POINT:
        pairs = zip(points[:WITNESSES], targets[:WITNESSES], strict=True)
        return concatenate([SINGLE_POINT[case](G, A, goal, seed) for A, goal in pairs])
    if case in WHOLE_ROTATION and H is not None:
        return WHOLE_ROTATION[case](G, H, seed)
    return None


def _searched(problem: _Problem) -> InverseSolutions:
    """Numerical solutions of a chain without closed form: isolated ones, or the nearest of a continuum."""
    chain = problem.chain
    rank = _rank(problem)
    search = numerical.all_solutions if rank == chain.joints else numerical.one_solution
    ends, left, best = search(
        chain,
        problem.points,
        problem.targets,
        limits=problem.limits,
        tolerance=problem.tolerance,
        seed=problem.seed,
    )
    if not len(ends):
        residual = float(run_descent(chain, problem.points, problem.targets, best[None], iterations=0)[1][0])
        return _nothing(problem, "numerical", Shortfall(best, residual, None, None))
    if rank < chain.joints:
        ends = np.array([_settled(problem, q) for q in _representatives(problem, ends)])
        ends, left = run_descent(chain, problem.points, problem.targets, ends, damping=POLISH)
    return _answer(problem, "numerical", ends, left)


def _rank(problem: _Problem) -> int:
    """Number of degrees of freedom of the goal that the joints move, at the configuration where they move most."""
    most = 0
    for q in numerical.even_starts(problem.chain, problem.limits, 4):
        J = linearised(problem.chain, problem.points, q)[1]
        singular = np.linalg.svd(J, compute_uv=False)
        most = max(most, int((singular > NO_MOTION * max(float(singular[0]), 1e-300)).sum()))
    return most


def _representatives(problem: _Problem, ends: FloatArray) -> FloatArray:
    """Point of a continuum (s, n) nearest to the seed; with limits, the first few."""
    wrapped = np.array([within_limits(problem.chain.kinds, q, problem.seed, problem.limits)[0] for q in ends])
    order = np.argsort(np.linalg.norm(wrapped - problem.seed, axis=1), kind="stable")
    return wrapped[order[: 1 if problem.limits is None else 8]]


def _settled(problem: _Problem, q: FloatArray) -> FloatArray:
    return nearest_by_self_motion(problem.chain, problem.points, problem.targets, q, problem.seed, problem.tolerance)


def _answer(problem: _Problem, case: Case, joints: FloatArray, left: FloatArray) -> InverseSolutions:
    """Distinct solutions (s, n) inside the limits, nearest to the seed first."""
    chain = problem.chain
    by_residual = np.argsort(left, kind="stable")
    joints, left = joints[by_residual], left[by_residual]
    inside: list[tuple[FloatArray, float, FloatArray]] = []
    outside: list[FloatArray] = []
    for i in distinct(chain.kinds, joints):
        q, fits = within_limits(chain.kinds, joints[i], problem.seed, problem.limits)
        motions = self_motions(chain, problem.points, problem.targets, q, problem.tolerance)
        if not fits and len(motions) == 1 and problem.limits is not None:
            slid = moved_within_limits(chain, problem.points, problem.targets, q, problem.limits, problem.tolerance)
            if slid is not None:
                q, fits = slid, True
                motions = self_motions(chain, problem.points, problem.targets, q, problem.tolerance)
        if fits:
            inside.append((q, float(left[i]), motions))
        else:
            outside.append(q)
    inside.sort(key=lambda solution: float(np.linalg.norm(solution[0] - problem.seed)))
    n = chain.joints
    rows = np.array([q for q, _, _ in inside]).reshape(-1, n)
    residuals = run_descent(chain, problem.points, problem.targets, rows, iterations=0)[1]
    motions_of = tuple(motions for _, _, motions in inside)
    return InverseSolutions(
        case,
        "beyond_limits" if not inside else "continuum" if any(map(len, motions_of)) else "isolated",
        rows,
        residuals,
        motions_of,
        np.array(outside).reshape(-1, n),
    )


def _unreachable(
    problem: _Problem, known: Recognition, ends: FloatArray, left: FloatArray, branches: Branches
) -> InverseSolutions:
    """Result for an unreachable goal; it names the first joint, in the order of solution, that fails in every
    branch.
    """
    nearest = int(np.argmin(left))
    failing = np.flatnonzero(branches.excess.min(axis=0) > problem.tolerance)
    order = problem.chain.order[::-1] if known.inverted else problem.chain.order
    joint = next((j for j in order if j in failing), None)
    excess = None if joint is None else float(branches.excess[:, joint].min())
    return _nothing(problem, known.case, Shortfall(ends[nearest], float(left[nearest]), joint, excess))


def _nothing(problem: _Problem, case: Case, shortfall: Shortfall) -> InverseSolutions:
    none = np.zeros((0, problem.chain.joints))
    return InverseSolutions(case, "unreachable", none, np.zeros(0), (), none, shortfall)


# -- normal form of goals ------------------------------------------------------------------------------------
# Normal form of the goals of inverse kinematics: points at the joints' zero, and targets of the same homogeneous
# scale; planes that all joints leave fixed, and the Lie algebra of their motions.
#
# All displacements of a chain leave some plane invariant, ``aᵀĤ_j = 0``: that at infinity, or one of a pencil if all
# axes are parallel. Each gives the scales that they preserve; it does not matter which one is used.


PLANE_TOLERANCE = 1e-12
"""Height of a point, relative to its norm, below which it counts as zero."""
RANK_TOLERANCE = 1e-6
FIT_STEPS = 60
STARTS = 24
CANDIDATES = 64
"""Number of planes of a pencil that are tried."""
SETTLED = 1e-14
WHOLE_GROUP = 6
"""Dimension of the algebra of all rigid motions."""


def finite(name: str, array: FloatArray, shape: tuple[int | None, ...]) -> FloatArray:
    """``array`` as float64. Raises InverseKinematicsError for a wrong shape or values that are not finite."""
    array = np.asarray(array, dtype=np.float64)
    fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
    if not fits:
        expected = ", ".join("m" if size is None else str(size) for size in shape)
        raise InverseKinematicsError(
            "shape", f"{name} has shape {array.shape}; ({expected}) is needed", shape=array.shape
        )
    if not np.isfinite(array).all():
        raise InverseKinematicsError("not_finite", f"{name} {array.tolist()} must be finite")
    return array


def fixed_planes(generators: FloatArray) -> FloatArray:
    """Orthonormal basis (k, 4) of the planes that all ``generators`` (n, 4, 4) leave invariant, ``aᵀĤ_j = 0``.

    One plane, or a pencil or bundle if axes are parallel or there are few joints; at least the plane that is nearest to
    invariant.
    """
    unit = generators / np.linalg.norm(generators, axis=(1, 2), keepdims=True)
    U, singular, _ = np.linalg.svd(np.concatenate(list(unit), axis=1))
    rank = min(3, int((singular > RANK_TOLERANCE * singular[0]).sum()))
    return np.asarray(U[:, rank:].T, dtype=np.float64)


def clear_plane(planes: FloatArray, points: FloatArray) -> FloatArray:
    """Plane (4,) of the span of ``planes`` (k, 4) that is farthest from all ``points`` (m, 4)."""
    if len(planes) == 1:
        return np.asarray(planes[0], dtype=np.float64)
    scales = planes @ (points / np.linalg.norm(points, axis=1, keepdims=True)).T
    candidates = np.random.default_rng(0).normal(size=(CANDIDATES, len(planes)))
    candidates /= np.linalg.norm(candidates, axis=1, keepdims=True)
    clearest = int(np.argmax(np.abs(candidates @ scales).min(axis=1)))
    return np.asarray(candidates[clearest] @ planes, dtype=np.float64)


def scaled_displacement(generators: FloatArray, H: FloatArray) -> FloatArray:
    """``H`` (4, 4), given up to scale and sign, scaled so that it preserves the plane that the chain leaves invariant.

    Also valid for half a turn, where the trace does not determine the sign. Raises InverseKinematicsError if it is a
    reflection, singular, or does not preserve the plane.
    """
    H = finite("displacement", H, (4, 4))
    size = float(np.linalg.norm(H))
    determinant = float(np.linalg.det(H / size)) if size > 0.0 else 0.0
    if not determinant > 1e-14:
        raise InverseKinematicsError(
            "mirrored",
            f"det H is {determinant:.3g} (at unit norm); a displacement has a positive determinant",
            determinant=determinant,
        )
    plane = fixed_planes(generators)[-1]
    scale = float(plane @ H @ plane)
    if not abs(scale) > 1e-9 * size:
        raise InverseKinematicsError(
            "not_rigid", "the displacement does not keep the plane that all joints leave fixed", scale=scale
        )
    return H / scale


def equal_scales(generators: FloatArray, points: FloatArray, targets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``points`` (m, 4) unchanged, and ``targets`` (m, 4) scaled to the same value on a plane that all joints leave
    invariant.

    Raises InverseKinematicsError for wrong shapes, and for a point or target on that plane.
    """
    points, targets = finite("points", points, (None, 4)), finite("targets", targets, (None, 4))
    if points.shape != targets.shape or not len(points):
        raise InverseKinematicsError(
            "shape",
            f"points {points.shape}, targets {targets.shape}; one target for each of one or more points is needed",
            shape=targets.shape,
        )
    for name, array in (("points", points), ("targets", targets)):
        zero = np.flatnonzero(~(np.linalg.norm(array, axis=1) > 0.0))
        if len(zero):
            raise InverseKinematicsError("degenerate", f"{name} {zero.tolist()} are zero vectors, no points")
    plane = clear_plane(fixed_planes(generators), np.concatenate([points, targets]))
    for name, array in (("points", points), ("targets", targets)):
        low = np.flatnonzero(~(np.abs(array @ plane) > PLANE_TOLERANCE * np.linalg.norm(array, axis=1)))
        if len(low):
            raise InverseKinematicsError(
                "degenerate",
                f"{name} {low.tolist()} lie on the plane that all joints leave fixed (at infinity); finite ones are "
                "needed",
                entries=low.tolist(),
            )
    return points, targets * ((points @ plane) / (targets @ plane))[:, None]


def motion_algebra(generators: FloatArray) -> FloatArray:
    """Lie algebra generated by the joints, as an orthonormal basis (k, 4, 4): k = 6 for most arms, never more.

    Every displacement of the chain is a product of exponentials of its elements. For a noisy model, the strongest six
    directions.
    """
    members = [G / np.linalg.norm(G) for G in generators]
    basis = np.zeros((0, 16))
    for _ in range(3):
        _, singular, rows = np.linalg.svd(np.array(members).reshape(-1, 16), full_matrices=False)
        basis = rows[singular > RANK_TOLERANCE * singular[0]][:6]
        spanned = basis.reshape(-1, 4, 4)
        members = [*spanned, *(A @ B - B @ A for i, A in enumerate(spanned) for B in spanned[:i])]
    return np.asarray(basis.reshape(-1, 4, 4), dtype=np.float64)


def displacement_between(
    generators: FloatArray, points: FloatArray, targets: FloatArray, *, max_residual: float
) -> FloatArray | None:
    """Displacement (4, 4) in the group generated by the joints that moves points (m, 4) closest to targets.

    Three points that are not collinear suffice: the group consists of rigid motions, so no metric is needed. Equal
    heights. None if the points do not determine it, or if the joints do not generate all rigid motions and none of
    theirs fits. Raises InverseKinematicsError, ``not_rigid``, if no rigid motion fits: a residual above
    ``max_residual`` (norm of the residual divided by that of the targets).
    """
    algebra = motion_algebra(generators)
    slopes = (algebra @ points.T).transpose(0, 2, 1).reshape(len(algebra), -1)
    singular = np.linalg.svd(slopes, compute_uv=False)
    if len(singular) < len(algebra) or singular[-1] < RANK_TOLERANCE * singular[0]:
        return None
    rng = np.random.default_rng(0)
    best, least = np.eye(4), np.inf
    for start in range(STARTS):
        try:
            first = np.eye(4) if start == 0 else _random_displacement(algebra, rng)
            H, residual = _fitted(algebra, points, targets, first)
        except GeometryError:  # not a rigid motion by its eigenvalues: another start may succeed
            continue
        if residual < least:
            best, least = H, residual
        if least <= max_residual:
            return best
    if len(algebra) < WHOLE_GROUP:
        return None
    raise InverseKinematicsError(
        "not_rigid",
        f"no displacement of this arm's kind takes the points to their targets: {least:.2e} of the targets' norm is "
        f"left, {max_residual:.1e} is taken. Mirrored, swapped or of another body?",
        residual=least,
    )


def _random_displacement(algebra: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Random displacement of about half a turn, as a start value."""
    X = np.tensordot(rng.normal(size=len(algebra)), algebra, axes=1)
    squared = -0.5 * float(np.sum(X * X.T))
    return exp_twist(X * (2.5 / np.sqrt(squared) if squared > 1e-9 else 1.0))


def _fitted(algebra: FloatArray, points: FloatArray, targets: FloatArray, H: FloatArray) -> tuple[FloatArray, float]:
    """Damped Gauss-Newton over the group from ``H`` (4, 4); returns the result and its residual."""
    moved = points @ H.T
    error = float(np.linalg.norm(moved - targets))
    norm, damping = float(np.linalg.norm(targets)), 1e-3
    for _ in range(FIT_STEPS):
        J = (algebra @ moved.T).transpose(0, 2, 1).reshape(len(algebra), -1).T
        normal, gradient = J.T @ J, J.T @ (targets - moved).ravel()
        ridge = damping * np.trace(normal) / len(algebra) * np.eye(len(algebra))
        step = exp_twist(np.tensordot(np.linalg.solve(normal + ridge, gradient), algebra, axes=1))
        trial = moved @ step.T
        reached = float(np.linalg.norm(trial - targets))
        if reached < error:
            settled = error - reached <= SETTLED * norm
            H, moved, error = step @ H, trial, reached
            damping = max(0.1 * damping, 1e-14)
            if settled:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return H, error / norm
