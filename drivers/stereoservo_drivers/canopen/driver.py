"""The joint driver ``canopen``: an arm of drives on a CAN bus.

``write_velocity`` stores the newest command, ``read_state`` returns the newest complete set; a separate thread runs the
cycle (``bus_thread.py``, ``master.py``) independently of the caller. A latched fault is raised by ``read_state`` once,
and by ``write_velocity`` and ``activate`` until ``configure()`` clears it: reset and enable are separate steps.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import (
    CommandReport,
    DriverContext,
    DriverError,
    ExaminationFinding,
    JointDriverDescription,
    JointState,
    MayMove,
)
from stereoservo.ports.discovery import BusScan, FoundBus, JointChoice
from stereoservo_drivers.can.channel import Channel
from stereoservo_drivers.canopen.bus_thread import BusThread
from stereoservo_drivers.canopen.cia402 import Cia402Codec
from stereoservo_drivers.canopen.cia402_bringup import Cia402Bringup
from stereoservo_drivers.canopen.codec import Bringup, Codec
from stereoservo_drivers.canopen.gripper import Gripper
from stereoservo_drivers.canopen.master import ENABLE_LIMIT_S, Master, MasterFault, MasterSettings, Mode
from stereoservo_drivers.canopen.odrive import OdriveBringup, OdriveCodec
from stereoservo_drivers.canopen.option_checks import check_options
from stereoservo_drivers.canopen.options import CanJoint, CanOptions, can_options
from stereoservo_drivers.kit.auxiliary import verify_order
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState

DRIVER = "canopen"
CALL_BUDGET_US = 500.0
FIRST_SAMPLE_S = 1.0
OFF_MARGIN_S = 1.0
SWITCH_INTERVAL_S = 0.0005
"""Python's switch interval [s]: another thread of the process may compute this long before the bus thread continues."""
_POLL_S = 0.001
_LOADS: dict[Literal["efforts", "following_errors"], str] = {"efforts": "effort", "following_errors": "following_error"}
"""Names required in ``feedback`` for a sample to contain the values."""


class CanJointDriver:
    """An arm of CiA 402 drives or ODrives. Options: :class:`~stereoservo_drivers.canopen.options.CanOptions`."""

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self.options = can_options(options, context.cell_dir)
        check_options(self.options)
        self._context = context
        self._life = DriverLifecycle(f"joint driver {DRIVER!r}")
        self._codec = make_codec(self.options)
        self.bringup = make_bringup(self.options, self._codec, context.cell_dir)
        self._grippers: dict[str, Gripper] = {}
        if isinstance(self.bringup, Cia402Bringup):
            self._grippers = {each.gripper.name: each for each in self.bringup.grippers.values()}
        self.master = Master(self._codec, MasterSettings.of(self.options))
        self.bus: BusThread | None = None
        self._reported_fault: MasterFault | None = None
        self._write_seq = 0

    @staticmethod
    def examine_file(path: Path) -> Iterator[ExaminationFinding]:
        """Findings on an EDS or DCF file. Raises DriverError (``eds``)."""
        from stereoservo_drivers.canopen.examination import examine_eds  # not for the servo process

        return examine_eds(path)

    def describe(self) -> JointDriverDescription:
        """Description by the cell file's joints and limits; the servo's clock sets the pace."""
        return JointDriverDescription(
            driver=DRIVER,
            joints=tuple(joint.spec() for joint in self.options.joint),
            rate_hz=self.options.rate_hz,
            pacing="clock",
            effort_units=tuple(_effort_unit(joint, self.options.protocol) for joint in self.options.joint),
            lacks=tuple(what for what, needed in _LOADS.items() if needed not in self.options.feedback),
            command_timeout_s=self.options.command_timeout_s,
            auxiliary=(
                *(output.spec() for output in self.options.output),
                *(gripper.spec() for gripper in self.options.gripper),
            ),
            call_budget_us=CALL_BUDGET_US,
        )

    # -- lifecycle ------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Connect, check and configure all drives; if already configured, clear the latched fault. Never enables.

        A drive found in fault does not fail the first call: the fault is latched, and the next call clears it. Raises
        DriverError.
        """
        self._life.require("configure()", LifecycleState.CREATED, LifecycleState.CONFIGURED)
        if isinstance(self._context.clock, VirtualClock):
            raise DriverError(
                "real_time",
                "joint driver 'canopen' needs real time, and this cell runs in lockstep on a virtual clock; use "
                "driver 'pybullet' in lockstep",
            )
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        if self._life.state is LifecycleState.CREATED:
            self._connect()
            self._life.state = LifecycleState.CONFIGURED
        elif self.bus is None or not self.bus.alive:
            self._connect()
            self._clear()
        elif self.master.fault is not None:
            self._clear()

    def _connect(self) -> None:
        """Open, bring up, start the cycle, wait for a complete set. Raises DriverError, with everything closed."""
        self._release()
        self.bus = BusThread(Channel(self.options), self.master)
        try:
            self.bringup.connect(self.bus)
            self._begin_cycle(self.bus)
        except BaseException as error:  # otherwise a thread that keeps sending heartbeats would remain
            self._release()
            code = error.code if isinstance(error, DriverError) else "internal"
            self.master.latch(MasterFault(code, str(error), hint="reset connects again"))
            raise

    def _begin_cycle(self, bus: BusThread) -> None:
        """Start the cycle and wait for a complete set. Raises DriverError if none arrives."""
        self.master.clear()
        self._reported_fault = None
        bus.begin_cycle()
        cycles = self.master.statistics.cycles + 2

        def answered() -> bool:
            return self.master.sample() is not None and self.master.statistics.cycles >= cycles

        if not self._wait(answered, FIRST_SAMPLE_S):
            self._require_no_fault()
            states = ", ".join(self._codec.status_words())
            raise DriverError(
                "no_sample",
                f"the drives did not answer the first cycles within {FIRST_SAMPLE_S:g} s; they say: {states}",
                retry=True,
            )

    def _clear(self) -> None:
        """Reset the drives' faults. Raises DriverError if a fault remains, which is then latched."""
        assert self.bus is not None
        if self.master.fault is None:
            return
        self._await_rest()
        self.bus.end_cycle()
        try:
            self.bringup.reset(self.bus)
        except DriverError as error:
            if self.bus.alive:
                self.bus.begin_cycle()
            raise error
        self._begin_cycle(self.bus)
        self._require_no_fault()

    def _await_rest(self) -> None:
        """Wait for the end of the quick stop before the cycle ends. Raises DriverError if the arm keeps moving."""
        limit_s = self.master.stop_limit_s
        if self._wait(lambda: self.master.at_rest() is True, limit_s) or self.master.at_rest() is None:
            return
        sample = self.master.sample()
        speeds = [] if sample is None else np.round(sample.velocities, 4).tolist()
        raise DriverError(
            "moving",
            f"no reset while the arm moves: {speeds} rad/s or m/s {limit_s:.1f} s after its stop; is it pushed, or is "
            "an encoder wrong?",
            retry=True,
            velocities=speeds,
        )

    def activate(self) -> None:
        """Enable all axes at velocity zero. Raises DriverError, also while a fault is latched."""
        self._life.require("activate()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        self._require_no_fault()
        if self._life.state is LifecycleState.ACTIVE:
            return
        self.master.request_enable(time.monotonic_ns())

        def settled() -> bool:
            self.master.port_called(time.monotonic_ns())
            return self.master.mode in (Mode.RUNNING, Mode.LATCHED)

        if not self._wait(settled, ENABLE_LIMIT_S + OFF_MARGIN_S):
            self.master.request_disable()
            raise DriverError("enable_timeout", f"the CAN bus's thread is stuck in mode {self.master.mode}")
        self._require_no_fault()
        assert self.bus is not None  # its master is running
        for gripper in self._grippers.values():
            gripper.enable(self.bus.now_ns())
        self._life.state = LifecycleState.ACTIVE

    def deactivate(self) -> None:
        """Bring to rest, then switch off. Idempotent. Raises DriverError if a drive does not report that it is off."""
        if self._life.state is not LifecycleState.ACTIVE:
            return
        self._life.state = LifecycleState.CONFIGURED
        self.stop_auxiliary()
        self.master.request_disable()
        limit_s = self.master.stop_limit_s + OFF_MARGIN_S
        if not self._wait(self._is_off, limit_s):
            states = ", ".join(self._codec.status_words())
            raise DriverError(
                "not_off", f"the drives are not off {limit_s:.1f} s after they were told to be; they say: {states}"
            )

    def _is_off(self) -> bool:
        """Whether all axes are off, or a latched fault's quick stop is active, which must not be interrupted."""
        mode = self.master.mode
        return mode is Mode.LATCHED or (mode is Mode.OFF and self._codec.at_rest_unpowered())

    def stop(self) -> None:
        """Command velocity zero from the next cycle on; the drives remain enabled. Any state, never raises."""
        self.stop_auxiliary()
        self.master.set_command(np.zeros(len(self.options.joint)), time.monotonic_ns())

    def close(self) -> None:
        """Stop, switch off, release drives and bus. Idempotent; never raises."""
        try:
            self.deactivate()
        except DriverError as error:
            self.master.latch(MasterFault(error.code, str(error)))
        bus = self.bus
        if bus is not None and bus.alive:
            self._wait(lambda: self.master.at_rest() is True, self.master.stop_limit_s)
            try:
                bus.end_cycle()
                self.bringup.release(bus)
            except DriverError as error:
                self.master.latch(MasterFault(error.code, str(error)))
        self._release()
        self._life.state = LifecycleState.CLOSED

    def _release(self) -> None:
        if self.bus is not None:
            self.bus.end()
            self.bus = None

    @classmethod
    def find_buses(cls) -> tuple[FoundBus, ...]:
        """CAN adapters and USB serial ports of this computer."""
        from stereoservo_drivers.canopen.nodes import found_buses  # only for `stereoservo setup`

        return found_buses()

    @classmethod
    def scan_bus(cls, options: Mapping[str, Any]) -> BusScan:
        """CiA 402 drives on a bus. Raises DriverError."""
        from stereoservo_drivers.canopen.nodes import scan_bus

        return scan_bus(options)

    @classmethod
    def options_of(cls, scan: BusScan, joints: Sequence[JointChoice]) -> dict[str, Any]:
        """Options for the drives of a scan."""
        from stereoservo_drivers.canopen.nodes import proposed_options

        return proposed_options(scan, joints)

    def examine(self, may_move: MayMove) -> Iterator[ExaminationFinding]:
        """Findings on bus and drives for `stereoservo doctor`; closes the driver."""
        from stereoservo_drivers.canopen.examination import examine  # only for this command

        self._life.require("examine()", LifecycleState.CREATED)
        return examine(self, self._context.cell_dir, may_move)

    # -- the cycle of the caller ----------------------------------------------------------------------------

    def read_state(self) -> JointState:
        """The newest complete set, stamped with its poll. Raises DriverError, for a latched fault once."""
        self._life.require("read_state()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        self.master.port_called(time.monotonic_ns())
        self._poll_grippers()
        if self.master.fault is not self._reported_fault:
            self._require_no_fault()
        sample = self.master.sample()
        if sample is None:
            raise DriverError("no_sample", "the drives have not answered since the last reset", retry=True)
        return sample

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        """Command velocities (n,). Raises DriverError: not active, a latched fault, wrong shape, not finite."""
        self._life.require("write_velocity()", LifecycleState.ACTIVE)
        asked = np.array(qd, dtype=np.float64)
        if asked.shape != (len(self.options.joint),):
            raise DriverError(
                "shape", f"write_velocity() got shape {asked.shape}; this arm takes ({len(self.options.joint)},)"
            )
        if not np.isfinite(asked).all():
            raise DriverError("not_finite", f"write_velocity() got {asked.tolist()}; velocities must be finite")
        self._require_no_fault()
        now_ns = time.monotonic_ns()
        sent, reasons = self.master.limited(asked)
        self.master.set_command(asked, now_ns)
        self._write_seq += 1
        return CommandReport(seq=self._write_seq, t_ns=now_ns, asked=asked, sent=sent, reasons=reasons)

    def write_auxiliary(self, values: Mapping[str, float]) -> None:
        """Move grippers and switch digital outputs. Raises DriverError: not active, a latched fault, unknown name, or
        outside its limits.
        """
        self._life.require("write_auxiliary()", LifecycleState.ACTIVE)
        self._require_no_fault()
        assert self.bus is not None
        verify_order(values, self.describe().auxiliary)
        for name in values.keys() & self._grippers.keys():
            self._grippers[name].order(values[name], self.bus.now_ns())
        switched = {name: value for name, value in values.items() if name not in self._grippers}
        if switched and isinstance(self.bringup, Cia402Bringup):
            self.bringup.outputs.write(self.bus, switched)

    def read_auxiliary(self) -> dict[str, float]:
        """Grippers' positions, and digital outputs as confirmed by the drives."""
        outputs = self.bringup.outputs.values() if isinstance(self.bringup, Cia402Bringup) else {}
        return outputs | {name: gripper.position for name, gripper in self._grippers.items()}

    def stop_auxiliary(self) -> None:
        """Stop grippers at their positions, powered; digital outputs keep their state."""
        for gripper in self._grippers.values():
            if self.bus is not None:
                with contextlib.suppress(DriverError):  # a lost bus is reported as a separate fault
                    gripper.stop(self.bus)

    def _poll_grippers(self) -> None:
        """Continue the grippers' commands; a gripper's fault stops the arm, with its name."""
        if self.bus is None or not self.bus.alive:
            return
        if self.master.fault is not None:
            self.stop_auxiliary()
        for name, gripper in self._grippers.items():
            with contextlib.suppress(DriverError):  # see above
                fault = gripper.poll(self.bus)
                if fault is not None:
                    told = MasterFault(fault.code, fault.message, axis=name, value=fault.value, hint=fault.hint)
                    self.master.latch(told)

    def _require_no_fault(self) -> None:
        fault = self.master.fault
        if fault is not None:
            self._reported_fault = fault
            raise DriverError(
                fault.code,
                f"{fault.text()} [all axes are stopped until a reset]",
                axis=fault.axis,
                value=fault.value,
                limit=fault.limit,
                latched=True,
            )

    def _wait(self, until: Callable[[], bool], limit_s: float) -> bool:
        """Wait for ``until``, at most ``limit_s``; returns whether it became true."""
        end = time.monotonic() + limit_s
        while not until():
            if time.monotonic() > end:
                return until()
            if self.bus is None or not self.bus.alive:
                return until()
            time.sleep(_POLL_S)
        return True


def _effort_unit(joint: CanJoint, protocol: str) -> str:
    """Unit of efforts: CiA 402 reports torque in permille of a rated torque (0x6077), which possibly only the cell file
    states; ODrive in N m.
    """
    if protocol == "cia402" and joint.rated_torque is None:
        return "of rated"
    return "N m" if joint.kind == "revolute" else "N"


def make_codec(options: CanOptions) -> Codec:
    """The cyclic codec. Raises DriverError (``option``) if the options do not fit the protocol."""
    if options.protocol == "odrive":
        return OdriveCodec(options)
    return Cia402Codec(options)


def make_bringup(options: CanOptions, codec: Codec, cell_dir: Path) -> Bringup:
    """The bring-up that belongs to ``codec``, which ``make_codec`` returned for the same ``options``."""
    if isinstance(codec, OdriveCodec):
        return OdriveBringup(options, codec, cell_dir)
    assert isinstance(codec, Cia402Codec)
    return Cia402Bringup(options, codec, cell_dir)
