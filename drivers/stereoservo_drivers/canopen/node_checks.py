"""Checks of CiA 402 drives for ``doctor``, before anything is configured: presence, identity, state."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from stereoservo.ports.devices import DriverError, ExaminationFinding
from stereoservo_drivers.canopen.auxiliary.gripper import Gripper
from stereoservo_drivers.canopen.bringup import Link
from stereoservo_drivers.canopen.cia402 import Cia402Codec, DriveAxis
from stereoservo_drivers.canopen.cia402_configuration import (
    MODES,
    capabilities,
    compose,
    eds_path,
    lead_words,
    load_eds,
)
from stereoservo_drivers.canopen.cia402_presence import ALL_NODES, CIA_402, IDENTITY, ask
from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive
from stereoservo_drivers.canopen.cia402_words import FAULTY, drive_state, error_hint, error_words
from stereoservo_drivers.canopen.options import POSITION_MODES, CanJoint, CanOptions

MODE_NAMES = {1: "profile position", 3: "profile velocity", 4: "torque", 6: "homing", 7: "interpolated position",
              8: "cyclic position", 9: "cyclic velocity", 10: "cyclic torque"}  # fmt: skip
_WIRING = "is it powered, is its cable in, are its bit rate and its node id those of the cell file?"


def examine_nodes(
    link: Link, options: CanOptions, codec: Cia402Codec, cell_dir: Path
) -> Iterator[ExaminationFinding]:
    """Findings on every node; nothing is written to any drive. Raises DriverError where the bus is lost."""
    answers = scan(link)
    grippers = {each.node_id: Gripper(options, each, cell_dir) for each in options.gripper}
    known = [*codec.axes, *(gripper.axis for gripper in grippers.values())]
    unknown_nodes = [node for node in answers if node not in {axis.node_id for axis in known}]
    dictionary = load_eds(eds_path(options, cell_dir))
    for axis in known:
        count, gripper = answers.get(axis.node_id, 0), grippers.get(axis.node_id)
        if count != 1:
            yield _not_one(axis, count, unknown_nodes)
            continue
        with RemoteDrive(link, axis, dictionary if gripper is None else load_eds(gripper.eds)) as drive:
            try:
                yield _identity(drive, axis.joint)
                yield _state(drive)
                yield _modes(drive, options) if gripper is None else _gripper(drive, gripper)
            except DriverError as error:
                yield ExaminationFinding(axis.name, False, str(error))
    if unknown_nodes:
        words = ", ".join(str(node) for node in unknown_nodes)
        yield ExaminationFinding(
            "other nodes", None, f"{words} answer too, and no joint of the cell file has them"
        )


def _gripper(drive: RemoteDrive, gripper: Gripper) -> ExaminationFinding:
    """Finding on a gripper's mode and on what it does where this computer is gone. Raises DriverError."""
    setup = gripper.compose(drive, capabilities(drive))
    return ExaminationFinding(
        f"{drive.name} mode", None if setup.losses else True, f"profile position (1); {setup.safety()}"
    )


def scan(link: Link) -> dict[int, int]:
    """Query every node id for its device type; returns the number of replies from each that replied."""
    answers = ask(link, list(ALL_NODES), 0x1000, 0)
    return {node: len(frames) for node, frames in answers.items() if frames}


def _not_one(axis: DriveAxis, count: int, unknown_nodes: list[int]) -> ExaminationFinding:
    if count > 1:
        return ExaminationFinding(
            axis.name, False, f"{count} drives answer as node {axis.node_id}",
            "give each drive a node id of its own (switches on the drive, or its vendor's tool, one drive at a time)",
        )  # fmt: skip
    remedy = _WIRING
    if unknown_nodes:
        remedy += (
            f" Nodes {', '.join(map(str, unknown_nodes))} answer, which no joint has: is it one of them?"
        )
    return ExaminationFinding(axis.name, False, "no answer", remedy)


def _identity(drive: RemoteDrive, joint: CanJoint) -> ExaminationFinding:
    name = drive.axis.name
    device = drive.read(0x1000)
    values = {what: drive.read_if_there(0x1018, k + 1) for k, what in enumerate(IDENTITY)}
    reported = ", ".join(
        f"{what} {value:#x}" if value is not None else f"no {what}" for what, value in values.items()
    )
    message = f"answers once; device type {device:#010x}, {reported}"
    if device & 0xFFFF != CIA_402:
        return ExaminationFinding(
            name, False, f"{message}: device profile {device & 0xFFFF} is not CiA 402",
            "another device has this node id; or protocol of the cell file",
        )  # fmt: skip
    wrong = [
        (what, value)
        for what, value in values.items()
        if getattr(joint, what) is not None and getattr(joint, what) != value
    ]
    if wrong:
        asked = ", ".join(f"{what} is {getattr(joint, what):#x} in the cell file" for what, _ in wrong)
        mended = ", ".join(f"{what} = {value:#x}" for what, value in wrong if value is not None)
        return ExaminationFinding(
            name, False, f"{message}; but {asked}", f"if this drive belongs here: {mended}"
        )
    return ExaminationFinding(name, True, message)


def _state(drive: RemoteDrive) -> ExaminationFinding:
    name = f"{drive.axis.name} state"
    state = drive_state(drive.read(0x6041))
    register = drive.read(0x1001)
    past = _past_errors(drive)
    texts = [state.value]
    volts = drive.read_if_there(0x6079)
    if volts is not None:
        texts.append(f"supply {volts * 1e-3:.1f} V")
    switches = drive.read_if_there(0x60FD) or 0
    texts += [
        f"{what} limit switch active"
        for bit, what in enumerate(("negative", "positive"))
        if switches >> bit & 1
    ]
    texts.append(f"error register {register:#04x}" if register else "no error")
    if past:
        texts.append(f"history {', '.join(error_words(code) for code in past)}")
    message = "; ".join(texts)
    if state in FAULTY or register:
        code = drive.read_if_there(0x603F) or (past[0] if past else 0)
        words = f" ({error_words(code)})" if code else ""
        remedy = error_hint(code) if code else "look its error up in the drive's manual"
        return ExaminationFinding(
            name, False, f"{message}{words}", f"{remedy}; then `stereoservo reset` clears it"
        )
    return ExaminationFinding(name, None if switches & 3 else True, message)


def _past_errors(drive: RemoteDrive) -> list[int]:
    """Error history 0x1003, newest first."""
    count = drive.read_if_there(0x1003, 0) or 0
    read = (drive.read_if_there(0x1003, k) for k in range(1, min(count, 4) + 1))
    return [value & 0xFFFF for value in read if value]


def _modes(drive: RemoteDrive, options: CanOptions) -> ExaminationFinding:
    """Modes, watches and what is lost, as the drive would be configured; raises DriverError as that does."""
    name = f"{drive.axis.name} modes"
    supported = drive.read_if_there(0x6502)
    if supported is None:
        message = "0x6502 is not there"
    else:
        modes = [mode for mode in range(1, 33) if supported >> (mode - 1) & 1]
        message = ", ".join(f"{mode} {MODE_NAMES.get(mode, '')}".strip() for mode in modes) or "none"
    try:
        setup = compose(drive, options, capabilities(drive))
    except DriverError as error:
        return ExaminationFinding(name, False, f"{message}; {error}")
    chosen = setup.modes[0]
    message += f"; used: {MODES[chosen]} ({chosen}); {setup.safety()}"
    if chosen in POSITION_MODES:
        message += f"; {lead_words(drive.axis.joint)}"
    return ExaminationFinding(name, None if setup.losses else True, message)
