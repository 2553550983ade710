"""The demonstration as the command line gives it: in lockstep (more seeds are slow), and once as real processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from scipy.stats import chi2

SEEDS = (0, 1)
MORE_SEEDS = range(2, 10)
TIMEOUT_S = 900


def run_demo(out: Path, *options: str) -> dict[str, Any]:
    """One demo as a process; its JSON. Prints what it said when it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "stereoservo.cli.main", "demo", "--json", "--out", str(out), *options],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False, stdin=subprocess.DEVNULL,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
    )  # fmt: skip
    if done.returncode != 0:
        print(done.stdout, done.stderr)
    assert done.returncode == 0
    assert done.stdout.count("\n") == 1
    result: dict[str, Any] = json.loads(done.stdout)
    return result


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Future[dict[str, Any]]]]:
    """All lockstep demos, two at a time: every seed, and seed 0 again."""
    with ThreadPoolExecutor(2) as pool:
        runs = {
            name: pool.submit(run_demo, tmp_path_factory.mktemp(f"demo-{name}"), "--lockstep", "--seed", seed)
            for name, seed in [*((str(seed), str(seed)) for seed in SEEDS), ("again", "0")]
        }
        yield runs
        for run in runs.values():
            run.cancel()


def check(result: dict[str, Any]) -> None:
    """The promises of one demonstration."""
    assert result["converged"] is True
    assert [goal["outcome"] for goal in result["goals"]] == ["reached"] * 3
    assert {goal["law"] for goal in result["goals"]} == {"stereo", "cartesian3", "trajectory"}
    assert max(goal["rotation_deg"] for goal in result["goals"]) >= 179.0
    for goal in result["goals"]:
        assert goal["final_error_px"] <= 0.3
        assert goal["final_error_mm"] <= 0.5
        if goal["law"] != "stereo":
            assert goal["max_line_deviation_mm"] <= 5.0
    assert result["calibration"]["joints"] == 6
    assert result["calibration"]["chi2_ok"] is True
    assert result["replay"]["identical"] is True
    report = Path(result["report"]).read_text()
    assert report.count("data:image/png;base64,") >= 6


@pytest.mark.timeout(TIMEOUT_S)
@pytest.mark.parametrize("seed", SEEDS)
def test_uncalibrated_cell_calibrates_itself_and_reaches_its_goals(
    demos: dict[str, Future[dict[str, Any]]], seed: int
) -> None:
    check(demos[str(seed)].result())


@pytest.mark.slow
@pytest.mark.timeout(TIMEOUT_S)
@pytest.mark.parametrize("seed", MORE_SEEDS)
def test_more_seeds_do_likewise(tmp_path: Path, seed: int) -> None:
    check(run_demo(tmp_path, "--lockstep", "--seed", str(seed)))


@pytest.mark.timeout(TIMEOUT_S)
def test_lockstep_is_deterministic_given_the_seed(demos: dict[str, Future[dict[str, Any]]]) -> None:
    first, again, other = demos["0"].result(), demos["again"].result(), demos["1"].result()
    assert first["goals"] == again["goals"]
    assert Path(first["model"]).read_bytes() == Path(again["model"]).read_bytes()
    assert Path(first["model"]).read_bytes() != Path(other["model"]).read_bytes()


@pytest.mark.timeout(TIMEOUT_S)
def test_calibration_residual_is_the_measurement_noise_pooled_over_seeds(
    demos: dict[str, Future[dict[str, Any]]],
) -> None:
    """Sum of squared residuals in sigmas against chi-square with measurements less parameters, both summed."""
    results = [demos[str(seed)].result()["calibration"] for seed in SEEDS]
    total, freedom = sum(r["chi2"] for r in results), sum(r["degrees_of_freedom"] for r in results)
    # The systematic part, an eighth of the variance at a stop, is one number for all views; known to 40 %: 5 % in all.
    low, high = chi2.ppf(0.0005, freedom) * 0.95, chi2.ppf(0.9995, freedom) * 1.05
    assert low < total < high


@pytest.mark.process
@pytest.mark.timeout(TIMEOUT_S)
def test_demo_as_real_processes(tmp_path: Path) -> None:
    result = run_demo(tmp_path)
    check(result)
    assert result["lockstep"] is False
    assert result["loop"]["rate_hz"] == 250.0
    assert "skipped" in result["loop"]
    left = subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True, text=True, check=False)
    assert left.stdout == ""
