"""The fundamental matrix from matched pixels: linear, robust and refined; epipolar distances; a test of parallax
against one homography.

Convention: ``m'ᵀ F m = 0`` with ``m`` left, ``m'`` right, in pixels (the thesis's F of (2.10) is the transpose).
"""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from stereoservo.geometry.cameras import from_pixels, isotropic_normaliser
from stereoservo.geometry.homogeneous import GeometryError, to_homogeneous
from stereoservo.numerics.arrays import FloatArray

Loss = Literal["linear", "soft_l1", "huber", "cauchy", "arctan"]

MIN_MATCHES = 8
INLIER_SIGMAS = 3.29
"""Sampson distance [sigmas] that 99.9 % of true matches do not exceed (one degree of freedom)."""


def fundamental_linear(left: FloatArray, right: FloatArray) -> FloatArray:
    """``F`` (3, 3) of unit Frobenius norm from matches ``(n, 2)`` [px], n >= 8, by the normalised 8-point method.

    Raises GeometryError for fewer than eight matches, pixels that are not finite, or matches that leave F
    undetermined (on one point, line or plane).
    """
    left, right = _matches(left, right)
    T_left, T_right = isotropic_normaliser(left), isotropic_normaliser(right)
    x, y = to_homogeneous(from_pixels(T_left, left)), to_homogeneous(from_pixels(T_right, right))
    system = (y[:, :, None] * x[:, None, :]).reshape(-1, 9)
    _, singular, v = np.linalg.svd(system, full_matrices=len(system) < 9)
    if not singular[7] > 1e-7 * singular[0]:
        raise GeometryError(
            "degenerate",
            "the matches do not determine F: they lie on one plane, or the cameras share a centre",
            singular=singular,
        )
    return _unit(T_right.T @ _rank_two(v[8].reshape(3, 3)) @ T_left)


def fundamental_robust(
    left: FloatArray,
    right: FloatArray,
    sigma_px: float,
    *,
    max_iterations: int = 10_000,
    refuse_plane: bool = True,
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """``F`` (3, 3) and inliers ``(n,)`` of matches ``(n, 2)`` [px] with outliers; noise ``sigma_px`` [px] per
    coordinate.

    MAGSAC with a fixed seed, then refinement on the matches within 3.29 sigmas, until they stay the same:
    the same input gives the same output. Raises GeometryError if no F has eight inliers, or if a homography
    explains the inliers as well (points of one plane leave F undetermined), unless ``refuse_plane`` is
    false: then use :func:`parallax_ratio`.
    """
    if not sigma_px > 0:
        raise GeometryError("shape", f"sigma_px is {sigma_px}; it must be positive", sigma_px=sigma_px)
    left, right = _matches(left, right)
    isotropic_normaliser(left), isotropic_normaliser(right)  # raises for coincident points before the random search
    threshold = INLIER_SIGMAS * sigma_px
    found = _sampled(left, right, threshold, max_iterations)
    if found is None:
        raise GeometryError("no_model", f"no fundamental matrix fits the {len(left)} matches", matches=len(left))
    F = _unit(found)
    inliers = np.abs(sampson_distances(F, left, right)) <= threshold
    for _ in range(10):
        if int(inliers.sum()) < MIN_MATCHES:
            raise GeometryError(
                "too_few",
                f"{int(inliers.sum())} of {len(left)} matches agree on one F; at least {MIN_MATCHES} must",
                inliers=int(inliers.sum()),
                matches=len(left),
            )
        F = fundamental_refine(F, left[inliers], right[inliers], sigma_px)
        again = np.abs(sampson_distances(F, left, right)) <= threshold
        if np.array_equal(again, inliers):
            break
        inliers = again
    if refuse_plane:
        _refuse_plane(left[inliers], right[inliers], sigma_px)
    return F, inliers


def _sampled(left: FloatArray, right: FloatArray, threshold: float, max_iterations: int) -> FloatArray | None:
    """``F`` (3, 3) by MAGSAC, else by least median of squares; None if neither finds one."""
    parameters = cv2.UsacParams()
    parameters.confidence = 0.9999
    parameters.isParallel = False
    parameters.maxIterations = max_iterations
    parameters.randomGeneratorState = 20010701
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.threshold = threshold
    by_median = (cv2.FM_LMEDS, threshold, 0.9999, max_iterations)
    for arguments in ((parameters,), by_median):
        try:
            found, _ = cv2.findFundamentalMat(left, right, *arguments)
        except cv2.error:
            continue  # OpenCV's searches assert on some inputs, valid ones among them
        if found is not None and np.shape(found) == (3, 3) and np.isfinite(found).all():
            return np.asarray(found, dtype=np.float64)
    return None


def fundamental_refine(
    F: FloatArray,
    left: FloatArray,
    right: FloatArray,
    sigma: FloatArray | float = 1.0,
    *,
    loss: Loss = "linear",
) -> FloatArray:
    """``F`` (3, 3) of least Sampson error over matches ``(n, 2)`` [px]; ``sigma`` (n,) or a number [px].

    Seven parameters, so that rank two holds exactly; analytic Jacobian. ``loss`` as in scipy's
    ``least_squares``. Raises GeometryError for fewer than eight matches or an F that is not of rank two.
    """
    left, right = _matches(left, right)
    T_left, T_right = isotropic_normaliser(left), isotropic_normaliser(right)
    start = np.linalg.inv(T_right).T @ np.asarray(F, dtype=np.float64) @ np.linalg.inv(T_left)
    U, s, Vt = np.linalg.svd(start)
    if not (np.isfinite(s).all() and s[1] > 1e-12 * s[0]):
        raise GeometryError("degenerate", f"F has singular values {s.tolist()}; it must be of rank two", singular=s)
    x, y = to_homogeneous(from_pixels(T_left, left)), to_homogeneous(from_pixels(T_right, right))
    u, v = x @ Vt.T, y @ U  # F becomes diag(s₁, s₂, 0) in these coordinates
    lines = (T_left[:2, :2] @ Vt.T[:2], T_right[:2, :2] @ U[:2])  # rows of line normals, back to pixels
    core = s[:2] / np.linalg.norm(s[:2])
    tangent = np.array([[-core[1], 0, 0, core[0]], [0, 1, 0, 0], [0, 0, 1, 0]]).reshape(3, 2, 2)
    weights = 1.0 / np.broadcast_to(np.asarray(sigma, dtype=np.float64), len(left))

    def parts(z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        B = np.diag(core) + np.tensordot(z[:3], tangent, 1)
        return np.vstack([np.eye(2), z[3:5]]), B, np.column_stack([np.eye(2), z[5:7]])

    def residuals(z: FloatArray) -> FloatArray:
        p, B, q = parts(z)
        value, _, _, length = _sampson_parts(p @ B @ q, u, v, lines)
        result: FloatArray = value / length * weights
        return result

    def jacobian(z: FloatArray) -> FloatArray:
        p, B, q = parts(z)
        D = np.empty((7, 3, 3))
        D[:3] = p @ tangent @ q
        for i in range(2):
            D[3 + i] = 0.0
            D[3 + i, 2] = B[i] @ q
            D[5 + i] = 0.0
            D[5 + i, :, 2] = p @ B[:, i]
        value, on_right, on_left, length = _sampson_parts(p @ B @ q, u, v, lines)
        # d(value/length): value is linear in the matrix, length² a sum of squares of line normals in
        # pixels.
        d_value = _products(v, u) @ D.reshape(7, 9).T
        d_square = _products(on_right, u) @ (lines[1] @ D).reshape(7, 6).T
        d_square += _products(v, on_left) @ (D @ lines[0].T).reshape(7, 6).T
        result: FloatArray = (d_value / length[:, None] - (value / length**3)[:, None] * d_square) * weights[:, None]
        return result

    options: dict[str, Any] = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": 200}
    fit = least_squares(residuals, np.zeros(7), jac=jacobian, method="trf", loss=loss, **options)
    p, B, q = parts(fit.x)
    return _unit(T_right.T @ U @ p @ B @ q @ Vt @ T_left)


def _products(a: FloatArray, b: FloatArray) -> FloatArray:
    """Products (n, i j) of the entries of each row of ``a`` (n, i) with those of ``b`` (n, j)."""
    return (a[:, :, None] * b[:, None, :]).reshape(len(a), -1)


def _sampson_parts(
    G: FloatArray, u: FloatArray, v: FloatArray, lines: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """``vᵀGu`` (n,), the epipolar lines' normals in pixels in the right and left image (n, 2), their joint
    length.
    """
    Gu, Gv = u @ G.T, v @ G
    on_right, on_left = Gu @ lines[1].T, Gv @ lines[0].T
    length = np.sqrt((on_right**2).sum(axis=1) + (on_left**2).sum(axis=1))
    return (v * Gu).sum(axis=1), on_right, on_left, length


def sampson_distances(F: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Signed first-order distances ``(n,)`` [px] of matches ``(n, 2)`` to the epipolar constraint; NaN is kept."""
    x, y = to_homogeneous(left), to_homogeneous(right)
    value, _, _, length = _sampson_parts(F, x, y, (np.eye(2, 3), np.eye(2, 3)))
    distances: FloatArray = value / length
    return distances


def epipolar_distances(F: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Distances ``(n, 2)`` [px] of the left and right pixel of each match to its epipolar line; NaN is kept."""
    x, y = to_homogeneous(left), to_homogeneous(right)
    on_right, on_left = x @ F.T, y @ F
    value = np.abs((y * on_right).sum(axis=1))
    lengths = np.stack([np.linalg.norm(on_left[:, :2], axis=1), np.linalg.norm(on_right[:, :2], axis=1)], axis=1)
    distances: FloatArray = value[:, None] / lengths
    return distances


ROUNDING_PX = 1e-8
"""Residual [px] below which there is only rounding error."""


def parallax_ratio(F: FloatArray, left: FloatArray, right: FloatArray) -> float:
    """Variance ratio of the residuals of one homography to those of ``F``, for matches (n, 2) [px].

    About 1 if the points lie on one plane or the cameras share a centre; each with its own degrees of freedom.
    Infinite if no homography is found.
    """
    left, right = _matches(left, right)
    H, _ = cv2.findHomography(left, right, 0)
    if H is None:
        return float("inf")
    mapped = to_homogeneous(left) @ np.asarray(H).T
    transfer = right - mapped[:, :2] / mapped[:, 2:]
    # A transfer error includes the left image's noise, stretched by the map.
    of_plane = (transfer**2).sum() / (2 * len(left) - 8) / (1.0 + abs(np.linalg.det(H[:2, :2])))
    of_pair = (sampson_distances(F, left, right) ** 2).sum() / max(1, len(left) - 7)
    # Two copies of one image leave rounding errors, whose ratio is meaningless.
    return float(of_plane / max(of_pair, ROUNDING_PX**2))


def _refuse_plane(left: FloatArray, right: FloatArray, sigma_px: float) -> None:
    """Raise GeometryError if a homography explains the matches to their noise."""
    H, _ = cv2.findHomography(left, right, 0)
    if H is None:
        return
    mapped = to_homogeneous(left) @ np.asarray(H).T
    if not (np.abs(mapped[:, 2]) > 1e-9).all():
        return
    transfer = right - mapped[:, :2] / mapped[:, 2:]
    rms = float(np.sqrt(np.median((transfer**2).sum(axis=1)) / 2))
    # Transfer errors include both images' noise, about √2 sigma, times the map's stretch.
    stretch = np.sqrt(abs(np.linalg.det(H[:2, :2]))) if abs(H[2, 2]) > 0 else 1.0
    limit = 3.0 * sigma_px * float(np.hypot(1.0, stretch))
    if rms < limit:
        raise GeometryError(
            "degenerate",
            f"the matches lie on one plane (a homography fits to {rms:.3g} px, noise is {sigma_px:.3g} px); "
            "points off one plane are needed",
            rms_px=rms,
            limit_px=limit,
        )


def _matches(left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    left, right = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    if left.ndim != 2 or left.shape[1:] != (2,) or left.shape != right.shape:
        raise GeometryError("shape", f"matches have shapes {left.shape} and {right.shape}; both must be (n, 2)")
    if not (np.isfinite(left).all() and np.isfinite(right).all()):
        bad = np.flatnonzero(~(np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1))).tolist()
        raise GeometryError("not_finite", f"match(es) {bad} are not finite; leave missing ones out", matches=bad)
    if len(left) < MIN_MATCHES:
        raise GeometryError("too_few", f"{len(left)} matches; at least {MIN_MATCHES} are needed", matches=len(left))
    return left, right


def _rank_two(F: FloatArray) -> FloatArray:
    U, s, Vt = np.linalg.svd(F)
    nearest: FloatArray = (U[:, :2] * s[:2]) @ Vt[:2]
    return nearest


def _unit(F: FloatArray) -> FloatArray:
    """``F`` with unit Frobenius norm and its largest entry positive, so that its representation is unique."""
    unit: FloatArray = F / (np.linalg.norm(F) * np.sign(F.flat[np.argmax(np.abs(F))]))
    return unit
