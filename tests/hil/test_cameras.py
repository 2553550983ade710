"""Cameras as MJPEG streams that go wrong in mid-goal: the goal is reached, or the arm stops and says why."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from stereoservo.client import Client, GoalHandle
from stereoservo.messages.wire import EventMessage

from .can_bench import CanBench, codes
from .conftest import at_rest, eventually, processes, recover

pytestmark = pytest.mark.process

FAKE_ARM = '[joints]\ndriver = "fake"\n\n[joints.options]\ncommand_timeout_s = 0.4\n'
"""The cameras are under test: the arm behind them may be a light one."""


@pytest.fixture(scope="module")
def bench(roots: Path) -> Iterator[CanBench]:
    """Emulated cameras and a daemon that has calibrated itself through them and knows the goal ``park``."""
    bench = CanBench.emulated(roots / "streams", joints=FAKE_ARM)
    try:
        bench.start_daemon()
        with Client(bench.name) as client:
            client.enable()
            assert client.calibrate(timeout_s=300.0).covariance_ok
            client.teach("park", frames=5)
        yield bench
    finally:
        bench.end()
    eventually("no process is left", lambda: not processes(bench.directories))


@pytest.fixture
def client(bench: CanBench) -> Iterator[Client]:
    """A client, with the arm enabled, both cameras as they should be and heard, nothing in hand."""
    with Client(bench.name) as client:
        order(bench, "clear all")
        recover(client)
        goal = client.status().goal
        if goal:
            client.cancel(goal)
        eventually("both cameras see, the arm rests", lambda: sees(client) and at_rest(client))
        yield client


def order(bench: CanBench, text: str) -> str:
    """An order to the emulated cameras."""
    assert bench.cameras is not None
    return bench.cameras.order(text)


def sees(client: Client) -> bool:
    """Whether both cameras see markers now."""
    seen = client.status().visible
    return len(seen) == 2 and all(count > 0 for count in seen.values())


def under_way(client: Client) -> GoalHandle:
    """Off by joints, then on the way back to ``park`` by what the cameras see."""
    joints = client.status().joints
    client.goal({name: joints[name] + 0.12 for name in ("j1", "j4", "j5", "j6")}).reached(60.0)
    handle = client.goal("park", law="cartesian3", tolerance_px=0.5, hold_frames=3, time_limit_s=60.0)
    eventually("the arm moves", lambda: not at_rest(client))
    return handle


def events_after(client: Client, first: int) -> list[EventMessage]:
    """Events from number ``first`` on."""
    return list(client.events(first).events)


def told(client: Client, first: int, kind: str) -> list[str]:
    """What events of ``kind`` said since number ``first``."""
    return [event.message for event in events_after(client, first) if event.kind == kind]


@pytest.mark.parametrize(
    "text",
    [
        "drop all for 2s",
        "freeze left for 1s",
        "disconnect all",
        "truncate left 5",
        pytest.param("freeze all for 2s", marks=pytest.mark.slow),
        pytest.param("drop left for 2s", marks=pytest.mark.slow),
        pytest.param("stall left for 2s", marks=pytest.mark.slow),
        pytest.param("cut all", marks=pytest.mark.slow),
        pytest.param("refuse left for 2s", marks=pytest.mark.slow),
        pytest.param("refuse all for 3s", marks=pytest.mark.slow),
        pytest.param("corrupt all 10", marks=pytest.mark.slow),
        pytest.param("black left for 2s", marks=pytest.mark.slow),
        pytest.param("white all for 2s", marks=pytest.mark.slow),
        pytest.param("exposure all 0.5 for 5s", marks=pytest.mark.slow),
        pytest.param("lamp on for 5s", marks=pytest.mark.slow),
        pytest.param("loss all 20% for 5s", marks=pytest.mark.slow),
        pytest.param("jitter all 5ms for 5s", marks=pytest.mark.slow),
    ],
)
def test_what_passes_does_not_change_the_outcome(bench: CanBench, client: Client, text: str) -> None:
    handle = under_way(client)
    order(bench, text)
    result = handle.reached(90.0)
    assert result.error_px is not None
    assert result.error_px <= 0.5


@pytest.mark.slow
def test_mirrored_pictures_end_a_goal_and_right_ones_make_the_model_good_again(bench: CanBench, client: Client) -> None:
    handle = under_way(client)
    order(bench, "flip all for 1s")
    result = handle.wait(90.0)
    assert result.outcome == "aborted"
    assert "images" in result.why
    eventually("the arm rests", lambda: at_rest(client))
    eventually("the model is good again", lambda: client.status().model == "valid", 60.0)
    assert client.goal("park", tolerance_px=0.5, hold_frames=3).reached(90.0).error_px is not None


def test_both_cameras_dark_for_good_stop_the_arm_with_the_reason_and_light_lets_it_go_on(
    bench: CanBench, client: Client
) -> None:
    handle = under_way(client)
    order(bench, "black all")
    eventually(f"features stale: {codes(client)}", lambda: "FEATURES_STALE" in codes(client))
    eventually("the arm rests", lambda: at_rest(client))
    time.sleep(0.3)
    assert at_rest(client)
    assert client.status().lifecycle == "active"
    order(bench, "clear all")
    handle.reached(90.0)


def test_a_camera_that_goes_away_is_told_lost_and_told_back(bench: CanBench, client: Client) -> None:
    first = client.status().last_event + 1
    order(bench, "refuse left")
    eventually("camera_lost", lambda: told(client, first, "camera_lost"))
    order(bench, "clear left")
    eventually("camera_back", lambda: told(client, first, "camera_back"))
    (lost,) = told(client, first, "camera_lost")
    assert "left" in lost
    assert "/left.mjpg" in lost


@pytest.mark.slow
def test_pictures_of_another_size_are_refused_with_both_sizes(bench: CanBench, client: Client) -> None:
    first = client.status().last_event + 1
    order(bench, "size left 320x240")
    eventually("camera_lost", lambda: told(client, first, "camera_lost"))
    (lost,) = told(client, first, "camera_lost")
    assert "320" in lost
    assert "640" in lost
    assert client.status().visible.get("left", 0) == 0 or "FEATURES_STALE" in codes(client) or at_rest(client)


@pytest.mark.slow
def test_exchanged_cables_end_in_a_stop_with_a_reason_or_at_the_goal(bench: CanBench, client: Client) -> None:
    handle = under_way(client)
    order(bench, "swap left right")
    eventually("a reason or the goal", lambda: bool(client.status().reasons) or not client.status().goal, 30.0)
    if client.status().goal:
        eventually("the arm rests", lambda: at_rest(client))
        handle.abandon()
