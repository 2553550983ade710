"""Arms that take Cartesian velocities: virtual joints against a serial arm that has them, and the driver."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.messages.cell_file import load_cell_file
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError, JointDriver
from stereoservo_drivers.contracts import JointDriverContract
from stereoservo_drivers.kit.cartesian import CartesianArm, CartesianState
from stereoservo_drivers.kit.joint_checks import JOINT_CHECKS, run_check
from stereoservo_drivers.kit.virtual_joints import positions_of, turn, twist_of, velocities_of
from stereoservo_drivers.twist import TwistJointDriver, seen_as_joints, virtual_positions
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.world.arms.arm_cell import body_jacobian, cell_of, place_of
from stereoservo_sim.world.robots import flange_pose

PATH = shipped_cell_path("twist")
BASE = {"joint1": 1.07, "joint2": 0.49, "joint3": -0.91, "joint4": -0.97, "joint5": 2.42, "joint6": 1.61}
OPTIONS: dict[str, Any] = load_cell_file(PATH).joints.options | {"base": BASE}  # stated: nothing is searched for
ELSEWHERE = OPTIONS | {
    "mounted": {"shift_m": [0.1, -0.2, 0.3], "turn_deg": [10.0, 20.0, -30.0]},
    "tool": {"shift_m": [0.02, 0.0, 0.1], "turn_deg": [0.0, 25.0, 40.0]},
    "arm": "fake",
}


class TestTwist(JointDriverContract):
    frame = "base"

    def make_driver(self, context: DriverContext) -> JointDriver:
        near = {"box": [0.04, 0.04, 0.04], "turns": [0.1, 0.1, 0.1], "arm": "fake", "frame": self.frame}
        return TwistJointDriver(OPTIONS | near, context)


class TestTwistInTheToolsAxes(TestTwist):
    frame = "tool"


def driven(tmp_path: Path, options: dict[str, Any]) -> tuple[TwistJointDriver, VirtualClock]:
    clock = VirtualClock()
    driver = TwistJointDriver(options, DriverContext(clock, "t", tmp_path, PATH.parent))
    driver.configure()
    driver.activate()
    return driver, clock


def test_virtual_joints_are_those_of_a_serial_arm_that_has_them() -> None:
    """Poses, and velocities by its Jacobian, of three slides and three turns built link by link."""
    options = ELSEWHERE | {"attitude": [0.4, -1.1, 0.7]}
    cell = cell_of(place_of(options), "eye_to_hand", PATH.parent)
    virtual = seen_as_joints(options, cell)
    tool = turn(np.radians([0.0, 25.0, 40.0]))
    attitude = turn(np.array(options["attitude"]))
    rng = np.random.default_rng(3)
    for _ in range(20):
        q = rng.uniform(-1.0, 1.0, 6) * [0.4, 0.4, 0.4, 3.0, 1.3, 3.0] + [0.3, 0.0, 0.4, 0.0, 0.0, 0.0]
        pose = flange_pose(virtual.robot, q)
        at_tool = pose @ np.block([[tool, np.array([[0.02], [0.0], [0.1]])], [np.zeros((1, 3)), np.ones((1, 1))]])
        base = np.linalg.inv(cell.robot.mounted)
        found = positions_of(base @ at_tool, attitude, q + rng.uniform(-3.0, 3.0, 6))
        wrapped = found - q
        wrapped[3:] -= 2.0 * np.pi * np.round(wrapped[3:] / (2.0 * np.pi))
        assert np.abs(wrapped).max() < 1e-12
        rates = rng.standard_normal(6)
        v, w = twist_of(q, rates, attitude)
        J = body_jacobian(virtual.robot, q, at_tool[:3, 3])
        moved = J @ rates
        R = cell.robot.mounted[:3, :3]
        assert np.allclose(R @ v, moved[:3], atol=1e-12)
        assert np.allclose(R @ w, moved[3:] / 0.3, atol=1e-12)
        assert np.allclose(velocities_of(q, v, w, attitude), rates, atol=1e-9)


def test_turns_are_followed_beyond_half_a_turn_and_refused_near_the_singular_tilt() -> None:
    near = np.zeros(6)
    for a in np.linspace(0.0, 5.0, 60):
        pose = np.eye(4)
        pose[:3, :3] = turn(np.array([0.0, 0.0, a]))
        near = positions_of(pose, np.eye(3), near)
        assert near[5] == pytest.approx(a, abs=1e-12)
    pose[:3, :3] = turn(np.radians([0.0, 85.0, 0.0]))
    with pytest.raises(DriverError, match=r"tilted by 85°.*set the attitude"):
        positions_of(pose, np.eye(3), near)


def test_the_arm_goes_where_it_is_told_and_its_camera_sees_it_there(tmp_path: Path) -> None:
    """A turned base, a tool aside, the tool's axes: the true flange is where six exact joints would have it."""
    driver, clock = driven(tmp_path, ELSEWHERE | {"frame": "tool"})
    rates = np.array([0.03, -0.02, 0.02, 0.1, -0.15, 0.2])
    for _ in range(500):
        driver.write_velocity(rates)
        clock.advance_to(clock.now_ns() + 4_000_000)
    moved = driver.read_state()
    assert np.allclose(moved.velocities, rates, atol=2e-3)
    assert moved.positions - np.array(driver.describe().home) == pytest.approx(rates * 1.9, rel=0.1, abs=2e-3)
    q = driver._inner._bank.plant.positions  # the truth, which no driver tells
    cell = driver._cell
    virtual = seen_as_joints(ELSEWHERE, cell)
    assert np.abs(flange_pose(virtual.robot, moved.positions) - flange_pose(cell.robot, q)).max() < 1e-5
    assert virtual_positions(ELSEWHERE, cell, q) == pytest.approx(moved.positions, abs=1e-5)


def test_the_controller_stops_by_itself_and_after_a_reset_the_way_back_is_free(tmp_path: Path) -> None:
    """At the arm's last joint's limit, which the cell does not know; and where the arm is stretched."""
    driver, clock = driven(tmp_path, OPTIONS | {"arm": "fake", "turns": [2.0, 1.2, 9.0], "box": [2.0, 2.0, 2.0]})

    def drive(rates: list[float], steps: int) -> None:
        for _ in range(steps):
            driver.write_velocity(np.array(rates))
            clock.advance_to(clock.now_ns() + 20_000_000)

    with pytest.raises(
        DriverError, match="controller has stopped the arm: joint joint6 of the arm at its limit; reset"
    ):
        drive([0.0, 0.0, 0.0, 0.0, 0.0, 0.5], 800)
    driver.stop()
    driver.deactivate()
    driver.configure()
    driver.activate()
    at = driver.read_state().positions[5]
    drive([0.0, 0.0, 0.0, 0.0, 0.0, -0.5], 40)
    assert driver.read_state().positions[5] < at - 0.1
    with pytest.raises(DriverError, match="near a singularity of the arm; reset"):
        drive([0.15, 0.0, 0.15, 0.0, 0.0, 0.0], 800)


def test_a_robot_that_tells_no_numbers_is_not_driven_by_them_and_nothing_of_them_stays(
    tmp_path: Path,
) -> None:
    driver, _ = driven(tmp_path, OPTIONS | {"arm": "fake"})
    arm = driver._arm
    read, written = arm.read, []
    arm.write = lambda v, w: written.append((v, w)) or (v, w)  # type: ignore[method-assign]
    for broken in ("pose", "v", "w"):
        arm.read = lambda broken=broken: read()._replace(**{broken: np.nan * getattr(read(), broken)})  # type: ignore[method-assign, misc]
        for call in (driver.read_state, lambda: driver.write_velocity(np.full(6, 0.01))):
            with pytest.raises(DriverError, match="no numbers"):
                call()
    assert not written
    arm.read = read  # type: ignore[method-assign]
    assert np.isfinite(driver.read_state().positions).all()
    driver.write_velocity(np.full(6, 0.01))
    assert np.isfinite(written).all()


class MisreadArm:
    """The simulated controller as somebody's `CartesianArm` that reads or commands it wrongly, as ``wrong`` says."""

    def __init__(self, arm: CartesianArm, wrong: str) -> None:
        self._arm, self._wrong = arm, wrong

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def read(self) -> CartesianState:
        told = self._arm.read()
        pose, attitude = told.pose.copy(), Rotation.from_matrix(told.pose[:3, :3])
        v, w = told.v, told.w
        if self._wrong == "millimetres":
            pose[:3, 3], v = 1e3 * pose[:3, 3], 1e3 * v
        elif self._wrong == "degrees":
            pose[:3, :3] = Rotation.from_rotvec(np.degrees(attitude.as_rotvec())).as_matrix()
            w = np.degrees(w)
        elif self._wrong == "rotation vector taken for angles":
            pose[:3, :3] = Rotation.from_euler("xyz", attitude.as_rotvec()).as_matrix()
        elif self._wrong == "tool from base":
            pose[:3, :3] = pose[:3, :3].T
        return told._replace(pose=pose, v=v, w=w)

    def write(self, v: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self._wrong != "commands in millimetres":
            return self._arm.write(v, w)
        carried, turned = self._arm.write(1e-3 * v, w)
        return 1e3 * carried, turned


@pytest.mark.parametrize(
    ("wrong", "check"),
    [
        ("nothing", ""),
        ("millimetres", "moves as told"),
        ("commands in millimetres", "moves as told"),
        ("degrees", "moves as told"),
        ("rotation vector taken for angles", "agrees with its velocities"),
        ("tool from base", "moves as told"),
        ("twists in the tool's axes", "moves as told"),
    ],
)
def test_the_drivers_checks_tell_a_wrong_unit_or_frame_of_a_cartesian_arm(
    tmp_path: Path, wrong: str, check: str
) -> None:
    """Without cameras: `driver-check` is where a base link that is wrong shows."""

    class Setup(JointDriverContract):
        def make_driver(self, context: DriverContext) -> JointDriver:
            near = {"box": [0.04, 0.04, 0.04], "turns": [0.1, 0.1, 0.1], "arm": "fake"}
            frame = "tool" if wrong == "twists in the tool's axes" else "base"
            driver = TwistJointDriver(OPTIONS | near | {"frame": frame}, context)
            driver._arm, driver._frame = MisreadArm(driver._arm, wrong), "base"
            return driver

    names = ("moves as told", "agrees with its velocities")
    found = []
    for number, each in enumerate(c for c in JOINT_CHECKS if c.name in names):
        folder = tmp_path / str(number)
        folder.mkdir()
        found.append(run_check(each, Setup(), folder))
    failed = {result.name: result.remedy for result in found if result.verdict == "failed"}
    assert (check in failed) if check else not failed, found
    assert all("of a Cartesian arm" in remedy for remedy in failed.values())
