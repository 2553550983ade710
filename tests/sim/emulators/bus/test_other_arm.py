"""Emulated drives of an arm that is not the embedded one: joints of the URDF, prismatic ones too."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.emulators.bus.factory import drives_of_cell, make_bus_emulator
from stereoservo_sim.emulators.fault_engine import EmulationError
from stereoservo_sim.world.arms.arm_cell import ArmPlace, cell_of, urdf_path

SCARA = cell_of(ArmPlace(urdf="scara.urdf"), "eye_to_hand", Path())


def scara_on_a_bus(**drives: object) -> CellFile:
    """The cell hil-can with the drives of the SCARA's joints."""
    cell = load_cell_file(shipped_cell_path("hil-can"))
    joints = [
        {
            "name": joint.name, "node_id": k + 1, "kind": joint.kind, "counts_per_rev": 65536,
            "gear_ratio": 160.0 if joint.kind == "revolute" else 100.0, "max_velocity": joint.velocity_max,
            "max_acceleration": joint.acceleration_max, "quick_stop_deceleration": 10.0,
            "position_min": joint.position_min, "position_max": joint.position_max,
        }
        for k, joint in enumerate(SCARA.robot.joints)
    ]  # fmt: skip
    options = {**cell.joints.options, "joint": joints}
    return msgspec.structs.replace(
        cell,
        joints=msgspec.structs.replace(cell.joints, options=options),
        emulate={"drives": {"urdf": "scara.urdf", **drives}},
    )


@pytest.mark.parametrize("plant", ["pybullet", "ideal"])
@pytest.mark.parametrize("mechanics", ["none", "strain_wave", "planetary_qdd", "serial_servo"])
def test_drives_move_the_arm_of_a_urdf(plant: str, mechanics: str, tmp_path: Path) -> None:
    cell = scara_on_a_bus(plant=plant, mechanics=mechanics)
    options, settings = drives_of_cell(cell)
    emulator = make_bus_emulator(options, settings, t_ns=0, runtime_dir=tmp_path)
    positions = np.array([node.axis.position for node in emulator.nodes])
    # motors stand where their gears leave the links at the cell's base
    assert np.allclose(positions, SCARA.base, atol=0.07)
    assert np.allclose(emulator.plant.plant.positions, SCARA.base, atol=1e-6)
    # and the cell's simulated cameras see that arm
    assert np.array_equal(true_cell(cell).base, SCARA.base)


def test_joints_that_are_not_the_urdfs_are_named() -> None:
    cell = scara_on_a_bus(urdf="gantry.urdf")
    options, settings = drives_of_cell(cell)
    with pytest.raises(EmulationError, match=r"gantry\.urdf' is the simulated arm with joints x \(prismatic\), z"):
        make_bus_emulator(options, settings, t_ns=0)


def test_joints_that_differ_are_told_with_what_the_file_leaves_out(tmp_path: Path) -> None:
    """Of a gripper's jaw, for which the cell has a drive as for a joint of the arm."""
    source = urdf_path("scara.urdf", tmp_path).read_text(encoding="utf-8")
    jaw = (
        '<link name="jaw"/><joint name="grip" type="revolute"><parent link="flange"/><child link="jaw"/>'
        '<limit lower="0" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    (tmp_path / "mine.urdf").write_text(source.replace("</robot>", jaw))
    cell = scara_on_a_bus(urdf="mine.urdf", plant="ideal")
    joints = cell.joints.options["joint"]
    joints.append({**joints[-1], "name": "grip", "node_id": len(joints) + 1})
    options, drives = drives_of_cell(cell, tmp_path)
    with pytest.raises(EmulationError, match=r"this cell has .*grip.*flange = 'jaw' makes it a joint of the arm"):
        make_bus_emulator(options, drives, t_ns=0, cell_dir=tmp_path)
