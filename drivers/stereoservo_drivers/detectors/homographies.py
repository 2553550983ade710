"""Homographies of planar dot patterns: fit, image of a circle, outlier test. Numba kernels; no state.

Pattern coordinates are those of :class:`~stereoservo.ports.dot_plates.DotFace` in units of half its
corner distance. A face seen from in front has a homography of positive determinant and positive depths; a
mirrored pattern has not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.compilation import kernel

ODD_NOISE, ODD_REST = 25.0, 70.0
SINGULAR = 1e-11
"""Pivot below which normal equations count as singular."""


@kernel
def lower_root(A):
    """Cholesky factor L of a symmetric A = L Lᵀ, in place in its lower triangle. False if A is singular."""
    n = A.shape[0]
    for j in range(n):
        scale = 0.0
        for i in range(j, n):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i == j:
                if total < SINGULAR:
                    return False
                A[j, j] = np.sqrt(total)
                scale = 1.0 / A[j, j]
            else:
                A[i, j] = total * scale
    return True


class Normal(NamedTuple):
    """Normal equations of a homography's linear residuals, [[B, 0, C], [0, B, D], [Cᵀ, Dᵀ, E]] h = (a, b, c), reduced
    by B = L Lᵀ: ``root`` L (6, by rows), ``kx`` L⁻¹C and ``ky`` L⁻¹D (6, by rows), ``ux`` L⁻¹a, ``uy`` L⁻¹b (3),
    Schur's complement ``s`` (3) of E and its right-hand side ``g`` (2). ``solvable``: all positive definite.
    """

    solvable: bool
    root: tuple[float, float, float, float, float, float]
    kx: tuple[float, float, float, float, float, float]
    ky: tuple[float, float, float, float, float, float]
    ux: tuple[float, float, float]
    uy: tuple[float, float, float]
    s: tuple[float, float, float]
    g: tuple[float, float]


@kernel
def _forward(root, a, b, c):
    """L⁻¹ times a column."""
    x = a / root[0]
    y = (b - root[1] * x) / root[2]
    return x, y, (c - root[3] * x - root[4] * y) / root[5]


@kernel
def _backward(root, a, b, c):
    """L⁻ᵀ times a column."""
    z = c / root[5]
    y = (b - root[4] * z) / root[2]
    return (a - root[1] * y - root[3] * z) / root[0], y, z


@kernel
def _normal(pattern, pixels, used, frame, h):
    """The normal equations at depths of ``h`` (8,); ``frame`` (3,) = centroid and scale of the pixels."""
    zero2, zero3, zero6 = (0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    none = Normal(False, zero6, zero6, zero6, zero3, zero3, zero3, zero2)
    n = nx = ny = nxx = nxy = nyy = 0.0
    u = ux = uy = uxx = uxy = uyy = 0.0
    v = vx = vy = vxx = vxy = vyy = 0.0
    rx = ry = rxx = rxy = ryy = 0.0
    for i in range(used.size):
        if not used[i]:
            continue
        x, y = pattern[i, 0], pattern[i, 1]
        depth = h[6] * x + h[7] * y + 1.0
        if depth < 1e-3:
            return none
        tu, tv = (pixels[i, 0] - frame[0]) / frame[2], (pixels[i, 1] - frame[1]) / frame[2]
        w = 1.0 / (depth * depth)
        wx, wy = w * x, w * y
        wxx, wxy, wyy = wx * x, wx * y, wy * y
        n, nx, ny, nxx, nxy, nyy = n + w, nx + wx, ny + wy, nxx + wxx, nxy + wxy, nyy + wyy
        u, ux, uy = u + tu * w, ux + tu * wx, uy + tu * wy
        uxx, uxy, uyy = uxx + tu * wxx, uxy + tu * wxy, uyy + tu * wyy
        v, vx, vy = v + tv * w, vx + tv * wx, vy + tv * wy
        vxx, vxy, vyy = vxx + tv * wxx, vxy + tv * wxy, vyy + tv * wyy
        r = tu * tu + tv * tv
        rx, ry = rx + r * wx, ry + r * wy
        rxx, rxy, ryy = rxx + r * wxx, rxy + r * wxy, ryy + r * wyy
    if nxx < SINGULAR:
        return none
    l00 = np.sqrt(nxx)
    l10, l20 = nxy / l00, nx / l00
    d1 = nyy - l10 * l10
    if d1 < SINGULAR:
        return none
    l11 = np.sqrt(d1)
    l21 = (ny - l20 * l10) / l11
    d2 = n - l20 * l20 - l21 * l21
    if d2 < SINGULAR:
        return none
    root = (l00, l10, l11, l20, l21, np.sqrt(d2))
    a0, b0, c0 = _forward(root, -uxx, -uxy, -ux)
    a1, b1, c1 = _forward(root, -uxy, -uyy, -uy)
    d0, e0, f0 = _forward(root, -vxx, -vxy, -vx)
    d1, e1, f1 = _forward(root, -vxy, -vyy, -vy)
    p, q = _forward(root, ux, uy, u), _forward(root, vx, vy, v)
    s00 = rxx - a0 * a0 - b0 * b0 - c0 * c0 - d0 * d0 - e0 * e0 - f0 * f0
    s01 = rxy - a0 * a1 - b0 * b1 - c0 * c1 - d0 * d1 - e0 * e1 - f0 * f1
    s11 = ryy - a1 * a1 - b1 * b1 - c1 * c1 - d1 * d1 - e1 * e1 - f1 * f1
    if s00 < SINGULAR or s11 - s01 * s01 / s00 < SINGULAR:
        return none
    g0 = -rx - a0 * p[0] - b0 * p[1] - c0 * p[2] - d0 * q[0] - e0 * q[1] - f0 * q[2]
    g1 = -ry - a1 * p[0] - b1 * p[1] - c1 * p[2] - d1 * q[0] - e1 * q[1] - f1 * q[2]
    return Normal(True, root, (a0, a1, b0, b1, c0, c1), (d0, d1, e0, e1, f0, f1), p, q, (s00, s01, s11), (g0, g1))


@kernel
def _solution(normal, h):
    """Solve the normal equations into ``h`` (8,)."""
    s, kx, ky, ux, uy = normal.s, normal.kx, normal.ky, normal.ux, normal.uy
    det = s[0] * s[2] - s[1] * s[1]
    g0 = (s[2] * normal.g[0] - s[1] * normal.g[1]) / det
    g1 = (s[0] * normal.g[1] - s[1] * normal.g[0]) / det
    h[0], h[1], h[2] = _backward(
        normal.root, ux[0] - kx[0] * g0 - kx[1] * g1, ux[1] - kx[2] * g0 - kx[3] * g1, ux[2] - kx[4] * g0 - kx[5] * g1
    )
    h[3], h[4], h[5] = _backward(
        normal.root, uy[0] - ky[0] * g0 - ky[1] * g1, uy[1] - ky[2] * g0 - ky[3] * g1, uy[2] - ky[4] * g0 - ky[5] * g1
    )
    h[6], h[7] = g0, g1


@kernel
def _fit(pattern, pixels, used, frame, h):
    """Homography in normalised pixels into ``h`` (8,). False if it is undetermined or depths are not positive."""
    n = 0
    frame[:] = 0.0
    for i in range(used.size):
        if used[i]:
            n += 1
            frame[0] += pixels[i, 0]
            frame[1] += pixels[i, 1]
    if n < 4:
        return False
    frame[0] /= n
    frame[1] /= n
    for i in range(used.size):
        if used[i]:
            frame[2] += (pixels[i, 0] - frame[0]) ** 2 + (pixels[i, 1] - frame[1]) ** 2
    frame[2] = np.sqrt(frame[2] / n)
    if frame[2] < 1e-6:
        return False
    h[:] = 0.0
    for _ in range(1 if n == 4 else 3):
        normal = _normal(pattern, pixels, used, frame, h)
        if not normal.solvable:
            return False
        _solution(normal, h)
    nearest = 1.0
    for i in range(used.size):
        nearest = min(nearest, h[6] * pattern[i, 0] + h[7] * pattern[i, 1] + 1.0)
    return nearest > 1e-3


@kernel
def _in_pixels(frame, h, H):
    for j in range(2):
        H[j, 0] = frame[2] * h[3 * j] + frame[j] * h[6]
        H[j, 1] = frame[2] * h[3 * j + 1] + frame[j] * h[7]
        H[j, 2] = frame[2] * h[3 * j + 2] + frame[j]
    H[2, 0] = h[6]
    H[2, 1] = h[7]
    H[2, 2] = 1.0


@kernel
def fit_homography(pattern, pixels, used, H):
    """Least-squares homography (3, 3) of pattern (n, 2) to pixels (n, 2) [px] over the rows ``used`` (n,), into ``H``.

    Scaled to H[2, 2] = 1. Algebraic residuals reweighted by depth, so that the minimum is that of the pixel residuals
    to first order. Returns False if fewer than four rows are used, they are degenerate or depths are not positive.
    """
    frame, h = np.zeros(3), np.zeros(8)
    if not _fit(pattern, pixels, used, frame, h):
        return False
    _in_pixels(frame, h, H)
    return True


@kernel
def image_of_circle(H, x, y, radius, out):
    """Image of a circle: ``out`` = (u, v) of its centre's image, (du, dv) from there to the ellipse's centre, ellipse
    area [px²], larger and smaller half axis [px]. Returns False if it is not an ellipse seen from the front.
    """
    w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    if w <= 0.0:
        return False
    u = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
    v = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
    # dual conic of the picture, D = H (r² diag(1, 1, 0) - p pᵀ) Hᵀ
    r2 = radius * radius
    d33 = r2 * (H[2, 0] ** 2 + H[2, 1] ** 2) - w * w
    if d33 >= 0.0:
        return False
    d13 = r2 * (H[0, 0] * H[2, 0] + H[0, 1] * H[2, 1]) - u * w * w
    d23 = r2 * (H[1, 0] * H[2, 0] + H[1, 1] * H[2, 1]) - v * w * w
    j11 = (H[0, 0] - u * H[2, 0]) / w
    j12 = (H[0, 1] - u * H[2, 1]) / w
    j21 = (H[1, 0] - v * H[2, 0]) / w
    j22 = (H[1, 1] - v * H[2, 1]) / w
    det = j11 * j22 - j12 * j21
    if det <= 0.0:
        return False
    out[0] = u
    out[1] = v
    out[2] = d13 / d33 - u
    out[3] = d23 / d33 - v
    out[4] = np.pi * r2 * det
    total = j11 * j11 + j12 * j12 + j21 * j21 + j22 * j22
    root = np.sqrt(max(total * total - 4.0 * det * det, 0.0))
    out[5] = radius * np.sqrt(0.5 * (total + root))
    out[6] = radius * det / np.sqrt(0.5 * (total + root))
    return True


@kernel
def misfits(pattern, pixels, used, H, out):
    """Distances (n,) [px] between pixels and projected pattern; 0 where not used. Returns the largest."""
    worst = 0.0
    for i in range(used.size):
        out[i] = 0.0
        if used[i]:
            x, y = pattern[i, 0], pattern[i, 1]
            w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            du = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w - pixels[i, 0]
            dv = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w - pixels[i, 1]
            out[i] = np.sqrt(du * du + dv * dv)
            worst = max(worst, out[i])
    return worst


@kernel
def _leave_one_out(pattern, pixels, used, frame, h, out):
    """Leave-one-out residual of each dot: ``out`` (n, 3) = its distance from the homography of the others [px], the
    smallest root of I - L, its squared studentised residual [px²].

    A dot's distance, to first order, is |(I - L)⁻¹ e|, e its residual and L (2, 2) its leverage; a homography bends to
    a single bad dot, so that e alone may hide most of its error. Rows are 0 if the others do not determine a dot (five
    dots, three of them collinear). Returns False if the fit is degenerate.
    """
    normal = _normal(pattern, pixels, used, frame, h)
    out[:] = 0.0
    if not normal.solvable:
        return False
    kx, ky = normal.kx, normal.ky
    s00, s01, s11 = normal.s
    whole = s00 * s11 - s01 * s01
    for i in range(used.size):
        if not used[i]:
            continue
        x, y = pattern[i, 0], pattern[i, 1]
        depth = h[6] * x + h[7] * y + 1.0
        tu, tv = (pixels[i, 0] - frame[0]) / frame[2], (pixels[i, 1] - frame[1]) / frame[2]
        eu = tu - (h[0] * x + h[1] * y + h[2]) / depth
        ev = tv - (h[3] * x + h[4] * y + h[5]) / depth
        # the leverage of the two rows, by the same reduction
        p, q, r = _forward(normal.root, x / depth, y / depth, 1.0 / depth)
        u0 = -tu * x / depth - kx[0] * p - kx[2] * q - kx[4] * r
        u1 = -tu * y / depth - kx[1] * p - kx[3] * q - kx[5] * r
        v0 = -tv * x / depth - ky[0] * p - ky[2] * q - ky[4] * r
        v1 = -tv * y / depth - ky[1] * p - ky[3] * q - ky[5] * r
        own = 1.0 - p * p - q * q - r * r
        m11 = own - (s11 * u0 * u0 - 2.0 * s01 * u0 * u1 + s00 * u1 * u1) / whole
        m12 = -(s11 * u0 * v0 - s01 * (u0 * v1 + u1 * v0) + s00 * u1 * v1) / whole
        m22 = own - (s11 * v0 * v0 - 2.0 * s01 * v0 * v1 + s00 * v1 * v1) / whole
        det = m11 * m22 - m12 * m12
        least = 0.5 * (m11 + m22) - np.sqrt(0.25 * (m11 - m22) ** 2 + m12 * m12)
        if least < 1e-6 or det <= 0.0:
            continue
        a = frame[2] * (m22 * eu - m12 * ev) / det
        c = frame[2] * (m11 * ev - m12 * eu) / det
        out[i, 0] = np.sqrt(a * a + c * c)
        out[i, 1] = least
        out[i, 2] = (a * eu + c * ev) * frame[2]
    return True


@kernel
def outlier_dot(pattern, pixels, used, sigma, out):
    """The dot whose residual exceeds noise and the others' misfit, -1 if there is none; of six or more.

    ``sigma`` [px] of a dot; ``out`` (n, 3) as :func:`_left_out` writes it. The limits are ODD_NOISE variances of noise
    and ODD_REST times the others' misfit beyond noise (F of 2 and 4 degrees of freedom, 0.9998).
    """
    frame, h = np.zeros(3), np.zeros(8)
    n = 0
    for i in range(used.size):
        n += 1 if used[i] else 0
    if n < 6 or not _fit(pattern, pixels, used, frame, h):
        return -1
    if not _leave_one_out(pattern, pixels, used, frame, h, out):
        return -1
    total = 0.0
    for i in range(used.size):
        if used[i]:
            depth = h[6] * pattern[i, 0] + h[7] * pattern[i, 1] + 1.0
            for axis in range(2):
                at = h[3 * axis] * pattern[i, 0] + h[3 * axis + 1] * pattern[i, 1] + h[3 * axis + 2]
                total += (pixels[i, axis] - frame[axis] - frame[2] * at / depth) ** 2
    worst, largest = -1, 1.0
    for i in range(used.size):
        if used[i] and out[i, 1] > 0.0:
            rest = max(total - out[i, 2], 0.0) / (2 * n - 10)
            limit = ODD_NOISE * sigma * sigma + ODD_REST * max(rest - sigma * sigma, 0.0)
            if out[i, 2] > largest * limit:
                largest = out[i, 2] / limit
                worst = i
    return worst


class OutlierGates(NamedTuple):
    """Limits of a dot's distance from its prediction by the others: ``tolerance`` [px], and in addition that allowed by
    a dot's standard deviation ``sigma`` [px]; ``least`` dots must remain.
    """

    tolerance: float
    sigma: float
    least: int


@kernel
def _worst_outlier(pattern, pixels, used, frame, h, gates):
    """The dot with the largest leave-one-out residual, -1 if all are within tolerance.

    The limit is the tolerance plus five standard deviations, of sigma times the largest root of (I - L)⁻¹. Of the dots
    beyond it, the one with the largest studentised residual is returned. -2 if the fit is degenerate.
    """
    tolerance, sigma, _ = gates
    out = np.zeros((used.size, 3))
    if not _leave_one_out(pattern, pixels, used, frame, h, out):
        return -2
    worst = -1
    largest = 0.0
    for i in range(used.size):
        far = used[i] and out[i, 1] > 0.0 and out[i, 0] > tolerance + 5.0 * sigma / np.sqrt(out[i, 1])
        if far and out[i, 2] > largest:
            largest = out[i, 2]
            worst = i
    return worst


@kernel
def reject_outliers(pattern, pixels, used, gates, H):
    """Clear rows of ``used`` until each remaining dot is as near to its prediction by the others as the `OutlierGates`
    require.

    Returns False if fewer than their least dots would remain; with five dots left the wrong one cannot be identified,
    so that it must be at least 5. Writes the homography to ``H``.
    """
    frame, h = np.zeros(3), np.zeros(8)
    count = 0
    for i in range(used.size):
        count += 1 if used[i] else 0
    while count >= gates.least:
        if not _fit(pattern, pixels, used, frame, h):
            return False
        worst = _worst_outlier(pattern, pixels, used, frame, h, gates)
        if worst == -1:
            _in_pixels(frame, h, H)
            return True
        if worst == -2:
            return False
        used[worst] = False
        count -= 1
    return False


@kernel
def inverse_of(M, out):
    """Inverse of ``M`` (9,), a 3x3 matrix row by row, with last entry 1, into ``out`` (9,); False: there is none."""
    out[0] = M[4] * M[8] - M[5] * M[7]
    out[1] = M[2] * M[7] - M[1] * M[8]
    out[2] = M[1] * M[5] - M[2] * M[4]
    out[3] = M[5] * M[6] - M[3] * M[8]
    out[4] = M[0] * M[8] - M[2] * M[6]
    out[5] = M[2] * M[3] - M[0] * M[5]
    out[6] = M[3] * M[7] - M[4] * M[6]
    out[7] = M[1] * M[6] - M[0] * M[7]
    last = M[0] * M[4] - M[1] * M[3]
    if not abs(last) > 1e-12:
        return False
    for k in range(8):
        out[k] /= last
    out[8] = 1.0
    return True


@kernel
def square_to_quad(quad, out):
    """Homography (9,) from the unit square to ``quad`` (4, 2) with its corners in order, last entry 1; False: none."""
    d1u, d1v = quad[1, 0] - quad[2, 0], quad[1, 1] - quad[2, 1]
    d2u, d2v = quad[3, 0] - quad[2, 0], quad[3, 1] - quad[2, 1]
    su = quad[0, 0] - quad[1, 0] + quad[2, 0] - quad[3, 0]
    sv = quad[0, 1] - quad[1, 1] + quad[2, 1] - quad[3, 1]
    determinant = d1u * d2v - d2u * d1v
    if not abs(determinant) > 1e-12:
        return False
    g, h = (su * d2v - d2u * sv) / determinant, (d1u * sv - su * d1v) / determinant
    out[0] = quad[1, 0] - quad[0, 0] + g * quad[1, 0]
    out[1] = quad[3, 0] - quad[0, 0] + h * quad[3, 0]
    out[2] = quad[0, 0]
    out[3] = quad[1, 1] - quad[0, 1] + g * quad[1, 1]
    out[4] = quad[3, 1] - quad[0, 1] + h * quad[3, 1]
    out[5] = quad[0, 1]
    out[6], out[7], out[8] = g, h, 1.0
    return True
