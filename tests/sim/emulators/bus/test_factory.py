"""Emulated buses from cell files: what is built, what is refused, and an arm that goes on where it stood."""

import msgspec
import numpy as np
import pytest

from stereoservo.messages.cell_file import load_cell_file
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.emulators.bus.factory import DrivesSettings, drives_of_cell, make_bus_emulator
from stereoservo_sim.emulators.fault_engine import EmulationError
from stereoservo_sim.emulators.nodes.odrive_node import OdriveNode
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.simulated_cell import demo_cell

MS = 1_000_000


@pytest.fixture(scope="module")
def cell():
    return load_cell_file(shipped_cell_path("hil-can"))


@pytest.fixture(scope="module")
def options(cell):
    return drives_of_cell(cell)[0]


def with_emulation(cell, **drives):
    return msgspec.structs.replace(cell, emulate={"drives": drives})


def test_the_shipped_cell_is_the_simulated_arm_at_its_base(cell):
    options, settings = drives_of_cell(cell)
    emulator = make_bus_emulator(options, settings, t_ns=0)
    assert [node.node_id for node in emulator.nodes] == [1, 2, 3, 4, 5, 6]
    assert np.allclose([node.axis.position for node in emulator.nodes], demo_cell().base)
    assert emulator.wire.bitrate is None
    emulator.run_until(20 * MS)
    assert {frame.id for _, frame in emulator.delivered()} >= {0x701, 0x702, 0x703, 0x704, 0x705, 0x706}
    emulator.close()


def test_bit_times_and_start_as_asked(options):
    settings = DrivesSettings(plant="ideal", bit_time=True, start={"j2": -0.5})
    emulator = make_bus_emulator(options, settings, t_ns=0)
    assert emulator.wire.bitrate == options.bitrate
    assert [node.axis.position for node in emulator.nodes] == [0.0, -0.5, 0.0, 0.0, 0.0, 0.0]


def test_odrives_are_built_by_protocol(options):
    emulator = make_bus_emulator(
        msgspec.structs.replace(options, protocol="odrive"), DrivesSettings(plant="ideal"), t_ns=0
    )
    assert all(isinstance(node, OdriveNode) for node in emulator.nodes)


def test_an_arm_goes_on_where_its_truth_ends_unless_told_otherwise(options, tmp_path):
    history = TrueJointHistory.create(tmp_path / FILE_NAME, 6, now_ns=0)
    stood = np.array([0.1, -1.2, -0.3, 0.2, 0.6, 0.05])
    history.append(50 * MS, stood, np.zeros(6))
    history.close()
    ideal = DrivesSettings(plant="ideal")
    emulator = make_bus_emulator(options, ideal, t_ns=100 * MS, runtime_dir=tmp_path)
    assert np.array_equal([node.axis.position for node in emulator.nodes], stood)
    emulator.run_until(200 * MS)
    emulator.close()
    reader = TrueJointHistory.open(tmp_path / FILE_NAME)
    assert reader.newest()[0] == 200 * MS
    assert np.array_equal(reader.at(150 * MS), stood)
    fresh = make_bus_emulator(
        options, msgspec.structs.replace(ideal, resume=False), t_ns=300 * MS, runtime_dir=tmp_path
    )
    assert not any(node.axis.position for node in fresh.nodes)
    fresh.close()


def test_drives_behind_gears_that_sag_report_their_motors(options, tmp_path):
    sagging = DrivesSettings(plant="ideal", mechanics={"j2": Mechanics(sag=0.02)}, start={"j2": -0.5})
    emulator = make_bus_emulator(options, sagging, t_ns=0, runtime_dir=tmp_path)
    emulator.run_until(100 * MS)
    link = TrueJointHistory.open(tmp_path / FILE_NAME).newest()[1]
    assert np.allclose(link, [0.0, -0.5, 0.0, 0.0, 0.0, 0.0])
    motor = emulator.nodes[1].axis.position
    assert np.isclose(motor + 0.02 * -np.cos(motor), -0.5)
    assert emulator.nodes[1].axis.following_error == 0.0
    emulator.close()


def test_mechanics_of_a_joint_that_is_not_there_are_refused(options):
    settings = DrivesSettings(plant="ideal", mechanics={"j9": Mechanics()})
    with pytest.raises(EmulationError, match=r"emulate\.drives\.mechanics: no joint 'j9'; joints: j1"):
        make_bus_emulator(options, settings, t_ns=0)


def test_a_remapped_pdo_is_shorter_on_the_bus(options):
    """By SDO alone, as somebody's tool would do it; the drive itself then sends the short frame."""
    emulator = make_bus_emulator(options, DrivesSettings(plant="ideal"), t_ns=0)
    for k, frame in enumerate(
        (
            CanFrame(0x603, b"\x23\x00\x18\x01\x83\x01\x00\x80"),  # TPDO 1 off,
            CanFrame(0x603, b"\x2f\x00\x18\x02\x01\0\0\0"),  # sent on every SYNC,
            CanFrame(0x603, b"\x23\x00\x18\x01\x83\x01\0\0"),  # on;
            CanFrame(0, b"\x01\x00"),  # operational
        )
    ):
        emulator.inject(frame, (10 + k) * MS)
    emulator.run_until(20 * MS)
    answer = emulator.order("remap 3", 20 * MS)
    assert "status word alone" in answer
    emulator.run_until(30 * MS)
    emulator.delivered()
    emulator.inject(CanFrame(0x80), 30 * MS)
    emulator.run_until(40 * MS)
    lengths = {frame.id: len(frame.data) for _, frame in emulator.delivered() if 0x181 <= frame.id <= 0x186}
    assert lengths[0x183] == 2
    emulator.close()


def test_a_drive_whose_cause_stays_refuses_its_reset(options):
    emulator = make_bus_emulator(options, DrivesSettings(plant="ideal"), t_ns=0)
    emulator.order("sticky 3 0x4310", 10 * MS)
    for k, word in enumerate((0x00, 0x80, 0x00)):
        data = b"\x2b\x40\x60\x00" + word.to_bytes(2, "little") + b"\0\0"
        emulator.inject(CanFrame(0x603, data), (20 + k) * MS)
    emulator.run_until(30 * MS)
    assert "fault" in emulator.nodes[2].state()
    emulator.order("sticky 3 off", 30 * MS)
    for k, word in enumerate((0x00, 0x80, 0x00)):
        data = b"\x2b\x40\x60\x00" + word.to_bytes(2, "little") + b"\0\0"
        emulator.inject(CanFrame(0x603, data), (40 + k) * MS)
    emulator.run_until(50 * MS)
    assert "fault" not in emulator.nodes[2].state()


def test_a_running_double_of_a_drive_does_not_share_its_arm(options):
    emulator = make_bus_emulator(options, DrivesSettings(plant="ideal"), t_ns=0)
    emulator.inject(CanFrame(0, b"\x01\x00"), 10 * MS)
    emulator.run_until(20 * MS)
    emulator.order("duplicate 3 running", 20 * MS)
    original, double = emulator.nodes[2], emulator.nodes[6]
    emulator.order("fault 3 0x3210", 21 * MS)
    assert "fault" in original.state()
    assert "fault" not in double.state()
    assert double.axis is not original.axis
    double.axis.powered = True
    assert not original.axis.powered


def test_cells_without_can_drives_are_refused():
    cell = load_cell_file(shipped_cell_path("demo"))
    with pytest.raises(EmulationError, match=r"'pybullet'; drives are emulated for 'canopen'"):
        drives_of_cell(cell)


@pytest.mark.parametrize(
    ("drives", "told"),
    [
        ({"plnat": "ideal"}, "no option 'plnat'; did you mean 'plant'\\? valid: urdf, flange"),
        ({"plant": "gazebo"}, "plant"),
        ({"brake_ms": -1.0}, "brake_ms"),
        ({"machine": {"mass": 3.0}}, "mass"),
    ],
)
def test_settings_are_decoded_strictly(cell, drives, told):
    with pytest.raises(EmulationError, match=told):
        drives_of_cell(with_emulation(cell, **drives))


def test_other_tables_of_emulation_are_refused(cell):
    with pytest.raises(EmulationError, match=r"emulate\.robots is unknown"):
        drives_of_cell(msgspec.structs.replace(cell, emulate={"robots": {}}))


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (DrivesSettings(plant="ideal", start={"j9": 0.0}), "no joint 'j9'; joints: j1"),
        (DrivesSettings(plant="ideal", start={"j1": 90.0}), "90 is outside the joint's range"),
        (
            DrivesSettings(plant="ideal", eds="none.eds"),
            r"emulate\.drives\.eds = 'none\.eds': there is no file none\.eds; leave eds out",
        ),
        (DrivesSettings(plant="ideal", rated_torques={"j9": 1.0}), "rated_torques: no joint 'j9'"),
    ],
)
def test_settings_that_fit_no_joint_are_refused(options, settings, told):
    with pytest.raises(EmulationError, match=told):
        make_bus_emulator(options, settings, t_ns=0)


def test_the_simulated_arm_has_the_joints_of_its_names_only(options):
    two = msgspec.structs.replace(options, joint=options.joint[:2])
    with pytest.raises(EmulationError, match="plant = 'ideal'"):
        make_bus_emulator(two, DrivesSettings(), t_ns=0)
    assert len(make_bus_emulator(two, DrivesSettings(plant="ideal"), t_ns=0).nodes) == 2
