"""The stop slot raised for ``stereoservo stop CELL``, from the command line alone, before any other import."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from stereoservo.daemon.seqlock import SlotError, StopSlot
from stereoservo.messages.directories import CellDirectories, DirectoryError, directories_of


class RaisedStop(NamedTuple):
    """A stop that was raised: the cell's directories, its slot, and the word to pass to `StopSlot.acknowledged`."""

    directories: CellDirectories
    slot: StopSlot
    word: int


def raise_stop(arguments: Sequence[str]) -> RaisedStop | None:
    """Raise the stop slot if the command line is ``stop CELL`` for a cell of this host; None otherwise, and if there is
    no slot.

    A mistyped option after the cell does not delay the stop: the command reports it afterwards.
    """
    if arguments[:1] != ["stop"] or any(word.startswith(("--help", "--endpoint")) for word in arguments):
        return None
    cells = [word for word in arguments[1:] if not word.startswith("-")]
    if len(cells) != 1:
        return None
    try:
        directories = directories_of(cells[0])
        slot = StopSlot(directories.stop_slot)
    except (DirectoryError, SlotError, OSError):  # the command reports the error
        return None
    return RaisedStop(directories, slot, slot.raise_stop())
