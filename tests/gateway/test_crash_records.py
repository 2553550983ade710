"""Each goal has exactly one end, and each event its effect once, whoever is killed meanwhile."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from stereoservo.core.cycle import Event
from stereoservo.gateway import persistence
from stereoservo.gateway.persistence import HandledEvents, OpenGoalRecord
from stereoservo.gateway.publisher import EventLog
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.run_record import OpenGoal, begin_run, end_run, read_goals, run_is_up


class Gateway:
    """What of a gateway's process tells and keeps goals."""

    def __init__(self, directories: CellDirectories, boot: str) -> None:
        self.goals = OpenGoalRecord(directories, boot)
        self.log = EventLog(boot, lambda _: None, self.goals.observe)
        self.goals.end_earlier(self.log)

    @property
    def ends(self) -> list[tuple[str, str, str]]:
        events = self.log.since(1).events
        return [(e.kind, e.id, e.message) for e in events if e.kind.endswith("aborted")]


@pytest.fixture
def directories(tmp_path: Path) -> CellDirectories:
    return CellDirectories("demo", tmp_path, tmp_path)


def test_the_next_run_ends_the_goals_of_one_that_was_killed_once(directories: CellDirectories) -> None:
    begin_run(directories, "a", 7)
    run_is_up(directories)
    first = Gateway(directories, "a")
    for kind, goal in (
        ("goal_accepted", "queued"), ("goal_accepted", "done"), ("goal_started", "done"), ("goal_reached", "done"),
        ("calibration_progress", "trials"), ("calibration_progress", "trials"), ("goal_started", ""),
    ):  # fmt: skip
        first.log.add(kind, id=goal)
    assert {goal.id for goal in read_goals(directories)} == {"queued", "trials"}
    begin_run(directories, "b", 8)
    second = Gateway(directories, "b")
    assert [(kind, goal) for kind, goal, _ in second.ends] == [
        ("goal_aborted", "queued"),
        ("calibration_aborted", "trials"),
    ]
    assert "was killed (signal 9)" in second.ends[0][2]
    assert read_goals(directories) == ()
    assert Gateway(directories, "b").ends == []
    begin_run(directories, "c", 9)
    assert Gateway(directories, "c").ends == []


def test_the_gateway_that_is_left_tells_why(directories: CellDirectories) -> None:
    begin_run(directories, "a", 7)
    run_is_up(directories)
    gateway = Gateway(directories, "a")
    gateway.log.add("goal_accepted", id="g")
    assert gateway.goals.any_of_this_run
    end_run(directories, "the servo process ended by signal SIGKILL (signal 9)")
    gateway.goals.end_current(gateway.log)
    gateway.goals.end_current(gateway.log)
    assert gateway.ends == [("goal_aborted", "g", "the servo process ended by signal SIGKILL (signal 9)")]
    begin_run(directories, "b", 8)
    assert Gateway(directories, "b").ends == []


def test_a_gateway_started_again_in_the_same_run_ends_nothing(directories: CellDirectories) -> None:
    begin_run(directories, "a", 7)
    run_is_up(directories)
    Gateway(directories, "a").log.add("goal_accepted", id="g")
    again = Gateway(directories, "a")
    assert again.ends == []
    again.log.add("goal_reached", id="g")
    assert read_goals(directories) == ()


def event(seq: int, t_ns: int = 0) -> Event:
    return Event(seq, t_ns, "taught")


def test_the_next_gateway_knows_what_was_handled(tmp_path: Path) -> None:
    path, told = tmp_path / "handled.slot", []
    first = HandledEvents(path, lambda *note: told.append(note))
    assert not first.is_journaled(event(1))
    first.mark(event(3), acted=True)
    first.mark(event(5), acted=False)
    first.close()
    second = HandledEvents(path, lambda *note: told.append(note))
    assert second.is_journaled(event(5))
    assert not second.is_journaled(event(6))
    assert second.is_acted_on(event(3))
    assert not second.is_acted_on(event(4))
    assert told == []


@pytest.mark.parametrize("damage", ["record", "empty", "short", "noise", "long"])
def test_where_it_is_damaged_nothing_of_before_the_start_is_done_twice(tmp_path: Path, damage: str) -> None:
    path, told = tmp_path / "handled.slot", []
    first = HandledEvents(path, lambda *note: told.append(note))
    first.mark(event(3), acted=True)
    first.close()
    content = bytearray(path.read_bytes())
    content[-1] ^= 0xFF  # half of the record is another one's
    damaged = {
        "record": bytes(content),
        "empty": b"",
        "short": content[:70],
        "noise": b"\xff" * 80,
        "long": content * 2,
    }
    path.write_bytes(damaged[damage])
    before = event(10**6, time.monotonic_ns())
    second = HandledEvents(path, lambda *note: told.append(note))
    assert second.is_journaled(before)
    assert second.is_acted_on(before)
    after = event(10**6 + 1, time.monotonic_ns())
    assert not second.is_acted_on(after)
    ((topic, text),) = told
    assert topic == "handled events"
    assert "was damaged and is started empty" in text
    second.mark(after, acted=True)
    second.close()
    third = HandledEvents(path, lambda *note: told.append(note))
    assert third.is_acted_on(after)
    assert len(told) == 1


class FullDisk:
    """Takes no goals while it is full; a clock of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full, self.now = True, 100.0
        write = persistence.write_goals

        def write_goals(directories: CellDirectories, goals: tuple[OpenGoal, ...]) -> None:
            if self.full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            write(directories, goals)

        monkeypatch.setattr(persistence, "write_goals", write_goals)
        monkeypatch.setattr(persistence, "time", SimpleNamespace(monotonic=lambda: self.now))


def with_a_goal_on_a_full_disk(
    directories: CellDirectories, monkeypatch: pytest.MonkeyPatch
) -> tuple[Gateway, FullDisk]:
    """A gateway that wrote an accepted goal before its disk was full."""
    begin_run(directories, "a", 7)
    run_is_up(directories)
    gateway = Gateway(directories, "a")
    gateway.log.add("goal_accepted", id="g")
    return gateway, FullDisk(monkeypatch)


def test_a_goal_that_ended_on_a_full_disk_does_not_end_again(
    directories: CellDirectories, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, disk = with_a_goal_on_a_full_disk(directories, monkeypatch)
    first.log.add("goal_reached", id="g")
    for _ in range(50):
        disk.now += 0.1
        first.goals.poll()
    assert [goal.id for goal in read_goals(directories)] == ["g"]
    assert capsys.readouterr().err.count("No space left") == 1
    disk.full = False
    disk.now += 1.0
    first.goals.poll()
    assert read_goals(directories) == ()
    begin_run(directories, "b", 8)
    assert Gateway(directories, "b").ends == []


def test_the_next_gateway_mends_what_a_full_disk_has_left(
    directories: CellDirectories, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, disk = with_a_goal_on_a_full_disk(directories, monkeypatch)
    events = [first.log.add("goal_started", id="g"), first.log.add("goal_reached", id="g")]
    events.append(first.log.add("goal_started", id="later"))
    disk.full = False
    second = Gateway(directories, "a")
    assert second.goals.any_of_this_run
    for told in events:  # the core's events come to it again
        second.goals.observe(told, repeated=True)
    second.goals.poll()
    assert [goal.id for goal in read_goals(directories)] == ["later"]
