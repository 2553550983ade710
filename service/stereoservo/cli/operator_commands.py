"""Commands of the operator that set the state of a cell: ``stereoservo enable``, ``disable``, ``hold``, ``resume``,
``reset`` (after a fault), ``acknowledge`` (a goal that is reached) and ``cancel``.
"""

from __future__ import annotations

from typing import Annotated

import typer

from stereoservo.cli.output import (
    CellArgument,
    CommandError,
    EndpointOption,
    JsonOption,
    OperatorOption,
    emit,
)
from stereoservo.client import Client


def enable(
    cell: CellArgument,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Let the arm move: power on, brakes released, at rest."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        client.enable()
        state = client.status()
    emit(state, state.lifecycle, json)


def disable(
    cell: CellArgument,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Stop the arm and switch its drives off."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        reply = client.disable()
    emit(reply, reply.message, json)


def hold(
    cell: CellArgument,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Decelerate and hold; the goal is kept for `resume`."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        reply = client.hold()
    emit(reply, reply.message, json)


def resume(
    cell: CellArgument,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Go on after `hold` or `stop`, from the measured state."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        reply = client.resume()
    emit(reply, reply.message, json)


def reset(
    cell: CellArgument,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Leave a fault whose cause is gone; the arm stays off until `enable`."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        client.reset()
        state = client.status()
    emit(state, f"{state.lifecycle}: the fault is cleared; `stereoservo enable {cell}` switches on", json)


def acknowledge(
    cell: CellArgument,
    goal_id: Annotated[str, typer.Argument(metavar="ID", help="The goal that was reached.")],
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """A reached goal that waits may be left (a gripper has closed): the queue goes on."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        reply = client.acknowledge(goal_id)
    emit(reply, reply.message, json)


def cancel(
    cell: CellArgument,
    goal_id: Annotated[
        str, typer.Argument(metavar="[ID]", help="The goal, active or queued (default: the active one).")
    ] = "",
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Cancel a goal, whoever sent it: the arm brakes, and the next one of the queue begins."""
    with Client(cell, endpoint=endpoint, operator=operator) as client:
        goal_id = goal_id or client.status().goal
        if not goal_id:
            raise CommandError("no_goal", f"no goal is active in cell {client.cell!r}: there is nothing to cancel")
        reply = client.cancel(goal_id)
    emit(reply, f"goal {goal_id}: {reply.message}", json)
