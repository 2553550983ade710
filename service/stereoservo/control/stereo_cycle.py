"""Numba kernels of a complete stereo servoing step, from joints and pixels to joint velocities: forward kinematics,
triangulation, image Jacobian, damped least squares.

In `stereo_cycle` the arithmetic is that of `chain_forward`, `triangulate` and `image_step`, but no operator is ever
formed: a joint's velocity of a point is ``H̄_{j−1} Ĥ_j (exp_j … exp_n M₀)``, vectors instead of matrices.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.kinematics.kernels import Chain, invert4, transform_points_into, triangulate_into
from stereoservo.numerics.arrays import FloatArray, KindArray
from stereoservo.numerics.compilation import Fields, kernel
from stereoservo.numerics.linear import add_pixel_equations, damped_solve

DAMPING = 1e-6
"""Default damping, relative to the largest diagonal element of the normal matrix."""


class StereoArm(NamedTuple):
    """An arm in front of cameras: its ``chain``, whose generators have the ``squares`` (n, 4, 4); cameras ``matrices``
    (c, 3, 4), and marker ``points`` (m, 4) at the chain's zero.
    """

    chain: Chain
    squares: FloatArray
    matrices: FloatArray
    points: FloatArray


class Factors(NamedTuple):
    """Factors of a chain of ``generators`` (n, 4, 4) at some joints: its ``exponentials`` (n, 4, 4) in the order of the
    chain, and the product of those to the left of each, ``before`` (n + 1, 4, 4), H̄; ``tip_first`` as in `Chain`.
    """

    generators: FloatArray
    tip_first: bool
    exponentials: FloatArray
    before: FloatArray


class PlacedPoints(NamedTuple):
    """Current points (m, 4) ``now``, and the same points at the chain's zero, ``at_zero``."""

    now: FloatArray
    at_zero: FloatArray


class PointRows(NamedTuple):
    """Jacobian of one point in c cameras: ``rows`` ``J_G P Ĥ_j|_Q M`` (c, 2, n), and ``gradients`` (c,
    2, 4) ``J_G P``.
    """

    rows: FloatArray
    gradients: FloatArray


class Sighted(NamedTuple):
    """Observations of m markers in c cameras: ``pixels`` and ``set_points`` (c, m, 2), ``weights`` (c, m) = 1/sigma
    [1/px].
    """

    pixels: FloatArray
    set_points: FloatArray
    weights: FloatArray


class CycleOptions(NamedTuple):
    """``gain`` [1/s]; ``damping`` relative to the largest diagonal element; ``mean``: whether the Jacobian is the mean
    of the current one and that at the goal; ``triangulations``: number of renormalised iterations, -1: the points are
    those of the joints.
    """

    gain: float
    damping: float
    mean: bool
    triangulations: int


@kernel
def _factors_into(chain: Chain, squares: FloatArray, q: FloatArray, factors: Factors) -> None:
    """Compute the factors of a chain at ``q`` (n,); ``squares`` (n, 4, 4) of its generators."""
    generators, kinds, zero, tip_first = chain
    _, _, E, B = factors
    n = q.shape[0]
    for i in range(4):
        for k in range(4):
            B[0, i, k] = 1.0 if i == k else 0.0
    for nth in range(n):
        j = n - 1 - nth if tip_first else nth
        step = q[j] - zero[j]
        first, second = step, 0.0
        if kinds[j] == 0:
            half = math.sin(0.5 * step)
            first, second = math.sin(step), 2.0 * half * half
        for i in range(4):
            for k in range(4):
                E[nth, i, k] = first * generators[j, i, k] + second * squares[j, i, k]
            E[nth, i, i] += 1.0
        for i in range(4):
            for k in range(4):
                B[nth + 1, i, k] = (
                    B[nth, i, 0] * E[nth, 0, k]
                    + B[nth, i, 1] * E[nth, 1, k]
                    + B[nth, i, 2] * E[nth, 2, k]
                    + B[nth, i, 3] * E[nth, 3, k]
                )


@kernel
def _add_point(
    factors: Factors, matrices: FloatArray, points: PlacedPoints, p: int, share: float, point_rows: PointRows
) -> None:
    """Add ``share`` times the rows of point ``p`` to ``point_rows``, whose gradients are scratch."""
    generators, tip_first, E, B = factors
    M, M0 = points
    rows, g = point_rows
    n, cameras = E.shape[0], matrices.shape[0]
    m0, m1, m2, m3 = M[p, 0], M[p, 1], M[p, 2], M[p, 3]
    for c in range(cameras):
        d = matrices[c, 2, 0] * m0 + matrices[c, 2, 1] * m1 + matrices[c, 2, 2] * m2 + matrices[c, 2, 3] * m3
        scale = 1.0 / d if d != 0.0 else math.nan
        for r in range(2):
            x = matrices[c, r, 0] * m0 + matrices[c, r, 1] * m1 + matrices[c, r, 2] * m2 + matrices[c, r, 3] * m3
            pixel = x * scale
            for i in range(4):
                g[c, r, i] = share * (matrices[c, r, i] - pixel * matrices[c, 2, i]) * scale
    z0, z1, z2, z3 = M0[p, 0], M0[p, 1], M0[p, 2], M0[p, 3]
    for back in range(n):
        nth = n - 1 - back
        j = back if tip_first else nth
        y0 = E[nth, 0, 0] * z0 + E[nth, 0, 1] * z1 + E[nth, 0, 2] * z2 + E[nth, 0, 3] * z3
        y1 = E[nth, 1, 0] * z0 + E[nth, 1, 1] * z1 + E[nth, 1, 2] * z2 + E[nth, 1, 3] * z3
        y2 = E[nth, 2, 0] * z0 + E[nth, 2, 1] * z1 + E[nth, 2, 2] * z2 + E[nth, 2, 3] * z3
        y3 = E[nth, 3, 0] * z0 + E[nth, 3, 1] * z1 + E[nth, 3, 2] * z2 + E[nth, 3, 3] * z3
        z0, z1, z2, z3 = y0, y1, y2, y3
        y0 = generators[j, 0, 0] * z0 + generators[j, 0, 1] * z1 + generators[j, 0, 2] * z2 + generators[j, 0, 3] * z3
        y1 = generators[j, 1, 0] * z0 + generators[j, 1, 1] * z1 + generators[j, 1, 2] * z2 + generators[j, 1, 3] * z3
        y2 = generators[j, 2, 0] * z0 + generators[j, 2, 1] * z1 + generators[j, 2, 2] * z2 + generators[j, 2, 3] * z3
        y3 = generators[j, 3, 0] * z0 + generators[j, 3, 1] * z1 + generators[j, 3, 2] * z2 + generators[j, 3, 3] * z3
        v0 = B[nth, 0, 0] * y0 + B[nth, 0, 1] * y1 + B[nth, 0, 2] * y2 + B[nth, 0, 3] * y3
        v1 = B[nth, 1, 0] * y0 + B[nth, 1, 1] * y1 + B[nth, 1, 2] * y2 + B[nth, 1, 3] * y3
        v2 = B[nth, 2, 0] * y0 + B[nth, 2, 1] * y1 + B[nth, 2, 2] * y2 + B[nth, 2, 3] * y3
        v3 = B[nth, 3, 0] * y0 + B[nth, 3, 1] * y1 + B[nth, 3, 2] * y2 + B[nth, 3, 3] * y3
        for c in range(cameras):
            rows[c, 0, j] += g[c, 0, 0] * v0 + g[c, 0, 1] * v1 + g[c, 0, 2] * v2 + g[c, 0, 3] * v3
            rows[c, 1, j] += g[c, 1, 0] * v0 + g[c, 1, 1] * v1 + g[c, 1, 2] * v2 + g[c, 1, 3] * v3


@kernel
def stereo_cycle(
    arm: Fields,
    q: FloatArray,
    target_points: FloatArray,
    sighted: Fields,
    options: Fields,
    velocity: FloatArray,
) -> float:
    """`StereoCycle.step` into ``velocity`` (n,); returns the conditioning.

    The fields of a `StereoArm`, with those of its chain, of a `Sighted` and of `CycleOptions`; ``target_points``
    (m, 4).
    """
    chain, squares, matrices, marker_points = StereoArm(*arm)
    pixels, set_points, weights = Sighted(*sighted)
    gain, damping, mean, triangulations = CycleOptions(*options)
    n, cameras, markers = q.shape[0], matrices.shape[0], marker_points.shape[0]
    generators, kinds, zero, tip_first = chain
    E, B = np.empty((n, 4, 4)), np.empty((n + 1, 4, 4))
    factors = Factors(generators, tip_first, E, B)
    _factors_into(Chain(generators, kinds, zero, tip_first), squares, q, factors)
    M, M0 = np.empty((markers, 4)), marker_points
    transform_points_into(B[n], marker_points, M)
    back = B[n]
    if triangulations >= 0 or mean:
        back = invert4(B[n])
    if triangulations >= 0:
        found, ok = np.empty((markers, 4)), np.empty(markers, dtype=np.bool_)
        triangulate_into(matrices, pixels, weights, triangulations, found, ok)
        M0 = np.empty((markers, 4))
        for p in range(markers):
            if ok[p]:
                for i in range(4):
                    M[p, i] = found[p, i]
        transform_points_into(back, M, M0)
    T0 = M0
    if mean:
        T0 = np.empty((markers, 4))
        transform_points_into(back, target_points, T0)
    N, b = np.zeros((n, n)), np.zeros(n)
    rows = np.empty((cameras, 2, n))
    point_rows = PointRows(rows, np.empty((cameras, 2, 4)))
    for p in range(markers):
        seen = False
        for c in range(cameras):
            seen = seen or weights[c, p] > 0.0
            for j in range(n):
                rows[c, 0, j] = 0.0
                rows[c, 1, j] = 0.0
        if not seen:
            continue
        _add_point(factors, matrices, PlacedPoints(M, M0), p, 0.5 if mean else 1.0, point_rows)
        if mean:
            _add_point(factors, matrices, PlacedPoints(target_points, T0), p, 0.5, point_rows)
        for c in range(cameras):
            w = weights[c, p]
            if not w > 0.0:
                continue
            u = set_points[c, p, 0] - pixels[c, p, 0]
            v = set_points[c, p, 1] - pixels[c, p, 1]
            add_pixel_equations(rows[c], u, v, w * w, N, b)
    conditioning = damped_solve(N, b, damping, velocity)
    for i in range(n):
        velocity[i] *= gain
    return conditioning


@kernel
def stereo_step(
    jacobian: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    weights: FloatArray,
    gain: float,
    damping: float,
) -> tuple[FloatArray, float, float]:
    """The stereo law from a Jacobian, as a kernel: joint velocity (n,), largest pixel error [px], conditioning."""
    cameras, points, _, n = jacobian.shape
    N = np.zeros((n, n))
    b = np.zeros(n)
    x = np.zeros(n)
    worst = 0.0
    for c in range(cameras):
        for p in range(points):
            w = weights[c, p]
            if w == 0.0:
                continue
            du = pixels[c, p, 0] - set_points[c, p, 0]
            dv = pixels[c, p, 1] - set_points[c, p, 1]
            worst = max(worst, math.sqrt(du * du + dv * dv))
            add_pixel_equations(jacobian[c, p], du, dv, w * w, N, b)
    conditioning = damped_solve(N, b, damping, x)
    for i in range(n):
        x[i] *= -gain
    return x, worst, conditioning


class StereoCycle:
    """Joints and pixels to joint velocities in one call: kinematics (5.21), points, Jacobian, damped solve (8.36).

    ``generators`` (n, 4, 4) with ``zero`` (n,), ``kinds`` (n,) 0 revolute or 1 prismatic, ``tip_first`` as in
    `ProjectiveChain`; ``matrices`` (c, 3, 4); ``marker_points`` (m, 4) at the zero. Fixed for the life of the object.
    """

    def __init__(
        self,
        generators: FloatArray,
        kinds: KindArray,
        zero: FloatArray,
        matrices: FloatArray,
        marker_points: FloatArray,
        tip_first: bool = False,
    ) -> None:
        chain = (np.ascontiguousarray(generators), kinds, zero, tip_first)
        squares = np.ascontiguousarray(generators @ generators)
        self._points = np.ascontiguousarray(marker_points)
        self._arm = (chain, squares, np.ascontiguousarray(matrices), self._points)

    def step(
        self,
        q: FloatArray,
        pixels: FloatArray,
        set_points: FloatArray,
        weights: FloatArray,
        gain: float,
        damping: float = DAMPING,
        *,
        target_points: FloatArray | None = None,
        triangulations: int = -1,
    ) -> tuple[FloatArray, float]:
        """Velocity (n,) [rad/s or m/s] and conditioning at joints ``q`` (n,); the other arguments as in `stereo_step`.

        Points are those of the joints (8.35), or, with ``triangulations`` >= 0 renormalised iterations, triangulated
        (8.34) if two cameras see them. With ``target_points`` (m, 4) the Jacobian is the mean of the current one and
        that at the goal.
        """
        velocity = np.empty(len(q))
        mean = target_points is not None
        targets = target_points if target_points is not None else self._points
        sighted, options = (pixels, set_points, weights), (gain, damping, mean, triangulations)
        return velocity, stereo_cycle(self._arm, q, targets, sighted, options, velocity)
