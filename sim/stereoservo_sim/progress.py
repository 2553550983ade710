"""Progress of a command: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

ProgressCall = Callable[[str, int, int], None]
"""Callback ``tell(stage, done, total)``."""
LINE_EVERY_S = 5.0
"""Least time between two lines of a stage, except its first and its last one."""


def silent(stage: str, done: int, total: int) -> None:
    """Progress callback without effect."""


def counted(tell: ProgressCall, stage: str, total: int) -> Iterator[int]:
    """Yields 0 to ``total`` - 1; reports the number done before each, and at the end."""
    for done in range(total):
        tell(stage, done, total)
        yield done
    tell(stage, total, total)


@contextmanager
def progress_bar() -> Iterator[ProgressCall]:
    """A bar on stderr if that is a terminal, else a line from time to time."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield progress_lines(sys.stderr)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        tasks: dict[str, Any] = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        yield tell


def progress_lines(out: TextIO, clock: Callable[[], float] = time.monotonic) -> ProgressCall:
    """Plain lines ``stage: done of total`` into ``out``: the first and the last of a stage, others every
    ``LINE_EVERY_S`` seconds of ``clock``."""
    said: dict[str, tuple[int, float]] = {}

    def tell(stage: str, done: int, total: int) -> None:
        before, when = said.get(stage, (-1, 0.0))
        last = done >= total and before < total
        if stage in said and not last and clock() - when < LINE_EVERY_S:
            return
        if before >= done:
            return
        said[stage] = done, clock()
        print(f"{stage}: {done} of {total}", file=out, flush=True)

    return tell
