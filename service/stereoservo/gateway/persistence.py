"""Files of the gateway: stores of taught goals and models, and the journal, a log of events. No failure ends the
gateway: damaged files are set aside, and failed writes are reported.
"""

from __future__ import annotations

import errno
import os
import re
import struct
import time
from collections.abc import Callable
from io import FileIO
from pathlib import Path

from stereoservo.client.goal_handle import TERMINAL
from stereoservo.core.cycle import Event
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.process_control import write_log
from stereoservo.daemon.seqlock import SlotReader, SlotWriter
from stereoservo.daemon.taught_goals import (
    ModelOf,
    TaughtFileError,
    TaughtGoal,
    load_taught,
    refined_goal,
    save_taught,
)
from stereoservo.gateway.publisher import EventLog
from stereoservo.kinematics.model import CellModel, ModelFileError, load_model
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.files import set_aside
from stereoservo.messages.run_record import OpenGoal, read_goals, read_run, write_goals
from stereoservo.messages.wire import EventMessage

JOURNAL_BYTES = 10_000_000
REOPEN_S = 1.0
"""Interval of attempts to open a journal that could not be opened [s]."""
SetNote = Callable[[str, str], None]
"""Called with the topic and the text of a note for the cell's keeper."""


class TaughtStore:
    """Taught goals by name. ``model_of``: see `load_taught`.

    A damaged file is set aside and reported to ``recover``, and there are no goals; without ``recover`` it remains as
    it is, and TaughtFileError is raised.
    """

    def __init__(self, path: Path, model_of: ModelOf = lambda _: None, recover: SetNote | None = None) -> None:
        self._path = path
        self.goals: dict[str, TaughtGoal] = {}
        try:
            self.goals = load_taught(path, model_of)
        except TaughtFileError as error:
            if recover is None:
                raise
            recover("taught goals", f"{error}; {set_aside(path)}, and there are no taught goals")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the goals, sorted."""
        return tuple(sorted(self.goals))

    def add(self, name: str, goal: TaughtGoal) -> None:
        """Store a goal, replacing one of the same name. Raises OSError; the goal is then not stored."""
        self._replace({**self.goals, name: goal})

    def refine(self, used: CellModel, model: CellModel) -> None:
        """Restate the goals in ``model`` instead of ``used``, if only the estimate changed (see `refined_goal`). Raises
        OSError if they cannot be stored; they are then restated in memory.
        """
        self.restore_goals({name: refined_goal(goal, used, model) for name, goal in self.goals.items()})

    def restore_goals(self, goals: dict[str, TaughtGoal]) -> None:
        """Set ``goals`` in memory, and write the file if it holds others. Raises OSError."""
        self.goals = goals
        try:
            stored = load_taught(self._path)
        except TaughtFileError:
            stored = None
        if stored != goals:
            save_taught(self._path, goals)

    def _replace(self, goals: dict[str, TaughtGoal]) -> None:
        save_taught(self._path, goals)
        self.goals = goals


class ModelStore:
    """Model files ``model-<epoch>.json``; an epoch is never used twice."""

    _FILE = re.compile(r"model-(\d{6,})\.json")
    _USED = re.compile(r"model-(\d{6,})\.json(?:\.damaged-\d+)?")

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def path(self, epoch: int) -> Path:
        """File of a model."""
        return self._directory / f"model-{epoch:06d}.json"

    def epochs(self) -> list[int]:
        """Epochs of all model files, ascending."""
        return self._epochs(self._FILE)

    def _epochs(self, pattern: re.Pattern[str]) -> list[int]:
        return sorted(int(match[1]) for path in self._directory.iterdir() if (match := pattern.fullmatch(path.name)))

    def next_epoch(self) -> int:
        """The last epoch plus one; epochs of damaged files that were set aside count."""
        return max(self._epochs(self._USED), default=0) + 1

    def of_epoch(self, epoch: int) -> CellModel | None:
        """Model of an epoch, None if its file is missing or damaged."""
        try:
            return load_model(self.path(epoch))
        except ModelFileError:
            return None

    def newest_fitting(self, settings: CoreSettings, *, recover: bool = False) -> tuple[CellModel | None, list[str]]:
        """Newest model that fits the cell's joints and cameras, and the reasons why newer ones were skipped.

        ``recover``: set damaged files aside. Models of another schema are not damaged.
        """
        passed = []
        for epoch in reversed(self.epochs()):
            path = self.path(epoch)
            try:
                model = load_model(path)
            except ModelFileError as error:
                aside = f"; {set_aside(path)}" if recover and error.key != "schema" else ""
                passed.append(f"{error}{aside}")
                continue
            mismatch = _mismatch(model, settings)
            if not mismatch:
                return model, passed
            passed.append(f"{path}: {mismatch}")
        return None, passed


def _mismatch(model: CellModel, settings: CoreSettings) -> str:
    """Reason why ``model`` does not belong to this cell; empty if it does."""
    if model.joint_names != settings.joint_names or model.joint_kinds != settings.joint_kinds:
        return f"is of joints {_joints(model)}; the cell has {_joints(settings)}"
    of_model = [(camera.name, camera.width, camera.height) for camera in model.cameras]
    of_cell = [(camera.name, camera.width, camera.height) for camera in settings.cameras]
    if of_model != of_cell:
        return f"is of cameras {of_model}; the cell has {of_cell}"
    mounts = {camera.mount for camera in settings.cameras}
    if mounts != {model.mount}:
        return f"is of cameras mounted {model.mount}; the cell's are {', '.join(sorted(mounts))}"
    unknown = [marker for marker in model.marker_ids if marker not in settings.marker_ids]
    if unknown:
        return f"has markers {unknown} that no detector of the cell reports"
    return ""


def _joints(of: CellModel | CoreSettings) -> str:
    """Joint names, with the kinds of those that are not revolute."""
    return ", ".join(
        name if kind == "revolute" else f"{name} ({kind})"
        for name, kind in zip(of.joint_names, of.joint_kinds, strict=True)
    )


class Journal:
    """Log of events for people, one JSON object per line; the older half is dropped when the file has grown large.

    Lines that cannot be written are lost and counted (``note``).
    """

    def __init__(self, path: Path, limit: int = JOURNAL_BYTES) -> None:
        self._path = path
        self._limit = limit
        self._stream: FileIO | None = None
        self._tried_s = -REOPEN_S
        self._torn = False
        self._lost = 0
        self._cause = ""
        try:
            self._open()
        except OSError as error:
            self._cause = error.strerror or str(error)

    @property
    def note(self) -> str:
        """Text on lines that are missing; empty if there are none."""
        return f"{self._path}: {self._lost} events are missing in it: {self._cause}" if self._cause else ""

    def _open(self) -> FileIO:
        if self._stream is None:
            self._tried_s = time.monotonic()
            self._stream = FileIO(self._path, "ab")
        return self._stream

    def add(self, line: bytes) -> None:
        """Append a line, unless the file cannot be written."""
        if self._stream is None and time.monotonic() - self._tried_s < REOPEN_S:
            self._lost += 1
            return
        try:
            self._write(line)
        except OSError as error:
            self._lost += 1
            self._cause = error.strerror or str(error)

    def _write(self, line: bytes) -> None:
        stream = self._open()
        data = (b"\n" if self._torn else b"") + line + b"\n"
        written = stream.write(data)
        self._torn = written < len(data)
        if self._torn:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if stream.tell() > self._limit:
            self.close()
            self._path.replace(self._path.with_suffix(".1.jsonl"))
            self._open()

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._stream is not None:
            stream, self._stream = self._stream, None
            stream.close()


# -- what outlives a gateway ---------------------------------------------------------------------------------
# State that survives a restart of the gateway: the goals that have not ended, so that each gets exactly one terminal
# event even if a process is killed; and the numbers of the core's events that were handled, because the next gateway
# receives them all again.


_HANDLED_LAYOUT = "HandledEvents.1"
_HANDLED = struct.Struct("=qq")
RETRY_S = 1.0
"""Interval of attempts to write goals that could not be written [s]."""
BEGINS = frozenset({"goal_accepted", "goal_started", "calibration_progress"})
ENDS = frozenset({*TERMINAL, "calibration_finished", "calibration_aborted", "check_finished"})


class OpenGoalRecord:
    """Goals accepted and not ended, by the events that are published; ``boot`` is the daemon's run.

    A write that failed on a full disk is repeated until it succeeds: a goal that remained in the file would end twice.
    """

    def __init__(self, directories: CellDirectories, boot: str) -> None:
        self._directories = directories
        self._boot = boot
        self._goals = {goal.id: goal for goal in read_goals(directories)}
        self._due_s: float | None = None

    def observe(self, event: EventMessage, *, repeated: bool = False) -> None:
        """Handle an event that was published; ``repeated``: by an earlier gateway, which may have had a full disk."""
        if event.kind in BEGINS and event.id and event.id not in self._goals:
            calibration = event.kind.startswith("calibration")
            self._goals[event.id] = OpenGoal(event.id, self._boot, calibration)
        elif event.kind not in ENDS or self._goals.pop(event.id, None) is None:
            return
        if repeated:
            self._due_s = time.monotonic()
        else:
            self._store()

    def poll(self) -> None:
        """Write pending changes, once a second."""
        if self._due_s is not None and time.monotonic() >= self._due_s:
            self._store()

    def _store(self) -> None:
        again, self._due_s = self._due_s is not None, None
        try:
            write_goals(self._directories, tuple(self._goals.values()))
        except OSError as error:  # a full disk: goals continue, and end, nevertheless
            self._due_s = time.monotonic() + RETRY_S
            if not again:
                write_log("gateway", f"{self._directories.open_goals}: {error.strerror}")

    @property
    def any_of_this_run(self) -> bool:
        """Whether a goal of this run has not ended."""
        return any(goal.boot == self._boot for goal in self._goals.values())

    def end_earlier(self, log: EventLog) -> None:
        """Publish the end of the goals that ended with an earlier run."""
        run = read_run(self._directories)
        why = "" if run is None or run.boot != self._boot else run.previous
        self._end(log, why or "the daemon ended", earlier=True)

    def end_current(self, log: EventLog) -> None:
        """Publish the end of the goals of this run, whose servo process is gone."""
        run = read_run(self._directories)
        why = "" if run is None or run.boot != self._boot else run.cause
        self._end(log, why or "the servo process ended", earlier=False)

    def _end(self, log: EventLog, why: str, *, earlier: bool) -> None:
        for goal in [goal for goal in self._goals.values() if (goal.boot != self._boot) == earlier]:
            kind = "calibration_aborted" if goal.calibration else "goal_aborted"
            log.add(kind, id=goal.id, message=why, origin="gateway")


class HandledEvents:
    """Number of the last event in the journal, and of the last one with a single effect that was acted on.

    Stored in a slot, because a gateway killed while writing a file leaves an incomplete one. If the slot is damaged,
    all events before this start count as handled. Raises SlotError.
    """

    def __init__(self, path: Path, set_note: SetNote) -> None:
        existed = path.exists()
        self._slot = SlotWriter(path, _HANDLED.size, _HANDLED_LAYOUT)
        with SlotReader(path, _HANDLED_LAYOUT) as reader:
            record = reader.newest()
        self._journaled = self._acted = self._not_before_ns = 0
        if record is not None and len(record) == _HANDLED.size:
            self._journaled, self._acted = map(int, _HANDLED.unpack(record))
            return
        self._write()
        if existed:
            self._not_before_ns = time.monotonic_ns()
            set_note(
                "handled events",
                f"{path}: was damaged and is started empty. What was taught or calibrated in the moment before the "
                "gateway's start may be missing: look, and repeat it",
            )

    def is_journaled(self, event: Event) -> bool:
        """Whether ``event`` is in the journal."""
        return event.seq <= self._journaled or event.t_ns < self._not_before_ns

    def is_acted_on(self, event: Event) -> bool:
        """Whether ``event`` has had its effect."""
        return event.seq <= self._acted or event.t_ns < self._not_before_ns

    def missed_before(self, event: Event) -> int:
        """Number of events missing between the last handled one and ``event``."""
        return 0 if event.t_ns < self._not_before_ns else max(0, event.seq - self._journaled - 1)

    def mark(self, event: Event, *, acted: bool) -> None:
        """Record that ``event`` is in the journal and, with ``acted``, has had its effect."""
        self._journaled = max(self._journaled, event.seq)
        if acted:
            self._acted = max(self._acted, event.seq)
        self._write()

    def _write(self) -> None:
        self._slot.write(_HANDLED.pack(self._journaled, self._acted))

    def close(self) -> None:
        """Release the slot. Idempotent."""
        self._slot.close()
