"""What outlives a daemon: how it ended, and the goals that it owes an end."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from stereoservo.messages import run_record
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.run_record import (
    OpenGoal,
    begin_run,
    end_cause,
    end_run,
    read_goals,
    read_run,
    run_is_up,
    write_goals,
)


@pytest.fixture
def directories(tmp_path: Path) -> CellDirectories:
    return CellDirectories("demo", tmp_path, tmp_path)


def test_the_first_cause_stays_and_the_next_run_knows_it(directories: CellDirectories) -> None:
    assert read_run(directories) is None
    begin_run(directories, "a", 7)
    run_is_up(directories)
    end_run(directories, "the servo process hung")
    end_run(directories, "what came of it")
    run = read_run(directories)
    assert run is not None
    assert (run.cause, run.in_order) == ("the servo process hung", False)
    begin_run(directories, "b", 8)
    run = read_run(directories)
    assert run is not None
    assert (run.boot, run.cause, run.previous) == ("b", "", "the servo process hung")


def test_an_end_in_order_is_nothing_to_speak_of(directories: CellDirectories) -> None:
    begin_run(directories, "a", 7)
    run_is_up(directories)
    end_run(directories, "ended by SIGTERM", in_order=True)
    begin_run(directories, "b", 8)
    run = read_run(directories)
    assert run is not None
    assert run.previous == ""


def test_a_start_that_failed_hides_no_cause_of_the_run_before_it(directories: CellDirectories) -> None:
    begin_run(directories, "a", 7)
    run_is_up(directories)
    end_run(directories, "the servo process hung")
    begin_run(directories, "b", 8)
    end_run(directories, "unknown field `speed`")
    begin_run(directories, "c", 9)
    end_run(directories, "somebody asked for it (SIGINT)", in_order=True)
    begin_run(directories, "d", 10)
    run = read_run(directories)
    assert run is not None
    assert run.previous == "the servo process hung"


def test_a_cause_that_nobody_could_write_is_concluded(
    directories: CellDirectories, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin_run(directories, "a", 7)
    run_is_up(directories)
    run = read_run(directories)
    assert run is not None
    assert "(process 7) was killed (signal 9)" in end_cause(run)
    monkeypatch.setattr(run_record, "machine_start", lambda: "another")
    assert "the computer was switched off" in end_cause(run)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b'{"boot": 5}', b"[" * 50_000, b'{"goals": [{"id": 1}]}'])
def test_a_damaged_record_is_none(content: bytes, directories: CellDirectories) -> None:
    directories.run_record.write_bytes(content)
    directories.open_goals.write_bytes(content)
    assert read_run(directories) is None
    assert read_goals(directories) == ()
    begin_run(directories, "a", 7)
    run_is_up(directories)
    assert read_run(directories) is not None


def test_goals_are_read_as_they_were_written(directories: CellDirectories) -> None:
    goals = (OpenGoal("one", "a"), OpenGoal("two", "b", calibration=True))
    write_goals(directories, goals)
    assert read_goals(directories) == goals
    tree = msgspec.json.decode(directories.open_goals.read_bytes())
    tree["later"] = 1
    directories.open_goals.write_bytes(msgspec.json.encode(tree))
    assert read_goals(directories) == goals
