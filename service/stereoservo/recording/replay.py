"""Replay of a flight recording: the recorded inputs through the same core, with the outputs compared bit for bit."""

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
from stereoservo.core.state import StateVersionError, decode_state, encode_state
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
    core: ServoCore | None = None
    settings: CoreSettings | None = None
    recorded: Fingerprint | None = None
    steps = checkpoints = gaps = 0
    worst = 0.0
    used: set[str] = set()
    differs: int | None = None
    for topic, data in recorded_messages(path):
        try:
            if topic == "header":
                first = msgspec.msgpack.decode(data)
                recorded = msgspec.convert(first["fingerprint"], Fingerprint)
                settings = msgspec.msgpack.decode(first["settings"], type=CoreSettings, dec_hook=decode_array)
                if header is not None:
                    header(settings)
            elif topic == "gap":
                core = None
                gaps += 1
            elif topic == "checkpoint" and settings is not None:
                step, state = msgspec.msgpack.decode(data)
                checkpoints += 1
                if core is None:
                    core = ServoCore(settings, decode_state(state))
                elif differs is None and encode_state(core.state) != state:
                    differs = step
            elif topic == "step" and core is not None and settings is not None:
                record = decode_step(data)
                laws = _laws_of_goals(record.inputs, settings.law)
                if recorded is not None:
                    _require_installed(laws & set(recorded.laws))
                outputs = core.step(record.inputs)
                used |= laws
                used.add(outputs.status.law)
                if observe is not None:
                    observe(record.inputs, outputs)
                same, error = _compare(record, outputs)
                worst = max(worst, error)
                if not same and differs is None:
                    differs = record.step
                steps += 1
                if progress is not None and steps % 1000 == 0:
                    progress(steps)
        except UnknownLawError as error:
            made = (
                ""
                if recorded is None
                else f" (recorded with {recorded.laws.get(error.name, 'an unknown version')})"
            )
            raise RecordingError(
                path, steps, f"needs a law that is not installed here{made}: {error}"
            ) from error
        except StateVersionError as error:
            raise RecordingError(path, steps, _of_another_version(str(error), recorded)) from error
        except (msgspec.MsgspecError, ValueError, KeyError, TypeError) as error:
            if recorded is not None and recorded.stereoservo != stereoservo.__version__:
                cause = f"the {topic} does not fit this program ({error})"
                raise RecordingError(path, steps, _of_another_version(cause, recorded)) from error
            raise RecordingError(path, steps, f"step record is damaged ({error})") from error
    if settings is None or recorded is None:
        raise RecordingError(path, steps, "holds no header; is it a flight recording?")
    if steps == 0:
        raise RecordingError(path, steps, "holds no step after a checkpoint")
    same_machine = comparable(recorded, fingerprint(), used)
    return ReplayResult(
        identical=(differs is None) if same_machine else None,
        steps=steps,
        max_relative_error=worst,
        first_difference=differs,
        checkpoints=checkpoints,
        gaps=gaps,
        fingerprint=recorded,
    )


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
