"""Maximum likelihood estimate of projective translations that share the plane at infinity (thesis 3.2.3, (3.40)).

Six parameters for one motion, 3 + 3n for n: the largest entry of the plane ``h`` is fixed (its scale is
no parameter), and the entry of each ``k`` at the same index follows from ``hᵀk = 0`` (3.39 with errata). Solved by
`reprojection_fit` in coordinates whitened over the points. Pixels are ideal ones [px], NaN where missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.geometry.cameras import check_views, projection_jacobian_many
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.reprojection_fit import (
    Images,
    Minimum,
    Motion,
    covariance_of,
    linearise,
    minimise,
    read_images,
    with_rest,
)
from stereoservo.geometry.translations import conditioner
from stereoservo.numerics.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class TranslationFit:
    """Translations ``H_s = I + k_s hᵀ`` of least squared reprojection error.

    ``plane`` (4,) h, of unit norm, the points on its positive side; ``plane_covariance`` (4, 4), of rank
    three, ``C h = 0``, at the stated noise; ``directions`` (n, 4) k_s with ``hᵀk = 0``; ``points`` (m, 4) at
    rest, NaN if not estimated, depth 1 in the first camera; ``cost`` the sum of squares over the stated
    variances; ``freedom`` measurements minus parameters; ``evaluations`` of the model.
    """

    plane: FloatArray
    plane_covariance: FloatArray
    directions: FloatArray
    points: FloatArray
    cost: float
    freedom: int
    evaluations: int

    def agrees(self, tail: float = 1e-3) -> bool:
        """Whether a chi-square at the stated noise exceeds the cost with a probability above ``tail``."""
        return bool(self.cost <= chi2_distribution.isf(tail, max(1, self.freedom)))


@dataclass(frozen=True, eq=False)
class SharedPlane:
    """The minimal chart (3 + 3n,) of n translations about one plane (3.39 with errata): entry ``at`` of h is fixed
    at ``pivot``, entry ``at`` of each k follows from ``hᵀk = 0``.
    """

    at: int
    pivot: float
    motions: int

    @property
    def others(self) -> list[int]:
        """The three entries of h and of each k that are parameters."""
        return [j for j in range(4) if j != self.at]

    def vectors(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``h`` (4,) and ``k`` (n, 4) of parameters ``x``."""
        h, k = np.empty(4), np.empty((self.motions, 4))
        h[self.at], h[self.others] = self.pivot, x[:3]
        k[:, self.others] = x[3:].reshape(self.motions, 3)
        k[:, self.at] = -(k[:, self.others] @ h[self.others]) / self.pivot
        return h, k

    def displacements(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``I + k hᵀ`` (n, 4, 4) and its derivatives (n, 3 + 3n, 4, 4)."""
        h, k = self.vectors(x)
        p, each = self.at, np.arange(self.motions)
        slopes = np.zeros((self.motions, len(x), 4, 4))
        for a, j in enumerate(self.others):
            slopes[:, a, :, j] = k
            slopes[:, a, p, :] -= k[:, j, None] * h / self.pivot
            slopes[each, 3 + 3 * each + a, j] = h
            slopes[each, 3 + 3 * each + a, p] = -h[j] / self.pivot * h
        return np.eye(4) + k[:, :, None] * h, slopes


def shared_plane(plane: FloatArray, directions: FloatArray) -> tuple[SharedPlane, FloatArray]:
    """The chart about a start ``plane`` (4,), ``directions`` (n, 4), and the start's parameters (3 + 3n,)."""
    size = float(np.linalg.norm(plane))
    h = plane / size
    at = int(np.argmax(np.abs(h)))
    chart = SharedPlane(at, float(h[at]), len(directions))
    return chart, np.concatenate([h[chart.others], (directions[:, chart.others] * size).ravel()])


def homography_motion(Hs: FloatArray, span: FloatArray | None = None) -> tuple[Motion, FloatArray]:
    """Motion with fifteen parameters for each of the homographies ``(n, 4, 4)``, and their start values; with
    orthonormal columns ``span`` (4, 3) only the eleven that act on the points they span.
    """
    n = len(Hs)
    columns = np.eye(4) if span is None else span
    acting = (Hs @ columns).reshape(n, 1, -1)
    charts = np.linalg.svd(acting)[2][:, 1:].reshape(n, -1, 4, columns.shape[1]) @ columns.T
    q = charts.shape[1]
    slopes = np.zeros((n, q * n, 4, 4))
    for s in range(n):
        slopes[s, q * s : q * s + q] = charts[s]

    def motion(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return Hs + np.einsum("sq,sqij->sij", x.reshape(n, q), charts), slopes

    return motion, np.zeros(q * n)


def refine_translations(
    Ps: FloatArray,
    pixels: FloatArray,
    points: FloatArray,
    plane: FloatArray,
    directions: FloatArray,
    sigma: FloatArray | float,
    *,
    points_covariance: FloatArray | None = None,
) -> TranslationFit:
    """Translations of least reprojection error with points given a priori (3.40).

    Cameras ``Ps`` (c, 3, 4); ``pixels`` (n, c, m, 2) [px] after each of the n motions; ``points`` (m, 4) before
    them, or (n, m, 4) before each one; start ``plane`` (4,), ``directions`` (n, 4). Points are assumed exact:
    the covariance is due to the pixels' noise alone, unless ``points_covariance`` (m, 4, 4) of common points states
    theirs, which is then propagated to first order. Raises GeometryError for shapes that do not fit, a plane
    that the data do not determine, no convergence.
    """
    images = read_images(Ps, pixels, sigma)
    common = points[None] if points.ndim == 2 else points
    if common.ndim != 3 or common.shape[1:] != (pixels.shape[2], 4) or len(common) not in (1, len(pixels)):
        raise GeometryError(
            "shape",
            f"points {points.shape} do not fit pixels {pixels.shape}; (m, 4) or (n, m, 4)",
            points=points.shape,
        )
    _check_start(plane, directions, len(pixels))
    known: BoolArray = np.asarray(np.isfinite(common).all(axis=(0, 2)))
    images = _only(images, known)
    if points_covariance is not None and points.ndim != 2:
        raise GeometryError("shape", "points_covariance needs points (m, 4) common to all motions")
    W = conditioner(common[:, known].reshape(-1, 4))
    size = np.linalg.norm(common[:, known] @ W.T, axis=2, keepdims=True)
    M = common[:, known] @ W.T / size
    seen, chart, x = _whitened(images, W, plane, directions)
    best = minimise(seen, chart.displacements, x, M[0] if len(M) == 1 else M, free_points=False)
    covariance = covariance_of(best.information, "the plane at infinity")
    if points_covariance is not None:
        whole = np.broadcast_to(np.eye(4), (M.shape[1], 4, 4))
        at = linearise(seen, *chart.displacements(best.x), M[0], whole)
        lever = np.einsum("nrq,nrj->nqj", at.motion, at.points)
        noise = W @ points_covariance[known] @ W.T / size[0, :, :, None] ** 2
        covariance = covariance + covariance @ np.einsum("npi,nij,nqj->pq", lever, noise, lever) @ covariance
    freedom = images.measurements - len(x)
    return _in_caller_frame(best, chart, covariance, W, common[0], freedom)


def bundle_translations(
    Ps: FloatArray,
    pixels: FloatArray,
    points: FloatArray,
    plane: FloatArray,
    directions: FloatArray,
    sigma: FloatArray | float,
) -> TranslationFit:
    """Translations and points of least reprojection error over all stops (3.40 with free points).

    ``pixels`` (n + 1, c, m, 2) [px], the stop at rest first; start ``points`` (m, 4) at rest, NaN for points
    to leave out, ``plane`` (4,), ``directions`` (n, 4) from rest to each stop. Raises GeometryError as
    `refine_translations` does.
    """
    images = read_images(Ps, pixels, sigma)
    if points.shape != (pixels.shape[2], 4):
        raise GeometryError("shape", f"points {points.shape}; {(pixels.shape[2], 4)} are needed", points=points.shape)
    _check_start(plane, directions, len(pixels) - 1)
    known = np.isfinite(points).all(axis=1) & ((images.weights > 0).sum(axis=(0, 1)) >= 2)
    images = _only(images, known)
    W = conditioner(points[known])
    M = points[known] @ W.T
    M = M / np.linalg.norm(M, axis=1, keepdims=True)
    seen, chart, x = _whitened(images, W, plane, directions)
    best = minimise(seen, with_rest(chart.displacements), x, M, free_points=True)
    covariance = covariance_of(best.information, "the plane at infinity")
    estimated = np.full(points.shape, np.nan)
    estimated[known] = best.points @ np.linalg.inv(W).T
    estimated = estimated / (estimated @ images.cameras[0, 2])[:, None]
    freedom = images.measurements - len(x) - 3 * int(known.sum())
    return _in_caller_frame(best, chart, covariance, W, estimated, freedom)


def _whitened(
    images: Images, W: FloatArray, plane: FloatArray, directions: FloatArray
) -> tuple[Images, SharedPlane, FloatArray]:
    """Images, chart and start in the frame ``W M`` of the points."""
    seen = Images(images.cameras @ np.linalg.inv(W), images.pixels, images.weights)
    return seen, *shared_plane(np.asarray(np.linalg.solve(W.T, plane), dtype=np.float64), directions @ W.T)


def _check_start(plane: FloatArray, directions: FloatArray, n: int) -> None:
    if n < 1 or np.shape(plane) != (4,) or np.shape(directions) != (n, 4):
        raise GeometryError(
            "shape",
            f"plane {np.shape(plane)} and directions {np.shape(directions)} do not fit {n} motions; (4,) and (n, 4) "
            "with n >= 1 are needed",
            motions=n,
        )


def _only(images: Images, known: BoolArray) -> Images:
    if int(known.sum()) < 4:
        raise GeometryError("too_few", f"{int(known.sum())} points are known; 4 are needed", points=int(known.sum()))
    return Images(images.cameras, images.pixels[:, :, known], images.weights[:, :, known])


def _in_caller_frame(
    best: Minimum, chart: SharedPlane, covariance: FloatArray, W: FloatArray, points: FloatArray, freedom: int
) -> TranslationFit:
    """The fit transformed to the caller's frame: ``h = Wᵀ h_w`` of unit norm, the points on its positive side."""
    h_white, k_white = chart.vectors(best.x)
    h = W.T @ h_white
    size = float(np.linalg.norm(h)) * (1.0 if np.nansum(np.sign(points @ h)) >= 0 else -1.0)
    unit = h / size
    tangent = (np.eye(4) - np.outer(unit, unit)) @ W.T[:, chart.others] / size
    return TranslationFit(
        unit,
        np.asarray(tangent @ covariance[:3, :3] @ tangent.T, dtype=np.float64),
        np.asarray(np.linalg.solve(W, k_white.T).T * size, dtype=np.float64),
        points,
        best.cost,
        freedom,
        best.evaluations,
    )


ACROSS = 1e-6
"""Relative part of a motion that must lead out of the points' plane for the start to exist."""


def plane_basis(M: FloatArray) -> FloatArray:
    """Orthonormal ``(4, 4)``: columns 1 to 3 best span the points M (m, 4), column 4 is their common plane."""
    unit = M / np.linalg.norm(M, axis=1, keepdims=True)
    basis: FloatArray = np.linalg.svd(unit, full_matrices=len(unit) < 4)[2].T
    return basis


def planar_map(Ps: FloatArray, m: FloatArray, depth: FloatArray, pixels: FloatArray) -> FloatArray:
    """Map ``D`` (4, 3), linear, such that ``P_c D m`` are, up to scale, the pixels of plane coordinates m (n, 3).

    ``depth`` (c, n) before the motion divides the equations; pixels (c, n, 2) [px], NaN where missing. Raises
    GeometryError for fewer than 11 equations or points that leave D undetermined (collinear).
    """
    values, w = check_views(Ps, pixels, None)
    if 2 * int((w > 0).sum()) < 11:
        raise GeometryError("too_few", f"{2 * int((w > 0).sum())} pixel coordinates; 11 unknowns need as many")
    rows = (Ps[:, None, :2, :] - values[..., None] * Ps[:, None, 2:, :]) * (w / depth)[..., None, None]
    system = (rows[..., :, None] * m[None, :, None, None, :]).reshape(-1, 12)
    size = np.linalg.norm(system, axis=0)
    _, singular, Vt = np.linalg.svd(system / size, full_matrices=False)
    if not singular[10] > 1e-10 * singular[0]:
        raise GeometryError("degenerate", "the points do not determine a map of their plane (collinear?)")
    D: FloatArray = (Vt[11] / size).reshape(4, 3)
    return D


def planar_start(Ps: FloatArray, M: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Plane at infinity ``h`` (4,), unit norm, and directions ``k`` (n, 4), linear, from coplanar points.

    Points M (m, 4) at rest; pixels (n, c, m, 2) [px] after each motion, NaN where missing. Raises GeometryError if
    all motions lie in the points' plane, which leaves the plane at infinity undetermined, or too few points are seen.
    """
    known = np.isfinite(M).all(axis=1)
    M = M[known]
    basis = plane_basis(M)
    B, normal = basis[:, :3], basis[:, 3]
    m = M @ B
    factor = np.linalg.qr(m / np.linalg.norm(m, axis=1, keepdims=True))[1]
    depth = np.einsum("cj,nj->cn", Ps[:, 2], M)
    unit = M / np.linalg.norm(m @ np.linalg.inv(factor), axis=1, keepdims=True)
    jacobian = projection_jacobian_many(Ps, unit)
    left = np.linalg.cholesky(np.einsum("cnai,cnaj->ij", jacobian, jacobian)).T
    weighted = []
    for moved in pixels:
        D = planar_map(Ps, m, depth, moved[:, known])
        # D = γ (B + k gᵀ): on the plane γ is the double eigenvalue.
        values = np.linalg.eigvals(B.T @ D)
        pairs = [(abs(values[i] - values[j]), values[i] + values[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
        gamma = 0.5 * float(min(pairs, key=lambda pair: float(pair[0]))[1].real)
        weighted.append(left @ (D / gamma - B) @ factor.T)
    v = np.linalg.svd(np.concatenate(weighted), full_matrices=False)[2][0]
    g = np.linalg.solve(factor, v)
    k = np.stack([np.linalg.solve(left, G @ v) for G in weighted])
    return _last_freedom(B @ g, normal, k, left)


def _last_freedom(
    within: FloatArray, normal: FloatArray, k: FloatArray, left: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Plane ``h = within + η normal`` with least ``hᵀk`` over the motions; the k then projected onto the plane."""
    across = k @ normal
    if not np.linalg.norm(across) > ACROSS * np.linalg.norm(k):
        raise GeometryError(
            "degenerate",
            "all motions lie in the plane of the points, which leaves the plane at infinity open; a motion out of it "
            "is needed",
            across=across.tolist(),
        )
    h = within - normal * float((k @ within) @ across / (across @ across))
    lever = np.linalg.solve(left.T @ left, h)
    k = k - np.outer(k @ h, lever) / (h @ lever)
    size = float(np.linalg.norm(h))
    return h / size, k * size
