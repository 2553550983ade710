"""`stereoservo bench soak`: every goal ends once, whatever happens, and nothing grows."""

from __future__ import annotations

import pytest

from stereoservo.core.cycle import Event
from stereoservo.daemon.lockstep import MemoryLinks
from stereoservo_sim.benchmarks import soak


@pytest.mark.parametrize(("goals", "minutes"), [(2, 0.5), pytest.param(12, 120.0, marks=pytest.mark.slow)])
def test_goals_and_faults_for_hours(goals: int, minutes: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak, "GOALS", goals)
    monkeypatch.setattr(soak, "VIRTUAL_MINUTES", minutes)
    figures = soak.run_soak(1, 3, lambda stage, done, total: None)
    assert figures["goals"] == sum(figures["outcomes"].values()) > 0
    assert set(figures["outcomes"]) <= {"goal_reached", "goal_aborted"}
    assert sum(figures["faults"].values()) > 0
    assert figures["events"] > figures["goals"]
    assert figures["fastest_of_limit"] <= 1.0 + 1e-9
    assert figures["descriptors"][0] == figures["descriptors"][1]
    if minutes > 1.0:
        assert figures["memory_slope_mb_per_virtual_hour"] < 1.0
        assert abs(figures["residual_px"]["difference_in_sigma"]) < 4.0


def test_a_goal_that_ends_twice_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak, "TERMINAL", frozenset({"goal_started", "goal_reached", "goal_aborted"}))
    monkeypatch.setattr(soak, "GOALS", 1)
    monkeypatch.setattr(soak, "QUIET", 1.1)
    with pytest.raises(soak.ExperimentError, match=r"ended 2 times: goal_started, goal_reached"):
        soak.run_soak(1, 1, lambda stage, done, total: None)


def test_an_event_that_is_lost_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    published = MemoryLinks.publish_events

    def publish(links: MemoryLinks, events: tuple[Event, ...]) -> None:
        published(links, tuple(event for event in events if event.seq != 2))

    monkeypatch.setattr(MemoryLinks, "publish_events", publish)
    with pytest.raises(soak.ExperimentError, match="events 2 to 2 were lost"):
        soak.run_soak(1, 3, lambda stage, done, total: None)
