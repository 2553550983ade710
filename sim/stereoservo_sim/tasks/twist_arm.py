"""The tasks' RX 90 behind an interface of Cartesian velocities: six virtual joints, with its own controller.

The driver's kit (`kit.cartesian`) over the controller of driver ``twist`` over ideal velocity drives, in virtual time.
Twists leak slightly into other directions, are ramped and scaled down, and the controller stops the arm by itself near
a singularity and at a joint's limit, neither of which is known to the service.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.kinematics.composition import Composition
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, JointSpec
from stereoservo_drivers.fake import FakeJointDriver
from stereoservo_drivers.kit.cartesian import CartesianJointDriver, cartesian_description
from stereoservo_drivers.kit.virtual_joints import VirtualLimits, positions_of
from stereoservo_drivers.twist import LIMIT_MARGIN, SINGULAR, SimulatedController, TwistOptions
from stereoservo_sim.tasks.arms import MID_RANGE, PLATE_ON_FLANGE, RX90_LIMITS, inverse_kinematics, rx90_cell
from stereoservo_sim.tasks.setting import MARKERS
from stereoservo_sim.world.arms.arm_cell import LEVER, body_jacobian
from stereoservo_sim.world.arms.virtual_arm import TO_NEXT, virtual_links
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.robots import Robot, flange_pose
from stereoservo_sim.world.synthetic import SyntheticCell

BOX, TURNS = 0.8, (1.6, 1.35, 6.2)
"""Ranges of the virtual joints to either side of mid-range [m], and about the tool's x, y, z [rad]."""
SPEEDS, ACCELERATIONS = (0.25, 1.0), (1.0, 4.0)
"""Limits of translations and rotations [m/s, rad/s; m/s², rad/s²]."""
CONTROLLER_SPEEDS = (0.5, 2.0)
"""Speeds to which the controller scales twists down: more than three translations, or rotations, give together."""
JOINT_SPEED, JOINT_ACCELERATION = 4.0, 20.0
"""Limits of the RX 90's own joints [rad/s, rad/s²]."""
RATE_HZ = 250.0
"""Rate of the interface."""
STRIDE = 0.02, 0.08
"""Largest distance between poses of a tested path [m, rad]."""
CLEAR_OF_LIMIT, CLEAR_OF_SINGULARITY = LIMIT_MARGIN + 0.05, 3.0 * SINGULAR
"""Clearance of a tested path, beyond where the controller stops [rad; smallest over largest singular value]."""


class TwistArm:
    """`TaskArm` of virtual joints, with the RX 90's own at ``start`` (6,)."""

    composition = Composition.BASE_FIRST

    def __init__(self, start: FloatArray) -> None:
        self._rig, self._robot = _placed()
        self._clock = VirtualClock()
        self._history = TrueJointHistory.in_memory(6, 64)
        context = DriverContext(
            self._clock, "tasks", Path(), Path(), services={"world": self._history}
        )  # no files are read
        joints = [
            {
                "name": joint.name,
                "min": joint.position_min,
                "max": joint.position_max,
                "velocity": joint.velocity_max,
                "acceleration": joint.acceleration_max,
            }
            for joint in self._robot.joints
        ]
        at = {joint.name: value for joint, value in zip(self._robot.joints, start.tolist(), strict=True)}
        inner = FakeJointDriver({"joints": joints, "start": at, "rate_hz": RATE_HZ}, context)
        options = TwistOptions(speeds=CONTROLLER_SPEEDS, accelerations=ACCELERATIONS)
        controller = SimulatedController(options, inner, self._robot, context)
        limits = virtual_limits(self._rig)
        description = cartesian_description(
            "twist", limits, rate_hz=RATE_HZ, timeout_s=options.command_timeout_s, budget_us=500.0
        )
        self.limits = np.array([(joint.position_min, joint.position_max) for joint in description.joints])
        self._driver = CartesianJointDriver(controller, description, attitude(self._rig))
        self._driver.configure()
        self._driver.activate()
        self.joints = self._driver.read_state().positions

    def move(self, velocity: FloatArray, dt_s: float) -> None:
        """Command ``velocity`` (6,) once per cycle of the interface. Raises DriverError if the arm has stopped."""
        cycles = max(1, round(dt_s * RATE_HZ))
        for _ in range(cycles):
            self._driver.write_velocity(velocity)
            self._clock.advance_to(self._clock.now_ns() + round(1e9 * dt_s / cycles))
        self.joints = self._driver.read_state().positions

    @property
    def pose(self) -> FloatArray:
        """True pose of the plate."""
        newest = self._history.newest()
        assert newest is not None  # the driver is configured
        pose: FloatArray = self._rig @ flange_pose(self._robot, newest[1])
        return pose


def _placed() -> tuple[FloatArray, Robot]:
    """The RX 90's base in the rig (4, 4), and the arm in its own base frame with the plate as its flange."""
    cell = rx90_cell()
    links = np.array(cell.links)
    links[-1] = links[-1] @ PLATE_ON_FLANGE
    joints = tuple(
        JointSpec(name, "revolute", low, high, JOINT_SPEED, JOINT_ACCELERATION)
        for name, (low, high) in zip(cell.joint_names, RX90_LIMITS.tolist(), strict=True)
    )
    return cell.base, Robot("rx90", np.eye(4), links, joints, np.zeros(6), np.zeros((6, 3)), ())


def attitude(rig_from_base: FloatArray) -> FloatArray:
    """Attitude (3, 3), base from plate, at which rotations are zero: the plate faces the point between the cameras."""
    facing: FloatArray = rig_from_base[:3, :3].T
    return facing


def virtual_limits(rig_from_base: FloatArray) -> VirtualLimits:
    """Limits of the virtual joints around mid-range."""
    x, y, z = (np.linalg.inv(rig_from_base) @ MID_RANGE)[:3, 3].tolist()
    low, high = (x - BOX, y - BOX, z - BOX), (x + BOX, y + BOX, z + BOX)
    return VirtualLimits(low, high, TURNS, SPEEDS, ACCELERATIONS)


def twist_cell() -> SyntheticCell:
    """The virtual joints as a serial arm before the tasks' cameras, the plate at mid-range when at home."""
    cell = rx90_cell()
    facing = attitude(cell.base)
    home = positions_of(np.linalg.inv(cell.base) @ MID_RANGE, facing, np.zeros(6))
    return SyntheticCell(
        cell.base @ TO_NEXT,
        ("prismatic",) * 3 + ("revolute",) * 3,
        tuple(virtual_links(facing)),
        MARKERS,
        cell.intrinsics,
        cell.poses,
        home,
        np.zeros(6),
        cell.lenses,
    )


def twist_start(way: FloatArray) -> FloatArray | None:
    """The RX 90's joints (6,) at the start of a path (k, 4, 4) of the plate.

    Of several configurations the one that stays farthest from singularities; None if none can follow the path clear of
    its limits and singularities.
    """
    rig, robot = _placed()
    rehearsed = np.linalg.inv(rig) @ _dense(way)
    found = inverse_kinematics(rehearsed[0] @ np.linalg.inv(PLATE_ON_FLANGE), RX90_LIMITS)
    clear = [_clearance(robot, q, rehearsed) for q in found]
    best = int(np.argmax(clear)) if clear else -1
    return found[best] if clear and clear[best] > 0.0 else None


def _dense(way: FloatArray) -> FloatArray:
    """Poses on a path (k, 4, 4) at most `STRIDE` apart, interpolated on a line and about one axis between two."""
    poses, last = [way[0]], way[0]
    for pose in way[1:]:
        turn = Rotation.from_matrix(pose[:3, :3] @ last[:3, :3].T).as_rotvec()
        shift = pose[:3, 3] - last[:3, 3]
        parts = max(np.linalg.norm(shift) / STRIDE[0], np.linalg.norm(turn) / STRIDE[1])
        if parts < 0.5 and pose is not way[-1]:
            continue
        for share in np.linspace(0.0, 1.0, int(np.ceil(parts)) + 1)[1:]:
            between = np.eye(4)
            between[:3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ last[:3, :3]
            between[:3, 3] = last[:3, 3] + share * shift
            poses.append(between)
        last = pose
    return np.array(poses)


def _clearance(robot: Robot, q: FloatArray, way: FloatArray) -> float:
    """Least ratio of the arm's singular values on a path (k, 4, 4) from ``q`` (6,) on; 0 if it is not clear."""
    low, high = RX90_LIMITS[:, 0] + CLEAR_OF_LIMIT, RX90_LIMITS[:, 1] - CLEAR_OF_LIMIT
    least = 1.0
    # Poses are so close that one Newton step brings the arm to the next; the last pose is checked, too.
    for pose in [*way, way[-1]]:
        there = flange_pose(robot, q)
        u, values, vt = np.linalg.svd(body_jacobian(robot, q, there[:3, 3]))
        least = min(least, float(values[-1] / values[0]))
        if least < CLEAR_OF_SINGULARITY or not ((low < q) & (q < high)).all():
            return 0.0
        turn = Rotation.from_matrix(pose[:3, :3] @ there[:3, :3].T).as_rotvec()
        step = np.concatenate([pose[:3, 3] - there[:3, 3], LEVER * turn])
        q = q + vt.T @ ((u.T @ step) / values)
    return least
