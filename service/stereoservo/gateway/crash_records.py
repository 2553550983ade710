"""What of a gateway outlives it: the goals that have not ended, so that each gets its one terminal event whoever is
killed meanwhile, and the numbers of the core's events that were dealt with: the next gateway is sent them all again.
"""

from __future__ import annotations

import struct
import time
from pathlib import Path

from stereoservo.client.goal_handle import TERMINAL
from stereoservo.core.cycle import Event
from stereoservo.daemon.process_control import write_log
from stereoservo.daemon.seqlock import SlotReader, SlotWriter
from stereoservo.gateway.persistence import Tell
from stereoservo.gateway.publisher import EventLog
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.run_record import OpenGoal, read_goals, read_run, write_goals
from stereoservo.messages.wire import EventMessage

_HANDLED_LAYOUT = "HandledEvents.1"
_HANDLED = struct.Struct("=qq")
AGAIN_S = 1.0
"""How often goals that could not be written are tried again."""
BEGINS = frozenset({"goal_accepted", "goal_started", "calibration_progress"})
ENDS = frozenset({*TERMINAL, "calibration_finished", "calibration_aborted", "check_finished"})


class OpenGoalRecord:
    """Goals accepted and not ended, by the events that are published; ``boot`` is the daemon's run.

    What a full disk has not taken is written once there is room: a goal that stayed in the file would end twice.
    """

    def __init__(self, directories: CellDirectories, boot: str) -> None:
        self._directories = directories
        self._boot = boot
        self._goals = {goal.id: goal for goal in read_goals(directories)}
        self._due_s: float | None = None

    def observe(self, event: EventMessage, *, repeated: bool = False) -> None:
        """Take an event that was published; ``repeated``: by a gateway before this one, which may not have had room."""
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
        """Write what is not written yet, each second."""
        if self._due_s is not None and time.monotonic() >= self._due_s:
            self._store()

    def _store(self) -> None:
        again, self._due_s = self._due_s is not None, None
        try:
            write_goals(self._directories, tuple(self._goals.values()))
        except OSError as error:  # a full disk: goals go on, and end, all the same
            self._due_s = time.monotonic() + AGAIN_S
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
    """Up to which event the journal has them, and up to which those were acted upon that must not be twice.

    A slot, because a gateway that is killed while it writes a file leaves half of it. Where it is damaged, all events
    of before this start are taken for handled. Raises SlotError.
    """

    def __init__(self, path: Path, tell: Tell) -> None:
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
            tell(
                "handled events",
                f"{path}: was damaged and begins anew. What was taught or calibrated in the moment before the "
                "gateway's start may be missing: look, and repeat it",
            )

    def is_journaled(self, event: Event) -> bool:
        """Whether ``event`` is in the journal."""
        return event.seq <= self._journaled or event.t_ns < self._not_before_ns

    def is_acted_on(self, event: Event) -> bool:
        """Whether ``event`` has had its effect."""
        return event.seq <= self._acted or event.t_ns < self._not_before_ns

    def missed_before(self, event: Event) -> int:
        """How many events are missing between those that were dealt with and ``event``."""
        return 0 if event.t_ns < self._not_before_ns else max(0, event.seq - self._journaled - 1)

    def mark(self, event: Event, *, acted: bool) -> None:
        """``event`` is in the journal and, with ``acted``, has had its effect."""
        self._journaled = max(self._journaled, event.seq)
        if acted:
            self._acted = max(self._acted, event.seq)
        self._write()

    def _write(self) -> None:
        self._slot.write(_HANDLED.pack(self._journaled, self._acted))

    def close(self) -> None:
        """Release the slot. Idempotent."""
        self._slot.close()
