"""Drift that grows from check to check is told before it matters."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.change.model_check import find_trend
from stereoservo.daemon.jobs.check_job import KEPT_CHECKS, load_checks, save_checks
from stereoservo.messages.check_report import CheckReport, Drift

START = datetime(2026, 1, 1, tzinfo=UTC)
PX_PER_RAD = 400.0


def report(day: float, x: dict[str, float], sigma: float, epoch: int = 1) -> CheckReport:
    drifts = tuple(Drift("joint", name, (value,), (sigma**-2,), abs(value) * PX_PER_RAD) for name, value in x.items())
    return CheckReport(
        "holds", "", epoch, 7, 400, 400.0, 400.0, 1.0, 0.05, 0.25, {}, {}, {}, (), drifts, 0,
        (START + timedelta(days=day)).isoformat(),
    )  # fmt: skip


def checks(speed: float, sigma: float, seed: int, count: int = 8, every: float = 15.0) -> list[CheckReport]:
    rng = np.random.default_rng(seed)
    return [
        report(every * k, {f"j{j}": (j == 2) * speed * every * k + rng.normal(0, sigma) for j in range(6)}, sigma)
        for k in range(count)
    ]


def test_steady_growth_is_named_with_the_day_it_will_matter() -> None:
    speed, sigma = 2e-6, 1e-5  # rad a day: 0.25 px at 625 rad⁻¹ … day 312
    found = find_trend(checks(speed, sigma, 1))
    assert found is not None
    assert (found.kind, found.subject, found.checks) == ("joint", "j2", 8)
    assert found.px_a_day == pytest.approx(speed * PX_PER_RAD, rel=0.2)
    assert found.days == pytest.approx(0.25 / PX_PER_RAD / speed - 105, rel=0.25)
    assert "zero of joint j2 has changed steadily over 8 checks" in found.message
    assert "will cross the limit of 0.25 px in about" in found.message
    beyond = find_trend(checks(1e-5, sigma, 1))
    assert beyond is not None
    assert beyond.days == 0.0


def test_unchanging_estimates_do_not_grow() -> None:
    grown = [find_trend(checks(0.0, 1e-5, seed)) for seed in range(300)]
    assert sum(one is not None for one in grown) <= 4  # expected 0.3 %: more than 4 has a chance of 1e-3


def test_checks_of_another_model_do_not_count() -> None:
    history = checks(2e-6, 1e-5, 2)
    assert find_trend([msgspec.structs.replace(c, model_epoch=k // 6) for k, c in enumerate(history)]) is None
    assert find_trend(history[:2]) is None
    assert find_trend([]) is None


def test_history_is_bounded_and_survives_a_damaged_line(tmp_path: Path) -> None:
    path = tmp_path / "checks.jsonl"
    assert load_checks(path) == ([], 0)
    many = [report(k, {"j1": 0.1 * k}, 1e-5) for k in range(KEPT_CHECKS + 5)]
    save_checks(path, many)
    again, lost = load_checks(path)
    assert (len(again), lost) == (KEPT_CHECKS, 0)
    assert again == many[5:]
    path.write_bytes(path.read_bytes()[:-40])
    again, lost = load_checks(path)
    assert (len(again), lost) == (KEPT_CHECKS - 1, 1)


@pytest.mark.parametrize(
    "change",
    [
        lambda line: b"\xff" + line,
        lambda line: b"[" * 60_000,
        lambda line: line[:-9],
        lambda line: b"\0" * 40,
        lambda line: line.replace(b'"created":"', b'"created":"yesterday '),
        lambda line: line.replace(b'"information":[', b'"information":[1.0,'),
    ],
    ids=["not UTF-8", "nested", "cut", "zeros", "no time", "too long"],
)
def test_a_line_that_cannot_be_used_is_counted(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    path = tmp_path / "checks.jsonl"
    good = [report(k, {"j1": 0.1}, 1e-5) for k in (1, 3)]
    damaged = change(msgspec.json.encode(report(2, {"j1": 0.1}, 1e-5)))
    path.write_bytes(msgspec.json.encode(good[0]) + b"\n" + damaged + b"\n" + msgspec.json.encode(good[1]))
    assert load_checks(path) == (good, 1)
