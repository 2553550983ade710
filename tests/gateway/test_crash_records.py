"""Each goal has exactly one end, and each event its effect once, whoever is killed meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereoservo.gateway.crash_records import HandledEvents, OpenGoalRecord
from stereoservo.gateway.publisher import EventLog
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.run_record import begin_run, end_run, read_goals, run_is_up


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


def test_the_next_gateway_knows_what_was_handled(tmp_path: Path) -> None:
    path = tmp_path / "handled.slot"
    first = HandledEvents(path)
    assert not first.is_journaled(1)
    first.mark(3, acted=True)
    first.mark(5, acted=False)
    first.close()
    second = HandledEvents(path)
    assert second.is_journaled(5)
    assert not second.is_journaled(6)
    assert second.is_acted_on(3)
    assert not second.is_acted_on(4)


def test_a_gateway_killed_while_it_wrote_leaves_nothing_that_hinders_the_next(tmp_path: Path) -> None:
    path = tmp_path / "handled.slot"
    first = HandledEvents(path)
    first.mark(3, acted=True)
    first.close()
    content = bytearray(path.read_bytes())
    content[-1] ^= 0xFF  # half of the record is another one's
    path.write_bytes(content)
    second = HandledEvents(path)
    assert not second.is_journaled(1)
    second.mark(4, acted=False)
    assert second.is_journaled(4)
