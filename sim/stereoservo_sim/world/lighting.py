"""Varying light and exposure: ambient steps, automatic exposure, soft shadows, a lamp's reflection, flicker.

It is applied to the image of a scene before the sensor's noise and quantisation to 255 levels, so that bright areas
are clipped, and dark ones are lost in noise.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

NonNegative = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
Share = Annotated[float, Meta(ge=0, le=0.95)]
SLANT = 0.35
"""Inclination of a shadow's edges to the image columns [rad]."""
Picture = npt.NDArray[np.float32]


class Lighting(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Light variation as a function of the time since the camera was activated.

    ``level``: factor of all light; 1 is the unmodified scene.
    ``steps``: (s, level) times from which the ambient light has this level.
    ``adapt_s``: time constant of an automatic exposure that follows the ambient light, 0: fixed exposure.
    ``swing``: relative amplitude of an exposure oscillation of period ``swing_s``.
    ``shadow``: share of light that a shadow blocks; ``shadow_px`` wide, edges of ``soft_px`` (sigma), crossing the
    image once in ``shadow_s``.
    ``spot``: grey levels of a lamp's reflection of radius ``spot_px`` (sigma), which circles about the image centre
    once in ``spot_s``.
    ``flicker``: share of light that varies at ``flicker_hz``, seen as bands since rows are read out one after another
    in ``readout_s``.
    """

    level: Positive = 1.0
    steps: tuple[tuple[NonNegative, Positive], ...] = ()
    adapt_s: NonNegative = 0.0
    swing: Share = 0.0
    swing_s: Positive = 2.0
    shadow: Share = 0.0
    shadow_px: Positive = 120.0
    soft_px: Positive = 15.0
    shadow_s: Positive = 4.0
    spot: NonNegative = 0.0
    spot_px: Positive = 40.0
    spot_s: Positive = 5.0
    flicker: Share = 0.0
    flicker_hz: Positive = 100.0
    readout_s: Positive = 0.02

    def exposed(self, t_s: float) -> float:
        """Light of the whole image at ``t_s`` [s], exposure included."""
        gain, ambient = self.level, 1.0
        for at_s, level in sorted(self.steps):
            if at_s > t_s:
                break
            left = 1.0 if self.adapt_s == 0.0 else float(np.exp(-(t_s - at_s) / self.adapt_s))
            gain *= (level / ambient) ** left
            ambient = level
        return float(gain * (1.0 + self.swing * np.sin(2.0 * np.pi * t_s / self.swing_s)))

    def lit(self, image: Picture, t_s: float) -> Picture:
        """``image`` (h, w) [grey levels] under the light at ``t_s`` [s]."""
        height, width = image.shape
        rows = np.full(height, self.exposed(t_s))
        if self.flicker:
            times = t_s + self.readout_s * (np.arange(height) / height - 0.5)
            rows *= 1.0 + self.flicker * np.sin(2.0 * np.pi * self.flicker_hz * times)
        lit = image * rows.astype(np.float32)[:, None]
        u = np.arange(width, dtype=np.float32)[None, :]
        v = np.arange(height, dtype=np.float32)[:, None]
        if self.shadow:
            way = width + height * np.float32(SLANT) + 2.0 * self.shadow_px
            middle = np.float32((t_s / self.shadow_s % 1.0) * way - self.shadow_px)
            across = np.abs(u + np.float32(SLANT) * v - middle) - np.float32(0.5 * self.shadow_px)
            # a logistic edge as steep as a Gaussian one of this sigma
            lit *= 1.0 - np.float32(self.shadow) / (1.0 + np.exp(np.clip(across / self.soft_px * 1.7, -60, 60)))
        if self.spot:
            angle = 2.0 * np.pi * t_s / self.spot_s
            u0, v0 = width * (0.5 + 0.15 * np.cos(angle)), height * (0.5 + 0.15 * np.sin(angle))
            bell = [np.exp(-0.5 * ((x - x0) / self.spot_px) ** 2) for x, x0 in ((u, u0), (v, v0))]
            lit += (self.spot * bell[0] * bell[1]).astype(np.float32)
        return np.asarray(lit, dtype=np.float32)
