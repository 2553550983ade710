"""Command ``stereoservo init``: writes a commented cell configuration file (TOML) with the joint limits that the
driver reports.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from json import dumps as json_text
from pathlib import Path
from typing import Annotated, Any

import typer

from stereoservo.cli.output import CommandError, JsonOption, emit, log, shipped_or_path
from stereoservo.messages.addresses import Address
from stereoservo.messages.cell_file import CameraSection, check_joints, load_cell_file
from stereoservo.messages.directories import CELL_NAME
from stereoservo.messages.goals import DEFAULT_LAW
from stereoservo.messages.text_files import decoded_text
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraDescription, DriverContext, DriverError, JointDriverDescription

OPTION_KEY = re.compile(r"[A-Za-z0-9_-]+")


def init(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The cell file to write, e.g. cell.toml.")],
    name: Annotated[str, typer.Option(help="Name of the cell (default: the file's).")] = "",
    joint_driver: Annotated[str, typer.Option(help="See `stereoservo drivers`.")] = "fake",
    camera_driver: Annotated[str, typer.Option(help="See `stereoservo drivers`.")] = "fake",
    detector: Annotated[str, typer.Option(help="For camera drivers that deliver images.")] = "dots",
    camera: Annotated[list[str] | None, typer.Option(help="Camera names (default: left, right).")] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="An option of the joint driver, its value as in TOML; repeatable."),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="NAME|PATH",
            help="Begin with a copy of a cell, shipped (hil-can, hil-video, demo, …) or your own, and its comments.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write over an existing file.")] = False,
    json: JsonOption = False,
) -> None:
    """Write a cell file with every joint's limits and comments on what to set."""
    cell = name or file.stem
    if not CELL_NAME.fullmatch(cell):
        raise CommandError("argument", f"cell name {cell!r}: letters, digits, '_' and '-' are valid, up to 64 (--name)")
    if file.exists() and not force:
        raise CommandError("exists", f"{file} exists already; --force writes over it")
    if source is not None:
        _copy(source, file, cell, camera or option or joint_driver != "fake" or camera_driver != "fake")
        emit({"cell": cell, "file": str(file)}, f"wrote {file}; next: stereoservo doctor {file}", json)
        return
    cameras = camera or ["left", "right"]
    options = toml_options(option or [])
    context = DriverContext(MonotonicClock(), cell, Path("/nonexistent"), file.absolute().parent)
    try:
        joints: JointDriverDescription = plugins.load(plugins.JOINT_DRIVERS, joint_driver)(
            tomllib.loads(options), context
        ).describe()
    except DriverError as error:
        if error.code != "option" or (options and "is missing" not in str(error)):
            raise
        raise CommandError(
            "option",
            f"{error}. Driver {joint_driver!r} tells its joints only once it knows [joints.options]: give them "
            "(--option 'servo=[{name=\"j1\", id=1}]' --option port=/dev/ttyUSB0), begin with a copy of a shipped cell "
            "that uses it (--from hil-can for 'canopen', --from hil-video for 'canopen' and 'video'), or let "
            "`stereoservo setup` find the drives",
        ) from error
    described: CameraDescription = plugins.load(plugins.CAMERA_DRIVERS, camera_driver)(
        {}, DriverContext(MonotonicClock(), cell, Path("/nonexistent"), file.absolute().parent, camera=cameras[0])
    ).describe()
    detector_name = detector if described.delivers == "frames" else ""
    sections = [CameraSection(name, camera_driver, detector_name) for name in cameras]
    try:
        file.write_text(cell_text(cell, joint_driver, options, joints, sections))
    except OSError as error:
        raise CommandError("file", f"{file}: {error.strerror}") from error
    check_joints(load_cell_file(file), tuple(joint.name for joint in joints.joints), file)
    for text in joints.notes:
        log(text)
    emit({"cell": cell, "file": str(file)}, f"wrote {file}; next: stereoservo doctor {file}", json)


def _copy(source: str, file: Path, cell: str, contradicted: object) -> None:
    """Write a copy of a cell file, shipped or of a path, as ``cell``. Raises CommandError, CellFileError."""
    if contradicted:
        raise CommandError(
            "argument", "--from copies a cell as it is; drivers, cameras and options are changed in the copy"
        )
    path = shipped_or_path(source)
    load_cell_file(path)
    text, _ = decoded_text(path.read_bytes())
    renamed, count = re.subn(r'(?m)^(\[cell\]\s*\n(?:[^\[\n]*\n)*?name\s*=\s*)"[^"]*"', rf'\g<1>"{cell}"', text)
    if count != 1:
        raise CommandError("file", f'{path}: no line name = "…" under [cell], which is changed in a copy')
    try:
        file.write_text(renamed, encoding="utf-8")
    except OSError as error:
        raise CommandError("file", f"{file}: {error.strerror}") from error
    load_cell_file(file)


def toml_options(given: list[str]) -> str:
    """Lines of ``[joints.options]``; a value that is not TOML is a string. Raises CommandError."""
    lines = []
    for text in given:
        key, found, value = text.partition("=")
        line = f"{key} = {value}"
        try:
            tomllib.loads(line)
        except tomllib.TOMLDecodeError:
            line = f"{key} = {json_text(value)}"
        if not found or not OPTION_KEY.fullmatch(key):
            raise CommandError("argument", f"--option {Address(text)!r}; KEY=VALUE is valid, e.g. port=/dev/ttyUSB0")
        lines.append(line)
    try:
        tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as error:
        raise CommandError("argument", f"--option: {error}; each key once is valid") from error
    return "\n".join(lines)


def cell_text(
    cell: str,
    driver: str,
    options: str,
    joints: JointDriverDescription,
    cameras: list[CameraSection],
    base: Sequence[float] = (),
) -> str:
    """A cell file with comments. ``options``: lines of ``[joints.options]``; ``base``: of calibration [rad or m]."""
    lines = [
        "schema = 1",
        "",
        "[cell]",
        f'name = "{cell}"',
        "",
        "[joints]",
        f'driver = "{driver}"',
        *(
            ["[joints.options]", options]
            if options
            else ["# [joints.options]              # what the driver wants to know"]
        ),
        "# [joints.home]                 # home position by joint [rad or m]; default: calibration.base",
        "",
    ]
    for camera in cameras:
        lines += ["[[camera]]", f'name = "{camera.name}"', f'driver = "{camera.driver}"']
        if camera.detector:
            lines.append(f'detector = "{camera.detector}"')
        lines += [f'mount = "{camera.mount}"         # eye_to_hand, or eye_in_hand', ""]
        if camera.options:
            lines += ["[camera.options]", *toml_lines(camera.options, "camera.options"), ""]
    lines += [
        "[servo]",
        f"rate_hz = {min(joints.rate_hz, 250.0):g}                 # cycles of the loop a second",
        f'law = "{DEFAULT_LAW}"             # default law of goals, of: {", ".join(plugins.names(plugins.LAWS))}',
        "gain = 1.5                     # [1/s]",
        "tolerance_px = 0.25            # a goal is reached when every marker is this close ...",
        "hold_frames = 10               # ... for so many frames",
        "",
        "[safety]",
        "coast_s = 0.5                  # how long a law may run on prediction when no camera delivers",
        "position_margin = 0.01         # distance kept from every limit [rad or m]",
        "speed_scale = 1.0              # lowers every speed",
        "",
        "# Limits of the cell: at most those of the machine (given here). Say why where you lower one.",
    ]
    for joint in joints.joints:
        lines += [
            "[[safety.limit]]",
            f'joint = "{joint.name}"',
            f"min = {round(joint.position_min, 4)!r}",
            f"max = {round(joint.position_max, 4)!r}",
            f"velocity = {joint.velocity_max!r}",
            f"acceleration = {joint.acceleration_max!r}",
            "",
        ]
    lines += [
        "# What stops the arm when it meets something: learnt by the calibration's motions where the drives tell",
        "# efforts or following errors (see docs/safety.md). Thresholds of your own by joint come before these.",
        "# [safety.contact]",
        "# effort = { j1 = 12.0 }         # beyond its moving mean [N m or N]",
        "# following = { j1 = 0.02 }      # set less actual position [rad or m]",
        "# factor = 2.0                   # of what the motions showed",
        "",
        "# Trial motions: each joint moves alone from base, as far as the markers stay in view (see",
        "# docs/calibration.md). Choose base such that every camera sees the markers there.",
        "[calibration]",
        "stops = 9",
        "frames = 5",
        "",
        "[calibration.base]",
    ]
    base = base or joints.home or [_base(joint.position_min, joint.position_max) for joint in joints.joints]
    lines += [f"{joint.name} = {round(q, 4)!r}" for joint, q in zip(joints.joints, base, strict=True)]
    lines += ["", "# [calibration.range]           # state it where something stands in the way [rad or m]"]
    lines += [f"# {joint.name} = {_range(joint.position_min, joint.position_max)!r}" for joint in joints.joints]
    return "\n".join(lines) + "\n"


def toml_lines(table: Mapping[str, Any], section: str) -> list[str]:
    """Lines of a table of a TOML file, below the heading ``section``: its values, then its lists of tables."""
    lines, below = [], []
    for key, value in table.items():
        if isinstance(value, list | tuple) and value and isinstance(value[0], dict):
            for row in value:
                below += ["", f"[[{section}.{key}]]", *toml_lines(row, f"{section}.{key}")]
        elif isinstance(value, dict):
            below += ["", f"[{section}.{key}]", *toml_lines(value, f"{section}.{key}")]
        else:
            lines.append(f"{key} = {_toml_value(value)}")
    return lines + below


def _toml_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return json_text(value) if isinstance(value, str) else repr(value)


def _base(low: float, high: float) -> float:
    return round(min(max(0.0, low + 0.25 * (high - low)), high - 0.25 * (high - low)), 3)


def _range(low: float, high: float) -> float:
    return round(min(0.3, 0.2 * (high - low)), 3)
