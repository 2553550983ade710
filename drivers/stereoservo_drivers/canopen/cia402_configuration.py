"""Capabilities of a CiA 402 drive, from its own answers, the safest configuration that they allow, and its object
writes.

CiA 301 and CiA 402 make few objects mandatory: a drive's reaction to a silent master, its quick stop's reaction and
even the modes are optional. An EDS may be wrong or of another firmware, so the drive is queried.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.canopen.cia402 import EMCY_ID, SYNC_ID
from stereoservo_drivers.canopen.eds_files import read_eds
from stereoservo_drivers.canopen.option_checks import parse_sdo_key
from stereoservo_drivers.canopen.options import CanJoint, CanOptions, CommandMode
from stereoservo_drivers.canopen.pdo_plan import FEEDBACK_OBJECTS, PDOS, RPDO_IDS, TARGETS, TPDO_IDS, Pdo, PdoPlan
from stereoservo_drivers.canopen.units import JointScale

if TYPE_CHECKING:
    import canopen

    from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive

Watch = Literal["heartbeat", "guarding", "deadline"]

MODES: dict[CommandMode, int] = {"csv": 9, "pv": 3, "csp": 8, "ip": 7}
"""Mode of operation -> its number in 0x6060, the preferred one first."""
FEEDBACK_INDEX = {what: entry >> 16 for what, entry in FEEDBACK_OBJECTS.items()}
HEARTBEAT_CONSUMER = (0x1016, 1)
GUARD_TIME, LIFE_FACTOR = (0x100C, 0), (0x100D, 0)
DEADLINE = (0x1400, 5)
ABORT_OPTION, QUICK_STOP_OPTION, QUICK_STOP_RAMP = (0x6007, 0), (0x605A, 0), (0x6085, 0)
FAULT_REACTION = (0x605E, 0)
SPEEDS = ((0x607F, 0), (0x6080, 0))
RAMPS = ((0x6083, 0), (0x6084, 0))
INTERPOLATION_TIME, INTERPOLATION_EXPONENT = (0x60C2, 1), (0x60C2, 2)


def mapped_object(entry: int) -> tuple[int, int]:
    """Index and sub-index of a mapping entry."""
    return entry >> 16, entry >> 8 & 0xFF


PROBED = (
    HEARTBEAT_CONSUMER, GUARD_TIME, LIFE_FACTOR, DEADLINE, ABORT_OPTION, QUICK_STOP_OPTION, QUICK_STOP_RAMP,
    FAULT_REACTION, *SPEEDS, *RAMPS, INTERPOLATION_TIME, INTERPOLATION_EXPONENT,
    *dict.fromkeys(map(mapped_object, TARGETS.values())), *((index, 0) for index in FEEDBACK_INDEX.values()),
)  # fmt: skip

LOSSES = {
    ABORT_OPTION: "0x6007 is not there: what the drive does when it misses this computer is its maker's choice",
    QUICK_STOP_OPTION: "0x605A is not there: whether a quick stop ends with the power off is its maker's choice",
    QUICK_STOP_RAMP: "0x6085 is not there: how hard a quick stop brakes is its maker's choice",
}
"""Text on the effect of a missing object, for the objects by which a drive stops."""
NO_SWITCHES = "0x60FD is not there: a limit switch is not told from another limit of the drive"
NO_WATCH = (
    "the drive watches nothing of this computer that must stop it: it has no consumer heartbeat (0x1016:1) and no node "
    "guarding (0x100C, 0x100D)"
)
ONLY_DEADLINE = (
    "; its deadline of commands (0x1400:5) is set, but CiA 301 asks no more of it than that the drive notices, and "
    "CiA 402 has no object for what it does then"
)


@dataclass(frozen=True)
class Capabilities:
    """Capabilities of one drive. ``values``: of the probed objects that exist; ``modes``: bits of 0x6502, None if it
    does not report them.
    """

    modes: int | None
    values: dict[tuple[int, int], int]

    def has(self, key: tuple[int, int]) -> bool:
        """Whether the drive has an object."""
        return key in self.values


@dataclass(frozen=True)
class Setup:
    """Configuration of one drive. ``modes``: to try, the best first. ``losses``: restrictions of its stops, as text."""

    capabilities: Capabilities
    modes: tuple[CommandMode, ...]
    watches: tuple[Watch, ...]
    losses: tuple[str, ...] = field(default=())

    def safety(self) -> str:
        """Its monitoring of this computer, and its restrictions, as one line."""
        words = {
            "heartbeat": "this computer's heartbeat (0x1016)",
            "guarding": "node guarding (0x100C)",
            "deadline": "the deadline of commands (0x1400:5)",
        }
        watched = ", ".join(words[watch] for watch in self.watches) or "nothing"
        return "; ".join((f"watches {watched}", *self.losses))


def capabilities(drive: RemoteDrive) -> Capabilities:
    """Query a drive's capabilities. Raises DriverError (``sdo_timeout``)."""
    found = {key: drive.read_if_there(*key) for key in PROBED}
    return Capabilities(drive.read_if_there(0x6502), {key: value for key, value in found.items() if value is not None})


def compose(drive: RemoteDrive, options: CanOptions, has: Capabilities) -> Setup:
    """The safest configuration of a drive. Raises DriverError (``mode``, ``no_watch``)."""
    joint = drive.axis.joint
    losses = [text for key, text in LOSSES.items() if not has.has(key)]
    if "switches" in options.feedback and not has.has((FEEDBACK_INDEX["switches"], 0)):
        losses.append(NO_SWITCHES)
    watches = watches_of(options, has)
    if not set(watches) - {"deadline"}:
        unwatched = NO_WATCH + ONLY_DEADLINE * bool(watches)
        if "watch" not in joint.accept_missing:
            raise drive.error(
                "no_watch",
                f"{unwatched}. If this computer dies, it goes on with the last command that it got. Cut "
                'its power by a safety relay, and say that you know: accept_missing = ["watch"] of this joint',
                joint=joint.name,
            )
        losses.insert(0, f"{unwatched}, as accept_missing acknowledges")
    return Setup(has, _modes(drive, options, has), watches, tuple(losses))


def watches_of(options: CanOptions, has: Capabilities) -> tuple[Watch, ...]:
    """The drive's own monitoring of this computer; heartbeat and guarding exclude each other (CiA 301)."""
    watches: list[Watch] = []
    if has.has(HEARTBEAT_CONSUMER):
        watches.append("heartbeat")
    elif has.has(GUARD_TIME) and has.has(LIFE_FACTOR):
        watches.append("guarding")
    if has.has(DEADLINE) and options.rpdo_deadline_ms:
        watches.append("deadline")
    return tuple(watches)


def _modes(drive: RemoteDrive, options: CanOptions, has: Capabilities) -> tuple[CommandMode, ...]:
    there = tuple(mode for mode in MODES if usable(mode, has))
    if options.mode == "auto":
        asked = there
    else:
        asked = tuple(mode for mode in there if mode == options.mode)
    if asked:
        return asked
    told = "none" if has.modes is None else f"0x{has.modes:08X}"
    number = "" if options.mode == "auto" else f" {MODES[options.mode]} ({options.mode})"
    able = ", ".join(there) or "none of csv, pv, csp and ip: this drive cannot be used"
    raise drive.error("mode", f"the drive has no mode{number}, 0x6502 is {told}; set mode to {able}", modes=has.modes)


def usable(mode: CommandMode, has: Capabilities) -> bool:
    """Whether a drive has a mode (by 0x6502 if reported), and the object of its set-point."""
    stated = has.modes is None or bool(has.modes >> (MODES[mode] - 1) & 1)
    return stated and has.has(mapped_object(TARGETS[mode]))


def available_feedback(options: CanOptions, drives: list[Capabilities]) -> list[tuple[str, ...]]:
    """Requested feedback that each drive is to send: switches if it has them, the rest if all drives have it."""

    def sends(drive: Capabilities, what: str) -> bool:
        return all(has.has((FEEDBACK_INDEX[what], 0)) for has in ([drive] if what == "switches" else drives))

    return [tuple(what for what in options.feedback if sends(drive, what)) for drive in drives]


def interpolation_time(rate_hz: float) -> tuple[int, int]:
    """Period of a cycle as 0x60C2 takes it: (value of 8 bits, exponent of ten [s]), the closest there is."""
    period_s = 1.0 / rate_hz
    candidates = [
        (round(period_s * 10.0**-exponent), exponent)
        for exponent in range(-3, -7, -1)
        if 1 <= round(period_s * 10.0**-exponent) <= 255
    ]
    return min(candidates, key=lambda pair: abs(pair[0] * 10.0 ** pair[1] - period_s))


def periods_agree(options: CanOptions, value: int, exponent: int) -> bool:
    """Whether a period of set-points read from 0x60C2 is that of the cycle, within the resolution of 0x60C2."""
    due = interpolation_time(options.rate_hz)
    return math.isclose(value * 10.0**exponent, due[0] * 10.0 ** due[1], rel_tol=1e-9)


def lead_words(joint: CanJoint) -> str:
    """Maximum motion of a drive with position set-points after its last one, as text."""
    unit = "rad" if joint.kind == "revolute" else "m"
    farthest = joint.lead + joint.largest_load_offset
    return f"led by positions: without orders it goes at most {farthest:.3g} {unit} further"


# -- writes ----------------------------------------------------------------------------------------------------

SHIPPED_EDS = Path(__file__).with_name("drive402.eds")

PDO_OFF = 1 << 31
_COB_ID_MASK = 0xBFFFFFFF
"""Bit 30 of a TPDO's COB-ID (no remote frames) may be fixed in the drive."""
_WHOLE = 0xFFFFFFFF
FAULT_REACTION_QUICK_STOP = 2


class PdoObjects(NamedTuple):
    """Objects and settings of the PDOs in one direction: the first indices of ``communication`` and ``mapping``, the
    COB-IDs without the node's, and the ``transmission`` type.
    """

    name: str
    communication: int
    mapping: int
    cob_ids: tuple[int, ...]
    transmission: int


RPDOS = PdoObjects("RPDO", 0x1400, 0x1600, RPDO_IDS, 255)
"""Received PDOs take effect at once."""
TPDOS = PdoObjects("TPDO", 0x1800, 0x1A00, TPDO_IDS, 1)
"""Sent PDOs come with every SYNC."""
PDO_RANGE = 0x200


@dataclass(frozen=True)
class Write:
    """One write of ``value`` to an object; read back, it must agree in the bits of ``mask``. ``option``: its origin in
    the cell file.
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


def identifier_writes(node_id: int) -> list[Write]:
    """Writes of the COB-IDs of SYNC (not produced by the drive: bit 30) and EMCY, for drives with other values."""
    return [Write(0x1005, 0, SYNC_ID, 0x400007FF), Write(0x1014, 0, EMCY_ID + node_id, 0x800007FF)]


def parameter_writes(options: CanOptions, joint: CanJoint, setup: Setup) -> list[Write]:
    """Writes of everything but mode, PDOs and the drive's monitoring of this computer, which is activated last.

    Only objects that the drive has. Values of the joint's ``sdo`` replace the driver's own.
    """
    scale = JointScale.of(joint)
    limit = scale.rate_units(joint.max_velocity)
    acceleration = scale.rate_units(joint.max_acceleration)
    guarded = "guarding" in setup.watches
    writes = [
        Write(0x1017, 0, 0 if guarded else options.heartbeat_ms, option="heartbeat_ms"),
        Write(*ABORT_OPTION, options.abort_option, option="abort_option"),
        Write(*QUICK_STOP_OPTION, options.quick_stop_option, option="quick_stop_option"),
        Write(*QUICK_STOP_RAMP, scale.rate_units(joint.quick_stop_deceleration), option="quick_stop_deceleration"),
        Write(*FAULT_REACTION, FAULT_REACTION_QUICK_STOP),
        *(Write(*key, limit, option="max_velocity") for key in SPEEDS),
        *(Write(*key, acceleration, option="max_acceleration") for key in RAMPS),
    ]
    own = [Write(*parse_sdo_key(name), value, option="sdo") for name, value in joint.sdo.items()]
    there = [write for write in writes if write.key == (0x1017, 0) or setup.capabilities.has(write.key)]
    return list({write.key: write for write in (*there, *own)}.values())


def period_writes(options: CanOptions, joint: CanJoint, setup: Setup, mode: CommandMode) -> list[Write]:
    """Writes of the period of set-points in the modes that interpolate, if the drive has the object."""
    told = {parse_sdo_key(name) for name in joint.sdo}
    has = setup.capabilities.values
    if mode == "pv" or INTERPOLATION_TIME not in has or INTERPOLATION_TIME in told:
        return []
    value, exponent = interpolation_time(options.rate_hz)
    held = has.get(INTERPOLATION_EXPONENT, exponent)
    if periods_agree(options, has[INTERPOLATION_TIME], held):
        return []
    if held == exponent:
        return [Write(*INTERPOLATION_TIME, value, option="rate_hz")]
    return [
        Write(*INTERPOLATION_EXPONENT, exponent, option="rate_hz"),
        Write(*INTERPOLATION_TIME, value, option="rate_hz"),
    ]


def watch_writes(options: CanOptions, setup: Setup) -> list[Write]:
    """Writes that activate the drive's monitoring of this computer."""
    if "heartbeat" in setup.watches:
        value = options.master_id << 16 | options.heartbeat_timeout_ms
        return [Write(*HEARTBEAT_CONSUMER, value, option="heartbeat_timeout_ms")]
    if "guarding" in setup.watches:
        factor = max(2, round(options.heartbeat_timeout_ms / options.heartbeat_ms))
        return [
            Write(*GUARD_TIME, options.heartbeat_ms, option="heartbeat_ms"),
            Write(*LIFE_FACTOR, min(factor, 255), option="heartbeat_timeout_ms"),
        ]
    return []


def unwatch_writes(setup: Setup) -> list[Write]:
    """Writes that end the drive's monitoring of this computer."""
    if "heartbeat" in setup.watches:
        return [Write(*HEARTBEAT_CONSUMER, 0)]
    return [Write(*LIFE_FACTOR, 0), Write(*GUARD_TIME, 0)] if "guarding" in setup.watches else []


def pdo_writes(
    objects: PdoObjects, pdo: Pdo, node_id: int, *, fixed: bool = False, deadline_ms: int = 0
) -> list[Write]:
    """Writes of one PDO in the order of CiA 301: off, no mapping, mapping, type, deadline, on. ``fixed``: its mapping
    cannot be changed.
    """
    communication, mapped = objects.communication + pdo.number, objects.mapping + pdo.number
    cob_id = objects.cob_ids[pdo.number] + node_id
    writes = []
    if not fixed:
        writes += [Write(communication, 1, cob_id | PDO_OFF, _COB_ID_MASK), Write(mapped, 0, 0)]
        writes += [Write(mapped, place + 1, entry, option="feedback") for place, entry in enumerate(pdo.mapping)]
        writes.append(Write(mapped, 0, len(pdo.mapping)))
    writes.append(Write(communication, 2, objects.transmission))
    if deadline_ms:
        writes.append(Write(communication, DEADLINE[1], deadline_ms, option="rpdo_deadline_ms"))
    return [*writes, Write(communication, 1, cob_id, _COB_ID_MASK)]


def unused_pdos(plan: PdoPlan, dictionary: canopen.ObjectDictionary) -> list[int]:
    """Communication objects of all PDOs but those of the plan: a drive may have them enabled by default."""
    found = []
    for objects, used in ((RPDOS, plan.commands), (TPDOS, plan.reports)):
        first = objects.communication
        standard = range(first, first + PDOS)
        listed = [index for index in dictionary if first + PDOS <= index < first + PDO_RANGE]
        found += [index for index in (*standard, *listed) if index - first not in {pdo.number for pdo in used}]
    return found


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
    """Object dictionary of an EDS file. Raises DriverError (``eds``) if it holds nothing usable."""
    return read_eds(path)[0]
