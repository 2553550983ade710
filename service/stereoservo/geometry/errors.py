"""The one exception of geometry: input from which the asked quantity cannot be computed."""

from __future__ import annotations

from typing import Any


class GeometryError(ValueError):
    """Degenerate or malformed geometric input. The text says what, the value, and what would have been
    valid.

    Attributes: code: short machine-readable cause: ``"shape"``, ``"not_finite"``, ``"too_few"``,
    ``"degenerate"``, ``"orientation"``, ``"half_turn"``, ``"no_model"``. data: the values that the message
    speaks of.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data
