"""State, event, feature and reply messages of the daemon, and the JSON codec of every message on zenoh."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, inspect

from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.goals import (
    LAW_TITLE,
    AcknowledgeGoal,
    AuxiliarySpec,
    Calibrate,
    CancelGoal,
    Command,
    Disable,
    Enable,
    Goal,
    Hold,
    Home,
    Jog,
    MarkerId,
    Name,
    OrderAuxiliary,
    PlanReport,
    RenewGoal,
    Reset,
    Resume,
    Stop,
    Teach,
    UpdateGoal,
)
from stereoservo.messages.learning import LearningState
from stereoservo.messages.reasons import Reason
from stereoservo.messages.recording_request import ImagesRecorded
from stereoservo.messages.status import Halt, Health, RefinementState, StatusHeader

ENCODING = "application/json"
MAX_PAYLOAD_BYTES = 65_536

Drawn = tuple[float, float, float]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)

_T = TypeVar("_T")
_NOT_FINITE = re.compile(rb"(?<![\w\"])(-?NaN|[+-]?Infinity|-?inf|nan)(?![\w\"])")


COMMANDS: dict[str, type[Command]] = {
    "enable": Enable,
    "disable": Disable,
    "hold": Hold,
    "resume": Resume,
    "reset": Reset,
    "jog": Jog,
    "auxiliary": OrderAuxiliary,
    "home": Home,
    "calibrate": Calibrate,
    "teach": Teach,
    "cancel": CancelGoal,
    "renew": RenewGoal,
    "update": UpdateGoal,
    "acknowledge": AcknowledgeGoal,
}
"""Types of the payloads of ``command/<verb>/<operator>``; the ``command`` tag may be omitted."""


class Record(msgspec.Struct, frozen=True, tag="record", tag_field="command", forbid_unknown_fields=True):
    """Start or stop a flight recording. Handled by the gateway, not forwarded to the core.

    ``images``: also record the cameras' frames, in the directory ``NAME.images`` beside the recording ``NAME.mcap``.
    """

    on: bool = True
    images: bool = False


class Synthesise(msgspec.Struct, frozen=True, tag="synthesise", tag_field="command", forbid_unknown_fields=True):
    """Make the goal ``name`` from CAD drawings. Handled by the gateway, not forwarded to the core.

    ``workpiece``, ``tool``: marker -> (x, y, z) in the coordinates of the respective drawing, with one unit of length
    for both.
    ``pose``: 4x4, row-major: from the tool's drawing to the workpiece's, in the aligned position. The workpiece's
    markers must be visible now.
    """

    name: Name
    workpiece: dict[MarkerId, Drawn]
    tool: dict[MarkerId, Drawn]
    pose: Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)] = IDENTITY


class Restore(msgspec.Struct, frozen=True, tag="restore", tag_field="command", forbid_unknown_fields=True):
    """Restore the calibrated model from which the one in use was refined on-line. Handled by the gateway."""


class MessageError(ValueError):
    """An invalid message: the text contains the place in it, the value and valid values."""


class JointInfo(msgspec.Struct, frozen=True):
    """A joint of the cell; limits [rad or m, s]."""

    name: str
    kind: str
    position_min: float
    position_max: float
    velocity_max: float


class CameraInfo(msgspec.Struct, frozen=True):
    """A camera of the cell; size [px]."""

    name: str
    width: int
    height: int
    rate_hz: float
    mount: str
    marker_ids: tuple[int, ...]


class ModelInfo(msgspec.Struct, frozen=True):
    """The model in use."""

    epoch: int
    stratum: str
    marker_ids: tuple[int, ...]
    created: str
    rms_px: float | None = None
    path: str = ""


class TaughtInfo(msgspec.Struct, frozen=True):
    """A taught goal and the model it was taught with. ``standing``: markers besides body and ``tool``."""

    name: str
    model_epoch: int
    created: str
    standing: tuple[int, ...] = ()
    tool: tuple[int, ...] = ()


class CellInfo(msgspec.Struct, frozen=True):
    """Description of a cell, constant from step to step; ``get …/info``."""

    cell: str
    version: str
    boot: str
    joints: tuple[JointInfo, ...]
    cameras: tuple[CameraInfo, ...]
    laws: tuple[str, ...]
    law: str
    tolerance_px: float
    model: ModelInfo | None = None
    taught: tuple[TaughtInfo, ...] = ()
    can_calibrate: bool = False
    can_home: bool = False
    dry_run: bool = False
    commissioning: bool = False
    recording: str = ""
    auxiliary: tuple[AuxiliarySpec, ...] = ()
    """Auxiliary joints and digital outputs, which are commanded by `command/auxiliary`."""


class LoopInfo(msgspec.Struct, frozen=True):
    """Statistics of the servo loop since its start; lateness and work [us]."""

    rate_hz: float
    cycles: int
    overruns: int
    skipped: int
    lateness_us: dict[str, float]
    work_us: dict[str, float]
    records_dropped: int = 0


class StateMessage(StatusHeader, frozen=True):
    """The cell's state. ``t_ns`` monotonic on the daemon's host, ``t_wall`` [s since 1970].

    Values whose source is lost are left out: of joints ``joints``, ``velocities``, ``efforts``, ``following_errors``
    and ``auxiliary``; of a camera its entry in ``visible``, ``innovation_px`` and ``health.cameras``. Without any
    camera ``error_px`` is None and an ``ok`` diagnosis of the model becomes ``unknown``.
    """

    cell: str
    boot: str
    t_wall: float
    joints: dict[str, float]
    velocities: dict[str, float]
    command: dict[str, float]
    error_px: float | None
    task_error: tuple[float, ...]
    innovation_px: dict[str, float]
    visible: dict[str, int]
    loop: LoopInfo
    driver_active: bool = False
    servo_alive: bool = True
    dry_run: bool = False
    differences: tuple[str, ...] = ()
    last_event: int = 0
    notes: tuple[str, ...] = ()
    """Remarks for the administrator of the cell, for instance on damaged files and full disks."""
    progress: float | None = None
    """Path parameter of the active goal, 0 to 1, if it is known."""
    seconds_left: float | None = None
    efforts: dict[str, float] = msgspec.field(default_factory=dict)
    """As the drives report them [N m or N, or fractions of the rated torque]; empty if they report none."""
    following_errors: dict[str, float] = msgspec.field(default_factory=dict)
    """Set less actual position [rad or m]."""
    effort_limits: dict[str, float] = msgspec.field(default_factory=dict)
    """Largest deviation of efforts from their moving mean before the arm stops for a collision; absent if unknown."""
    following_limits: dict[str, float] = msgspec.field(default_factory=dict)
    """Largest following errors before the arm stops for a collision."""
    health: Health = Health()
    """Agreement of the images with the model, by camera; if they disagree, the explanation and the reaction."""
    auxiliary: dict[str, float] = msgspec.field(default_factory=dict)
    """Auxiliary joints [rad or m] and digital outputs (0 or 1), as the driver reports them."""
    refused_messages: int = 0
    """Messages that the gateway has rejected since its start: not JSON, of a wrong shape, on a wrong key."""
    refinement: RefinementState | None = None
    """With `[calibration] refine`; None: there is no on-line refinement."""
    learning: LearningState | None = None
    """Progress of the calibration that is running; None: there is none."""
    joints_age_s: float | None = None
    """Age of the newest joint sample [s]; None: there was none yet."""
    camera_age_s: dict[str, float | None] = msgspec.field(default_factory=dict)
    """For each camera, time [s] since the shutter of its newest frame; None: there was none yet."""
    halt: Halt | None = None
    """Who requested that the arm is stopped or held, while it is."""


class FeaturesMessage(msgspec.Struct, frozen=True):
    """Markers of one frame: pixels (u, v) [px], integer = pixel centre; ``sigmas`` [px] of one axis."""

    camera: str
    seq: int
    t_shutter_ns: int
    t_received_ns: int
    t_wall: float
    ids: tuple[int, ...]
    pixels: tuple[tuple[float, float], ...]
    sigmas: tuple[float, ...]


class PreviewInfo(msgspec.Struct, frozen=True):
    """Attachment of a picture on ``preview/<camera>``, whose payload is a JPEG of one frame, possibly reduced in size.

    ``width``, ``height``: of the frame [px]; all pixels of the other messages refer to it.
    """

    camera: str
    seq: int
    t_shutter_ns: int
    t_wall: float
    width: int
    height: int


class CalibrationResult(msgspec.Struct, frozen=True):
    """Result of a calibration.

    ``covariance_ok``: the residuals are explained by the measurement noise (chi-square).
    ``verdict``: what the model can be used for, in plain words, with ``grade`` good, usable or not.
    ``seconds``: duration of the fit.
    ``report`` (a page), ``figures`` (for programs), ``trials``: files on the daemon's host; the report exists once the
    event ``calibration_report`` was sent.
    """

    rms_px: float
    per_joint_px: dict[str, float]
    covariance_ok: bool
    model: str
    epoch: int
    stratum: str
    chi2: float
    degrees_of_freedom: int
    measurements: int
    parameters: int
    outliers: int
    joints: int
    images: int
    seconds: float
    verdict: str = ""
    grade: str = ""
    report: str = ""
    trials: str = ""
    figures: str = ""


class EventMessage(msgspec.Struct, frozen=True):
    """An event, numbered per ``boot`` without gaps. ``id``: the goal that it concerns."""

    seq: int
    boot: str
    t_ns: int
    t_wall: float
    kind: str
    message: str = ""
    id: str = ""
    request: int = -1
    operator: str = ""
    accepted: bool | None = None
    reasons: tuple[Reason, ...] = ()
    name: str = ""
    error_px: float | None = None
    progress: float | None = None
    origin: str = "core"
    calibration: CalibrationResult | None = None
    check: CheckReport | None = None
    reset: ZeroReset | None = None
    images: ImagesRecorded | None = None


class EventList(msgspec.Struct, frozen=True):
    """Reply to ``get …/event?from=N``: at most a few hundred; ``next`` is where to continue, ``first`` the oldest
    kept.
    """

    boot: str
    first: int
    next: int
    events: tuple[EventMessage, ...]


class Reply(msgspec.Struct, frozen=True):
    """Answer to a goal or command. If it is refused: ``reasons`` of the core, or ``problems`` of the message itself.

    ``plan``: the expected course of a goal, if it was planned.
    """

    accepted: bool
    message: str = ""
    id: str = ""
    request: int = -1
    reasons: tuple[Reason, ...] = ()
    problems: tuple[str, ...] = ()
    boot: str = ""
    plan: PlanReport | None = None


class RunningGoal(msgspec.Struct, frozen=True):
    """A goal that was accepted and has not ended, of this ``operator``: taught ones as the resolved set-points, moved
    ones (``update``) as they were sent. ``plan``: as in its reply.
    """

    goal: Goal
    operator: str = ""
    plan: PlanReport | None = None


class RunningGoals(msgspec.Struct, frozen=True):
    """Reply to ``get …/goals``: goals that were accepted and have not ended, the oldest first."""

    goals: tuple[RunningGoal, ...] = ()


SCHEMAS: dict[str, Any] = {
    "goal": Goal,
    "goals": RunningGoals,
    "state": StateMessage,
    "event": EventMessage,
    "events": EventList,
    "features": FeaturesMessage,
    "preview": PreviewInfo,
    "info": CellInfo,
    "reply": Reply,
    "command-record": Record,
    "command-stop": Stop,
    "command-synthesise": Synthesise,
    "command-restore": Restore,
    **{f"command-{verb}": kind for verb, kind in COMMANDS.items()},
}


def schema(name: str, laws: Sequence[str]) -> bytes:
    """The JSON Schema of a message as JSON, in which a law is one of ``laws``.

    Raises MessageError with the existing names.
    """
    kind = SCHEMAS.get(name)
    if kind is None:
        raise MessageError(f"no schema {name!r}; there are: {', '.join(SCHEMAS)}")
    tree = msgspec.json.schema(kind)
    _list_laws(tree, list(laws))
    return msgspec.json.encode(tree)


def _list_laws(tree: Any, laws: list[str]) -> None:
    """Insert ``laws`` as the valid values, in place, wherever a schema contains the name of a law."""
    if isinstance(tree, dict):
        if tree.get("title") == LAW_TITLE:
            tree["enum"] = laws
        for branch in tree.values():
            _list_laws(branch, laws)
    elif isinstance(tree, list):
        for branch in tree:
            _list_laws(branch, laws)


def encode(message: Any) -> bytes:
    """A message as JSON. Raises MessageError for a number that is not finite (JSON would turn it into
    null).
    """
    tree = msgspec.to_builtins(message)
    require_finite(tree)
    return msgspec.json.encode(tree)


def require_finite(tree: Any, where: str = "") -> None:
    """Raises MessageError naming the place of the first number that is not finite."""
    if isinstance(tree, float):
        if not math.isfinite(tree):
            raise MessageError(f"{where or 'value'} is {tree}; finite numbers are valid")
    elif isinstance(tree, dict):
        for key, value in tree.items():
            require_finite(value, f"{where}.{key}" if where else str(key))
    elif isinstance(tree, list | tuple):
        for index, value in enumerate(tree):
            require_finite(value, f"{where}[{index}]")


def decode(data: bytes, kind: type[_T]) -> _T:
    """Decode a message. The struct determines the strictness: commands and goals reject unknown fields, the others do
    not.

    Raises MessageError for any invalid bytes: too large, not JSON, a number that is not finite, a field that does not
    fit.
    """
    if len(data) > MAX_PAYLOAD_BYTES:
        raise MessageError(f"payload of {len(data)} bytes; at most {MAX_PAYLOAD_BYTES} are taken")
    found = read(data, kind)
    _require_bounded(msgspec.to_builtins(found, str_keys=True))
    return found


def read(data: bytes, kind: type[_T]) -> _T:
    """Decode a message of the daemon, without a size limit. Raises MessageError like :func:`decode`, for any invalid
    bytes.
    """
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.ValidationError as error:
        raise MessageError(_validation_error(str(error), data, kind)) from error
    except Exception as error:  # the decoder's errors have no common class
        raise MessageError(_undecodable(error, data)) from error


def _undecodable(error: Exception, data: bytes) -> str:
    """Reason why ``data`` is not valid JSON."""
    if isinstance(error, RecursionError):
        return "payload is nested too deeply; a message has few levels"
    if isinstance(error, UnicodeDecodeError):
        return f"payload is not UTF-8: {error.reason} 0x{error.object[error.start]:02x}"
    if match := _NOT_FINITE.search(data):
        return f"{match[0].decode()} is not a JSON number; finite numbers are valid"
    return f"payload is not JSON: {error}"


def _validation_error(error: str, data: bytes, kind: Any) -> str:
    """Validation error with its place, the given value, and the valid values."""
    text, _, where = error.partition(" - at `")
    if where.startswith("key` in `"):
        return f"a key of {where.removeprefix('key` in `$.').rstrip('`')}: {text}"
    place = where.rstrip("`").removeprefix("$").lstrip(".")
    try:
        value: Any = msgspec.json.decode(data)
    except (
        Exception
    ):  # values that the typed decoder, which ends at the first error, did not reach; only the place is named
        return f"{place}: {text}" if place else text
    at = f"{place}: " if place else ""
    parts = place.replace("[", ".[").split(".") if place else []
    if "field `" in text:  # an unknown one, or a missing one
        known = _keys(_type_at(kind, value, parts), _value_at(value, parts), text.split("`")[1])
        return at + text + (f"; {known}" if known else "")
    given = _value_at(value, parts)
    value_text = "" if given is None or isinstance(given, dict | list) or repr(given) in text else f", got {given!r}"
    values = _valid_values(_type_at(kind, value, parts), parts[-1]) if text.startswith("Invalid ") and parts else ()
    return at + text + value_text + (f"; valid: {', '.join(values)}" if values else "")


_described = functools.cache(inspect.type_info)


def _members(found: Any) -> list[Any]:
    """The member types of a type ``found``, which may be a union."""
    if isinstance(found, inspect.Metadata):
        return _members(found.type)
    if isinstance(found, inspect.UnionType):
        return [member for part in found.types for member in _members(part)]
    return [] if found is None else [found]


def _structs(found: Any) -> list[inspect.StructType]:
    return [member for member in _members(found) if isinstance(member, inspect.StructType)]


def _struct_of(found: Any, value: Any) -> inspect.StructType | None:
    """The struct of type ``found`` for ``value``, by its tag if there are several."""
    structs = _structs(found)
    if len(structs) == 1:
        return structs[0]
    given = value if isinstance(value, dict) else {}
    return next((s for s in structs if s.tag_field and given.get(s.tag_field) == s.tag), None)


def _value_at(value: Any, parts: Sequence[str]) -> Any:
    """The value at a place of a decoded message; None if that is unknown."""
    for part in parts:
        if isinstance(value, list) and part.startswith("[") and part[1:-1].isdigit():
            value = value[int(part[1:-1])]
        else:
            value = value.get(part) if isinstance(value, dict) else None
    return value


def _type_at(kind: Any, value: Any, parts: Sequence[str]) -> Any:
    """The type expected at a place of a message of ``kind``, for which ``value`` was given; for a tag, the type of its
    object. None if it cannot be determined.
    """
    found: Any = _described(kind)
    for k, part in enumerate(parts):
        if part.startswith("["):
            inner = [getattr(member, "item_type", getattr(member, "value_type", None)) for member in _members(found)]
            found = next(filter(None, inner), None)
        elif any(struct.tag_field == part for struct in _structs(found)):
            return found
        else:
            struct = _struct_of(found, _value_at(value, parts[:k]))
            fields = () if struct is None else struct.fields
            found = next((field.type for field in fields if field.encode_name == part), None)
    return found


def _keys(found: Any, value: Any, missing: str) -> str:
    """The keys of an object of type ``found``, or the valid values of its tag if that is ``missing``."""
    struct = _struct_of(found, value)
    if struct is None:
        values = _valid_values(found, missing)
        return f"valid: {', '.join(values)}" if values else ""
    return f"known: {', '.join(field.encode_name for field in struct.fields)}"


def _valid_values(found: Any, name: str) -> tuple[str, ...]:
    """The valid values of the key ``name`` of type ``found``; empty if its values are not a fixed set."""
    tags = tuple(str(struct.tag) for struct in _structs(found) if struct.tag_field == name)
    return tags or tuple(
        str(word)
        for member in _members(found)
        if isinstance(member, inspect.LiteralType)
        for word in member.values
        if isinstance(word, str)
    )


def _require_bounded(tree: Any) -> None:
    """Raises MessageError for an integer that does not fit 64 bits: no later stage could represent it."""
    if isinstance(tree, int):
        if not -(1 << 63) <= tree < 1 << 63:
            raise MessageError(f"integer {tree} is out of range; -2^63 to 2^63 - 1 are valid")
    elif isinstance(tree, dict):
        for value in tree.values():
            _require_bounded(value)
    elif isinstance(tree, list | tuple):
        for value in tree:
            _require_bounded(value)


def decode_command(verb: str, data: bytes) -> Command:
    """The payload of ``command/<verb>``; an empty one means ``{}``. Raises MessageError."""
    kind: Any = COMMANDS[verb]
    command: Command = decode(data or b"{}", kind)
    return command
