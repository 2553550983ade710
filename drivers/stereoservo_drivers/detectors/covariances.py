"""Covariances of measured dots from the noise of a whole picture. Numba kernels; no state."""

from __future__ import annotations

import numpy as np

from stereoservo_drivers.detectors.compilation import FLOAT, compile_for, given, kernel, written
from stereoservo_drivers.detectors.levels import UNEVEN_INSIDE
from stereoservo_drivers.detectors.measurements import (
    BACKGROUND,
    BRIGHT,
    BXX,
    BXY,
    BYY,
    CONTRAST,
    CXX,
    CXY,
    CYY,
    EXX,
    EXY,
    EYY,
    NOISE,
)

QUANTISATION = 1.0 / 12.0
"""Least noise variance [grey levels squared]: rounding to whole levels."""
CLEARLY_MORE = 1.25
"""Ratio from which the noise in the light is taken for more than in the dark: three standard deviations of a median
over fourteen dots of 35 pixels each."""
SATURATED_PX = 0.005
"""Standard deviation [px] that sampling adds to a dot whose edge is cut off at white (measured: 0.0045)."""


@kernel
def variances(dots, column, unevenness, out):
    """Noise variance of each dot (k,) [levels²] from what its ``column`` of ``dots`` says, -1 where that is nothing.

    ``unevenness``: part of the contrast that is no noise. One picture has one noise: each dot gets the median over all
    of them, which is steadier (a dot's own: 15 %), unless its own is more than twice that.
    """
    n = dots.shape[0]
    known = np.empty(n)
    count = 0
    for i in range(n):
        out[i] = dots[i, column]
        if out[i] >= 0.0:
            out[i] = max(out[i] - (unevenness * dots[i, CONTRAST]) ** 2, 0.0)
            known[count] = out[i]
            count += 1
    if count == 0:
        out[:] = 1.0 + QUANTISATION
        return
    known = np.sort(known[:count])
    common = max(0.5 * (known[(count - 1) // 2] + known[count // 2]), QUANTISATION)
    for i in range(n):
        if out[i] <= 2.0 * common:
            out[i] = common


@kernel
def covariances(dots, floor, out):
    """Covariances (k, 2, 2) [px²] of measured ``dots`` (k, FIELDS), with a standard deviation of ``floor`` [px] added.

    Noise may be more in the light than in the dark (shot noise). Where levels are cut off at black that of the light
    counts; less noise in the light than in the dark is none seen, for being cut off at white.
    """
    n = dots.shape[0]
    darks, brights = np.empty(n), np.empty(n)
    variances(dots, NOISE, 0.0, darks)
    variances(dots, BRIGHT, UNEVEN_INSIDE, brights)
    seen = False
    for i in range(n):
        seen = seen or dots[i, BRIGHT] >= 0.0
    for i in range(n):
        dot, dark = dots[i], darks[i]
        bright = brights[i] if seen and brights[i] > CLEARLY_MORE * dark else dark
        clip = 3.0 * np.sqrt(bright)
        # noise that is cut off is less: 0.58 of it at black itself, 0.85 one standard deviation above
        if dot[BACKGROUND] < 2.5 * np.sqrt(dark):
            dark = bright
        even = floor * floor
        if dot[BACKGROUND] + dot[CONTRAST] > 255.0 - clip:
            even += SATURATED_PX * SATURATED_PX
        light = bright - dark
        out[i, 0, 0] = dark * dot[CXX] + light * dot[BXX] + dot[EXX] + even
        out[i, 0, 1] = dark * dot[CXY] + light * dot[BXY] + dot[EXY]
        out[i, 1, 0] = out[i, 0, 1]
        out[i, 1, 1] = dark * dot[CYY] + light * dot[BYY] + dot[EYY] + even


def compile_kernels() -> None:
    """Compile what the detector calls, or load it from the cache."""
    compile_for(covariances, given(FLOAT, 2), FLOAT, written(FLOAT, 3))
