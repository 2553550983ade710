"""`stereoservo bench kills` and `bench soak-live`: what they measure on a daemon in real time, in short."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.benchmarks import soak

pytestmark = pytest.mark.process


def quiet(stage: str, done: int, total: int) -> None:
    """Progress that nobody looks at."""


def test_what_was_done_before_a_kill_is_recorded_and_replays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak, "KILLS", 1)
    figures = soak.run_kills(1, 1, quiet)
    assert figures["kills"] == sum(figures["killed"].values()) == 1
    assert figures["replays"] == figures["replays_identical"] > 0
    assert figures["steps"] > 50
    assert figures["share_recorded"] > 0.9  # a machine that stalls while it is recorded may cost some


def test_goals_in_real_time_have_one_end_each_and_no_event_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak, "MINUTES", 0.1)
    figures = soak.run_soak_live(1, 1, quiet)
    assert figures["goals"] == sum(figures["outcomes"].values()) > 0
    assert figures["events_lost"] == 0
    assert 0.0 < figures["disk_mb"] < 100.0
    assert {name.split()[0] for name in figures["processes"]} >= {"servo", "gateway", "supervisor"}


def test_slopes_are_of_the_time_after_a_quarter() -> None:
    hours = np.linspace(0.0, 1.0, 41)
    memory = np.where(hours < 0.2, 300.0 * hours, 60.0 + 2.0 * hours)
    rows = np.stack([hours, memory, np.where(hours < 0.2, 40, 30 + (hours > 0.5))], axis=1)
    slopes = soak._slopes(rows)
    assert slopes["memory_slope_mb_per_hour"] == pytest.approx(2.0)
    assert slopes["descriptors"] == [30, 31]
