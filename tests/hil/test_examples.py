"""The programs of `examples/`, and `watch` into viewers, each against a live fake cell."""

import importlib.util
import json
import shutil
import struct
import subprocess
import sys
import time
from base64 import b64decode
from pathlib import Path
from typing import Any

import pytest

from recording.foxglove_schemas import decode_by_schema
from stereoservo.client import Client
from stereoservo.messages.wire import Reply, decode

from .conftest import CELL, moved_away, serving

pytestmark = pytest.mark.process
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
STYLES = ("sync", "async")


def run(style: str, name: str, *arguments: str) -> str:
    """What an example prints. It is to succeed."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / style / f"{name}.py"), CELL, *arguments],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run_here() -> None:
    names = {"watch", "teach", "goal", "stream", "stop"}
    for style in STYLES:
        assert {path.stem for path in (EXAMPLES / style).iterdir() if path.suffix == ".py"} == names
    assert {path.name for path in (EXAMPLES / "javascript").iterdir()} == {f"{name}.mjs" for name in (*names, "cell")}


@pytest.mark.parametrize("style", STYLES)
def test_a_goal_is_taught_and_reached(client: Client, style: str) -> None:
    assert run(style, "teach", f"here-{style}") == f"taught here-{style}\n"
    assert f"here-{style}" in [taught.name for taught in client.info().taught]
    start = client.status().joints
    moved_away(client)
    assert run(style, "goal", f"here-{style}").splitlines()[-1].startswith("reached ")
    assert all(abs(client.status().joints[name] - q) < 0.02 for name, q in start.items())


@pytest.mark.parametrize("style", STYLES)
def test_a_goal_that_is_not_there_is_refused_in_words(client: Client, style: str) -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / style / "goal.py"), CELL, "nowhere"],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("refused: ")
    assert "park" in done.stderr


@pytest.mark.parametrize("style", STYLES)
def test_watch_prints_states_and_features(client: Client, style: str) -> None:
    kinds = {line.split()[0] for line in run(style, "watch", "2").splitlines()}
    assert {"state", "features"} <= kinds


@pytest.mark.parametrize("style", STYLES)
def test_a_stream_is_followed_and_stop_stops(client: Client, style: str) -> None:
    start = client.status().joints
    assert run(style, "stream", "6").startswith("followed 60 set-points")
    assert any(abs(client.status().joints[name] - q) > 1e-3 for name, q in start.items())
    assert run(style, "stop").startswith("stopped: ")
    assert "STOPPED" in {reason.code for reason in client.status().reasons}


def node() -> list[str]:
    """How a program of node with a WebSocket is run; the test is left out where that cannot be."""
    if importlib.util.find_spec("websockets") is None:
        pytest.skip("the page's server needs websockets (extra web)")
    found = shutil.which("node")
    if found is None:
        pytest.skip("node is not installed (Debian's package nodejs)")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    numbers = tuple(int(part) for part in version.removeprefix("v").split(".")[:2])
    if numbers < (20, 10):
        pytest.skip(f"node {version} has no WebSocket of its own; 20.10 has")
    return [found] if numbers >= (22, 0) else [found, "--experimental-websocket", "--no-warnings"]


def run_node(name: str, *arguments: str, code: int = 0) -> str:
    """What an example in JavaScript prints, on stderr where it is to fail."""
    done = subprocess.run(
        [*node(), str(EXAMPLES / "javascript" / f"{name}.mjs"), *arguments],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == code, (done.stdout, done.stderr)
    return done.stderr if code else done.stdout


def run_operating(name: str, *arguments: str, code: int = 0) -> str:
    """`run_node` for a program that needs the token, which is good for one use."""
    node()
    with serving(CELL, "--operate", "ann") as served:
        return run_node(name, served["url"], served["token"], *arguments, code=code)


def test_in_javascript_a_goal_is_taught_and_reached(client: Client) -> None:
    assert run_operating("teach", "here-js") == "taught here-js\n"
    start = client.status().joints
    moved_away(client)
    assert run_operating("goal", "here-js").splitlines()[-1].startswith("reached ")
    assert all(abs(client.status().joints[name] - q) < 0.02 for name, q in start.items())
    refused = run_operating("goal", "nowhere", code=1)
    assert refused.startswith("refused: ")
    assert "park" in refused


def test_in_javascript_a_stream_is_followed(client: Client) -> None:
    start = client.status().joints
    assert run_operating("stream", "6").startswith("followed 60 set-points")
    assert any(abs(client.status().joints[name] - q) > 1e-3 for name, q in start.items())


def test_in_javascript_a_page_without_token_watches_and_stops_and_does_nothing_else(client: Client) -> None:
    node()
    with serving(CELL) as served:
        kinds = {line.split()[0] for line in run_node("watch", served["url"], "2").splitlines()}
        assert {"state", "features"} <= kinds
        assert "read-only" in run_node("goal", served["url"], "guess", "park", code=1)
        assert run_node("stop", served["url"]).startswith("stopped: ")
    assert "STOPPED" in {reason.code for reason in client.status().reasons}


@pytest.mark.parametrize("wrong", ["command/dance/me", "command/hold", "command/hold/me/now"])
def test_a_wrong_key_is_answered_with_the_right_ones(client: Client, wrong: str) -> None:
    reply = decode(client.query(f"{client.keys.prefix}/{wrong}", b"{}"), Reply)
    assert not reply.accepted
    assert "command/<name>/<name> is valid" in reply.problems[0] or "there are: stop, enable" in reply.problems[0]


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun-sdk (extra `watch`) is not installed")
def test_watch_writes_a_live_cell_for_rerun(client: Client, tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    program = [sys.executable, "-m", "stereoservo.cli.main", "watch", CELL, "--rerun", "--save", str(file)]
    subprocess.run([*program, "--seconds", "3"], check=True, capture_output=True, timeout=240)
    listed = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(file)], check=True, capture_output=True, text=True
    ).stdout
    values = ("/joints", "/command", "/velocities", "/innovation_px")
    for entity in (*values, "/camera/left/markers", "/camera/right/markers", "/reasons"):
        assert f" - {entity} " in listed


def test_watch_serves_a_live_cell_to_foxglove(client: Client) -> None:
    """A client of Foxglove's protocol that is not Foxglove's: it decodes by the schemas that are advertised."""
    for needed in ("foxglove", "google.protobuf", "jsonschema", "websockets"):
        pytest.importorskip(needed, reason=f"{needed} is of the extra `test`")
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    program = [sys.executable, "-m", "stereoservo.cli.main", "watch", CELL, "--foxglove", "--port", "0"]
    process = subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        url = process.stderr.readline().split()[-1]
        channels: dict[int, dict[str, Any]] = {}
        found: dict[str, Any] = {}
        wanted = {"/joints", "/command", "/status", "/camera/left/annotations", "/camera/right/annotations"}
        with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as foxglove:
            while not wanted <= set(found):
                data = foxglove.recv(timeout=60)
                if isinstance(data, str):
                    message = json.loads(data)
                    new = {channel["id"]: channel for channel in message.get("channels", ())}
                    channels |= new
                    if new:
                        asked = [{"id": number, "channelId": number} for number in new]
                        foxglove.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
                elif data[0] == 1:  # message data: its subscription, its time [ns]
                    number, t_ns = struct.unpack_from("<IQ", data, 1)
                    channel = channels[number]
                    text = channel["schema"]
                    schema = text.encode() if channel["schemaEncoding"] == "jsonschema" else b64decode(text)
                    found[channel["topic"]] = decode_by_schema(
                        channel["encoding"], channel["schemaName"], schema, data[13:]
                    )
                    assert abs(t_ns * 1e-9 - time.time()) < 60.0, "the wall clock's time"
        joints = {joint.name: joint.position for joint in found["/joints"].joints}
        assert joints == pytest.approx(client.status().joints, abs=0.01)
        assert found["/status"]["lifecycle"] == "active"
        assert len(found["/camera/left/annotations"].points[0].points) >= 4
    finally:
        process.terminate()
        process.communicate(timeout=240)
