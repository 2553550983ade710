"""Processes that hang: what their heartbeats say, and what the supervisor makes of it."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

import pytest

from stereoservo.daemon.heartbeat import (
    CAMERA_OPENS_S,
    DRIVER_CALL_S,
    GATEWAY_HANG_S,
    HEARTBEAT_BYTES,
    HEARTBEAT_LAYOUT,
    REQUEST_S,
    SERVO_HANG_S,
    SUPERVISOR_HANG_S,
    VISION_HANG_S,
    HangWatch,
    HeartbeatWriter,
)
from stereoservo.daemon.seqlock import create_slot
from stereoservo.daemon.supervisor import LATE_S, WATCH_EVERY_S, ServoDiedError, Supervisor
from stereoservo.gateway.process import Gateway
from stereoservo.messages.directories import CellDirectories


class Bench:
    """One process's heartbeat, and the watch over it."""

    def __init__(self, path: Path) -> None:
        create_slot(path, HEARTBEAT_BYTES, HEARTBEAT_LAYOUT)
        self.watch = HangWatch(path)
        self.path = path
        self.process = HeartbeatWriter(path)
        self.watch.begin()


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "it.slot")


def test_a_process_is_watched_from_its_first_beat_on(bench: Bench) -> None:
    assert bench.watch.check(1000.0) == ""
    bench.process.beat(2.0)
    assert bench.watch.check(2000.0) == ""
    assert bench.watch.check(2001.9) == ""
    assert bench.watch.check(2002.5) == "it gave no sign of life for 2.5 s (limit 2 s)"


def test_what_takes_long_is_announced(bench: Bench) -> None:
    bench.process.beat(2.0)
    bench.process.beat(15.0)
    assert bench.watch.check(1000.0) == ""
    assert bench.watch.check(1014.0) == ""
    bench.process.beat(2.0)
    assert bench.watch.check(1015.0) == ""
    assert "limit 2 s" in bench.watch.check(1017.5)


def test_a_watch_that_was_late_begins_anew(bench: Bench) -> None:
    bench.process.beat(2.0)
    assert bench.watch.check(1000.0) == ""
    assert bench.watch.check(1009.0, late=True) == ""
    assert bench.watch.check(1010.9) == ""
    assert bench.watch.check(1011.2) != ""


def test_a_new_process_is_not_judged_by_the_beats_of_the_one_before(bench: Bench) -> None:
    bench.process.beat(2.0)
    bench.process.close()
    bench.watch.begin()
    assert bench.watch.check(1000.0) == ""
    assert bench.watch.check(2000.0) == ""
    process = HeartbeatWriter(bench.path)
    process.beat(2.0)
    assert bench.watch.check(2001.0) == ""
    assert bench.watch.check(2004.0) != ""


def test_limits_are_those_of_the_page() -> None:
    """When servo and vision announce the longer one is tested beside their cycles."""
    page = (Path(__file__).parents[2] / "docs/safety.md").read_text(encoding="utf-8")
    told = {
        row[1]: [float(limit) for limit in re.findall(r"([\d.]+) s\b", row[2])]
        for row in re.finditer(r"^\| (servo|gateway|vision|supervisor) \| ([^|]*) \|", page, re.MULTILINE)
    }
    assert told == {
        "servo": [SERVO_HANG_S, DRIVER_CALL_S],
        "gateway": [GATEWAY_HANG_S, REQUEST_S],
        "vision": [VISION_HANG_S, CAMERA_OPENS_S],
        "supervisor": [SUPERVISOR_HANG_S],
    }


def test_a_gateway_has_its_longer_limit_while_it_serves_a_request_and_no_longer(bench: Bench) -> None:
    gateway = MagicMock(
        _announce_due_s=None, _state=MagicMock(newest=None), _observations=[],
        _stop=MagicMock(enables=[]), _steps_recorded=0.0, _heartbeat=bench.process,
    )  # fmt: skip
    gateway._servo.events.return_value = ()
    queries = MagicMock()
    queries.try_recv.side_effect = lambda: None
    gateway._queries = lambda: Gateway._queries(gateway)
    clock = [1000.0]
    served = []

    def hung_after(seconds: float) -> str:
        return bench.watch.check(clock[0] + seconds)

    def serve(query: object) -> None:
        clock[0] += 1000.0
        served.append(query)
        assert hung_after(0.0) == ""
        assert hung_after(59.9) == ""
        assert "(limit 60 s)" in hung_after(60.1)

    gateway._sources = ((queries, serve),)
    assert not Gateway.run_once(gateway)
    assert hung_after(0.0) == ""
    assert hung_after(4.9) == ""
    assert "(limit 5 s)" in hung_after(5.1)
    queries.try_recv.side_effect = ["a query", None]
    assert Gateway.run_once(gateway)
    assert served == ["a query"]
    clock[0] += 1000.0
    assert hung_after(0.0) == ""
    assert "(limit 5 s)" in hung_after(5.1)


# -- the supervisor -----------------------------------------------------------------------------------------


class StubProcess:
    """A process that runs until it is killed."""

    def __init__(self) -> None:
        self.code: int | None = None

    def poll(self) -> int | None:
        return self.code

    def kill(self) -> None:
        self.code = -9


class Watched:
    """A supervisor of stub processes on its own clock, each with a heartbeat that a test gives."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        directories = CellDirectories("bench", root, root)
        names = ("servo", "gateway", "vision-left")
        for name in names:
            create_slot(directories.heartbeat_slot(name), HEARTBEAT_BYTES, HEARTBEAT_LAYOUT)
        plan = SimpleNamespace(
            runtime=str(root),
            directories=directories,
            cameras=(SimpleNamespace(name="left"),),
            joints=SimpleNamespace(simulated=False),
        )
        self.now = 1000.0
        self.started: list[str] = []
        self.said: list[tuple[str, str]] = []

        def start(child: Any) -> None:
            self.started.append(child.name)
            child.watch.begin()
            child.process = StubProcess()
            child.started = self.now

        monkeypatch.setattr("stereoservo.daemon.supervisor._start", start)
        monkeypatch.setattr("stereoservo.daemon.supervisor.restore", lambda plan: [])
        self.supervisor = Supervisor(cast(Any, plan))
        self.supervisor._reporter = cast(
            Any,
            SimpleNamespace(report=lambda kind, text: self.said.append((kind, text)), flush=lambda: None),
        )
        self.beats = {name: HeartbeatWriter(directories.heartbeat_slot(name)) for name in names}
        for child in self.supervisor.children:
            start(child)
        self.started.clear()

    def go_on(self, seconds: float, *, silent: str = "") -> None:
        """Time goes on; all processes give signs of life, but for one."""
        for _ in range(round(seconds / WATCH_EVERY_S)):
            self.now += WATCH_EVERY_S
            for name, beat in self.beats.items():
                if name != silent:
                    beat._due_ns = 0
                    beat.beat(2.0)
            self.supervisor.check(self.now)


@pytest.fixture
def watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Watched:
    return Watched(tmp_path, monkeypatch)


@pytest.mark.parametrize("name", ["gateway", "vision-left"])
def test_a_process_that_hangs_is_killed_and_started_again(name: str, watched: Watched) -> None:
    watched.go_on(1.0)
    watched.go_on(1.9, silent=name)
    assert watched.said == []
    watched.go_on(0.3, silent=name)
    ((kind, text),) = watched.said
    assert kind == "process_hung"
    assert text.startswith(f"{name} hung: it gave no sign of life for 2.")
    assert "(limit 2 s)" in text
    assert "starting again" in text
    assert watched.started == []
    watched.go_on(2.0, silent=name)  # it starts, and is given time to
    assert watched.started == [name]
    watched.go_on(60.0, silent=name)
    assert len(watched.said) == 1


def test_a_servo_process_that_hangs_ends_the_daemon(watched: Watched) -> None:
    watched.go_on(1.0)
    process = watched.supervisor.servo.process
    with pytest.raises(ServoDiedError, match=r"the servo process hung: .* \(limit 2 s\).*run the cell again"):
        watched.go_on(3.0, silent="servo")
    assert process is not None
    assert process.poll() == -9
    assert watched.now < 1000.0 + 1.0 + 2.0 + 0.2
    ((kind, _),) = watched.said
    assert kind == "process_hung"


def test_time_in_which_the_supervisor_stood_counts_against_nobody(watched: Watched) -> None:
    watched.go_on(1.0)
    for _ in range(5):
        watched.now += 1.9 + LATE_S
        watched.supervisor.check(watched.now)
    assert watched.said == []
    assert watched.supervisor.servo.process is not None
