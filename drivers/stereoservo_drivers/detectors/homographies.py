"""Homographies of planar dot patterns: fit, image of a circle, outlier test. Numba kernels; no state.

Pattern coordinates are those of :class:`~stereoservo.ports.dot_plates.DotFace` in units of half its
corner distance. A face seen from in front has a homography of positive determinant and positive depths; a
mirrored pattern has not.
"""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.compilation import kernel

ODD_NOISE, ODD_REST = 25.0, 70.0


@kernel
def _solve(A, b):
    """Gaussian elimination with partial pivoting, in place; the solution is in ``b``. False if singular."""
    n = b.size
    for i in range(n):
        pivot = i
        for k in range(i + 1, n):
            if abs(A[k, i]) > abs(A[pivot, i]):
                pivot = k
        if abs(A[pivot, i]) < 1e-11:
            return False
        if pivot != i:
            for j in range(n):
                A[i, j], A[pivot, j] = A[pivot, j], A[i, j]
            b[i], b[pivot] = b[pivot], b[i]
        for k in range(i + 1, n):
            f = A[k, i] / A[i, i]
            if f != 0.0:
                for j in range(i, n):
                    A[k, j] -= f * A[i, j]
                b[k] -= f * b[i]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            b[i] -= A[i, j] * b[j]
        b[i] /= A[i, i]
    return True


@kernel
def _lower_root(A):
    """Cholesky factor L of a symmetric A = L Lᵀ, in place in its lower triangle. False if A is singular."""
    n = A.shape[0]
    for j in range(n):
        for i in range(j, n):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i == j:
                if total < 1e-11:
                    return False
                A[j, j] = np.sqrt(total)
            else:
                A[i, j] = total / A[j, j]
    return True


@kernel
def _normal_matrix(pattern, pixels, used, frame, h, A, b):
    """Normal equations of the linear residuals at depths of ``h`` (8,); ``frame`` (3,) = centroid and scale of the
    pixels.
    """
    A[:] = 0.0
    b[:] = 0.0
    row = np.zeros(8)
    for i in range(used.size):
        if not used[i]:
            continue
        depth = h[6] * pattern[i, 0] + h[7] * pattern[i, 1] + 1.0
        if depth < 1e-3:
            return False
        for axis in range(2):
            target = (pixels[i, axis] - frame[axis]) / frame[2]
            _row(pattern[i], axis, target, depth, row)
            for j in range(8):
                if row[j] != 0.0:
                    for k in range(8):
                        A[j, k] += row[j] * row[k]
                    b[j] += row[j] * target / depth
    return True


@kernel
def _row(point, axis, target, depth, row):
    row[:] = 0.0
    row[3 * axis] = point[0] / depth
    row[3 * axis + 1] = point[1] / depth
    row[3 * axis + 2] = 1.0 / depth
    row[6] = -target * point[0] / depth
    row[7] = -target * point[1] / depth


@kernel
def _fit(pattern, pixels, used, frame, h, A, b):
    """Homography in normalised pixels into ``h`` (8,). False where it is undetermined or depths are not
    positive.
    """
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
        if not _normal_matrix(pattern, pixels, used, frame, h, A, b) or not _solve(A, b):
            return False
        for j in range(8):
            h[j] = b[j]
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
    """Least-squares homography (3, 3) of pattern (n, 2) to pixels (n, 2) [px] over the rows ``used`` (n,),
    into ``H``.

    Scaled to H[2, 2] = 1. Algebraic residuals reweighted by depth, so that the minimum is that of the pixel
    residuals to first order. False where fewer than four rows are used, they are degenerate or depths are
    not positive.
    """
    frame = np.zeros(3)
    h = np.zeros(8)
    A = np.zeros((8, 8))
    b = np.zeros(8)
    if not _fit(pattern, pixels, used, frame, h, A, b):
        return False
    _in_pixels(frame, h, H)
    return True


@kernel
def image_of_circle(H, x, y, radius, out):
    """Image of a circle: ``out`` = (u, v) of its centre's image, (du, dv) from there to the ellipse's centre,
    ellipse area [px²], larger and smaller half axis [px]. False where it is not an ellipse seen from the front.
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
def _leave_one_out(pattern, pixels, used, frame, h, A, b, out):
    """Leave-one-out residual of each dot: ``out`` (n, 3) = its distance from the homography of the others [px], the
    smallest root of I - L, its squared studentised residual [px²].

    A dot's distance, to first order, is |(I - L)⁻¹ e|, e its residual and L (2, 2) its leverage; a homography bends to
    a single bad dot, so that e alone may hide most of its error. Rows of 0 where the others say nothing of a dot (five
    dots, three of them collinear). False where the fit is degenerate.
    """
    if not _normal_matrix(pattern, pixels, used, frame, h, A, b):
        return False
    out[:] = 0.0
    if not _lower_root(A):
        return False
    rows = np.zeros((2, 8))
    e = np.zeros(2)
    for i in range(used.size):
        if not used[i]:
            continue
        depth = h[6] * pattern[i, 0] + h[7] * pattern[i, 1] + 1.0
        for axis in range(2):
            target = (pixels[i, axis] - frame[axis]) / frame[2]
            _row(pattern[i], axis, target, depth, rows[axis])
            e[axis] = target / depth
            for j in range(8):
                e[axis] -= rows[axis, j] * h[j]
            # L⁻¹ row, the square of which is the leverage
            for j in range(8):
                for k in range(j):
                    rows[axis, j] -= A[j, k] * rows[axis, k]
                rows[axis, j] /= A[j, j]
        m11, m12, m22 = 1.0, 0.0, 1.0
        for j in range(8):
            m11 -= rows[0, j] * rows[0, j]
            m12 -= rows[0, j] * rows[1, j]
            m22 -= rows[1, j] * rows[1, j]
        det = m11 * m22 - m12 * m12
        least = 0.5 * (m11 + m22) - np.sqrt(0.25 * (m11 - m22) ** 2 + m12 * m12)
        if least < 1e-6 or det <= 0.0:
            continue
        a = frame[2] * (m22 * e[0] - m12 * e[1]) / det
        c = frame[2] * (m11 * e[1] - m12 * e[0]) / det
        out[i, 0] = np.sqrt(a * a + c * c)
        out[i, 1] = least
        out[i, 2] = (a * e[0] + c * e[1]) * frame[2]
    return True


@kernel
def outlier_dot(pattern, pixels, used, sigma, out):
    """The dot whose residual exceeds noise and the others' misfit, -1 if there is none; of six or more.

    ``sigma`` [px] of a dot; ``out`` (n, 3) as :func:`_left_out` writes it. Beyond ODD_NOISE variances of noise and
    ODD_REST of what the others misfit beyond noise (F of 2 and 4 degrees of freedom, 0.9998).
    """
    frame = np.zeros(3)
    h = np.zeros(8)
    A = np.zeros((8, 8))
    b = np.zeros(8)
    n = 0
    for i in range(used.size):
        n += 1 if used[i] else 0
    if n < 6 or not _fit(pattern, pixels, used, frame, h, A, b):
        return -1
    if not _leave_one_out(pattern, pixels, used, frame, h, A, b, out):
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


@kernel
def _worst_outlier(pattern, pixels, used, frame, h, A, b, tolerance, sigma):
    """The dot with the largest leave-one-out residual, -1 where all are within tolerance.

    It may be ``tolerance`` [px] and five standard deviations, of ``sigma`` [px] times the largest root of
    (I - L)⁻¹. Of the dots beyond, the one with the largest studentised residual goes. -2 where the fit is degenerate.
    """
    out = np.zeros((used.size, 3))
    if not _leave_one_out(pattern, pixels, used, frame, h, A, b, out):
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
def reject_outliers(pattern, pixels, used, tolerance, sigma, least, H):
    """Clear rows of ``used`` until each remaining dot lies within ``tolerance`` [px] of its prediction by the
    others.

    ``sigma`` [px]: standard deviation of a dot, allowed for on top. False where fewer than ``least`` dots
    would remain; with five dots left nothing tells which one is wrong, so that ``least`` must be at least
    5. ``H`` gets the homography.
    """
    frame = np.zeros(3)
    h = np.zeros(8)
    A = np.zeros((8, 8))
    b = np.zeros(8)
    count = 0
    for i in range(used.size):
        count += 1 if used[i] else 0
    while count >= least:
        if not _fit(pattern, pixels, used, frame, h, A, b):
            return False
        worst = _worst_outlier(pattern, pixels, used, frame, h, A, b, tolerance, sigma)
        if worst == -1:
            _in_pixels(frame, h, H)
            return True
        if worst == -2:
            return False
        used[worst] = False
        count -= 1
    return False
