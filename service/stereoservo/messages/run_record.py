"""Records in a cell's state directory that outlive every process of its daemon: how its last run ended, and which goals
have not ended yet.
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import msgspec

from stereoservo.messages.directories import CellDirectories

_T = TypeVar("_T")


class RunRecord(msgspec.Struct, frozen=True):
    """A run of a cell's daemon, written at its start, when it is ``up``, and at its end; times [s since 1970].

    ``pid``: of the supervisor; ``machine``: identifies the boot of the computer that it ran in.
    ``cause``: of its end: empty while it runs, and permanently if no process was left to write it.
    ``in_order``: the end was requested.
    ``previous``: how the last run before it that was up ended, empty if that was requested.
    ``remedy``: what to do, if the cause does not state it.
    """

    boot: str
    pid: int
    machine: str
    started: float
    ended: float | None = None
    cause: str = ""
    in_order: bool = False
    previous: str = ""
    remedy: str = ""
    up: bool = False


class OpenGoal(msgspec.Struct, frozen=True):
    """A goal or calibration that was accepted in the run ``boot`` and has not ended."""

    id: str
    boot: str
    calibration: bool = False


class OpenGoals(msgspec.Struct, frozen=True):
    """All goals that have not ended."""

    goals: tuple[OpenGoal, ...] = ()


def begin_run(directories: CellDirectories, boot: str, pid: int) -> None:
    """Record that a run starts. Raises OSError."""
    before = read_run(directories)
    if before is None or not before.up:  # a failed start has no information about earlier goals
        previous = "" if before is None else before.previous
    else:
        previous = "" if before.in_order else end_cause(before)
    run = RunRecord(boot, pid, machine_start(), time.time(), previous=previous)
    _replace(directories.run_record, msgspec.json.encode(run))


def run_is_up(directories: CellDirectories) -> None:
    """Record that the daemon accepts requests. Raises OSError."""
    run = read_run(directories)
    if run is not None:
        _replace(directories.run_record, msgspec.json.encode(msgspec.structs.replace(run, up=True)))


def end_run(directories: CellDirectories, cause: str, remedy: str = "", *, in_order: bool = False) -> None:
    """Record the cause of a run's end, unless there is one already. Raises OSError."""
    run = read_run(directories)
    if run is not None and not run.cause:
        ended = msgspec.structs.replace(run, ended=time.time(), cause=cause, remedy=remedy, in_order=in_order)
        _replace(directories.run_record, msgspec.json.encode(ended))


def read_run(directories: CellDirectories) -> RunRecord | None:
    """The newest run, None if none was recorded."""
    return _read(directories.run_record, RunRecord)


def end_cause(run: RunRecord) -> str:
    """Cause of the end of a run that has ended, also if no process could write it."""
    if run.cause:
        return run.cause
    if run.machine != machine_start():
        return "the computer was switched off or restarted while the daemon ran"
    return (
        f"the supervisor (process {run.pid}) was killed (signal 9), by a person or for lack of memory: see "
        "`journalctl -k`"
    )


def read_goals(directories: CellDirectories) -> tuple[OpenGoal, ...]:
    """The goals that have not ended."""
    found = _read(directories.open_goals, OpenGoals)
    return () if found is None else found.goals


def write_goals(directories: CellDirectories, goals: tuple[OpenGoal, ...]) -> None:
    """Replace the goals that have not ended. Raises OSError."""
    _replace(directories.open_goals, msgspec.json.encode(OpenGoals(goals)))


def machine_start() -> str:
    """Identifier of this boot of the computer; empty if the kernel provides none."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""


def _read(path: Path, kind: type[_T]) -> _T | None:
    """A record; None if there is none, or a damaged one, because nothing depends on it."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
        return None


def _replace(path: Path, data: bytes) -> None:
    """Replace a file as a whole: if the process is killed meanwhile, either the old or the new one remains."""
    temporary = path.with_suffix(".new")
    temporary.write_bytes(data)
    temporary.replace(path)
