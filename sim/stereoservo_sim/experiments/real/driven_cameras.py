"""Calibration of cameras and tag corners from images and the reported displacements of a real arm's hand.

The arm's recorded displacements ``D`` (n, 4, 4) carry the tag's corners ``X`` (k, 3) [m], unknown in the
hand; each camera is a free 3x4 matrix with, if asked for, one radial term. No intrinsics, no size of the tag,
no place of it is given.

A camera's pixel is ``c + (1 + κ r²)(m − c)``, with ``m`` the projective pixel, ``c`` the image's middle and
``r`` its distance to ``m`` in half image widths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stereoservo.geometry.cameras import from_pixels, pixel_normaliser, resection, triangulate
from stereoservo.geometry.homogeneous import GeometryError, to_homogeneous
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo_sim.experiments.experiment import ExperimentError

LEAST_VIEWS = 6
"""Views of the tag that a free camera needs: 11 unknowns, and a tag of unknown place counts little more than
a point."""

RADII = (0.04, 0.1, 0.2)
DIRECTIONS = 12
"""Guesses of the tag's offset in the hand: directions on spheres [m]. At zero the linear start may
diverge."""

BUNDLES = 4
ALTERNATIONS = 4
AGREEMENT = 1e-6
"""At most BUNDLES of the best guesses are bundled; fewer when the first two end at the same cost."""

ROBUST_SCALE = 1.0
"""Residual [px] beyond which the robust pass's loss grows linearly."""

GATE_SIGMAS, GATE_FLOOR = 6.0, 2.0
"""A view is left out of the second pass when a corner of it is off by more than so many robust sigmas, and so
many px."""


@dataclass(frozen=True)
class TagViews:
    """Views of one tag: camera index (v,), pose index (v,) into the displacements, ``pixels`` (v, k, 2)
    [px]."""

    camera: IntArray
    pose: IntArray
    pixels: FloatArray

    def take(self, chosen: BoolArray) -> TagViews:
        """The views where ``chosen`` (v,) holds."""
        return TagViews(self.camera[chosen], self.pose[chosen], self.pixels[chosen])


@dataclass(frozen=True)
class DrivenCameras:
    """A fit: ``Ps`` (c, 3, 4) from the arm's base [m] to undistorted pixels, ``radial`` (c,), ``corners``.

    ``corners`` (k, 3) in the hand [m]. ``sizes`` (c, 2): image width and height [px]. ``inliers`` (v,) of the
    fitted views; ``rss`` [px²] their squared residuals; ``costs`` [px²]: robust costs of the bundled guesses,
    best guess first.
    """

    Ps: FloatArray
    radial: FloatArray
    corners: FloatArray
    sizes: IntArray
    inliers: BoolArray
    rss: float
    costs: tuple[float, ...]


def predict(model: DrivenCameras, displacements: FloatArray, camera: IntArray, pose: IntArray) -> FloatArray:
    """Pixels ``(v, k, 2)`` [px] of the tag's corners in views (camera, pose); ``displacements`` (n, 4, 4)."""
    points = carried(displacements[pose], model.corners)
    m = np.einsum("vij,vkj->vki", model.Ps[camera], to_homogeneous(points))
    pixels = m[..., :2] / m[..., 2:]
    return distort(pixels, model.radial[camera][:, None], model.sizes[camera][:, None])


def distort(pixels: FloatArray, radial: FloatArray, sizes: IntArray) -> FloatArray:
    """Projective pixels ``(..., 2)`` to measured ones; ``radial`` (...) and ``sizes`` (..., 2) broadcast."""
    middle, half = (sizes - 1) / 2.0, sizes[..., :1] / 2.0
    offset = pixels - middle
    square = ((offset / half) ** 2).sum(axis=-1, keepdims=True)
    distorted: FloatArray = middle + offset * (1.0 + radial[..., None] * square)
    return distorted


def undistort(pixels: FloatArray, radial: FloatArray, sizes: IntArray) -> FloatArray:
    """The inverse of :func:`distort`, by fixed-point iteration; for ``|κ r²|`` well below 1/3."""
    middle = (sizes - 1) / 2.0
    straight = pixels
    for _ in range(30):
        factor = (distort(straight, radial, sizes) - middle) / np.where(
            straight == middle, 1.0, straight - middle
        )
        straight = middle + (pixels - middle) / np.where(straight == middle, 1.0, factor)
    return straight


def fit_driven_cameras(
    displacements: FloatArray, views: TagViews, sizes: IntArray, rng: np.random.Generator
) -> DrivenCameras:
    """Cameras without radial terms, and corners, of least reprojection error; several guesses of the offset.

    For each guess: linear cameras from the tag's middle, corners and cameras in turn, then a robust bundle of
    the best few; the best of these, and last a plain least-squares bundle on its inliers. Raises
    ExperimentError ``too_few_poses`` where a camera has fewer than LEAST_VIEWS views, ``no_fit`` where no
    guess leads anywhere.
    """
    count = np.bincount(views.camera, minlength=len(sizes))
    if (count < LEAST_VIEWS).any():
        raise ExperimentError(
            "too_few_poses",
            f"the tag is seen in {count.tolist()} poses by the cameras; each needs at least {LEAST_VIEWS}",
            views=count.tolist(),
            needed=LEAST_VIEWS,
        )
    problem = _CameraProblem.of(displacements, views, sizes)
    guesses = [problem.linear_start(offset) for offset in _offsets(rng)]
    usable = sorted((start for start in guesses if start is not None), key=lambda start: start[0])
    best: tuple[float, FloatArray] | None = None
    costs = []
    for _, Ps, corners in usable[:BUNDLES]:
        z, cost = problem.bundle(Ps, np.zeros(len(sizes)), corners, radial=False, robust=True)
        costs.append(cost)
        if np.isfinite(cost) and (best is None or cost < best[0]):
            best = (cost, z)
        if len(costs) > 1 and max(costs) < (1.0 + AGREEMENT) * min(costs):
            break
    if best is None:
        raise ExperimentError(
            "no_fit",
            f"none of {len(guesses)} guesses of the tag's offset leads to cameras",
            guesses=len(guesses),
        )
    return problem.finish(best[1], radial=False, costs=tuple(costs))


def refit(model: DrivenCameras, displacements: FloatArray, views: TagViews, *, radial: bool) -> DrivenCameras:
    """Fit again from ``model``, with or without radial terms: robust, then plain on the inliers."""
    problem = _CameraProblem.of(displacements, views, model.sizes)
    Ps, corners = problem.inward(model)
    z, _ = problem.bundle(
        Ps, model.radial if radial else np.zeros(len(Ps)), corners, radial=radial, robust=True
    )
    return problem.finish(z, radial=radial, costs=model.costs)


def _offsets(rng: np.random.Generator) -> FloatArray:
    """Start values (g, 3) [m]: an even spiral of directions, rotated at random, on each of RADII."""
    i = np.arange(DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * i / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * i
    ring = np.sqrt(1.0 - z**2)
    sphere = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
    sphere = sphere @ Rotation.random(rng=rng).as_matrix().T
    return np.concatenate([radius * sphere for radius in RADII])


def carried(displacements: FloatArray, corners: FloatArray) -> FloatArray:
    """Corners (k, 3) moved by displacements (v, 4, 4): (v, k, 3)."""
    points: FloatArray = (
        np.einsum("vij,kj->vki", displacements[:, :3, :3], corners) + displacements[:, None, :3, 3]
    )
    return points


@dataclass(frozen=True)
class _CameraProblem:
    """The data in normalised units: lengths divided by ``spread`` about ``middle``, pixels by ``N`` (c, 3, 3).

    Unknowns ``z``: cameras (c, 3, 4), radial terms (c,), corners (k, 3), in one row.
    """

    views: TagViews
    sizes: IntArray
    turned: FloatArray  # (v, 4, 4)
    pixels: FloatArray  # (v, k, 2)
    N: FloatArray
    middle: FloatArray
    spread: float

    @classmethod
    def of(cls, displacements: FloatArray, views: TagViews, sizes: IntArray) -> _CameraProblem:
        positions = displacements[views.pose][:, :3, 3]
        middle = positions.mean(axis=0)
        spread = float(np.sqrt(((positions - middle) ** 2).sum(axis=1).mean()))
        if not spread > 1e-6:
            raise ExperimentError(
                "no_motion",
                f"the hand moved by {spread:.2g} m over all poses; a fit needs centimetres",
                spread_m=spread,
            )
        turned = displacements[views.pose].copy()
        turned[:, :3, 3] = (positions - middle) / spread
        N = np.stack([pixel_normaliser(int(w), int(h)) for w, h in sizes])
        pixels = np.stack([from_pixels(N[c], p) for c, p in zip(views.camera, views.pixels, strict=True)])
        return cls(views, sizes, turned, pixels, N, middle, spread)

    @property
    def half(self) -> FloatArray:
        """Half image widths (v, 1, 1) [px]: from normalised residuals to pixels."""
        return np.asarray(self.sizes[self.views.camera, 0] / 2.0)[:, None, None]

    def linear_start(self, offset: FloatArray) -> tuple[float, FloatArray, FloatArray] | None:
        """Median error [px], cameras and corners from one guess (3,) [m]; None where the guess is
        degenerate."""
        corners = np.tile(offset / self.spread, (self.pixels.shape[1], 1))
        pixels = np.broadcast_to(self.pixels.mean(axis=1, keepdims=True), self.pixels.shape)
        try:
            for turn in range(ALTERNATIONS):
                Ps = self._resect(
                    corners[:1] if turn == 0 else corners, pixels[:, :1] if turn == 0 else self.pixels
                )
                corners = self._linear_corners(Ps)
            Ps = self._resect(corners, self.pixels)
        except (GeometryError, np.linalg.LinAlgError):
            return None
        z = np.concatenate([Ps.ravel(), np.zeros(len(Ps)), corners.ravel()])
        error = np.linalg.norm(self._residuals(z), axis=2)
        return (float(np.median(error)), Ps, corners) if np.isfinite(error).all() else None

    def _resect(self, corners: FloatArray, pixels: FloatArray) -> FloatArray:
        points = to_homogeneous(carried(self.turned, corners))
        cameras = [self.views.camera == c for c in range(len(self.sizes))]
        return np.stack(
            [resection(points[v].reshape(-1, 4), pixels[v].reshape(-1, 2), refine=False) for v in cameras]
        )

    def _linear_corners(self, Ps: FloatArray) -> FloatArray:
        """Corners (k, 3) that satisfy ``(P₁₂ − m P₃)(R X + t, 1) = 0`` over all views, by depth-weighted
        least squares."""
        P = Ps[self.views.camera]
        rows = P[:, None, :2] - self.pixels[..., None] * P[:, None, 2:]  # (v, k, 2, 4)
        depth = np.einsum("vj,vj->v", P[:, 2], self.turned[:, :, 3])
        rows = rows / np.where(depth == 0.0, np.nan, depth)[:, None, None, None]
        A = np.einsum("vkaj,vji->vkai", rows, self.turned[:, :, :3])
        b = -np.einsum("vkaj,vj->vka", rows, self.turned[:, :, 3])
        k = self.pixels.shape[1]
        return np.stack(
            [np.linalg.lstsq(A[:, i].reshape(-1, 3), b[:, i].reshape(-1), rcond=1e-9)[0] for i in range(k)]
        )

    def _unpack(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        c = len(self.sizes)
        return z[: 12 * c].reshape(c, 3, 4), z[12 * c : 13 * c], z[13 * c :].reshape(-1, 3)

    def _residuals(self, z: FloatArray) -> FloatArray:
        """Predicted less measured (v, k, 2) [px]."""
        Ps, radial, corners = self._unpack(z)
        m = np.einsum("vij,vkj->vki", Ps[self.views.camera], to_homogeneous(carried(self.turned, corners)))
        u = m[..., :2] / m[..., 2:]
        square = (u**2).sum(axis=2, keepdims=True)
        residuals: FloatArray = (
            u * (1.0 + radial[self.views.camera][:, None, None] * square) - self.pixels
        ) * self.half
        return residuals

    def _jacobian(self, z: FloatArray) -> FloatArray:
        """Derivative (v, k, 2, len(z)) [px] of the residuals."""
        Ps, radial, corners = self._unpack(z)
        v, k, c = len(self.turned), len(corners), len(Ps)
        P = Ps[self.views.camera]
        points = to_homogeneous(carried(self.turned, corners))
        m = np.einsum("vij,vkj->vki", P, points)
        u, depth = m[..., :2] / m[..., 2:], m[..., 2]
        square = (u**2).sum(axis=2)
        kappa = radial[self.views.camera][:, None]
        bend = (1.0 + kappa * square)[..., None, None] * np.eye(2) + 2.0 * kappa[..., None, None] * (
            u[..., :, None] * u[..., None, :]
        )
        bend = bend * self.half[..., None]
        by_camera = np.zeros((v, k, 2, 3, 4))
        by_camera[:, :, 0, 0] = by_camera[:, :, 1, 1] = points
        by_camera[:, :, :, 2] = -u[..., None] * points[:, :, None]
        by_camera = np.einsum("vkab,vkbij->vkaij", bend, by_camera / depth[..., None, None, None])
        by_point = (P[:, None, :2, :3] - u[..., None] * P[:, None, 2:, :3]) / depth[..., None, None]
        by_corner = np.einsum("vkab,vkbi,vij->vkaj", bend, by_point, self.turned[:, :3, :3])

        J = np.zeros((v, k, 2, len(z)))
        for camera in range(c):
            seen = self.views.camera == camera
            J[seen, :, :, 12 * camera : 12 * camera + 12] = by_camera[seen].reshape(-1, k, 2, 12)
            J[seen, :, :, 12 * c + camera] = u[seen] * square[seen][..., None] * self.half[seen]
        for corner in range(k):
            J[:, corner, :, 13 * c + 3 * corner : 13 * c + 3 * corner + 3] = by_corner[:, corner]
        return J

    def bundle(
        self,
        Ps: FloatArray,
        radial_terms: FloatArray,
        corners: FloatArray,
        *,
        radial: bool,
        robust: bool,
        inliers: BoolArray | None = None,
    ) -> tuple[FloatArray, float]:
        """Bundle adjustment: unknowns of least (robust) reprojection error and the cost [px²]; each camera's scale
        is left out.
        """
        c = len(Ps)
        unit = [P / np.linalg.norm(P) for P in Ps]
        start = np.concatenate([np.ravel(unit), radial_terms, corners.ravel()])
        chart = np.zeros((len(start), 11 * c + (c if radial else 0) + corners.size))
        for i, P in enumerate(unit):
            chart[12 * i : 12 * i + 12, 11 * i : 11 * i + 11] = np.linalg.svd(P.reshape(1, 12))[2][1:].T
        rest = len(start) - (12 * c if radial else 13 * c)
        chart[-rest:, -rest:] = np.eye(rest)
        used = np.ones(len(self.turned), dtype=bool) if inliers is None else inliers

        def residuals(y: FloatArray) -> FloatArray:
            return self._residuals(start + chart @ y)[used].ravel()

        def jacobian(y: FloatArray) -> FloatArray:
            product: FloatArray = self._jacobian(start + chart @ y)[used].reshape(-1, len(start)) @ chart
            return product

        fit = least_squares(
            residuals,
            np.zeros(chart.shape[1]),
            jac=jacobian,
            loss="soft_l1" if robust else "linear",
            f_scale=ROBUST_SCALE,
            x_scale="jac",
            max_nfev=200,
        )
        return start + chart @ fit.x, float(fit.cost)

    def finish(self, z: FloatArray, *, radial: bool, costs: tuple[float, ...]) -> DrivenCameras:
        """Gate the views, fit the rest by plain least squares, and return to pixels and metres."""
        error = np.linalg.norm(self._residuals(z), axis=2)
        gate = max(GATE_SIGMAS * float(np.median(error)) / np.sqrt(2.0 * np.log(2.0)), GATE_FLOOR)
        inliers = error.max(axis=1) <= gate
        left = np.bincount(self.views.camera[inliers], minlength=len(self.sizes))
        if (left < LEAST_VIEWS).any():
            inliers = np.ones(len(error), dtype=bool)
        Ps, radial_terms, corners = self._unpack(z)
        z, _ = self.bundle(Ps, radial_terms, corners, radial=radial, robust=False, inliers=inliers)
        Ps, radial_terms, corners = self._unpack(z)
        to_unit = np.eye(4) / self.spread
        to_unit[:3, 3], to_unit[3, 3] = -self.middle / self.spread, 1.0
        outward = np.stack([np.linalg.inv(N) @ P @ to_unit for N, P in zip(self.N, Ps, strict=True)])
        outward = outward / np.linalg.norm(outward[:, 2:, :3], axis=2, keepdims=True)
        rss = float((self._residuals(z)[inliers] ** 2).sum())
        return DrivenCameras(outward, radial_terms, corners * self.spread, self.sizes, inliers, rss, costs)

    def inward(self, model: DrivenCameras) -> tuple[FloatArray, FloatArray]:
        """Cameras and corners of ``model`` in this problem's units."""
        from_unit = np.diag([self.spread, self.spread, self.spread, 1.0])
        from_unit[:3, 3] = self.middle
        return np.stack(
            [N @ P @ from_unit for N, P in zip(self.N, model.Ps, strict=True)]
        ), model.corners / self.spread


@dataclass(frozen=True)
class Triangulated:
    """Triangulation errors: the cameras (indices) used, and the distances ``errors`` (n,) [m] of the corners from
    their true positions.
    """

    cameras: tuple[int, ...]
    errors: FloatArray

    @property
    def rms_mm(self) -> float:
        """Root mean square distance [mm]."""
        return float(1e3 * np.sqrt(np.mean(self.errors**2)))


def triangulation_errors(
    folds: Sequence[tuple[int, IntArray, DrivenCameras]],
    displacements: FloatArray,
    views: TagViews,
    fold: IntArray,
) -> list[Triangulated]:
    """Each set of two or more of the cameras that every fold fitted, the largest set last.

    ``folds``: number, cameras (indices) and the model fitted without it; ``fold`` (v,) of the views. Only poses in
    which all these cameras saw the tag count. Empty where there is none.
    """
    if not folds:
        return []
    common = sorted(set.intersection(*(set(kept.tolist()) for _, kept, _ in folds)))
    subsets = [s for size in range(2, len(common) + 1) for s in combinations(common, size)]
    errors: dict[tuple[int, ...], list[FloatArray]] = {subset: [] for subset in subsets}
    for number, kept, model in folds:
        held = views.take(fold == number)
        for pose in np.unique(held.pose):
            at = {int(c): held.pixels[(held.pose == pose) & (held.camera == c)] for c in common}
            if any(len(pixels) != 1 for pixels in at.values()):
                continue
            truth = carried(displacements[pose][None], model.corners)[0]
            for subset in subsets:
                rows = [int(np.flatnonzero(kept == c)[0]) for c in subset]
                ideal = np.array(
                    [
                        undistort(at[c][0], model.radial[row][None], model.sizes[row][None])
                        for c, row in zip(subset, rows, strict=True)
                    ]
                )
                points = triangulate(model.Ps[rows], ideal)
                errors[subset].append(np.linalg.norm(points[:, :3] / points[:, 3:] - truth, axis=1))
    return [Triangulated(s, np.concatenate(found)) for s, found in errors.items() if found]
