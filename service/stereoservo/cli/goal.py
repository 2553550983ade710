"""``stereoservo goal``."""

from __future__ import annotations

import uuid
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import typer

from stereoservo.cli.output import (
    CellArgument,
    CommandError,
    EndpointOption,
    JsonOption,
    OperatorOption,
    emit,
    note,
    pairs,
)
from stereoservo.gateway.client import Client, ClientError, GoalHandle
from stereoservo.gateway.messages import decode, encode
from stereoservo.runtime.commands import FeatureTarget, Goal, JointTarget, Target, TaughtTarget

WAITING_LEASE_S = 2.0
"""Who waits for a goal stands behind it: when that process dies, the arm stops."""


def goal(
    cell: CellArgument,
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="Name of a taught goal.")] = "",
    joint: Annotated[
        list[str] | None,
        typer.Option("--joint", metavar="NAME=RAD", help="Joint position [rad or m]; repeatable."),
    ] = None,
    set_points: Annotated[
        Path | None,
        typer.Option("--set-points", metavar="FILE", help='JSON: {"camera": {"marker": [u, v]}} in pixels.'),
    ] = None,
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="A whole goal as JSON.")] = None,
    law: Annotated[str | None, typer.Option(help="stereo or cartesian3 (default: the cell's).")] = None,
    points: Annotated[str | None, typer.Option(help="triangulated or predicted, for law stereo.")] = None,
    gain: Annotated[float | None, typer.Option(help="Gain [1/s].")] = None,
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
    check: Annotated[bool, typer.Option("--check", help="Only say whether it would be accepted.")] = False,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait for its end.")] = True,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Send a goal and wait for its end. Ctrl-C cancels it."""
    if file is not None:
        wanted = decode(_read(file), Goal)
    else:
        tree: dict[str, Any] = {
            "id": str(uuid.uuid4()),
            "target": msgspec.to_builtins(_target(name, joint, set_points)),
            "law": law,
            "points": points,
            "gain": gain,
            "tolerance_px": tolerance,
            "hold_frames": hold_frames,
            "speed_scale": speed_scale,
            "lease_s": lease,
            "time_limit_s": time_limit,
            "mode": "queue" if queue else "preempt",
        }
        wanted = decode(
            encode({key: value for key, value in tree.items() if value is not None}),
            Goal,  # NaN is refused, not dropped
        )
    if wait and wanted.lease_s is None:
        wanted = msgspec.structs.replace(wanted, lease_s=WAITING_LEASE_S)
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        if check or wanted.check:
            reply = client.check(wanted)
            emit(reply, reply.message, json)
            return
        try:
            handle = client.send(wanted)
            note(f"goal {handle.id} accepted")
            if wait:
                follow(handle, json)
            else:
                emit({"id": handle.id, "accepted": True}, handle.id, json)
        except KeyboardInterrupt:
            with suppress(ClientError):  # not accepted yet, or ended already
                client.cancel(wanted.id)
            raise


def follow(handle: GoalHandle, as_json: bool) -> None:
    """Wait for a goal's end and print it. Raises CommandError unless it was reached."""
    result = handle.wait()
    if result.outcome != "reached":
        tree = cast("dict[str, Any]", msgspec.to_builtins(result))
        raise CommandError("goal_" + result.outcome, f"goal {result.outcome}: {result.message}", goal=tree)
    error = "" if result.error_px is None else f", error {result.error_px:.3f} px"
    emit(result, f"reached in {result.seconds:.2f} s{error}", as_json)


def _target(name: str, joints: list[str] | None, set_points: Path | None) -> Target:
    if sum((bool(name), bool(joints), set_points is not None)) != 1:
        raise CommandError("usage", "one of NAME (a taught goal), --joint, --set-points or --file is needed")
    if name:
        return TaughtTarget(name)
    if joints:
        return JointTarget(pairs(joints, "--joint"))
    assert set_points is not None
    return FeatureTarget(decode(_read(set_points), dict[str, dict[int, tuple[float, float]]]))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CommandError("file", f"{path}: {error.strerror}") from error
