"""Command ``stereoservo goal``: sends a goal to a cell (or asks whether it would be accepted), streams set-points to
it, prints its plan and progress, and waits for its end.
"""

from __future__ import annotations

import math
import re
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import msgspec
import typer

from stereoservo.cli import interruption
from stereoservo.cli.output import (
    CELL_OPTIONS,
    CellArgument,
    CellOptions,
    CommandError,
    emit,
    goals_beginning,
    log,
    log_hold,
    marker_ids,
    pairs,
    read_file,
    read_object,
)
from stereoservo.client import Client, ClientError, GoalHandle
from stereoservo.messages.discovery import find_daemon
from stereoservo.messages.goals import Approach, FeatureTarget, Goal, PlanReport, PointTarget, StreamedTarget
from stereoservo.messages.wire import MessageError, decode, encode
from stereoservo.ports import plugins

if TYPE_CHECKING:
    from stereoservo.daemon.jobs.recorded_set_points import SetPoints


KINDS = {"points": "points", "displacement": "displacement", "incidence": "incidence"}
"""Options that take a target as a file, and its kind."""
UNITS = {"--move": {"mm": 1e-3, "cm": 1e-2, "m": 1.0}, "--turn": {"deg": math.pi / 180.0, "rad": 1.0}}
"""Units of a step's components, in [m] and [rad]."""
SOURCES = ("triangulated", "predicted")
PLANNED_LAW = "trajectory"
"""Law whose plan can end in a chosen posture."""


class StreamLine(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One line of a stream: set-points, or points with the epoch of their model; ``stamp_s``: time at which they are
    valid.
    """

    stamp_s: float | None = None
    set_points: dict[str, dict[int, tuple[float, float]]] | None = None
    points: dict[int, tuple[float, float, float, float]] | None = None
    model_epoch: int | None = None


def target_tree(
    name: str,
    joints: list[str] | None,
    set_points: Path | None,
    files: dict[str, Path | None],
    relative_to: str | None,
    common: str | None,
    lines: str | None = None,
    planes: str | None = None,
    step: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The target in wire format. Exactly one of a name, joints, set-points, a ``step`` or a file of ``files`` must be
    given.
    """
    given = [bool(name), bool(joints), set_points is not None, bool(step), *(f is not None for f in files.values())]
    if sum(given) != 1:
        raise CommandError(
            "usage",
            "one of NAME (a taught goal), --move or --turn, --joint, --set-points, --images, --points, --displacement, "
            "--incidence, --follow or --file is needed",
        )
    if (relative_to or common or lines or planes) and not name:
        raise CommandError("usage", "--relative-to, --common, --lines and --planes go with NAME, a taught goal")
    if name:
        tree: dict[str, Any] = {"kind": "taught", "name": name}
        if relative_to is not None:
            tree["relative_to"] = relative_to
        if common is not None:
            tree["common"] = marker_ids(common, "--common")
        for key, text, least, most in (("lines", lines, 2, 2), ("planes", planes, 3, 64)):
            if text is not None:
                tree[key] = _id_groups(text, f"--{key}", least, most)
        return tree
    if step:
        return step
    if joints:
        return {"kind": "joints", "positions": pairs(joints, "--joint")}
    if set_points is not None:
        return {"kind": "features", "set_points": read_object(set_points)}
    kind, path = next((kind, path) for kind, path in files.items() if path is not None)
    if kind == "points" and str(path) in SOURCES:
        raise CommandError("usage", f"--points takes a file; {path} goes with --point-source")
    tree = read_object(path)
    valid = "step" if kind == "displacement" and "frame" in tree else KINDS[kind]
    if tree.get("kind", valid) != valid:
        raise CommandError("file", f"{path}: kind is {tree['kind']!r}; {valid!r} goes with --{kind}")
    matrix = tree.get("matrix")
    if kind == "displacement" and isinstance(matrix, list) and all(isinstance(row, list) for row in matrix):
        tree["matrix"] = [number for row in matrix for number in row]
    return {**tree, "kind": valid}


def step_tree(move: list[str] | None, turn: list[str] | None, frame: str | None, length: str) -> dict[str, Any]:
    """A step as a target in wire format, from ``z=+20mm`` and ``z=+10deg``; empty without one. Raises CommandError."""
    if not (move or turn):
        if frame or length:
            raise CommandError("usage", "--in and --length go with --move or --turn")
        return {}
    vectors = {"move": _along_axes(move, "--move", "z=+20mm"), "turn": _along_axes(turn, "--turn", "z=+10deg")}
    return {"kind": "step", "frame": frame or "tool", "length": length, **vectors}


def _along_axes(texts: list[str] | None, option: str, example: str) -> list[float]:
    """Components x, y, z [m or rad] of ``AXIS=NUMBER UNIT``, repeated or with commas; others are 0."""
    units, found = UNITS[option], dict.fromkeys("xyz", 0.0)
    for text in ",".join(texts or ()).split(",") if texts else ():
        match = re.fullmatch(r"([xyz])=([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?) ?([a-z°]+)", text.strip())
        if match is None or match[3] not in units or found[match[1]]:
            raise CommandError(
                "argument",
                f"{option} {text!r}: each of x, y, z at most once, a number and a unit ({', '.join(units)}) are valid, "
                f"{example} say",
            )
        found[match[1]] = float(match[2]) * units[match[3]]
    return list(found.values())


def _id_groups(text: str, what: str, least: int, most: int) -> list[list[int]]:
    """Parse ``400-401,402-407`` as groups of ids. Raises CommandError."""
    try:
        groups = [[int(part) for part in group.split("-")] for group in text.split(",")]
    except ValueError:
        groups = []
    if not groups or any(not least <= len(group) <= most for group in groups):
        count, example = (
            (f"{least}", "400-401,402-407") if least == most else (f"{least} or more", "400-401-406,402-403-408")
        )
        raise CommandError("argument", f"{what} {text!r}: groups of {count} ids are valid, {example} say")
    return groups


def adaptive(text: str) -> dict[str, float]:
    """Parse ``NEAR:FAR[:SLOPE]`` as an adaptive gain."""
    try:
        values = [float(part) for part in text.split(":")]
    except ValueError:
        values = []
    if len(values) not in (2, 3):
        raise CommandError("argument", f"--adaptive-gain {text!r}: NEAR:FAR or NEAR:FAR:SLOPE is valid, 4:0.8:30 say")
    return dict(zip(("near", "far", "slope"), values, strict=False))


def make_goal(target: dict[str, Any], **options: Any) -> Goal:
    """A goal with a new id; options that are None have the cell's defaults, those with a posture the planning law."""
    tree = {"id": str(uuid.uuid4()), "target": target, **options}
    given = {key: value for key, value in tree.items() if value is not None}
    if "posture" in given:
        given.setdefault("law", PLANNED_LAW)
    return decode(encode(given), Goal)  # NaN is refused, not dropped


def stream_lines(source: str) -> Iterator[tuple[float | None, StreamedTarget]]:
    """Set-points with their stamps from JSON lines of a file, or of stdin (``-``), as they arrive.

    Those of a file are paced by their stamps. Raises CommandError naming the line.
    """
    lines: Iterator[bytes]
    lines = iter(sys.stdin.buffer) if source == "-" else iter(read_file(Path(source)).splitlines())
    began, first = time.monotonic(), None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            found = decode(line, StreamLine)
        except MessageError as error:
            raise CommandError("stream", f"{source}: line {number}: {error}") from error
        target = _streamed(found, f"{source}: line {number}")
        if found.stamp_s is not None and source != "-":
            first = found.stamp_s if first is None else first
            time.sleep(max(0.0, found.stamp_s - first - (time.monotonic() - began)))
        yield found.stamp_s, target


def _streamed(line: StreamLine, where: str) -> StreamedTarget:
    if (line.set_points is None) == (line.points is None):
        given = "neither" if line.points is None else "both"
        raise CommandError("stream", f"{where}: {given} of set_points and points given; exactly one is valid")
    if line.set_points is not None:
        return FeatureTarget(line.set_points, line.model_epoch)
    if line.points is None or line.model_epoch is None:
        raise CommandError("stream", f"{where}: points are in the frame of a model; model_epoch is needed with them")
    return PointTarget(line.points, line.model_epoch)


# -- goal ------------------------------------------------------------------------------------------


# -- set-points in the image ---------------------------------------------------------------------------------
# Set-points of a goal from recorded images, for ``stereoservo goal CELL --images DIR``: mean marker pixels of every
# recorded camera, checked against the live cell.


FRAMES = 20


def read_images(cell: str, endpoint: str | None, images: Path, at_s: float, frames: int) -> tuple[SetPoints, ...]:
    """Set-points of every recorded camera; reports them on stderr.

    Raises CommandError, SetPointError, ImageFileError, DriverError, PluginError, CellFileError, NotRunningError.
    """
    from stereoservo.daemon.jobs.recorded_set_points import set_points_from_images  # OpenCV: only for this

    if cell.endswith(".toml"):
        path = Path(cell)
    elif endpoint is None:
        path = Path(find_daemon(cell).cell_path)
    else:
        raise CommandError(
            "usage",
            "--images needs the cell file, for its cameras' detectors, and the cell is on another host: run this there",
        )
    found = set_points_from_images(path, images, at_s, frames)
    for one in found:
        left_out = ", ".join(str(marker) for marker in one.left_out)
        log(
            f"camera {one.camera}: {len(one.pixels)} markers in {one.frames} frames from {one.at_s:.2f} s on"
            + (f"; markers {left_out} are in fewer than half of them, and left out" if left_out else "")
        )
    return found


def feature_tree(found: tuple[SetPoints, ...]) -> dict[str, Any]:
    """The set-points as a target on the wire."""
    points = {one.camera: {str(marker): list(pixel) for marker, pixel in one.pixels.items()} for one in found}
    return {"kind": "features", "set_points": points}


def require_cameras(client: Client, found: tuple[SetPoints, ...]) -> None:
    """Raise CommandError if a recording does not match a camera of the live cell in its current setup."""
    if not found:
        return
    cameras = {camera.name: (camera.width, camera.height) for camera in client.info().cameras}
    for one in found:
        if cameras.get(one.camera) != one.size:
            has = cameras.get(one.camera)
            live = "has no such camera" if has is None else f"has it with {has[0]}x{has[1]} px"
            raise CommandError(
                "other_cell",
                f"camera {one.camera!r} is recorded with pictures of {one.size[0]}x{one.size[1]} px; the cell {live}",
                camera=one.camera,
            )


Stream = Iterator[tuple[float | None, StreamedTarget]]
WAITING_LEASE_S = 2.0
"""The process that waits for a goal renews its lease: when it dies, the arm stops."""

TARGETS = ("file", "name", "move", "turn", "joint", "set_points", "points", "displacement", "incidence")
"""Options that are a target, without those of streams and images."""
FOR_POSTURES = ("taught", "features")
"""Kinds of targets whose postures are listed."""


@dataclass(frozen=True)
class GoalOptions:
    """Target, law and terms of a goal, as options of the command line."""

    name: Annotated[
        str, typer.Argument(metavar="[NAME]", help="Name of a taught goal.", autocompletion=goals_beginning)
    ] = ""
    relative_to: Annotated[
        str | None, typer.Option(help="Of a taught goal: workpiece (which may have moved) or cameras (which have).")
    ] = None
    common: Annotated[
        str | None,
        typer.Option(metavar="IDS", help="Markers seen when it was taught and now: 10,11,12 (default: all)."),
    ] = None
    lines: Annotated[
        str | None,
        typer.Option(metavar="A-B,...", help="Edges seen when it was taught and now, each by two ids on it."),
    ] = None
    planes: Annotated[
        str | None,
        typer.Option(metavar="A-B-C,...", help="Faces, each by ids of points on it; others then than now will do."),
    ] = None
    move: Annotated[
        list[str] | None,
        typer.Option("--move", metavar="AXIS=LENGTH", help="Move along an axis of --in: z=+20mm; repeatable."),
    ] = None
    turn: Annotated[
        list[str] | None,
        typer.Option("--turn", metavar="AXIS=ANGLE", help="Turn about an axis of --in, at the middle of the markers."),
    ] = None
    in_frame: Annotated[
        str | None,
        typer.Option("--in", metavar="FRAME", help="tool (default), base, camera:NAME, or scene:A-B-C by three ids."),
    ] = None
    length: Annotated[
        str,
        typer.Option(
            metavar="WHAT:OF=METRES", help="For --move: a known length, markers:10,11=0.05 (default: the cell's)."
        ),
    ] = ""
    joint: Annotated[
        list[str] | None, typer.Option("--joint", metavar="NAME=RAD", help="Joint position [rad or m]; repeatable.")
    ] = None
    set_points: Annotated[
        Path | None,
        typer.Option("--set-points", metavar="FILE", help='JSON: {"camera": {"marker": [u, v]}} in pixels.'),
    ] = None
    images: Annotated[
        Path | None,
        typer.Option(
            "--images", metavar="DIR", help="Set-points out of pictures recorded by `record --images`, at rest."
        ),
    ] = None
    at: Annotated[float, typer.Option("--at", help="With --images: seconds from their beginning.", min=0.0)] = 0.0
    frames: Annotated[
        int, typer.Option("--frames", help="With --images: frames a camera to average.", min=1, max=1000)
    ] = FRAMES
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="FILE", help='JSON: {"points": {"marker": [x, y, z, w]}, "model_epoch": N}.'),
    ] = None
    displacement: Annotated[
        Path | None,
        typer.Option(
            "--displacement",
            metavar="FILE",
            help='JSON: {"matrix": 4x4 rigid [m], "frame": as --in}, or projective, "model_epoch" or "basis": 5 ids.',
        ),
    ] = None
    incidence: Annotated[
        Path | None, typer.Option("--incidence", metavar="FILE", help='JSON: {"incidences": […], "secondary": …}.')
    ] = None
    follow_file: Annotated[
        str | None,
        typer.Option(
            "--follow",
            metavar="FILE|-",
            help='A moving target: JSON lines {"stamp_s": …, "set_points" or "points": …}.',
        ),
    ] = None
    follow_markers: Annotated[
        str | None,
        typer.Option(
            metavar="IDS",
            help="Go with a target that moves: its markers, 14,15,16 (cameras on the arm: of the body that they see).",
        ),
    ] = None
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="A whole goal as JSON.")] = None
    law: Annotated[
        str | None,
        typer.Option(help=f"Installed here: {', '.join(plugins.names(plugins.LAWS))} (default: the cell's)."),
    ] = None
    point_source: Annotated[str | None, typer.Option(help="Where points come from: triangulated or predicted.")] = None
    jacobian: Annotated[str | None, typer.Option(help="current, desired, mean or fixed-depth, for laws in images.")] = (
        None
    )
    centre: Annotated[
        str | None,
        typer.Option(metavar="IDS", help="Markers whose middle moves on the line (default: all of the goal)."),
    ] = None
    camera: Annotated[
        list[str] | None, typer.Option("--camera", help="Camera that may be used; repeatable (default: all).")
    ] = None
    profile: Annotated[
        str | None, typer.Option(help="linear, exponential, translation-first, …, for laws that follow a plan.")
    ] = None
    posture: Annotated[
        int | None,
        typer.Option(metavar="N", help="End in the posture that `stereoservo ik` lists as number N (law trajectory)."),
    ] = None
    gain: Annotated[float | None, typer.Option(help="Gain [1/s].")] = None
    adaptive_gain: Annotated[
        str | None, typer.Option(metavar="NEAR:FAR[:SLOPE]", help="Gain that falls with the error [1/s].")
    ] = None
    damping: Annotated[
        float | None,
        typer.Option(
            metavar="K",
            help="Share [0, 1) of the measured velocity that is taken back, for drives that lag; gain / (1 + K).",
        ),
    ] = None
    tolerance: Annotated[float | None, typer.Option(help="Largest pixel distance at the goal [px].")] = None
    hold_frames: Annotated[int | None, typer.Option(help="Frames for which the tolerance must hold.")] = None
    speed_scale: Annotated[float, typer.Option(help="Lowers the speed, (0, 1].")] = 1.0
    lease: Annotated[
        float | None,
        typer.Option(
            help=f"Abort when this client is silent for so long [s] (default: {WAITING_LEASE_S:g} while it waits, "
            f"none with --no-wait)."
        ),
    ] = None
    time_limit: Annotated[float | None, typer.Option(help="Abort after so long [s].")] = None
    queue: Annotated[bool, typer.Option("--queue", help="After the active goal, not instead of it.")] = False
    blend: Annotated[
        float | None, typer.Option(metavar="PX", help="Go on to the next goal below this error, without a stop.")
    ] = None
    acknowledge: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Reached, wait so long for `acknowledge` before going on.")
    ] = None
    check: Annotated[bool, typer.Option("--check", help="Only say what it would do; nothing moves.")] = False
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait for its end.")] = True


GOAL_OPTIONS = GoalOptions()


def goal(cell: CellArgument, given: GoalOptions = GOAL_OPTIONS, options: CellOptions = CELL_OPTIONS) -> None:
    """Send a goal and wait for its end. Ctrl-C cancels it."""
    _require_images(given.images, given.at, given.frames)
    stream: Stream | None = None
    found: tuple[SetPoints, ...] = ()
    target: dict[str, Any] = {}
    others = any(getattr(given, option) for option in TARGETS)
    if given.follow_file is not None:
        if others or given.images:
            raise CommandError("usage", "--follow is a target of its own; its first line is where it begins")
        target, stream = _followed(given.follow_file)
    elif given.images is not None:
        if others:
            raise CommandError("usage", "--images is a target of its own; leave the others out")
        found = read_images(cell, options.endpoint, given.images, given.at, given.frames)
        target = feature_tree(found)
    elif given.file is None:
        files = {"points": given.points, "displacement": given.displacement, "incidence": given.incidence}
        relative = (given.relative_to, given.common, given.lines, given.planes)
        step = step_tree(given.move, given.turn, given.in_frame, given.length)
        target = target_tree(given.name, given.joint, given.set_points, files, *relative, step)
    local = target if given.file is None and stream is None and options.endpoint is None else {}
    ends_in = None if given.posture is None else _ends_in(cell, local, given.posture, options.operator)
    requested = (
        _requested(given, target, ends_in) if given.file is None else decode(encode(read_object(given.file)), Goal)
    )
    with options.client(cell, interruption.check) as client:
        require_cameras(client, found)
        if given.check or requested.check:
            _checked(client, requested, options.json)
        else:
            _run(client, requested, stream, given.wait, options.json)


def _requested(given: GoalOptions, target: dict[str, Any], ends_in: dict[str, float] | None) -> Goal:
    """The goal of the options, with its ``target`` and the posture in which it ends."""
    return make_goal(
        target, law=given.law, points=given.point_source, jacobian=given.jacobian,
        centre=None if given.centre is None else {"markers": marker_ids(given.centre, "--centre")},
        cameras=given.camera or None, profile=given.profile, gain=_one_gain(given.gain, given.adaptive_gain),
        damping=given.damping, posture=ends_in, tolerance_px=given.tolerance, hold_frames=given.hold_frames,
        speed_scale=given.speed_scale, lease_s=given.lease, time_limit_s=given.time_limit,
        mode="queue" if given.queue else "preempt", blend_px=given.blend, acknowledge_s=given.acknowledge,
        follow_markers=_followed_ids(given.follow_markers),
    )  # fmt: skip


def _require_images(images: Path | None, at: float, frames: int) -> None:
    if images is None and (at or frames != FRAMES):
        raise CommandError("usage", "--at and --frames go with --images DIR")


def _ends_in(cell: str, target: dict[str, Any], number: int, operator: str | None) -> dict[str, float]:
    """Joints by name of the posture ``number`` that reaches a target in wire format. Raises CommandError."""
    if target.get("kind") not in FOR_POSTURES:
        raise CommandError("usage", "--posture goes with NAME or --set-points, on the cell's host")
    from stereoservo.cli.ik import posture  # numerics: only for this

    return posture(cell, target, number, operator)


def _followed_ids(text: str | None) -> list[int] | None:
    return None if text is None else marker_ids(text, "--follow-markers")


def _one_gain(gain: float | None, adaptive_gain: str | None) -> float | dict[str, float] | None:
    if gain is not None and adaptive_gain is not None:
        raise CommandError("usage", "--gain and --adaptive-gain: one of them")
    return gain if adaptive_gain is None else adaptive(adaptive_gain)


def _checked(client: Client, requested: Goal, as_json: bool) -> None:
    reply = client.check(requested)
    emit(reply, reply.message + ("" if reply.plan is None else f"\n{plan_table(reply.plan)}"), as_json)


def _followed(source: str) -> tuple[dict[str, Any], Stream]:
    """First target of a stream, in wire format, and the stream. Raises CommandError for an empty one."""
    stream = stream_lines(source)
    first = next(stream, None)
    if first is None:
        raise CommandError("stream", f"{source}: holds no set-points; a line at least is needed")
    target = cast("dict[str, Any]", msgspec.to_builtins(first[1], str_keys=True))
    return target, chain([first], stream)


def _run(client: Client, requested: Goal, stream: Stream | None, wait: bool, as_json: bool) -> None:
    if wait and requested.lease_s is None:
        requested = msgspec.structs.replace(requested, lease_s=WAITING_LEASE_S)
    try:
        handle = client.send(requested)
        log(f"goal {handle.id} accepted" + (f": {handle.message}" if handle.message != "accepted" else ""))
        if stream is not None:
            log(f"{handle.stream(stream)} set-points followed")
        if wait:
            follow(handle, as_json, client.cell)
            if requested.acknowledge_s is not None:
                log(f"it waits there for `stereoservo acknowledge {client.cell} {handle.id}`")
        else:
            emit({"id": handle.id, "accepted": True}, handle.id, as_json)
    except KeyboardInterrupt:
        with suppress(ClientError):  # not accepted yet, or already ended
            client.cancel(requested.id)
        raise


def follow(handle: GoalHandle, as_json: bool, cell: str) -> None:
    """Wait for a goal's end and print it; holds are printed, too. Raises CommandError unless it was reached."""
    result = handle.wait(progress=lambda event: log_hold(event.kind, event.message, cell))
    if result.outcome != "reached":
        tree = cast("dict[str, Any]", msgspec.to_builtins(result))
        raise CommandError("goal_" + result.outcome, f"goal {result.outcome}: {result.why}", goal=tree)
    error = "" if result.error_px is None else f", error {result.error_px:.3f} px"
    _, _, made = result.message.partition("; ")
    emit(result, f"reached in {result.seconds:.2f} s{error}" + (f"\n{made}" if made else ""), as_json)


def plan_table(plan: PlanReport) -> str:
    """Path, duration, and the closest approach to every limit, as text."""
    lines = [f"law {plan.law}, path {plan.way}, {plan.seconds:.2f} s"]
    if not plan.approaches:
        return lines[0]
    rows: list[tuple[str, ...]] = [("limit", "of", "nearest", "limit at", "clearance", "at path")]
    rows += [_row(approach) for approach in plan.approaches]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines += [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
    return "\n".join(lines)


def _row(approach: Approach) -> tuple[str, ...]:
    unit = approach.unit
    of = approach.subject if approach.marker is None else f"{approach.subject}, marker {approach.marker}"
    return (
        approach.code,
        of,
        f"{approach.value:.4g} {unit}",
        f"{approach.limit:.4g} {unit}",
        f"{approach.room:.4g} {unit}",
        f"{100.0 * approach.share:.0f} %",
    )
