"""Command ``stereoservo stop``: stops the arm by a word in shared memory on its host, over zenoh from another."""

from __future__ import annotations

import time

import typer

from stereoservo.cli.early_stop import RaisedStop
from stereoservo.cli.output import CellArgument, CommandError, EndpointOption, JsonOption, emit
from stereoservo.client import Client
from stereoservo.messages.discovery import daemon_info, unreachable_reason
from stereoservo.messages.locks import holder
from stereoservo.messages.wire import Reply

ACKNOWLEDGE_S = 1.0
"""Time limit [s]. The servo process applies a stop in its next cycle, a few milliseconds later; a busy machine delays
it by tenths of a second.
"""

NOT_TAKEN = (
    "Drives stop by themselves without commands; where the arm still moves, use the emergency stop. A servo process "
    "that starts, or goes on, takes this stop in its first cycle"
)


def stop(context: typer.Context, cell: CellArgument, endpoint: EndpointOption = None, json: JsonOption = False) -> None:
    """Stop the arm: it brakes and holds until `resume`. Not an emergency stop; see docs/safety.md."""
    raised: RaisedStop | None = context.obj
    if raised is None:  # another host's cell, or one without a slot
        with Client(cell, endpoint=endpoint, timeout_s=1.0) as client:
            reply = client.stop()
    else:
        _await_acknowledgement(raised)
        info = daemon_info(raised.directories)
        boot = "" if info is None else info.boot
        reply = Reply(accepted=True, message="the servo process has taken the stop", boot=boot)
    emit(reply, "stopped", json)


def _await_acknowledgement(raised: RaisedStop) -> None:
    """Wait until the servo process itself has acknowledged the stop. Raises CommandError."""
    until = time.monotonic() + ACKNOWLEDGE_S
    while not raised.slot.acknowledged(raised.word):
        runs = holder(raised.directories.servo_lock) is not None
        if not runs or time.monotonic() > until:
            why = (
                f"the servo process did not acknowledge it within {ACKNOWLEDGE_S:g} s: it hangs"
                if runs
                else f"no servo process runs. {unreachable_reason(raised.directories)}".rstrip(". ")
            )
            raise CommandError("not_acknowledged", f"after raising the stop slot: {why}. {NOT_TAKEN}")
        time.sleep(0.005)
