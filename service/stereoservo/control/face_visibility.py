"""Visibility of a marker face in the cameras during a Cartesian motion: the sense of rotation that keeps it visible,
and how far the rotation must wait for the translation (thesis 7.4.2).

The face is turned by ``t`` about an axis through the centre while the centre goes the share ``s`` of its straight
line. A camera at ``O`` sees it while ``f(s, t) = a(t)ᵀ(O − s Δ) > 0``, ``a(t) = exp(−tĤᵀ)a``: affine in ``s``, a
sinusoid in ``t``. So at every ``t`` the shares in sight are one interval, and a way on which neither goes back exists
where the largest lower bound so far never exceeds the upper one. From it: how far the translation may go before the
turn has caught up, how far the turn may go before the translation has, and in which of its two senses the turn has a
way at all: one rotation leads the face's normal along a small circle, and its short arc may pass behind the horizon
where the long one does not.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

SAMPLES = 32
"""Angles at which a turn is looked at; they lie closer the less of it is left."""
MARGIN_OF_END = 0.1
MARGIN_OF_NOW = 0.5
"""A camera is kept on the face's front by the smaller of these shares of ``f`` at the end and now."""
APPROACH = 4.0
"""A component slows where its bound is nearer than this part of what it has to make: 1/4."""


@kernel
def _way(
    F: FloatArray, G: FloatArray, margins: FloatArray, cameras: int, angle: float, margin: float
) -> tuple[float, float, bool]:
    """Share of the translation, turn, and whether the way is clear."""
    size = abs(angle)
    share, turn, reached = 1.0, size, 0.0
    clear, going = True, True
    samples = SAMPLES if angle != 0.0 else 0
    for i in range(samples + 1):
        t = angle * i / samples if samples > 0 else 0.0
        sine, half = math.sin(t), math.sin(0.5 * t)
        versine = 2.0 * half * half
        rate = G[0] - sine * G[1] + versine * G[2]
        low, high = 0.0, 1.0
        for c in range(cameras):
            value = F[c, 0] - sine * F[c, 1] + versine * F[c, 2] - margin * margins[c]
            if rate > 0.0:
                high = min(high, value / rate)
            elif rate < 0.0:
                low = max(low, value / rate)
            elif value < 0.0:
                high = -1.0
        if i == samples:
            high = 1.0
        reached = max(reached, low)
        clear = clear and reached <= high
        share = min(share, max(0.0, high))
        if low > 0.0 and going:
            turn = size * max(0, i - 1) / max(1, samples)
            going = False
    return share, turn, clear


@kernel
def way_in_sight(
    face: FloatArray, H: FloatArray, displacement: FloatArray, eyes: FloatArray, side: float, angle: float
) -> tuple[float, float, float, bool]:
    """Angle, share of the translation and turn that keep a face (4,) in view, and whether a path in view exists.

    ``eyes`` (c, 4): camera centres of height 1; ``side``: 1 or -1, of the face, which is seen."""
    rows = np.empty((3, 4))
    for i in range(4):
        rows[0, i] = face[i]
    for k in range(1, 3):
        for i in range(4):
            s = 0.0
            for j in range(4):
                s += rows[k - 1, j] * H[j, i]
            rows[k, i] = s
    cameras = eyes.shape[0]
    F = np.empty((cameras, 3))
    margins = np.empty(cameras)
    G = np.zeros(3)
    for k in range(3):
        for i in range(4):
            G[k] += side * rows[k, i] * displacement[i]
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    versine = 2.0 * half * half
    seeing = 0
    for c in range(cameras):
        for k in range(3):
            s = 0.0
            for i in range(4):
                s += rows[k, i] * eyes[c, i]
            F[seeing, k] = side * s
        now = F[seeing, 0]
        end = now - G[0] - sine * (F[seeing, 1] - G[1]) + versine * (F[seeing, 2] - G[2])
        if now > 0.0 and end > 0.0:
            margins[seeing] = min(MARGIN_OF_NOW * now, MARGIN_OF_END * end)
            seeing += 1
    other = angle - math.copysign(2.0 * math.pi, angle)
    for trial in range(4):
        sense = angle if trial % 2 == 0 else other
        if trial % 2 == 1 and angle == 0.0:
            continue
        share, turn, clear = _way(F, G, margins, seeing, sense, 1.0 if trial < 2 else 0.0)
        if clear:
            return sense, share, turn, True
    share, turn, clear = _way(F, G, margins, seeing, angle, 0.0)
    return angle, share, turn, False
