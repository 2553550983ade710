"""Base of the simulated joint drivers: lifecycle, time, encoder, and the history of true positions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import (
    CommandReport,
    DriverContext,
    DriverError,
    JointDriverDescription,
    JointSpec,
    JointState,
)
from stereoservo_drivers.kit.auxiliary import AuxiliaryMotion
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState
from stereoservo_drivers.position_output import LEAD_S, LOAD_OFFSET, PositionOutput
from stereoservo_sim.world.arms.arm_cell import ArmPlace, cell_of, place_of
from stereoservo_sim.world.history import CAPACITY, FILE_NAME, HistoryError, TrueJointHistory
from stereoservo_sim.world.mechanics import MechanicalPlant, MechanicsOption, chosen_mechanics, column, quantised
from stereoservo_sim.world.robots import Robot
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.velocity_drives import DriveBank, Plant, PositionBank

RECORD_EVERY_NS = 3_000_000
"""Least interval between two samples of the history, so that a plant of 1 kHz does not fill it sooner; interpolation is
cubic.
"""
Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]


class ArmOptions(ArmPlace, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of every simulated arm, in addition to the arm and its place (`ArmPlace`).

    ``start``: positions by joint name [rad or m] of an arm that was never moved; joints left out start at the simulated
    cell's base.
    ``resume``: an arm with a history starts at its end.
    ``encoder``: resolution [rad or m], 0 is exact.
    ``history``: number of stored samples of the true positions.
    ``mechanics``: a preset, or imperfections by joint, see `stereoservo_sim.world.mechanics`; its ``encoder_step``
    replaces ``encoder``.
    ``auxiliary``: joints and outputs besides the arm's, which no camera shows.
    ``drives``: whether its drives accept velocities, or positions (`PositionOutput`) without a command time-out.
    """

    rate_hz: Annotated[float, Meta(ge=10, le=2000)] = 250.0
    start: dict[str, float] = msgspec.field(default_factory=dict)
    resume: bool = True
    command_timeout_s: Positive = 0.1
    encoder: NonNegative = 1e-6
    history: Annotated[int, Meta(ge=64, le=10_000_000)] = CAPACITY
    mechanics: MechanicsOption = "none"
    auxiliary: tuple[AuxiliarySpec, ...] = ()
    drives: Literal["velocity", "position"] = "velocity"


class SimulatedArm:
    """A joint driver over a simulated plant. Time is the context's clock: nothing moves between calls.

    ``read_state`` and ``write_velocity`` advance the simulation to the current time, so the true positions that cameras
    see are as fine as these calls are frequent. ``context.services["world"]`` may hold a JointHistory to write to;
    otherwise it is a file in the runtime directory. ``robot``: its weight loads imperfect mechanics; None: it is
    unknown.
    """

    driver = "simulated"
    call_budget_us = 2000.0
    step_ns = 1_000_000

    def __init__(
        self,
        options: ArmOptions,
        context: DriverContext,
        joints: tuple[JointSpec, ...],
        base: FloatArray,
        robot: Robot | None,
    ) -> None:
        self._options = options
        self._context = context
        self._robot = robot
        try:
            self._mechanics = chosen_mechanics(
                options.mechanics, [joint.name for joint in joints], [joint.kind == "prismatic" for joint in joints]
            )
        except ValueError as error:
            raise DriverError("option", f"driver {self.driver!r}: {error}") from error
        self._steps = np.full(len(joints), options.encoder)
        if self._mechanics is not None:
            coarse = column(self._mechanics, "encoder_step")
            self._steps = np.where(coarse > 0.0, coarse, self._steps)
        self._joints = tuple(
            msgspec.structs.replace(joint, resolution=step)
            for joint, step in zip(joints, self._steps.tolist(), strict=True)
        )
        self._start = _start(self.driver, joints, base, options.start)
        self._life = DriverLifecycle(f"joint driver {self.driver!r}")
        self._auxiliary = AuxiliaryMotion(options.auxiliary)
        self._bank: DriveBank | None = None
        self._output: PositionOutput | None = None
        self._history: TrueJointHistory | None = None
        self._seq = 0
        self._write_seq = 0
        self._last_ns = 0

    def make_plant(self, positions: FloatArray) -> Plant:
        """Plant of the links, at rest at ``positions`` (n,). Raises DriverError."""
        raise NotImplementedError

    def describe(self) -> JointDriverDescription:
        """Joints, limits, rate; the clock sets the pace."""
        return JointDriverDescription(
            driver=self.driver,
            joints=self._joints,
            rate_hz=self._options.rate_hz,
            pacing="clock",
            command_timeout_s=self._options.command_timeout_s,
            call_budget_us=self.call_budget_us,
            home=tuple(self._start.tolist()),
            auxiliary=self._options.auxiliary,
            simulated=True,
            notes=() if self._robot is None else self._robot.notes,
        )

    def configure(self) -> None:
        """Set up the arm at the positions of its last run. Raises DriverError."""
        self._life.require("configure()", LifecycleState.CREATED, LifecycleState.CONFIGURED)
        if self._life.state is LifecycleState.CONFIGURED:
            return
        now_ns = self._context.clock.now_ns()
        self._history = self._open_history(now_ns)
        newest = self._history.newest() if self._options.resume else None
        positions = newest[1] if newest is not None else self._start
        plant = self.make_plant(positions)
        if self._mechanics is not None:
            plant = MechanicalPlant(plant, self._mechanics, self._robot)
        self._bank = self._make_bank(plant, now_ns)
        self._record(self._bank)
        self._life.state = LifecycleState.CONFIGURED

    def activate(self) -> None:
        """Release the brakes, at rest. Raises DriverError."""
        self._life.require("activate()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        self._life.state = LifecycleState.ACTIVE

    def read_state(self) -> JointState:
        """Encoder readings, motors' efforts and following errors now. Raises DriverError."""
        self._life.require("read_state()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        bank = self._advance()
        self._seq += 1
        positions = self.encode(bank.plant.readings)
        return JointState(
            seq=self._seq,
            t_ns=self._stamp(bank),
            positions=positions,
            velocities=bank.plant.reading_rates.copy(),
            efforts=bank.plant.efforts.copy(),
            following_errors=bank.set_positions - positions,
        )

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        """Command velocities (n,). Raises DriverError: not active, wrong shape, not finite."""
        self._life.require("write_velocity()", LifecycleState.ACTIVE)
        asked = np.array(qd, dtype=np.float64)
        if asked.shape != (len(self._joints),):
            raise DriverError(
                "shape", f"write_velocity() got shape {asked.shape}; this arm takes ({len(self._joints)},)"
            )
        if not np.all(np.isfinite(asked)):
            raise DriverError("not_finite", f"write_velocity() got {asked.tolist()}; velocities must be finite")
        bank = self._advance()
        now_ns = self._context.clock.now_ns()
        sent, reasons = self.send(bank, now_ns, asked)
        self._write_seq += 1
        return CommandReport(seq=self._write_seq, t_ns=now_ns, asked=asked, sent=sent, reasons=reasons)

    def write_auxiliary(self, values: Mapping[str, float]) -> None:
        """Move auxiliary joints and switch outputs. Raises DriverError: not active, unknown name, outside limits."""
        self._life.require("write_auxiliary()", LifecycleState.ACTIVE)
        self._auxiliary.order(values, self._context.clock.now_ns())

    def read_auxiliary(self) -> dict[str, float]:
        """Current positions of auxiliary joints and states of outputs."""
        return self._auxiliary.values(self._context.clock.now_ns())

    def stop_auxiliary(self) -> None:
        """Stop auxiliary joints at their positions."""
        self._auxiliary.stop(self._context.clock.now_ns())

    def stop(self) -> None:
        """Brake to rest. Any state; never raises."""
        self.stop_auxiliary()
        if self._bank is not None and self._life.state in (LifecycleState.CONFIGURED, LifecycleState.ACTIVE):
            self._bank.brake(self._context.clock.now_ns())
            if self._output is not None:
                self._output.orders = self._bank.set_positions.copy()
            self._record(self._bank)

    def deactivate(self) -> None:
        """Brake; further commands are refused. Idempotent."""
        if self._life.state is LifecycleState.ACTIVE:
            self.stop()
            self._life.state = LifecycleState.CONFIGURED

    def close(self) -> None:
        """Brake, release. Idempotent; never raises."""
        self.deactivate()
        if self._bank is not None:
            self._bank.plant.close()
        if self._history is not None and self._history.path is not None:
            self._history.close()
        self._bank = None
        self._history = None
        self._life.state = LifecycleState.CLOSED

    def encode(self, positions: FloatArray) -> FloatArray:
        """Readings (n,) of the joints' encoders."""
        return quantised(positions, self._steps)

    def send(self, bank: DriveBank, now_ns: int, asked: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
        """Send a command to the drives; returns the sent velocities (n,), and why they differ from the command."""
        return bank.command(now_ns, asked)

    def _make_bank(self, plant: Plant, now_ns: int) -> DriveBank:
        timeout_ns = round(self._options.command_timeout_s * 1e9)
        if self._options.drives == "velocity":
            return DriveBank(self._joints, plant, now_ns=now_ns, step_ns=self.step_ns, timeout_ns=timeout_ns)
        low, high, fastest = np.array([(j.position_min, j.position_max, j.velocity_max) for j in self._joints]).T
        period_ns = round(1e9 / self._options.rate_hz)
        largest = np.array([LOAD_OFFSET[joint.kind] for joint in self._joints])
        output = PositionOutput(LEAD_S * fastest, largest, fastest, period_ns * 1e-9)
        self._output = output
        return PositionBank(
            self._joints,
            plant,
            now_ns=now_ns,
            step_ns=self.step_ns,
            timeout_ns=timeout_ns,
            period_ns=period_ns,
            order=lambda velocities: output.step(velocities, self.encode(plant.readings), low, high),
        )

    def _advance(self) -> DriveBank:
        assert self._bank is not None  # configured: the lifecycle was checked
        self._bank.advance(self._context.clock.now_ns())
        self._record(self._bank)
        return self._bank

    def _stamp(self, bank: DriveBank) -> int:
        # Several reads inside one simulation step still have increasing stamps.
        self._last_ns = max(bank.t_ns, self._last_ns + 1)
        return self._last_ns

    def _record(self, bank: DriveBank) -> None:
        if self._history is not None and bank.t_ns - self._history.newest_ns >= RECORD_EVERY_NS:
            self._history.append(bank.t_ns, bank.plant.positions, bank.plant.velocities)

    def _open_history(self, now_ns: int) -> TrueJointHistory:
        shared = self._context.services.get("world")
        if shared is not None:
            if not isinstance(shared, TrueJointHistory) or shared.joints != len(self._joints):
                raise DriverError("world", f"services['world'] must be a JointHistory of {len(self._joints)} joints")
            return shared
        path = self._context.runtime_dir / FILE_NAME
        try:
            return TrueJointHistory.create(path, len(self._joints), now_ns=now_ns, capacity=self._options.history)
        except HistoryError as error:
            raise DriverError("history", str(error), path=str(path)) from error


def cell_of_context(arm: Mapping[str, Any], context: DriverContext, driver: str) -> SimulatedCell:
    """The simulated cell of the options ``arm`` for a driver. Raises DriverError."""
    try:
        return cell_of(place_of(arm), context.mount, context.cell_dir)
    except ValueError as error:
        raise DriverError("option", f"driver {driver!r}: {error}") from error


def _start(driver: str, joints: tuple[JointSpec, ...], base: FloatArray, start: Mapping[str, Any]) -> FloatArray:
    names = [joint.name for joint in joints]
    positions = base.copy()
    for name, value in start.items():
        if name not in names:
            raise DriverError("option", f"driver {driver!r}: start: no joint {name!r}; joints: {', '.join(names)}")
        positions[names.index(name)] = value
    for joint, value in zip(joints, positions, strict=True):
        if not joint.position_min <= value <= joint.position_max:
            raise DriverError(
                "option",
                f"driver {driver!r}: start of joint {joint.name!r} is {value:g}; its range is "
                f"{joint.position_min:g} to {joint.position_max:g}",
            )
    return positions
