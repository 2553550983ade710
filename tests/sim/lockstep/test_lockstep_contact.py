"""Contact on the whole cell in lockstep: learnt while calibrating, met on the way, left again, replayed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.core.cycle import ModelUpdate
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CellFile, check_cell
from stereoservo.messages.goals import Goal, Jog, JointTarget, Resume, RunGoal
from stereoservo.recording.replay import replay
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.world.simulated_cell import demo_cell

NAMES = tuple(f"j{k}" for k in range(1, 7))


def fake_cell(contact: dict[str, Any]) -> CellFile:
    base = demo_cell().base
    return check_cell(
        {
            "schema": 1,
            "cell": {"name": "contact"},
            "joints": {"driver": "fake"},
            "camera": [{"name": name, "driver": "fake"} for name in ("left", "right")],
            "safety": {
                "limit": [
                    {"joint": n, "min": -m, "max": m, "velocity": 0.5, "acceleration": 4.0}
                    for n, m in zip(NAMES, (2.7, 2.3, 2.4, 4.7, 1.8, 4.7), strict=True)
                ],
                "contact": contact,
            },
            "calibration": {
                "base": dict(zip(NAMES, base.tolist(), strict=True)),
                "range": dict.fromkeys(NAMES, 0.25),
                "stops": 5,
                "frames": 2,
                "settle_s": 0.05,
                "speed_scale": 1.0,
            },
        }
    )


def to(cell: LockstepCell, **offsets: float) -> RunGoal:
    start = dict(zip(NAMES, demo_cell().base.tolist(), strict=True))
    return RunGoal(Goal("0000abcd", JointTarget({name: start[name] + offsets.get(name, 0.0) for name in NAMES})))


def codes(cell: LockstepCell) -> list[str]:
    assert cell.status is not None
    return [reason.code for reason in cell.status.reasons]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    directory = tmp_path_factory.mktemp("calibrated")
    with LockstepCell(fake_cell({}), cell_dir=directory, runtime_dir=directory) as cell:
        cell.run_for(0.5)
        operator = LockstepOperator(cell)
        operator.enable()
        return operator.calibrate()


def test_calibration_teaches_what_the_drives_tell(calibrated: CellModel) -> None:
    """The fake arm's drives follow exactly, up to the encoder, and feel no weight."""
    loads = calibrated.loads
    assert loads is not None
    assert loads.velocities == pytest.approx(0.5, abs=0.01)
    assert loads.following_errors is not None
    assert np.all((loads.following_errors > 0.0) & (loads.following_errors < 1e-6))
    assert loads.largest_efforts is not None
    assert not loads.largest_efforts.any()


def test_learnt_following_errors_stop_a_blocked_arm_and_let_it_go_back(calibrated: CellModel, tmp_path: Path) -> None:
    recording = tmp_path / "flight.mcap"
    with LockstepCell(fake_cell({}), cell_dir=tmp_path, runtime_dir=tmp_path, recording=recording) as cell:
        driver: Any = cell.joints
        cell.run_for(0.5)
        operator = LockstepOperator(cell)
        operator.enable()
        cell.update_model(ModelUpdate(calibrated))
        cell.run_for(0.3)
        assert cell.submit(to(cell, j1=0.4, j3=-0.1)).accepted
        cell.run_for(0.4)
        assert codes(cell) == []
        driver.faults.block_after = 1
        event = cell.wait_for(lambda e: e.id == "0000abcd" and e.kind == "goal_aborted", 0.1)
        assert (event.reasons[0].code, event.reasons[0].subject) == ("CONTACT_FOLLOWING", "j1")
        assert event.reasons[0].threshold == pytest.approx(0.5 / 250.0, rel=0.01)  # the floor: one cycle's way
        cell.run_for(1.0)
        assert cell.status is not None
        assert cell.status.lifecycle == "active"
        assert not cell.status.command.any()
        assert codes(cell)[-2:] == ["CONTACT_FOLLOWING", "STOPPED"]
        assert not cell.submit(Jog({"j1": -0.1}, 1.0)).accepted

        assert cell.submit(Resume()).accepted
        at = float(cell.status.positions[0])
        assert cell.submit(Jog({"j1": -0.1}, 1.0)).accepted
        cell.run_for(1.2)
        assert float(cell.status.positions[0]) < at - 0.05  # the way less what the set-point ran ahead
        assert codes(cell) == []
        assert cell.submit(Jog({"j1": 0.3}, 1.0)).accepted
        cell.wait_for(lambda e: e.kind == "stopped", 2.0, cell.events[-1].seq)
    assert replay(recording).identical is True


def test_a_stated_effort_stops_without_a_model(tmp_path: Path) -> None:
    contact = {"effort": {"j2": 8.0}, "following": {"j2": 1.0}}
    with LockstepCell(fake_cell(contact), cell_dir=tmp_path, runtime_dir=tmp_path) as cell:
        driver: Any = cell.joints
        cell.run_for(0.5)
        LockstepOperator(cell).enable()
        driver.faults.block_after, driver.faults.block_joint = 1, "j2"
        assert cell.submit(to(cell, j1=0.2, j2=0.2)).accepted
        event = cell.wait_for(lambda e: e.id == "0000abcd" and e.kind == "goal_aborted", 1.0)
        reason = event.reasons[0]
        assert (reason.code, reason.subject, reason.threshold, reason.unit) == (
            "CONTACT_EFFORT",
            "j2",
            8.0,
            "N m",
        )


def test_switched_off_contact_leaves_it_to_the_joints_travel(tmp_path: Path) -> None:
    with LockstepCell(fake_cell({"enabled": False}), cell_dir=tmp_path, runtime_dir=tmp_path) as cell:
        driver: Any = cell.joints
        cell.run_for(0.5)
        LockstepOperator(cell).enable()
        driver.faults.block_after, driver.faults.block_joint = 1, "j2"
        assert cell.submit(to(cell, j2=0.5)).accepted
        event = cell.wait_for(lambda e: e.id == "0000abcd" and e.kind == "goal_aborted", 3.0)
        assert event.reasons[0].code == "JOINT_NOT_FOLLOWING"
        assert cell.status is not None
        assert cell.status.effort_limits is None
