"""Planar dot patterns under homographies: fit, check, search. Numba kernels; no state.

Pattern coordinates are those of :class:`~stereoservo_drivers.detectors.plates.DotFace` in units of half its
corner distance. A face seen from in front has a homography of positive determinant and positive depths; a
mirrored pattern has not.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo_drivers.detectors.compilation import FLOAT, INT, compile_for, given, kernel, written

FloatArray = npt.NDArray[np.float64]

CLEAR = 1.6
"""Least ratio of misfits between the second-best and the best explanation of the same dots."""


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
def _normal_matrix(pattern, pixels, used, frame, h, A, b):
    """Normal equations of the linear residuals at depths of ``h`` (8,); ``frame`` (3,) = middle and scale
    of the pixels.
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
    """The picture of a circle: ``out`` = (u, v) of its centre's image, (du, dv) from there to the ellipse's
    centre, ellipse area [px²], larger and smaller half axis [px]. False where it is not an ellipse seen
    from in front.
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
def _worst_stranger(pattern, pixels, used, frame, h, A, b, tolerance, sigma):
    """The dot that fits the others least, -1 where each lies where the others put it.

    A dot's distance from the homography of the others, to first order, is |(I - L)⁻¹ e|, e its residual and
    L (2, 2) its leverage; a homography bends to a single bad dot, so that e alone may hide most of its
    error. It may be ``tolerance`` [px] and five standard deviations, of ``sigma`` [px] times the largest root
    of (I - L)⁻¹. Of the dots beyond, the one with the largest studentised residual goes. -2 where the fit is
    degenerate.
    """
    if not _normal_matrix(pattern, pixels, used, frame, h, A, b):
        return -2
    rows = np.zeros((2, 8))
    solved = np.zeros((2, 8))
    work = np.zeros((8, 8))
    worst = -1
    largest = 0.0
    for i in range(used.size):
        if not used[i]:
            continue
        depth = h[6] * pattern[i, 0] + h[7] * pattern[i, 1] + 1.0
        e = np.zeros(2)
        for axis in range(2):
            target = (pixels[i, axis] - frame[axis]) / frame[2]
            _row(pattern[i], axis, target, depth, rows[axis])
            e[axis] = target / depth
            for j in range(8):
                e[axis] -= rows[axis, j] * h[j]
            for j in range(8):
                solved[axis, j] = rows[axis, j]
                for k in range(8):
                    work[j, k] = A[j, k]
            if not _solve(work, solved[axis]):
                return -2
        m11, m12, m22 = 1.0, 0.0, 1.0
        for j in range(8):
            m11 -= rows[0, j] * solved[0, j]
            m12 -= rows[0, j] * solved[1, j]
            m22 -= rows[1, j] * solved[1, j]
        det = m11 * m22 - m12 * m12
        least = 0.5 * (m11 + m22) - np.sqrt(0.25 * (m11 - m22) ** 2 + m12 * m12)
        if least < 1e-6 or det <= 0.0:
            # the others say nothing of this dot: five dots, three of them collinear
            continue
        a = frame[2] * (m22 * e[0] - m12 * e[1]) / det
        c = frame[2] * (m11 * e[1] - m12 * e[0]) / det
        if np.sqrt(a * a + c * c) > tolerance + 5.0 * sigma / np.sqrt(least):
            studentised = (a * e[0] + c * e[1]) * frame[2]
            if studentised > largest:
                largest = studentised
                worst = i
    return worst


@kernel
def drop_strangers(pattern, pixels, used, tolerance, sigma, least, H):
    """Clear rows of ``used`` until each remaining dot lies within ``tolerance`` [px] of where the others
    put it.

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
        worst = _worst_stranger(pattern, pixels, used, frame, h, A, b, tolerance, sigma)
        if worst == -1:
            _in_pixels(frame, h, H)
            return True
        if worst == -2:
            return False
        used[worst] = False
        count -= 1
    return False


@kernel
def _turn(a, b, c):
    """Twice the signed area of a triangle; positive when clockwise as seen (v down)."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def basis_inverse(positions: FloatArray) -> FloatArray:
    """Inverse (3, 3) of the matrix that maps the standard projective basis to four points (4, 2), scales
    included.
    """
    M = np.column_stack([positions, np.ones(4)]).T
    scaled: FloatArray = M[:, :3] * np.linalg.solve(M[:, :3], M[:, 3])
    return np.linalg.inv(scaled)


@kernel
def _hypothesis(p, q, r, s, inverse, H):
    """Homography of four pattern points (by ``inverse``) to four pixels, H[2, 2] > 0."""
    whole = _turn(p, q, r)
    a, b, c = _turn(s, q, r) / whole, _turn(p, s, r) / whole, _turn(p, q, s) / whole
    for j in range(3):
        H[0, j] = a * p[0] * inverse[0, j] + b * q[0] * inverse[1, j] + c * r[0] * inverse[2, j]
        H[1, j] = a * p[1] * inverse[0, j] + b * q[1] * inverse[1, j] + c * r[1] * inverse[2, j]
        H[2, j] = a * inverse[0, j] + b * inverse[1, j] + c * inverse[2, j]
    scale = H[2, 2]
    if abs(scale) < 1e-12:
        return False
    for i in range(3):
        for j in range(3):
            H[i, j] /= scale
    return True


@kernel
def _promising(pattern, pixels, basis, least, reach, H):
    """Whether enough dots outside the basis have something near their place."""
    missing = pattern.shape[0] - least
    for i in range(pattern.shape[0]):
        if i == basis[0] or i == basis[1] or i == basis[2] or i == basis[3]:
            continue
        w = H[2, 0] * pattern[i, 0] + H[2, 1] * pattern[i, 1] + H[2, 2]
        if w <= 0.0:
            return False
        u = (H[0, 0] * pattern[i, 0] + H[0, 1] * pattern[i, 1] + H[0, 2]) / w
        v = (H[1, 0] * pattern[i, 0] + H[1, 1] * pattern[i, 1] + H[1, 2]) / w
        near = False
        for k in range(pixels.shape[0]):
            if abs(pixels[k, 0] - u) < reach and abs(pixels[k, 1] - v) < reach:
                near = True
                break
        if not near:
            missing -= 1
            if missing < 0:
                return False
    return True


@kernel
def _assign(pattern, radius, pixels, areas, reach, H, owner, circle):
    """Dots nearest to the projected pattern into ``owner`` (n,), -1 where none has the right place and size.

    Returns their number; 0 where the homography does not show the pattern from in front.
    """
    n = pattern.shape[0]
    count = 0
    for i in range(n):
        owner[i] = -1
        if not image_of_circle(H, pattern[i, 0], pattern[i, 1], radius, circle):
            return 0
        u, v = circle[0] + circle[2], circle[1] + circle[3]
        # blur inflates the area of thin dots
        most = np.pi * (circle[5] + 0.7) * (circle[6] + 0.7) * 1.25
        least = 0.75 * circle[4]
        nearest = reach * reach
        for k in range(pixels.shape[0]):
            du = pixels[k, 0] - u
            dv = pixels[k, 1] - v
            if du * du + dv * dv < nearest and least < areas[k] < most:
                nearest = du * du + dv * dv
                owner[i] = k
        if owner[i] >= 0:
            count += 1
            for j in range(i):
                if owner[j] == owner[i]:
                    return 0
    return count


@kernel
def find_face(pattern, radius, pixels, areas, bases, inverses, least, reach, tolerance, owner):
    """Search a pattern (n, 2) with dots of ``radius`` [pattern units] among dots (m, 2) [px] of ``areas``
    (m,) [px²].

    Every ordered quadruple of dots is held against every row of ``bases`` (b, 4) with its ``inverses``
    (b, 3, 3), pruned by the signs and sizes of its triangles, which the dots' areas foretell. A hypothesis
    counts when ``least`` dots or more lie within ``tolerance`` [px] of the homography fitted to all of them
    and are of the right size; ``reach`` [px] is how far a dot may lie from the homography of the quadruple.
    ``owner`` (n,) gets the dots' rows, -1 for missing ones. Returns the number found; 0 if none, or if
    another assignment explains as many dots nearly as well.
    """
    n = pattern.shape[0]
    m = pixels.shape[0]
    unit = np.pi * radius * radius
    H = np.zeros((3, 3))
    circle = np.zeros(7)
    trial = np.zeros(n, np.int64)
    used = np.zeros(n, np.bool_)
    matched = np.zeros((n, 2))
    distances = np.zeros(n)
    best_count = 0
    best_misfit = 1e30
    rival = 1e30
    owner[:] = -1
    for row in range(bases.shape[0]):
        basis = bases[row]
        t012 = _turn(pattern[basis[0]], pattern[basis[1]], pattern[basis[2]])
        t013 = _turn(pattern[basis[0]], pattern[basis[1]], pattern[basis[3]])
        t023 = _turn(pattern[basis[0]], pattern[basis[2]], pattern[basis[3]])
        t123 = _turn(pattern[basis[1]], pattern[basis[2]], pattern[basis[3]])
        inverse = inverses[row]
        for i in range(m):
            for j in range(m):
                if j == i or areas[j] > 3.0 * areas[i] or areas[i] > 3.0 * areas[j]:
                    continue
                for k in range(m):
                    if k in (i, j):
                        continue
                    ratio = _turn(pixels[i], pixels[j], pixels[k]) / t012
                    foretold = (areas[i] + areas[j] + areas[k]) / (3.0 * unit)
                    if ratio < 0.4 * foretold or ratio > 2.0 * foretold:
                        continue
                    for l in range(m):  # noqa: E741
                        if l in (i, j, k):
                            continue
                        if _turn(pixels[i], pixels[j], pixels[l]) / t013 < 0.3 * foretold:
                            continue
                        if _turn(pixels[i], pixels[k], pixels[l]) / t023 < 0.3 * foretold:
                            continue
                        if _turn(pixels[j], pixels[k], pixels[l]) / t123 < 0.3 * foretold:
                            continue
                        if not _hypothesis(pixels[i], pixels[j], pixels[k], pixels[l], inverse, H):
                            continue
                        if not _promising(pattern, pixels, basis, max(least, best_count), reach + 0.5, H):
                            continue
                        count = _assign(pattern, radius, pixels, areas, reach, H, trial, circle)
                        if count < least or count < best_count:
                            continue
                        same = count == best_count
                        for d in range(n):
                            used[d] = trial[d] >= 0
                            if trial[d] != owner[d]:
                                same = False
                            if used[d]:
                                matched[d, 0] = pixels[trial[d], 0]
                                matched[d, 1] = pixels[trial[d], 1]
                        if same:
                            continue
                        if not fit_homography(pattern, matched, used, H):
                            continue
                        misfit = misfits(pattern, matched, used, H, distances)
                        if misfit > tolerance:
                            continue
                        # sizes once more, under the better homography
                        if _assign(pattern, radius, pixels, areas, reach, H, trial, circle) < count:
                            continue
                        if count > best_count:
                            rival = 1e30
                        elif misfit >= best_misfit:
                            rival = min(rival, misfit)
                            continue
                        else:
                            rival = best_misfit
                        best_count = count
                        best_misfit = misfit
                        for d in range(n):
                            owner[d] = trial[d]
    if best_count == 0 or rival < CLEAR * best_misfit or rival < 0.5 * tolerance:
        owner[:] = -1
        return 0
    return best_count


def compile_kernels() -> None:
    """Compile what the detector calls, or load it from the cache."""
    compile_for(
        find_face, given(FLOAT, 2), FLOAT, given(FLOAT, 2), given(FLOAT, 1), given(INT, 2), given(FLOAT, 3),
        INT, FLOAT, FLOAT, written(INT, 1),
    )  # fmt: skip
