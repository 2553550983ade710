"""Taught goals in and out of the gateway: stored with model and tool, drawn, resolved, with what is seen now."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import Event, Sample
from stereoservo.gateway.observation_cache import ObservationCache
from stereoservo.gateway.persistence import TaughtStore
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.teaching import TaughtGoalRegistry
from stereoservo.messages.goals import Feature, FeatureTarget, IncidenceSpec, IncidenceTarget, TaughtTarget
from stereoservo.messages.wire import Synthesise
from stereoservo.ports.devices import CameraObservation

from .scene import BODY, TOOL, WORK, Cameras, make_model, placed, some_pose

RNG = np.random.default_rng(21)
MODEL = make_model(RNG, Cameras(), placed(BODY, some_pose(RNG)))
HAND, TABLE = some_pose(RNG), some_pose(RNG)


class Bench:
    def __init__(self, path: Path) -> None:
        self.model: Any = MODEL
        self.log = EventLog("boot", lambda _: None)
        self.sights = ObservationCache({"left": 0.0, "right": 0.0})
        self.store = TaughtStore(path / "taught.json")
        self.teaching = TaughtGoalRegistry(self.store, self.sights, lambda: self.model, self.log)

    def show(self, points: Any) -> None:
        """A frame of both cameras, now."""
        for name, seen in Cameras().pixels(points).items():
            now = time.monotonic_ns()
            ids, pixels = np.array(list(seen)), np.array(list(seen.values()))
            covariances = np.tile(1e-4 * np.eye(2), (len(ids), 1, 1))
            self.sights.add(CameraObservation(name, 1, now, now, ids, pixels, covariances))

    def taught(self, points: Any, request: int = 7) -> None:
        samples = tuple(
            Sample(
                name, np.array(list(seen)), np.array(list(seen.values())), np.tile(1e-4 * np.eye(2), (len(seen), 1, 1)),
                5, np.full(len(seen), 5.0), np.zeros(len(seen)),
            )
            for name, seen in Cameras().pixels(points).items()
        )  # fmt: skip
        self.teaching.taught(Event(1, 1, "taught", name="pick", request=request, samples=samples))

    def said(self) -> list[tuple[str, str]]:
        return [(event.kind, event.message) for event in self.log.since(1).events]


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_goal_is_stored_with_the_tool_of_its_request(bench: Bench) -> None:
    bench.teaching.expect(7, (20, 21, 22))
    bench.taught(placed(BODY | TOOL, HAND) | placed(WORK, TABLE))
    goal = bench.teaching.goals["pick"]
    assert goal.tool == (20, 21, 22)
    assert set(goal.target.set_points["left"]) == set(BODY)
    assert set(goal.others["left"]) == set(TOOL) | set(WORK)
    bench.taught(placed(BODY, HAND), request=8)
    assert bench.teaching.goals["pick"].tool == ()
    assert bench.said() == []


def test_a_tool_that_was_not_seen_teaches_nothing_and_is_reported(bench: Bench) -> None:
    bench.teaching.expect(7, (20, 21, 99))
    bench.taught(placed(BODY | TOOL, HAND))
    bench.model = None
    bench.taught(placed(BODY | TOOL, HAND), request=8)
    assert bench.teaching.names == ()
    (_, unseen), (_, gone) = bench.said()
    assert "no camera saw markers 99 of the tool" in unseen
    assert "the model that it was seen with is gone" in gone


def test_what_is_seen_now_carries_a_goal_over(bench: Bench) -> None:
    bench.taught(placed(BODY, HAND) | placed(WORK, TABLE))
    after = some_pose(np.random.default_rng(3))
    with pytest.raises(TransferError, match="0 markers beside the body"):
        bench.teaching.resolve(TaughtTarget("pick", "workpiece"))
    bench.show(placed(WORK, after))
    found = bench.teaching.resolve(TaughtTarget("pick", "workpiece")).target
    truth = Cameras().pixels(placed(BODY, after @ np.linalg.inv(TABLE) @ HAND))
    for camera, seen in found.set_points.items():
        for marker, pixel in seen.items():
            assert pixel == pytest.approx(tuple(truth[camera][marker]), abs=1e-4)


def test_a_drawn_goal_is_stored_and_reported(bench: Bench, tmp_path: Path) -> None:
    bench.show(placed(WORK, TABLE))
    message = bench.teaching.synthesise(Synthesise("pick", dict(WORK), dict(BODY)))
    assert "made from drawings: drawing placed by 6 markers" in message
    assert bench.said() == [("taught", message)]
    assert TaughtStore(tmp_path / "taught.json").goals == bench.teaching.goals


def test_standing_markers_of_an_incidence_become_their_pixels_of_now(bench: Bench) -> None:
    pin = Feature(markers=(0,))
    spec = IncidenceSpec("point-on-line", pin, Feature(markers=(10, 11)))
    pointed = IncidenceSpec("point-on-point", pin, Feature(points=((0.0, 0.0, 1.0, 1.0),)))
    target = IncidenceTarget((spec, pointed), model_epoch=1)
    with pytest.raises(TransferError, match=r"markers 10, 11 .* seen by no camera now; two cameras are needed"):
        bench.teaching.resolve_incidence(target)
    bench.show(placed(WORK, TABLE))
    found, seen = bench.teaching.resolve_incidence(target)
    assert seen == {}
    pixels = Cameras().pixels(placed(WORK, TABLE))
    assert found.incidences[1] == pointed
    assert found.incidences[0].moving == pin
    for camera in ("left", "right"):
        assert np.allclose(found.incidences[0].fixed.pixels[camera], [pixels[camera][10], pixels[camera][11]])
    bench.show(placed(WORK, some_pose(np.random.default_rng(4))))
    with pytest.raises(TransferError, match="markers 10, 11 of a fixed feature move now"):
        bench.teaching.resolve_incidence(target)
    found, seen = bench.teaching.resolve_incidence(target, (10, 11, 12, 77))
    for camera, pixel in found.incidences[0].fixed.pixels.items():
        assert seen[camera][10] == pixel[0]
        assert sorted(seen[camera]) == [10, 11, 12]


def test_a_goal_that_cannot_be_written_is_reported(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(name: str, goal: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(bench.store, "add", full)
    bench.show(placed(WORK, TABLE))
    with pytest.raises(TransferError, match="could not be saved"):
        bench.teaching.synthesise(Synthesise("pick", dict(WORK), dict(BODY)))
    assert "No space left" in bench.said()[0][1]


def test_a_goal_as_taught_needs_no_sight(bench: Bench) -> None:
    bench.taught(placed(BODY, HAND))
    found = bench.teaching.resolve(TaughtTarget("pick"))
    assert isinstance(found.target, FeatureTarget)
    assert found.target.model_epoch == MODEL.epoch
    assert msgspec.json.encode(found.target)


def test_a_goal_that_follows_a_target_gets_where_its_markers_were_when_it_was_taught(bench: Bench) -> None:
    body, work = placed(BODY, HAND), placed(WORK, TABLE)
    bench.taught(body | work)
    asked, views = (min(work), max(work), 999), Cameras().pixels(work)
    seen = bench.teaching.seen_when_taught(TaughtTarget("pick"), asked)
    assert sorted(seen) == sorted(views)
    for name, pixels in seen.items():
        assert sorted(pixels) == [min(work), max(work)]
        for marker, pixel in pixels.items():
            np.testing.assert_allclose(pixel, views[name][marker], atol=1e-6)
    assert bench.teaching.seen_when_taught(TaughtTarget("pick"), tuple(body)) == {}
