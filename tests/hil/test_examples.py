"""The programs of `examples/`, and `watch` into viewers, each against a live fake cell."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from stereoservo.client import Client
from stereoservo.messages.wire import Reply, decode

from .conftest import CELL, moved_away

pytestmark = pytest.mark.process
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
STYLES = ("sync", "async")


def run(style: str, name: str, *arguments: str) -> str:
    """What an example prints. It is to succeed."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / style / f"{name}.py"), CELL, *arguments],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run_here() -> None:
    for style in STYLES:
        assert {path.stem for path in (EXAMPLES / style).iterdir() if path.suffix == ".py"} == {
            "watch", "teach", "goal", "stream", "stop",
        }  # fmt: skip


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
        capture_output=True, text=True, timeout=60, check=False,
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


@pytest.mark.parametrize("wrong", ["command/dance/me", "command/hold", "command/hold/me/now"])
def test_a_wrong_key_is_answered_with_the_right_ones(client: Client, wrong: str) -> None:
    reply = decode(client.query(f"{client.keys.prefix}/{wrong}", b"{}"), Reply)
    assert not reply.accepted
    assert (
        "command/<name>/<name> is valid" in reply.problems[0]
        or "there are: stop, enable" in reply.problems[0]
    )


@pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="rerun-sdk (extra `watch`) is not installed"
)
def test_watch_writes_a_live_cell_for_rerun(client: Client, tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    program = [sys.executable, "-m", "stereoservo.cli.main", "watch", CELL, "--rerun", "--save", str(file)]
    subprocess.run([*program, "--seconds", "3"], check=True, capture_output=True, timeout=60)
    listed = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(file)], check=True, capture_output=True, text=True
    ).stdout
    for entity in ("/joints/j1", "/command/j1", "/camera/left/markers", "/camera/right/markers", "/reasons"):
        assert f" - {entity} " in listed
