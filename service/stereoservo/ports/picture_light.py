"""Why no marker is seen: a picture that is too dark, or too bright."""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import ImageArray

UNSEEN_S = 1.0
"""Time without a marker after which the picture is looked at, and then once in each such time."""
LEAST_CONTRAST = 30.0
"""Grey levels between dark and bright that the shipped detectors ask of a marker."""
SATURATED, MUCH_SATURATED = 254, 0.3
"""Grey level at the sensor's limit, and the share of such pixels that hides markers."""
STRIDE = 4
"""Of rows and columns, each n-th is looked at."""


def judge_light(image: ImageArray) -> tuple[str, str] | None:
    """Code and text of what is wrong with the light of ``image`` (h, w), None where nothing is."""
    grey = image[::STRIDE, ::STRIDE]
    dark, bright = (float(level) for level in np.percentile(grey, [1.0, 99.5]))
    cut = float((grey >= SATURATED).mean())
    if cut > MUCH_SATURATED:
        return "camera_glare", (
            f"{100 * cut:.0f} % of its pixels are white to the limit, at most {100 * MUCH_SATURATED:.0f} % are well: "
            "shorten the exposure, lower the gain, close the iris, or turn the lamp away"
        )
    if bright - dark < LEAST_CONTRAST and bright < 128.0:
        return "camera_dark", (
            f"its picture has {bright - dark:.0f} grey levels between dark and bright, the brightest {bright:.0f} of "
            f"255; {LEAST_CONTRAST:.0f} are needed: more light, a longer exposure, more gain, or take off the cap"
        )
    return None


class LightWatch:
    """Tells once when a camera sees no marker because of its light, and once when it sees one again."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._code = ""

    def see(self, image: ImageArray, markers: int, t_ns: int) -> tuple[str, str] | None:
        """Code and text of what is new with a picture of ``t_ns`` that shows so many ``markers``: ``camera_dark``,
        ``camera_glare``, ``camera_light``; else None."""
        if self._last_ns is None or markers:
            self._last_ns = t_ns
        if markers:
            was, self._code = self._code, ""
            return ("camera_light", "sees markers again") if was else None
        if (t_ns - self._last_ns) * 1e-9 < UNSEEN_S:
            return None
        self._last_ns = t_ns
        found = judge_light(image)
        code = "" if found is None else found[0]
        new, self._code = code != self._code, code or self._code
        return (code, f"sees no marker: {found[1]}") if found is not None and new else None
