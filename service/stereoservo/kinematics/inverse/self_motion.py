"""Self-motions (joint motions that keep the goal reached) of redundant arms and at singular configurations: their
directions, and the solution along them that is nearest to a seed or inside the joint limits.
"""

from __future__ import annotations

import numpy as np

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.inverse.numerical import linearised
from stereoservo.numerics.arrays import FloatArray

NO_MOTION = 1e-6
"""Singular value of the Jacobian, relative to the largest, below which a direction does not move the points."""
PROBE = 0.05
PROBES = (0.2 * PROBE, -0.5 * PROBE, PROBE)
"""Motions [rad or m] after which the goal must still be reached: it is not for a stretched elbow."""
STRICTER = 0.02
"""Fraction of the tolerance for that test: with a nearly aligned wrist, a stretched elbow hardly moves."""
STRIDE = 0.4
"""Longest step [rad or m] towards a seed; halved if the goal is lost, or if the step does not approach the seed."""
CORRECTIONS = 20
SETTLED = 1e-6
"""Step [rad or m] at which a correction has converged: the remainder of a measured goal is noise."""


def null_directions(chain: ProjectiveChain, points: FloatArray, q: FloatArray) -> FloatArray:
    """Null space (k, n), orthonormal, of the Jacobian of ``points`` (m, 4) at ``q`` (n,).

    Joints are weighted by their motion of the points, so units do not matter.
    """
    moved, J, operators = linearised(chain, points, q)
    sizes = np.linalg.norm(J, axis=0)
    most = np.linalg.norm(operators, axis=(1, 2)) * float(np.linalg.norm(moved))
    idle = sizes <= NO_MOTION * most
    weights = np.where(idle, 1.0, sizes)
    scaled = np.where(idle, 0.0, J) / weights
    _, singular, rows = np.linalg.svd(scaled, full_matrices=len(scaled) < scaled.shape[1])
    rank = int((singular > NO_MOTION * max(float(singular[0]), 1e-300)).sum())
    kernel = rows[rank:] / weights
    if not len(kernel):
        return np.zeros((0, chain.joints))
    return np.asarray(np.linalg.qr(kernel.T)[0].T, dtype=np.float64)


def corrected(
    chain: ProjectiveChain, points: FloatArray, targets: FloatArray, q: FloatArray, tolerance: float
) -> tuple[FloatArray, float]:
    """``q`` (n,) corrected to reach the goal again by the least joint motion, and the residual left."""
    norm = float(np.linalg.norm(targets))
    residual = longest = np.inf
    for _ in range(CORRECTIONS):
        moved, J, _ = linearised(chain, points, q)
        error = (moved - targets).ravel()
        residual = float(np.linalg.norm(error)) / norm
        if residual <= 0.01 * tolerance or longest < SETTLED or not np.isfinite(residual):
            break
        step = -np.linalg.lstsq(J, error, rcond=NO_MOTION)[0]
        longest = float(np.abs(step).max())
        q = q + step * min(1.0, 0.2 / max(longest, 1e-300))
    return q, residual


def self_motions(
    chain: ProjectiveChain, points: FloatArray, targets: FloatArray, q: FloatArray, tolerance: float
) -> FloatArray:
    """Null-space directions (k, n) at ``q`` (n,) along which the goal stays reached over a finite distance.

    Directions for which this holds only to first order, at the boundary of the workspace, are excluded.
    """
    kept = []
    for direction in null_directions(chain, points, q):
        if all(_stays_reached(chain, points, targets, q, probe * direction, tolerance) for probe in PROBES):
            kept.append(direction)
    return np.array(kept).reshape(-1, chain.joints)


def _stays_reached(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    q: FloatArray,
    step: FloatArray,
    tolerance: float,
) -> bool:
    """Whether the goal is reached about ``step`` (n,) away from ``q`` (n,), and at half of it."""
    ahead, residual = corrected(chain, points, targets, q + step, tolerance)
    fraction = float((ahead - q) @ step) / float(step @ step)
    return residual <= STRICTER * tolerance and 0.5 < fraction < 1.5


def nearest_by_self_motion(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    q: FloatArray,
    seed: FloatArray,
    tolerance: float,
) -> FloatArray:
    """Configuration nearest to ``seed`` (n,) along self-motions from ``q`` (n,), with the goal reached."""
    stride = STRIDE
    for _ in range(200):
        kernel = null_directions(chain, points, q)
        step = kernel.T @ (kernel @ (seed - q))
        length = float(np.abs(step).max(initial=0.0))
        if length < SETTLED:
            break
        ahead, residual = corrected(chain, points, targets, q + step * min(1.0, stride / length), tolerance)
        if residual <= tolerance and np.linalg.norm(ahead - seed) < np.linalg.norm(q - seed):
            q = ahead
        elif stride > PROBE:
            stride *= 0.5
        else:
            break
    return q


def moved_within_limits(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    q: FloatArray,
    limits: FloatArray,
    tolerance: float,
) -> FloatArray | None:
    """Configuration (n,) inside ``limits`` (n, 2) along the single self-motion of ``q`` (n,), or None.

    Follows the motion in both directions for a full turn, or to its end.
    """
    kernel = null_directions(chain, points, q)
    if len(kernel) != 1:
        return None
    for sense in (1.0, -1.0):
        here, direction = q, sense * kernel[0]
        for _ in range(int(np.ceil(2.0 * np.pi / PROBE)) * 2):
            here, residual = corrected(chain, points, targets, here + PROBE * direction, tolerance)
            if residual > tolerance:
                break
            if (here >= limits[:, 0]).all() and (here <= limits[:, 1]).all():
                return here
            onward = null_directions(chain, points, here)
            if not len(onward):
                break
            along = onward.T @ (onward @ direction)
            size = float(np.linalg.norm(along))
            if size < 1e-6:
                break
            direction = along / size
    return None
