"""Interface of a demonstration to its command: progress, and the error of a failed demonstration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from stereoservo.messages.learning import LearningState


class DemoFailedError(Exception):
    """The demonstration did not succeed."""


@dataclass(frozen=True)
class DemonstrationProgress:
    """Protocol of a progress reporter: lines of text, the completed fraction of the current work, and what a
    calibration has learnt so far.
    """

    tell: Callable[[str], None]
    progress: Callable[[float], None]
    learning: Callable[[LearningState], None] = lambda _: None
