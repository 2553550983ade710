"""Discovery of the daemons that run for this user, and start of a cell's daemon as a child process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec

from stereoservo.messages.compilation_progress import CompilationProgress, ProgressTimeout, read_progress
from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.directories import CELL_NAME, CellDirectories, cell_directories, runtime_root
from stereoservo.messages.files import read_bounded
from stereoservo.messages.locks import holder
from stereoservo.messages.run_record import end_cause, read_run

MAX_INFO_BYTES = 1 << 16
REPORT_EVERY_S = 10.0
"""Interval [s] at which the number of compiled kernels is reported to the program that starts a daemon."""


class DaemonInfo(msgspec.Struct, frozen=True):
    """``daemon.json`` in the runtime directory, written by the gateway once it listens."""

    cell: str
    endpoint: str
    boot: str
    pid: int
    cell_path: str
    dry_run: bool = False
    commissioning: bool = False


class NotRunningError(Exception):
    """No daemon runs for a cell; the message lists the running ones. ``more``: what is known of the one that ran."""

    def __init__(self, cell: str, running: tuple[str, ...], more: str = "") -> None:
        super().__init__(
            f"no daemon runs for cell {cell!r}; running: {', '.join(running) or 'none'}. {more}"
            f"Start it with `stereoservo run CELL.toml`"
        )
        self.cell = cell
        self.running = running


class DaemonError(Exception):
    """A started daemon did not come up; contains its exit code and its output."""

    def __init__(self, message: str, code: int | None, output: str) -> None:
        super().__init__(message)
        self.code = code
        self.output = output


def daemon_info(directories: CellDirectories) -> DaemonInfo | None:
    """Description of the running daemon; None if none runs, it is not ready yet, or its file cannot be read."""
    with suppress(DamagedError), decoding(partial(DamagedError, directories.daemon)):
        if holder(directories.daemon_lock) is not None:
            return msgspec.json.decode(read_bounded(directories.daemon, MAX_INFO_BYTES), type=DaemonInfo)
    return None


def live_cells() -> list[DaemonInfo]:
    """All running daemons of this user."""
    root = runtime_root()
    if not root.is_dir():
        return []
    found = []
    for path in sorted(root.iterdir()):
        if CELL_NAME.fullmatch(path.name) and path.is_dir() and (path / "daemon.lock").exists():
            info = daemon_info(cell_directories(path.name))
            if info is not None:
                found.append(info)
    return found


def find_daemon(cell: str) -> DaemonInfo:
    """The daemon of ``cell``, a name or the path of a cell file. Raises NotRunningError, CellFileError."""
    name = cell
    if cell.endswith(".toml"):
        from stereoservo.messages.cell_file import load_cell_file  # not needed by a client that gives a name

        name = load_cell_file(Path(cell)).cell.name
    directories = cell_directories(name)
    info = daemon_info(directories)
    if info is None:
        raise NotRunningError(name, tuple(found.cell for found in live_cells()), unreachable_reason(directories))
    return info


def unreachable_reason(directories: CellDirectories) -> str:
    """Sentence, followed by a space, on a daemon that is not reachable: it does not accept requests yet, or how its
    last run ended; empty if there was none.
    """
    pid = holder(directories.daemon_lock)
    if pid is not None:
        compiling = ", ".join(one.text for one in read_progress(directories.runtime))
        more = f"It has compiled {compiling}. " if compiling else ""
        return f"Process {pid} has the cell and takes no requests: it starts, or ends. {more}"
    run = read_run(directories)
    if run is None:
        return ""
    when = "" if run.ended is None else time.strftime(" at %Y-%m-%d %H:%M:%S", time.localtime(run.ended))
    text = f"Its last run ended{when}: {end_cause(run).removesuffix('.')}. "
    return f"{text}{run.remedy}. " if run.remedy else text


class DaemonProcess:
    """``stereoservo run`` as a child process; a context manager that ends it.

    ``log``: file that receives its stderr (default: inherited).
    """

    def __init__(
        self,
        cell_path: Path,
        *,
        options: tuple[str, ...] = (),
        log: Path | None = None,
        environment: dict[str, str] | None = None,
    ) -> None:
        self.cell_path = cell_path
        self._log = log
        stream = log.open("wb") if log is not None else None
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "stereoservo.cli.main", "run", str(cell_path), *options],
                stdin=subprocess.DEVNULL,
                stdout=stream if stream is not None else sys.stderr,
                stderr=stream if stream is not None else None,
                env={**os.environ, **(environment or {})},
            )
        finally:
            if stream is not None:
                stream.close()

    def wait_ready(
        self,
        timeout_s: float = 600.0,
        tell: Callable[[str], None] = lambda text: None,
    ) -> DaemonInfo:
        """Wait until it accepts requests: ``timeout_s`` counts from the last compiled kernel.
        ``tell`` receives a line if more kernels were compiled, each `REPORT_EVERY_S`. Raises DaemonError with its
        output.
        """
        wait, due_s = ProgressTimeout(timeout_s), time.monotonic() + REPORT_EVERY_S
        known: tuple[CompilationProgress, ...] = ()
        while not wait.is_over(progress := self._progress()):
            if progress != known and time.monotonic() > due_s:
                known, due_s = progress, time.monotonic() + REPORT_EVERY_S
                tell("compiling kernels: " + ", ".join(f"{one.part} {one.text}" for one in progress))
            code = self.process.poll()
            if code is not None:
                raise DaemonError(
                    f"the daemon ended at its start (exit code {code}): {self.output()}", code, self.output()
                )
            for info in live_cells():
                if info.pid == self.process.pid:
                    return info
            time.sleep(0.05)
        log_hint = f"; it logs into {self._log}" if self._log is not None else ""
        raise DaemonError(
            f"the daemon was not ready within {timeout_s:g} s, in which it compiled no kernel either: a computer that "
            f"is too busy? Start it again: what was compiled is kept{log_hint}",
            None,
            self.output(),
        )

    def _progress(self) -> tuple[CompilationProgress, ...]:
        root = runtime_root()
        folders = sorted(root.iterdir()) if root.is_dir() else []
        return tuple(one for folder in folders for one in read_progress(folder, self.process.pid))

    def output(self) -> str:
        """Its log so far, if it logs into a file."""
        return self._log.read_text(errors="replace").strip() if self._log is not None else ""

    def stop(self, how: signal.Signals = signal.SIGTERM, timeout_s: float = 20.0) -> int:
        """Terminate it regularly; returns its exit code. Idempotent."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
