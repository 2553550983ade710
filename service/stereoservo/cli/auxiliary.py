"""Command ``stereoservo auxiliary``: moves a gripper or other joints beside the arm's, and switches digital outputs."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from stereoservo.cli.output import CellArgument, EndpointOption, JsonOption, OperatorOption, emit, pairs
from stereoservo.client import Client
from stereoservo.messages.wire import StateMessage

SWITCHED = {"on": "1", "off": "0"}
SHARE = 0.01
"""Share of a joint's range: within it of its target a joint has arrived, and within it of its last position it rests.
"""
STANDS_S = 0.5
POLL_S = 0.05


def auxiliary(
    cell: CellArgument,
    values: Annotated[
        list[str], typer.Argument(metavar="NAME=VALUE...", help="[rad] or [m] by joint; on or off by output.")
    ],
    wait: Annotated[
        float,
        typer.Option(help="Seconds to wait until they are there, or stand (a closed gripper).", min=0.0),
    ] = 5.0,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Move a gripper, switch an output: joints and outputs beside the arm's."""
    words = [item.partition("=") for item in values]
    ordered = pairs([f"{name}{equals}{SWITCHED.get(value, value)}" for name, equals, value in words], "value")
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        near = {spec.name: SHARE * (spec.high - spec.low) for spec in client.info().auxiliary}
        client.auxiliary(ordered)
        state = _arrived(client, ordered, near, wait)
    emit(state, "  ".join(f"{name} {value:g}" for name, value in state.auxiliary.items()), json)


def _arrived(client: Client, ordered: dict[str, float], near: dict[str, float], wait_s: float) -> StateMessage:
    """The state once all joints are at their targets, have rested for a while, or ``wait_s`` have passed."""
    until = time.monotonic() + wait_s
    state = stood = client.status()
    moved_at = time.monotonic()
    while (now := time.monotonic()) < until and now - moved_at < STANDS_S:
        if _near(state.auxiliary, ordered, near):
            break
        time.sleep(POLL_S)
        state = client.status()
        if not _near(state.auxiliary, stood.auxiliary, near):  # moved, however slowly
            stood, moved_at = state, time.monotonic()
    return state


def _near(values: dict[str, float], wanted: dict[str, float], near: dict[str, float]) -> bool:
    return all(abs(values.get(name, float("inf")) - value) <= near[name] for name, value in wanted.items())
