"""What the gateway adds to the state: silent cameras with their cause, and who has stopped the arm."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from stereoservo.core.cycle import Event
from stereoservo.daemon.heartbeat import (
    CAMERA_OPENS_S,
    HEARTBEAT_BYTES,
    HEARTBEAT_LAYOUT,
    VISION_HANG_S,
    HeartbeatWriter,
)
from stereoservo.daemon.seqlock import create_slot
from stereoservo.gateway.intake import NAMELESS, sender
from stereoservo.gateway.process import CameraWatch, CellState
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.goals import Stop
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import LoopInfo, StateMessage, encode
from stereoservo.ports.devices import CameraDescription

BEATER = """
import sys, time
from pathlib import Path
from stereoservo.daemon.heartbeat import HeartbeatWriter
HeartbeatWriter(Path(sys.argv[1])).beat(float(sys.argv[2]))
print("beats", flush=True)
time.sleep(60)
"""
STATE = StateMessage(
    cell="c", boot="b", t_ns=1, step=0, t_wall=1.0, lifecycle="inactive", model="none", model_epoch=0, source="hold",
    goal="", law="", level="ok", reasons=(), joints={}, velocities={}, command={}, error_px=None, task_error=(),
    innovation_px={}, visible={}, loop=LoopInfo(250.0, 1, 0, 0, {"p99": 1.0, "max": 2.0}, {}),
)  # fmt: skip


@pytest.fixture
def slot(tmp_path: Path) -> Path:
    path = CellDirectories("c", tmp_path, tmp_path).heartbeat_slot("vision-left")
    create_slot(path, HEARTBEAT_BYTES, HEARTBEAT_LAYOUT)
    return path


@pytest.fixture
def watch(slot: Path, tmp_path: Path) -> Iterator[CameraWatch]:
    left = CameraDescription("fake", "left", 64, 48, 30.0, "observations", 1.0)
    found = CameraWatch(CellDirectories("c", tmp_path, tmp_path), [left])
    yield found
    found.close()


def said(watch: CameraWatch, age_s: float | None) -> list[tuple[str, str, str]]:
    state = msgspec.structs.replace(STATE, camera_age_s={"left": age_s})
    return [(reason.level, reason.subject, reason.hint) for reason in watch.reasons(state)]


@contextmanager
def vision(slot: Path, limit_s: float) -> Iterator[subprocess.Popen[str]]:
    """A process of a camera that has beaten once."""
    with subprocess.Popen(
        [sys.executable, "-c", BEATER, str(slot), str(limit_s)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


def test_a_killed_camera_process_is_reported_before_its_last_frame_is_old(slot: Path, watch: CameraWatch) -> None:
    with vision(slot, CAMERA_OPENS_S) as process:  # while a camera opens no beat is missed
        assert said(watch, 0.03) == []
        process.kill()
        process.wait()
        ((level, subject, hint),) = said(watch, 0.03)
    assert (level, subject) == ("slow", "left")
    assert "its process has ended" in hint


def test_a_camera_process_that_hangs_and_one_whose_camera_is_silent_are_distinguished(
    slot: Path, watch: CameraWatch
) -> None:
    ((level, _, hint),) = said(watch, None)
    assert (level, hint) == ("info", "its process is being started")
    with vision(slot, VISION_HANG_S):  # one that has beaten, and beats no more
        until = time.monotonic() + 20.0
        while "hangs" not in said(watch, 2.0)[0][2]:
            assert time.monotonic() < until
            time.sleep(0.02)
    with closing(HeartbeatWriter(slot)) as heartbeat:
        heartbeat.beat(VISION_HANG_S)
        ((level, _, hint),) = said(watch, 2.0)
        assert level == "slow"
        assert "its process lives" in hint
        ((level, _, hint),) = said(watch, None)
        assert level == "info"
        assert "opened" in hint


# -- who stopped the arm ------------------------------------------------------------------------------------


class Halted:
    """A `CellState` of an arm that the core says is halted, with these reasons."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reasons: tuple[Reason, ...] = ()
        servo: Any = SimpleNamespace(announced_silence=lambda: True)
        plan: Any = SimpleNamespace(directories=CellDirectories("c", tmp_path, tmp_path), cameras=())
        self.state = CellState(plan, "b", servo)
        self.state.newest = SimpleNamespace()  # type: ignore[assignment]
        monkeypatch.setattr(
            "stereoservo.gateway.process.state_message",
            lambda *_, **__: msgspec.structs.replace(STATE, reasons=self.reasons),
        )

    def take(self, kind: Any, message: str = "", operator: str = "", name: str = "", repeated: bool = False,
             code: str = "STOPPED") -> None:  # fmt: skip
        reasons = (Reason(code, "hold"),) if kind == "stopped" else ()
        event = Event(1, time.monotonic_ns(), kind, message, name=name, reasons=reasons)
        self.state.on_event(event, operator, repeated=repeated)

    def words(self, *codes: str) -> str | None:
        self.reasons = tuple(Reason(code, "hold") for code in codes)
        message = self.state.message()
        assert message is not None
        return None if message.halt is None else message.halt.words


@pytest.fixture
def halted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Halted:
    return Halted(tmp_path, monkeypatch)


def test_the_state_states_who_stopped_the_arm_until_it_is_resumed(halted: Halted) -> None:
    assert halted.words("STOPPED") is None
    halted.take("stopped", operator="viewer 2")
    assert halted.words("STOPPED") == "stopped by viewer 2"
    assert halted.words() is None, "what is over is not told"
    halted.take("held", "held by bob")
    assert halted.words("STOPPED") == "stopped by viewer 2", "a hold changes nothing of a stop"
    halted.take("resumed", "resumed by ann")
    halted.take("held", "held by bob")
    assert halted.words("HELD") == "held by bob"
    halted.take("lifecycle", name="active")
    assert halted.words("HELD") is None


def test_a_stop_that_came_by_no_wire_or_for_a_cause_states_it(halted: Halted) -> None:
    halted.take("stopped")
    assert halted.words("STOPPED") == "stopped on the cell's host"
    halted.take("stopped", code="CONTACT_EFFORT")
    assert halted.words("STOPPED") == "stopped for CONTACT_EFFORT"
    halted.take("stopped", repeated=True)
    assert halted.words("STOPPED") == "stopped", "who it was an earlier gateway knew"


@pytest.mark.parametrize(
    ("payload", "who"),
    [
        (encode(Stop("ann")), "ann"),
        (b'{"operator": "viewer 2", "why": "new"}', "viewer 2"),
        (b"", NAMELESS),
        (b"{}", NAMELESS),
        (b"\xff\x00", NAMELESS),
        (b'{"operator": "\\u001b[2J"}', NAMELESS),
        (b'{"operator": "' + b"a" * 65 + b'"}', NAMELESS),
    ],
)
def test_who_stops_is_taken_from_the_payload_whatever_that_is(payload: bytes, who: str) -> None:
    message = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload))
    assert sender(message) == who
    assert sender(SimpleNamespace(payload=None)) == NAMELESS
    assert sender(SimpleNamespace()) == NAMELESS, "an arm is stopped whatever a message is"
