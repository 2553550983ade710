"""Configuration of a CiA 402 drive as a list of object writes, from the cell file's options."""

from __future__ import annotations

import configparser
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.canopen.cia402 import COMMAND, EMCY_ID, RPDO_IDS, SYNC_ID, TPDO_IDS, tpdo_mappings
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.canopen.units import JointScale

if TYPE_CHECKING:
    import canopen

SHIPPED_EDS = Path(__file__).with_name("drive402.eds")

PDO_OFF = 1 << 31
_COB_ID_MASK = 0xBFFFFFFF
"""Bit 30 of a TPDO's COB-ID (no remote frames) may be fixed in the drive."""
_WHOLE = 0xFFFFFFFF
ON_EVERY_SYNC = 1
AT_ONCE = 255
MODES = {"csv": 9, "pv": 3}
FAULT_REACTION_QUICK_STOP = 2

HEARTBEAT_CONSUMER = (0x1016, 1)
RPDO_COMMUNICATION, RPDO_MAPPING = 0x1400, 0x1600
TPDO_COMMUNICATION, TPDO_MAPPING = 0x1800, 0x1A00
PDO_RANGE = 0x200

_OBJECT = re.compile(r"\s*(0[xX][0-9a-fA-F]{1,4})\s*(?::\s*(\d{1,3}|0[xX][0-9a-fA-F]{1,2}))?\s*")


@dataclass(frozen=True)
class Write:
    """One write of ``value`` to an object; read back, it must agree in the bits of ``mask``. ``option``: its origin
    in the cell file.
    """

    index: int
    subindex: int
    value: int
    mask: int = _WHOLE
    option: str = ""

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.subindex

    def agrees(self, read: int) -> bool:
        """Whether a value read back agrees with the one written."""
        return (read ^ self.value) & self.mask == 0


def parse_object(name: str, joint: str) -> tuple[int, int]:
    """Parse ``0x60C2:1`` as index and sub-index (0 where left out). Raises DriverError (``option``)."""
    match = _OBJECT.fullmatch(name)
    if match is None or int(match[2] or "0", 0) > 0xFF:
        raise DriverError(
            "option",
            f"joint {joint!r}: sdo key {name!r} is no object; write it like 0x60C2:1 (index and sub-index)",
            joint=joint,
            key=name,
        )
    return int(match[1], 16), int(match[2] or "0", 0)


def identifier_writes(node_id: int) -> list[Write]:
    """Writes of the COB-IDs of SYNC (which the drive must not produce: bit 30) and EMCY, for drives with other
    values.
    """
    return [
        Write(0x1005, 0, SYNC_ID, 0x400007FF),
        Write(0x1014, 0, EMCY_ID + node_id, 0x800007FF),
    ]


def parameter_writes(
    options: CanOptions, joint: CanJoint, dictionary: canopen.ObjectDictionary
) -> list[Write]:
    """Writes of everything but PDOs and the monitoring of this master's heartbeat (0x1016), which is activated
    last.

    What the joint's ``sdo`` names takes the place of the driver's own value. 0x605E, 0x607F, 0x6080, 0x6083 and 0x6084
    only where the EDS has them.
    """
    scale = JointScale.of(joint)
    limit = scale.rate_units(joint.max_velocity)
    acceleration = scale.rate_units(joint.max_acceleration)
    always = [
        Write(0x1017, 0, options.heartbeat_ms, option="heartbeat_ms"),
        Write(0x6007, 0, options.abort_option, option="abort_option"),
        Write(0x605A, 0, options.quick_stop_option, option="quick_stop_option"),
        Write(0x6060, 0, MODES[options.mode], option="mode"),
        Write(0x6085, 0, scale.rate_units(joint.quick_stop_deceleration), option="quick_stop_deceleration"),
    ]
    where_there = [
        Write(0x605E, 0, FAULT_REACTION_QUICK_STOP),
        Write(0x607F, 0, limit, option="max_velocity"),
        Write(0x6080, 0, limit, option="max_velocity"),
        Write(0x6083, 0, acceleration, option="max_acceleration"),
        Write(0x6084, 0, acceleration, option="max_acceleration"),
    ]
    own = [Write(*parse_object(name, joint.name), value, option="sdo") for name, value in joint.sdo.items()]
    there = [write for write in where_there if dictionary.get_variable(*write.key) is not None]
    return list({write.key: write for write in (*always, *there, *own)}.values())


def _pdo_writes(
    number: int,
    base: tuple[int, int],
    cob_id: int,
    mapping: tuple[int, ...],
    transmission: int,
    deadline_ms: int,
) -> list[Write]:
    """Writes of one PDO in the order of CiA 301: off, no mapping, mapping, type, deadline, on."""
    communication, mapped = base[0] + number, base[1] + number
    writes = [Write(communication, 1, cob_id | PDO_OFF, _COB_ID_MASK), Write(mapped, 0, 0)]
    writes += [Write(mapped, place + 1, entry, option="feedback") for place, entry in enumerate(mapping)]
    writes += [Write(mapped, 0, len(mapping)), Write(communication, 2, transmission)]
    if deadline_ms:
        option = "rpdo_deadline_ms (0 where the drive has no such deadline)"
        writes.append(Write(communication, 5, deadline_ms, option=option))
    return [*writes, Write(communication, 1, cob_id, _COB_ID_MASK)]


def pdo_writes(options: CanOptions, node_id: int) -> list[Write]:
    """Writes of the mapping of RPDO1 and the TPDOs in use, in order."""
    rpdo = (RPDO_COMMUNICATION, RPDO_MAPPING)
    tpdo = (TPDO_COMMUNICATION, TPDO_MAPPING)
    writes = _pdo_writes(0, rpdo, RPDO_IDS[0] + node_id, COMMAND, AT_ONCE, options.rpdo_deadline_ms)
    for number, mapping in enumerate(tpdo_mappings(options.feedback)):
        writes += _pdo_writes(number, tpdo, TPDO_IDS[number] + node_id, mapping, ON_EVERY_SYNC, 0)
    return writes


def unused_pdos(options: CanOptions, dictionary: canopen.ObjectDictionary) -> list[int]:
    """Writes that disable all other PDOs of the EDS: a drive may have them on by default."""
    used = len(tpdo_mappings(options.feedback))
    rpdos = range(RPDO_COMMUNICATION + 1, RPDO_COMMUNICATION + PDO_RANGE)
    tpdos = range(TPDO_COMMUNICATION + used, TPDO_COMMUNICATION + PDO_RANGE)
    return [index for index in dictionary if index in rpdos or index in tpdos]


def eds_path(options: CanOptions, cell_dir: Path) -> Path:
    """Path of the EDS: beside the cell file, or the shipped one (``eds`` empty or its name). Raises DriverError
    (``eds``).
    """
    if not options.eds:
        return SHIPPED_EDS
    path = cell_dir / options.eds
    if path.is_file():
        return path
    if options.eds == SHIPPED_EDS.name:
        return SHIPPED_EDS
    raise DriverError(
        "eds",
        f"eds = {options.eds!r}: there is no file {path}; leave eds out for the shipped one, which fits most drives",
        eds=options.eds,
        path=str(path),
    )


def load_eds(path: Path) -> canopen.ObjectDictionary:
    """Object dictionary of an EDS file. Raises DriverError (``eds``) where it is invalid."""
    from canopen import import_od  # heavy: only who talks to drives pays for it

    try:
        dictionary = import_od(str(path))
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        NotImplementedError,
        OSError,
        configparser.Error,
    ) as error:
        raise DriverError("eds", f"{path} is not an EDS file of CiA 306: {error}", path=str(path)) from error
    if not len(dictionary):
        raise DriverError("eds", f"{path} holds no objects", path=str(path))
    return dictionary
