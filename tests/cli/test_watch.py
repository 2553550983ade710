"""What `stereoservo watch` shows to viewers of what a cell publishes."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from stereoservo.messages.wire import EventMessage, FeaturesMessage


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun-sdk (extra `watch`) is not installed")
def test_rerun_is_given_every_value_with_its_time_and_the_names_of_joints(tmp_path: Path) -> None:
    from stereoservo.cli.rerun_viewer import RerunViewer

    file = tmp_path / "one.rrd"
    with RerunViewer("cell", file) as viewer:
        for k in range(40):
            viewer._add_series("joints", 1000.0 + 0.05 * k, {"shoulder": float(k), "elbow": -0.5})
            viewer.show(FeaturesMessage("left", k, 0, 0, 1000.0 + 0.05 * k, (3, 7), ((k, 2.0), (5.0, k)), (0.1, 0.1)))
            viewer.show(FeaturesMessage("right", k, 0, 0, 1000.0 + 0.05 * k, (), (), ()))
        viewer.show(EventMessage(1, "boot", 0, 1002.0, "stopped", "by hand"))
    told = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(file)], check=True, capture_output=True, text=True,
        timeout=240,
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
