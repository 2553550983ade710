"""What the supervisor puts in order before it starts a child again: the run plan and the slots."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereoservo.daemon.ipc_messages import (
    OBSERVATION_LAYOUT,
    PlanError,
    RunPlan,
    load_plan,
    save_plan,
)
from stereoservo.daemon.seqlock import SlotReader, StopSlot, create_stop_slot
from stereoservo.daemon.supervisor import restore
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.servo_state import STATE_LAYOUT
from stereoservo.ports.devices import CameraDescription, JointDriverDescription, JointSpec

CELL = check_cell(
    {
        "schema": 1,
        "cell": {"name": "bench"},
        "joints": {"driver": "stub"},
        "camera": [{"name": "left", "driver": "stub"}],
        "safety": {"limit": []},
    }
)
JOINTS = JointDriverDescription("stub", (JointSpec("j1", "revolute", -2.0, 2.0, 1.0, 4.0),), 250.0, "clock", 0.1, 100.0)
CAMERA = CameraDescription("stub", "left", 640, 480, 30.0, "observations", 100.0, (0, 1, 2))


@pytest.fixture
def plan(tmp_path: Path) -> RunPlan:
    found = RunPlan(CELL, "cell.toml", str(tmp_path), str(tmp_path), "boot", JOINTS, (CAMERA,))
    save_plan(found)
    create_stop_slot(found.directories.stop_slot)
    restore(found)
    return found


def test_what_is_whole_is_left_as_it_is(plan: RunPlan, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert restore(plan) == []
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_child_finds_all_that_it_needs_again(plan: RunPlan, tmp_path: Path) -> None:
    for path in tmp_path.iterdir():
        path.write_bytes(b"\xff" * 10)
    with pytest.raises(PlanError):
        load_plan(tmp_path)
    told = restore(plan)
    # plan, stop slot, state, ring of steps, four heartbeats; four of the camera: observation, prior, preview, who asks
    assert len(told) == 12
    assert load_plan(tmp_path).boot == "boot"
    assert StopSlot(plan.directories.stop_slot).raise_stop()
    SlotReader(plan.directories.state_slot, STATE_LAYOUT).close()
    SlotReader(plan.directories.observation_slot("left"), OBSERVATION_LAYOUT).close()


@pytest.mark.parametrize("data", [b"", b"\x81" * 60_000, b"\xff", b"\xa1\xff"])
def test_a_damaged_plan_is_one_kind_of_refusal(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "plan.msgpack").write_bytes(data)
    with pytest.raises(PlanError, match=r"plan\.msgpack: .*started by `stereoservo run`"):
        load_plan(tmp_path)
