"""Simulation of drives and arm on a fixed time grid: ramps, brakes, contact, end stops, efforts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.emulators.nodes.node import EmulatedAxis
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.velocity_drives import IdealPlant, Plant

Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]

STEP_NS = 1_000_000
RECORD_STEPS = 4
"""Number of steps between samples of the truth: 250 Hz, with cubic interpolation."""
AWAKE_NS = 100_000_000
"""Time for which the plant is simulated at rest after power or contact has changed, for its efforts."""
RESTING = 1e-3
"""Speed below which an axis counts as at rest [rad/s or m/s]; simulated rigid bodies oscillate."""
EFFORT_FILTER_S = 0.005


class PlantSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the machine [rad, s; m for prismatic joints; efforts in shares of the rated torque].

    ``brake_s``: from closing until the axis is at rest. ``coast_deceleration``: of an axis without power and brake.
    ``end_stop_margin``: distance of the mechanical stops beyond the position limits. ``contact_stiffness``: effort per
    unit of a blocked axis's lag; ``effort_max``: at which the drive's current saturates. For a plant without torques of
    its own: ``inertia`` (effort per unit/s²), ``friction``, ``gravity`` (times the cosine of the position).
    """

    brake_s: Positive = 0.02
    coast_deceleration: Positive = 20.0
    end_stop_margin: NonNegative = 0.05
    contact_stiffness: Positive = 50.0
    effort_max: Positive = 2.0
    inertia: NonNegative = 0.02
    friction: NonNegative = 0.05
    gravity: NonNegative = 0.1


@dataclass
class _Command:
    """Command of an axis during one step of the grid."""

    powered: bool
    brake_closed: bool
    target: float
    acceleration: float
    blocked: bool


class _Body:
    """State of one joint: its drive's set-point and its mechanical limits."""

    def __init__(self, axis: EmulatedAxis, settings: PlantSettings) -> None:
        self.axis = axis
        self.settings = settings
        self.low = axis.joint.position_min - settings.end_stop_margin
        self.high = axis.joint.position_max + settings.end_stop_margin
        self.position = axis.position
        self.velocity = 0.0
        self.set_position = axis.position
        self.braking = 0.0
        self.acceleration = 0.0
        self.command = self.read()
        axis.set_position = axis.position

    def read(self) -> _Command:
        """The current command."""
        axis = self.axis
        return _Command(axis.powered, axis.brake_closed, axis.target, axis.acceleration, axis.blocked)

    def latch(self) -> bool:
        """Apply the command to the next step; returns whether power, brake or contact changed."""
        before = self.command
        now = self.command = self.read()
        if now.brake_closed and not before.brake_closed:
            self.braking = abs(self.velocity) / self.settings.brake_s
        return (now.powered, now.brake_closed, now.blocked) != (before.powered, before.brake_closed, before.blocked)

    def resting(self) -> bool:
        """Whether neither the joint nor its set-point moves."""
        axis, command = self.axis, self.command
        driven = command.powered and not command.brake_closed
        if driven and (command.target != 0.0 or axis.set_velocity != 0.0 or self.set_position != self.position):
            return False
        return self.velocity == 0.0

    def move(self, h: float) -> None:
        """Advance by ``h`` [s]: the drive's set-point, and the joint that follows it."""
        before = self.velocity
        if self.command.powered and not self.command.brake_closed:
            self._drive(h)
        else:
            self._coast(h)
        if not self.low <= self.position <= self.high:
            self.position = min(max(self.position, self.low), self.high)
            self.velocity = 0.0
        self.acceleration = (self.velocity - before) / h

    def _drive(self, h: float) -> None:
        axis, command = self.axis, self.command
        gap = command.target - axis.set_velocity
        acceleration = max(command.acceleration, 1e-9)
        duration = min(abs(gap) / acceleration, h)
        reached = command.target
        if duration >= h:
            reached = axis.set_velocity + math.copysign(acceleration * h, gap)
        self.set_position += 0.5 * (axis.set_velocity + reached) * duration + reached * (h - duration)
        axis.set_velocity = reached
        if command.blocked:
            self.velocity = 0.0
            return
        lag = self.set_position - self.position
        # A released axis catches up at the joint's own speed, in addition to the motion that it follows.
        most = (abs(axis.set_velocity) + axis.joint.velocity_max) * h
        step = min(max(lag, -most), most)
        self.position = self.set_position if step == lag else self.position + step
        self.velocity = axis.set_velocity if step == lag else step / h

    def _coast(self, h: float) -> None:
        axis = self.axis
        rate = self.braking if self.command.brake_closed else self.settings.coast_deceleration
        speed = 0.0 if self.command.blocked else abs(self.velocity)
        duration = min(speed / rate, h) if rate > 0 else h
        left = 0.0 if duration < h else max(speed - rate * h, 0.0)
        self.position += math.copysign(0.5 * (speed + left) * duration, self.velocity)
        self.velocity = math.copysign(left, self.velocity) if left else 0.0
        axis.set_velocity = self.velocity
        self.set_position = self.position

    def held_up(self) -> float:
        """Effort of pushing against a contact or an end stop."""
        return self.settings.contact_stiffness * (self.set_position - self.position)

    def free_effort(self) -> float:
        """Effort of inertia, friction and gravity of a joint whose plant has no torques; in rated torques."""
        s = self.settings
        moving = math.tanh(self.velocity / RESTING)
        return s.inertia * self.acceleration + s.friction * moving + s.gravity * math.cos(self.position)


class PlantBeside:
    """A plant and ideal joints beside it, combined: the joints of ``plant`` first."""

    def __init__(self, plant: Plant, beside: IdealPlant) -> None:
        self._parts: tuple[Plant, Plant] = plant, beside
        self._count = len(plant.positions)
        self._take()

    def _take(self) -> None:
        first, second = self._parts
        self.positions = np.concatenate([first.positions, second.positions])
        self.velocities = np.concatenate([first.velocities, second.velocities])
        self.efforts = np.concatenate([first.efforts, second.efforts])

    @property
    def motors(self) -> FloatArray:
        """Motor angles of both."""
        return np.concatenate([part.motors for part in self._parts])

    @property
    def readings(self) -> FloatArray:
        """Encoder angles of both."""
        return np.concatenate([part.readings for part in self._parts])

    @property
    def reading_rates(self) -> FloatArray:
        """Encoder velocities of both."""
        return np.concatenate([part.reading_rates for part in self._parts])

    def follow(self, set_positions: FloatArray, set_velocities: FloatArray, h: float) -> None:
        """Advance both by ``h`` [s]."""
        n = self._count
        self._parts[0].follow(set_positions[:n], set_velocities[:n], h)
        self._parts[1].follow(set_positions[n:], set_velocities[n:], h)
        self._take()

    def rest(self, h: float) -> bool:
        """Let ``h`` [s] pass if neither moves."""
        first, second = (part.rest(h) for part in self._parts)  # time passes in both
        return first and second

    def close(self) -> None:
        """Release both."""
        for part in self._parts:
            part.close()


class AxisPlant:
    """Axes and plant, step by step. A command acts from the first grid point after its arrival, never earlier.

    A position between grid points is extrapolated with the velocity of the last one. While everything is at rest, steps
    are skipped. ``history`` records the truth. ``rated`` (n,) [N m or N]: torques to which the plant's efforts are
    relative; None: the plant has no mass, and inertia, friction and gravity of the settings are used instead.
    Without power and brake an axis coasts down by friction; sinking of an arm under gravity is not modelled.
    """

    def __init__(
        self,
        axes: Sequence[EmulatedAxis],
        plant: Plant,
        settings: PlantSettings | None = None,
        *,
        t_ns: int,
        history: TrueJointHistory | None = None,
        rated: Sequence[float] | None = None,
        step_ns: int = STEP_NS,
    ) -> None:
        self.settings = settings or PlantSettings()
        self.axes = tuple(axes)
        self.plant = plant
        self.t_ns = t_ns - t_ns % (RECORD_STEPS * step_ns)
        self.step_ns = step_ns
        self._seen_ns = t_ns
        self._bodies = [_Body(axis, self.settings) for axis in axes]
        self._rated = tuple(rated) if rated is not None else None
        self._history = history
        self._record_ns = RECORD_STEPS * step_ns
        self._awake_ns = t_ns + AWAKE_NS
        self._resting = False
        self._read_encoders()
        self._record()

    def due_ns(self, now_ns: int) -> int:
        """Time at which ``advance`` is next needed, after ``now_ns``."""
        if not self._resting:
            return self.t_ns + self.step_ns
        step = self.step_ns if self._wanted() else self._record_ns
        return (now_ns // step + 1) * step

    def advance(self, now_ns: int) -> None:
        """Advance to the last grid point not after ``now_ns``."""
        while (steps := (now_ns - self.t_ns) // self.step_ns) > 0:
            if self._resting:
                self.plant.rest(steps * self.step_ns * 1e-9)
                self._read_encoders()
                self.t_ns += steps * self.step_ns
            else:
                self._step()
                self.t_ns += self.step_ns
            self._seen_ns = self.t_ns
            if not self._resting or self.t_ns == now_ns:
                self._latch()
            self._record()

    def observe(self, now_ns: int) -> None:
        """Update the axes' positions to ``now_ns``, less than a step after the last grid point."""
        if self._resting or now_ns == self._seen_ns:
            return
        self._seen_ns = now_ns
        h = (now_ns - self.t_ns) * 1e-9
        readings = self.plant.readings
        for k, body in enumerate(self._bodies):
            axis = body.axis
            axis.position = float(readings[k]) + axis.velocity * h
            if body.command.powered and not body.command.brake_closed:
                axis.set_position = body.set_position + axis.set_velocity * h
            else:
                axis.set_position = axis.position

    def at_rest(self, node: int | None = None) -> bool:
        """Whether all axes (or the one of index ``node``) are at rest."""
        axes = self.axes if node is None else self.axes[node : node + 1]
        return all(abs(axis.velocity) < RESTING for axis in axes)

    def close(self) -> None:
        """Release plant and history."""
        self.plant.close()
        if self._history is not None and self._history.path is not None:
            self._history.close()
        self._history = None

    def _wanted(self) -> bool:
        for body in self._bodies:
            axis, command = body.axis, body.command
            if (axis.powered and not axis.brake_closed and axis.target != 0.0) or (
                axis.powered is not command.powered
                or axis.brake_closed is not command.brake_closed
                or axis.blocked is not command.blocked
            ):
                return True
        return False

    def _latch(self) -> None:
        changed = False
        for body in self._bodies:
            changed |= body.latch()
        if changed:
            self._awake_ns = self.t_ns + AWAKE_NS
        self._resting = (
            self.t_ns >= self._awake_ns and all(body.resting() for body in self._bodies) and self.plant.rest(0.0)
        )
        if self._resting:
            for body in self._bodies:
                body.axis.velocity = 0.0

    def _step(self) -> None:
        h = self.step_ns * 1e-9
        for body in self._bodies:
            body.move(h)
        wanted = np.array([body.position for body in self._bodies])
        self.plant.follow(wanted, np.array([body.velocity for body in self._bodies]), h)
        self._read_encoders()
        rates = self.plant.reading_rates
        for k, body in enumerate(self._bodies):
            axis = body.axis
            axis.velocity = float(rates[k])
            axis.set_position = body.set_position
            if not body.command.powered or body.command.brake_closed:
                axis.set_position = axis.position
                axis.effort = 0.0
                continue
            free = body.free_effort() if self._rated is None else float(self.plant.efforts[k]) / self._rated[k]
            effort = min(max(free + body.held_up(), -self.settings.effort_max), self.settings.effort_max)
            axis.effort += (effort - axis.effort) * h / (h + EFFORT_FILTER_S)

    def _read_encoders(self) -> None:
        for axis, reading in zip(self.axes, self.plant.readings.tolist(), strict=True):
            axis.position = reading

    def _record(self) -> None:
        if self._history is not None and (self.t_ns // self.step_ns) % RECORD_STEPS == 0:
            n = self._history.joints  # a gripper is not part of the truth that cameras see
            self._history.append(self.t_ns, self.plant.positions[:n], self.plant.velocities[:n])
