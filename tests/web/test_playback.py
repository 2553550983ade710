"""A recording shown to pages: what they are sent of a moment is what the core's bench did then."""

import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np
import pytest

from core.conftest import Bench
from recording.bench_flight import GOAL_ID, GOAL_STEP, record_bench
from stereoservo.messages.goals import FeatureTarget
from stereoservo.recording.replay import RecordingError

pytest.importorskip("websockets", reason="the page's server needs websockets (extra web)")

from stereoservo.web.playback import PlaybackLink

STEPS = 400


class Shown(NamedTuple):
    """A link that is paused, what it has published by slot, and what was recorded."""

    link: PlaybackLink
    slots: dict[str, bytes]
    bench: Bench
    target: FeatureTarget

    def at(self, step: int) -> dict[str, Any]:
        """What pages are sent once they went to ``step``; pictures as they are."""
        log = self.bench.log[-STEPS:]
        self.slots.pop("flight", None)
        self.link.seek((log[step][0].now_ns - log[0][0].now_ns) * 1e-9)
        eventually(lambda: "flight" in self.slots)
        return {
            slot: data if slot.startswith("picture") else msgspec.json.decode(data) for slot, data in self.slots.items()
        }


def eventually(condition: Callable[[], Any]) -> None:
    until = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shown]:
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    bench, target = record_bench(path, STEPS)
    slots: dict[str, bytes] = {}
    link = PlaybackLink(path, lambda slot, data, keep: slots.__setitem__(slot, data))
    link.start()
    link.play(False, None)

    def read() -> bool:
        return "flight" in slots and not msgspec.json.decode(slots["flight"])["flight"]["reading"]

    eventually(read)
    yield Shown(link, slots, bench, target)
    link.close()


def test_a_moment_is_what_was_recorded(shown: Shown) -> None:
    log = shown.bench.log[-STEPS:]
    for step in (250, 30, 399):  # forwards and back
        sent = shown.at(step)
        state, predicted = sent["state"]["state"], sent["state"]["predicted"]
        recorded = {outputs.status.t_ns: outputs.status for _, outputs in log}[state["t_ns"]]
        assert 0 <= log[step][0].now_ns - state["t_ns"] < 50_000_000
        assert list(state["joints"].values()) == recorded.positions.tolist()
        assert state["error_px"] == recorded.error_px
        exact = shown.bench.truth.pixels(recorded.positions)[0]
        assert np.allclose(list(predicted["left"].values()), exact, rtol=0, atol=1e-6), "the model is the true one"
        newest = [o for inputs, _ in log[: step + 1] for o in inputs.observations if o.camera == "left"][-1]
        assert sent["features left"]["features"]["pixels"] == newest.pixels.tolist()
        (size,) = struct.unpack_from("<I", picture := sent["picture left"])
        image = cv2.imdecode(np.frombuffer(picture[4 + size :], np.uint8), cv2.IMREAD_GRAYSCALE)
        assert abs(image.astype(int) - step // 100 * 25).max() <= 1
        rows = sent["plots"]["plots"]["error"]
        assert rows[-1] == [pytest.approx(state["t_ns"] * 1e-9), state["error_px"]]
        reasons = sent["plots"]["plots"]["reasons"]
        assert reasons[-1] == [rows[-1][0], [reason["code"] for reason in state["reasons"]]]


def test_the_goal_is_drawn_and_reported_from_when_it_ran(shown: Shown) -> None:
    before, after = shown.at(GOAL_STEP - 1), shown.at(STEPS - 1)
    assert before["goal"]["goal"]["id"] == ""
    assert after["goal"]["goal"]["id"] == GOAL_ID
    for camera, wanted in shown.target.set_points.items():
        assert after["goal"]["goal"]["set_points"][camera] == {str(m): list(p) for m, p in wanted.items()}
        ends = {m: way[-1] for m, way in after["goal"]["goal"]["plan"]["pixels"][camera].items()}
        assert all(np.allclose(ends[str(m)], p, atol=0.5) for m, p in wanted.items())
    truth, plan = shown.bench.truth, after["goal"]["goal"]["plan"]
    there = truth.points(np.array([way[-1] for way in plan["joints"].values()]))
    assert np.allclose(after["goal"]["goal"]["scene"], there, atol=1e-6), "its markers, in the true frame"
    kinds = [event["event"]["kind"] for event in after["events"]["events"]]
    assert "goal_started" in kinds
    assert kinds == [e.kind for _, o in shown.bench.log[-STEPS:] for e in o.events if e.kind != "reply"]
    assert "goal_started" not in [event["event"]["kind"] for event in before["events"]["events"]]


def test_it_plays_to_its_end_and_begins_again(shown: Shown) -> None:
    shown.at(100)
    shown.link.play(True, 50.0)

    def told() -> Any:
        return msgspec.json.decode(shown.slots["flight"])["flight"]

    eventually(lambda: told()["at"] == told()["seconds"] and not told()["playing"])
    assert told()["notes"] == []
    shown.link.play(True, 0.05)
    eventually(lambda: told()["at"] < 1.0 and told()["playing"])
    shown.link.play(False, None)


def test_what_is_no_recording_is_refused_at_the_start(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(b"no recording")
    with pytest.raises(RecordingError):
        PlaybackLink(path, lambda slot, data, keep: None)
