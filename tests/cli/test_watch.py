"""What `stereoservo watch` shows to viewers of what a cell publishes."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from stereoservo.cli.watch.command import Thinned
from stereoservo.messages.wire import EventMessage, FeaturesMessage

FRAME = FeaturesMessage("left", 0, 0, 0, 0.0, (), (), ())


def test_markers_are_thinned_by_camera_and_nothing_else_is() -> None:
    thinned = Thinned()
    shown = {"left": 0, "right": 0}
    for k in range(300):  # ten seconds at 30 Hz
        for camera in shown:
            frame = msgspec.structs.replace(FRAME, camera=camera, t_shutter_ns=k * 33_333_333)
            shown[camera] += thinned.shows(frame)
    assert shown == {"left": 150, "right": 150}
    assert all(thinned.shows(EventMessage(k, "boot", 0, 0.0, "stopped")) for k in range(20))
    assert thinned.shows(FRAME), "a daemon that is started anew, on another host, has another clock"


@pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="rerun-sdk (extra `watch`) is not installed"
)
def test_series_of_rerun_have_the_names_of_their_joints(tmp_path: Path) -> None:
    from stereoservo.cli.watch.rerun_viewer import RerunViewer

    file = tmp_path / "one.rrd"
    with RerunViewer("cell", file) as viewer:
        for value in (1.5, 2.5):
            viewer._show_series("joints", {"shoulder": value, "elbow": -value})
    told = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(file)], check=True, capture_output=True, text=True,
        timeout=60,
    ).stdout  # fmt: skip
    for found in ("shoulder", "elbow", "1.5", "-2.5"):
        assert found in told
