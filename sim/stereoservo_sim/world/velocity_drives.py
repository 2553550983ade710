"""Simulated drives controlled by velocity or position: ramps, limits, time-out; interface of the plant they move."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import JointSpec

STIFFNESS = 500.0
"""Stiffness of an ideal joint's drive at a wall [N m/rad or N/m]."""
REST_VELOCITY = 1e-9
"""Speed below which a physics engine's joint is at rest [rad/s or m/s]."""


class Plant(Protocol):
    """Protocol of the plant that the drives move. True ``positions``, ``velocities`` of the links and ``efforts`` of
    the motors [N m or N], (n,).
    """

    positions: FloatArray
    velocities: FloatArray
    efforts: FloatArray

    @property
    def motors(self) -> FloatArray:
        """Angles of the motors (n,), in units of the joints; the drives' set-points refer to them."""
        ...

    @property
    def readings(self) -> FloatArray:
        """Angles at the encoders (n,), before quantisation."""
        ...

    @property
    def reading_rates(self) -> FloatArray:
        """Velocities at the encoders (n,)."""
        ...

    def follow(self, set_positions: FloatArray, set_velocities: FloatArray, h: float) -> None:
        """Advance by ``h`` [s] towards the drives' set-points at its end, (n,), (n,)."""
        ...

    def rest(self, h: float) -> bool:
        """Let ``h`` [s] pass if nothing moves or is about to; returns whether that is so."""
        ...

    def close(self) -> None:
        """Release resources."""
        ...


class RigidPlant:
    """Base of plants with rigid joints: motor, link and encoder move alike."""

    positions: FloatArray
    velocities: FloatArray

    @property
    def motors(self) -> FloatArray:
        """Angles of the motors (n,), equal to the links'."""
        return self.positions

    @property
    def readings(self) -> FloatArray:
        """Angles at the encoders (n,), equal to the links'."""
        return self.positions

    @property
    def reading_rates(self) -> FloatArray:
        """Velocities at the encoders (n,), equal to the links'."""
        return self.velocities

    def rest(self, h: float) -> bool:
        """Whether nothing moves; then time that passes changes nothing."""
        return bool(np.all(np.abs(self.velocities) < REST_VELOCITY))


class IdealPlant(RigidPlant):
    """Massless joints that follow their set-points exactly; efforts come from walls alone.

    ``walls`` (2, n): least and largest position of each joint; at a wall its drive pushes with ``STIFFNESS``.
    """

    def __init__(self, positions: FloatArray) -> None:
        self.positions = positions.copy()
        self.velocities = np.zeros_like(positions)
        self.efforts = np.zeros_like(positions)
        self.walls = np.array([np.full_like(positions, -np.inf), np.full_like(positions, np.inf)])

    def follow(self, set_positions: FloatArray, set_velocities: FloatArray, h: float) -> None:
        """Adopt the set-points, limited by the walls."""
        self.positions = np.clip(set_positions, self.walls[0], self.walls[1])
        beyond = set_positions - self.positions
        self.velocities = np.where(beyond != 0.0, 0.0, set_velocities)
        self.efforts = STIFFNESS * beyond

    def close(self) -> None:
        """No effect."""


def ramp(
    q: FloatArray, v: FloatArray, target: FloatArray, acceleration: FloatArray, h: float
) -> tuple[FloatArray, FloatArray]:
    """Exact motion over ``h`` [s] with velocities ramped to ``target`` at ``acceleration``; all (n,)."""
    gap = target - v
    duration = np.minimum(np.abs(gap) / acceleration, h)
    reached = v + np.sign(gap) * acceleration * duration
    reached = np.where(duration < h, target, reached)
    return q + 0.5 * (v + reached) * duration + reached * (h - duration), reached


class DriveBank:
    """Velocity drives of all joints on a fixed time grid, with a common command time-out.

    The set-points advance in steps of ``step_ns``, never beyond the requested time. After ``timeout_ns`` without a
    command the drives brake by themselves; once they are at rest, time is skipped, so that catching up after a stall
    costs at most the time-out and the brake ramp.
    """

    def __init__(
        self, joints: tuple[JointSpec, ...], plant: Plant, *, now_ns: int, step_ns: int, timeout_ns: int
    ) -> None:
        self.plant = plant
        self.t_ns = now_ns
        self._step_ns = step_ns
        self._timeout_ns = timeout_ns
        self._low = np.array([j.position_min for j in joints])
        self._high = np.array([j.position_max for j in joints])
        self._velocity = np.array([j.velocity_max for j in joints])
        self._acceleration = np.array([j.acceleration_max for j in joints])
        self._q = plant.motors.copy()
        self._v = np.zeros(len(joints))
        self._target = np.zeros(len(joints))
        self._deadline_ns = now_ns
        self.timed_out = False

    @property
    def set_positions(self) -> FloatArray:
        """Set the drives' set-points (n,)."""
        return self._q

    def command(self, t_ns: int, velocities: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
        """Apply a velocity command (n,) given at ``t_ns``; returns the one sent to the drives, and why it differs."""
        self.advance(t_ns)
        sent = np.clip(velocities, -self._velocity, self._velocity)
        reasons = () if np.array_equal(sent, velocities) else ("drive_velocity_limit",)
        self._target = sent
        self._deadline_ns = t_ns + self._timeout_ns
        self.timed_out = False
        return sent, reasons

    def brake(self, t_ns: int) -> None:
        """Ramp to rest from ``t_ns`` on."""
        self.advance(t_ns)
        self._target = np.zeros_like(self._target)

    def advance(self, now_ns: int) -> None:
        """Advance to the last grid point not after ``now_ns``."""
        while now_ns - self.t_ns >= self._step_ns:
            if self.t_ns >= self._deadline_ns and np.any(self._target):
                self._target = np.zeros_like(self._target)
                self.timed_out = True
            if self._stands():
                left_ns = (now_ns - self.t_ns) // self._step_ns * self._step_ns
                if self.plant.rest(left_ns * 1e-9):
                    self.t_ns += left_ns
                    return
            steps = 1
            if isinstance(self.plant, IdealPlant):
                # The ramp is exact over any time: one step to the next event.
                end = now_ns if self.t_ns >= self._deadline_ns else min(now_ns, self._deadline_ns)
                steps = max((end - self.t_ns) // self._step_ns, 1)
            h = steps * self._step_ns * 1e-9
            self._q, self._v = self._course(h)
            self.plant.follow(self._q, self._v, h)
            self.t_ns += steps * self._step_ns

    def _stands(self) -> bool:
        """Whether the set-points are at rest."""
        return not np.any(self._target) and not np.any(self._v)

    def _course(self, h: float) -> tuple[FloatArray, FloatArray]:
        """Set-points and their velocities (n,) after ``h`` [s]."""
        q, v = ramp(self._q, self._v, self._target, self._acceleration, h)
        stopped = (q < self._low) | (q > self._high)
        if np.any(stopped):  # the mechanical end stop
            q, v = np.clip(q, self._low, self._high), np.where(stopped, 0.0, v)
        return q, v


class PositionBank(DriveBank):
    """Position drives of all joints: set-points move to the newest ordered positions within ``period_ns``, limited by
    each joint's speed, and stay there if no more come: these drives have no time-out.

    ``order``: function from commanded velocities (n,) to ordered positions (n,), called once per period.
    """

    def __init__(
        self, joints: tuple[JointSpec, ...], plant: Plant, *, now_ns: int, step_ns: int, timeout_ns: int,
        period_ns: int, order: Callable[[FloatArray], FloatArray],
    ) -> None:  # fmt: skip
        super().__init__(joints, plant, now_ns=now_ns, step_ns=step_ns, timeout_ns=timeout_ns)
        self._period_ns, self._order = period_ns, order
        self._due_ns = now_ns
        self._orders, self._speed = self._q.copy(), np.zeros_like(self._q)

    def command(self, t_ns: int, velocities: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
        """Apply a velocity command (n,), limited to the joints' speeds; the orders follow it. Returns the limited
        command (n,), and why it differs.
        """
        self.advance(t_ns)
        sent = np.clip(velocities, -self._velocity, self._velocity)
        if t_ns - self._due_ns > self._timeout_ns:  # no command in the meantime
            self._due_ns = t_ns
        while self._due_ns <= t_ns:
            self._due_ns += self._period_ns
            self._orders = self._order(sent).copy()
            gap = np.abs(self._orders - self._q)
            self._speed = np.minimum(gap / (self._period_ns * 1e-9), self._velocity)
        return sent, () if np.array_equal(sent, velocities) else ("drive_velocity_limit",)

    def brake(self, t_ns: int) -> None:
        """Hold the set-points of ``t_ns``."""
        self.advance(t_ns)
        self._orders = self._q.copy()

    def _stands(self) -> bool:
        return np.array_equal(self._q, self._orders)

    def _course(self, h: float) -> tuple[FloatArray, FloatArray]:
        step = np.clip(self._orders - self._q, -self._speed * h, self._speed * h)
        return self._q + step, step / h
