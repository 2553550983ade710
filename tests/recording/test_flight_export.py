"""A flight exported for other programs: it replays as before, and what is added is read by what we did not write."""

from __future__ import annotations

import importlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader

from core.conftest import Bench
from recording.bench_flight import record_bench
from recording.foxglove_schemas import decode_by_schema
from stereoservo.cli import main as cli
from stereoservo.messages.goals import FeatureTarget
from stereoservo.recording.replay import recorded_messages, replay

for needed in ("foxglove", "google.protobuf", "jsonschema"):
    pytest.importorskip(needed, reason=f"{needed} is of the extra `test`")

STEPS = 400


def foxglove_channels() -> Any:
    """The module that needs foxglove-sdk."""
    return importlib.import_module("stereoservo.recording.foxglove_channels")


class Exported(NamedTuple):
    """A flight of a bench with its exported file, and the goal's set-points."""

    bench: Bench
    flight: Path
    file: Path
    goal: FeatureTarget


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Four seconds towards a goal, with pictures of one camera."""
    folder = tmp_path_factory.mktemp("flight")
    flight, file = folder / "flight.mcap", folder / "flight.foxglove.mcap"
    bench, target = record_bench(flight, STEPS)
    assert cli.invoke(["export", str(flight), "--json"]) == 0
    return Exported(bench, flight, file, target)


def decoded(file: Path) -> dict[str, list[tuple[int, Any]]]:
    """Messages with a schema, by topic with their times."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            if schema is not None:
                content = decode_by_schema(channel.message_encoding, schema.name, schema.data, message.data)
                found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


@pytest.fixture(scope="module")
def messages(exported: Exported) -> dict[str, list[tuple[int, Any]]]:
    return decoded(exported.file)


def test_the_recording_is_in_it_bit_for_bit(exported: Exported) -> None:
    before = list(recorded_messages(exported.flight))
    after = [(topic, data) for topic, data in recorded_messages(exported.file) if not topic.startswith("/")]
    assert after == before
    result = replay(exported.file)
    assert (result.identical, result.steps) == (True, STEPS)


def test_the_recording_takes_no_more_room_in_it_than_by_itself(exported: Exported) -> None:
    def own_bytes(file: Path) -> int:
        with file.open("rb") as stream:
            messages = make_reader(stream).iter_messages()
            return sum(len(message.data) for schema, _, message in messages if schema is None)

    assert own_bytes(exported.file) < 1.02 * own_bytes(exported.flight), "it is compressed as the recorder does"


def test_every_message_is_valid_by_its_schema_and_at_the_wall_clocks_time(
    exported: Exported, messages: dict[str, list[tuple[int, Any]]]
) -> None:
    assert set(messages) == {
        "/joints", "/command", "/status", "/log", "/reasons", "/tf", "/scene", "/camera/left/image",
        "/camera/left/annotations", "/camera/right/annotations",
    }  # fmt: skip
    end = exported.flight.stat().st_mtime_ns
    times = [t_ns for found in messages.values() for t_ns, _ in found]
    assert end - (STEPS / exported.bench.settings.rate_hz + 1.0) * 1e9 < min(times)
    assert max(times) <= end


def test_joints_and_pixels_are_those_recorded(exported: Exported, messages: dict[str, list[tuple[int, Any]]]) -> None:
    recorded = {inputs.now_ns: (inputs, outputs) for inputs, outputs in exported.bench.log[-STEPS:]}
    shift = messages["/joints"][0][0] - min(recorded)
    for t_ns, content in messages["/joints"]:
        _, outputs = recorded[t_ns - shift]
        assert [joint.name for joint in content.joints] == list(exported.bench.settings.joint_names)
        assert [joint.position for joint in content.joints] == list(outputs.status.positions)
    seen = {
        observation.t_shutter_ns + shift: observation
        for inputs, _ in recorded.values()
        for observation in inputs.observations
        if observation.camera == "left"
    }
    wanted = np.array(list(exported.goal.set_points["left"].values())) + 0.5
    drawn = messages["/camera/left/annotations"]
    assert len(drawn) == len(seen)
    for t_ns, content in drawn:
        pixels = [(point.x, point.y) for point in content.points[0].points]
        assert np.allclose(pixels, seen[t_ns].pixels + 0.5, rtol=0, atol=1e-12)
    assert np.allclose([(point.x, point.y) for point in drawn[-1][1].points[-1].points], wanted, atol=1e-12)


def test_the_scene_is_the_true_one_in_baselines(exported: Exported, messages: dict[str, list[tuple[int, Any]]]) -> None:
    """Markers, camera centres and axes against the bench's arm in metres: all distances agree but for the unit."""
    truth = exported.bench.truth
    centres = np.array([-np.linalg.solve(P[:, :3], P[:, 3]) for P in truth.cameras])
    baseline = np.linalg.norm(centres[1] - centres[0])
    positions = {t_ns: np.array([j.position for j in m.joints]) for t_ns, m in messages["/joints"]}
    t_ns, scene = next((t, m) for t, m in reversed(messages["/scene"]) if t in positions)
    by_name = {entity.id: entity for entity in scene.entities}
    markers = np.array([(s.pose.position.x, s.pose.position.y, s.pose.position.z) for s in by_name["markers"].spheres])
    places = np.array([(t.pose.position.x, t.pose.position.y, t.pose.position.z) for t in by_name["cameras"].texts])
    true_points = np.vstack([truth.points(positions[t_ns]), centres])
    drawn = np.vstack([markers, places])

    def distances(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    assert np.allclose(distances(drawn) * baseline, distances(true_points), rtol=1e-6, atol=1e-9)
    # Points on the first axis stand still when it turns: their distances to the markers do not depend on it.
    first = by_name["arm"].lines[0].points
    line = np.array([(p.x, p.y, p.z) for p in first])
    turned = positions[t_ns] + np.array([0.4, 0, 0, 0, 0, 0])
    again = foxglove_channels().MetricScene(truth.model).markers(turned)
    assert np.allclose(
        np.linalg.norm(again[:, None] - line, axis=2),
        np.linalg.norm(markers[:, None] - line, axis=2),
        atol=1e-6,
    )


def test_a_file_that_exists_is_left_alone(exported: Exported) -> None:
    before = exported.file.read_bytes()
    assert cli.invoke(["export", str(exported.flight), "--json"]) == 1
    assert exported.file.read_bytes() == before


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun-sdk (extra `watch`) is not installed")
def test_rerun_decodes_at_least_eight_entities(exported: Exported, tmp_path: Path) -> None:
    rrd = tmp_path / "flight.rrd"
    program = [sys.executable, "-m", "rerun"]
    subprocess.run([*program, "mcap", "convert", str(exported.file), "-o", str(rrd)], check=True, timeout=240)
    listed = subprocess.run(
        [*program, "rrd", "print", "-v", str(rrd)], check=True, capture_output=True, text=True, timeout=240
    ).stdout
    entities = set()
    for entity, columns in re.findall(r" - (/\S+) - .*?columns: \[(.*?)\]", listed):
        if any("@Mcap" not in column for column in columns.split() if "@" in column):
            entities.add(entity)
    assert len(entities) >= 8, entities


def test_the_layout_shows_topics_that_there_are(messages: dict[str, list[tuple[int, Any]]]) -> None:
    layout = (Path(__file__).resolve().parents[2] / "deploy/foxglove/stereoservo.json").read_text()
    named = {topic.partition(".")[0] for topic in re.findall(r'"(/[^"]+)"', layout)}
    assert named - set(messages) == {"/camera/right/image"}  # the bench has pictures of one camera
