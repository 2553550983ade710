"""The shipped cell file and the one in deploy/ are one."""

from __future__ import annotations

from pathlib import Path

from stereoservo.runtime.cellfile import load_cell_file
from stereoservo_sim.cells import demo_cell_path, demo_cell_text
from stereoservo_sim.world import demo_cell

DEPLOYED = Path(__file__).parents[2] / "deploy" / "cells" / "demo.toml"


def test_the_deployed_cell_file_is_the_packaged_one():
    assert DEPLOYED.read_bytes() == demo_cell_path().read_bytes()
    assert demo_cell_text() == DEPLOYED.read_text(encoding="utf-8")


def test_the_cell_file_names_what_the_simulation_has():
    cell = load_cell_file(demo_cell_path())
    assert [camera.name for camera in cell.camera] == [camera.name for camera in demo_cell().rig.cameras]
    assert [limit.joint for limit in cell.safety.limit] == list(demo_cell().robot.joint_names)
