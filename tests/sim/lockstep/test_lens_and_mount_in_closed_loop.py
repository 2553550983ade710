"""The cells `wide` and `eye_in_hand` in closed loop, with exact models in lockstep."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.core.cycle import ModelUpdate
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel, FitStatistics
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.goals import FeatureTarget, Goal, RunGoal
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.robots import joint_frames
from stereoservo_sim.world.simulated_cell import SimulatedCell, goals_of

TERMINAL = ("goal_reached", "goal_aborted", "goal_cancelled")


def exact_model(cell: SimulatedCell, seed: int) -> CellModel:
    """The simulated truth, at the base, in a random projective frame."""
    frames, flange = joint_frames(cell.robot, cell.base)
    twists = np.zeros((6, 4, 4))
    for twist, frame in zip(twists, frames, strict=True):
        x, y, z = frame[:3, 2]
        twist[:3, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
        twist[:3, 3] = -twist[:3, :3] @ frame[:3, 3]
    points = np.column_stack([cell.marker_positions(cell.base), np.ones(14)])
    if cell.stand is not None:  # everything as the flange sees it
        back = np.linalg.inv(flange)
        twists = -back @ twists @ flange
        points = points @ back.T
    H = np.eye(4) + 0.3 * np.random.default_rng(seed).standard_normal((4, 4))
    inverse = np.linalg.inv(H)
    plane = np.array([0, 0, 0, 1.0]) @ H
    points = points @ inverse.T
    return CellModel(
        schema=MODEL_SCHEMA, epoch=3, joint_names=cell.robot.joint_names, joint_kinds=("revolute",) * 6,
        zero=cell.base, generators=inverse @ twists @ H,
        cameras=tuple(CameraModel(c.name, c.P @ H, c.width, c.height, c.lens) for c in cell.rig.cameras),
        marker_ids=tuple(int(i) for i in cell.body.ids), marker_points=points / (points @ plane)[:, None],
        plane_at_infinity=plane, stratum="metric", projective_to_euclidean=H,
        statistics=FitStatistics(0.01, 1.0, 1, True, 1, 0, 0, (), 1),
        mount="eye_to_hand" if cell.stand is None else "eye_in_hand",
    )  # fmt: skip


def faked(name: str) -> dict[str, Any]:
    """A shipped cell file with marker positions instead of images."""
    tree = tomllib.loads(shipped_cell_path(name).read_text())
    tree["joints"] = {"driver": "fake"}
    for camera in tree["camera"]:
        camera["driver"] = "fake"
        camera["options"] = {"k1": camera["options"].get("k1", 0.0), "noise_px": 0.02}
        del camera["detector"]
    return tree


@pytest.mark.parametrize(
    ("name", "law", "goal"),
    [
        ("wide", "stereo", "near"),
        ("wide", "cartesian3", "far"),
        ("eye_in_hand", "cartesian2", "roll"),
        ("eye_in_hand", "cartesian3", "far"),
        pytest.param("wide", "cartesian2", "roll", marks=pytest.mark.slow),
        pytest.param("wide", "cartesian3", "roll", marks=pytest.mark.slow),
        pytest.param("eye_in_hand", "stereo", "near", marks=pytest.mark.slow),
        pytest.param("eye_in_hand", "cartesian3", "roll", marks=pytest.mark.slow),
    ],
)
def test_goal_is_reached_with_an_exact_model(tmp_path: Path, name: str, law: Any, goal: str) -> None:
    file = check_cell(faked(name))
    truth = true_cell(file)
    history = TrueJointHistory.in_memory(6, capacity=1 << 15)
    shown = goals_of(file.camera[0].mount)[goal]
    pixels = truth.truth_pixels(shown)
    target = FeatureTarget(
        {camera: {int(i): (float(u), float(v)) for i, (u, v) in zip(truth.body.ids, seen, strict=True)}
         for camera, seen in pixels.items()}
    )  # fmt: skip
    with LockstepCell(file, cell_dir=tmp_path, runtime_dir=tmp_path, services={"world": history}) as cell:
        cell.run_for(0.5)
        LockstepOperator(cell).enable()
        cell.update_model(ModelUpdate(exact_model(truth, seed=5)))
        cell.run_for(0.3)
        assert cell.submit(RunGoal(Goal("0000abcd", target, law=law))).accepted
        end = cell.wait_for(lambda event: event.kind in TERMINAL, 30.0)
        assert end.kind == "goal_reached", end
        cell.run_for(0.5)
        q = history.newest()[1]  # type: ignore[index]
    for camera, seen in truth.truth_pixels(q).items():
        assert np.linalg.norm(seen - pixels[camera], axis=1).max() < 0.1
    off = truth.marker_positions_rig(q) - truth.marker_positions_rig(shown)
    assert np.linalg.norm(off, axis=1).max() < 0.5e-3
    if law == "cartesian3":
        path = np.array([truth.marker_positions_rig(p).mean(axis=0) for p in history.since(0)[2][::10]])
        line = truth.marker_positions_rig(shown).mean(axis=0) - path[0]
        line /= np.linalg.norm(line)
        way = path - path[0]
        assert np.linalg.norm(way - (way @ line)[:, None] * line, axis=1).max() < 5e-3
