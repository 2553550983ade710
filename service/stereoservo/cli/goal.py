"""``stereoservo goal``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import msgspec
import typer

from stereoservo.cli import interruption
from stereoservo.cli.goal_images import FRAMES, feature_tree, read_images, require_cameras
from stereoservo.cli.goal_input import (
    adaptive,
    make_goal,
    numbers,
    read,
    stream_lines,
    target_tree,
)
from stereoservo.cli.goal_text import plan_table
from stereoservo.cli.output import (
    CellArgument,
    CommandError,
    EndpointOption,
    JsonOption,
    OperatorOption,
    emit,
    note,
)
from stereoservo.gateway.client import Client, ClientError, GoalHandle
from stereoservo.gateway.messages import decode
from stereoservo.runtime.commands import LAWS, Goal, StreamedTarget

if TYPE_CHECKING:
    from stereoservo.runtime.image_set_points import SetPoints

WAITING_LEASE_S = 2.0
"""Who waits for a goal stands behind it: when that process dies, the arm stops."""


def goal(
    cell: CellArgument,
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="Name of a taught goal.")] = "",
    relative_to: Annotated[
        str | None,
        typer.Option(help="Of a taught goal: workpiece (which may have moved) or cameras (which have)."),
    ] = None,
    common: Annotated[
        str | None,
        typer.Option(metavar="IDS", help="Markers seen when it was taught and now: 10,11,12 (default: all)."),
    ] = None,
    joint: Annotated[
        list[str] | None,
        typer.Option("--joint", metavar="NAME=RAD", help="Joint position [rad or m]; repeatable."),
    ] = None,
    set_points: Annotated[
        Path | None,
        typer.Option("--set-points", metavar="FILE", help='JSON: {"camera": {"marker": [u, v]}} in pixels.'),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="DIR",
            help="Set-points out of pictures recorded by `record --images`, at rest.",
        ),
    ] = None,
    at: Annotated[
        float, typer.Option("--at", help="With --images: seconds from their beginning.", min=0.0)
    ] = 0.0,
    frames: Annotated[
        int, typer.Option("--frames", help="With --images: frames a camera to average.", min=1, max=1000)
    ] = FRAMES,
    points: Annotated[
        Path | None,
        typer.Option(
            "--points", metavar="FILE", help='JSON: {"points": {"marker": [x, y, z, w]}, "model_epoch": N}.'
        ),
    ] = None,
    displacement: Annotated[
        Path | None,
        typer.Option(
            "--displacement",
            metavar="FILE",
            help='JSON: {"matrix": 4x4, "model_epoch": N or "basis": 5 ids}.',
        ),
    ] = None,
    incidence: Annotated[
        Path | None,
        typer.Option("--incidence", metavar="FILE", help='JSON: {"incidences": […], "secondary": …}.'),
    ] = None,
    follow_file: Annotated[
        str | None,
        typer.Option(
            "--follow",
            metavar="FILE|-",
            help='A moving target: JSON lines {"stamp_s": …, "set_points" or "points": …}.',
        ),
    ] = None,
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="A whole goal as JSON.")] = None,
    law: Annotated[str | None, typer.Option(help=f"{', '.join(LAWS)} (default: the cell's).")] = None,
    point_source: Annotated[
        str | None, typer.Option(help="Where points come from: triangulated or predicted.")
    ] = None,
    jacobian: Annotated[
        str | None, typer.Option(help="current, desired, mean or fixed-depth, for laws in images.")
    ] = None,
    centre: Annotated[
        str | None,
        typer.Option(
            metavar="IDS", help="Markers whose middle moves on the line (default: all of the goal)."
        ),
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option("--camera", help="Camera that may be used; repeatable (default: all).")
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(help="linear, exponential, translation-first, …, for law trajectory."),
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Gain [1/s].")] = None,
    adaptive_gain: Annotated[
        str | None, typer.Option(metavar="NEAR:FAR[:SLOPE]", help="Gain that falls with the error [1/s].")
    ] = None,
    tolerance: Annotated[float | None, typer.Option(help="Largest pixel distance at the goal [px].")] = None,
    hold_frames: Annotated[int | None, typer.Option(help="Frames for which the tolerance must hold.")] = None,
    speed_scale: Annotated[float, typer.Option(help="Lowers the speed, (0, 1].")] = 1.0,
    lease: Annotated[
        float | None,
        typer.Option(
            help=f"Abort when this client is silent for so long [s] (default: {WAITING_LEASE_S:g} while it waits, "
            f"none with --no-wait)."
        ),
    ] = None,
    time_limit: Annotated[float | None, typer.Option(help="Abort after so long [s].")] = None,
    queue: Annotated[bool, typer.Option("--queue", help="After the active goal, not instead of it.")] = False,
    blend: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Go on to the next goal below this error, without a stop."),
    ] = None,
    acknowledge: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Reached, wait so long for `acknowledge` before going on."),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Only say what it would do; nothing moves.")] = False,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait for its end.")] = True,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Send a goal and wait for its end. Ctrl-C cancels it."""
    stream: Iterator[tuple[float | None, StreamedTarget]] | None = None
    found: tuple[SetPoints, ...] = ()
    if images is None and (at or frames != FRAMES):
        raise CommandError("usage", "--at and --frames go with --images DIR")
    if gain is not None and adaptive_gain is not None:
        raise CommandError("usage", "--gain and --adaptive-gain: one of them")
    if follow_file is not None:
        if file or name or joint or set_points or points or displacement or incidence or images:
            raise CommandError("usage", "--follow is a target of its own; its first line is where it begins")
        stream = stream_lines(follow_file)
        first = next(stream, None)
        if first is None:
            raise CommandError("stream", f"{follow_file}: holds no set-points; a line at least is needed")
        stream = chain([first], stream)
        target = cast("dict[str, Any]", msgspec.to_builtins(first[1], str_keys=True))
    elif images is not None:
        if file or name or joint or set_points or points or displacement or incidence:
            raise CommandError("usage", "--images is a target of its own; leave the others out")
        found = read_images(cell, endpoint, images, at, frames)
        target = feature_tree(found)
    elif file is None:
        files = {"points": points, "displacement": displacement, "incidence": incidence}
        target = target_tree(name, joint, set_points, files, relative_to, common)
    if file is not None:
        wanted = decode(read(file), Goal)
    else:
        options: dict[str, Any] = {
            "law": law,
            "points": point_source,
            "jacobian": jacobian,
            "centre": None if centre is None else {"markers": numbers(centre, "--centre")},
            "cameras": camera or None,
            "profile": profile,
            "gain": gain if adaptive_gain is None else adaptive(adaptive_gain),
            "tolerance_px": tolerance,
            "hold_frames": hold_frames,
            "speed_scale": speed_scale,
            "lease_s": lease,
            "time_limit_s": time_limit,
            "mode": "queue" if queue else "preempt",
            "blend_px": blend,
            "acknowledge_s": acknowledge,
        }
        wanted = make_goal(target, options)
    if wait and wanted.lease_s is None:
        wanted = msgspec.structs.replace(wanted, lease_s=WAITING_LEASE_S)
    with Client(cell, endpoint=endpoint, operator=operator, while_waiting=interruption.check) as client:
        require_cameras(client, found)
        if check or wanted.check:
            reply = client.check(wanted)
            emit(reply, reply.message + ("" if reply.plan is None else f"\n{plan_table(reply.plan)}"), json)
            return
        _run(client, wanted, stream, wait, json)


def _run(
    client: Client,
    wanted: Goal,
    stream: Iterator[tuple[float | None, StreamedTarget]] | None,
    wait: bool,
    as_json: bool,
) -> None:
    try:
        handle = client.send(wanted)
        note(f"goal {handle.id} accepted" + (f": {handle.message}" if handle.message != "accepted" else ""))
        if stream is not None:
            note(f"{handle.stream(stream)} set-points followed")
        if wait:
            follow(handle, as_json)
            if wanted.acknowledge_s is not None:
                note(f"it waits there for `stereoservo acknowledge {client.cell} {handle.id}`")
        else:
            emit({"id": handle.id, "accepted": True}, handle.id, as_json)
    except KeyboardInterrupt:
        with suppress(ClientError):  # not accepted yet, or ended already
            client.cancel(wanted.id)
        raise


def follow(handle: GoalHandle, as_json: bool) -> None:
    """Wait for a goal's end and print it. Raises CommandError unless it was reached."""
    result = handle.wait()
    if result.outcome != "reached":
        tree = cast("dict[str, Any]", msgspec.to_builtins(result))
        raise CommandError("goal_" + result.outcome, f"goal {result.outcome}: {result.why}", goal=tree)
    error = "" if result.error_px is None else f", error {result.error_px:.3f} px"
    emit(result, f"reached in {result.seconds:.2f} s{error}", as_json)
