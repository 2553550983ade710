"""Command ``stereoservo stop``: stops the arm over zenoh, or by a word in shared memory where the gateway does not
reply.
"""

from __future__ import annotations

import time
from pathlib import Path

from stereoservo.cli.output import CellArgument, CommandError, EndpointOption, JsonOption, emit, note
from stereoservo.client import Client, InvalidReplyError, NoReplyError, SessionError
from stereoservo.daemon.seqlock import SlotError, StopSlot
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import NotRunningError

ACKNOWLEDGE_S = 1.0


def stop(cell: CellArgument, endpoint: EndpointOption = None, json: JsonOption = False) -> None:
    """Stop the arm: it brakes and holds until `resume`. Not an emergency stop; see docs/safety.md."""
    try:
        with Client(cell, endpoint=endpoint, timeout_s=1.0) as client:
            reply = client.stop()
    except (InvalidReplyError, NoReplyError, SessionError, NotRunningError) as error:
        if endpoint is not None:
            raise
        _raise_slot(cell, error)
        emit({"accepted": True, "message": "stopped by the stop slot"}, "stopped (by the stop slot)", json)
        return
    emit(reply, "stopped", json)


def _raise_slot(cell: str, cause: Exception) -> None:
    name = load_cell_file(Path(cell)).cell.name if cell.endswith(".toml") else cell
    try:
        slot = StopSlot(cell_directories(name).stop_slot)
    except SlotError as error:
        raise cause from error
    note(f"{cause}; raising the stop slot")
    word = slot.raise_stop()
    until = time.monotonic() + ACKNOWLEDGE_S
    while not slot.acknowledged(word):
        if time.monotonic() > until:
            raise CommandError(
                "not_acknowledged",
                f"the servo process did not acknowledge the stop within {ACKNOWLEDGE_S:g} s",
            )
        time.sleep(0.01)
