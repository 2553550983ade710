"""The cell of several files: a fake arm, two cameras without pictures, its model, and a goal that it was shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CellFile, check_cell
from stereoservo.messages.goals import JointTarget
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.kept_models import kept_model
from stereoservo_sim.world.simulated_cell import demo_cell, workpiece_cell

NAMES = tuple(f"j{k}" for k in range(1, 7))
GOAL = np.radians([4.0, -83.0, -29.0, -24.0, 53.0, -90.0])


def fake_cell(*, static: bool = False, **camera: Any) -> CellFile:
    """``static``: a plate stands beside the arm for good. ``camera``: options of both."""
    plate = workpiece_cell().workpiece
    assert plate is not None
    camera = {**camera, "workpiece": True} if static else camera
    return check_cell(
        {
            "schema": 1,
            "scene": {"static": plate.body.ids.tolist() if static else []},
            "cell": {"name": "fakes"},
            "joints": {"driver": "fake"},
            "camera": [{"name": name, "driver": "fake", "options": camera} for name in ("left", "right")],
            "servo": {"tolerance_px": 0.2, "hold_frames": 5},
            "safety": {
                "limit": [
                    {"joint": n, "min": -m, "max": m, "velocity": 1.0, "acceleration": 4.0}
                    for n, m in zip(NAMES, (2.7, 2.3, 2.4, 4.7, 1.8, 4.7), strict=True)
                ]
            },
            "calibration": {
                "base": dict(zip(NAMES, demo_cell().base.tolist(), strict=True)),
                "range": dict(zip(NAMES, [0.3, 0.3, 0.3, 0.7, 0.6, 0.7], strict=True)),
                "stops": 7,
                "frames": 2,
                "settle_s": 0.05,
                "speed_scale": 1.0,
            },
        }
    )


def shown_goal(cell_file: CellFile, folder: Path) -> tuple[CellModel, Any]:
    """Model of a cell, learnt once a run, and a goal that is taught with it."""

    def learn() -> CellModel:
        with LockstepCell(cell_file, cell_dir=folder, runtime_dir=folder) as cell:
            cell.run_for(0.5)
            operator = LockstepOperator(cell)
            operator.enable()
            return operator.calibrate()

    model = kept_model(("lockstep", cell_file), learn).model
    with LockstepCell(cell_file, cell_dir=folder, runtime_dir=folder) as cell:
        cell.run_for(0.5)
        operator = LockstepOperator(cell)
        operator.enable()
        operator.use_model(model)
        operator.goal(JointTarget(dict(zip(NAMES, GOAL.tolist(), strict=True))))
        cell.run_for(0.3)
        operator.teach("shown")
        return model, operator.taught["shown"]


@pytest.fixture(scope="session")
def fake_file() -> CellFile:
    """The fake cell."""
    return fake_cell()


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[CellModel, Any]:
    """A model of the fake cell and a goal that was shown to it."""
    return shown_goal(fake_cell(), tmp_path_factory.mktemp("calibrated"))


@pytest.fixture(scope="session")
def calibrated_with_plate(tmp_path_factory: pytest.TempPathFactory) -> tuple[CellModel, Any]:
    """The same of the cell beside whose arm a plate stands for good."""
    return shown_goal(fake_cell(static=True), tmp_path_factory.mktemp("calibrated-with-plate"))
