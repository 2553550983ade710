"""What `stereoservo watch` shows to viewers of what a cell publishes."""

import importlib.util
import re
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
def test_rerun_is_given_every_value_with_its_time_and_the_names_of_joints(tmp_path: Path) -> None:
    from stereoservo.cli.watch.rerun_viewer import RerunViewer

    file = tmp_path / "one.rrd"
    with RerunViewer("cell", file) as viewer:
        for k in range(40):
            viewer._add_series("joints", 1000.0 + 0.05 * k, {"shoulder": float(k), "elbow": -0.5})
            viewer.show(
                FeaturesMessage("left", k, 0, 0, 1000.0 + 0.05 * k, (3, 7), ((k, 2.0), (5.0, k)), (0.1, 0.1))
            )
            viewer.show(FeaturesMessage("right", k, 0, 0, 1000.0 + 0.05 * k, (), (), ()))
        viewer.show(EventMessage(1, "boot", 0, 1002.0, "stopped", "by hand"))
    told = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(file)], check=True, capture_output=True, text=True,
        timeout=60,
    ).stdout  # fmt: skip
    for found in (
        "shoulder",
        "elbow",
        "/camera/left/markers",
        "/camera/right/markers",
        "stopped: by hand",
        "39.0",
    ):
        assert found in told, found
    times = set(re.findall(r"1970-01-01T00:16:\d\d(?:\.\d+)?", told))
    assert len(times) == 41, "of each message"
