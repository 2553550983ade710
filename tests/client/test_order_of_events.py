"""Every wait of a client, with the events that it waits for in each order, alone or several at once: their order is
that of processes which do not wait for each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import permutations, product
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from stereoservo.cli import record
from stereoservo.cli.output import CellOptions
from stereoservo.client import Client, FailedError, client, events
from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.goals import JointTarget
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.recording_request import ImagesRecorded, RecordedImages
from stereoservo.messages.wire import (
    CalibrationResult,
    CellInfo,
    EventList,
    EventMessage,
    LoopInfo,
    Reply,
    StateMessage,
    encode,
)

REQUEST = 7
STATE = StateMessage(
    cell="demo", boot="b", t_ns=1, step=0, t_wall=1.0, lifecycle="active", model="valid", model_epoch=1,
    source="hold", goal="", law="", level="ok", reasons=(), joints={}, velocities={}, command={}, error_px=None,
    task_error=(),
    innovation_px={}, visible={}, loop=LoopInfo(250.0, 1, 0, 0, {}, {}),
)  # fmt: skip
RESULT = CalibrationResult(0.1, {}, True, "m.json", 2, "metric", 1.0, 1, 2, 1, 0, 1, 2, 3.0)
CHECK = CheckReport("holds", "all is well", 1, 4, 20, 20.0, 20.0, 1.0, 0.1, 0.5, {}, {}, {}, (), (), 0)
RESET = ZeroReset(2, 1, (), 3.0, 1.0, "reset")
IMAGES = ImagesRecorded("d", (RecordedImages("left", "d/left.avi", 1, 0, 0, "ended"),))
Step = EventMessage | StateMessage


def event(kind: str, **fields: Any) -> EventMessage:
    return EventMessage(0, "b", 0, 0.0, kind, **fields)


class ScriptedClient(Client):
    """A client of a cell that does, once it is asked for something, what ``script`` says, a batch in each 10 ms; on a
    clock of its own.
    """

    def __init__(self, script: list[list[Step]]) -> None:
        self.cell, self.operator, self.keys = "demo", "anna", KeySpace("demo")
        self.goal_key = self.keys.goal(self.operator)
        self.while_waiting = lambda: None
        self._timeout_s, self._closed, self._session = 2.0, True, self
        self.script, self.id, self.asked = script, "", False
        self.log: list[EventMessage] = []
        self.arrived: list[EventMessage] = []
        self.state = STATE
        self.now = 100.0

    def declare_subscriber(self, key: str, handler: Any) -> Any:
        return self

    def undeclare(self) -> None:
        pass

    def try_recv(self) -> Any:
        if not self.arrived:
            return None
        data = encode(self.arrived.pop(0))
        payload = SimpleNamespace(to_bytes=lambda: data)
        return SimpleNamespace(key_expr=self.keys.event, payload=payload)

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        if self.asked and self.script:
            for step in self.script.pop(0):
                if isinstance(step, StateMessage):
                    self.state = step
                    continue
                mine = {"id": self.id} if step.id == "mine" else {}
                told = msgspec.structs.replace(step, seq=len(self.log) + 1, **mine)
                self.log.append(told)
                self.arrived.append(told)

    def query(self, key: str, payload: bytes = b"", timeout_s: float | None = None) -> bytes:
        if key == self.keys.state:
            return encode(self.state)
        if key == self.keys.info:
            return encode(CellInfo("demo", "1", "b", (), (), (), "stereo", 1.0, None, (), True, True))
        if key.startswith(self.keys.event):
            first = int(key.rpartition("=")[2])
            found = tuple(self.log[first - 1 :]) if first <= len(self.log) else ()
            return encode(EventList("b", 1, len(self.log) + 1, found))
        self.asked = True
        self.id = msgspec.json.decode(payload).get("id", "")
        return encode(Reply(True, "accepted", self.id, request=REQUEST, boot="b"))


def run_record(made: ScriptedClient) -> object:
    printed: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CellOptions, "client", lambda *arguments: made)
        patch.setattr(CellOptions, "emit", lambda _, result, text: printed.append(result))
        record.record("demo", seconds=0.05, images=True)
    return printed[0]["images"]


def failed(call: Callable[[ScriptedClient], object]) -> Callable[[ScriptedClient], object]:
    """What ends as a failure: the event's kind."""

    def work(made: ScriptedClient) -> object:
        with pytest.raises(FailedError) as caught:
            call(made)
        return caught.value.event.kind

    return work


REPORT, OTHER = event("calibration_report", id="mine", name="report"), event("calibrated", id="another")
CALIBRATED = event("calibrated", id="mine", calibration=RESULT)
WAITS: dict[str, tuple[Callable[[ScriptedClient], object], list[Step], object]] = {
    "calibrate, and its report": (
        lambda c: c.calibrate(report=True, lease_s=None), [CALIBRATED, REPORT, OTHER], RESULT,
    ),
    "calibrate": (lambda c: c.calibrate(lease_s=None), [CALIBRATED, REPORT, OTHER], RESULT),
    "a calibration that fails, and its report": (
        failed(lambda c: c.calibrate(report=True, lease_s=None)),
        [event("calibration_failed", id="mine"), REPORT, OTHER], "calibration_failed",
    ),
    "a calibration that is aborted": (
        failed(lambda c: c.calibrate(report=True, lease_s=None)),
        [event("calibration_aborted", id="mine"), OTHER], "calibration_aborted",
    ),
    "check": (
        lambda c: c.check_model(lease_s=None), [event("checked", id="mine", check=CHECK), OTHER], CHECK,
    ),
    "zeros": (
        lambda c: c.reset_zeros(lease_s=None),
        [event("checked", id="mine", check=CHECK), event("zeros_reset", id="mine", reset=RESET), OTHER], RESET,
    ),
    "teach": (
        lambda c: c.teach("a").name,
        [event("taught", request=REQUEST, name="a"), event("taught", request=3, name="b"), OTHER], "a",
    ),
    "goal": (
        lambda c: c.goal(JointTarget({"j1": 0.1}), lease_s=None).wait().outcome,
        [event("goal_accepted", id="mine"), event("goal_reached", id="mine"), OTHER], "reached",
    ),
    "home": (
        lambda c: c.home(lease_s=None).wait().outcome,
        [event("goal_started", id="mine"), event("goal_aborted", id="mine"), OTHER], "aborted",
    ),
    "reset": (
        lambda c: c.reset(), [event("lifecycle", name="inactive"), msgspec.structs.replace(STATE, lifecycle="inactive"),
        OTHER], None,
    ),
    "enable": (
        lambda c: c.enable(), [event("lifecycle", name="active"), STATE, OTHER], None,
    ),
    "record": (
        run_record,
        [event("recording", message="a.mcap"), event("images_recorded", images=IMAGES),
         event("images_ended", name="vision-left")],
        msgspec.to_builtins(IMAGES),
    ),
}  # fmt: skip
BEFORE = {"reset": "fault", "enable": "inactive"}


def batches(steps: list[Step]) -> Iterator[list[list[Step]]]:
    """``steps`` in their order, in each way parted into batches."""
    for cuts in product((False, True), repeat=len(steps) - 1):
        parted = [[steps[0]]]
        for cut, step in zip(cuts, steps[1:], strict=True):
            if cut:
                parted.append([step])
            else:
                parted[-1].append(step)
        yield parted


@pytest.mark.parametrize("name", WAITS)
def test_a_wait_finds_its_events_in_any_order(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    call, steps, result = WAITS[name]
    for order in permutations(steps):
        for script in batches(list(order)):
            told = [[step if isinstance(step, StateMessage) else step.kind for step in batch] for batch in script]
            made = ScriptedClient(script)
            if name in BEFORE:
                made.state = msgspec.structs.replace(STATE, lifecycle=BEFORE[name])
            for module in (events, client, record):
                monkeypatch.setattr(module, "time", made)
            assert call(made) == result, told
            assert made.now < 101.0, told


@pytest.mark.parametrize(
    "order", list(permutations([CALIBRATED, REPORT, event("fit_progress", id="mine", progress=0.5)]))
)
def test_each_event_of_a_calibration_is_shown_once(order: tuple[Step, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    for script in batches(list(order)):
        made, shown = ScriptedClient(script), list[EventMessage]()
        monkeypatch.setattr(events, "time", made)
        made.calibrate(shown.append, report=True, lease_s=None)
        assert shown == [told for told in made.log if told.seq <= shown[-1].seq]
        assert {told.kind for told in shown} >= {"calibrated", "calibration_report"}


def test_a_report_that_does_not_come_is_not_waited_for_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    made = ScriptedClient([[CALIBRATED]])
    monkeypatch.setattr(events, "time", made)
    assert made.calibrate(report=True, lease_s=None) == RESULT
    assert made.now - 100.0 == pytest.approx(client.REPORT_TIMEOUT_S, abs=1.0)
