"""Command ``stereoservo teach``: stores the current view of the cameras, or a goal made from CAD drawings, as a named
goal.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereoservo.cli.output import CELL_OPTIONS, CellArgument, CellOptions, CommandError, marker_ids, read_object
from stereoservo.messages.wire import Synthesise, decode, encode


def teach(
    cell: CellArgument,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the goal; an older one of that name is replaced.")
    ],
    frames: Annotated[int, typer.Option(help="Frames a camera to average.", min=1, max=1000)] = 20,
    tool: Annotated[
        str | None,
        typer.Option(
            metavar="IDS",
            help="Markers on the tool by which the goal is meant: it then survives a marker body that is mounted anew.",
        ),
    ] = None,
    drawing: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FILE",
            help='Make it from drawings, JSON: {"workpiece": {"10": [x, y, z]}, "tool": {"0": …}, "pose": 4x4}.',
        ),
    ] = None,
    options: CellOptions = CELL_OPTIONS,
) -> None:
    """Store what the cameras see now as a goal, with all other markers in view; or make one from drawings."""
    if drawing is not None:
        if tool is not None:
            raise CommandError("usage", "--tool goes with what the cameras see; in a drawing, its tool is named")
        request = read_drawing(drawing, name)
        with options.client(cell) as client:
            reply = client.synthesise(request)
        options.emit(reply, reply.message)
        return
    markers = () if tool is None else tuple(marker_ids(tool, "--tool"))
    with options.client(cell) as client:
        event = client.teach(name, frames, tool=markers)
    options.emit(event, event.message)


def read_drawing(path: Path, name: str) -> Synthesise:
    """Parse a drawing's file as a request; ``pose`` may be nested rows. Raises CommandError, MessageError."""
    tree = read_object(path)
    pose = tree.get("pose")
    if isinstance(pose, list) and all(isinstance(row, list) for row in pose):
        tree["pose"] = [number for row in pose for number in row]
    return decode(encode({**tree, "name": name}), Synthesise)
