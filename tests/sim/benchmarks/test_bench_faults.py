"""`stereoservo bench faults`: its rows and tables. The faults are tested in emulators/bus/test_fault_table.py."""

from __future__ import annotations

import io
import json
import subprocess
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from stereoservo.cli import main as cli
from stereoservo_sim.benchmarks.faults import bench, inputs, service
from stereoservo_sim.benchmarks.faults.bench import distinct_sentences, reliability_page
from stereoservo_sim.emulators.bus.fault_trials import ODRIVE_CASES, FaultCase


@pytest.fixture
def one_case(monkeypatch):
    drive_error = next(case for case in ODRIVE_CASES if case.name == "drive error")
    monkeypatch.setattr(bench, "CASES", {"odrive": (drive_error,)})


WALL = {
    "rows": [
        {
            "fault": "node silent",
            "rest_ms": {"repetitions": 2, "median": 31.5, "max": 33.25},
            "detected_ms": None,
            "bound_ms_in_bit_time": 60.0,
            "never_at_rest": 0,
            "codes": ["silent"],
            "restarts": 0,
            "stalled": ["silent: no TPDO1"],
        }
    ],
    "emulator_loop": {"turns": 9, "stalls": 1, "latest_ns": 2_500_000, "longest_gap_ns": 4_000_000},
    "load": [1.0, 1.0, 1.0],
}


SERVICE = {
    "fault": "servo killed",
    "bound_ms": 180.0,
    "rest_ms": {"repetitions": 1, "median": 23.3, "max": 23.3},
    "within": 1,
    "after": ["not_running"],
    "status_right": 1,
    "status_says": ["no daemon runs"],
    "terminal_events": [1],
    "trials": 1,
    "void": [],
}

INPUT = {
    "input": "joints",
    "fault": "not a number",
    "goal": "either",
    "bound_ms": 270.0,
    "rest_ms": {"repetitions": 2, "median": 120.0, "max": 140.0},
    "within": 2,
    "after": ["active"],
    "reasons": ["JOINT_VALUE", "STOPPED"],
    "outcomes": ["goal_aborted"],
    "terminal_events": [1],
    "works_again": 2,
    "fastest_of_limit": 0.512,
    "trials": 2,
}


def test_rows_and_tables(one_case, monkeypatch):
    asked = []
    monkeypatch.setattr(bench, "run_wall", lambda repetitions, progress: asked.append(repetitions) or WALL)
    monkeypatch.setattr(bench, "run_service", lambda repetitions, tell: [SERVICE])
    monkeypatch.setattr(bench, "run_inputs", lambda repetitions, seed, tell: [INPUT])
    figures = bench.run_faults(2, 5, lambda stage, done, total: None)
    (row,) = figures["rows"]
    assert asked == [1]
    assert figures["ok"]
    assert (row["trials"], row["codes"]) == (2, {"drive_fault": 2})
    assert 0.0 < row["detected_ms_median"] < row["rest_ms_median"] <= row["rest_ms_max"] <= row["bound_ms"]
    assert json.loads(json.dumps(figures, allow_nan=False))["rows"][0]["fault"] == "drive error"
    page = reliability_page({**figures, "machine": {"processor": "one", "cores": 2}})
    assert "| servo killed | 23 / 23 | 180 | 1 of 1 | not_running | 1 of 1 | 1 | no daemon runs | 0 |" in page
    assert "| odrive | drive error | " in page
    told = "JOINT_VALUE, STOPPED | goal_aborted | 1 | 2 of 2 |"
    assert f"| joints | not a number | either | 120 / 140 | 270 | 2 of 2 | active | {told}" in page
    assert "had 0.51 of its velocity limit" in page
    console = Console(width=200, file=io.StringIO(), markup=False)
    bench.show_faults(figures, console)
    text = console.file.getvalue()
    for word in (
        "drive error",
        "drive_fault 2",
        "31.5 / 33.2",
        "2.50 ms late",
        "12.5 ms",
        "servo killed",
        "no daemon runs",
        "JOINT_VALUE",
    ):
        assert word in text


def test_a_sentence_that_differs_in_times_and_numbers_alone_is_printed_once():
    silent = "the gateway has given no sign of life for {} s, since {}. One that hangs for 5 s is killed"
    ended = "Its last run ended at {} {}: the supervisor (process {}) was killed (signal 9)"
    note = "s/recordings/hil-can-{}.mcap: {} steps; it is set aside as model-000004.json.damaged-{}; of joint j1"
    assert distinct_sentences(
        [
            silent.format("1.8", "18:49:47"),
            silent.format("2.0", "18:50:21"),
            "nothing is wrong",
            ended.format("2026-11-23", "14:13:25", 4482),
            ended.format("2026-11-24", "14:13:26", 51),
            silent.format("11", "18:50:21"),
            note.format("20261123T141550.371310Z", 250, 1),
            note.format("20261123T141605.079062Z", 251, 2),
            "nothing is wrong",
        ]
    ) == [
        silent.format("N", "HH:MM:SS"),
        "nothing is wrong",
        ended.format("YYYY-MM-DD", "HH:MM:SS", "N"),
        note.format("STAMP", "N", "N"),
    ]


def test_numbers_that_are_alike_and_sentences_that_are_others_stay():
    said = ["killed by signal 9 after 3 s", "killed by signal 9 after 4 s", "ended by signal 9 after 3 s"]
    assert distinct_sentences(said) == ["killed by signal 9 after N s", "ended by signal 9 after 3 s"]
    assert distinct_sentences(["joint j1 is slow", "joint j2 is slow"]) == [
        "joint j1 is slow",
        "joint j2 is slow",
    ]
    assert distinct_sentences(["200 sockets, epoch 3"]) == ["200 sockets, epoch 3"]
    assert distinct_sentences([]) == []


def test_the_page_has_a_row_for_each_fault_of_the_service():
    text = Path(__file__).parents[3].joinpath("docs/reliability.md").read_text(encoding="utf-8")
    rows = [line.split(" | ")[0].removeprefix("| ") for line in text.splitlines() if line.startswith("| ")]
    assert [name for name in rows if name in {f.name for f in service.FAULTS}] == [
        fault.name for fault in service.FAULTS
    ]


@pytest.mark.parametrize("disk", [service.memory_disk, service.image_disk])
def test_where_nothing_may_be_mounted_the_trials_are_void_with_the_reason(tmp_path, monkeypatch, disk):
    def refused(words, **_):
        raise subprocess.CalledProcessError(32, words, stderr="must be superuser to use mount.\n")

    monkeypatch.setattr(service.subprocess, "run", refused)
    with ExitStack() as mounts:
        bench = SimpleNamespace(
            folder=tmp_path, directories=SimpleNamespace(state=tmp_path / "s"), mounts=mounts, lasting=ExitStack(),
            goals=[], end_daemon=lambda: None, delete_state=lambda: None,
        )  # fmt: skip
        row = service._row(bench, next(fault for fault in service.FAULTS if fault.disk is disk), 3)
    assert (row["trials"], row["within"], row["rest_ms"]) == (0, 0, None)
    assert len(row["void"]) == service.TRIES
    assert all("must be superuser to use mount" in why for why in row["void"])


def test_the_page_has_a_row_for_each_fault_of_the_inputs():
    text = Path(__file__).parents[3].joinpath("docs/reliability.md").read_text(encoding="utf-8")
    rows = [tuple(line.removeprefix("| ").split(" | ")[:3]) for line in text.splitlines()]
    faults_of_inputs = [(fault.input, fault.name, fault.goal) for fault in inputs.FAULTS]
    assert [row for row in rows if row in faults_of_inputs] == faults_of_inputs


def test_a_problem_is_printed_and_the_table_not_ok(one_case, monkeypatch):
    impossible = FaultCase(name="too strict", orders=("fault 3 0x20",), codes=("drive_fault",), bound_ms=1.0)
    monkeypatch.setattr(bench, "CASES", {"odrive": (impossible,)})
    monkeypatch.setattr(bench, "run_wall", lambda repetitions, progress: WALL)
    monkeypatch.setattr(bench, "run_service", lambda repetitions, tell: [])
    monkeypatch.setattr(bench, "run_inputs", lambda repetitions, seed, tell: [])
    figures = bench.run_faults(1, 0, lambda stage, done, total: None)
    assert not figures["ok"]
    (problem,) = figures["rows"][0]["problems"]
    assert problem.startswith("at rest after")


FEW = ("client of a goal killed",)
"""Those of killed processes are in tests/hil/test_lifecycle.py, too."""


@pytest.mark.process
@pytest.mark.parametrize("names", [FEW, pytest.param((), marks=pytest.mark.slow)])
def test_faults_of_the_service(names):
    chosen = tuple(fault for fault in service.FAULTS if not names or fault.name in names)
    assert len(chosen) >= len(FEW)
    told = []
    rows = service.run_service(1, told.append, chosen)
    assert told == rows
    for fault, row in zip(chosen, rows, strict=True):
        if not row["trials"]:
            pytest.skip(f"{fault.name}: no trial on this machine: {'; '.join(row['void'])}")
        assert set(row["after"]) <= set(fault.after), row
        assert row["status_right"] == 1, row
        assert fault.may_go_on or (row["rest_ms"] is None) == (fault.bound_ms is None), row
        assert fault.bound_ms is not None or row["within"] == 1, row
        if not fault.jogs:
            assert row["terminal_events"] == [1], row


FEW_INPUTS = (
    ("frozen: no new sample", "either"),
    ("not a number", "either"),
    ("not a number", "joints"),
    ("from the past", "images"),
    ("everyone's goes back", "either"),
)


@pytest.mark.parametrize("names", [FEW_INPUTS, pytest.param((), marks=pytest.mark.slow)])
def test_faults_of_the_inputs(names):
    chosen = tuple(f for f in inputs.FAULTS if not names or (f.name, f.goal) in names)
    assert len(chosen) >= len(FEW_INPUTS)
    told = []
    rows = inputs.run_inputs(1, 3, told.append, chosen)
    assert told == rows
    for fault, row in zip(chosen, rows, strict=True):
        assert row["trials"] == row["within"] == row["works_again"] == 1, row
        assert row["terminal_events"] == [1], row
        assert row["fastest_of_limit"] <= 1.0, row
        assert (row["rest_ms"] is None) == (fault.notice_ms is None), row
    assert inputs.run_inputs(1, 3, told.append, chosen[:1]) == rows[:1]


@pytest.mark.slow
def test_a_fault_in_real_time_is_measured(one_case, monkeypatch, capsys):
    ordered = [case for case in bench.ORDERED if case[0] == "node silent"]
    monkeypatch.setattr(bench, "ORDERED", tuple(ordered))
    monkeypatch.setattr(bench, "DONE_TO_THE_MASTER", ("master killed",))
    monkeypatch.setattr(bench, "run_service", lambda repetitions, tell: [])
    monkeypatch.setattr(bench, "run_inputs", lambda repetitions, seed, tell: [])
    assert cli.invoke(["bench", "faults", "--repetitions", "1", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    silent, killed = answer["wall"]["rows"]
    for row in (silent, killed):
        assert row["rest_ms"]["repetitions"] == 1
        assert row["never_at_rest"] == row["restarts"] == 0
    assert silent["codes"] == ["silent"]
    assert killed["codes"] == []
    assert answer["wall"]["emulator_loop"]["turns"] > 0
