"""Least squares of the reprojection error over any parameterized motion; the solver of thesis chapters 3 and 4.

A motion maps its parameters to the displacements of all stops. Points are known, or free and eliminated by the Schur
complement (variable projection). Pixels are ideal ones [px], NaN where missing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import BoolArray, FloatArray

MAX_ITERATIONS = 60
COST_TOLERANCE = 1e-10
"""Relative decrease of the cost below which the fit has converged."""
UNDETERMINED = 1e-11
"""Relative eigenvalue of the scaled information matrix below which a direction counts as undetermined."""

Motion = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Function from parameters (q,) to displacements (s, 4, 4) and their derivatives (s, q, 4, 4)."""


@dataclass(frozen=True, eq=False)
class Images:
    """Pixels (s, c, m, 2), 0 where missing, and weights (s, c, m) [1/px], 0 where missing, of s stops."""

    cameras: FloatArray
    pixels: FloatArray
    weights: FloatArray

    @property
    def measurements(self) -> int:
        """Number of pixel coordinates."""
        return 2 * int((self.weights > 0).sum())


def read_images(Ps: FloatArray, pixels: FloatArray, sigma: FloatArray | float) -> Images:
    """Pixels ``(s, c, m, 2)`` [px], NaN where missing, of cameras ``(c, 3, 4)`` with noise ``sigma``, a number or
    (s, c, m) [px]. Raises GeometryError for shapes that do not fit or a sigma that is not positive.
    """
    Ps, pixels = np.asarray(Ps, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    if Ps.ndim != 3 or Ps.shape[1:] != (3, 4) or pixels.ndim != 4 or pixels.shape[1::2] != (len(Ps), 2):
        raise GeometryError(
            "shape",
            f"cameras {Ps.shape} and pixels {pixels.shape} do not fit; (c, 3, 4) and (stops, c, points, 2) are needed",
            cameras=Ps.shape,
            pixels=pixels.shape,
        )
    seen: BoolArray = np.asarray(np.isfinite(pixels).all(axis=3))
    noise = np.broadcast_to(np.asarray(sigma, dtype=np.float64), seen.shape)
    if not (noise[seen] > 0).all():
        raise GeometryError("shape", "sigma must be positive wherever a pixel is given", sigma=np.min(noise))
    weights = np.where(seen, 1.0 / np.where(seen, noise, 1.0), 0.0)
    return Images(Ps, np.where(seen[..., None], pixels, 0.0), weights)


def with_rest(motion: Motion) -> Motion:
    """The motion with the rest pose, the identity, as its first stop."""

    def moved(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        H, slopes = motion(x)
        zero = np.zeros((1, *slopes.shape[1:]))
        return np.concatenate([np.eye(4)[None], H]), np.concatenate([zero, slopes])

    return moved


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Residuals (m, r), derivatives by the motion (m, r, q) and by each point's own chart (m, r, 3)."""

    residuals: FloatArray
    motion: FloatArray
    points: FloatArray


def point_charts(M: FloatArray) -> FloatArray:
    """Orthonormal complements (m, 4, 3) of points (m, 4): their three degrees of freedom without the scale."""
    return np.asarray(np.linalg.svd(M[:, None, :])[2][:, 1:].transpose(0, 2, 1), dtype=np.float64)


def linearise(images: Images, H: FloatArray, slopes: FloatArray, M: FloatArray, charts: FloatArray) -> Linearisation:
    """Residuals and derivatives at displacements ``H`` (s, 4, 4) and points ``M`` (m, 4) or (s, m, 4)."""
    M = np.broadcast_to(M, (len(H), *M.shape[-2:]))
    moved = M @ H.transpose(0, 2, 1)
    m = np.einsum("cij,snj->scni", images.cameras, moved)
    depth = np.where(images.weights > 0, m[..., 2], 1.0)
    predicted = m[..., :2] / depth[..., None]
    residuals = (predicted - images.pixels) * images.weights[..., None]
    scale = (images.weights / depth)[..., None, None]
    P = images.cameras[None, :, None]
    rows = (P[..., :2, :] - predicted[..., None] * P[..., 2:, :]) * scale
    by_motion = rows @ np.einsum("sqij,snj->snqi", slopes, M).transpose(0, 1, 3, 2)[:, None]
    by_points = rows @ H[:, None, None] @ charts
    n, rows_each = M.shape[1], 2 * images.weights[..., 0].size

    def per_point(values: FloatArray) -> FloatArray:
        return values.transpose(2, 0, 1, 3, *range(4, values.ndim)).reshape(n, rows_each, *values.shape[4:])

    return Linearisation(per_point(residuals), per_point(by_motion), per_point(by_points))


def without_points(at: Linearisation) -> tuple[FloatArray, FloatArray]:
    """Residuals (m, r) and motion derivatives (m, r, q) with the points eliminated by projection."""
    Q = np.linalg.qr(at.points)[0]
    residuals = at.residuals - (Q @ (Q.transpose(0, 2, 1) @ at.residuals[..., None]))[..., 0]
    return residuals, at.motion - Q @ (Q.transpose(0, 2, 1) @ at.motion)


@dataclass(frozen=True, eq=False)
class Minimum:
    """Parameters (q,), points (m, 4), cost, information (q, q) of the parameters, model evaluations."""

    x: FloatArray
    points: FloatArray
    cost: float
    information: FloatArray
    evaluations: int


def minimise(images: Images, motion: Motion, x: FloatArray, M: FloatArray, free_points: bool) -> Minimum:
    """Levenberg-Marquardt from ``x`` (q,) and points ``M`` (m, 4), or fixed ones (s, m, 4).

    Raises GeometryError if the residuals at the start are not finite, or if it does not converge.
    """
    charts = point_charts(M) if free_points else np.zeros((M.shape[-2], 4, 3))
    at = linearise(images, *motion(x), M, charts)
    cost = float((at.residuals**2).sum())
    if not np.isfinite(cost):
        raise GeometryError("degenerate", "the start of the fit puts points into a camera's focal plane")
    damping, evaluations = 1e-6, 1
    while evaluations < MAX_ITERATIONS:
        r, J = without_points(at) if free_points else (at.residuals, at.motion)
        information = np.einsum("nrp,nrq->pq", J, J, optimize=True)
        gradient = np.einsum("nrp,nr->p", J, r)
        step = _damped_step(information, gradient, damping)
        M_new = M
        if free_points:
            remaining = at.residuals + at.motion @ step
            pseudo = np.linalg.pinv(at.points)
            M_new = M - np.einsum("nij,njr,nr->ni", charts, pseudo, remaining)
            M_new = M_new / np.linalg.norm(M_new, axis=1, keepdims=True)
        charts_new = point_charts(M_new) if free_points else charts
        new = linearise(images, *motion(x + step), M_new, charts_new)
        evaluations += 1
        cost_new = float((new.residuals**2).sum())
        if np.isfinite(cost_new) and cost_new <= cost:
            done = cost - cost_new <= COST_TOLERANCE * (cost + 1e-12 * images.measurements)
            x, M, charts, at, cost = x + step, M_new, charts_new, new, cost_new
            damping = max(damping / 10.0, 1e-12)
        else:
            # At the minimum rounding decides which of two costs is lower.
            done = abs(float(gradient @ step)) <= COST_TOLERANCE * (cost + 1e-12 * images.measurements)
            damping *= 10.0
        if done:
            J = without_points(at)[1] if free_points else at.motion
            information = np.einsum("nrp,nrq->pq", J, J, optimize=True)
            return Minimum(x, M, cost, information, evaluations)
    raise GeometryError(
        "no_model",
        f"no convergence in {MAX_ITERATIONS} evaluations; the cost stands at {cost:.4g} for "
        f"{images.measurements} pixel coordinates",
        cost=cost,
        measurements=images.measurements,
    )


def _damped_step(information: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(size, size) + damping * np.eye(len(size))
    return np.asarray(-np.linalg.lstsq(scaled, gradient / size, rcond=1e-15)[0] / size, dtype=np.float64)


def covariance_of(information: FloatArray, what: str) -> FloatArray:
    """Inverse of an information matrix (q, q). Raises GeometryError if the data leave a direction undetermined."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    if not values[0] > UNDETERMINED * values[-1]:
        raise GeometryError(
            "degenerate",
            f"the images leave {what} undetermined (information {values[0]:.3g} to {values[-1]:.3g}); "
            "more points off one plane, or motions in other directions, are needed",
            information=values.tolist(),
        )
    root = vectors / np.sqrt(values) / size[:, None]
    return np.asarray(root @ root.T, dtype=np.float64)
