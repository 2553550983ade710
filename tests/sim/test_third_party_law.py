"""A law of a third party, installed as a wheel: found, run and recorded with no line of the product changed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from stereoservo.control.contracts import LawContract
from stereoservo_sim.tasks.random_tasks import random_tasks
from stereoservo_sim.tasks.task_file import tasks_text
from third_party.resolved_rates import LAW as RESOLVED_RATES
from third_party.wheel import LAW, SOURCE, install_law


class TestResolvedRates(LawContract):
    law = RESOLVED_RATES


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the law is installed, beside one that does not import and one that is no law."""
    folder = tmp_path_factory.mktemp("wheel")
    return install_law(folder, broken="no_such_module:LAW", number="resolved_rates:SOME")


def stereoservo(site: Path, *arguments: str, timeout_s: float = 280.0) -> subprocess.CompletedProcess[str]:
    """The command line in a process in which the wheel is installed."""
    return subprocess.run(
        [sys.executable, "-m", "stereoservo.cli.main", *arguments],
        capture_output=True, text=True, timeout=timeout_s, check=False, stdin=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(site), "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
    )  # fmt: skip


def answer(site: Path, *arguments: str, timeout_s: float = 280.0) -> Any:
    done = stereoservo(site, *arguments, "--json", timeout_s=timeout_s)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


def test_the_law_is_short_and_the_broken_ones_are_listed_with_their_errors(site: Path) -> None:
    assert len(SOURCE.read_text().splitlines()) <= 32
    laws = {law["name"]: law for law in answer(site, "drivers")["laws"]}
    assert laws[LAW]["error"] is None
    assert laws[LAW]["distribution"] == "resolved-rates 1.2"
    assert "ModuleNotFoundError" in laws["broken"]["error"]
    assert "AttributeError" in laws["number"]["error"]
    assert laws["stereo"]["error"] is None


def test_help_lists_it_without_importing_any_law(site: Path) -> None:
    assert LAW in stereoservo(site, "goal", "--help").stdout
    code = (
        "import sys; from stereoservo.cli import goal\n"
        "assert not {'numba', 'resolved_rates', 'stereoservo.control.laws.stereo'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(site)}, check=False, timeout=240
    )
    assert done.returncode == 0


def test_it_aligns_simulated_tasks(site: Path, tmp_path: Path) -> None:
    tasks = tmp_path / "tasks.csv"
    tasks.write_text(tasks_text(random_tasks(11, 2), "test"), encoding="utf-8")
    result = answer(site, "simulate", str(tasks), "--law", LAW, "--jobs", "1")
    assert {task["law"] for task in result["tasks"]} == {LAW}
    assert result["solved"] == 2


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_it_reaches_a_goal_in_the_demonstration_and_its_recording_replays(site: Path, tmp_path: Path) -> None:
    result = answer(site, "demo", "--lockstep", "--law", LAW, "--out", str(tmp_path), timeout_s=880.0)
    assert [goal["law"] for goal in result["goals"]] == [LAW, "cartesian3", "trajectory"]
    assert [goal["outcome"] for goal in result["goals"]] == ["reached"] * 3
    assert result["replay"]["identical"] is True
    flight = str(tmp_path / "flight.mcap")
    without = stereoservo(tmp_path, "replay", flight, "--json")
    assert f"law {LAW!r}" in json.loads(without.stdout)["error"]["message"]
