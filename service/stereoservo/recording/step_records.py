"""The stream of step records and state checkpoints from the servo loop to a recorder, and the software versions on
which replay depends.
"""

from __future__ import annotations

import platform
import zlib
from collections.abc import Container
from functools import cache

import msgspec
import numba
import numpy as np

import stereoservo
from stereoservo.control.law_registry import LAWS
from stereoservo.core.cycle import StepInputs, StepResult
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state_encoding import encode_state
from stereoservo.recording.step_layout import encode_step
from stereoservo.recording.step_messages import Fingerprint, RecordedCheckpoint, RecordedStep, RecordingStart, StepSink


@cache
def fingerprint() -> Fingerprint:
    """The fingerprint of this process."""
    return Fingerprint(
        stereoservo=stereoservo.__version__,
        python=platform.python_version(),
        numpy=np.__version__,
        numba=numba.__version__,
        processor=_processor(),
        libc=" ".join(platform.libc_ver()),
        laws=LAWS.sources(),
    )


def comparable(recorded: Fingerprint, present: Fingerprint, used: Container[str]) -> bool:
    """Whether a replay must give the same bits, for a recording in which the laws ``used`` ran.

    Laws that did not run are not compared, nor are those of a recording that states none.
    """
    bare = msgspec.structs.replace(present, laws=recorded.laws)
    laws = recorded.laws.items()
    return recorded == bare and all(present.laws.get(name) == source for name, source in laws if name in used)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            found = [line.split(":", 1)[1].strip() for line in file if line.startswith(("model name", "flags"))]
    except OSError:
        return platform.processor()
    flags = f"{zlib.crc32(found[1].encode()):08x}" if len(found) > 1 else ""
    return f"{found[0]} {flags}".strip() if found else platform.processor()


CHECKPOINT_EVERY_S = 5.0
RETRY_S = 0.1
"""Interval [s] after a checkpoint that the recorder could not take: encoding one takes time for the whole state."""


class StepStream:
    """Sends each step, and a checkpoint at the start, every ``CHECKPOINT_EVERY_S`` and after a gap. A checkpoint that
    the recorder could not take is made again after ``RETRY_S``, and after a gap no step is sent before it.

    ``dropped`` counts the steps that a recorder could not take.
    """

    def __init__(self, settings: CoreSettings, rate_hz: float) -> None:
        self._start = RecordingStart(settings, fingerprint())
        self._every = max(1, round(CHECKPOINT_EVERY_S * rate_hz))
        self._connected: StepSink | None = None
        self._sink: StepSink | None = None
        self._since_checkpoint = 0
        self._try_again = max(1, round(RETRY_S * rate_hz))
        self._pause = 0
        self._lost = 0
        self.dropped = 0

    def before(self, sink: StepSink | None, core: ServoCore, now_ns: int) -> None:
        """Start the stream if ``sink`` is a new recorder; send a checkpoint of ``core`` when one is due."""
        if sink is not self._connected:
            self._connected = sink
            self._sink = sink if sink is not None and sink.send(self._start) else None
            self._since_checkpoint, self._lost, self._pause = self._every, 0, 0
        if self._sink is None:
            return
        if self._pause:
            self._pause -= 1
        elif self._since_checkpoint >= self._every or self._lost:
            state = RecordedCheckpoint(now_ns, core.state.step, encode_state(core.state), self._lost)
            if self._sink.send(state):
                self._since_checkpoint, self._lost = 0, 0
            else:
                self._pause = self._try_again

    def after(self, inputs: StepInputs, result: StepResult) -> None:
        """Send the step's record."""
        if self._sink is None:
            return
        self._since_checkpoint += 1
        if self._lost or not self._sink.send(RecordedStep(inputs.now_ns, encode_step(inputs, result))):
            self._lost += 1
            self.dropped += 1
