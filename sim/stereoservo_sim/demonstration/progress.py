"""Interface of a demonstration to its command: progress, and the error of a failed demonstration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


class DemoFailedError(Exception):
    """The demonstration did not succeed."""


@dataclass(frozen=True)
class DemonstrationProgress:
    """Protocol of a progress reporter: lines of text, and the completed fraction of the current work."""

    tell: Callable[[str], None]
    progress: Callable[[float], None]
