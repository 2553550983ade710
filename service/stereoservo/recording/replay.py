"""Replay of a flight recording: runs the recorded inputs through the same control core and compares the outputs bit
for bit; and the reader of a recording's messages.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Header, Message
from mcap.stream_reader import StreamReader

import stereoservo
from stereoservo.control.law_registry import LAWS, UnknownLawError
from stereoservo.core.cycle import StepInputs, StepOutputs, decode_array
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import StateVersionError, decode_state, is_recorded
from stereoservo.messages.goals import IncidenceTarget, JointTarget, RunGoal
from stereoservo.recording.flight_recorder import FORMAT
from stereoservo.recording.step_records import (
    Fingerprint,
    StepRecord,
    comparable,
    decode_step,
    encode_step,
    fingerprint,
)


class RecordingError(Exception):
    """A recording cannot be read: names the file, how far it is good, and the cause."""

    def __init__(self, path: Path, steps: int, cause: str) -> None:
        good = f"; {steps} steps before that are good" if steps else ""
        super().__init__(f"{path}: {cause}{good}")
        self.path = str(path)
        self.steps = steps


@dataclass(frozen=True)
class ReplayResult:
    """``identical`` is None where the fingerprints differ in what was run; ``max_relative_error`` counts then."""

    identical: bool | None
    steps: int
    max_relative_error: float
    first_difference: int | None
    checkpoints: int
    gaps: int
    fingerprint: Fingerprint


class _Replay:
    """A recording's messages through a fresh core, one after the other, and what came of it so far."""

    def __init__(
        self,
        progress: Callable[[int], None] | None,
        observe: Callable[[StepInputs, StepOutputs], None] | None,
        header: Callable[[CoreSettings], None] | None,
    ) -> None:
        self._progress, self._observe, self._header = progress, observe, header
        self._core: ServoCore | None = None
        self._settings: CoreSettings | None = None
        self.recorded: Fingerprint | None = None
        self.steps = self.checkpoints = self.gaps = 0
        self.worst = 0.0
        self.laws: set[str] = set()
        self.differs: int | None = None

    def take(self, topic: str, data: bytes) -> None:
        """The next message. Raises what its decoding and the core raise."""
        if topic == "header":
            self._take_header(data)
        elif topic == "gap":
            self._core = None
            self.gaps += 1
        elif topic == "checkpoint" and self._settings is not None:
            step, state = msgspec.msgpack.decode(data)
            self.checkpoints += 1
            if self._core is None:
                self._core = ServoCore(self._settings, decode_state(state))
            elif self.differs is None and not is_recorded(self._core.state, state):
                self.differs = step
        elif topic == "step" and self._core is not None and self._settings is not None:
            self._take_step(decode_step(data), self._core, self._settings.law)

    def _take_header(self, data: bytes) -> None:
        first = msgspec.msgpack.decode(data)
        self.recorded = msgspec.convert(first["fingerprint"], Fingerprint)
        self._settings = msgspec.msgpack.decode(first["settings"], type=CoreSettings, dec_hook=decode_array)
        if self._header is not None:
            self._header(self._settings)

    def _take_step(self, record: StepRecord, core: ServoCore, default_law: str) -> None:
        laws = _laws_of_goals(record.inputs, default_law)
        if self.recorded is not None:
            _require_installed(laws & set(self.recorded.laws))
        outputs = core.step(record.inputs)
        self.laws |= laws | {outputs.status.law}
        if self._observe is not None:
            self._observe(record.inputs, outputs)
        same, error = _compare(record, outputs)
        self.worst = max(self.worst, error)
        if not same and self.differs is None:
            self.differs = record.step
        self.steps += 1
        if self._progress is not None and self.steps % 1000 == 0:
            self._progress(self.steps)

    def result(self, path: Path) -> ReplayResult:
        """What came of the whole recording. Raises RecordingError where that was nothing."""
        if self._settings is None or self.recorded is None:
            raise RecordingError(path, self.steps, "holds no header; is it a flight recording?")
        if self.steps == 0:
            raise RecordingError(path, self.steps, "holds no step after a checkpoint")
        same_machine = comparable(self.recorded, fingerprint(), self.laws)
        return ReplayResult(
            identical=(self.differs is None) if same_machine else None,
            steps=self.steps,
            max_relative_error=self.worst,
            first_difference=self.differs,
            checkpoints=self.checkpoints,
            gaps=self.gaps,
            fingerprint=self.recorded,
        )


def replay(
    path: Path,
    progress: Callable[[int], None] | None = None,
    observe: Callable[[StepInputs, StepOutputs], None] | None = None,
    header: Callable[[CoreSettings], None] | None = None,
) -> ReplayResult:
    """Run a recording through a fresh core. Raises RecordingError on a damaged or foreign file.

    ``header`` is given the core's settings, ``observe`` every step's inputs and outputs: reports and debuggers read a
    recording through them.
    """
    run = _Replay(progress, observe, header)
    for topic, data in recorded_messages(path):
        try:
            run.take(topic, data)
        except (
            UnknownLawError, StateVersionError, msgspec.MsgspecError, ValueError, KeyError, TypeError
        ) as error:  # fmt: skip
            raise RecordingError(path, run.steps, _cause(error, topic, run.recorded)) from error
    return run.result(path)


def _cause(error: Exception, topic: str, recorded: Fingerprint | None) -> str:
    """Why a message of this ``topic`` cannot be replayed."""
    if isinstance(error, UnknownLawError):
        made = (
            ""
            if recorded is None
            else f" (recorded with {recorded.laws.get(error.name, 'an unknown version')})"
        )
        return f"needs a law that is not installed here{made}: {error}"
    if isinstance(error, StateVersionError):
        return _of_another_version(str(error), recorded)
    if recorded is not None and recorded.stereoservo != stereoservo.__version__:
        return _of_another_version(f"the {topic} does not fit this program ({error})", recorded)
    return f"step record is damaged ({error})"


def _laws_of_goals(inputs: StepInputs, default: str) -> set[str]:
    """Names of the laws of the goals that this step requests."""
    goals = [request.command.goal for request in inputs.requests if isinstance(request.command, RunGoal)]
    return {g.law or default for g in goals if not isinstance(g.target, JointTarget | IncidenceTarget)}


def _require_installed(laws: set[str]) -> None:
    """Raises UnknownLawError for the first law that is not installed here."""
    for name in sorted(laws):
        LAWS[name]


def _of_another_version(cause: str, recorded: Fingerprint | None) -> str:
    """The error message for a recording of another version, with the remedy."""
    now = f"stereoservo {stereoservo.__version__}"
    by = "an unknown version" if recorded is None else f"stereoservo {recorded.stereoservo}"
    return (
        f"cannot be replayed by {now}: {cause}. The file is not damaged; it was written by "
        f"{'another build of ' if by == now else ''}{by}. Replay it with the version that wrote it, or record anew"
    )


def _compare(record: StepRecord, outputs: StepOutputs) -> tuple[bool, float]:
    """Whether all outputs agree bit for bit, and the largest relative difference of the raw joint velocity."""
    again = decode_step(encode_step(record.inputs, outputs))
    difference = float(np.abs(again.raw - record.raw).max(initial=0.0))
    scale = float(np.abs(record.raw).max(initial=0.0))
    error = difference / scale if scale > 0.0 else difference
    return again.outputs_crc == record.outputs_crc and again.step == record.step, error


def recorded_messages(path: Path) -> Iterator[tuple[str, bytes]]:
    """Topic and payload in file order. Raises RecordingError naming how far the file is good."""
    steps = 0
    topics: dict[int, str] = {}
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Header) and record.profile != FORMAT:
                    raise RecordingError(
                        path, 0, f"is of profile {record.profile!r}; this program reads {FORMAT!r}"
                    )
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    topic = topics[record.channel_id]
                    steps += topic == "step"
                    yield topic, record.data
    except OSError as error:
        raise RecordingError(path, steps, f"cannot be read: {error.strerror}") from error
    except (McapError, EOFError, ValueError, KeyError, RuntimeError, struct.error) as error:
        raise RecordingError(
            path, steps, f"is truncated or damaged ({type(error).__name__}: {error})"
        ) from error
