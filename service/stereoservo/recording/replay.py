"""Replay of a flight recording: runs the recorded inputs through the same control core and compares the outputs bit
for bit; and the reader of a recording's messages.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

import stereoservo
from stereoservo.control.law_registry import LAWS, UnknownLawError
from stereoservo.core.cycle import StepInputs, StepOutputs, decode_array
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state_encoding import StateVersionError, decode_state, is_recorded
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.decoding import DamagedError, cause_of, decoding
from stereoservo.messages.goals import IncidenceTarget, JointTarget, RunGoal
from stereoservo.recording.compression import LARGEST, Checkpoints, StepBlocks
from stereoservo.recording.flight_recorder import FORMATS
from stereoservo.recording.step_layout import StepRecord, decode_step, outputs_crc
from stereoservo.recording.step_messages import Fingerprint
from stereoservo.recording.step_records import comparable, fingerprint

LARGEST_RECORD = LARGEST
"""Largest record that a recorder writes [bytes]: a larger stated size is damage, and is not allocated."""
LZ4_STATES_SIZE = 0x08
"""Flag of an LZ4 frame: its header contains the size of the content."""


class RecordingError(DamagedError):
    """A recording cannot be read: the message contains the file, how far it is valid, and the cause.

    ``cut``: the file ends inside a record, as after a crash. ``result``: the replay of the valid part, if it has steps.
    """

    def __init__(self, path: Path, steps: int, cause: str, *, cut: bool = False) -> None:
        good = f"; {steps} steps before that are good" if steps else ""
        super().__init__(path, f"{cause}{good}")
        self.path = str(path)
        self.steps = steps
        self.cut = cut
        self.result: ReplayResult | None = None


@dataclass(frozen=True)
class ReplayResult:
    """``identical`` is None if the fingerprints of the programs differ; then ``max_relative_error`` is relevant.
    ``last_step``: number of the last step that was compared.
    """

    identical: bool | None
    steps: int
    max_relative_error: float
    first_difference: int | None
    checkpoints: int
    gaps: int
    fingerprint: Fingerprint
    last_step: int = -1


class _Replay:
    """Replays a recording's messages through a new core, one after the other, and collects the results."""

    def __init__(self) -> None:
        self._core: ServoCore | None = None
        self.settings: CoreSettings | None = None
        self.recorded: Fingerprint | None = None
        self.steps = self.checkpoints = self.gaps = 0
        self.worst = 0.0
        self.laws: set[str] = set()
        self.differs: int | None = None
        self.last_step = -1

    def take(self, topic: str, data: bytes) -> tuple[StepInputs, StepOutputs] | None:
        """Process the next message; returns inputs and outputs of a step. Raises the exceptions of its decoding and of
        the core.
        """
        if topic == "header":
            self._take_header(data)
        elif topic == "gap":
            self._core = None
            self.gaps += 1
        elif topic == "checkpoint" and self.settings is not None:
            step, state = msgspec.msgpack.decode(data)
            self.checkpoints += 1
            if self._core is None:
                self._core = ServoCore(self.settings, decode_state(state))
            elif self.differs is None and not is_recorded(self._core.state, state):
                self.differs = step
        elif topic == "step" and self._core is not None and self.settings is not None:
            return self._take_step(decode_step(data), self._core, self.settings.law)
        return None

    def _take_header(self, data: bytes) -> None:
        first = msgspec.msgpack.decode(data)
        self.recorded = msgspec.convert(first["fingerprint"], Fingerprint)
        self.settings = msgspec.msgpack.decode(first["settings"], type=CoreSettings, dec_hook=decode_array)

    def _take_step(self, record: StepRecord, core: ServoCore, default_law: str) -> tuple[StepInputs, StepOutputs]:
        laws = _laws_of_goals(record.inputs, default_law)
        if self.recorded is not None:
            _require_installed(laws & set(self.recorded.laws))
        outputs = core.step(record.inputs)
        self.laws |= laws | {outputs.status.law}
        same, error = _compare(record, outputs)
        self.worst = max(self.worst, error)
        if not same and self.differs is None:
            self.differs = record.step
        self.steps += 1
        self.last_step = record.step
        return record.inputs, outputs

    def result(self, path: Path) -> ReplayResult:
        """The result of the whole recording. Raises RecordingError if it has none."""
        if self.settings is None or self.recorded is None:
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
            last_step=self.last_step,
        )


def replay(
    path: Path,
    progress: Callable[[int], None] | None = None,
    observe: Callable[[StepInputs, StepOutputs], None] | None = None,
    header: Callable[[CoreSettings], None] | None = None,
) -> ReplayResult:
    """Run a recording through a new core. Raises RecordingError on a damaged, cut or foreign file, with the result of
    the valid part before.

    ``header`` is called with the core's settings, ``observe`` with every step's inputs and outputs, for reports and
    debuggers.
    """
    run = _Replay()
    try:
        for topic, data in recorded_messages(path):
            try:
                stepped = run.take(topic, data)
            except Exception as error:  # from a decoder, or the core with inputs that no core has processed
                raise RecordingError(path, run.steps, _cause(error, topic, run.recorded)) from error
            if topic == "header" and header is not None and run.settings is not None:
                header(run.settings)
            if stepped is not None and observe is not None:
                observe(*stepped)
            if stepped is not None and progress is not None and run.steps % 1000 == 0:
                progress(run.steps)
    except RecordingError as error:
        with suppress(RecordingError):
            error.result = run.result(path)
        raise
    return run.result(path)


def _cause(error: Exception, topic: str, recorded: Fingerprint | None) -> str:
    """Why a message of this ``topic`` cannot be replayed."""
    if isinstance(error, UnknownLawError):
        made = "" if recorded is None else f" (recorded with {recorded.laws.get(error.name, 'an unknown version')})"
        return f"needs a law that is not installed here{made}: {error}"
    if isinstance(error, StateVersionError):
        return _of_another_version(str(error), recorded)
    if recorded is not None and recorded.stereoservo != stereoservo.__version__:
        return _of_another_version(f"the {topic} does not fit this program ({error})", recorded)
    return f"{topic} record is damaged ({cause_of(error)})"


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
        f"{'another build of ' if by == now else ''}{by}. Replay it with the version that wrote it, or record again"
    )


def _compare(record: StepRecord, outputs: StepOutputs) -> tuple[bool, float]:
    """Whether all outputs agree bit for bit, and the largest relative difference of the raw joint velocity."""
    status = outputs.status
    difference = float(np.abs(status.command_raw - record.raw).max(initial=0.0))
    scale = float(np.abs(record.raw).max(initial=0.0))
    error = difference / scale if scale > 0.0 else difference
    same = outputs_crc(outputs, record.layout) == record.outputs_crc and status.step == record.step
    same = same and (outputs.command is None) == (record.command is None)
    return same, error


class _Contents:
    """The steps and checkpoints in a file's messages, decompressed."""

    def __init__(self) -> None:
        self._blocks, self._checkpoints = StepBlocks(), Checkpoints()

    def of(self, topic: str, data: bytes) -> list[tuple[str, bytes]]:
        """Topic and content of the parts of a message. Raises any exception on damaged bytes."""
        if topic == "steps":
            return [("step", step) for step in self._blocks.restore(data)]
        if topic == "state":
            self._blocks.begin()
            return [("checkpoint", self._checkpoints.restore(data))]
        return [(topic, data)]


class _BoundedFile:
    """A recording's file, read up to its end only. ``cut``: more bytes were requested than it has."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._left = os.fstat(file.fileno()).st_size
        self.cut = False

    def read(self, length: int) -> bytes:
        if length > LARGEST_RECORD:
            raise ValueError(f"a length of {length} bytes")
        if length > self._left:
            self.cut = True
            raise EndOfFile
        self._left -= length
        return self._file.read(length)


def recorded_messages(path: Path) -> Iterator[tuple[str, bytes]]:
    """Topic and payload in file order. Raises RecordingError that states how far the file is valid."""
    steps = messages = 0
    stated: int | None = None
    topics: dict[int, str] = {}
    source: _BoundedFile | None = None
    contents = _Contents()

    def refused(cause: str) -> RecordingError:
        if cause.startswith("cannot be read"):
            return RecordingError(path, steps, cause)
        if source is not None and source.cut:
            return RecordingError(
                path, steps, "is truncated: it ends inside a record, or before its last one", cut=True
            )
        return RecordingError(path, steps, f"is truncated or damaged ({cause})")

    with decoding(refused), path.open("rb") as stream:
        source = _BoundedFile(stream)
        for record in _records(source):
            if isinstance(record, Header) and record.profile not in FORMATS:
                known = " and ".join(map(repr, FORMATS))
                raise RecordingError(path, 0, f"is of profile {record.profile!r}; this program reads {known}")
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                messages += 1
                for topic, data in contents.of(topics[record.channel_id], record.data):
                    steps += topic == "step"
                    yield topic, data
            elif isinstance(record, Statistics):
                stated = record.message_count
        if stated != messages:  # a reader skips unknown kinds of records, and a damaged kind is one
            raise ValueError(f"it states {stated} messages and {messages} were read")


@dataclass(frozen=True)
class RecordedSpan:
    """Facts about a recording before its replay: times [ns] of its first and last step, by its own clock, and the
    models of its first state, by epoch.

    ``shift_ns``: wall clock minus that clock, which counts from a computer's start: the time of the last change of the
    file is taken as the time of the last step.
    """

    first_ns: int
    last_ns: int
    models: dict[int, CellModel]
    shift_ns: int


def recorded_span(source: Path) -> RecordedSpan:
    """The span of a recording, up to where it is cut. Raises RecordingError."""
    first_ns = last_ns = 0
    models: dict[int, CellModel] = {}
    begun = False
    for topic, data in whole_messages(source):
        if topic == "checkpoint" and not begun:
            begun = True
            try:
                state = decode_state(msgspec.msgpack.decode(data)[1])
            except Exception:  # any error is reported by the replay
                continue
            models = {m.epoch: m for m in (state.model, state.pending_model) if m is not None}
        elif topic == "step":
            last_ns = decode_step(data).inputs.now_ns
            first_ns = first_ns or last_ns
    return RecordedSpan(first_ns, last_ns, models, source.stat().st_mtime_ns - last_ns)


def whole_messages(source: Path) -> Iterator[tuple[str, bytes]]:
    """The recording's messages, without those added by another export; up to where it is cut, if it is."""
    try:
        for topic, data in recorded_messages(source):
            if topic in ("header", "step", "checkpoint", "gap"):
                yield topic, data
    except RecordingError as error:
        if not error.cut:
            raise


def _records(source: _BoundedFile) -> Iterator[McapRecord]:
    """All records in file order, those of chunks after the chunk's checksum. Raises any exception."""
    reader = StreamReader(
        source,
        emit_chunks=True,
        validate_crcs=True,
        record_size_limit=LARGEST_RECORD,
    )
    for record in reader.records:
        if isinstance(record, Chunk):
            _check_sizes(record)
            yield from breakup_chunk(record, validate_crc=True)
        else:
            yield record


def _check_sizes(chunk: Chunk) -> None:
    """Raises ValueError for a chunk whose compressed data state another size than the chunk, because that size would be
    allocated.
    """
    size = chunk.uncompressed_size
    if chunk.compression not in ("", "lz4"):
        raise ValueError(f"a chunk is compressed by {chunk.compression!r}; 'lz4' is read")
    if chunk.compression == "lz4":
        flags, _, stated = struct.unpack_from("<BBQ", chunk.data, 4)
        if not flags & LZ4_STATES_SIZE or stated != size or size > LARGEST_RECORD:
            raise ValueError(f"a chunk of {size} bytes, whose data state {stated}")
