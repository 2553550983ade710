"""Commands of the operator that take effect at once: the cell's state (``stereoservo enable``, ``disable``, ``hold``,
``resume``, ``reset``, ``acknowledge``, ``cancel``), and motions at hand (``jog``, ``auxiliary``).
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Annotated

import typer

from stereoservo.cli.output import CELL_OPTIONS, CellArgument, CellOptions, CommandError, pairs
from stereoservo.client import Client, ClientError
from stereoservo.messages.wire import StateMessage


def enable(cell: CellArgument, options: CellOptions = CELL_OPTIONS) -> None:
    """Let the arm move: power on, brakes released, at rest."""
    with options.client(cell) as client:
        client.enable()
        state = client.status()
    options.emit(state, state.lifecycle)


def disable(cell: CellArgument, options: CellOptions = CELL_OPTIONS) -> None:
    """Stop the arm and switch its drives off."""
    with options.client(cell) as client:
        reply = client.disable()
    options.emit(reply, reply.message)


def hold(cell: CellArgument, options: CellOptions = CELL_OPTIONS) -> None:
    """Decelerate and hold; the goal is kept for `resume`."""
    with options.client(cell) as client:
        reply = client.hold()
    options.emit(reply, reply.message)


def resume(cell: CellArgument, options: CellOptions = CELL_OPTIONS) -> None:
    """Go on after `hold` or `stop`, from the measured state."""
    with options.client(cell) as client:
        reply = client.resume()
    options.emit(reply, reply.message)


def reset(cell: CellArgument, options: CellOptions = CELL_OPTIONS) -> None:
    """Leave a fault whose cause is gone; the arm stays off until `enable`."""
    with options.client(cell) as client:
        client.reset()
        state = client.status()
    options.emit(state, f"{state.lifecycle}: the fault is cleared; `stereoservo enable {cell}` switches on")


def acknowledge(
    cell: CellArgument,
    goal_id: Annotated[str, typer.Argument(metavar="ID", help="The goal that was reached.")],
    options: CellOptions = CELL_OPTIONS,
) -> None:
    """A reached goal that waits may be left (a gripper has closed): the queue goes on."""
    with options.client(cell) as client:
        reply = client.acknowledge(goal_id)
    options.emit(reply, reply.message)


def cancel(
    cell: CellArgument,
    goal_id: Annotated[
        str, typer.Argument(metavar="[ID]", help="The goal, active or queued (default: the active one).")
    ] = "",
    options: CellOptions = CELL_OPTIONS,
) -> None:
    """Cancel a goal, whoever sent it: the arm brakes, and the next one of the queue begins."""
    with options.client(cell) as client:
        goal_id = goal_id or client.status().goal
        if not goal_id:
            raise CommandError("no_goal", f"no goal is active in cell {client.cell!r}: there is nothing to cancel")
        reply = client.cancel(goal_id)
    options.emit(reply, f"goal {goal_id}: {reply.message}")


# -- jog: renews its lease while this process lives (a dead man's switch) -----------------------------------------


LEASE_S = 0.3
EVERY_S = 0.1


def jog(
    cell: CellArgument,
    velocities: Annotated[list[str], typer.Argument(metavar="JOINT=VELOCITY...", help="[rad/s] or [m/s] by joint.")],
    seconds: Annotated[float, typer.Option(help="For how long; Ctrl-C ends it sooner.", min=0.0)] = 1.0,
    options: CellOptions = CELL_OPTIONS,
) -> None:
    """Move joints at given velocities for some time."""
    requested = pairs(velocities, "velocity")
    with options.client(cell) as client:
        client.jog(requested, LEASE_S)
        try:
            until = time.monotonic() + seconds
            while (left := until - time.monotonic()) > 0:
                time.sleep(min(EVERY_S, left))
                client.jog(requested, LEASE_S)
        finally:
            with suppress(ClientError):  # the lease ends it anyway, slightly later
                client.jog(dict.fromkeys(requested, 0.0), 0.05)
        state = client.wait_state(lambda s: s.source != "jog", "at rest", 3.0)
    options.emit(state, "  ".join(f"{name} {value:+.4f}" for name, value in state.joints.items()))


# -- joints and outputs beside the arm's --------------------------------------------------------------------------


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
        float, typer.Option(help="Seconds to wait until they are there, or stand (a closed gripper).", min=0.0)
    ] = 5.0,
    options: CellOptions = CELL_OPTIONS,
) -> None:
    """Move a gripper, switch an output: joints and outputs beside the arm's."""
    words = [item.partition("=") for item in values]
    ordered = pairs([f"{name}{equals}{SWITCHED.get(value, value)}" for name, equals, value in words], "value")
    with options.client(cell) as client:
        near = {spec.name: SHARE * (spec.high - spec.low) for spec in client.info().auxiliary}
        client.auxiliary(ordered)
        state = _arrived(client, ordered, near, wait)
    options.emit(state, "  ".join(f"{name} {value:g}" for name, value in state.auxiliary.items()))


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
