"""One fault at a time, in mid-goal, on the whole cell in lockstep: the arm comes to rest, and the status says why."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.kinematics.model import CellModel
from stereoservo.runtime.cellfile import CellFile, check_cell
from stereoservo.runtime.commands import Goal, JointTarget, RunGoal
from stereoservo.runtime.cycle import ModelUpdate
from stereoservo.runtime.lockstep import LockstepCell
from stereoservo.runtime.lockstep_operator import LockstepOperator
from stereoservo_sim.history import JointHistory
from stereoservo_sim.world import demo_cell

NAMES = tuple(f"j{k}" for k in range(1, 7))
BOUND_S = 1.5  # coast (0.5) + braking from full speed (0.25) + drives' time-out (0.1), generously
GOAL = np.radians([4.0, -83.0, -29.0, -24.0, 53.0, -90.0])


def fake_cell() -> CellFile:
    base = demo_cell().base
    return check_cell(
        {
            "schema": 1,
            "cell": {"name": "faults"},
            "joints": {"driver": "fake"},
            "camera": [{"name": name, "driver": "fake"} for name in ("left", "right")],
            "servo": {"tolerance_px": 0.2, "hold_frames": 5},
            "safety": {
                "limit": [
                    {"joint": n, "min": -m, "max": m, "velocity": 1.0, "acceleration": 4.0}
                    for n, m in zip(NAMES, (2.7, 2.3, 2.4, 4.7, 1.8, 4.7), strict=True)
                ]
            },
            "calibration": {
                "base": dict(zip(NAMES, base.tolist(), strict=True)),
                "range": dict(zip(NAMES, [0.3, 0.3, 0.3, 0.7, 0.6, 0.7], strict=True)),
                "stops": 7,
                "frames": 2,
                "settle_s": 0.05,
                "speed_scale": 1.0,
            },
        }
    )


class Flight:
    """A cell on its way to a goal, and the truth about its arm."""

    def __init__(self, directory: Path, model: CellModel, target: Any) -> None:
        self.history = JointHistory.in_memory(6, capacity=1 << 14)
        self.cell = LockstepCell(
            fake_cell(), cell_dir=directory, runtime_dir=directory, services={"world": self.history}
        )
        self.cell.run_for(0.5)
        self.operator = LockstepOperator(self.cell)
        self.operator.enable()
        self.cell.update_model(ModelUpdate(model))
        self.cell.run_for(0.3)
        self.goal = Goal("0000abcd", target)
        assert self.cell.submit(RunGoal(self.goal)).accepted
        self.cell.run_for(0.8)
        assert self.speed() > 0.1

    @property
    def joints(self) -> Any:
        return self.cell.joints

    @property
    def cameras(self) -> Any:
        return self.cell.cameras

    def speed(self) -> float:
        newest = self.history.newest()
        assert newest is not None
        return float(np.abs(newest[2]).max())

    def codes(self) -> set[str]:
        assert self.cell.status is not None
        return {reason.code for reason in self.cell.status.reasons}

    def ends(self) -> list[str]:
        return [
            e.kind
            for e in self.cell.events
            if e.id == self.goal.id and e.kind.startswith("goal_") and e.kind != "goal_started"
        ]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[CellModel, Any]:
    """A model of the fake cell and a goal that was shown to it."""
    directory = tmp_path_factory.mktemp("calibrated")
    with LockstepCell(fake_cell(), cell_dir=directory, runtime_dir=directory) as cell:
        cell.run_for(0.5)
        operator = LockstepOperator(cell)
        operator.enable()
        model = operator.calibrate()
        operator.goal(JointTarget(dict(zip(NAMES, GOAL.tolist(), strict=True))))
        cell.run_for(0.3)
        operator.teach("shown")
        return model, operator.taught["shown"]


def blackout(flight: Flight) -> None:
    for camera in flight.cameras:
        camera.blackout = True


def fault(**changes: int) -> Callable[[Flight], None]:
    def inject(flight: Flight) -> None:
        for name, value in changes.items():
            setattr(flight.joints.faults, name, value)

    return inject


FAULTS = {
    "write": (fault(fail_write=1), "DRIVER_FAULT", "fault"),
    "read": (fault(fail_read=1), "DRIVER_FAULT", "fault"),
    "encoder and stamp stand still": (fault(freeze_encoder_after=1), "JOINTS_STALE", "active"),
    "encoder stands still": (fault(stuck_encoder_after=1), "JOINT_NOT_FOLLOWING", "fault"),
    "commands do not arrive": (fault(drop_writes_after=1), "JOINT_NOT_FOLLOWING", "fault"),
    "cameras": (blackout, "FEATURES_STALE", "active"),
    "stop": (lambda flight: flight.cell.raise_stop(), "STOPPED", "active"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_single_fault_in_mid_goal_ends_at_rest(
    calibrated: tuple[CellModel, Any], tmp_path: Path, name: str
) -> None:
    inject, code, lifecycle = FAULTS[name]
    flight = Flight(tmp_path, *calibrated)
    inject(flight)
    flight.cell.run_for(BOUND_S)
    assert flight.speed() == pytest.approx(0.0, abs=1e-9)
    assert code in flight.codes()
    assert flight.cell.status is not None
    assert flight.cell.status.lifecycle == lifecycle
    flight.cell.run_for(1.0)
    assert flight.speed() == pytest.approx(0.0, abs=1e-9)  # no fault re-enables by itself
    assert len(flight.ends()) <= 1
    flight.cell.close()


def test_both_cameras_dark_for_two_seconds_changes_nothing_of_the_outcome(
    calibrated: tuple[CellModel, Any], tmp_path: Path
) -> None:
    flight = Flight(tmp_path, *calibrated)
    blackout(flight)
    flight.cell.run_for(2.0)
    for camera in flight.cameras:
        camera.blackout = False
    event = flight.cell.wait_for(
        lambda e: e.id == flight.goal.id and e.kind in ("goal_reached", "goal_aborted"), 30.0
    )
    assert event.kind == "goal_reached"
    flight.cell.close()


def test_goal_whose_set_points_are_of_no_displacement_is_refused(
    calibrated: tuple[CellModel, Any], tmp_path: Path
) -> None:
    flight = Flight(tmp_path, *calibrated)
    shown = calibrated[1]
    swapped = {camera: {**pixels, 0: pixels[3], 3: pixels[0]} for camera, pixels in shown.set_points.items()}
    reply = flight.cell.submit(RunGoal(Goal("0000abce", type(shown)(swapped))))
    assert reply.accepted is False
    assert "no displacement" in reply.message
    assert flight.ends() == []
    flight.cell.close()
