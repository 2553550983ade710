"""What an experiment raises when its input cannot give a result."""

from __future__ import annotations

from typing import Any


class ExperimentError(Exception):
    """Input of an experiment is missing, malformed or too little. The text says what, the value, what would
    be valid.

    Attributes:
        code: short machine-readable cause, e.g. ``"data_missing"``, ``"csv"``, ``"tag_not_seen"``.
        data: the values that the message speaks of; plain JSON types.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data
