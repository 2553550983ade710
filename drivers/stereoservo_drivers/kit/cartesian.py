"""Joint drivers of arms that are commanded by Cartesian velocities: six virtual joints over a device with few calls."""

from __future__ import annotations

import contextlib
from typing import Literal, NamedTuple, Protocol

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CommandReport, DriverError, JointDriverDescription, JointState
from stereoservo_drivers.kit.virtual_joints import VirtualLimits, positions_of, twist_of, velocities_of
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState

Frame = Literal["base", "tool"]
"""Axes of the twists in the robot's interface; both twists are of the tool's point."""


class CartesianState(NamedTuple):
    """State reported by the robot: stamp, ``pose`` (4, 4) base from tool [m], and the twist of the tool's point, ``v``
    (3,) [m/s] and ``w`` (3,) [rad/s], in the base frame.
    """

    t_ns: int
    pose: FloatArray
    v: FloatArray
    w: FloatArray


class CartesianArm(Protocol):
    """Protocol of a robot's Cartesian-velocity interface. All but ``stop`` and ``close`` may raise DriverError."""

    def connect(self) -> None:
        """Connect; nothing moves. Called again after the reset of a fault."""
        ...

    def enable(self) -> None:
        """Ready to move, at rest."""
        ...

    def read(self) -> CartesianState:
        """The newest state. Raises DriverError, with the remedy, if the robot has stopped by itself."""
        ...

    def write(self, v: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Command a twist, in the axes given to the driver; returns the twist that is executed."""
        ...

    def stop(self) -> None:
        """Come to rest."""
        ...

    def disable(self) -> None:
        """Stop, no motion any more."""
        ...

    def close(self) -> None:
        """Disconnect."""
        ...


class CartesianJointDriver:
    """A joint driver over a :class:`CartesianArm`. ``description``: see `cartesian_description`; ``attitude`` (3, 3):
    of the tool in the base frame, the zero of its turns (`virtual_joints.turn` of a rotation vector).

    The pose reported by the robot serves as joint positions; as always, reaching a goal is determined in the images.
    """

    def __init__(
        self, arm: CartesianArm, description: JointDriverDescription, attitude: FloatArray, frame: Frame = "base"
    ) -> None:
        self._arm = arm
        self._description = description
        self._attitude = attitude
        self._frame = frame
        self._life = DriverLifecycle(f"joint driver {description.driver!r}")
        ends = [(j.position_min, j.position_max, j.velocity_max, j.acceleration_max) for j in description.joints]
        self._low, self._high, self._fastest, self._acceleration = np.array(ends).T
        home = np.array(description.home) if description.home else 0.5 * (self._low + self._high)
        self._positions, self._pose = home, np.eye(4)
        self._reads = self._writes = 0

    def describe(self) -> JointDriverDescription:
        """The virtual joints."""
        return self._description

    def configure(self) -> None:
        """Connect the robot. Raises DriverError, also if its tool is too far from the attitude."""
        self._life.require("configure()", LifecycleState.CREATED, LifecycleState.CONFIGURED)
        self._arm.connect()
        self._follow(self._arm.read())
        self._life.state = LifecycleState.CONFIGURED

    def activate(self) -> None:
        """Ready to move. Raises DriverError."""
        self._life.require("activate()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        self._arm.enable()
        self._life.state = LifecycleState.ACTIVE

    def read_state(self) -> JointState:
        """The robot's pose and twist as virtual joints. Raises DriverError."""
        self._life.require("read_state()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        told = self._arm.read()
        self._follow(told)
        self._reads += 1
        rates = velocities_of(self._positions, told.v, told.w, self._attitude)
        return JointState(self._reads, told.t_ns, self._positions.copy(), rates)

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        """Command virtual joint velocities (6,). Raises DriverError."""
        self._life.require("write_velocity()", LifecycleState.ACTIVE)
        asked = np.array(qd, dtype=np.float64)
        if asked.shape != (6,) or not np.isfinite(asked).all():
            raise DriverError("command", f"write_velocity() got {asked.tolist()}; six finite velocities are needed")
        told = self._arm.read()
        self._follow(told)
        # Slides share one acceleration, turns another: half of it is available for each to brake before its limit.
        down, up = (np.sqrt(self._acceleration * np.maximum(room, 0.0)) for room in self._room())
        cut = np.clip(asked, -np.minimum(down, self._fastest), np.minimum(up, self._fastest))
        v, w = self._in_axes(*twist_of(self._positions, cut, self._attitude))
        sent = velocities_of(self._positions, *self._in_base(*self._arm.write(v, w)), self._attitude)
        self._writes += 1
        reasons = ("limit",) * bool((cut != asked).any())
        reasons += ("robot_limit",) * bool(np.abs(sent - cut).max() > 1e-9)
        return CommandReport(self._writes, told.t_ns, asked, sent, reasons)

    def stop(self) -> None:
        """Bring the arm to rest. Any state; never raises."""
        if self._life.state in (LifecycleState.CONFIGURED, LifecycleState.ACTIVE):
            with contextlib.suppress(Exception):  # the next read reports a robot that is gone
                self._arm.stop()

    def deactivate(self) -> None:
        """Stop; no commands any more. Idempotent."""
        if self._life.state is LifecycleState.ACTIVE:
            self.stop()
            self._life.state = LifecycleState.CONFIGURED
            self._arm.disable()

    def close(self) -> None:
        """Stop, disconnect. Idempotent; never raises."""
        self.stop()
        if self._life.state is not LifecycleState.CLOSED:
            with contextlib.suppress(Exception):  # no error can be reported any more
                self._arm.close()
        self._life.state = LifecycleState.CLOSED

    def _follow(self, told: CartesianState) -> None:
        """Store the robot's state. Raises DriverError, and keeps the previous one, if the pose or twist is invalid."""
        if not all(np.isfinite(part).all() for part in (told.pose, told.v, told.w)):
            raise DriverError(
                "pose",
                "the robot's interface tells a pose or a twist with entries that are no numbers; nothing is commanded "
                "by it: see the robot's own panel, then reset",
                retry=True,
            )
        self._positions = positions_of(told.pose, self._attitude, self._positions)
        self._pose = told.pose

    def _room(self) -> tuple[FloatArray, FloatArray]:
        """Distances (6,) to the lower and the upper limits."""
        return self._positions - self._low, self._high - self._positions

    def _in_axes(self, v: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        R = self._pose[:3, :3]
        return (v, w) if self._frame == "base" else (R.T @ v, R.T @ w)

    def _in_base(self, v: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        R = self._pose[:3, :3]
        return (v, w) if self._frame == "base" else (R @ v, R @ w)


def cartesian_description(
    driver: str,
    limits: VirtualLimits,
    *,
    rate_hz: float,
    timeout_s: float,
    budget_us: float,
    home: tuple[float, ...] = (),
    simulated: bool = False,
) -> JointDriverDescription:
    """Description of a driver of virtual joints: no efforts, no following errors. Raises DriverError (``option``)."""
    return JointDriverDescription(
        driver, limits.joints(), rate_hz, "clock", timeout_s, budget_us, home,
        lacks=("efforts", "following_errors"), simulated=simulated,
    )  # fmt: skip
