"""The cells `wide` and `eye_in_hand` in closed loop, with exact models in lockstep."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.core.cycle import ModelUpdate
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.goals import FeatureTarget, Goal, RunGoal
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.world.arms.arm_goals import goals_of
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.history import TrueJointHistory

TERMINAL = ("goal_reached", "goal_aborted", "goal_cancelled")


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
    shown = goals_of(truth)[goal]
    pixels = truth.truth_pixels(shown)
    target = FeatureTarget(
        {camera: {int(i): (float(u), float(v)) for i, (u, v) in zip(truth.body.ids, seen, strict=True)}
         for camera, seen in pixels.items()}
    )  # fmt: skip
    with LockstepCell(file, cell_dir=tmp_path, runtime_dir=tmp_path, services={"world": history}) as cell:
        cell.run_for(0.5)
        LockstepOperator(cell).enable()
        cell.update_model(ModelUpdate(exact_simulated_model(truth, seed=5)))
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
