"""Alignment of known points with their current images: estimates the map between two projective frames (rigid,
similarity, affine or projective, depending on the frames), with residuals and reprojected pixels.

For every stratum: a workpiece that has moved, cameras that were exchanged, points of a
drawing (thesis 8.6: targets "can be reprojected onto images actually taken, even if the cameras have changed"). With
two metric frames the map is a rigid motion or a similarity (three points), with two affine ones an affinity (four),
else a homography (five). All are fitted to the (ideal) pixels by one Gauss-Newton iteration on the group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from stereoservo.geometry.cameras import (
    check_views,
    project_many,
    projection_jacobian_many,
    triangulate,
    triangulation_covariance,
)
from stereoservo.geometry.displacements import similarity_from_points
from stereoservo.geometry.homogeneous import GeometryError, move_points, to_homogeneous, whitener
from stereoservo.geometry.homography import linear_homography, pixel_whitening, unit_determinant
from stereoservo.geometry.moved_cameras import (
    OFF_PLANE,
    FrameChange,
    plane_deviations,
    refuse_coplanar,
)
from stereoservo.numerics.arrays import FloatArray

Family = Literal["rigid", "similar", "affine", "projective"]
POINTS_NEEDED: dict[Family, int] = {"rigid": 3, "similar": 3, "affine": 4, "projective": 5}
"""Number of points in general position that determine a map of the family."""
ITERATIONS = 30
HALVINGS = 8
CONVERGED = 1e-9
"""Step, in units of the points' spread, at which the fit has converged."""


@dataclass(frozen=True)
class AlignmentFrame:
    """A projective frame: its cameras (c, 3, 4), and its maps to an affine and a Euclidean frame, if known."""

    Ps: FloatArray
    to_affine: FloatArray | None = None
    to_euclidean: FloatArray | None = None


DRAWING = AlignmentFrame(np.zeros((0, 3, 4)), np.eye(4), np.eye(4))
"""Frame of a drawing: Euclidean, with its own unit of length, without cameras."""


def family_between(old: AlignmentFrame, new: AlignmentFrame, same_scale: bool) -> Family:
    """The smallest group that contains the map between two frames; ``same_scale``: both have one unit of length."""
    if old.to_euclidean is not None and new.to_euclidean is not None:
        return "rigid" if same_scale else "similar"
    return "affine" if old.to_affine is not None and new.to_affine is not None else "projective"


def algebra(family: Family) -> FloatArray:
    """Basis (k, 4, 4) of the group's Lie algebra, with trace 0, so that determinants are preserved."""
    units = np.eye(16).reshape(16, 4, 4)
    moves = [units[3], units[7], units[11]]
    rotations = [units[4 * i + j] - units[4 * j + i] for i, j in ((0, 1), (0, 2), (1, 2))]
    size = np.diag([1.0, 1.0, 1.0, -3.0])
    if family == "rigid":
        return np.array([*moves, *rotations])
    if family == "similar":
        return np.array([*moves, *rotations, size])
    last = 3 if family == "affine" else 4
    off = [units[4 * i + j] for i in range(last) for j in range(4) if i != j]
    stretch = [units[5 * i] - units[15] for i in range(3)]
    return np.array([*off, *stretch])


def upgrades(family: Family, old: AlignmentFrame, new: AlignmentFrame) -> tuple[FloatArray, FloatArray]:
    """Maps from either frame to the frame in which the generators of `algebra` apply."""
    pairs = {"rigid": "to_euclidean", "similar": "to_euclidean", "affine": "to_affine"}
    if family == "projective":
        return np.eye(4), np.eye(4)
    found = [getattr(frame, pairs[family]) for frame in (old, new)]
    if found[0] is None or found[1] is None:
        raise GeometryError("stratum", f"a {family} map needs two frames whose {pairs[family]} is known")
    return found[0], found[1]


def affinity_from_points(X: FloatArray, Y: FloatArray) -> FloatArray:
    """Least-squares affinity ``T`` (4, 4) from points ``(n, 3)`` to ``(n, 3)``. Raises GeometryError if they are
    coplanar.
    """
    if len(X) < 4:
        raise GeometryError("too_few", f"{len(X)} points; an affinity needs at least 4", points=len(X))
    rows = np.hstack([X - X.mean(axis=0), np.ones((len(X), 1))])
    solution, _, rank, _ = np.linalg.lstsq(rows, Y, rcond=1e-9)
    if rank < 4:
        raise GeometryError("degenerate", "the points lie in one plane: an affinity off it stays open")
    T = np.eye(4)
    T[:3, :3] = solution[:3].T
    T[:3, 3] = solution[3] - T[:3, :3] @ X.mean(axis=0)
    return T


def align(
    family: Family,
    old: AlignmentFrame,
    new: AlignmentFrame,
    M_old: FloatArray,
    pixels_new: FloatArray,
    sigmas: FloatArray | float = 1.0,
    M_covariance: FloatArray | None = None,
    names: Sequence[int] | None = None,
) -> FrameChange:
    """Map of the family that moves points ``(n, 4)`` of the old frame onto their images in the new cameras.

    Minimises the reprojection error over ``pixels_new`` (c, n, 2) [px], NaN where missing, ``sigmas`` (c, n) or a
    number [px]; ``M_covariance`` (n, 4, 4) of the old points. ``names`` (n,): names of the points for messages. The
    sign keeps points in front; returned with its covariance.

    Raises GeometryError if two cameras see too few points, or if these do not determine the map.
    """
    called = np.arange(len(M_old)) if names is None else np.asarray(names)
    sigma = np.broadcast_to(np.asarray(sigmas, dtype=np.float64), pixels_new.shape[:2])
    pixels, weights = check_views(new.Ps, pixels_new, 1.0 / sigma)
    M_new = triangulate(new.Ps, pixels_new, sigma, iterations=6)
    both = np.flatnonzero(np.isfinite(M_old).all(axis=1) & np.isfinite(M_new).all(axis=1))
    if len(both) < POINTS_NEEDED[family]:
        raise GeometryError(
            "too_few",
            f"{len(both)} points are known and seen by two cameras ({called[both].tolist()}); a {family} map needs "
            f"at least {POINTS_NEEDED[family]}",
            points=called[both].tolist(),
        )
    own = None if M_covariance is None else np.asarray(M_covariance, dtype=np.float64)
    covariance_px = triangulation_covariance(new.Ps, M_new[both], np.where(weights > 0, sigma, np.inf)[:, both])
    _refuse_flat(family, M_new[both], covariance_px, called[both].tolist())
    up_old, up_new = upgrades(family, old, new)
    T = start_map(family, M_old[both], M_new[both], up_old, up_new)
    used = np.flatnonzero(np.isfinite(M_old).all(axis=1) & (weights > 0).any(axis=0))
    views = PointViews(new.Ps, M_old[used], pixels[:, used], weights[:, used], None if own is None else own[used])
    # About the points' centroid, in units of their standard deviation: this decouples rotations from translations.
    local = local_frame(family, move_points(up_new, M_new[both])) @ up_new
    generators = np.linalg.inv(local) @ algebra(family) @ local
    T = descend(T, generators, views)
    whitening = views.whitening(T)
    whitened, J = views.residuals(T, whitening), views.jacobian(T, generators, whitening)
    _, singular, rows = np.linalg.svd(J, full_matrices=False)
    k = len(generators)
    if len(singular) < k or not singular[k - 1] > 1e-10 * singular[0]:
        raise GeometryError("degenerate", f"points {called[used].tolist()} leave the {family} map open")
    chart = (generators @ T).reshape(k, 16).T @ (rows.T / singular)
    freedom = 2 * int((weights[:, used] > 0).sum()) - k
    rms = float(np.sqrt(whitened @ whitened / freedom)) if freedom > 0 else 0.0
    return FrameChange(T, chart @ chart.T, tuple(used.tolist()), rms, freedom)


@dataclass(frozen=True)
class PointViews:
    """Points ``(n, 4)`` and their pixels ``(c, n, 2)`` with weights ``(c, n)``, 0 where missing."""

    Ps: FloatArray
    M: FloatArray
    pixels: FloatArray
    weights: FloatArray
    covariance: FloatArray | None

    def whitening(self, T: FloatArray) -> FloatArray:
        """Whitening ``(n, 2c, 2c)`` at the map ``T`` (4, 4), which also moves the points' own covariance."""
        return pixel_whitening(self.Ps, T, self.M, self.weights, self.covariance)

    def residuals(self, T: FloatArray, whitening: FloatArray) -> FloatArray:
        """Whitened residuals (r,)."""
        difference = project_many(self.Ps, self.M @ T.T) - self.pixels
        flat = difference.transpose(1, 0, 2).reshape(len(self.M), -1, 1)
        whitened: FloatArray = (whitening @ flat).ravel()
        return whitened

    def jacobian(self, T: FloatArray, generators: FloatArray, whitening: FloatArray) -> FloatArray:
        """Derivatives (r, k) of the residuals by x in ``exp(Σ x Ĝ) T`` at x = 0."""
        moved = self.M @ T.T
        by_point = projection_jacobian_many(self.Ps, moved)
        by_map = np.einsum("cnij,knj->ncik", by_point, moved @ generators.transpose(0, 2, 1))
        slopes: FloatArray = (whitening @ by_map.reshape(len(moved), -1, len(generators))).reshape(-1, len(generators))
        return slopes


class ImageConstraints(Protocol):
    """Whitened image errors of a map ``T`` (4, 4); the type that ``whitening`` returns is the class's own."""

    def whitening(self, T: FloatArray) -> Any: ...

    def residuals(self, T: FloatArray, whitening: Any) -> FloatArray: ...

    def jacobian(self, T: FloatArray, generators: FloatArray, whitening: Any) -> FloatArray: ...


def descend(T: FloatArray, generators: FloatArray, views: ImageConstraints) -> FloatArray:
    """Gauss-Newton on the group; the whitening follows the solution, and is fixed within a step."""
    from scipy.linalg import expm  # here, so that a gateway that aligns nothing does without scipy

    for _ in range(ITERATIONS):
        whitening = views.whitening(T)
        residuals = views.residuals(T, whitening)
        step = -np.linalg.lstsq(views.jacobian(T, generators, whitening), residuals, rcond=1e-12)[0]
        cost = residuals @ residuals
        for _ in range(HALVINGS):
            trial: FloatArray = expm(np.tensordot(step, generators, axes=1)) @ T
            after = views.residuals(trial, whitening)
            if after @ after <= cost * (1.0 + 1e-12):
                T = trial
                break
            step = 0.5 * step
        else:
            return T  # no direction of descent: the minimum is reached to rounding
        if float(np.abs(step).max()) < CONVERGED:
            break
    return T


def start_map(
    family: Family, M_old: FloatArray, M_new: FloatArray, up_old: FloatArray, up_new: FloatArray
) -> FloatArray:
    """Initial map from both reconstructions, ``|det| = 1``, with the sign that keeps points in front."""
    if family == "projective":
        return linear_homography(M_old, M_new)[0]
    X, Y = move_points(up_old, M_old), move_points(up_new, M_new)
    x, y = X[:, :3] / X[:, 3:], Y[:, :3] / Y[:, 3:]
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise GeometryError("degenerate", "a point lies in the plane at infinity")
    T = affinity_from_points(x, y) if family == "affine" else _similarity(x, y, family)
    T = unit_determinant(np.linalg.inv(up_new) @ T @ up_old, f"the {family} map")
    return -T if float(np.sign(np.sum(move_points(T, M_old) * M_new, axis=1)).sum()) < 0 else T


def _similarity(x: FloatArray, y: FloatArray, family: Family) -> FloatArray:
    return similarity_from_points(x, y, scaled=family == "similar")


def local_frame(family: Family, X: FloatArray) -> FloatArray:
    """Coordinates of the points ``(n, 4)`` of an upgraded frame relative to their centroid."""
    if family == "projective":
        return whitener(X)
    x = X[:, :3] / X[:, 3:]
    centroid = x.mean(axis=0)
    local = np.eye(4)
    local[:3, 3] = -centroid
    local[:3] /= max(float(np.sqrt(((x - centroid) ** 2).sum(axis=1).mean())), 1e-300)
    return local


def _refuse_flat(family: Family, M: FloatArray, covariance: FloatArray, names: list[int]) -> None:
    if family == "projective":
        refuse_coplanar(M, covariance, names)
    elif family == "affine":
        _, deviations = plane_deviations(M, covariance)
        if deviations < OFF_PLANE:
            raise GeometryError(
                "degenerate",
                f"points {names} are coplanar: they stand {deviations:.3g} standard deviations off their plane, "
                f"{OFF_PLANE:g} are needed; add a point off it",
                coplanar=names,
                deviations=deviations,
            )


def point_residuals(Ps: FloatArray, M: FloatArray, pixels: FloatArray) -> FloatArray:
    """Rms distance ``(n,)`` [px] of points ``(n, 4)`` from their pixels ``(c, n, 2)``; NaN where none is seen."""
    squares = ((project_many(Ps, M) - pixels) ** 2).sum(axis=-1)
    seen = np.isfinite(squares)
    count = seen.sum(axis=0)
    total = np.where(seen, squares, 0.0).sum(axis=0)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def reprojected(Ps: FloatArray, M: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(c, n, 2)`` of points ``(n, 4)`` and the larger standard deviation ``(c, n)`` [px] of each.

    ``covariance`` (n, 4, 4) of the points.
    """
    J = projection_jacobian_many(Ps, M)
    covariance_px = np.einsum("cnij,njk,cnlk->cnil", J, covariance, J)
    deviations = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_px)[..., -1], 0.0))
    return project_many(Ps, M), deviations


def drawn_points(coordinates: FloatArray, placed: FloatArray | None = None) -> FloatArray:
    """Homogeneous points ``(n, 4)`` of CAD points ``(n, 3)``, after the rigid motion ``placed`` (4, 4), if given.

    Raises GeometryError if ``placed`` is not a rigid motion (a mirror image, a change of size).
    """
    points = to_homogeneous(np.asarray(coordinates, dtype=np.float64))
    if placed is None:
        return points
    R = placed[:3, :3]
    defect = float(max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(placed[3] - [0, 0, 0, 1]).max()))
    if defect > 1e-6 or np.linalg.det(R) < 0:
        what = "is a mirror image" if defect <= 1e-6 else f"is off a rigid motion by {defect:.2g}"
        raise GeometryError(
            "not_rigid", f"the matrix {what}; a rotation, a translation and a last row 0, 0, 0, 1 are needed"
        )
    return move_points(placed, points)
