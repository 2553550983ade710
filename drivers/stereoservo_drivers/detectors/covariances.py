"""Covariances of measured dots from the noise of a whole picture."""

from __future__ import annotations

import numpy as np

from stereoservo.runtime.ports import FloatArray
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
SATURATED_PX = 0.005
"""Standard deviation [px] that sampling adds to a dot whose edge is cut off at white (measured: 0.0045)."""


def covariances_of(dots: FloatArray) -> FloatArray:
    """Covariances (k, 2, 2) [px²] of measured ``dots`` (k, FIELDS)."""
    odd = dots[:, [EXX, EXY, EXY, EYY]].reshape(-1, 2, 2)
    return noise_covariances(dots) + odd


def noise_covariances(dots: FloatArray) -> FloatArray:
    """Covariances (k, 2, 2) [px²] that noise gives the centres of measured ``dots`` (k, FIELDS).

    Noise may be more in the light than in the dark (shot noise). Where levels are cut off at black that of the light
    counts; less noise in the light than in the dark is none seen, for being cut off at white.
    """
    dark = noise_variances(dots[:, NOISE])
    own = np.maximum(dots[:, BRIGHT] - (UNEVEN_INSIDE * dots[:, CONTRAST]) ** 2, 0.0)
    own = noise_variances(np.where(dots[:, BRIGHT] >= 0.0, own, -1.0))
    bright = np.maximum(own, dark) if (dots[:, BRIGHT] >= 0.0).any() else dark
    black = dots[:, BACKGROUND] < 3.0 * np.sqrt(bright)
    white = dots[:, BACKGROUND] + dots[:, CONTRAST] > 255.0 - 3.0 * np.sqrt(bright)
    dark = np.where(black, bright, dark)
    light = dots[:, [BXX, BXY, BXY, BYY]]
    both = dark[:, None] * (dots[:, [CXX, CXY, CXY, CYY]] - light) + bright[:, None] * light
    return np.ascontiguousarray(both.reshape(-1, 2, 2)) + np.where(white, SATURATED_PX**2, 0.0)[
        :, None, None
    ] * np.eye(2)


def noise_variances(measured: FloatArray) -> FloatArray:
    """Noise variance of each dot's surroundings (k,) from the measured ones (k,), -1 where there is none
    [levels²].

    One picture has one noise: each gets the median over all dots, which is steadier (a dot's own: 15 %),
    unless its own surroundings are more than twice as restless.
    """
    known = measured[measured >= 0.0]
    if not len(known):
        return np.full(len(measured), 1.0 + QUANTISATION)
    common = max(float(np.median(known)), QUANTISATION)
    return np.where(measured > 2.0 * common, measured, common)
