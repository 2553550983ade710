"""Error boundaries for bytes that this process did not write itself: files, records of shared-memory slots, packets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import msgspec


class DamagedError(Exception):
    """Data that cannot be used. ``source``: the file or slot that holds them; ``cause``: what is wrong."""

    def __init__(self, source: Path | str, cause: str) -> None:
        super().__init__(f"{source}: {cause}")
        self.source = str(source)
        self.cause = cause


@contextmanager
def decoding(refusal: Callable[[str], Exception], passed: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Boundary around a decoder: any exception inside is raised as ``refusal(cause)``, with the cause as text.

    DamagedError and the types ``passed``, which a decoder raises on purpose, are raised as they are.
    """
    try:
        yield
    except Exception as error:  # a decoder may raise anything: its errors have no common class
        if isinstance(error, (DamagedError, *passed)):
            raise
        raise refusal(cause_of(error)) from error


def cause_of(error: BaseException) -> str:
    """Cause of an exception of a decoder, as text."""
    if isinstance(error, DamagedError):
        return error.cause
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be read: {error.strerror}"
    if isinstance(error, RecursionError):
        return "is nested too deeply"
    if isinstance(error, UnicodeDecodeError):
        return f"is not UTF-8: {error.reason} 0x{error.object[error.start]:02x} at byte {error.start}"
    if isinstance(error, MemoryError):
        return "states a size that does not fit into memory"
    if isinstance(error, msgspec.MsgspecError | ValueError):
        return str(error)
    return f"{type(error).__name__}: {error}"


class RecordBoundary:
    """Boundary around the handling of single records of ``source``, a context manager to be used for each of them.

    A record whose handling raises is skipped and counted (``refused``). ``log`` is called with the first, tenth,
    hundredth … of them.
    """

    def __init__(self, source: str, log: Callable[[str], None] | None = None) -> None:
        self._source = source
        self._log = log
        self._logged = 1
        self._cause = ""
        self.refused = 0

    @property
    def note(self) -> str:
        """Text on the skipped records; empty if there are none."""
        if self.refused == 0:
            return ""
        return f"{self._source}: {self.refused} records left out; the last one: {self._cause}"

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if error is None or not isinstance(error, Exception):
            return False
        self.refuse(error)
        return True

    def refuse(self, error: Exception) -> None:
        """Count a record whose handling raised ``error``, and log it if its number is one that is logged."""
        self.refused += 1
        self._cause = cause_of(error)[:500]
        if self._log is not None and self.refused == self._logged:
            self._logged *= 10
            self._log(self.note)
