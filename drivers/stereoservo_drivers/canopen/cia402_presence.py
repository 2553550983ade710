"""Presence and identity of drives on the bus: one reply per node id, device type, identity, EDS, mode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import HEARTBEAT_ID, RPDO_IDS, SDO_REQUEST_ID, SDO_RESPONSE_ID
from stereoservo_drivers.canopen.cia402_configuration import SHIPPED_EDS
from stereoservo_drivers.canopen.codec import Link, listening, until
from stereoservo_drivers.canopen.options import CanOptions

if TYPE_CHECKING:
    from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive

PROBE_S = 0.05
"""Time within which both of two nodes with one id answer [s]."""
PATIENCE_S = 0.5
"""Time limit for the answer of a slow drive [s] (CiA 301 sets no limit)."""
ALONE_S = 0.05
"""Time within which another master of these drives would send them commands [s]."""
BOOT_UP = b"\0"
ABORT = b"\x80"
CIA_402 = 402
ALL_NODES = range(1, 128)
IDENTITY = ("vendor_id", "product_code", "revision", "serial_number")
"""Names of the sub-indices 1 to 4 of 0x1018, and of a joint's options."""


@dataclass(frozen=True)
class Identity:
    """Identity object 0x1018 of a drive; None for missing entries: only the vendor is mandatory (CiA 301)."""

    vendor_id: int | None
    product_code: int | None
    revision: int | None
    serial_number: int | None


def require_single_master(link: Link, drives: list[RemoteDrive]) -> None:
    """Check, before anything is sent, that no other master commands these drives. Raises DriverError
    (``second_master``).
    """
    with listening(link, [RPDO_IDS[0] + drive.node_id for drive in drives]) as received:
        link.wait(ALONE_S)
    for drive in drives:
        count = len(received[RPDO_IDS[0] + drive.node_id])
        if count:
            raise drive.error(
                "second_master",
                f"somebody else commands this drive, {count} frames 0x{RPDO_IDS[0] + drive.node_id:X} "
                f"within {ALONE_S * 1e3:.0f} ms; end the other master (another daemon or doctor on this bus, a "
                "maker's commissioning tool) first",
                retry=True,
                frames=count,
            )


@contextmanager
def reject_reboots(link: Link, drives: list[RemoteDrive]) -> Iterator[None]:
    """Context manager that raises DriverError (``rebooted``) at its end if a drive has booted meanwhile and lost its
    configuration.
    """
    with listening(link, [HEARTBEAT_ID + drive.node_id for drive in drives]) as received:
        try:
            yield
        except DriverError as error:
            _check_boots(drives, received, error)
            raise
    _check_boots(drives, received, None)


def _check_boots(
    drives: list[RemoteDrive], received: dict[int, list[CanFrame]], consequence: DriverError | None
) -> None:
    for drive in drives:
        if any(frame.data == BOOT_UP for frame in received[HEARTBEAT_ID + drive.node_id]):
            raise drive.error(
                "rebooted",
                "booted while it was configured and has forgotten what was written; is its supply "
                "sound, does another master reset it? Try again",
                retry=True,
            ) from consequence


def read_from_nodes(
    link: Link, nodes: list[int], index: int, subindex: int, patience_s: float = PROBE_S
) -> dict[int, list[CanFrame]]:
    """All replies of ``nodes`` to one SDO read each, within ``PROBE_S``; the first ones may take ``patience_s``."""
    request = bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0])
    with listening(link, [SDO_RESPONSE_ID + node for node in nodes]) as received:
        for node in nodes:
            link.send([CanFrame(SDO_REQUEST_ID + node, request)])
        link.wait(PROBE_S)
        if patience_s > PROBE_S and not all(received.values()):
            until(link, lambda: all(received.values()), patience_s - PROBE_S)
            link.wait(PROBE_S)
    return {node: received[SDO_RESPONSE_ID + node] for node in nodes}


def require_nodes(link: Link, drives: list[RemoteDrive], options: CanOptions) -> None:
    """One reply of each node. Raises DriverError (``node_missing``, ``duplicate_node``)."""
    answers = read_from_nodes(link, [drive.node_id for drive in drives], 0x1018, 4, PATIENCE_S)
    missing = [drive for drive in drives if not answers[drive.node_id]]
    if missing:
        raise _missing(link, missing, drives, options)
    for drive in drives:
        count = len(answers[drive.node_id])
        if count > 1:
            serials = ", ".join(
                "unknown" if frame.data[:1] == ABORT else f"{int.from_bytes(frame.data[4:8], 'little')}"
                for frame in answers[drive.node_id]
            )
            raise drive.error(
                "duplicate_node",
                f"{count} nodes answer to this id (serial numbers {serials}); disconnect all but one "
                "and give each an id of its own",
                answers=count,
            )


def _missing(link: Link, missing: list[RemoteDrive], drives: list[RemoteDrive], options: CanOptions) -> DriverError:
    configured = [drive.node_id for drive in drives]
    others = read_from_nodes(link, [node for node in ALL_NODES if node not in configured], 0x1000, 0)
    absent = [drive.node_id for drive in missing]
    present = sorted({*configured} - {*absent} | {node for node, answers in others.items() if answers})
    names = ", ".join(drive.name for drive in missing)
    if present:
        found = f"nodes that do answer: {', '.join(map(str, present))}; is it powered, is its node id right?"
    else:
        found = (
            f"no node answers on this bus; check bitrate ({options.bitrate}), interface and channel, power, "
            "cable and termination (120 ohm at both ends)"
        )
    return DriverError(
        "node_missing",
        f"no answer of {names} within {PATIENCE_S * 1e3:.0f} ms; {found}",
        retry=True,
        missing=absent,
        present=present,
    )


def identify(drive: RemoteDrive, eds: Path) -> Identity:
    """Check the drive's type and identity. Raises DriverError (``not_a_drive``, ``identity``, ``wrong_eds``)."""
    device_type = drive.read(0x1000)
    if device_type & 0xFFFF != CIA_402:
        raise drive.error(
            "not_a_drive",
            f"device type is 0x{device_type:08X} (profile {device_type & 0xFFFF}), not a drive "
            f"(profile {CIA_402}); is node_id right?",
            device_type=device_type,
        )
    identity = Identity(*(drive.read_if_there(0x1018, subindex) for subindex in (1, 2, 3, 4)))
    for key in IDENTITY:
        expected, found = getattr(drive.axis.joint, key), getattr(identity, key)
        if expected is not None and expected != found:
            raise drive.error(
                "identity",
                f"{key} is {_number(found)}, the cell file says {_number(expected)}; was the drive "
                "exchanged, or are node ids swapped?",
                key=key,
                found=found,
                wanted=expected,
            )
    _check_eds(drive, identity, eds)
    return identity


def _number(value: int | None) -> str:
    return "not told by the drive" if value is None else f"{value} (0x{value:X})"


def _check_eds(drive: RemoteDrive, identity: Identity, eds: Path) -> None:
    """Check that an EDS of the drive's own vendor is for this drive; the shipped one is for no particular drive."""
    if eds == SHIPPED_EDS:
        return
    of = drive.dictionary.device_information
    for key, in_eds, found in (
        ("vendor", of.vendor_number, identity.vendor_id),
        ("product", of.product_number, identity.product_code),
    ):
        if in_eds and found is not None and in_eds != found:
            raise drive.error(
                "wrong_eds",
                f"{eds.name} is for {key} 0x{in_eds:X} ({of.vendor_name} {of.product_name}), "
                f"the drive is {key} 0x{found:X}; take the drive's own EDS, or leave eds out",
                eds=str(eds),
                in_eds=in_eds,
                found=found,
            )
