"""Messages of the stream of step records from the servo loop to a recorder: start, steps, state checkpoints. A process
that only passes them on imports no kernel.
"""

from __future__ import annotations

from typing import Protocol

import msgspec

from stereoservo.core.settings import CoreSettings


class Fingerprint(msgspec.Struct, frozen=True):
    """Versions and platform on which bit-for-bit replay depends."""

    stereoservo: str
    python: str
    numpy: str
    numba: str
    processor: str
    libc: str
    laws: dict[str, str] = {}
    """Version and source hash of every installed law; empty in recordings made before it was stored."""


class RecordingStart(msgspec.Struct, frozen=True, tag="start", array_like=True, eq=False):
    """First message to a recorder."""

    settings: CoreSettings
    fingerprint: Fingerprint


class RecordedStep(msgspec.Struct, frozen=True, tag="step", array_like=True):
    """One encoded step record. ``lost``: steps dropped just before it because the recorder did not keep up."""

    t_ns: int
    data: bytes
    lost: int = 0


class RecordedCheckpoint(msgspec.Struct, frozen=True, tag="checkpoint", array_like=True):
    """The encoded state before step ``step``."""

    t_ns: int
    step: int
    state: bytes
    lost: int = 0


StepMessage = RecordingStart | RecordedStep | RecordedCheckpoint


class StepSink(Protocol):
    """Protocol of one connected recorder."""

    def send(self, message: StepMessage) -> bool:
        """Pass a message on; returns False if the recorder cannot take it now."""
        ...
