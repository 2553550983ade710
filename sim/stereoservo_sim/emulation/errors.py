"""Errors of emulators."""

from __future__ import annotations


class EmulationError(Exception):
    """A cell's hardware cannot be emulated as asked; says what would have been valid."""


class OrderError(ValueError):
    """An order cannot be understood or done; says what would have been valid."""
