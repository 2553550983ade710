"""A gripper: an auxiliary joint on its own CiA 402 drive, which moves to commanded positions by itself (mode 1).

RPDO1: target position and control word, in this order, because some drives act on the word as soon as it arrives; sent
only if needed. TPDO1: status word and position, every few SYNCs. It is not part of the arm's cycle, which neither waits
for it nor counts its frames. Its faults are reported with its name.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import EMCY_ID, HEARTBEAT_ID, DriveAxis
from stereoservo_drivers.canopen.cia402_configuration import (
    HEARTBEAT_CONSUMER,
    LOSSES,
    RPDOS,
    TPDOS,
    Capabilities,
    Setup,
    Write,
    eds_path,
    parameter_writes,
    pdo_writes,
)
from stereoservo_drivers.canopen.cia402_words import (
    ENABLE_STEPS,
    ControlWord,
    NmtState,
    error_hint,
    error_words,
    nmt_words,
)
from stereoservo_drivers.canopen.codec import AxisFault, Link, until
from stereoservo_drivers.canopen.option_checks import syncs_of_gripper
from stereoservo_drivers.canopen.options import CanGripper, CanOptions
from stereoservo_drivers.canopen.pdo_plan import CONTROL_WORD, RPDO_IDS, STATUS_AND_POSITION, TPDO_IDS, Pdo, PdoPlan
from stereoservo_drivers.canopen.units import wrap_int32

if TYPE_CHECKING:
    from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive

PROFILE_POSITION = 1
TARGET_POSITION, PROFILE_VELOCITY, TORQUE_LIMIT = (0x607A, 0), (0x6081, 0), (0x6072, 0)
NEW_SET_POINT, AT_ONCE_BIT, HALT = 0x0010, 0x0020, 0x0100
"""Control word bits in mode 1: new target; without finishing the motion to the previous one; halt."""
ACKNOWLEDGED = 0x1000
"""Status word bit in mode 1: the new set-point is accepted."""
MODE_S = 0.5
ENABLE_LIMIT_S, TAKEN_LIMIT_S = 1.5, 0.5
"""Time limits of enabling, and of accepting a command [s]."""
NO_WATCH = (
    "0x1016:1 is not there: where this computer dies the gripper goes on to the position that it was ordered to, and "
    "stays there"
)
GRIPPER_PDOS = PdoPlan((Pdo(0, (TARGET_POSITION[0] << 16 | 32, CONTROL_WORD)),), (Pdo(0, STATUS_AND_POSITION),))
_POSITION_AND_WORD, _WORD_AND_POSITION = struct.Struct("<iH"), struct.Struct("<Hi")


class Gripper:
    """One gripper of a cell. ``axis``: its drive's state, ``eds``: of its drive.

    Commands are stored from one thread, and executed by `poll`, which is called in every cycle.
    """

    def __init__(self, options: CanOptions, gripper: CanGripper, cell_dir: Path) -> None:
        self.gripper = gripper
        self.axis = DriveAxis(-1, gripper.joint())
        self.eds = eds_path(msgspec.structs.replace(options, eds=gripper.eds), cell_dir)
        self._options = msgspec.structs.replace(
            options, quick_stop_option=gripper.quick_stop_option, abort_option=gripper.abort_option
        )
        self._silent_ns = options.heartbeat_timeout_ms * 1_000_000
        self._statuses: list[CanFrame] = []
        self._heartbeats: list[CanFrame] = []
        self._emergencies: list[CanFrame] = []
        self._watching = False
        self._position: float | None = None
        self._rest()

    def _rest(self) -> None:
        self._on = self._was_enabled = self._halted = self._strobed = False
        self._order: float | None = None
        self._target: float | None = None
        self._since_ns = self._status_ns = self._heartbeat_ns = 0

    # -- bring-up -------------------------------------------------------------------------------------------

    def compose(self, drive: RemoteDrive, has: Capabilities) -> Setup:
        """The safest configuration of its drive. Raises DriverError (``mode``)."""
        if (has.modes is not None and not has.modes & 1 << PROFILE_POSITION - 1) or not has.has(TARGET_POSITION):
            told = "not told" if has.modes is None else f"0x{has.modes:08X}"
            raise drive.error(
                "mode",
                f"a gripper's drive needs profile position (mode 1, 0x607A), 0x6502 is {told}; use "
                "another drive, or a gripper on a digital output ([[joints.options.output]])",
                modes=has.modes,
            )
        losses = tuple(text for key, text in LOSSES.items() if not has.has(key))
        if not has.has(HEARTBEAT_CONSUMER):
            return Setup(has, (), (), (NO_WATCH, *losses))
        return Setup(has, (), ("heartbeat",), losses)

    def parameters(self, setup: Setup) -> list[Write]:
        """Writes of everything but mode, PDOs and its monitoring of this computer."""
        speed = self.axis.scale.rate_units(self.gripper.velocity)
        writes = [
            *parameter_writes(self._options, self.axis.joint, setup),
            Write(*PROFILE_VELOCITY, speed, option="velocity"),
        ]
        if self.gripper.torque_limit is not None:
            writes.append(Write(*TORQUE_LIMIT, self.gripper.torque_limit, option="torque_limit"))
        return writes

    def set_mode(self, link: Link, drive: RemoteDrive) -> list[Write]:
        """Write mode and PDOs; returns the writes to read back. Raises DriverError."""
        tpdos = TPDOS._replace(transmission=syncs_of_gripper(self._options.rate_hz))
        pdos = [write for pdo in GRIPPER_PDOS.commands for write in pdo_writes(RPDOS, pdo, drive.node_id)]
        pdos += [write for pdo in GRIPPER_PDOS.reports for write in pdo_writes(tpdos, pdo, drive.node_id)]
        drive.write(0x6060, 0, PROFILE_POSITION, "mode")
        until(link, lambda: drive.read(0x6061) == PROFILE_POSITION, MODE_S)
        drive.write_all(pdos)
        return [Write(0x6061, 0, PROFILE_POSITION, option="mode"), *pdos]

    def listen(self, link: Link) -> None:
        """Receive the drive's frames on ``link`` from now on."""
        for can_id, frames in (
            (TPDO_IDS[0], self._statuses),
            (HEARTBEAT_ID, self._heartbeats),
            (EMCY_ID, self._emergencies),
        ):
            link.subscribe(can_id + self.axis.node_id, frames)

    def watch(self, link: Link) -> None:
        """Start monitoring: it is configured and operational, and its silence and its errors count from now on."""
        for frames in (self._statuses, self._heartbeats, self._emergencies):
            frames.clear()
        self._rest()
        self._status_ns = self._heartbeat_ns = link.now_ns()
        self._watching = True

    def ignore(self) -> None:
        """Stop monitoring, before it is configured."""
        self._watching = False

    # -- orders ---------------------------------------------------------------------------------------------

    @property
    def position(self) -> float:
        """Newest position [m or rad]; NaN before there is one."""
        return math.nan if self._position is None else self._position

    def enable(self, now_ns: int) -> None:
        """Switch the power on, holding the current position."""
        if not self._on:
            self._on, self._since_ns = True, now_ns

    def order(self, position: float, now_ns: int) -> None:
        """Move to ``position`` [m or rad]."""
        self._order, self._target, self._since_ns = position, position, now_ns
        self._halted = self._strobed = False

    def stop(self, link: Link) -> None:
        """Stop at the current position, powered. Raises DriverError."""
        self._order, self._strobed = None, False
        if not self._halted:
            self._halted = True
            if self.axis.enabled:
                link.send([self._command(ControlWord.ENABLE_OPERATION | HALT)])

    def poll(self, link: Link) -> AxisFault | None:
        """Process the drive's frames and send pending commands. Returns its fault as text. Raises DriverError."""
        if not self._watching:
            return None
        now_ns = link.now_ns()
        fault = self._take_errors(now_ns)
        if self._statuses:
            fault = fault or self._take_status(now_ns)
            if fault is None:
                link.send(self._due(now_ns))
        return fault or self._overdue(now_ns)

    def _take_errors(self, now_ns: int) -> AxisFault | None:
        found = None
        while self._emergencies:
            data = self._emergencies.pop(0).data
            code = int.from_bytes(data[:2], "little")
            self.axis.add_error_code(code)
            if code and code not in self._options.emcy_ignore:
                found = self._fault("emergency", error_words(code), code, error_hint(code))
        while self._heartbeats:
            frame = self._heartbeats.pop(0)
            if frame.remote or len(frame.data) != 1:
                continue
            self._heartbeat_ns, state = now_ns, frame.data[0] & 0x7F
            if state == NmtState.BOOT_UP:
                found = self._fault("rebooted", "booted: it has lost its configuration", state, "check its supply")
            elif state != NmtState.OPERATIONAL:
                found = self._fault(
                    "left_operational", f"is {nmt_words(state)}", state, "does another master command it?"
                )
        return found

    def _take_status(self, now_ns: int) -> AxisFault | None:
        newest = self._statuses[-1].data
        self._statuses.clear()
        if len(newest) != _WORD_AND_POSITION.size:
            return self._fault(
                "mapping", f"TPDO1 has {len(newest)} bytes, {_WORD_AND_POSITION.size} are mapped", len(newest), "reset"
            )
        word, counts = _WORD_AND_POSITION.unpack(newest)
        self.axis.set_status_word(word)
        self._position = self.axis.scale.position(self.axis.counts.update(counts))
        self._status_ns = now_ns
        if self.axis.faulty:
            hint = error_hint(self.axis.codes[-1]) if self.axis.codes else "remove the cause, then reset"
            return self._fault("drive_fault", self.axis.words(), word, hint)
        if self._was_enabled and not self.axis.enabled:
            return self._fault(
                "disabled",
                f"left operation enabled unasked: {self.axis.words()}",
                word,
                "look at the drive's own inputs and its supply",
            )
        self._was_enabled |= self.axis.enabled and self._on
        return None

    def _due(self, now_ns: int) -> list[CanFrame]:
        """Frames after a status: the next step of enabling, or of the handshake by which a command is accepted."""
        axis = self.axis
        if not self._on:
            return []
        if not axis.enabled:
            return [self._command(ENABLE_STEPS.get(axis.state, ControlWord.DISABLE_VOLTAGE))]
        acknowledged = bool((axis.status_word or 0) & ACKNOWLEDGED)
        if self._halted:
            return [self._command(ControlWord.ENABLE_OPERATION | HALT)]
        if self._order is None:
            return [self._command(ControlWord.ENABLE_OPERATION)] if acknowledged else []
        if self._strobed and acknowledged:
            self._order, self._strobed = None, False
        elif not acknowledged:
            self._strobed = True
            return [self._command(ControlWord.ENABLE_OPERATION | NEW_SET_POINT | AT_ONCE_BIT)]
        return [self._command(ControlWord.ENABLE_OPERATION)]

    def _command(self, word: int) -> CanFrame:
        target = self.position if self._target is None else self._target
        counts = 0 if math.isnan(target) else wrap_int32(self.axis.scale.counts(target))
        return CanFrame(RPDO_IDS[0] + self.axis.node_id, _POSITION_AND_WORD.pack(counts, word))

    def _overdue(self, now_ns: int) -> AxisFault | None:
        for what, heard_ns, code in (
            ("heartbeat", self._heartbeat_ns, "heartbeat_lost"),
            ("TPDO1", self._status_ns, "silent"),
        ):
            if now_ns - heard_ns > self._silent_ns:
                return self._fault(
                    code, f"no {what} for {self._silent_ns * 1e-6:.0f} ms", None, "check its supply and the bus cable"
                )
        waited_s = (now_ns - self._since_ns) * 1e-9
        if self._on and not self._was_enabled and waited_s > ENABLE_LIMIT_S:
            return self._fault(
                "enable_timeout",
                f"not enabled after {waited_s:.1f} s: {self.axis.words()}",
                None,
                "is its power stage supplied, is the emergency stop released?",
            )
        if self._was_enabled and self._order is not None and waited_s > TAKEN_LIMIT_S:
            return self._fault(
                "target_ignored",
                f"has not taken its order within {TAKEN_LIMIT_S:g} s (bit 12 of the status word)",
                self.axis.status_word,
                "does an input or another tool hold it (halt, local mode)?",
            )
        return None

    def _fault(self, code: str, message: str, value: int | None, hint: str) -> AxisFault:
        who = f"gripper {self.gripper.name!r} (node {self.axis.node_id})"
        return AxisFault(-1, code, f"{who}: {message}", value, hint)
