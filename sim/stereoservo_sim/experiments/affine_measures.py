"""Error measures ``e_D`` and ``e_Q`` of an affine calibration (3.41)-(3.43), and their Cramér-Rao bound.

Structure is reconstructed projectively and upgraded afterwards (thesis 3.3), [m] in, [mm] out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from stereoservo.geometry.cameras import camera_centre, canonical_pair
from stereoservo.geometry.homogeneous import from_homogeneous, move_points, to_homogeneous
from stereoservo.geometry.homography import homography_from_points
from stereoservo.geometry.reprojection_fit import linearise, read_images, with_rest
from stereoservo.geometry.strata import projective_to_affine
from stereoservo.geometry.translation_fit import shared_plane
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.experiments.figures import draw_medians
from stereoservo_sim.world.camera_rig import StereoRig, project, stereo_rig

FOCAL_PX = 1530.0
"""Focal length of both cameras: the thesis's own rig in table 5.2 (1503 to 1540 px)."""
IMAGE_SIZE = (512, 512)
"""[px]: twice the principal point of table 5.2 (250 to 260 px)."""

CAMERAS_ASSUMED = (
    f"focal length {FOCAL_PX:.0f} px and image {IMAGE_SIZE[0]}x{IMAGE_SIZE[1]} px: not said in chapter 3, taken from "
    "table 5.2; both cameras look at the middle of the object"
)
EPIPOLAR_ASSUMED = "the epipolar geometry is known (rigid stereo, chapter 2), except in rows that say otherwise"


def converging_rig(distance: float, baseline: float = 0.2) -> StereoRig:
    """Two cameras of table 5.2, ``baseline`` [m] apart, aimed at a point ``distance`` [m] ahead."""
    return stereo_rig(
        np.eye(4),
        baseline=baseline,
        vergence=2.0 * float(np.arctan(0.5 * baseline / distance)),
        focal=FOCAL_PX,
        centre=((IMAGE_SIZE[0] - 1) / 2, (IMAGE_SIZE[1] - 1) / 2),
        size=IMAGE_SIZE,
    )


def images_of(rig: StereoRig, points: FloatArray) -> FloatArray:
    """Exact pixels (..., c, n, 2) of points (..., n, 3) [m]."""
    flat = points.reshape(-1, *points.shape[-2:])
    pixels = np.array([[project(camera.P, X)[0] for camera in rig.cameras] for X in flat])
    return np.asarray(pixels.reshape(*points.shape[:-2], *pixels.shape[1:]))


def fundamental_of(rig: StereoRig) -> FloatArray:
    """``F`` (3, 3) of the rig, ``m'ᵀ F m = 0``: ``[e']ₓ P' P⁺``."""
    left, right = (camera.P for camera in rig.cameras)
    e = right @ camera_centre(left)
    cross = np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])
    return np.asarray(cross @ right @ np.linalg.pinv(left))


def projective_cameras(F: FloatArray, pixels: FloatArray) -> FloatArray:
    """Cameras (2, 3, 4) of the canonical projective frame, ``pixels`` (2, n, 2) being matches in both."""
    return np.stack(canonical_pair(F, *IMAGE_SIZE, left=pixels[0], right=pixels[1]))


def upgrade(plane: FloatArray, points: FloatArray) -> FloatArray:
    """Affine structure N (n, 3) of projective points (n, 4) by ``H_PA`` (2.14) of the plane at infinity (4,)."""
    return from_homogeneous(move_points(projective_to_affine(plane), points))


def plane_at_infinity_of(points: FloatArray, X: FloatArray) -> FloatArray:
    """Plane at infinity (4,), unit norm, of exact projective points (n, 4) of a scene X (n, 3): ``hᵀM`` is the divisor
    of the map to X.
    """
    plane = homography_from_points(points, to_homogeneous(X))[3]
    return np.asarray(plane / np.linalg.norm(plane))


def distance_error(N: FloatArray, X: FloatArray) -> float:
    """``e_D`` [mm]: mean distance of X (n, 3) from N (n, 3) under the best-fitting affinity (3.42), (3.43)."""
    design = to_homogeneous(N)
    fit = np.linalg.lstsq(design, X, rcond=None)[0]
    return float(1e3 * np.linalg.norm(X - design @ fit, axis=1).mean())


def collinear_triplets(X: FloatArray) -> IntArray:
    """All collinear triplets (t, 3) of points of X (n, 3), the middle one second."""
    found = []
    for triplet in combinations(range(len(X)), 3):
        sides = [np.linalg.norm(X[triplet[i]] - X[triplet[j]]) for i, j in ((1, 2), (0, 2), (0, 1))]
        longest = int(np.argmax(sides))
        if sum(sides) - 2 * sides[longest] < 1e-9 * sides[longest]:
            ends = [triplet[i] for i in range(3) if i != longest]
            found.append((ends[0], triplet[longest], ends[1]))
    return np.array(found, dtype=np.int64).reshape(-1, 3)


def ratio_error(N: FloatArray, X: FloatArray, triplets: IntArray) -> float:
    """``e_Q`` [mm]: mean error of the length ratio of collinear triplets, in units of their first length (3.41)."""
    first, middle, last = triplets.T

    def lengths(Y: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.linalg.norm(Y[last] - Y[first], axis=1), np.linalg.norm(Y[middle] - Y[first], axis=1)

    (n_long, n_short), (x_long, x_short) = lengths(N), lengths(X)
    return float(1e3 * np.abs((n_long / n_short - x_long / x_short) * x_short).mean())


@dataclass(frozen=True, eq=False)
class Bound:
    """Cramér-Rao bound at the truth: covariances of the plane at infinity ``(3, 3)`` [1/m²] in the Euclidean frame,
    where it is (ε, 1), and of points and plane together ``(3n + 3, 3n + 3)``, points first [m].
    """

    plane: FloatArray
    joint: FloatArray


def cramer_rao(rig: StereoRig, X: FloatArray, shifts: FloatArray, sigma: float) -> Bound:
    """Bound for points X (n, 3) [m] seen at rest and after translations ``shifts`` (s, 3) [m] with noise ``sigma``
    [px], with cameras known up to a projective frame, and unknown points and motions.
    """
    P = np.array([camera.P for camera in rig.cameras])
    points = to_homogeneous(X)
    pixels = images_of(rig, np.concatenate([X[None], X + shifts[:, None]]))
    chart, x = shared_plane(np.eye(4)[3], np.hstack([shifts, np.zeros((len(shifts), 1))]))
    charts = np.broadcast_to(np.eye(4)[:, :3], (len(X), 4, 3))
    at = linearise(read_images(P, pixels, sigma), *with_rest(chart.displacements)(x), points, charts)
    n, q = len(X), len(x)
    information = np.zeros((3 * n + q, 3 * n + q))
    own = np.einsum("nra,nrb->nab", at.points, at.points)
    shared = np.einsum("nra,nrq->naq", at.points, at.motion)
    for i in range(n):
        information[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = own[i]
    information[: 3 * n, 3 * n :] = shared.reshape(3 * n, q)
    information[3 * n :, : 3 * n] = shared.reshape(3 * n, q).T
    information[3 * n :, 3 * n :] = np.einsum("nrp,nrq->pq", at.motion, at.motion)
    size = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    joint = covariance[: 3 * n + 3, : 3 * n + 3]
    return Bound(joint[3 * n :, 3 * n :], joint)


def cramer_rao_estimated(rig: StereoRig, X: FloatArray, shifts: FloatArray, sigma: float) -> Bound:
    """As `cramer_rao`, with the second camera unknown as well: the bound if F is estimated from the same images.

    ``plane`` is (3n + 3, 3n + 3) here: of the noise-free images' structure in the estimated cameras, points first, and
    the plane, since both change with the cameras.
    """
    P = np.array([camera.P for camera in rig.cameras])
    points = to_homogeneous(X)
    pixels = images_of(rig, np.concatenate([X[None], X + shifts[:, None]]))
    chart, x = shared_plane(np.eye(4)[3], np.hstack([shifts, np.zeros((len(shifts), 1))]))
    charts = np.broadcast_to(np.eye(4)[:, :3], (len(X), 4, 3))
    displacements, slopes = with_rest(chart.displacements)(x)
    at = linearise(read_images(P, pixels, sigma), displacements, slopes, points, charts)
    n, q = len(X), len(x)
    by_camera = _second_camera_slopes(P[1], points @ displacements.transpose(0, 2, 1), sigma)
    rows = at.motion.shape[1]
    J = np.zeros((n, rows, 3 * n + q + 12))
    for i in range(n):
        J[i, :, 3 * i : 3 * i + 3] = at.points[i]
    J[:, :, 3 * n : 3 * n + q], J[:, :, 3 * n + q :] = at.motion, by_camera
    flat = J.reshape(n * rows, -1)
    size = np.linalg.norm(flat, axis=0)
    # Five directions remain free: of the projective frame that keeps the first camera, and of the second one's scale.
    values, vectors = np.linalg.eigh((flat / size).T @ (flat / size))
    root = vectors[:, FRAME:] / np.sqrt(values[FRAME:]) / size[:, None]
    of_camera = root[3 * n + q :]
    still = slice(0, 2 * len(P))
    structure = np.concatenate(
        [-np.linalg.pinv(at.points[i, still]) @ by_camera[i, still] @ of_camera for i in range(n)]
    )
    plane = np.vstack([structure, root[3 * n : 3 * n + 3]])
    joint = root[: 3 * n + 3]
    return Bound(plane @ plane.T, joint @ joint.T)


FRAME = 5
"""Degrees of freedom of a projective frame with one camera given, with the other's scale."""


def _second_camera_slopes(P: FloatArray, moved: FloatArray, sigma: float) -> FloatArray:
    """Derivatives (n, 4 s, 12) of the residuals of points (s, n, 4) in the entries of the second camera P (3, 4)."""
    m = moved @ P.T
    ideal = m[..., :2] / m[..., 2:]
    slopes = np.zeros((*moved.shape[:2], 2, 2, 12))
    for axis in (0, 1):
        slopes[..., 1, axis, 4 * axis : 4 * axis + 4] = moved / m[..., 2:]
        slopes[..., 1, axis, 8:] = -ideal[..., axis, None] * moved / m[..., 2:]
    return np.asarray(slopes.transpose(1, 0, 2, 3, 4).reshape(moved.shape[1], -1, 12) / sigma)


def pair_covariance(rig: StereoRig, X: FloatArray, sigma: float) -> FloatArray:
    """Covariance (3n, 3n) [m²] of points X (n, 3) triangulated in one stereo image with noise ``sigma`` [px]."""
    P = np.array([camera.P for camera in rig.cameras])
    charts = np.broadcast_to(np.eye(4)[:, :3], (len(X), 4, 3))
    nothing = np.zeros((1, 0, 4, 4))
    images = read_images(P, images_of(rig, X[None]), sigma)
    at = linearise(images, np.eye(4)[None], nothing, to_homogeneous(X), charts)
    blocks = np.linalg.inv(np.einsum("nra,nrb->nab", at.points, at.points))
    covariance = np.zeros((3 * len(X), 3 * len(X)))
    for i, block in enumerate(blocks):
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    return covariance


def expected_errors(
    X: FloatArray,
    plane: FloatArray | None,
    joint: FloatArray | None,
    triplets: IntArray | None = None,
    exact: FloatArray | None = None,
) -> tuple[float, float | None]:
    """Means of ``e_D`` and ``e_Q`` [mm], to first order, of unbiased Gaussian estimates with these covariances.

    ``plane`` (3, 3) alone: noise-free structure, upgraded by the estimated plane. ``joint`` (3n + 3, 3n + 3):
    structure and plane of one estimate. ``e_Q`` takes lengths in the affine frame, which shears off-line errors
    into them: ``exact`` (n, 3), noise-free N there; default X itself. Both None or both given raises ValueError.
    """
    if (plane is None) == (joint is None):
        raise ValueError("give the covariance of the plane or the joint one of points and plane, not both")
    n = len(X)
    # A plane (ε, 1) moves a point upgraded by it: X / (1 + εᵀX) - X = -X (Xᵀε).
    lever = -(X[:, :, None] * X[:, None, :]).reshape(3 * n, 3)
    moves = lever if joint is None else np.hstack([np.eye(3 * n), lever])
    root = _root(plane if joint is None else joint)
    shifts = (moves @ root).reshape(n, 3, -1)
    design = to_homogeneous(X)
    left = np.eye(n) - design @ np.linalg.pinv(design)
    residuals = np.einsum("ij,jak->iak", left, shifts)
    e_d = float(1e3 * _mean_lengths(residuals @ residuals.transpose(0, 2, 1)).mean())
    if triplets is None or not len(triplets):
        return e_d, None
    first, middle, last = triplets.T
    along, short = X[last] - X[first], X[middle] - X[first]
    ratio = (np.linalg.norm(along, axis=1) / np.linalg.norm(short, axis=1))[:, None, None]
    moved = (shifts[last] - shifts[first]) - ratio * (shifts[middle] - shifts[first])
    A = np.linalg.lstsq(design, X if exact is None else exact, rcond=None)[0][:3]
    unit = along / np.linalg.norm(along, axis=1)[:, None]
    covector = unit @ (A @ A.T)
    covector = covector / (covector * unit).sum(axis=1)[:, None]
    deviations = np.linalg.norm(np.einsum("ta,tak->tk", covector, moved), axis=1)
    return e_d, float(1e3 * np.sqrt(2.0 / np.pi) * deviations.mean())


def _root(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _mean_lengths(covariances: FloatArray) -> FloatArray:
    """Mean length (n,) of Gaussian 3-vectors of covariances (n, 3, 3): ``E|r| = E[χ₃] · mean over u of √(uᵀCu)``."""
    k = np.arange(400) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / 400), np.pi * (1 + np.sqrt(5)) * k
    u = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)
    squares = np.einsum("ka,nab,kb->nk", u, covariances, u)
    return np.asarray(2.0 * np.sqrt(2.0 / np.pi) * np.sqrt(np.maximum(squares, 0.0)).mean(axis=1))


def answer_of(rows: list[dict[str, Any]], thesis: dict[str, Any], assumptions: list[str]) -> dict[str, Any]:
    """Answer of an experiment of chapter 3, with the thesis's values and the assumptions."""
    return {
        "rows": rows,
        "thesis": thesis,
        "assumptions": assumptions,
        "bound_is": "mean error of an estimator at the Cramér-Rao bound, free points, to first order",
    }


def rows_of(rows: list[dict[str, Any]], measure: str, **wanted: Any) -> list[dict[str, Any]]:
    """Rows with these entries for which any seed has a value of ``measure``."""
    return [r for r in rows if r[measure]["mean"] and all(r[key] == value for key, value in wanted.items())]


def draw_errors(
    axis: Axes, rows: list[dict[str, Any]], across: str, measure: str, style: str, colour: str, label: str
) -> None:
    """Draw medians of a ``measure`` of the rows with their spread, and its bound dashed if there is one."""
    if not rows:
        return
    places = [row[across] for row in rows]
    draw_medians(axis, places, [row[measure] for row in rows], style, colour, label)
    bounds = [row[f"bound_{measure}"] for row in rows]
    axis.plot(places, bounds, "--", color=colour, linewidth=0.8)
