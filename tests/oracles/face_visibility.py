"""Visibility of a face in numpy: the readable reference of that of `control.laws.cartesian3`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.laws.cartesian3 import MARGIN_OF_END, MARGIN_OF_NOW, SAMPLES
from stereoservo.numerics.arrays import FloatArray


class Way(NamedTuple):
    """``angle`` [rad]: the turn in the sense that was chosen, in (−2π, 2π). ``translation`` in [0, 1]: the share of the
    displacement that may be made before the turn goes on; ``turn`` in [0, \\|angle\\|]: how far it may go before the
    translation does. ``clear``: whether there is a way in sight of all cameras that see the face now and at its end.
    """

    angle: float
    translation: float
    turn: float
    clear: bool


def visible_rotation(face: FloatArray, H: FloatArray, displacement: FloatArray, eyes: FloatArray, angle: float) -> Way:
    """The way of a face (4,) turned by ``angle`` in [−π, π] with generator ``H`` (4, 4) and moved by (4,).

    ``eyes`` (c, 4): camera centres of height 1 times the sign that makes ``faceᵀO`` positive on the visible side.
    Senses are tried short before long, with the margin before without. Where none is clear the short one is kept to
    what is in sight now.
    """
    coefficients = _coefficients(face, H, displacement, eyes, angle)
    other = angle - math.copysign(2.0 * math.pi, angle)
    for margin in (1.0, 0.0):
        for sense in (angle, other):
            if sense == other and abs(angle) == 0.0:
                continue
            way = _way(*coefficients, sense, margin)
            if way.clear:
                return way
    return _way(*coefficients, angle, 0.0)


def _coefficients(
    face: FloatArray, H: FloatArray, displacement: FloatArray, eyes: FloatArray, angle: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``f(0, t) = F·(1, −sin t, 1 − cos t)`` (c, 3), ``∂f/∂s = −G·(…)`` (3,), margins (c,), of the cameras that see."""
    once = face @ H
    rows = np.stack([face, once, once @ H])
    F, G = eyes @ rows.T, rows @ displacement
    now, end = F[:, 0], (F - G) @ _sinusoid(angle)
    seen = (now > 0.0) & (end > 0.0)
    margins = np.minimum(MARGIN_OF_NOW * now, MARGIN_OF_END * end)
    return F[seen], G, margins[seen]


def _sinusoid(t: float) -> FloatArray:
    return np.array([1.0, -math.sin(t), 2.0 * math.sin(0.5 * t) ** 2])


def _way(F: FloatArray, G: FloatArray, margins: FloatArray, angle: float, margin: float) -> Way:
    share, turn, reached, clear, going = 1.0, abs(angle), 0.0, True, True
    samples = SAMPLES if angle != 0.0 else 0
    for i in range(samples + 1):
        t = angle * i / samples if samples else 0.0
        sinusoid = _sinusoid(t)
        room, rate = F @ sinusoid - margin * margins, float(G @ sinusoid)
        low, high = 0.0, 1.0
        for value in room:
            if rate > 0.0:
                high = min(high, float(value) / rate)
            elif rate < 0.0:
                low = max(low, float(value) / rate)
            elif value < 0.0:
                high = -1.0
        if i == samples:
            high = 1.0  # seen at the end, by what these cameras are
        reached = max(reached, low)
        clear = clear and reached <= high
        share = min(share, max(0.0, high))
        if low > 0.0 and going:
            turn, going = abs(angle) * max(0, i - 1) / max(1, samples), False
    return Way(angle, share, turn, clear)
