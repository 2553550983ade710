"""Optimal triangulation from two images: the exact least reprojection error by Hartley and Sturm's polynomial.

The pair of pixels nearest to the measured one that meets the epipolar constraint is found among the roots of a
polynomial of degree six, so that no local minimum is missed: the reference for
`stereoservo.geometry.cameras.triangulate`, which descends to the same minimum from a linear start.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.cameras import (
    DEFINITENESS,
    camera_centre,
    check_views,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.lines import cross_matrix
from stereoservo.numerics.arrays import FloatArray


def fundamental_of_cameras(P: FloatArray, P_right: FloatArray) -> FloatArray:
    """``F`` (3, 3) of unit norm with ``m'ᵀ F m = 0`` for cameras ``(3, 4)``: ``[e']ₓ P' P⁺`` (2.10, corrected).

    Raises GeometryError where the two centres are one.
    """
    epipole = P_right @ camera_centre(P)
    size = float(np.linalg.norm(P_right) * np.linalg.norm(camera_centre(P)))
    if not float(np.linalg.norm(epipole)) > 1e-12 * size:
        raise GeometryError("degenerate", "the two cameras have one centre; there is no epipolar geometry")
    F: FloatArray = cross_matrix(epipole) @ P_right @ np.linalg.pinv(P)
    return F / np.linalg.norm(F)


def optimal_pixels(F: FloatArray, pixels: FloatArray, sigmas: FloatArray | float = 1.0) -> FloatArray:
    """Pixels ``(2, n, 2)`` [px] nearest to measured ones ``(2, n, 2)`` that meet ``m'ᵀ F m = 0`` exactly.

    Least ``|m̂ - m|²/σ² + |m̂' - m'|²/σ'²`` over all pairs, for ``sigmas`` [px] a number, (2,) per camera, or (2, n).
    NaN where a pixel is missing or lies on the epipole, through which every line is epipolar.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    if pixels.ndim != 3 or pixels.shape[::2] != (2, 2) or np.shape(F) != (3, 3):
        raise GeometryError(
            "shape",
            f"F {np.shape(F)} and pixels {pixels.shape} do not fit; (3, 3) and (2, n, 2) are needed",
            pixels=pixels.shape,
        )
    n = pixels.shape[1]
    scale = np.asarray(sigmas, dtype=np.float64)
    scale = np.broadcast_to(scale[:, None] if scale.ndim == 1 else scale, (2, n))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise GeometryError("not_finite", "sigmas must be finite and positive")
    seen = np.isfinite(pixels).all(axis=(0, 2))
    result = np.full(pixels.shape, np.nan)
    if not seen.any():
        return result
    to_pixels = [_from_measured(pixels[i, seen], scale[i, seen]) for i in range(2)]
    local = np.swapaxes(to_pixels[1], 1, 2) @ F @ to_pixels[0]  # measured pixels at the origins, unit sigmas
    turns, focals, abcd, regular = _epipoles_on_the_axis(local)
    t = _least_parameter(*abcd, *focals)
    lines = _epipolar_pair(t, *abcd, *focals)
    for i in range(2):
        line = np.einsum("nji,nj->ni", turns[i], lines[i])  # back from turned coordinates
        foot = np.stack([-line[:, 0] * line[:, 2], -line[:, 1] * line[:, 2], line[:, 0] ** 2 + line[:, 1] ** 2], axis=1)
        foot = np.einsum("nij,nj->ni", to_pixels[i], foot)
        result[i, seen] = np.where(regular[:, None], foot[:, :2] / foot[:, 2:], np.nan)
    return result


def _from_measured(pixels: FloatArray, sigmas: FloatArray) -> FloatArray:
    """``(n, 3, 3)``: coordinates about the measured pixel, in units of its sigma, to pixels."""
    maps = np.zeros((len(pixels), 3, 3))
    maps[:, 0, 0] = maps[:, 1, 1] = sigmas
    maps[:, :2, 2] = pixels
    maps[:, 2, 2] = 1.0
    return maps


def _epipoles_on_the_axis(
    F: FloatArray,
) -> tuple[list[FloatArray], list[FloatArray], tuple[FloatArray, ...], npt.NDArray[np.bool_]]:
    """Rotations ``(n, 3, 3)`` that bring the epipoles to (1, 0, f), their f, and a, b, c, d of the turned F."""
    U, _, Vt = np.linalg.svd(F)
    regular = np.ones(len(F), dtype=bool)
    turns, focals = [], []
    for epipole in (Vt[:, 2], U[:, :, 2]):
        length = np.linalg.norm(epipole[:, :2], axis=1)
        regular &= length > 1e-12 * np.abs(epipole[:, 2])
        x, y, f = (epipole / np.where(length > 0, length, 1.0)[:, None]).T
        turn = np.zeros((len(F), 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = x, y, -y, x
        turn[:, 2, 2] = 1.0
        turns.append(turn)
        focals.append(f)
    turned = turns[1] @ F @ np.swapaxes(turns[0], 1, 2)
    abcd = turned[:, 1, 1], turned[:, 1, 2], turned[:, 2, 1], turned[:, 2, 2]
    return turns, focals, abcd, regular


def _least_parameter(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, f: FloatArray, g: FloatArray
) -> FloatArray:
    """Parameter t (n,) of the epipolar line through (0, t, 1) of least distance to the origins; inf allowed.

    ``s(t) = t²/(1 + f²t²) + (ct + d)²/((at + b)² + g²(ct + d)²)``. Its derivative's numerator has degree six.
    """
    first, second = np.stack([a, b]), np.stack([c, d])
    square = _product(first, first) + g**2 * _product(second, second)
    fourth = _product(square, square)
    one = np.ones_like(f)
    widened = np.stack([f**2, 0 * one, one])
    rest = (a * d - b * c) * _product(_product(widened, widened), _product(first, second))
    polynomial = np.concatenate([np.zeros((1, len(f))), fourth, np.zeros((1, len(f)))]) - rest
    candidates = np.stack([_real_parts(column) for column in polynomial.T], axis=1)

    def distance(t: FloatArray) -> FloatArray:
        right = c * t + d
        result: FloatArray = t**2 / (1 + f**2 * t**2) + right**2 / ((a * t + b) ** 2 + g**2 * right**2)
        return result

    with np.errstate(divide="ignore", invalid="ignore"):
        values = distance(candidates)
        at_infinity = 1 / f**2 + c**2 / (a**2 + g**2 * c**2)
    values = np.where(np.isfinite(values), values, np.inf)
    best = values.argmin(axis=0)
    least = np.take_along_axis(values, best[None], axis=0)[0]
    t = np.take_along_axis(candidates, best[None], axis=0)[0]
    return np.where(at_infinity < least, np.inf, t)


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Product of polynomials ``(degree + 1, n)``, highest power first."""
    product = np.zeros((len(p) + len(q) - 1, p.shape[1]))
    for i, coefficient in enumerate(p):
        product[i : i + len(q)] += coefficient * q
    return product


def _real_parts(polynomial: FloatArray) -> FloatArray:
    """Real parts (6,) of the roots: a double root that rounding made complex is kept; 0 fills up lower degrees."""
    parts = np.zeros(6)
    scaled = polynomial / np.abs(polynomial).max() if np.any(polynomial) else polynomial
    roots = np.roots(scaled)
    parts[: len(roots)] = roots.real
    # Two steps of Newton on the polynomial: the companion matrix loses digits where roots differ much in size.
    slope = np.polyder(scaled)
    for _ in range(2):
        value, rate = np.polyval(scaled, parts), np.polyval(slope, parts)
        step = np.divide(value, rate, out=np.zeros(6), where=rate != 0)
        improved = parts - step
        better = np.abs(np.polyval(scaled, improved)) < np.abs(value)
        parts = np.where(better, improved, parts)
    return parts


def _epipolar_pair(
    t: FloatArray,
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    f: FloatArray,
    g: FloatArray,
) -> list[FloatArray]:
    """Left and right epipolar lines (n, 3), in turned coordinates, of parameter t (n,), which may be inf."""
    far = np.isinf(t)
    u, w = np.where(far, 1.0, t), np.where(far, 0.0, 1.0)  # the point (0, u, w)
    return [
        np.stack([u * f, w, -u], axis=1),
        np.stack([-g * (c * u + d * w), a * u + b * w, c * u + d * w], axis=1),
    ]


def triangulate_optimal(Ps: FloatArray, pixels: FloatArray, sigmas: FloatArray | float = 1.0) -> FloatArray:
    """Points ``(n, 4)`` of exactly least reprojection error from pixels ``(2, n, 2)`` [px], depth 1 in camera one.

    Two cameras ``(2, 3, 4)``; ``sigmas`` as for `optimal_pixels`. NaN rows where a pixel is missing or the rays do not
    determine the point. Raises GeometryError on other numbers of cameras and on cameras of one centre.
    """
    if np.shape(Ps) != (2, 3, 4):
        raise GeometryError(
            "shape",
            f"cameras have shape {np.shape(Ps)}; two are needed, more go to triangulate",
            cameras=np.shape(Ps),
        )
    return triangulate_linear(Ps, optimal_pixels(fundamental_of_cameras(*Ps), pixels, sigmas))


def triangulate_linear(Ps: FloatArray, pixels: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Points ``(n, 4)`` from pixels ``(c, n, 2)`` by the linear constraints (2.71), depth in the first
    camera 1.

    ``weights`` (c, n) [1/px] multiply the constraints. NaN rows where fewer than two cameras see a point or
    its rays are one. Raises GeometryError on shapes that do not fit.
    """
    values, w = check_views(Ps, pixels, weights)
    rows = (values[..., None] * Ps[:, None, 2:, :] - Ps[:, None, :2, :]) * w[..., None, None]
    stacked = rows.transpose(1, 0, 2, 3).reshape(values.shape[1], -1, 4)
    scale = np.abs(Ps).max()
    _, singular, v = np.linalg.svd(stacked / scale, full_matrices=True)
    M: FloatArray = v[:, 3, :]
    depth = M @ Ps[0, 2]
    good = ((w > 0).sum(axis=0) >= 2) & (depth != 0.0)
    good &= singular[:, 2] ** 2 > DEFINITENESS * singular[:, 0] ** 2
    return np.where(good[:, None], M / np.where(good, depth, np.nan)[:, None], np.nan)
