"""Any arm in the simulated cell: URDF files against pybullet, what the search promises, cell files that leave out."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.core.settings import core_settings
from stereoservo.messages.cell_file import CellFileError, check_cell, load_cell_file
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.fake import FakeCameraDriver, FakeJointDriver
from stereoservo_sim.cells import ARMS, shipped_cell_path
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.experiments.random_rigs import arm_case, judged_case, twin
from stereoservo_sim.world.arms.arm_cell import (
    ArmPlace,
    body_jacobian,
    cell_of,
    seen_by_all,
    urdf_path,
)
from stereoservo_sim.world.arms.arm_goals import goals_of, goes_straight, straight_way
from stereoservo_sim.world.mechanics import PINION, PRESETS, chosen_mechanics, gravity_load, largest_torques
from stereoservo_sim.world.physics import PybulletPlant
from stereoservo_sim.world.robots import Robot, flange_pose, joint_frames
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.urdf_file import UrdfError, load_urdf
from stereoservo_sim.world.workpiece import Moved

HERE = Path(__file__).parent
MOUNTED = Moved((0.1, -0.2, 0.3), (10.0, 20.0, -30.0)).matrix


@cache
def shipped(name: str) -> SimulatedCell:
    path = shipped_cell_path(name)
    return true_cell(load_cell_file(path), path.parent)


def file_of(name: str) -> Path:
    return urdf_path(load_cell_file(shipped_cell_path(name)).joints.options["urdf"], HERE)


def random_configurations(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    low, high = ([getattr(j, f"position_{side}") for j in robot.joints] for side in ("min", "max"))
    return np.random.default_rng(seed).uniform(low, high, (count, len(robot.joints)))


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_is_where_and_as_heavy_as_pybullet_has_it(name: str) -> None:
    """On a tilted stand: link poses, the flange, and what gravity asks of each joint by inverse dynamics."""
    robot = load_urdf(file_of(name), mounted=MOUNTED)
    engine = PybulletPlant(robot, random_configurations(robot, 1)[0], 1e-3)
    try:
        for q in random_configurations(robot, 10, seed=1):
            engine.place(q)
            assert np.abs(engine.flange() - flange_pose(robot, q)).max() < 1e-6
            assert np.abs(gravity_load(robot, q)).max() <= 1.0
            assert np.allclose(gravity_load(robot, q) * largest_torques(robot), -engine.efforts, atol=1e-9)
    finally:
        engine.close()


@pytest.mark.parametrize("name", ARMS)
def test_the_jacobian_of_the_body_is_the_difference_quotient(name: str) -> None:
    robot = shipped(name).robot
    for q in random_configurations(robot, 3, seed=2):
        pose = flange_pose(robot, q)
        J = body_jacobian(robot, q, pose[:3, 3])
        for k in range(len(q)):
            later = q.copy()
            later[k] += 1e-6
            moved = (flange_pose(robot, later)[:3, 3] - pose[:3, 3]) / 1e-6
            assert np.allclose(J[:3, k], moved, atol=1e-5)


@pytest.mark.parametrize("name", ARMS)
def test_the_cell_that_is_found_shows_the_arm_well(name: str) -> None:
    cell = shipped(name)
    assert seen_by_all(cell, cell.base)
    pose = flange_pose(cell.robot, cell.base)
    values = np.linalg.svd(body_jacobian(cell.robot, cell.base, pose[:3, 3] + 0.1 * pose[:3, 2]), compute_uv=False)
    assert values[-1] > 0.05 * values[0]
    for q, joint in zip(cell.base, cell.robot.joints, strict=True):
        least = 0.25 if joint.kind == "revolute" else 0.05
        assert min(q - joint.position_min, joint.position_max - q) > least, joint.name
    synthetic = twin(cell, cell.base)
    seen = np.array([cell.truth_pixels(cell.base)[camera.name] for camera in cell.rig.cameras])
    assert np.allclose(synthetic.pixels(cell.base[None])[:, 0], seen, atol=1e-9)


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_calibrates_itself_as_truly_as_it_says(name: str) -> None:
    verdict = judged_case(arm_case(name, 0))
    assert verdict.outcome == "success", verdict
    # axes that are all parallel, or none, leave the angles of space open
    assert verdict.stratum == ("affine" if name in ("scara", "gantry") else "metric")


@pytest.mark.parametrize("name", ["scara", "pan_tilt", "xarm"])
def test_goals_are_seen_on_the_whole_way(name: str) -> None:
    cell = shipped(name)
    goals = goals_of(cell)
    assert tuple(goals) == ("near", "roll", "far")
    for q in goals.values():
        ways = [cell.base + np.linspace(0, 1, 23)[:, None] * (q - cell.base)]
        if goes_straight(cell.robot, cell.base):
            straight = straight_way(cell, q)
            assert straight is not None
            error = np.linalg.inv(flange_pose(cell.robot, straight[-1])) @ flange_pose(cell.robot, q)
            assert np.allclose(error, np.eye(4), atol=2e-3)
            ways.append(straight)
        assert all(seen_by_all(cell, one) for way in ways for one in way[::3])


def test_only_motions_that_make_a_group_go_straight() -> None:
    assert [name for name in ARMS if not goes_straight(shipped(name).robot, shipped(name).base)] == ["pan_tilt"]


def test_a_gripper_is_no_part_of_the_chain() -> None:
    robot = load_urdf(file_of("panda"))
    assert (len(robot.joints), robot.flange) == (7, "panda_hand")
    with_finger = load_urdf(file_of("panda"), flange="panda_leftfinger")
    assert with_finger.joint_names[-1] == "panda_finger_joint1"
    assert with_finger.joints[-1].kind == "prismatic"
    tip = load_urdf(file_of("panda"), flange="panda_grasptarget")
    q = random_configurations(robot, 1)[0]
    assert np.allclose(joint_frames(tip, q)[0], joint_frames(robot, q)[0])
    assert not np.allclose(flange_pose(tip, q), flange_pose(robot, q))


ONE_JOINT = """<robot name="one"><link name="a"/><link name="b"/>
<joint name="j" type="{kind}"><parent link="a"/><child link="{child}"/>{more}</joint></robot>"""


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<robot", "is not XML"),
        ("<model/>", "outermost element is <model>"),
        (
            ONE_JOINT.format(kind="planar", child="b", more=""),
            "no joint moves between 'a' and the flange 'a'",
        ),
        (ONE_JOINT.format(kind="revolute", child="c", more=""), "its child 'c' is no link; links: a, b"),
        (ONE_JOINT.format(kind="fixed", child="b", more=""), "no joint moves"),
        (ONE_JOINT.format(kind="continuous", child="b", more='<axis xyz="0 0 0"/>'), "a direction is needed"),
        (
            ONE_JOINT.format(kind="continuous", child="b", more='<axis xyz="0 0"/>'),
            "three numbers are needed",
        ),
        (
            ONE_JOINT.format(kind="prismatic", child="b", more='<limit lower="1" upper="0"/>'),
            "the lower must be below the upper",
        ),
    ],
)
def test_a_file_that_cannot_be_used_says_why(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "arm.urdf").write_text(text)
    with pytest.raises(UrdfError, match=told) as error:
        load_urdf(tmp_path / "arm.urdf")
    assert "arm.urdf" in str(error.value)


def test_options_that_name_nothing_say_what_there_is() -> None:
    with pytest.raises(ValueError, match=r"no such file .* shipped are gantry.urdf, .* kuka_iiwa/model.urdf"):
        cell_of(ArmPlace(urdf="arm.urdf"), "eye_to_hand", HERE)
    with pytest.raises(ValueError, match="no joint 'j9'; joints: shoulder, elbow, lift, spin"):
        cell_of(ArmPlace(urdf="scara.urdf", base={"j9": 0.0}), "eye_to_hand", HERE)
    with pytest.raises(ValueError, match=r"base\.lift is 0\.5; the joint's range is 0 to 0.3"):
        cell_of(ArmPlace(urdf="scara.urdf", base={"lift": 0.5}), "eye_to_hand", HERE)
    with pytest.raises(ValueError, match="flange 'hand' is no link; links: base, upper_arm"):
        cell_of(ArmPlace(urdf="scara.urdf", flange="hand"), "eye_to_hand", HERE)
    with pytest.raises(ValueError, match="distance_m is of an arm of your own; give its urdf as well"):
        cell_of(ArmPlace(distance_m=1.0), "eye_to_hand", HERE)


def test_one_line_of_a_cell_file_is_another_arm(tmp_path: Path) -> None:
    """A user's own file beside the cell file; limits, base and start are the arm's."""
    (tmp_path / "mine.urdf").write_bytes(file_of("gantry").read_bytes())
    tree = {
        "schema": 1, "cell": {"name": "mine"}, "joints": {"driver": "fake", "options": {"urdf": "mine.urdf"}},
        "camera": [{"name": side, "driver": "fake"} for side in ("left", "right")], "calibration": {},
    }  # fmt: skip
    cell = check_cell({**tree, "safety": {}})
    context = DriverContext(VirtualClock(), "mine", tmp_path, tmp_path, "left", arm=cell.arm_options)
    arm = FakeJointDriver(cell.joints.options, context)
    camera = FakeCameraDriver({}, context)
    assert np.array_equal(camera.cell.base, shipped("gantry").base)
    described = camera.describe()
    cameras = tuple(msgspec.structs.replace(described, name=side) for side in ("left", "right"))
    settings = core_settings(cell, arm.describe(), cameras)
    assert settings.joint_kinds == ("prismatic",) * 3
    assert settings.limits.position_max.tolist() == [0.6, 1.1, 0.5]
    assert settings.trials is not None
    assert np.array_equal(settings.trials.base, shipped("gantry").base)
    assert np.array_equal(settings.home, settings.trials.base)
    with pytest.raises(DriverError, match="joints and urdf both say which arm"):
        FakeJointDriver({"urdf": "mine.urdf", "joints": [{"name": "j1"}]}, context)
    # what moves something real still states its limits
    real = msgspec.structs.replace(arm.describe(), simulated=False)
    with pytest.raises(CellFileError, match="joint 'x' of driver 'fake' has no limits"):
        core_settings(cell, real, cameras)
    # and what is stated of a simulated arm is checked
    wrong = check_cell({**tree, "safety": {}, "calibration": {"base": {"x": 2.0}}})
    with pytest.raises(CellFileError, match=r"calibration.base.x: is 2; -0.59 to 0.59 is valid"):
        core_settings(wrong, arm.describe(), cameras)


def test_a_preset_drives_a_prismatic_joint_by_a_pinion() -> None:
    turning, sliding = chosen_mechanics("serial_servo", ("a", "b"), (False, True)) or ()
    one = PRESETS["serial_servo"]
    assert (turning.play, sliding.play) == (one.play, one.play * PINION)
    assert sliding.encoder_step == one.encoder_step * PINION
    assert (sliding.lag_s, sliding.play_friction) == (one.lag_s, one.play_friction)
    # As many ripples while it slides round the pinion as in a turn of the gear.
    waves = chosen_mechanics("strain_wave", ("a",), (True,)) or ()
    assert np.isclose(waves[0].ripple_order * 2 * np.pi * PINION, 200.0 * 2 * np.pi)


def test_cameras_on_the_arm_are_carried(tmp_path: Path) -> None:
    cell = shipped("pan_tilt")
    assert cell.stand is not None
    q = cell.base + 0.1
    assert np.array_equal(cell.body_pose(q), cell.stand)
    seen = cell.truth_pixels(q)
    assert min(np.abs(seen[name] - pixels).max() for name, pixels in cell.truth_pixels(cell.base).items()) > 10.0
