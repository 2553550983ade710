"""CiA 402 and CiA 301 codes and their texts: status word, control word, error codes, SDO abort codes, NMT states."""

from __future__ import annotations

from enum import IntEnum, StrEnum


class DriveState(StrEnum):
    """State of the drive's finite state automaton, CiA 402-2. UNKNOWN: the status word matches no state."""

    NOT_READY_TO_SWITCH_ON = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "no state of CiA 402"


STATE_MASKS: tuple[tuple[int, int, DriveState], ...] = (
    (0x4F, 0x00, DriveState.NOT_READY_TO_SWITCH_ON),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY_TO_SWITCH_ON),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, DriveState.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, DriveState.FAULT),
)
"""(mask, value, state) of 0x6041."""


def _state_of(low_bits: int) -> DriveState:
    for mask, value, state in STATE_MASKS:
        if low_bits & mask == value:
            return state
    return DriveState.UNKNOWN


_STATES = tuple(_state_of(low_bits) for low_bits in range(128))

FAULTY = frozenset({DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE})
POWER_OFF = frozenset(
    {DriveState.NOT_READY_TO_SWITCH_ON, DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.FAULT}
)
"""States in which no torque can be applied to the motor."""

WARNING_BIT = 0x0080
INTERNAL_LIMIT_BIT = 0x0800
FOLLOWS_BIT = 0x1000
"""Bit of the cyclic and interpolated modes: the drive follows its set-points."""


def drive_state(status_word: int) -> DriveState:
    """State coded in the status word 0x6041."""
    return _STATES[status_word & 0x7F]


class ControlWord(IntEnum):
    """Values of the control word 0x6040."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE_OPERATION = 0x000F
    FAULT_RESET = 0x0080


ENABLE_STEPS: dict[DriveState, ControlWord] = {
    DriveState.SWITCH_ON_DISABLED: ControlWord.SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: ControlWord.SWITCH_ON,
    DriveState.SWITCHED_ON: ControlWord.ENABLE_OPERATION,
    DriveState.OPERATION_ENABLED: ControlWord.ENABLE_OPERATION,
}
"""Next control word towards operation enabled; every other state gets DISABLE_VOLTAGE, never a fault reset."""


class NmtState(IntEnum):
    """NMT state in a heartbeat, CiA 301."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


def nmt_words(state: int) -> str:
    """NMT state as text."""
    try:
        return NmtState(state).name.lower().replace("_", "-")
    except ValueError:
        return f"unknown NMT state {state}"


HEARTBEAT_LOST = 0x8130
ERROR_PASSIVE = 0x8120

_WIRING = "check motor and its cable for a short or a blocked joint; lower max_acceleration or the load"
_SUPPLY = "check the supply's voltage under load and, for over-voltage, the brake chopper or a lower deceleration"
_HEAT = "let it cool; lower speed, acceleration or duty; check ventilation"
_ENCODER = "check the encoder's cable, shield and supply; commutation must be set up anew if it was changed"
_BUS = "check cable, shield, termination (120 ohm at both ends, 60 ohm between CAN_H and CAN_L) and bitrate"
_MASTER = "the drive missed this master: see what the fault before it says, then reset"
_MAPPING = "the drive's PDO mapping differs from the configured one: reset configures it anew"
_SETTINGS = "compare the drive's parameters with the cell file and the motor's data sheet"

ERROR_CODES: dict[int, tuple[str, str]] = {
    0x0000: ("no error", ""),
    0x1000: ("generic error", "look the drive's own error up in its manual (0x1003)"),
    0x2000: ("current", _WIRING),
    0x2110: ("short circuit or earth leakage at the input", _WIRING),
    0x2211: ("over-current inside the drive", _WIRING),
    0x2220: ("continuous over-current inside the drive", _WIRING),
    0x2310: ("over-current at the motor", _WIRING),
    0x2311: ("over-current at the motor, phase 1", _WIRING),
    0x2312: ("over-current at the motor, phase 2", _WIRING),
    0x2320: ("short circuit or earth leakage at the motor", _WIRING),
    0x2330: ("earth leakage at the motor", _WIRING),
    0x2340: ("short circuit at the motor", _WIRING),
    0x2350: ("i2t or thermal overload of the motor", _HEAT),
    0x3110: ("mains over-voltage", _SUPPLY),
    0x3120: ("mains under-voltage", _SUPPLY),
    0x3130: ("phase failure", _SUPPLY),
    0x3210: ("DC link over-voltage", _SUPPLY),
    0x3220: ("DC link under-voltage", _SUPPLY),
    0x3230: ("DC link load error", _SUPPLY),
    0x3310: ("output over-voltage", _SUPPLY),
    0x3331: ("field circuit interrupted", _WIRING),
    0x4110: ("excess ambient temperature", _HEAT),
    0x4210: ("excess temperature of the device", _HEAT),
    0x4300: ("temperature of the drive", _HEAT),
    0x4310: ("drive over-temperature", _HEAT),
    0x4320: ("drive under-temperature", "let the cabinet warm up"),
    0x5112: ("24 V supply", _SUPPLY),
    0x5113: ("5 V supply", _SUPPLY),
    0x5410: ("output stages", "power the drive off and on; replace it if this stays"),
    0x5441: ("contactor 1 or safe torque off input", "close the emergency stop's circuit, then reset"),
    0x5442: ("contactor 2 or safe torque off input", "close the emergency stop's circuit, then reset"),
    0x5443: ("contactor 3 or safe torque off input", "close the emergency stop's circuit, then reset"),
    0x5530: ("parameter memory (EEPROM)", _SETTINGS),
    0x6010: ("software watchdog of the drive", "power the drive off and on"),
    0x6100: ("internal software", "power the drive off and on; update its firmware"),
    0x6310: ("loss of parameters", _SETTINGS),
    0x6320: ("parameter error", _SETTINGS),
    0x7110: ("brake chopper", _SUPPLY),
    0x7121: ("motor blocked", "free the joint; see whether its brake opens"),
    0x7122: ("motor error or wrong commutation", _ENCODER),
    0x7300: ("sensor", _ENCODER),
    0x7303: ("resolver 1", _ENCODER),
    0x7304: ("resolver 2", _ENCODER),
    0x7305: ("incremental encoder 1", _ENCODER),
    0x7306: ("incremental encoder 2", _ENCODER),
    0x7310: ("speed", "check tuning, counts_per_rev and velocity_units_per_rev_s"),
    0x7320: ("position", "check tuning, and that the encoder counts with the motor's direction"),
    0x7380: ("position sensor", _ENCODER),
    0x7500: ("communication inside the drive", "power the drive off and on"),
    0x8100: ("communication", _BUS),
    0x8110: ("CAN overrun, frames lost in the drive", "lower rate_hz, or find the node that floods the bus"),
    0x8120: ("CAN error passive", _BUS),
    0x8130: ("heartbeat of the master lost", _MASTER),
    0x8140: ("recovered from bus-off", _BUS),
    0x8150: ("CAN id collision", "give every node an id of its own"),
    0x8200: ("protocol", _MAPPING),
    0x8210: ("PDO not processed: too short", _MAPPING),
    0x8220: ("PDO longer than mapped", _MAPPING),
    0x8230: ("destination object of a multiplexed PDO not available", _MAPPING),
    0x8240: ("SYNC of an unexpected length", "another SYNC producer is on the bus: switch it off (0x1005, bit 30)"),
    0x8250: ("RPDO timed out", "the cycle did not reach the drive within rpdo_deadline_ms; see the fault before it"),
    0x8300: ("torque control", "check tuning and load"),
    0x8311: ("excess torque", "free the joint; lower max_acceleration or the load"),
    0x8312: ("difficult start-up", "free the joint; see whether its brake opens"),
    0x8321: ("insufficient torque", "check load and rated torque"),
    0x8400: ("velocity speed controller", "check tuning, and that the encoder counts with the motor's direction"),
    0x8500: ("position controller", "check tuning"),
    0x8600: ("positioning controller", "check tuning"),
    0x8611: ("following error", "free the joint; lower max_acceleration; check the drive's tuning and 0x6065"),
    0x8612: ("reference limit", "drive the joint back by hand or with the drive's own tool"),
    0x8700: ("SYNC lost or out of time", "see the fault before it; 0x1006 is the period that the drive expects"),
    0x9000: ("external error", "see the drive's digital inputs"),
    0xF001: ("deceleration", _SETTINGS),
    0xF002: ("sub-synchronous run", _SETTINGS),
    0xF003: ("stroke operation", _SETTINGS),
    0xF004: ("control", _SETTINGS),
    0xFF01: ("manufacturer's error 1", "look 0xFF01 up in the drive's manual"),
}
"""Error code of EMCY and 0x603F -> (meaning, remedy); CiA 301 table of emergency codes, CiA 402-1."""

_ERROR_GROUPS: dict[int, str] = {
    0x1: "generic error",
    0x2: "current",
    0x3: "voltage",
    0x4: "temperature",
    0x5: "hardware of the device",
    0x6: "software of the device",
    0x7: "additional modules (motor, sensor, brake)",
    0x8: "monitoring",
    0x9: "external error",
    0xF: "device specific error",
}


def error_words(code: int) -> str:
    """Error code with its meaning: ``0x3210 DC link over-voltage``."""
    if code in ERROR_CODES:
        return f"0x{code:04X} {ERROR_CODES[code][0]}"
    if code >= 0xFF00:
        return f"0x{code:04X} manufacturer's error"
    return f"0x{code:04X} {_ERROR_GROUPS.get(code >> 12, 'code that CiA 301 does not define')}"


def error_hint(code: int) -> str:
    """Remedy of an error code, as text."""
    for group in (code, code & 0xFF00, code & 0xF000):
        if group and group in ERROR_CODES:
            return ERROR_CODES[group][1]
    return f"look 0x{code:04X} up in the drive's manual" if code else ""


def is_communication_error(code: int) -> bool:
    """Whether some drives clear the error only by NMT reset communication."""
    return code >> 8 in (0x81, 0x82) or code == 0x8700


ABORT_READ_ONLY = 0x06010002
NOT_WRITABLE = (0x06010000, ABORT_READ_ONLY)
"""Codes of objects that cannot be changed."""
ABORT_NOT_MAPPABLE, ABORT_PDO_FULL = 0x06040041, 0x06040042
ABORT_NO_OBJECT = 0x06020000
ABORT_NO_SUBINDEX = 0x06090011
OUT_OF_RANGE = (0x06090030, 0x06090031, 0x06090032)
"""Codes of values that an object does not accept."""

_FIT = "does the EDS fit this drive?"
_OBJECT = "look index and sub-index up in the drive's manual"
_RANGE = "compare the value with the range in the drive's manual"
_STATE = "switch the drive's power stage off, or disable the PDO that holds the object"

ABORT_CODES: dict[int, tuple[str, str]] = {
    0x05030000: ("toggle bit not alternated", "two masters on the bus?"),
    0x05040000: ("SDO protocol timed out", "is another SDO client on the bus?"),
    0x05040001: ("command specifier not valid", "two masters on the bus?"),
    0x05040002: ("invalid block size", _FIT),
    0x05040003: ("invalid sequence number", "two masters on the bus?"),
    0x05040004: ("CRC error", "check cable and termination"),
    0x05040005: ("out of memory", "power the drive off and on"),
    NOT_WRITABLE[0]: ("unsupported access to an object", _OBJECT),
    0x06010001: ("read of a write-only object", _FIT),
    ABORT_READ_ONLY: ("write to a read-only object", _OBJECT),
    ABORT_NO_OBJECT: ("object does not exist", _OBJECT),
    ABORT_NOT_MAPPABLE: ("object cannot be mapped", "choose other [feedback], or does the EDS fit this drive?"),
    ABORT_PDO_FULL: ("mapped objects exceed the PDO's length", "the drive takes fewer bytes in a PDO"),
    0x06040043: ("general parameter incompatibility", _FIT),
    0x06040047: ("general internal incompatibility in the device", _STATE),
    0x06060000: ("access failed due to a hardware error", "power the drive off and on"),
    0x06070010: ("data type or length does not match", _FIT),
    0x06070012: ("data type does not match, too long", _FIT),
    0x06070013: ("data type does not match, too short", _FIT),
    ABORT_NO_SUBINDEX: ("sub-index does not exist", _OBJECT),
    0x06090030: ("value range exceeded", _RANGE),
    0x06090031: ("value too high", _RANGE),
    0x06090032: ("value too low", _RANGE),
    0x06090036: ("maximum is less than minimum", _RANGE),
    0x060A0023: ("resource not available", "power the drive off and on"),
    0x08000000: ("general error", "look at the drive's own error"),
    0x08000020: ("data cannot be transferred or stored", _STATE),
    0x08000021: ("data cannot be stored because of local control", "end the drive's local control (its own tool)"),
    0x08000022: ("data cannot be stored in the present device state", _STATE),
    0x08000023: ("no object dictionary present", "power the drive off and on"),
    0x08000024: ("no data available", _STATE),
}
"""SDO abort code -> (meaning, remedy); CiA 301."""


def abort_words(code: int) -> str:
    """SDO abort code with its meaning."""
    return f"0x{code:08X} {ABORT_CODES[code][0] if code in ABORT_CODES else 'abort code unknown to CiA 301'}"


def abort_hint(code: int) -> str:
    """Remedy of an SDO abort, as text."""
    return ABORT_CODES[code][1] if code in ABORT_CODES else "look the abort code up in the drive's manual"
