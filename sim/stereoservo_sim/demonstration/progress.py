"""What a demonstration tells its command: progress, and that it did not succeed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


class DemoFailedError(Exception):
    """The demonstration did not succeed."""


@dataclass(frozen=True)
class DemonstrationProgress:
    """Protocol of a progress reporter: lines of text, and a fraction of the present work."""

    tell: Callable[[str], None]
    progress: Callable[[float], None]
