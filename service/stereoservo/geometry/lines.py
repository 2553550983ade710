"""Lines of space: Plücker coordinates, their span of two points and meet of two planes, images, reconstruction.

A line is a 6-vector ``(d, m)``: of points ``A``, ``B`` the direction ``d = A₄ B₁₂₃ - B₄ A₁₂₃`` and the moment
``m = A₁₂₃ x B₁₂₃``, with ``dᵀm = 0``. In a Euclidean frame d is the direction and m the moment about the origin.
Two points span it and two planes meet in it (thesis 2.5.2); stacks come first: ``(n, 6)``. An image line ``l`` (3,)
consists of the ideal pixels with ``lᵀ(u, v, 1) = 0`` and is scaled so that this is a signed distance [px].
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from stereoservo.geometry.cameras import camera_centre
from stereoservo.geometry.homogeneous import RANK_TOLERANCE, GeometryError, to_homogeneous
from stereoservo.numerics.arrays import BoolArray, FloatArray

CERTAINTY = 3.0
"""Number of standard deviations of its direction by which a segment must differ from the epipolar line."""


def line_through_points(A: FloatArray, B: FloatArray) -> FloatArray:
    """Plücker coordinates ``(..., 6)`` of the line from ``A`` (..., 4) to ``B`` (..., 4); zero if they coincide."""
    A, B = np.broadcast_arrays(np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64))
    d = A[..., 3:] * B[..., :3] - B[..., 3:] * A[..., :3]
    line: FloatArray = np.concatenate([d, np.cross(A[..., :3], B[..., :3])], axis=-1)
    return line


def line_in_planes(a: FloatArray, b: FloatArray) -> FloatArray:
    """Plücker coordinates ``(..., 6)`` of the meet of planes ``(..., 4)``: the dual of `line_through_points` (2.60)."""
    swapped = line_through_points(a, b)
    # Points give (d, m), planes (m, d), up to the sign, which depends on the order of the two.
    line: FloatArray = np.concatenate([swapped[..., 3:], swapped[..., :3]], axis=-1)
    return line


def span_matrix(L: FloatArray) -> FloatArray:
    """``A Bᵀ - B Aᵀ`` (..., 4, 4) of lines ``(..., 6)``: maps a plane to its intersection with the line."""
    L = np.asarray(L, dtype=np.float64)
    matrix = np.zeros((*L.shape[:-1], 4, 4))
    matrix[..., :3, :3] = cross_matrix(-L[..., 3:])
    matrix[..., 3, :3] = L[..., :3]
    matrix[..., :3, 3] = -L[..., :3]
    return matrix


def meet_matrix(L: FloatArray) -> FloatArray:
    """``a bᵀ - b aᵀ`` (..., 4, 4) of lines ``(..., 6)``: maps a point to the plane through it and the line."""
    L = np.asarray(L, dtype=np.float64)
    return span_matrix(np.concatenate([L[..., 3:], L[..., :3]], axis=-1))


def cross_matrix(w: FloatArray) -> FloatArray:
    """``[w]ₓ`` (..., 3, 3) of vectors ``(..., 3)``, antisymmetric, ``[w]ₓ x = w x x`` (2.37)."""
    w = np.asarray(w, dtype=np.float64)
    matrix = np.zeros((*w.shape[:-1], 3, 3))
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    matrix[..., 1, 2], matrix[..., 2, 0], matrix[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return matrix


def line_points(L: FloatArray) -> FloatArray:
    """Two orthonormal points ``(..., 2, 4)`` whose join is the line ``(..., 6)`` (2.78), with its orientation."""
    return _two_rows(span_matrix(checked_lines(L)), L, line_through_points)


def line_planes(L: FloatArray) -> FloatArray:
    """Two orthonormal planes ``(..., 2, 4)`` whose meet is the line ``(..., 6)`` (2.79), with its orientation."""
    return _two_rows(meet_matrix(checked_lines(L)), L, line_in_planes)


def _two_rows(matrix: FloatArray, L: FloatArray, line_of: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
    rows: FloatArray = np.linalg.svd(matrix)[2][..., :2, :]
    agrees = (line_of(rows[..., 0, :], rows[..., 1, :]) * L).sum(axis=-1) >= 0
    return np.where(agrees[..., None, None], rows, rows[..., ::-1, :])


def line_residual(L: FloatArray) -> FloatArray:
    """``2 dᵀm / |L|²`` (...) in [-1, 1]: zero if the 6-vector ``(..., 6)`` is a line (the Klein quadric)."""
    L = np.asarray(L, dtype=np.float64)
    residual: FloatArray = 2.0 * (L[..., :3] * L[..., 3:]).sum(axis=-1) / (L**2).sum(axis=-1)
    return residual


def checked_lines(L: FloatArray, tolerance: float = 1e-9) -> FloatArray:
    """``L`` (..., 6) unchanged. Raises GeometryError if one is zero, not finite, or no line (see `nearest_line`)."""
    L = np.asarray(L, dtype=np.float64)
    if L.shape[-1] != 6:
        raise GeometryError("shape", f"lines have shape {L.shape}; (..., 6) is needed", shape=L.shape)
    norms = np.linalg.norm(L, axis=-1)
    if not (np.isfinite(norms) & (norms > 0)).all():
        raise GeometryError("not_finite", f"a line is zero or not finite: {L.tolist()}")
    worst = float(np.abs(line_residual(L)).max(initial=0.0))
    if worst > tolerance:
        raise GeometryError(
            "degenerate",
            f"a 6-vector is no line: 2 dᵀm/|L|² is {worst:.3g}, at most {tolerance:.3g} is",
            residual=worst,
        )
    return L


def nearest_line(L: FloatArray) -> FloatArray:
    """The line ``(..., 6)`` nearest to 6-vectors ``(..., 6)``: ``d + m`` and ``d - m`` are scaled to equal lengths.

    Raises GeometryError if all lines are equally near to the 6-vector (``d = ± m``).
    """
    L = np.asarray(L, dtype=np.float64)
    plus, minus = L[..., :3] + L[..., 3:], L[..., :3] - L[..., 3:]
    lengths = np.linalg.norm(plus, axis=-1), np.linalg.norm(minus, axis=-1)
    if not (np.minimum(*lengths) > RANK_TOLERANCE * np.maximum(*lengths)).all():
        raise GeometryError("degenerate", f"d and m are parallel and equal in {L.tolist()}; no line is nearest")
    mean_length = 0.5 * (lengths[0] + lengths[1])
    plus = plus * (mean_length / lengths[0])[..., None]
    minus = minus * (mean_length / lengths[1])[..., None]
    line: FloatArray = 0.5 * np.concatenate([plus + minus, plus - minus], axis=-1)
    return line


def reciprocal_product(L1: FloatArray, L2: FloatArray) -> FloatArray:
    """``d₁ᵀm₂ + m₁ᵀd₂`` (...) of lines ``(..., 6)``: ``-det[A₁ B₁ A₂ B₂]``, zero if they meet; else its sign is the
    sense of their crossing.
    """
    product: FloatArray = (L1[..., :3] * L2[..., 3:] + L1[..., 3:] * L2[..., :3]).sum(axis=-1)
    return product


def line_motion(H: FloatArray) -> FloatArray:
    """``(6, 6)`` map of lines under the map ``H`` (4, 4) of points."""
    ends = np.eye(4)
    # Basis lines in the order of the coordinates: d_i from the origin e₄ to e_i; m from e₂e₃, e₃e₁, e₁e₂.
    first, second = [3, 3, 3, 1, 2, 0], [0, 1, 2, 2, 0, 1]
    return line_through_points(ends[first] @ H.T, ends[second] @ H.T).T


def line_projection(P: FloatArray) -> FloatArray:
    """``(3, 6)``: image lines of lines under a camera ``P`` (3, 4), ``l ~ (P A) x (P B)``."""
    first, second = [3, 3, 3, 1, 2, 0], [0, 1, 2, 2, 0, 1]
    columns = P.T
    projection: FloatArray = np.cross(columns[first], columns[second]).T
    return projection


def project_lines(Ps: FloatArray, L: FloatArray) -> FloatArray:
    """Image lines ``(c, n, 3)`` of lines ``(n, 6)`` in cameras ``(c, 3, 4)``, scaled to distances [px].

    NaN if a line passes through a camera's centre or its image is at infinity.
    """
    raw = np.stack([np.asarray(L, dtype=np.float64) @ line_projection(P).T for P in Ps])
    return _as_distance(raw)


def _as_distance(lines: FloatArray) -> FloatArray:
    length = np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)
    scaled: FloatArray = lines / np.where(length == 0.0, np.nan, length)
    return scaled


def image_lines(segments: FloatArray) -> FloatArray:
    """Image lines ``(..., 3)`` through the ends of segments ``(..., 2, 2)`` [px] (2.57); NaN if the ends coincide."""
    ends = to_homogeneous(segments)
    return _as_distance(np.cross(ends[..., 0, :], ends[..., 1, :]))


def interpretation_planes(Ps: FloatArray, lines: FloatArray) -> FloatArray:
    """Planes ``Pᵀl`` (c, n, 4) through camera centres and image lines ``(c, n, 3)``: rows ``lᵀP`` of (2.72, errata)."""
    planes: FloatArray = np.einsum("cij,cni->cnj", Ps, lines)
    return planes


def crossing_angles(Ps: FloatArray, segments: FloatArray) -> FloatArray:
    """``(c, c, n)`` [rad]: angle in [0, π/2] in camera i between a segment and camera j's epipolar line at its middle.

    Zero in all pairs if the line lies in an epipolar plane: then the interpretation planes coincide and do not
    determine the line. Depths along the line scale with 1/sin of it. NaN where i = j or a segment is missing.
    """
    c, n = segments.shape[:2]
    angles = np.full((c, c, n), np.nan)
    mean_length = segments.mean(axis=2)
    along = segments[:, :, 1] - segments[:, :, 0]
    for i, j in itertools.permutations(range(c), 2):
        epipole = Ps[i] @ camera_centre(Ps[j])
        to_epipole = epipole[:2] - epipole[2] * mean_length[i]
        sine = along[i, :, 0] * to_epipole[:, 1] - along[i, :, 1] * to_epipole[:, 0]
        angles[i, j] = np.arctan2(np.abs(sine), np.abs((along[i] * to_epipole).sum(axis=1)))
    return angles


def triangulate_lines(Ps: FloatArray, segments: FloatArray, sigma: float = 1.0, iterations: int = 10) -> FloatArray:
    """Lines ``(n, 6)``, unit norm, from segments ``(c, n, 2, 2)`` [px], NaN where missing, seen by c >= 2 cameras.

    The meet of the interpretation planes (2.72), then least squared distances [px] between the segments' ends
    and the projected line; with two cameras the meet is already optimal. The ends need not correspond between images.
    ``sigma`` [px] is the noise of the ends.

    Raises GeometryError naming the lines that fewer than two cameras see, and those that cannot be distinguished from
    lines in an epipolar plane: in every pair of cameras the segment is within three standard deviations of its
    direction, ``3 √2 σ / length``, parallel to the epipolar line.
    """
    _check_segments(Ps, segments)
    _refuse_epipolar(Ps, segments, sigma)
    lines = image_lines(segments)
    planes = np.nan_to_num(interpretation_planes(Ps, lines)).transpose(1, 0, 2)
    # Rows weighted as distances at the depth of the cameras' mean: scales of cameras do not matter.
    planes = planes / np.linalg.norm(Ps, axis=(1, 2))[None, :, None]
    points = np.linalg.svd(planes)[2][:, 2:, :]
    seen: BoolArray = np.asarray(np.isfinite(segments).all(axis=(2, 3)))
    for _ in range(iterations if Ps.shape[0] > 2 else 0):
        points, largest = _refined(Ps, points, segments, seen)
        if largest < 1e-12:
            break
    L = line_through_points(points[:, 0], points[:, 1])
    result: FloatArray = L / np.linalg.norm(L, axis=-1, keepdims=True)
    return result


def _check_segments(Ps: FloatArray, segments: FloatArray) -> None:
    if Ps.ndim != 3 or segments.ndim != 4 or segments.shape != (len(Ps), segments.shape[1], 2, 2):
        raise GeometryError(
            "shape",
            f"cameras {Ps.shape} and segments {segments.shape} do not fit; (c, 3, 4) and (c, n, 2, 2) are needed",
            cameras=Ps.shape,
            segments=segments.shape,
        )
    views = np.isfinite(segments).all(axis=(2, 3)).sum(axis=0)
    if (views < 2).any():
        few = np.flatnonzero(views < 2).tolist()
        raise GeometryError(
            "too_few",
            f"line(s) {few} are seen by fewer than two cameras",
            lines=few,
            views=views[few].tolist(),
        )


def _refuse_epipolar(Ps: FloatArray, segments: FloatArray, sigma: float) -> None:
    length = np.linalg.norm(segments[:, :, 1] - segments[:, :, 0], axis=2)
    with np.errstate(divide="ignore"):
        limit = np.maximum(CERTAINTY * np.sqrt(2.0) * sigma / length, 1e-9)
    angles = crossing_angles(Ps, segments)
    # A pair determines the line if both of its images cross the epipolar lines significantly.
    epipolar = (angles > limit[:, None]) & (angles.transpose(1, 0, 2) > limit[None, :])
    lost = np.flatnonzero(~epipolar.any(axis=(0, 1)))
    if len(lost):
        largest = np.nanmax(angles[:, :, lost], axis=(0, 1))
        needed = np.nanmin(limit[:, lost], axis=0)
        raise GeometryError(
            "degenerate",
            f"line(s) {lost.tolist()} lie in an epipolar plane: they cross the epipolar lines at "
            f"{np.rad2deg(largest).round(3).tolist()}° at most; {np.rad2deg(needed).round(3).tolist()}° are needed "
            f"with ends known to {sigma:.3g} px",
            lines=lost.tolist(),
            angles_rad=largest.tolist(),
            needed_rad=needed.tolist(),
        )


def _distances(
    Ps: FloatArray, points: FloatArray, segments: FloatArray, seen: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Distances ``(n, 2c)`` [px] of segment ends to projected lines, and their Jacobian ``(n, 2c, 4)``.

    The line of orthonormal points ``(n, 2, 4)`` moves by displacing its points along its two orthonormal planes: the
    four degrees of freedom of a line.
    """
    c, n = segments.shape[:2]
    planes = np.linalg.svd(points)[2][:, 2:, :]
    m = np.einsum("cij,nkj->cnki", Ps, points)
    shift = np.einsum("cij,nkj->cnki", Ps, planes)
    raw = np.cross(m[:, :, 0], m[:, :, 1])
    moved = np.stack(
        [np.cross(shift[:, :, k], m[:, :, 1]) for k in range(2)]
        + [np.cross(m[:, :, 0], shift[:, :, k]) for k in range(2)],
        axis=2,
    )
    length = np.linalg.norm(raw[..., :2], axis=-1)
    ends = to_homogeneous(np.where(seen[..., None, None], segments, 0.0))
    distance = np.einsum("cnei,cni->cne", ends, raw) / length[..., None]
    stretch = np.einsum("cnpi,cni->cnp", moved[..., :2], raw[..., :2]) / length[..., None] ** 2
    jacobian = np.einsum("cnei,cnpi->cnep", ends, moved) / length[..., None, None]
    jacobian = jacobian - distance[..., None] * stretch[:, :, None, :]
    distance, jacobian = distance * seen[..., None], jacobian * seen[..., None, None]
    return (
        distance.transpose(1, 0, 2).reshape(n, 2 * c),
        jacobian.transpose(1, 0, 2, 3).reshape(n, 2 * c, 4),
    )


def _refined(Ps: FloatArray, points: FloatArray, segments: FloatArray, seen: BoolArray) -> tuple[FloatArray, float]:
    """One Gauss-Newton step for all lines; the new orthonormal points and the largest step."""
    residual, J = _distances(Ps, points, segments, seen)
    step = -(np.linalg.pinv(J) @ residual[..., None])[..., 0]
    planes = np.linalg.svd(points)[2][:, 2:, :]
    moved = points + np.einsum("nkp,npj->nkj", step.reshape(-1, 2, 2), planes)
    orthonormal = np.linalg.qr(moved.transpose(0, 2, 1))[0].transpose(0, 2, 1)
    return orthonormal, float(np.abs(step).max(initial=0.0))


def line_covariance(Ps: FloatArray, L: FloatArray, segments: FloatArray, sigma: float) -> FloatArray:
    """First-order covariance ``(n, 6, 6)`` of unit lines ``(n, 6)`` for noise ``sigma`` [px] of the segments' ends.

    Of rank 4. Segments ``(c, n, 2, 2)`` [px] as for `triangulate_lines`.
    """
    _check_segments(Ps, segments)
    points = line_points(L)
    planes = np.linalg.svd(points)[2][:, 2:, :]
    _, J = _distances(Ps, points, segments, np.asarray(np.isfinite(segments).all(axis=(2, 3))))
    covariance = sigma**2 * np.linalg.inv(J.transpose(0, 2, 1) @ J)
    steps = np.stack(
        [line_through_points(planes[:, k], points[:, 1]) for k in range(2)]
        + [line_through_points(points[:, 0], planes[:, k]) for k in range(2)],
        axis=2,
    )
    result: FloatArray = steps @ covariance @ steps.transpose(0, 2, 1)
    return result
