"""Cameras that have moved, found anew from what the core saw at rest: events ``reanchor`` in, a model out."""

from __future__ import annotations

from pathlib import Path

import msgspec

from stereoservo.kinematics.calibration.reanchoring import Reanchored, RestPose, Sights, reanchor
from stereoservo.kinematics.model import CellModel, write_atomically
from stereoservo.runtime.cycle import Event, decode_array, encode_array

MOST_POSES = 12
"""The newest that are used."""


class ReanchorJob:
    """The poses since the cameras moved last. An event with ``trial`` 0 begins anew."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def add(self, event: Event) -> None:
        """Take an event ``reanchor``."""
        if event.trial <= 0:
            self.events.clear()
        self.events = [*self.events, event][-MOST_POSES:]


def find_anew(events: list[Event], model: CellModel, epoch: int, created: str = "") -> Reanchored:
    """The model of ``epoch`` with the cameras where the newest of ``events`` says that they moved.

    Raises CalibrationError.
    """
    newest = events[-1]
    poses = tuple(RestPose(event.joints, event.samples) for event in events if event.joints is not None)
    return reanchor(
        model, Sights(poses), newest.cameras, rigid_rig=newest.rigid, epoch=epoch, created=created
    )


def save_events(path: Path, events: list[Event]) -> None:
    """Keep events for the process that fits. Raises OSError."""
    write_atomically(path, msgspec.msgpack.encode(events, enc_hook=encode_array))


def load_events(path: Path) -> list[Event]:
    """Inverse of :func:`save_events`. Raises OSError, msgspec.MsgspecError."""
    return msgspec.msgpack.decode(path.read_bytes(), type=list[Event], dec_hook=decode_array)
