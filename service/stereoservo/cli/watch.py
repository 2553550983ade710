"""Command ``stereoservo watch``: prints the states, events and (on request) marker observations that a cell publishes,
one line each; and shows them to Foxglove and Rerun.
"""

from __future__ import annotations

import math
import os
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoservo.cli.output import CellArgument, CommandError, EndpointOption, JsonOption, emit, log
from stereoservo.cli.status import progress_words
from stereoservo.client import Client
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import EventMessage, FeaturesMessage, StateMessage

if TYPE_CHECKING:
    from stereoservo.cli.foxglove_server import FoxgloveServer
    from stereoservo.cli.rerun_viewer import RerunViewer

STATE_EVERY_S = 1.0
RUNTIME = "(rx: (handover: app), app: (worker_threads: 1))"
"""Threads of zenoh: the receiving thread handles each message itself; otherwise two more are woken per message."""
LOOK_EVERY_S = 0.1
"""Interval of frames unless each is requested: enough for the eye; all at 30 Hz would cost twice as much of a core."""


def watch(
    cell: CellArgument,
    features: Annotated[bool, typer.Option("--features", help="Markers of every frame, too.")] = False,
    seconds: Annotated[float, typer.Option(help="End after so long (default: never).", min=0.0)] = math.inf,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve it to Foxglove on this host, markers included.")
    ] = False,
    port: Annotated[int, typer.Option(help="Port of --foxglove.", min=0, max=65535)] = 8765,
    rerun: Annotated[bool, typer.Option("--rerun", help="Show it in the Rerun viewer, markers included.")] = False,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="With --rerun: write a file, open no viewer.")
    ] = None,
    endpoint: EndpointOption = None,
    json: JsonOption = False,
) -> None:
    """Print what the cell publishes, one line each (with --json: JSON Lines), until Ctrl-C."""
    if save is not None and not rerun:
        raise CommandError("argument", "--save goes with --rerun")
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
    with Client(cell, endpoint=endpoint) as client, ExitStack() as opened:
        viewers = _viewers(client.cell, port if foxglove else None, rerun, save, opened)
        until = time.monotonic() + seconds
        last_state = 0.0
        every_s = 0.0 if features else LOOK_EVERY_S
        for message in client.watch(features=features or bool(viewers), every_s=every_s):
            now = time.monotonic()
            if now > until:
                return
            for viewer in viewers:
                viewer.show(message)
            if isinstance(message, FeaturesMessage) and not features:
                continue
            if isinstance(message, StateMessage) and not json:
                if now - last_state < STATE_EVERY_S:
                    continue
                last_state = now
            kind = type(message).__name__.removesuffix("Message").lower()
            emit({"kind": kind, kind: message}, _line(message), json)


def _viewers(
    cell: str, port: int | None, rerun: bool, save: Path | None, opened: ExitStack
) -> list[FoxgloveServer | RerunViewer]:
    """The requested viewers; ``opened`` closes them."""
    found: list[FoxgloveServer | RerunViewer] = []
    if port is not None:
        from stereoservo.cli.foxglove_server import FoxgloveServer  # of the extra `cell`: only for this

        server = opened.enter_context(FoxgloveServer(cell, port))
        log(f"in Foxglove: Open connection, ws://localhost:{server.port}")
        found.append(server)
    if rerun:
        from stereoservo.cli.rerun_viewer import RerunViewer  # of the extra `watch`: only for this

        found.append(opened.enter_context(RerunViewer(cell, save)))
    return found


def _line(message: StateMessage | EventMessage | FeaturesMessage) -> str:
    if isinstance(message, EventMessage):
        return f"{message.seq:5} {message.kind:22} {message.id[:8]:8} {message.message}"
    if isinstance(message, FeaturesMessage):
        return f"      {message.camera} frame {message.seq}: {len(message.ids)} markers"
    parts = [message.lifecycle, message.source, progress_words(message)]
    parts.append(" ".join(f"{q:+.3f}" for q in message.joints.values()) or "joints unknown")
    return "      " + ", ".join(filter(None, parts)) + "".join(f"; {_why(reason)}" for reason in message.reasons)


def _why(reason: Reason) -> str:
    return f"{reason.code}: {reason.hint}" if reason.hint else reason.code
