"""Normal form of the goals of inverse kinematics: points at the joints' zero, and targets of the same homogeneous
scale; planes that all joints leave fixed, and the Lie algebra of their motions.

All displacements of a chain fix some plane, ``aᵀĤ_j = 0``: that at infinity, or one of a pencil where all axes are
parallel. Either gives the scales that they preserve; which one it is does not matter here.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.screws import exp_twist
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError
from stereoservo.numerics.arrays import FloatArray

PLANE_TOLERANCE = 1e-12
"""Share of its norm below which a point's height counts as none."""
RANK_TOLERANCE = 1e-6
FIT_STEPS = 60
STARTS = 24
CANDIDATES = 64
"""Planes of a pencil that are tried."""
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

    One, or where axes are parallel or joints few a pencil or bundle; at least the one that comes nearest to it.
    """
    unit = generators / np.linalg.norm(generators, axis=(1, 2), keepdims=True)
    U, singular, _ = np.linalg.svd(np.concatenate(list(unit), axis=1))
    rank = min(3, int((singular > RANK_TOLERANCE * singular[0]).sum()))
    return np.asarray(U[:, rank:].T, dtype=np.float64)


def clear_plane(planes: FloatArray, points: FloatArray) -> FloatArray:
    """Plane (4,) of the span of ``planes`` (k, 4) that is farthest from all ``points`` (m, 4)."""
    if len(planes) == 1:
        return np.asarray(planes[0], dtype=np.float64)
    heights = planes @ (points / np.linalg.norm(points, axis=1, keepdims=True)).T
    candidates = np.random.default_rng(0).normal(size=(CANDIDATES, len(planes)))
    candidates /= np.linalg.norm(candidates, axis=1, keepdims=True)
    clearest = int(np.argmax(np.abs(candidates @ heights).min(axis=1)))
    return np.asarray(candidates[clearest] @ planes, dtype=np.float64)


def scaled_displacement(generators: FloatArray, H: FloatArray) -> FloatArray:
    """``H`` (4, 4), given up to scale and sign, scaled such that it preserves the plane that the chain leaves
    invariant.

    Half a turn included, where the trace determines no sign. Raises InverseKinematicsError where it is a reflection,
    singular, or does not fix the plane at all.
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


def equal_scales(
    generators: FloatArray, points: FloatArray, targets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``points`` (m, 4) unchanged, and ``targets`` (m, 4) scaled to the same value on a plane that all joints leave
    invariant.

    Raises InverseKinematicsError for shapes that do not fit, and for a point or target on that plane.
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

    Every displacement of the chain is a product of exponentials of it. Of a noisy model the strongest six.
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
    generators: FloatArray, points: FloatArray, targets: FloatArray, *, misfit: float
) -> FloatArray | None:
    """Displacement (4, 4) in the group generated by the joints that moves points (m, 4) closest to targets.

    Three points that are not collinear will do: the group consists of rigid motions, so that no metric is needed. Equal
    heights. None where the points leave it open, or the joints do not generate all rigid motions and none of theirs
    fits. Raises InverseKinematicsError, ``not_rigid``, where no rigid motion does: a residual above ``misfit`` (the
    norm of what is left, over that of the targets).
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
            first = np.eye(4) if start == 0 else _turned(algebra, rng)
            H, residual = _fitted(algebra, points, targets, first)
        except GeometryError:  # not a rigid motion by its eigenvalues: another start may do
            continue
        if residual < least:
            best, least = H, residual
        if least <= misfit:
            return best
    if len(algebra) < WHOLE_GROUP:
        return None
    raise InverseKinematicsError(
        "not_rigid",
        f"no displacement of this arm's kind takes the points to their targets: {least:.2e} of the targets' norm is "
        f"left, {misfit:.1e} is taken. Mirrored, swapped or of another body?",
        residual=least,
    )


def _turned(algebra: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Random displacement of about half a turn, as a start value."""
    X = np.tensordot(rng.normal(size=len(algebra)), algebra, axes=1)
    squared = -0.5 * float(np.sum(X * X.T))
    return exp_twist(X * (2.5 / np.sqrt(squared) if squared > 1e-9 else 1.0))


def _fitted(
    algebra: FloatArray, points: FloatArray, targets: FloatArray, H: FloatArray
) -> tuple[FloatArray, float]:
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
