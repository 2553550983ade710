"""Progress of a calibration as published in `StateMessage.learning`: what has been moved and how accurately each joint
is known, and the text of progress for terminals.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import msgspec

BAR = 24
"""Characters of a joint's bar."""


class JointLearning(msgspec.Struct, frozen=True):
    """Progress of one joint: the range ``moved`` in its own trial motion [rad or m], and the rms error of the marker
    pixels predicted while it moves alone over this range [px]; None: not known yet.
    """

    name: str
    moved: float = 0.0
    predicted_px: float | None = None

    @property
    def share(self) -> float:
        """Fraction [0, 1] of the joint's bar that is full: none at 10 px, all at 0.001 px, logarithmic."""
        px = 10.0 if self.predicted_px is None else self.predicted_px
        return min(1.0, max(0.0, 0.25 * (1.0 - math.log10(max(px, 1e-9)))))


class LearntAccuracy(msgspec.Struct, frozen=True):
    """Result of a fit to the data collected so far, as in `LearningState`; the errors of the ``joints`` by name."""

    predicted_px: float | None = None
    joints: dict[str, float] = {}
    coverage: dict[str, float] = {}
    note: str = ""


class LearningState(msgspec.Struct, frozen=True):
    """Progress of a calibration. The predicted errors are those of a fit to the ``images`` collected before it began.

    ``doing``: ``moving``, or ``fitting`` the model after the motions.
    ``motion``: number of the trial motion, from 1; 0: before the first; the last of ``motions`` moves all joints.
    ``images``: collected so far.
    ``predicted_px``: rms error of predicted marker pixels while all known joints move [px]; None: not known yet.
    ``coverage``: fraction of each camera's image in which markers were seen.
    ``note``: why no error can be predicted yet.
    """

    doing: Literal["moving", "fitting"]
    motion: int
    motions: int
    images: int
    joints: tuple[JointLearning, ...]
    seconds_left: float | None = None
    predicted_px: float | None = None
    coverage: dict[str, float] = {}
    note: str = ""

    @property
    def headline(self) -> str:
        """The motion, the number of images, the predicted error and the time left, on one line."""
        count = self.motions - 1
        if self.doing == "fitting":
            motion = "fitting the model"
        elif 1 <= self.motion <= count:
            motion = f"joint {self.motion} of {count}"
        else:
            motion = "all joints at once" if self.motion else "to the base"
        left = "" if self.seconds_left is None else f", {self.seconds_left:.0f} s left"
        known = "accuracy not known yet" if self.predicted_px is None else f"predicted {self.predicted_px:.2g} px"
        return f"calibrating: {motion}, images {self.images}{left}, {known}"

    @property
    def text(self) -> str:
        """The progress on one line, with the error of each joint, or why there is none."""
        known = ", ".join(f"{j.name} {j.predicted_px:.2g}" for j in self.joints if j.predicted_px is not None)
        return self.headline + (f" ({known or self.note})" if known or self.note else "")

    @property
    def picture(self) -> str:
        """The progress as lines, with a bar for each joint."""
        width = max(len(joint.name) for joint in self.joints)
        lines = [self.headline]
        for joint in self.joints:
            full = round(BAR * joint.share)
            known = "not known yet" if joint.moved else "not moved yet"
            if joint.predicted_px is not None:
                known = f"{joint.predicted_px:.2g} px"
            lines.append(f"  {joint.name:{width}} {'█' * full}{'░' * (BAR - full)} {known}")
        return "\n".join(lines)


class LearningLines:
    """Callback for learning states: calls ``tell`` with the text when another motion begins or another accuracy is
    known.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._told: object = None

    def __call__(self, state: LearningState) -> None:
        """Take the newest state."""
        news = (state.doing, state.motion, state.predicted_px)
        if news != self._told:
            self._told = news
            self._tell(state.text)


def tenths(tell: Callable[[str], None], what: str = "") -> Callable[[float, str], None]:
    """Callback for the completed fraction of the task ``what`` and a remark: ``tell`` gets a line at each tenth, and
    again where one task ends and the next begins.
    """
    reported = 0

    def progress(fraction: float, remark: str = "") -> None:
        nonlocal reported
        tenth = int(10.0 * fraction + 1e-9)
        if tenth != reported:
            reported = tenth
            if tenth:
                tell(f"{what or ' '} {10 * tenth} %{f': {remark}' if remark else ''}")

    return progress
