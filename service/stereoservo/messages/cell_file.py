"""The cell file, the TOML configuration of a cell: structs of its sections (drivers, cameras, servo loop, safety,
calibration, zenoh), strictly decoded and validated.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import msgspec.inspect
from msgspec import Meta

from stereoservo.messages.addresses import keep_secret, redacted, without_secrets
from stereoservo.messages.goals import DEFAULT_LAW, LawName, Name, PointSource
from stereoservo.messages.known_length import known_length_of
from stereoservo.messages.text_files import Remark, complete, toml_of

SCHEMA = 1
Mount = Literal["eye_to_hand", "eye_in_hand"]
LARGEST = 1e9
MAX_MARKERS = 256
"""Largest number of markers of a cell, on the arm and static: the computing time of a step increases with it."""
MAX_CAMERAS = 8
MAX_JOINTS = 12

Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]


class CellFileError(Exception):
    """A cell file cannot be used: the message contains the file, the key, the value and valid values."""

    def __init__(self, path: Path | str, key: str, message: str) -> None:
        where = f"{path}: {key}: " if key else f"{path}: "
        super().__init__(where + redacted(message))
        self.path = str(path)
        self.key = key


class CellSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[cell]``"""

    name: Name


class JointsSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[joints]``: the driver, its options, and home [rad or m] by joint name (default: the calibration's base)."""

    driver: str
    options: dict[str, Any] = {}
    home: dict[str, float] = {}


class CameraSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One ``[[camera]]``. ``mobile``: may be moved at any time, and is re-estimated while it moves."""

    name: Name
    driver: str
    detector: str = ""
    mount: Mount = "eye_to_hand"
    mobile: bool = False
    options: dict[str, Any] = {}
    detector_options: dict[str, Any] = {}


class SceneSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[scene]``: ``static``, ids of markers that never move (e.g. a plate on a wall) and that the arm does not carry.
    ``moves``: for cameras on the arm, the marker body in front of them moves on its own once the cell is calibrated,
    for instance on a conveyor.

    Calibration triangulates static markers; they are used to detect and relocalize a displaced camera.
    """

    static: tuple[Annotated[int, Meta(ge=0)], ...] = ()
    moves: bool = False


class ServoSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[servo]``: the loop and the defaults of goals."""

    rate_hz: Annotated[float, Meta(ge=10, le=2000)] = 250.0
    law: LawName = DEFAULT_LAW
    points: PointSource = "predicted"
    gain: Positive = 1.5
    tolerance_px: Positive = 0.25
    hold_frames: Annotated[int, Meta(ge=1)] = 10
    time_limit_s: Positive = 60.0
    filter_s: NonNegative = 0.2
    """Time constant of the innovation filter [s]: 0 takes each frame as it is."""
    gate_sigma: Positive = 6.0
    """Observations farther from their prediction are rejected [sigmas]: the probability for both axes of a pixel
    together (chi-square with two degrees of freedom) equals that of so many sigmas in one axis.
    """
    reanchor: Literal["auto", "off"] = "auto"
    """Reaction to a camera that was moved: relocalized while the goal waits, or the goal is aborted."""
    priority: Annotated[int, Meta(ge=0, le=98)] = 50
    """SCHED_FIFO priority of the servo process; 0 does not change the scheduler."""


class JointLimit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One ``[[safety.limit]]``: position range, velocity and acceleration of one joint [rad or m, s]."""

    joint: str
    min: float
    max: float
    velocity: Positive
    acceleration: Positive


class KeepOut(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One ``[[safety.keep_out]]``: a box in joint space that the arm may not enter; joints left out are unbounded."""

    name: str
    ranges: dict[str, tuple[float, float]]


class ContactSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[safety.contact]``: collision detection by joint efforts and following errors.

    ``effort`` [as the driver reports it] and ``following`` [rad or m]: thresholds by joint, in place of those learnt
    from the calibration's motions. These are ``factor`` times the values observed there. The arm stops after
    ``samples`` consecutive joint samples beyond the threshold.
    """

    effort: dict[str, float] = {}
    following: dict[str, float] = {}
    factor: Annotated[float, Meta(ge=1, le=100)] = 2.0
    samples: Annotated[int, Meta(ge=1, le=100)] = 5
    enabled: bool = True


class SafetySection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[safety]``. A cell with a simulated arm may omit ``limit``: then the machine's limits are the cell's."""

    limit: tuple[JointLimit, ...] = ()
    keep_out: tuple[KeepOut, ...] = ()
    coast_s: NonNegative = 0.5
    """How long a law may run on prediction alone while no camera delivers [s]."""
    joint_timeout_s: Positive = 0.1
    """Age of the joint sample at which the arm brakes [s]."""
    position_margin: NonNegative = 0.01
    """Distance kept from every position limit [rad or m]."""
    speed_scale: Annotated[float, Meta(gt=0, le=1)] = 1.0
    contact: ContactSection = ContactSection()


class SpreadSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``calibration.spread``: at each stop of the joints before ``joint``, that joint is measured at several positions.

    A flat plate thus becomes a body in space: 4 dots at 4 positions are 16 points (thesis fig. 5.16). The positions are
    in ``base ± range``, equally spaced; ``range`` [rad or m] defaults to ``calibration.range`` of that joint, or 0.6
    rad, 0.2 m.
    """

    joint: str
    positions: Annotated[int, Meta(ge=2, le=12)] = 4
    range: Positive | None = None


class CalibrationSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[calibration]``: trial motions. Each joint moves alone from ``base`` over ``base ± range``, then all at once.

    A joint without a range moves outwards as long as the markers remain in every view, up to 0.6 rad or 0.2 m. For a
    simulated arm the base may be omitted.
    """

    base: dict[str, float] = {}
    range: dict[str, Positive] = {}
    motion: Literal["sweeps", "stops"] = "sweeps"
    """Joints stop for each measurement, or sweep while cameras with exact stamps run. With ``spread`` they stop."""
    stops: Annotated[int, Meta(ge=4, le=200)] = 9
    frames: Annotated[int, Meta(ge=1, le=200)] = 5
    settle_s: NonNegative = 0.15
    speed_scale: Annotated[float, Meta(gt=0, le=1)] = 0.5
    min_markers: Annotated[int, Meta(ge=3)] = 4
    """Least number of markers that each camera must see at a stop; with fewer the joint moves back."""
    min_range: Positive = 0.05
    """Smallest usable motion of a joint [rad or m]."""
    wait_s: Positive = 2.0
    """How long to wait at a stop for enough frames before moving back [s]."""
    together: Annotated[int, Meta(ge=0, le=16)] = 16
    """Number of stops, after those of single joints, at which all joints are offset from the base by 0.4 to 0.8 of the
    range in which each was driven; 0: none.
    """
    spread: SpreadSection | None = None
    known_length: str = ""
    """One length of arm, markers or cameras, as WHAT:OF=METRES (markers:10,11=0.05, baseline:left,right=0.2,
    prismatic:j1=1, a:j2=0.4, d:j3=0.1): it scales steps in metres, and the report's Denavit-Hartenberg parameters.
    """
    refine: bool = False
    """Refine the model on-line by the rest poses after goals; the calibrated one is kept."""


class TlsSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[zenoh.tls]``: paths, relative to the cell file."""

    root_ca_certificate: str
    listen_private_key: str
    listen_certificate: str
    enable_mtls: bool = True


class ZenohSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[zenoh]``: ``router`` (default: the daemon is its own router) or ``client`` of a site's router.

    ``endpoints``: listened on as a router (default: a unix socket in the runtime directory), connected to as a client.
    """

    mode: Literal["router", "client"] = "router"
    endpoints: tuple[str, ...] = ()
    tls: TlsSection | None = None


class RecordingSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[recording]``: the flight ring, the last minutes of the loop's steps, which is always recorded.

    It uses at most ``ring_mib`` of the state directory (0 switches it off), and only while ``reserve_mib`` of its disk
    remain free. At a fault the ring is kept separately, for the last ``kept_faults`` faults, so that the total is at
    most ``(1 + kept_faults) * ring_mib``.
    """

    ring_minutes: Annotated[float, Meta(gt=0, le=1440)] = 10.0
    ring_mib: Annotated[int, Meta(ge=0, le=1 << 20)] = 512
    reserve_mib: Annotated[int, Meta(ge=0, le=1 << 30)] = 2048
    kept_faults: Annotated[int, Meta(ge=0, le=100)] = 4


class CellFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole cell file."""

    schema: int
    cell: CellSection
    joints: JointsSection
    camera: tuple[CameraSection, ...]
    safety: SafetySection
    calibration: CalibrationSection | None = None
    servo: ServoSection = ServoSection()
    zenoh: ZenohSection = ZenohSection()
    scene: SceneSection = SceneSection()
    recording: RecordingSection = RecordingSection()
    emulate: dict[str, Any] = {}
    """``[emulate.drives]``, ``[emulate.cameras]``: replacements of the hardware by `stereoservo emulate`; of the
    daemon's processes only a simulated camera reads it (``arm_options``).
    """

    @property
    def arm_options(self) -> dict[str, Any]:
        """Options that describe the simulated arm, if there is one: those of the emulated drives, else of the joint
        driver.
        """
        drives = self.emulate.get("drives")
        return drives if isinstance(drives, dict) else self.joints.options


def load_cell_file(path: Path, remarks: list[Remark] | None = None) -> CellFile:
    """Read and check a cell file; ``remarks`` receives what was repaired in its text. Raises CellFileError with file,
    key, value and valid values, and with the lines that cannot be read.
    """
    try:
        tree, odd = toml_of(path.read_bytes())
        if remarks is not None:
            remarks += odd
        complete((tree, odd))  # a limit may be among what is missing
    except OSError as error:
        raise CellFileError(path, "", f"cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise CellFileError(path, "", f"is not TOML: {error}") from error
    return check_cell(tree, path)


def check_cell(tree: dict[str, Any], path: Path | str = "<cell>") -> CellFile:
    """Decode a parsed cell file strictly; its secrets are in no message from now on. Raises CellFileError."""
    keep_secret(tree)
    _check_numbers(tree, "", path)
    if tree.get("schema") != SCHEMA:
        raise CellFileError(path, "schema", f"is {tree.get('schema')!r}; this version reads {SCHEMA}")
    try:
        cell = msgspec.convert(tree, CellFile, strict=True)
    except msgspec.ValidationError as error:
        text, _, where = str(error).partition(" - at `")
        key = where.rstrip("`").removeprefix("$").lstrip(".")
        raise CellFileError(path, key, f"{text}{_allowed(tree, text, key)}") from error
    names = [camera.name for camera in cell.camera]
    if not names:
        raise CellFileError(path, "camera", "no camera; at least one [[camera]] is needed")
    if len(names) > MAX_CAMERAS:
        raise CellFileError(path, "camera", f"{len(names)} cameras; a cell has at most {MAX_CAMERAS}")
    for name in names:
        if names.count(name) > 1:
            raise CellFileError(path, "camera.name", f"{name!r} is used twice; camera names must differ")
    for camera in cell.camera:
        if camera.mobile and camera.mount != "eye_to_hand":
            raise CellFileError(
                path,
                "camera.mobile",
                f"{camera.name!r} rides on the arm (mount {camera.mount!r}), where the arm itself says how it moves; "
                "mobile is for cameras that something else moves (mount 'eye_to_hand')",
            )
    mounts = {camera.mount for camera in cell.camera}
    if len(mounts) > 1:
        raise CellFileError(
            path,
            "camera.mount",
            f"{', '.join(f'{camera.name!r} is {camera.mount}' for camera in cell.camera)}; all cameras of a cell are "
            "mounted alike: mount them so, or take those that stand and those on the arm as cells of their own",
        )
    check_limits(cell, path)
    if cell.calibration is not None and cell.calibration.known_length:
        _check_known_length(cell.calibration.known_length, names, path)
    return cell


def _check_known_length(text: str, cameras: list[str], path: Path | str) -> None:
    """Check a known length, as far as a cell file allows; the existing markers and joints are known only
    to the model.
    """
    try:
        known = known_length_of(text)
    except ValueError as error:
        raise CellFileError(path, "calibration.known_length", str(error)) from error
    if known.what == "baseline" and not set(known.of) <= set(cameras):
        raise CellFileError(
            path,
            "calibration.known_length",
            f"{text!r} names no two cameras of {', '.join(cameras)}",
        )


def _check_numbers(value: Any, key: str, path: Path | str) -> None:
    """Check that no number is infinite, NaN or too large: an infinite time-out would be a disabled time-out."""
    if isinstance(value, dict):
        for name, item in value.items():
            _check_numbers(item, f"{key}.{name}" if key else str(name), path)
    elif isinstance(value, list):
        for k, item in enumerate(value):
            _check_numbers(item, f"{key}[{k}]", path)
    elif isinstance(value, float) and not math.isfinite(value):
        raise CellFileError(path, key, f"is {value}; a finite number is needed")
    elif isinstance(value, float) and abs(value) > LARGEST:
        raise CellFileError(path, key, f"is {value}; numbers up to {LARGEST:g} are valid")
    elif isinstance(value, int) and abs(value) >= 2**63:
        raise CellFileError(path, key, "is an integer of more than 63 bits")


def check_limits(cell: CellFile, path: Path | str) -> None:
    """Check the joints' limits, and the values stated by joint against them. Raises CellFileError."""
    seen: list[str] = []
    for limit in cell.safety.limit:
        if limit.joint in seen:
            raise CellFileError(path, "safety.limit", f"joint {limit.joint!r} has two limits; one is allowed")
        seen.append(limit.joint)
        if not limit.min < limit.max:
            raise CellFileError(
                path, "safety.limit", f"joint {limit.joint!r}: min {limit.min} is not below max {limit.max}"
            )
        if limit.max - limit.min <= 2 * cell.safety.position_margin:
            raise CellFileError(
                path,
                "safety.limit",
                f"joint {limit.joint!r}: range {limit.max - limit.min} leaves nothing between two margins of "
                f"{cell.safety.position_margin} (safety.position_margin)",
            )
    sections: list[tuple[str, dict[str, Any]]] = [("joints.home", dict(cell.joints.home))]
    if cell.calibration is not None:
        sections += [("calibration.base", dict(cell.calibration.base))]
        sections += [("calibration.range", dict(cell.calibration.range))]
        if cell.calibration.spread is not None:
            joint = cell.calibration.spread.joint
            sections += [("calibration.spread.joint", {joint: joint})]
    contact = cell.safety.contact
    sections += [("safety.contact.effort", dict(contact.effort))]
    sections += [("safety.contact.following", dict(contact.following))]
    for box in cell.safety.keep_out:
        if not box.ranges:
            raise CellFileError(path, f"safety.keep_out {box.name!r}", "bounds no joint; give ranges of some")
        sections.append((f"safety.keep_out {box.name!r}", dict(box.ranges)))
    for key, values in sections:
        for joint, value in values.items():
            if not seen and not cell.safety.limit:
                continue  # checked once the driver has reported its joints' limits
            if joint not in seen:
                raise CellFileError(
                    path,
                    key,
                    f"joint {joint!r} has no [[safety.limit]]; joints with limits: {', '.join(seen) or 'none'}",
                )
            _check_value(key, joint, value, cell, path)


def _check_value(key: str, joint: str, value: Any, cell: CellFile, path: Path | str) -> None:
    """Check one value of a joint against its limits: a configuration, a range of trial motion, a bound of a
    keep-out.
    """
    limit = next(limit for limit in cell.safety.limit if limit.joint == joint)
    margin = cell.safety.position_margin
    low, high = limit.min + margin, limit.max - margin
    if key in ("joints.home", "calibration.base") and not low <= value <= high:
        raise CellFileError(
            path,
            f"{key}.{joint}",
            f"is {value:g}; {low:g} to {high:g} is valid (its limits less the margin; in rad?)",
        )
    if key == "calibration.range" and value > limit.max - limit.min:
        raise CellFileError(
            path,
            f"{key}.{joint}",
            f"is {value:g}; at most {limit.max - limit.min:g}, all that its limits leave (in rad?)",
        )
    if key.startswith("safety.contact") and not value > 0.0:
        raise CellFileError(
            path,
            f"{key}.{joint}",
            f"is {value:g}; a threshold is above 0 (leave the joint out where it is to be learnt)",
        )
    if isinstance(value, tuple) and not value[0] < value[1]:
        raise CellFileError(path, f"{key}.{joint}", f"is {list(value)}; the first must be below the second")


def check_joints(cell: CellFile, joint_names: tuple[str, ...], path: Path | str = "<cell>") -> None:
    """Check a cell against the joints of its driver. Raises CellFileError."""
    limited = [limit.joint for limit in cell.safety.limit]
    if len(joint_names) > MAX_JOINTS:
        raise CellFileError(
            path,
            "joints.driver",
            f"driver {cell.joints.driver!r} has {len(joint_names)} joints; a cell has at most {MAX_JOINTS}",
        )
    for name in joint_names:
        if name not in limited:
            raise CellFileError(
                path,
                "safety.limit",
                f"joint {name!r} of driver {cell.joints.driver!r} has no limits; limits are given for: "
                f"{', '.join(limited) or 'none'}",
            )
    for name in limited:
        if name not in joint_names:
            raise CellFileError(
                path,
                "safety.limit",
                f"no joint {name!r} in driver {cell.joints.driver!r}; its joints: {', '.join(joint_names)}",
            )
    if cell.calibration is not None:
        missing = [name for name in joint_names if name not in cell.calibration.base]
        if missing:
            raise CellFileError(
                path,
                "calibration.base",
                f"missing for joint(s) {', '.join(missing)}; all of {', '.join(joint_names)} are needed",
            )


def _allowed(tree: dict[str, Any], text: str, key: str) -> str:
    """The valid keys or values, if msgspec's text lacks them."""
    path = ".".join(part.split("[")[0] for part in key.split("."))
    if "unknown field" in text:
        section = _SECTIONS.get(path)
        if section is None:
            return ""
        return f"; known keys: {', '.join(field.encode_name for field in msgspec.structs.fields(section))}"
    if "Invalid enum value" in text:
        place, _, name = path.rpartition(".")
        values = _valid_values(_SECTIONS.get(place), name)
        return f"; valid: {', '.join(values)}" if values else ""
    value: Any = tree
    for part in key.replace("[", ".[").split("."):
        if not part:
            continue
        try:
            value = value[int(part.strip("[]"))] if part.startswith("[") else value[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return ""
    return f", got {without_secrets(value)!r}" if not isinstance(value, dict | list) else ""


def _valid_values(section: type[msgspec.Struct] | None, name: str) -> list[str]:
    """Valid values of a key with a fixed set of values."""
    if section is None:
        return []
    info = msgspec.inspect.type_info(section)
    assert isinstance(info, msgspec.inspect.StructType)
    field_type = next((field.type for field in info.fields if field.encode_name == name), None)
    return [str(word) for word in field_type.values] if isinstance(field_type, msgspec.inspect.LiteralType) else []


_SECTIONS: dict[str, type[msgspec.Struct]] = {
    "": CellFile, "cell": CellSection, "joints": JointsSection, "camera": CameraSection, "servo": ServoSection,
    "safety": SafetySection, "safety.limit": JointLimit, "safety.keep_out": KeepOut,
    "safety.contact": ContactSection,
    "calibration": CalibrationSection, "calibration.spread": SpreadSection, "zenoh": ZenohSection,
    "zenoh.tls": TlsSection, "scene": SceneSection, "recording": RecordingSection,
}  # fmt: skip


def sections() -> dict[str, type[msgspec.Struct]]:
    """The structs of a cell file's sections by path, the top level's ``""`` first."""
    return dict(_SECTIONS)


__all__ = [
    "CellFile",
    "CellFileError",
    "check_cell",
    "check_joints",
    "check_limits",
    "load_cell_file",
    "sections",
]
