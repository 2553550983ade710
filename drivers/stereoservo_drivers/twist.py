"""Driver ``twist``: a simulated arm behind a Cartesian-velocity interface, with its own controller.

The controller solves its inverse kinematics at each call, in velocities, has its own speed limits and time-out, and
stops the arm by itself near a singularity and at a joint's limit, as such controllers do; the cell has no access to the
arm's own joints. For the driver of a real one see `kit.cartesian`, docs/extending.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.fake import FakeJointDriver
from stereoservo_drivers.kit.cartesian import CartesianJointDriver, CartesianState, Frame, cartesian_description
from stereoservo_drivers.kit.virtual_joints import VirtualLimits, positions_of, turn
from stereoservo_drivers.options import decode_options
from stereoservo_drivers.pybullet import PybulletJointDriver
from stereoservo_drivers.simulated_arm import ArmOptions, SimulatedArm, cell_of_context
from stereoservo_sim.world.arms.arm_cell import LEVER, body_jacobian
from stereoservo_sim.world.arms.virtual_arm import virtual_cell
from stereoservo_sim.world.camera_rig import inverse_pose
from stereoservo_sim.world.robots import Robot, flange_pose
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.workpiece import Moved

Positive = Annotated[float, Meta(gt=0)]
Triple = tuple[float, float, float]

SINGULAR = 0.01
"""Ratio of smallest to largest singular value of the arm's Jacobian below which the controller stops."""
LIMIT_MARGIN = 0.01
"""Distance from a joint's limit at which the controller stops [rad or m]."""
CONTROLLER_US = 1000.0
"""Time budget of the controller's kinematics per call, in addition to the arm's own."""
LONGEST_CYCLE_S = 0.01
"""Longest time between two calls that the ramp of a twist takes into account."""


class TwistOptions(ArmOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of the arm behind the interface (`ArmOptions`), and of the interface.

    ``arm``: the simulated arm.
    ``tool``: the tool's frame in the flange's.
    ``frame``: axes of the twists.
    ``attitude``: rotation vector [rad], base from tool, the zero of turns (default: at the cell's base).
    ``box``: largest displacement of the tool's point from there to either side [m]; ``turns`` [rad] about the tool's x,
    y, z there; ``velocities``, ``accelerations`` of slides and turns.
    ``speeds``: [m/s], [rad/s] to which the controller itself scales a twist down.
    """

    arm: Literal["pybullet", "fake"] = "pybullet"
    tool: Moved = Moved()
    frame: Frame = "base"
    attitude: Triple | None = None
    box: tuple[Positive, Positive, Positive] = (0.5, 0.5, 0.5)
    turns: tuple[Positive, Positive, Positive] = (2.0, 1.2, 6.0)
    velocities: tuple[Positive, Positive] = (0.15, 0.5)
    accelerations: tuple[Positive, Positive] = (1.0, 4.0)
    speeds: tuple[Positive, Positive] = (0.25, 1.0)


class _Posture(NamedTuple):
    """The arm at its joints ``q`` (n,): the tool's pose in its base frame, and the Jacobian (6, n) of its motion in the
    world with its singular values and vectors.
    """

    q: FloatArray
    pose: FloatArray
    J: FloatArray
    parts: tuple[FloatArray, FloatArray, FloatArray]


class SimulatedController:
    """A :class:`CartesianArm` over a simulated arm. It reports the forward kinematics of its encoders' readings."""

    def __init__(self, options: TwistOptions, inner: SimulatedArm, robot: Robot, context: DriverContext) -> None:
        self._inner, self._robot, self._clock = inner, robot, context.clock
        self._tool = options.tool.matrix
        self._frame, self._speeds = options.frame, options.speeds
        self._timeout_ns = round(options.command_timeout_s * 1e9)
        self._accelerations = options.accelerations
        self._twist, self._at = (
            np.zeros(6),
            np.zeros(6),
        )  # commanded twist, and current state of its ramp; turns times LEVER
        self._deadline_ns = self._driven_ns = 0
        self._stopped = ""
        self._here: _Posture | None = None
        ends = [(j.position_min, j.position_max, j.velocity_max) for j in robot.joints]
        self._low, self._high, self._fastest = np.array(ends).T

    def connect(self) -> None:
        """Set up the arm; clears a protective stop."""
        self._inner.configure()
        self._twist[:] = self._at[:] = 0.0
        self._stopped = ""

    def enable(self) -> None:
        """Release the brakes."""
        self._inner.activate()

    def read(self) -> CartesianState:
        """Pose and twist of the tool's point. Raises DriverError (``protective_stop``) if the controller stopped."""
        state = self._inner.read_state()
        if self._stopped:
            raise DriverError("protective_stop", self._stopped)
        here = self._posture(state.positions)
        self._drive(here)
        told = here.J @ state.velocities
        R = self._robot.mounted[:3, :3].T  # the robot reports everything in its own base frame
        return CartesianState(state.t_ns, here.pose, R @ told[:3], R @ told[3:] / LEVER)

    def write(self, v: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Follow a twist until the time-out, scaled down to the controller's speeds."""
        here = self._posture(self._inner.read_state().positions)
        scale = min(
            1.0,
            *(
                speed / max(float(np.linalg.norm(part)), 1e-12)
                for speed, part in zip(self._speeds, (v, w), strict=True)
            ),
        )
        v, w = scale * v, scale * w
        R = self._robot.mounted[:3, :3]
        if self._frame == "tool":
            R = R @ here.pose[:3, :3]
        self._twist = np.concatenate([R @ v, LEVER * (R @ w)])
        self._deadline_ns = self._clock.now_ns() + self._timeout_ns
        share = self._drive(here)
        return share * v, share * w

    def stop(self) -> None:
        """Brake."""
        self._twist[:] = self._at[:] = 0.0
        self._inner.stop()

    def disable(self) -> None:
        """Brake; hold."""
        self._twist[:] = self._at[:] = 0.0
        self._inner.deactivate()

    def close(self) -> None:
        """Release."""
        self._inner.close()

    def _posture(self, q: FloatArray) -> _Posture:
        """The arm at its joints ``q`` (n,); computed once, because several calls of a cycle need it."""
        if self._here is None or not np.array_equal(q, self._here.q):
            pose = tool_pose(self._robot, self._tool, q)
            J = body_jacobian(self._robot, q, (self._robot.mounted @ pose)[:3, 3])
            u, values, vt = np.linalg.svd(J, full_matrices=False)
            self._here = _Posture(q, pose, J, (u, values, vt))
        return self._here

    def _drive(self, here: _Posture) -> float:
        """One cycle: the arm's joint velocities for the current twist, or a stop by the controller. Returns the share
        of the twist that the arm's joint velocities allow.
        """
        now_ns = self._clock.now_ns()
        if now_ns >= self._deadline_ns:
            self._twist[:] = 0.0
        moved = self._at.any()
        self._ramp(min((now_ns - self._driven_ns) * 1e-9, LONGEST_CYCLE_S))
        self._driven_ns = now_ns
        if not self._at.any():
            if moved:
                self._inner.write_velocity(np.zeros(len(here.q)))
            return 1.0
        q, (u, values, vt) = here.q, here.parts
        if values[-1] < SINGULAR * values[0]:
            self._protect("near a singularity of the arm")
            return 0.0
        rates = vt.T @ ((u.T @ self._at) / values)
        beyond = ((q > self._high - LIMIT_MARGIN) & (rates > 0)) | ((q < self._low + LIMIT_MARGIN) & (rates < 0))
        if beyond.any():
            self._protect(f"joint {self._robot.joint_names[int(np.argmax(beyond))]} of the arm at its limit")
            return 0.0
        share = min(1.0, 1.0 / float((np.abs(rates) / self._fastest).max()))
        self._inner.write_velocity(share * rates)
        return share

    def _ramp(self, dt: float) -> None:
        """Move the current twist towards the commanded one, slide and turn each at its acceleration."""
        for part, acceleration in ((slice(3), self._accelerations[0]), (slice(3, 6), LEVER * self._accelerations[1])):
            gap = self._twist[part] - self._at[part]
            size = float(np.linalg.norm(gap))
            self._at[part] += gap * min(1.0, acceleration * dt / max(size, 1e-12))

    def _protect(self, cause: str) -> None:
        self.stop()
        self._stopped = (
            f"the robot's controller has stopped the arm: {cause}; reset, move it away with its own panel, and keep "
            "the work farther from there (box, turns, calibration.range)"
        )


class TwistJointDriver(CartesianJointDriver):
    """The simulated arm through its Cartesian interface: six virtual joints."""

    driver = "twist"

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        decoded = decode_options(TwistOptions, options, self.driver)
        cell = cell_of_context(options, context, self.driver)
        kind = PybulletJointDriver if decoded.arm == "pybullet" else FakeJointDriver
        inner = kind({k: v for k, v in options.items() if k in ArmOptions.__struct_fields__}, context)
        self._inner, self._cell = inner, cell
        attitude = attitude_of(decoded, cell)
        start = np.array(inner.describe().home)
        home = positions_of(tool_pose(cell.robot, decoded.tool.matrix, start), attitude, np.zeros(6))
        description = cartesian_description(
            self.driver,
            limits_of(decoded, cell),
            rate_hz=decoded.rate_hz,
            timeout_s=decoded.command_timeout_s,
            budget_us=inner.call_budget_us + CONTROLLER_US,
            home=tuple(home.tolist()),
            simulated=True,
        )
        description = msgspec.structs.replace(description, auxiliary=decoded.auxiliary, notes=cell.robot.notes)
        super().__init__(SimulatedController(decoded, inner, cell.robot, context), description, attitude, decoded.frame)

    def write_auxiliary(self, values: Mapping[str, float]) -> None:
        """Move auxiliary joints and switch outputs, as `SimulatedArm`."""
        self._inner.write_auxiliary(values)

    def read_auxiliary(self) -> dict[str, float]:
        """Current positions of auxiliary joints and states of outputs."""
        return self._inner.read_auxiliary()

    def stop_auxiliary(self) -> None:
        """Stop auxiliary joints at their positions."""
        self._inner.stop_auxiliary()


def tool_pose(robot: Robot, tool: FloatArray, q: FloatArray) -> FloatArray:
    """Pose (4, 4) of the tool in the robot's own base frame at the arm's joints ``q`` (n,); ``tool`` (4, 4): flange
    from tool.
    """
    pose: FloatArray = inverse_pose(robot.mounted) @ flange_pose(robot, q) @ tool
    return pose


def attitude_of(options: TwistOptions, cell: SimulatedCell) -> FloatArray:
    """The attitude (3, 3), zero of the turns: the option's, else the tool's at the cell's base."""
    if options.attitude is not None:
        return turn(np.array(options.attitude))
    return tool_pose(cell.robot, options.tool.matrix, cell.base)[:3, :3]


def limits_of(options: TwistOptions, cell: SimulatedCell) -> VirtualLimits:
    """Limits of the virtual joints around the tool's place at the cell's base."""
    middle, box = tool_pose(cell.robot, options.tool.matrix, cell.base)[:3, 3], np.array(options.box)
    return VirtualLimits(
        tuple((middle - box).tolist()),
        tuple((middle + box).tolist()),
        options.turns,
        options.velocities,
        options.accelerations,
    )


def seen_as_joints(options: Mapping[str, Any], cell: SimulatedCell) -> SimulatedCell:
    """The true arm of a cell of driver ``twist`` with the virtual joints in place of the arm's. Raises DriverError."""
    decoded = decode_options(TwistOptions, options, TwistJointDriver.driver)
    return virtual_cell(
        cell,
        decoded.tool.matrix,
        attitude_of(decoded, cell),
        limits_of(decoded, cell).joints(),
        virtual_positions(options, cell, cell.base),
    )


def virtual_positions(options: Mapping[str, Any], cell: SimulatedCell, q: FloatArray) -> FloatArray:
    """Virtual joints (6,) of a cell of driver ``twist`` with the arm's own joints at ``q`` (n,). Raises DriverError."""
    decoded = decode_options(TwistOptions, options, TwistJointDriver.driver)
    pose = tool_pose(cell.robot, decoded.tool.matrix, q)
    return positions_of(pose, attitude_of(decoded, cell), np.zeros(6))
