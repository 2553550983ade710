"""The shipped cell files and those in deploy/ are the same, and fit the simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereoservo.messages.cell_file import check_cell, load_cell_file
from stereoservo_sim.cells import ARMS, CELLS, demo_cell_path, shipped_cell_path
from stereoservo_sim.demonstration.truth import true_cell

DEPLOYED = Path(__file__).parents[3] / "deploy" / "cells"
SIXTY = np.deg2rad(60.0)
LAID_OUT = [name for name in CELLS if name not in ARMS]
"""Cells that state their limits and ranges."""


@pytest.mark.parametrize("name", CELLS)
def test_the_deployed_cell_file_is_the_packaged_one(name: str) -> None:
    assert (DEPLOYED / f"{name}.toml").read_bytes() == shipped_cell_path(name).read_bytes()
    assert load_cell_file(shipped_cell_path(name)).cell.name == name


def test_the_demo_cell_is_the_first() -> None:
    assert demo_cell_path() == shipped_cell_path("demo")
    assert demo_cell_path().read_text(encoding="utf-8") == (DEPLOYED / "demo.toml").read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="no cell 'fisheye' is shipped; there are demo, wide, eye_in_hand, workpiece"):
        shipped_cell_path("fisheye")


@pytest.mark.parametrize("name", CELLS)
def test_the_cell_file_names_what_the_simulation_has(name: str) -> None:
    cell = load_cell_file(shipped_cell_path(name))
    truth = true_cell(cell)
    assert [camera.name for camera in cell.camera] == [camera.name for camera in truth.rig.cameras]
    if name in LAID_OUT:
        assert [limit.joint for limit in cell.safety.limit] == list(truth.robot.joint_names)


@pytest.mark.parametrize("name", LAID_OUT)
@pytest.mark.parametrize("index", range(6))
def test_every_calibration_stop_shows_the_body_to_both_cameras(name: str, index: int) -> None:
    """Every marker of plates, that all look at the cameras; of a solid as many vertices as a stop needs."""
    file = load_cell_file(shipped_cell_path(name))
    cell = true_cell(file)
    assert file.calibration is not None
    joint = cell.robot.joint_names[index]
    limit = next(limit for limit in file.safety.limit if limit.joint == joint)
    reach = file.calibration.range[joint]
    for offset in np.linspace(-reach, reach, file.calibration.stops):
        q = cell.base.copy()
        q[index] += offset
        assert limit.min + file.safety.position_margin < q[index] < limit.max - file.safety.position_margin
        for camera in cell.rig.cameras:
            solid = name == "edges"  # a corner's normal is the mean of its faces'
            seen = cell.visible(q, camera) if solid else cell.visible(q, camera, max_incidence=SIXTY)
            needed = file.calibration.min_markers if solid else seen.size
            assert seen.sum() >= needed, (joint, offset, camera.name, seen)


def test_the_truth_has_the_mount_and_the_lenses_of_the_cell_file() -> None:
    assert [camera.k1 for camera in true_cell(load_cell_file(shipped_cell_path("wide"))).rig.cameras] == [
        -0.3,
        -0.3,
    ]
    assert true_cell(load_cell_file(shipped_cell_path("demo"))).stand is None
    assert true_cell(load_cell_file(shipped_cell_path("eye_in_hand"))).stand is not None


def test_a_camera_under_another_name_keeps_its_view() -> None:
    tree = {
        "schema": 1, "cell": {"name": "x"}, "joints": {"driver": "fake"},
        "camera": [{"name": "a", "driver": "fake", "options": {"view": "right", "k1": -0.1}}],
        "safety": {"limit": [{"joint": "j1", "min": -1, "max": 1, "velocity": 1, "acceleration": 1}]},
    }  # fmt: skip
    (camera,) = true_cell(check_cell(tree)).rig.cameras
    right = true_cell(load_cell_file(demo_cell_path())).rig.camera("right")
    assert (camera.name, camera.k1) == ("a", -0.1)
    assert (camera.world_to_camera == right.world_to_camera).all()
    tree["camera"] = [{"name": "top", "driver": "fake"}]
    with pytest.raises(ValueError, match="camera 'top' is not simulated"):
        true_cell(check_cell(tree))
