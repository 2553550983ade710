"""Bring-up of CiA 402 drives: presence, identity, configuration, and reset of faults on request.

All of it is done in NMT state pre-operational, in which no process data moves anything and none is awaited. Every
written value is read back. Nothing here enables a drive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import (
    EMCY_ID,
    HEARTBEAT_ID,
    SDO_REQUEST_ID,
    SDO_RESPONSE_ID,
    Cia402Codec,
    DriveAxis,
)
from stereoservo_drivers.canopen.cia402_configuration import (
    ABORT_OPTION,
    FAULT_REACTION,
    INTERPOLATION_EXPONENT,
    INTERPOLATION_TIME,
    MODES,
    PDO_OFF,
    RPDOS,
    TPDOS,
    Capabilities,
    PdoObjects,
    Setup,
    Write,
    available_feedback,
    capabilities,
    compose,
    eds_path,
    identifier_writes,
    load_eds,
    mapped_object,
    parameter_writes,
    pdo_writes,
    period_writes,
    unused_pdos,
    unwatch_writes,
    watch_writes,
)
from stereoservo_drivers.canopen.cia402_presence import (
    Identity,
    identify,
    reject_reboots,
    require_nodes,
    require_single_master,
)
from stereoservo_drivers.canopen.cia402_words import (
    ABORT_NO_OBJECT,
    ABORT_NO_SUBINDEX,
    ABORT_NOT_MAPPABLE,
    ABORT_PDO_FULL,
    ABORT_READ_ONLY,
    FAULTY,
    NOT_WRITABLE,
    OUT_OF_RANGE,
    ControlWord,
    DriveState,
    NmtState,
    drive_state,
    error_hint,
    error_words,
    is_communication_error,
)
from stereoservo_drivers.canopen.codec import Link, listening, until
from stereoservo_drivers.canopen.gripper import GRIPPER_PDOS, Gripper
from stereoservo_drivers.canopen.option_checks import check_load, parse_sdo_key
from stereoservo_drivers.canopen.options import CanOptions, CanOutput, CommandMode
from stereoservo_drivers.canopen.pdo_plan import (
    CONTROL_WORD,
    TARGETS,
    UNRESTRICTED,
    Pdo,
    PdoPlan,
    Slot,
    Slots,
    planned,
    restricted,
)
from stereoservo_drivers.canopen.units import wrap_int32
from stereoservo_drivers.kit.auxiliary import verify_order

if TYPE_CHECKING:
    import canopen

    from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive


STATE_S = 0.5
"""Time for a change of state that needs no ramp."""
REST_S = 2.0
"""Time for a quick stop of a drive that was found moving."""
BOOT_S = 3.0
TAKEN_S = 0.01
"""Time until sent process data has arrived: a later NMT command must not overtake it."""
SETTLE_S = 0.03
"""Time within which a cause that is still present trips a drive again."""
STANDS_SHARE = 0.01
"""Share of the largest velocity below which a drive is at rest."""
FIXED_EFFECTS = {(FAULT_REACTION, 0): "at a fault of its own it lets its axis run out"}
"""Effects of objects with values that cannot be changed, where they are bad."""
LAST_DUMMY = 0x20
"""Mapping entries below are placeholders (CiA 301)."""
LOOK_S = 0.02
"""Time over which the positions of a drive without velocity feedback show whether it is at rest."""


class Cia402Bringup:
    """Bring-up of the drives of one bus. ``identities``, ``setups``: by node id, once connected; ``outputs``,
    ``grippers``: devices besides the joints.
    """

    def __init__(self, options: CanOptions, codec: Cia402Codec, cell_dir: Path) -> None:
        self.codec = codec
        self.identities: dict[int, Identity] = {}
        self.setups: dict[int, Setup] = {}
        self.outputs = DigitalOutputs(options.output)
        self.grippers = {g.node_id: Gripper(options, g, cell_dir) for g in options.gripper}
        self._options = options
        self._eds = eds_path(options, cell_dir)
        self._dictionaries: dict[Path, canopen.ObjectDictionary] = {}

    # -- what the driver asks for ---------------------------------------------------------------------------

    def connect(self, link: Link) -> None:
        """Check and configure every drive, power off, process data on.

        A drive in fault stays in fault: the codec reports it. Raises DriverError: ``node_missing``,
        ``duplicate_node``, ``not_a_drive``, ``identity``, ``wrong_eds``, ``eds``, ``mode``, ``no_watch``,
        ``option``, ``sdo_abort``, ``sdo_timeout``, ``read_back``, ``not_off``, ``not_operational``,
        ``second_master``, ``rebooted``.
        """
        self._ignore()
        with self._drives(link) as drives:
            require_single_master(link, drives)
            # Axes that a dead master has left moving: before anything that can fail, and while they accept process
            # data.
            link.send(self.codec.quick_stop())
            link.wait(TAKEN_S)
            with reject_reboots(link, drives):
                self._enter_pre_operational(drives)
                require_nodes(link, drives, self._options)
                self._prepare(link, drives)
                self._start(link, drives)
        self.outputs.listen(link)
        for gripper in self.grippers.values():
            gripper.listen(link)
            gripper.watch(link)

    def reset(self, link: Link) -> None:
        """Configure again and clear the faults of all drives, by NMT reset communication for bus faults.

        Ends in switch on disabled. Raises DriverError: as ``connect``; ``fault_stays`` if one cannot be cleared.
        """
        self._ignore()
        with self._drives(link) as drives:
            self._enter_pre_operational(drives)
            require_nodes(link, drives, self._options)
            self._reset_communication(link, [drive for drive in drives if _lost_the_bus(drive)])
            with reject_reboots(link, drives):
                self._prepare(link, drives)
                stays: DriverError | None = None
                try:
                    for drive in drives:
                        self._clear_fault(link, drive)
                    self._settle(link, drives)
                except DriverError as error:
                    stays = error
                self._start(link, drives)  # with a fault, too: the arm's positions are needed
                if stays is not None:
                    raise stays
        for gripper in self.grippers.values():
            gripper.watch(link)

    def release(self, link: Link) -> None:
        """End process data and the drives' monitoring of this master. Raises one DriverError for all.

        A drive that is still enabled is stopped and switched off first; if that fails, its monitoring remains active.
        """
        self._ignore()
        failed: list[DriverError] = []
        with self._drives(link) as drives:
            for drive in drives:
                try:
                    if _state(drive) is DriveState.OPERATION_ENABLED:
                        self._power_off(link, drive)
                    setup = self.setups.get(drive.node_id)
                    known = setup is not None and setup.capabilities.has(ABORT_OPTION)
                    if known and self._options.abort_option == 1:
                        drive.write(*ABORT_OPTION, 0)  # leaving operational would cause a fault
                    drive.nmt("PRE-OPERATIONAL")
                    drive.write_all(unwatch_writes(setup) if setup is not None else [])
                except DriverError as error:
                    failed.append(error)
                    if error.code == "connection_lost":
                        break
        if failed:
            raise DriverError(
                "not_released",
                f"{len(failed)} of {len(drives)} drives did not take leave of this master and will miss its heartbeat: "
                f"{failed[0]}",
                retry=True,
            ) from failed[0]

    # -- steps ---------------------------------------------------------------------------------------

    @contextmanager
    def _drives(self, link: Link) -> Iterator[list[RemoteDrive]]:
        # canopen takes long to import: only for access to drives
        from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive

        beside = [(gripper.axis, gripper.eds) for gripper in self.grippers.values()]
        known = [*((axis, self._eds) for axis in self.codec.axes), *beside]
        for eds in {eds for _, eds in known} - self._dictionaries.keys():
            self._dictionaries[eds] = load_eds(eds)
        with ExitStack() as stack:
            yield [stack.enter_context(RemoteDrive(link, axis, self._dictionaries[eds])) for axis, eds in known]

    def _ignore(self) -> None:
        """Context manager in which effects of bring-up on the drives are not faults."""
        self.codec.ignore()
        for gripper in self.grippers.values():
            gripper.ignore()

    def _enter_pre_operational(self, drives: list[RemoteDrive]) -> None:
        for drive in drives:
            drive.nmt("PRE-OPERATIONAL")

    def _prepare(self, link: Link, drives: list[RemoteDrive]) -> None:
        for drive in drives:  # first those that were left moving
            status_word = drive.read_if_there(0x6041)
            if status_word is not None and drive_state(status_word) is DriveState.OPERATION_ENABLED:
                drive.write(0x6040, 0, ControlWord.QUICK_STOP)
        found: list[Capabilities] = []
        for drive in drives:
            gripper = self.grippers.get(drive.node_id)
            self.identities[drive.node_id] = identify(drive, self._eds if gripper is None else gripper.eds)
            self._power_off(link, drive)
            has = capabilities(drive)
            if gripper is None:
                found.append(has)
                self.setups[drive.node_id] = compose(drive, self._options, has)
            else:
                self.setups[drive.node_id] = gripper.compose(drive, has)
        feedback = available_feedback(self._options, found)
        asked = [*feedback, *([()] * len(self.grippers))]
        plans = [self._configure(link, drive, wanted) for drive, wanted in zip(drives, asked, strict=True)]
        joints = plans[: len(self.codec.axes)]
        self.codec.arrange(joints)
        guarded = sum("guarding" in setup.watches for setup in self.setups.values())
        check_load(self._options, guarded, [length for plan in joints for length in plan.lengths])

    def _power_off(self, link: Link, drive: RemoteDrive) -> None:
        """Stop a drive that was left enabled, and switch it off. A fault remains."""
        state = _state(drive)
        if state in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE):
            drive.write(0x6040, 0, ControlWord.QUICK_STOP)
            until(link, lambda: _at_rest(link, drive), REST_S)
        if state is not DriveState.FAULT:
            drive.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE)
        off = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
        if not until(link, lambda: _state(drive) in off, REST_S if state in FAULTY else STATE_S):
            raise drive.error(
                "not_off", f"does not switch off, it says {drive.axis.words()!r}; switch its supply off and on"
            )

    def _configure(self, link: Link, drive: RemoteDrive, feedback: tuple[str, ...]) -> PdoPlan:
        """Write the whole configuration, then read it back; returns its PDOs. Raises DriverError (``read_back``)."""
        gripper, setup = self.grippers.get(drive.node_id), self.setups[drive.node_id]
        asked = parameter_writes(self._options, drive.axis.joint, setup)
        if gripper is not None:
            asked = gripper.parameters(setup)
        identifiers = [write for write in identifier_writes(drive.node_id) if self._differs(drive, write)]
        # Without guarding from an earlier master: a life time that expires now would cause a fault.
        first = [write for write in unwatch_writes(setup) if "guarding" in setup.watches]
        drive.write_all((*first, *identifiers))
        parameters = self._write_changeable(drive, asked)
        if gripper is None:
            plan, rest = self._set_mode(link, drive, feedback)
        else:
            plan, rest = GRIPPER_PDOS, gripper.set_mode(link, drive)
        off = [write for index in unused_pdos(plan, drive.dictionary) for write in self._off(drive, index)]
        off = self._write_changeable(drive, off)
        for write in {write.key: write for write in (*identifiers, *parameters, *rest, *off)}.values():
            self._compare(drive, write)
        self.outputs.prepare(drive)
        return plan

    def _write_changeable(self, drive: RemoteDrive, writes: list[Write]) -> list[Write]:
        """Write what differs, and return it: a value that the drive does not let change remains, as a loss. Raises
        DriverError, also if an option asks for just that object.
        """
        written = []
        for write in writes:
            if write.option != "sdo" and not self._differs(drive, write):
                continue
            try:
                drive.write(write.index, write.subindex, write.value, write.option)
            except DriverError as error:
                if error.data.get("abort_code") not in NOT_WRITABLE or write.option in ("sdo", "heartbeat_ms"):
                    raise
                value = drive.read(write.index, write.subindex)
                effect = FIXED_EFFECTS.get((write.key, value), f"{write.value} was to be written")
                self._lose(drive, f"0x{write.index:04X}:{write.subindex} is fixed at {value}: {effect}")
            else:
                written.append(write)
        return written

    def _lose(self, drive: RemoteDrive, text: str) -> None:
        """Add a restriction of the drive to its setup."""
        setup = self.setups[drive.node_id]
        self.setups[drive.node_id] = replace(setup, losses=(*setup.losses, text))

    def _set_mode(self, link: Link, drive: RemoteDrive, feedback: tuple[str, ...]) -> tuple[PdoPlan, list[Write]]:
        """Write mode, period and PDOs of a joint's drive; returns its PDOs and the writes to read back. Raises
        DriverError.
        """
        setup = self.setups[drive.node_id]
        mode = self._choose_mode(link, drive, setup)
        period = self._write_period(drive, mode)
        plan, fixed, writes = self._write_pdos(drive, mode, feedback)
        known = (CONTROL_WORD, TARGETS[mode])
        held = {pdo.number: _held_bytes(drive, pdo, known) for pdo in plan.commands if pdo.number in fixed}
        self.codec.configured(drive.axis, mode, "guarding" in setup.watches, plan, held)
        for what in feedback:
            if not plan.sends(what):
                self._lose(drive, f"{what} is not sent: the drive's TPDOs have no place for it")
        return plan, [*period, *writes]

    def _write_pdos(
        self, drive: RemoteDrive, mode: CommandMode, feedback: tuple[str, ...]
    ) -> tuple[PdoPlan, set[int], list[Write]]:
        """Write the PDOs that the drive permits: after a refusal, the plan is solved again without what was refused.

        Returns the plan, the numbers of RPDOs of fixed mapping, and the writes. Raises DriverError (``no_pdos``) if the
        drive cannot be commanded or read by PDOs.
        """
        slots: dict[PdoObjects, Slots] = {RPDOS: UNRESTRICTED, TPDOS: UNRESTRICTED}
        refused: list[str] = []
        while True:
            plan = planned(TARGETS[mode], feedback, slots[RPDOS], slots[TPDOS])
            if plan is None:
                raise drive.error(
                    "no_pdos",
                    "its PDOs cannot carry control word and set-point (RPDOs), or status word and position (TPDOs): "
                    + "; ".join(dict.fromkeys(refused)),
                    mode=mode,
                )
            writes: list[Write] = []
            for objects, pdo in [*((RPDOS, pdo) for pdo in plan.commands), *((TPDOS, pdo) for pdo in plan.reports)]:
                slot = slots[objects][pdo.number]
                try:
                    writes += self._write_pdo(drive, objects, pdo, fixed=slot.fixed is not None)
                except DriverError as error:
                    refused.append(str(error))
                    slots[objects] = restricted(
                        slots[objects], pdo.number, _slot_after_refusal(drive, objects, pdo, slot, error)
                    )
                    break
            else:
                fixed = {number for number, slot in enumerate(slots[RPDOS]) if slot.fixed is not None}
                return plan, fixed, writes

    def _write_pdo(self, drive: RemoteDrive, objects: PdoObjects, pdo: Pdo, *, fixed: bool) -> list[Write]:
        """Write a PDO, of which a ``fixed`` one is changed only where it differs; returns the writes."""
        setup = self.setups[drive.node_id]
        deadline = "deadline" in setup.watches and objects is RPDOS and pdo.number == 0
        deadline_ms = self._options.rpdo_deadline_ms if deadline else 0
        writes = pdo_writes(objects, pdo, drive.node_id, fixed=fixed, deadline_ms=deadline_ms)
        drive.write_all([write for write in writes if not fixed or self._differs(drive, write)])
        return writes

    def _write_period(self, drive: RemoteDrive, mode: CommandMode) -> list[Write]:
        """Write the period of set-points; returns the writes.

        A drive with velocity set-points may keep another period, which is reported as a loss. Raises DriverError if
        positions are interpolated.
        """
        setup = self.setups[drive.node_id]
        writes = period_writes(self._options, drive.axis.joint, setup, mode)
        try:
            drive.write_all(writes)
        except DriverError as error:
            if mode != "csv" or error.data.get("abort_code") != ABORT_READ_ONLY:
                raise
            value, exponent = (
                setup.capabilities.values.get(key, 0) for key in (INTERPOLATION_TIME, INTERPOLATION_EXPONENT)
            )
            self._lose(
                drive,
                f"0x60C2 is fixed at {value * 10.0 ** (exponent + 3):g} ms, and a cycle has "
                f"{1e3 / self._options.rate_hz:g} ms: the drive may ramp between set-points or miss some",
            )
            return []
        return writes

    def _choose_mode(self, link: Link, drive: RemoteDrive, setup: Setup) -> CommandMode:
        """Set the best mode that the drive accepts. Raises DriverError (``read_back``) if it accepts none."""
        for mode in setup.modes:
            number = MODES[mode]
            try:
                drive.write(0x6060, 0, number, "mode")
            except DriverError as error:
                if mode == setup.modes[-1] or not _out_of_range(error):
                    raise
                continue
            if until(link, lambda number=number: drive.read(0x6061) == number, STATE_S):  # type: ignore[misc]
                return mode
        self._compare(drive, Write(0x6061, 0, MODES[setup.modes[-1]], option="mode"))
        return setup.modes[-1]

    @staticmethod
    def _differs(drive: RemoteDrive, write: Write) -> bool:
        """Whether a value read back differs; False if the drive lacks the object, whose value is then fixed."""
        found = drive.read_if_there(write.index, write.subindex)
        return found is not None and not write.agrees(found)

    @staticmethod
    def _off(drive: RemoteDrive, index: int) -> list[Write]:
        """Write that switches a PDO off, if there is one that is on."""
        cob_id = drive.read_if_there(index, 1)
        return [] if cob_id is None or cob_id & PDO_OFF else [Write(index, 1, cob_id | PDO_OFF, PDO_OFF)]

    @staticmethod
    def _compare(drive: RemoteDrive, write: Write) -> None:
        found = drive.read(write.index, write.subindex)
        if not write.agrees(found):
            name = drive.object_name(write.index, write.subindex)
            raise drive.error(
                "read_back",
                f"{name} reads {found} (0x{found & 0xFFFFFFFF:X}), "
                f"written was {write.value} (0x{write.value & 0xFFFFFFFF:X}); the drive limits or ignores it: set "
                f"{write.option or 'the drive up so'} that it fits",
                object=f"0x{write.index:04X}:{write.subindex}",
                written=write.value,
                found=found,
            )

    def _start(self, link: Link, drives: list[RemoteDrive]) -> None:
        """Activate the drives' monitoring of this master, go operational, check that all report so."""
        for drive in drives:
            writes = watch_writes(self._options, self.setups[drive.node_id])
            drive.write_all(writes)
            for write in writes:
                self._compare(drive, write)
            _read_initial_state(drive)
        with listening(link, [HEARTBEAT_ID + drive.node_id for drive in drives]) as received:
            for drive in drives:
                drive.nmt("OPERATIONAL")
            limit_s = max(STATE_S, 10e-3 * self._options.heartbeat_ms)
            for drive in drives:
                heartbeats = received[HEARTBEAT_ID + drive.node_id]
                if not until(link, _reports(heartbeats, NmtState.OPERATIONAL), limit_s):
                    raise drive.error(
                        "not_operational",
                        f"no heartbeat says operational within {limit_s:g} s after NMT start; "
                        f"{len(heartbeats)} heartbeats came",
                        retry=True,
                    )
        self.codec.watch()

    # -- faults ---------------------------------------------------------------------------------------------

    def _reset_communication(self, link: Link, drives: list[RemoteDrive]) -> None:
        """Reset communication by NMT, which some drives (EPOS4) need to clear a lost heartbeat or bus as a fault."""
        with listening(link, [HEARTBEAT_ID + drive.node_id for drive in drives]) as received:
            for drive in drives:
                drive.nmt("RESET COMMUNICATION")
            for drive in drives:
                heartbeats = received[HEARTBEAT_ID + drive.node_id]
                if not until(link, _reports(heartbeats, NmtState.BOOT_UP), BOOT_S):
                    raise drive.error(
                        "no_boot_up",
                        f"no boot-up within {BOOT_S:g} s after NMT reset communication; switch its supply off and on",
                        retry=True,
                    )

    def _clear_fault(self, link: Link, drive: RemoteDrive) -> None:
        """Send the fault reset's edge and check its effect. Raises DriverError (``fault_stays``)."""
        until(link, lambda: _state(drive) is not DriveState.FAULT_REACTION_ACTIVE, REST_S)
        drive.axis.codes = []
        if _state(drive) in FAULTY:
            drive.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE)
            drive.write(0x6040, 0, ControlWord.FAULT_RESET)
            until(link, lambda: _state(drive) not in FAULTY, STATE_S)
            drive.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE)
        if not until(link, lambda: _state(drive) is DriveState.SWITCH_ON_DISABLED, STATE_S):
            raise self._stays(drive)

    def _settle(self, link: Link, drives: list[RemoteDrive]) -> None:
        """Wait for causes that are still present to appear again. Raises DriverError (``fault_stays``)."""
        with listening(link, [EMCY_ID + drive.node_id for drive in drives]) as received:
            link.wait(SETTLE_S)
        for drive in drives:
            codes = [int.from_bytes(frame.data[:2], "little") for frame in received[EMCY_ID + drive.node_id]]
            tripping = [code for code in codes if code and code not in self._options.emcy_ignore]
            if tripping or _state(drive) is not DriveState.SWITCH_ON_DISABLED:
                drive.axis.codes = [*drive.axis.codes, *tripping]
                raise self._stays(drive)
            drive.axis.codes = []

    @staticmethod
    def _stays(drive: RemoteDrive) -> DriverError:
        code = drive.read_if_there(0x603F) or (drive.axis.codes[-1] if drive.axis.codes else 0)
        return drive.error(
            "fault_stays",
            f"{error_words(code)} is still there after the reset (state {drive.axis.state.value!r}); "
            f"remove the cause first: {error_hint(code)}",
            retry=True,
            error_code=code,
            state=drive.axis.state.value,
        )


def _slot_after_refusal(drive: RemoteDrive, objects: PdoObjects, pdo: Pdo, slot: Slot, error: DriverError) -> Slot:
    """What a PDO can hold, after the drive refused a write of ``pdo``. Raises ``error`` if it is of another kind."""
    code, (index, subindex) = error.data.get("abort_code"), parse_sdo_key(str(error.data.get("object", "0x1:0")))
    if code is None:
        raise error
    if index != objects.mapping + pdo.number or slot.fixed is not None:
        return Slot(entries=0)  # it is not there, or cannot be used at these times
    if code in NOT_WRITABLE or (subindex == 0 and error.data["value"] == 0):
        return _fixed_slot(drive, objects, index)
    if code == ABORT_NOT_MAPPABLE and subindex:
        return slot._replace(excluded=slot.excluded | {pdo.mapping[subindex - 1]})
    if subindex == 0:
        return slot._replace(entries=len(pdo.mapping) - 1)
    if code in (ABORT_NO_OBJECT, ABORT_NO_SUBINDEX, ABORT_PDO_FULL):
        return slot._replace(entries=subindex - 1)
    raise error


def _fixed_slot(drive: RemoteDrive, objects: PdoObjects, index: int) -> Slot:
    """A PDO with the mapping that the drive has; unusable if it holds single bits, or digital outputs that would be
    held as they are.
    """
    mapping = tuple(drive.read(index, place + 1) for place in range(drive.read(index)))
    outputs = objects is RPDOS and any(mapped_object(entry)[0] == OUTPUTS[0] for entry in mapping)
    usable = mapping and not outputs and all(entry & 0xFF and entry % 8 == 0 for entry in mapping)
    return Slot(fixed=mapping) if usable else Slot(entries=0)


def _held_bytes(drive: RemoteDrive, pdo: Pdo, known: tuple[int, ...]) -> bytes:
    """Data of an RPDO of fixed mapping: the drive's own values, zeros for the ``known`` entries and dummies."""
    held = b""
    for entry in pdo.mapping:
        index, subindex = mapped_object(entry)
        value = 0 if entry in known or index < LAST_DUMMY else drive.read(index, subindex)
        held += (value & (1 << (entry & 0xFF)) - 1).to_bytes((entry & 0xFF) // 8, "little")
    return held


def _out_of_range(error: DriverError) -> bool:
    """Whether a value was refused as invalid for the object, by the drive or by its EDS."""
    return error.code == "option" or error.data.get("abort_code") in OUT_OF_RANGE


def _state(drive: RemoteDrive) -> DriveState:
    """Drive state read by SDO; the codec stores it as the newest."""
    drive.axis.set_status_word(drive.read(0x6041))
    return drive.axis.state


def _at_rest(link: Link, drive: RemoteDrive) -> bool:
    """Whether a drive has ended its quick stop, from its reported velocity or, without one, from its positions."""
    state, scale = _state(drive), drive.axis.scale
    if state is not DriveState.QUICK_STOP_ACTIVE:
        return state is not DriveState.OPERATION_ENABLED
    slow = STANDS_SHARE * drive.axis.joint.max_velocity
    speed = drive.read_if_there(0x606C)
    if speed is not None:
        return abs(speed) <= STANDS_SHARE * scale.rate_units(drive.axis.joint.max_velocity)
    before = drive.read(0x6064)
    link.wait(LOOK_S)
    moved = abs(wrap_int32(drive.read(0x6064) - before))
    return moved * scale.resolution <= max(slow * LOOK_S, scale.resolution)


def _read_initial_state(drive: RemoteDrive) -> None:
    """Read state, error code and limit switches before the first cycle."""
    axis = drive.axis
    if _state(drive) in FAULTY:
        axis.add_error_code(drive.read_if_there(0x603F) or 0)
    if axis.at_limit:
        switches = drive.read_if_there(0x60FD) or 0
        axis.limit_side = axis.joint.direction * ((switches >> 1 & 1) - (switches & 1))


def _lost_the_bus(drive: RemoteDrive) -> bool:
    axis: DriveAxis = drive.axis
    code = drive.read_if_there(0x603F) or 0
    return any(is_communication_error(known) for known in (*axis.codes, code))


def _reports(heartbeats: list[CanFrame], state: NmtState) -> Callable[[], bool]:
    return lambda: any(len(frame.data) == 1 and frame.data[0] & 0x7F == state for frame in heartbeats)


# -- digital outputs -----------------------------------------------------------------------------------------
# Digital outputs of an arm's drives, written by SDO beside the cycle.


DOWNLOAD_OUTPUTS = bytes([0x23, 0xFE, 0x60, 1])
"""Head of an SDO download of four bytes to 0x60FE:1 (CiA 301, 7.2.4.3.3)."""
DOWNLOADED = 0x60
OUTPUT_ANSWER_NS = 500_000_000
"""Time [s] after which the answer to an output command counts as lost, and the command is sent again."""

OUTPUTS, OUTPUT_MASK = (0x60FE, 1), (0x60FE, 2)


class DigitalOutputs:
    """Digital outputs of the drives, written without waiting for the drives' answers; ``options``: from the cell file.

    Each drive has one pending command at a time, because an answer does not identify its command; later commands
    follow.
    ``values``: by name, as confirmed by the drives. Other bits of 0x60FE keep their initial values.
    """

    def __init__(self, outputs: tuple[CanOutput, ...]) -> None:
        self._outputs = {output.name: output for output in outputs}
        self._specs = tuple(output.spec() for output in outputs)
        self._ordered: dict[int, int] = {}
        self._confirmed: dict[int, int] = {}
        self._due: set[int] = set()
        self._sent: dict[int, tuple[int, int]] = {}
        self._answers: dict[int, list[CanFrame]] = {}
        self._link: Link | None = None

    def prepare(self, drive: RemoteDrive) -> None:
        """Read the outputs of a drive, and enable those that are used. Raises DriverError (``outputs``)."""
        used = [output for output in self._outputs.values() if output.node_id == drive.node_id]
        if not used:
            return
        found = drive.read_if_there(*OUTPUTS)
        if found is None:
            names = ", ".join(output.name for output in used)
            raise DriverError(
                "outputs", f"{drive.name} has no digital outputs (0x60FE:1); leave out: {names}", node_id=drive.node_id
            )
        mask = drive.read_if_there(*OUTPUT_MASK)
        if mask is not None:
            drive.write(*OUTPUT_MASK, mask | sum(1 << output.bit for output in used), "output")
        self._ordered[drive.node_id] = self._confirmed[drive.node_id] = found
        self._due.discard(drive.node_id)
        self._sent.pop(drive.node_id, None)

    def listen(self, link: Link) -> None:
        """Receive the drives' answers on ``link`` from now on."""
        self._link = link
        for node in self._ordered:
            self._answers[node] = []
            link.subscribe(SDO_RESPONSE_ID + node, self._answers[node])

    def write(self, link: Link, values: Mapping[str, float]) -> None:
        """Switch outputs by name. Raises DriverError (``auxiliary``, ``connection_lost``)."""
        verify_order(values, self._specs)
        for name, value in values.items():
            output = self._outputs[name]
            rest = self._ordered[output.node_id] & ~(1 << output.bit)
            self._ordered[output.node_id] = rest | int(value) << output.bit
            self._due.add(output.node_id)
        self._exchange(link)

    def values(self) -> dict[str, float]:
        """The values confirmed by the drives, by name; also sends pending commands. Never raises."""
        if self._link is not None:
            with suppress(DriverError):  # a lost bus is reported as a separate fault
                self._exchange(self._link)
        return {
            name: float(self._confirmed.get(output.node_id, 0) >> output.bit & 1)
            for name, output in self._outputs.items()
        }

    def _exchange(self, link: Link) -> None:
        """Process the drives' answers, then send each drive its pending command. Raises DriverError."""
        now_ns = link.now_ns()
        for node, answers in self._answers.items():
            while answers:
                self._take(node, answers.pop(0).data)
            if now_ns - self._sent.get(node, (0, now_ns))[1] > OUTPUT_ANSWER_NS:
                del self._sent[node]  # its answer is lost: whether it was executed is unknown
                self._due.add(node)
        for node in sorted(self._due - self._sent.keys()):
            bits = self._ordered[node]
            link.send([CanFrame(SDO_REQUEST_ID + node, DOWNLOAD_OUTPUTS + bits.to_bytes(4, "little"))])
            self._due.discard(node)
            self._sent[node] = bits, now_ns

    def _take(self, node: int, data: bytes) -> None:
        """Handle a drive's answer to its command: confirmed or, if no newer command exists, reverted."""
        if node not in self._sent or data[1:4] != DOWNLOAD_OUTPUTS[1:]:
            return  # answers to requests of bring-up
        bits, _ = self._sent.pop(node)
        if data[0] == DOWNLOADED:
            self._confirmed[node] = bits
        elif node not in self._due:
            self._ordered[node] = self._confirmed[node]
