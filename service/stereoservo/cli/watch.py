"""Command ``stereoservo watch``: prints the states, events and (on request) marker observations that a cell publishes,
one line each.
"""

from __future__ import annotations

import math
import time
from typing import Annotated

import typer

from stereoservo.cli.output import CellArgument, EndpointOption, JsonOption, emit
from stereoservo.cli.status import progress_words
from stereoservo.client import Client
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import EventMessage, FeaturesMessage, StateMessage

STATE_EVERY_S = 1.0


def watch(
    cell: CellArgument,
    features: Annotated[bool, typer.Option("--features", help="Markers of every frame, too.")] = False,
    seconds: Annotated[float, typer.Option(help="End after so long (default: never).", min=0.0)] = math.inf,
    endpoint: EndpointOption = None,
    json: JsonOption = False,
) -> None:
    """Print what the cell publishes, one line each (with --json: JSON Lines), until Ctrl-C."""
    with Client(cell, endpoint=endpoint) as client:
        until = time.monotonic() + seconds
        last_state = 0.0
        for message in client.watch(features=features):
            now = time.monotonic()
            if now > until:
                return
            if isinstance(message, StateMessage) and not json:
                if now - last_state < STATE_EVERY_S:
                    continue
                last_state = now
            kind = type(message).__name__.removesuffix("Message").lower()
            emit({"kind": kind, kind: message}, _line(message), json)


def _line(message: StateMessage | EventMessage | FeaturesMessage) -> str:
    if isinstance(message, EventMessage):
        return f"{message.seq:5} {message.kind:22} {message.id[:8]:8} {message.message}"
    if isinstance(message, FeaturesMessage):
        return f"      {message.camera} frame {message.seq}: {len(message.ids)} markers"
    parts = [message.lifecycle, message.source, progress_words(message)]
    parts.append(" ".join(f"{q:+.3f}" for q in message.joints.values()))
    return (
        "      " + ", ".join(filter(None, parts)) + "".join(f"; {_why(reason)}" for reason in message.reasons)
    )


def _why(reason: Reason) -> str:
    return f"{reason.code}: {reason.hint}" if reason.hint else reason.code
