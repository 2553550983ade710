"""Alignment of patches of reference pictures to a hundredth of a pixel, with affine warps, independent of the light.

Inverse compositional alignment (Baker and Matthews, Lucas-Kanade 20 years on, 2004) with the gain and the offset of the
grey levels projected out. The part of a warp's linear part that is not determined (a lone edge or corner hardly
determines shear) is held near its start.

A *warp* of a patch is ``(A (2, 2), p (2,))``: the reference pixel ``r`` is at ``p`` [px], and ``r + x`` at ``p + A x``.
Level ``l`` of a pyramid has its pixel ``k`` over pixel ``2ˡ k`` of the image, as in `cv2.pyrDown`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from numba import types

from stereoservo.numerics.arrays import BoolArray, FloatArray, ImageArray, IntArray
from stereoservo.numerics.compilation import Fields, inlined_kernel, kernel, plain
from stereoservo_drivers.detectors.kernel_types import FLOAT, IMAGE, INT, compile_for, fields, given, written

TEMPLATE_LEVELS = 4
SMALLEST_LEVEL = 24
"""Least side of a pyramid's picture [px]."""
LEAST_DEVIATION = 4.0
"""Standard deviation of a patch [grey levels] below which it is flat."""
STIFFNESS = 2e-3
"""Weight that holds the linear part, as a share of its mean observability."""
ITERATIONS = 15
CONVERGED_PX = 3e-3
SLOPE_NOISE = 130.0 / 144.0
"""Variance of the five-point difference of noise with variance one."""
PARAMETERS = 8
"""Six of the warp, gain and offset: the degrees of freedom that a fit removes from its residuals."""

FOUND, OUTSIDE, LOST, RESTLESS = 0, 1, 2, 3
"""Outcomes: aligned; outside of the picture; diverged or flat; not converged."""


def build_pyramid(image: ImageArray, levels: int) -> list[ImageArray]:
    """Up to ``levels`` pictures, each half of the previous one, while their sides are at least ``SMALLEST_LEVEL``."""
    pyramid = [np.ascontiguousarray(image)]
    while len(pyramid) < levels and min(pyramid[-1].shape) >= 2 * SMALLEST_LEVEL:
        pyramid.append(cv2.pyrDown(pyramid[-1]))
    return pyramid


SINGLE = types.float32


@dataclass(frozen=True, eq=False)
class Templates:
    """Patches of one level of a reference picture, n of them with w = (2 half + 1)² pixels.

    ``steps`` (n, 6, w): maps grey levels to a warp step; ``levels`` (n, w): grey levels minus their mean; ``squares``
    (n,): sum of their squares; ``slopes`` (n,): mean squared gradient of an axis; ``offsets`` (n, 2): of the landmark
    from the patch's centre [px of the level];
    ``inverses`` (n, 6, 6): covariance of a step at noise one; ``valid`` (n,).
    """

    half: int
    steps: npt.NDArray[np.float32]
    levels: npt.NDArray[np.float32]
    squares: FloatArray
    slopes: FloatArray
    offsets: FloatArray
    inverses: FloatArray
    valid: BoolArray


def cut_templates(picture: ImageArray, pixels: FloatArray, half: int) -> Templates:
    """Templates around ``pixels`` (n, 2) [px of the picture]; those that extend beyond it or are flat are not valid."""
    n, side = len(pixels), 2 * half + 1
    height, width = picture.shape
    grey = picture.astype(np.float64)
    # Five-point differences: exact to third order, so that the gradient of sharp texture is not overestimated.
    kernel_x = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]]) / 12.0
    du, dv = cv2.filter2D(grey, cv2.CV_64F, kernel_x), cv2.filter2D(grey, cv2.CV_64F, kernel_x.T)
    centres = np.where(np.isfinite(pixels), np.rint(pixels), -1e6).astype(np.int64)
    reach = half + 2
    inside: BoolArray = ((centres >= reach) & (centres < np.array([width, height]) - reach)).all(axis=1)
    y, x = (grid.ravel() / half for grid in np.mgrid[-half : half + 1, -half : half + 1])
    steps, levels = np.zeros((n, 6, side * side), np.float32), np.zeros((n, side * side), np.float32)
    squares, slopes = np.zeros(n), np.ones(n)
    inverses, valid = np.zeros((n, 6, 6)), np.zeros(n, np.bool_)
    scale = np.array([1.0 / half] * 4 + [1.0] * 2)
    for k in np.flatnonzero(inside):
        u, v = centres[k]
        window = np.s_[v - half : v + half + 1, u - half : u + half + 1]
        patch = grey[window].ravel() - grey[window].mean()
        squares[k] = patch @ patch
        if squares[k] < LEAST_DEVIATION**2 * side * side:
            continue
        gu, gv = du[window].ravel(), dv[window].ravel()
        J = np.stack([gu * x, gu * y, gv * x, gv * y, gu, gv])
        J -= J.mean(axis=1, keepdims=True)
        J -= np.outer(J @ patch / squares[k], patch)
        H = J @ J.T
        held = H + np.diag([STIFFNESS * np.trace(H[:4, :4]) / 4.0] * 4 + [0.0] * 2)
        if np.linalg.cond(held) > 1e8:
            continue
        inverse = np.linalg.inv(held)
        steps[k], levels[k] = (inverse @ J) * scale[:, None], patch
        inverses[k] = inverse @ H @ inverse * np.outer(scale, scale)
        slopes[k] = 0.5 * (H[4, 4] + H[5, 5]) / (side * side)
        valid[k] = True
    offsets = np.where(inside[:, None], pixels - centres, 0.0)
    return Templates(half, steps, levels, squares, slopes, offsets, inverses, valid)


@kernel
def _sample_cubic(picture: ImageArray, u: float, v: float) -> tuple[float, float]:
    """Grey level at (u, v) by Catmull-Rom's cubic; at least two pixels inside."""
    i, j = int(np.floor(u)), int(np.floor(v))
    a, b = u - i, v - j
    a0, a1 = a * (-0.5 + a * (1.0 - 0.5 * a)), 1.0 + a * a * (-2.5 + 1.5 * a)
    a2, a3 = a * (0.5 + a * (2.0 - 1.5 * a)), a * a * (-0.5 + 0.5 * a)
    b0, b1 = b * (-0.5 + b * (1.0 - 0.5 * b)), 1.0 + b * b * (-2.5 + 1.5 * b)
    b2, b3 = b * (0.5 + b * (2.0 - 1.5 * b)), b * b * (-0.5 + 0.5 * b)
    total = 0.0
    for row, weight in ((j - 1, b0), (j, b1), (j + 1, b2), (j + 2, b3)):
        total += weight * (
            a0 * picture[row, i - 1] + a1 * picture[row, i] + a2 * picture[row, i + 1] + a3 * picture[row, i + 2]
        )
    squared = (a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3) * (b0 * b0 + b1 * b1 + b2 * b2 + b3 * b3)
    return total, squared


class Template(NamedTuple):
    """One patch of :class:`Templates`: ``steps`` (6, w), ``levels`` (w,), ``square``; mean of ``averaged`` pictures."""

    half: int
    averaged: int
    steps: npt.NDArray[np.float32]
    levels: npt.NDArray[np.float32]
    square: float


@kernel
def _reaches_out(picture: ImageArray, half: int, A: FloatArray, p: FloatArray) -> bool:
    """Whether a warped patch extends beyond the pixels of the picture that :func:`_sample_cubic` needs."""
    height, width = picture.shape
    reach_u, reach_v = half * (abs(A[0, 0]) + abs(A[0, 1])), half * (abs(A[1, 0]) + abs(A[1, 1]))
    return not (
        p[0] - reach_u >= 1.0
        and p[1] - reach_v >= 1.0
        and p[0] + reach_u < width - 2.0
        and p[1] + reach_v < height - 2.0
    )


@inlined_kernel
def _compare(
    picture: ImageArray, template: Template, A: FloatArray, p: FloatArray, step: FloatArray
) -> tuple[float, float, float, float]:
    """Sums over a patch of the picture: of levels, of their squares, of their product with the template, and of the
    squared weights of interpolation. ``step`` (6,): the template's warp step for the levels.
    """
    half, steps, levels = template.half, template.steps, template.levels
    a00, a01, a10, a11 = A[0, 0], A[0, 1], A[1, 0], A[1, 1]
    u0, v0 = p[0], p[1]
    total = total2 = cross = attenuation = 0.0
    s0 = s1 = s2 = s3 = s4 = s5 = 0.0
    at = 0
    for y in range(-half, half + 1):
        for x in range(-half, half + 1):
            level, squared = _sample_cubic(picture, u0 + a00 * x + a01 * y, v0 + a10 * x + a11 * y)
            total += level
            total2 += level * level
            attenuation += squared
            cross += level * levels[at]
            s0 += steps[0, at] * level
            s1 += steps[1, at] * level
            s2 += steps[2, at] * level
            s3 += steps[3, at] * level
            s4 += steps[4, at] * level
            s5 += steps[5, at] * level
            at += 1
    step[0], step[1], step[2], step[3], step[4], step[5] = s0, s1, s2, s3, s4, s5
    return total, total2, cross, attenuation


@kernel
def _compose_inverse(A: FloatArray, p: FloatArray, step: FloatArray, gain: float) -> bool:
    """Compose the warp with the inverse of the template's ``step``: W <- W after its inverse. False if too large."""
    d00, d01, d10, d11 = 1.0 + step[0] / gain, step[1] / gain, step[2] / gain, 1.0 + step[3] / gain
    t0, t1 = step[4] / gain, step[5] / gain
    determinant = d00 * d11 - d01 * d10
    if not (determinant > 0.25 and determinant < 4.0):
        return False
    i00, i01, i10, i11 = d11 / determinant, -d01 / determinant, -d10 / determinant, d00 / determinant
    a00, a01, a10, a11 = A[0, 0], A[0, 1], A[1, 0], A[1, 1]
    A[0, 0], A[0, 1] = a00 * i00 + a01 * i10, a00 * i01 + a01 * i11
    A[1, 0], A[1, 1] = a10 * i00 + a11 * i10, a10 * i01 + a11 * i11
    p[0] -= A[0, 0] * t0 + A[0, 1] * t1
    p[1] -= A[1, 0] * t0 + A[1, 1] * t1
    return True


@kernel
def _align_patch(
    picture: ImageArray, template: Template, iterations: int, A: FloatArray, p: FloatArray, measured: FloatArray
) -> int:
    """Move the warp ``A`` (2, 2), ``p`` (2,) until its patch fits ``picture``; returns the outcome. Writes ``measured``
    (3,).
    """
    half, count = template.half, (2 * template.half + 1) ** 2
    start_u, start_v = p[0], p[1]
    step = np.empty(6)
    for _ in range(iterations):
        if _reaches_out(picture, half, A, p):
            return OUTSIDE
        total, total2, cross, attenuation = _compare(picture, template, A, p, step)
        spread = total2 - total * total / count
        gain = cross / template.square
        if not (spread > 0.0 and gain > 0.1 and gain < 10.0):
            return LOST
        measured[0] = cross / np.sqrt(spread * template.square)
        measured[1] = gain
        left = max(spread - gain * gain * template.square, 0.0) / (count - PARAMETERS)
        # The template's noise is multiplied by the gain, the picture's reduced by interpolation.
        measured[2] = left / (gain * gain / template.averaged + attenuation / count)
        if step[4] * step[4] + step[5] * step[5] < 1e-20:  # no motion left
            return FOUND
        if not _compose_inverse(A, p, step, gain):
            return LOST
        if abs(p[0] - start_u) + abs(p[1] - start_v) > 2.0 * half:
            return LOST
        t0, t1 = step[4] / gain, step[5] / gain
        if t0 * t0 + t1 * t1 < CONVERGED_PX * CONVERGED_PX:
            return FOUND
    return RESTLESS


class TemplateArrays(NamedTuple):
    """All of :class:`Templates` that alignment needs: ``steps`` (n, 6, w), ``levels`` (n, w), ``squares`` (n,), each
    patch ``half`` pixels to either side, the mean of ``averaged`` pictures.
    """

    half: int
    averaged: int
    steps: npt.NDArray[np.float32]
    levels: npt.NDArray[np.float32]
    squares: FloatArray


class Warps(NamedTuple):
    """Positions of m patches, updated in place: ``A`` (m, 2, 2), and ``p`` (m, 2), of the templates' centres. Written:
    ``measured`` (m, 3): correlation, gain, noise variance [grey levels²] of one pixel of the pair; ``outcome`` (m,).
    """

    A: FloatArray
    p: FloatArray
    measured: FloatArray
    outcome: IntArray


@kernel
def align_patches(picture: ImageArray, templates: Fields, chosen: IntArray, iterations: int, warps: Fields) -> None:
    """Move ``warps`` of the ``chosen`` (m,) templates until they fit ``picture``, all in pixels of its level.

    With the fields of `TemplateArrays` and of `Warps`.
    """
    half, averaged, steps, levels, squares = templates
    A, p, measured, outcome = warps
    for m in range(len(chosen)):
        k = chosen[m]
        template = Template(half, averaged, steps[k], levels[k], squares[k])
        outcome[m] = _align_patch(picture, template, iterations, A[m], p[m], measured[m])


def compile_kernels() -> None:
    """Compile the kernels of the alignment, or load them from the cache."""
    compile_for(_sample_cubic, IMAGE, FLOAT, FLOAT)
    compile_for(
        align_patches,
        IMAGE,
        fields(INT, INT, given(SINGLE, 3), given(SINGLE, 2), given(FLOAT, 1)),
        given(INT, 1),
        INT,
        fields(written(FLOAT, 3), written(FLOAT, 2), written(FLOAT, 2), written(INT, 1)),
    )


@dataclass(frozen=True, eq=False)
class Alignment:
    """Result of an alignment: warps ``A`` (n, 2, 2) and ``pixels`` (n, 2) [px], ``covariances`` (n, 2, 2) [px²] of the
    noise of both pictures, ``correlations`` (n,), and which were ``found`` (n,).
    """

    A: FloatArray
    pixels: FloatArray
    covariances: FloatArray
    correlations: FloatArray
    found: BoolArray


class ReferencePatches:
    """Patches around ``pixels`` (n, 2) [px] of a reference ``picture``, at every level of its pyramid.

    ``averaged``: number of pictures averaged in the reference, which reduces its noise.
    """

    def __init__(self, picture: ImageArray, pixels: FloatArray, half: int, averaged: int = 1) -> None:
        self.pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        self.half = half
        self._averaged = averaged
        pyramid = build_pyramid(picture, TEMPLATE_LEVELS)
        self._levels = [cut_templates(level, self.pixels / 2**t, half) for t, level in enumerate(pyramid)]
        self.valid: BoolArray = self._levels[0].valid

    def align(
        self, pyramid: list[ImageArray], chosen: IntArray, A: FloatArray, pixels: FloatArray, coarse: int
    ) -> Alignment:
        """Align the ``chosen`` (m,) patches from start warps ``A`` (m, 2, 2), ``pixels`` (m, 2) [px].

        ``coarse``: number of levels above the finest one at which it starts. A patch that is lost at a coarse level
        continues from its start at the next finer one.
        """
        A, pixels = A.astype(np.float64), pixels.astype(np.float64)
        start_A, start = A.copy(), pixels.copy()
        sizes = np.sqrt(np.clip(np.abs(np.linalg.det(A)), 1e-6, 1e6))
        # A patch seen smaller than in the reference is compared with a smaller reference, and vice versa.
        base_t = np.clip(np.rint(-np.log2(sizes)), 0, len(self._levels) - 1).astype(np.int64)
        base_i = np.clip(np.rint(np.log2(sizes)), 0, len(pyramid) - 1).astype(np.int64)
        covariances, correlations = np.zeros((len(chosen), 2, 2)), np.zeros(len(chosen))
        found = np.zeros(len(chosen), np.bool_)
        for above in range(coarse, -1, -1):
            for t, i in sorted({(int(t) + above, int(i) + above) for t, i in zip(base_t, base_i, strict=True)}):
                group = np.flatnonzero((base_t + above == t) & (base_i + above == i))
                if t >= len(self._levels) or i >= len(pyramid):
                    continue
                result = self._align_level(t, i, pyramid[i], chosen[group], A[group], pixels[group])
                ok = result.found
                A[group], pixels[group] = result.A, result.pixels
                A[group[~ok]], pixels[group[~ok]] = start_A[group[~ok]], start[group[~ok]]
                covariances[group], correlations[group] = result.covariances, result.correlations
                found[group] = ok & (above == 0)
        return Alignment(A, pixels, covariances, correlations, found)

    def _align_level(
        self, t: int, i: int, picture: ImageArray, chosen: IntArray, A: FloatArray, pixels: FloatArray
    ) -> Alignment:
        level, m = self._levels[t], len(chosen)
        ratio = 2.0 ** (t - i)
        A_level = np.ascontiguousarray(A * ratio)
        d = level.offsets[chosen]
        p = pixels / 2**i - np.einsum("kij,kj->ki", A_level, d)
        measured, outcome = np.zeros((m, 3)), np.full(m, LOST, np.int64)
        use = np.flatnonzero(level.valid[chosen] & np.isfinite(p).all(axis=1))
        if len(use):
            templates = TemplateArrays(self.half, self._averaged, level.steps, level.levels, level.squares)
            warps = Warps(A_level[use], p[use], measured[use], outcome[use])
            align_patches(picture, plain(templates), chosen[use], ITERATIONS, plain(warps))
            A_level[use], p[use], measured[use], outcome[use] = warps
        found = outcome == FOUND
        G = np.zeros((m, 2, 6))
        G[:, 0, 0] = G[:, 1, 2] = d[:, 0]
        G[:, 0, 1] = G[:, 1, 3] = d[:, 1]
        G[:, 0, 4] = G[:, 1, 5] = 1.0
        onto = np.einsum("kij,kjl->kil", A_level, G) * 2.0**i
        gain = np.where(measured[:, 1] > 0.0, measured[:, 1], 1.0)
        # The picture's noise on the template's grid: the finer that grid, the fewer pixels contribute to a sample.
        density = np.clip(1.0 / np.maximum(np.abs(np.linalg.det(A_level)), 1e-6), 0.4, 4.0)
        noise = measured[:, 2] * (density / gain**2 + 1.0 / self._averaged)
        # Noise makes the template's gradients appear steeper than they are, and every step too short.
        false = SLOPE_NOISE * measured[:, 2] / self._averaged / level.slopes[chosen]
        noise /= np.clip(1.0 - false, 0.6, 1.0) ** 2
        covariances = np.einsum("kia,kab,kjb->kij", onto, level.inverses[chosen], onto) * noise[:, None, None]
        centre = (p + np.einsum("kij,kj->ki", A_level, d)) * 2.0**i
        return Alignment(A_level / ratio, centre, covariances, measured[:, 0], found)
