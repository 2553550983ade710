"""Messages between the processes of one cell: structs with msgpack codecs (run plan, requests, heartbeats, servo state,
reports), and, for the messages of each frame, byte records of fixed layout; the capacities and layouts of their
shared-memory slots.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np

from stereoservo.control.law_registry import LawDescription
from stereoservo.core.cycle import Event, Status, StepInputs, decode_array, encode
from stereoservo.core.settings import CoreSettings, core_settings
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.addresses import keep_secret
from stereoservo.messages.cell_file import CameraSection, CellFile
from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.files import read_bounded, write_atomically
from stereoservo.messages.goals import Request
from stereoservo.messages.recording_request import RecordedImages
from stereoservo.messages.servo_state import COMMISSIONING_SPEED, MAX_PLAN_BYTES, LoopStatistics, plan_path
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports.devices import (
    CameraDescription,
    CameraObservation,
    Clock,
    DriverContext,
    JointDriverDescription,
    Prior,
)
from stereoservo.recording.step_messages import RecordedStep, StepMessage

OBSERVATION_LAYOUT = "CameraObservation.2"
PRIOR_LAYOUT = "Prior.2"
OBSERVATION_CAPACITY = 1 << 16
PRIOR_CAPACITY = 1 << 16
STATE_CAPACITY = 1 << 16
PIXEL_STEP = 2.0**-12
"""Quantization step of detected pixels [px]; it adds a noise of 0.00007 px."""


class PlanOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a run that are not in the cell file."""

    boot: str
    seed: int = 0
    dry_run: bool = False
    commissioning: bool = False
    record: str = ""


class RunPlan(msgspec.Struct, frozen=True):
    """The configuration of one run, fixed at its start; every process reads it instead of the cell file."""

    cell: CellFile
    cell_path: str
    runtime: str
    state: str
    boot: str
    joints: JointDriverDescription
    cameras: tuple[CameraDescription, ...]
    seed: int = 0
    dry_run: bool = False
    commissioning: bool = False
    record: str = ""
    laws: tuple[LawDescription, ...] = ()
    law_errors: dict[str, str] = {}

    @property
    def directories(self) -> CellDirectories:
        """The cell's directories."""
        return CellDirectories(self.cell.cell.name, Path(self.runtime), Path(self.state))

    def driver_context(self, clock: Clock, camera: CameraSection | None = None) -> DriverContext:
        """The context for the constructor of the joint driver, or of driver and detector of ``camera``."""
        return DriverContext(
            clock=clock,
            cell=self.cell.cell.name,
            runtime_dir=Path(self.runtime),
            cell_dir=Path(self.cell_path).parent,
            camera="" if camera is None else camera.name,
            seed=self.seed,
            mount=(camera or self.cell.camera[0]).mount,
            arm=self.cell.arm_options,
        )

    def settings(self) -> CoreSettings:
        """The core's settings. Raises CellFileError if cell file and drivers contradict each other."""
        cap = COMMISSIONING_SPEED if self.commissioning else 1.0
        return core_settings(self.cell, self.joints, self.cameras, speed_cap=cap, watch_following=not self.dry_run)


class Received(msgspec.Struct, frozen=True, tag="received"):
    """Acknowledgement: the receiver has the sender's messages up to ``number`` (see `Outbox`). The servo process sends
    no event over a connection before it has received this from the gateway.
    """

    number: int


class Heartbeat(msgspec.Struct, frozen=True, tag="heartbeat"):
    """Heartbeat of the gateway; without it a moving arm is held."""


class Ask(msgspec.Struct, frozen=True, tag="ask"):
    """A request forwarded to the core."""

    request: Request


class NewModel(msgspec.Struct, frozen=True, tag="model", eq=False):
    """A model for the core. ``reanchored``, ``kept``: see `cycle.ModelUpdate`."""

    model: CellModel
    reanchored: tuple[str, ...] = ()
    kept: bool = False


ToServo = Received | Heartbeat | Ask | NewModel


class ServoState(msgspec.Struct, frozen=True, eq=False):
    """State of the servo process, published some tens of times per second."""

    status: Status
    loop: LoopStatistics
    driver_configured: bool
    driver_active: bool
    gateway: bool
    records_dropped: int
    differences: tuple[str, ...]
    """Reasons why the commands sent to the drives differ from the core's command; empty if they do not."""
    notes: tuple[str, ...] = ()
    """Records of other processes that could not be read and were skipped, by source."""
    auxiliary: dict[str, float] = {}
    joints_ns: int = 0
    """Stamp of the newest joint sample [ns]; 0: none yet."""
    frames_ns: dict[str, int] = {}
    """Shutter stamp of each camera's newest frame [ns]; stamps in the future are ignored."""


def newest_stamps(inputs: StepInputs, joints_ns: int, frames_ns: dict[str, int]) -> tuple[int, dict[str, int]]:
    """Stamps of the newest joint sample and of each camera's newest frame [ns], given the stamps before this step.

    Stamps in the future are ignored, because they give no age.
    """
    sample = inputs.joints
    if sample is not None and joints_ns < sample.t_ns <= inputs.now_ns:
        joints_ns = sample.t_ns
    for seen in inputs.observations:
        if seen.t_shutter_ns <= inputs.now_ns:
            frames_ns = {**frames_ns, seen.camera: seen.t_shutter_ns}
    return joints_ns, frames_ns


class Report(msgspec.Struct, frozen=True):
    """A message of a vision process or the supervisor that the gateway passes on to clients: ``number`` (1 and up) in
    ``stream``; each process starts a new stream.
    """

    origin: str
    kind: str
    message: str
    t_ns: int
    images: RecordedImages | None = None
    """Result of a recording of images that has ended."""
    stream: int = 0
    number: int = 0


def rounded(observation: CameraObservation) -> CameraObservation:
    """The observation rounded to the significant digits: at a noise of a hundredth of a pixel, half of a number's bits
    are noise, and all of them would be recorded.

    Pixels are rounded to multiples of ``PIXEL_STEP``. Variances are increased by at most 1/32, correlations are reduced
    by at most 1/16, so that the covariance remains valid, and neither its variances nor its determinant decrease. Along
    the long axis of a slanted ellipse the variance may decrease, by at most 1/32.
    """
    covariances = observation.covariances.copy()
    variances = covariances[:, (0, 1), (0, 1)]
    mantissa, exponent = np.frexp(variances)
    covariances[:, (0, 1), (0, 1)] = np.ldexp(np.ceil(64.0 * mantissa) / 64.0, exponent)
    step = np.ldexp(1.0 / 64.0, exponent.sum(axis=1) // 2)[:, None]
    covariances[:, (0, 1), (1, 0)] = np.trunc(covariances[:, (0, 1), (1, 0)] / step) * step
    pixels = np.round(observation.pixels / PIXEL_STEP) * PIXEL_STEP
    return msgspec.structs.replace(observation, pixels=pixels, covariances=covariances)


def encode_observation(observation: CameraObservation) -> bytes:
    """An observation of valid shapes (`core.cycle.check_observation`) as bytes of fixed layout."""
    name, o = observation.camera.encode(), observation
    head = _OBSERVATION.pack(len(name), len(o.ids), o.seq, o.t_shutter_ns, o.t_received_ns)
    return head + _padded(name) + _places(o.ids, o.pixels, o.covariances)


def decode_observation(data: bytes) -> CameraObservation:
    """Inverse of :func:`encode_observation`. Raises ValueError, before anything is allocated."""
    name, k, (seq, shutter_ns, received_ns), numbers = _split_message(data, _OBSERVATION, 7)
    return CameraObservation(
        name,
        seq,
        shutter_ns,
        received_ns,
        np.ndarray((k,), np.int64, numbers),
        np.ndarray((k, 2), np.float64, numbers, 8 * k),
        np.ndarray((k, 2, 2), np.float64, numbers, 24 * k),
    )


def encode_prior(prior: Prior) -> bytes:
    """A prior as bytes of fixed layout."""
    name = prior.camera.encode()
    head = _PRIOR.pack(len(name), len(prior.ids), prior.t_ns)
    return head + _padded(name) + _places(prior.ids, prior.pixels, prior.velocities, prior.covariances)


def decode_prior(data: bytes) -> Prior:
    """Inverse of :func:`encode_prior`. Raises ValueError, before anything is allocated."""
    name, k, (t_ns,), numbers = _split_message(data, _PRIOR, 9)
    return Prior(
        name,
        t_ns,
        np.ndarray((k,), np.int64, numbers),
        np.ndarray((k, 2), np.float64, numbers, 8 * k),
        np.ndarray((k, 2), np.float64, numbers, 24 * k),
        np.ndarray((k, 2, 2), np.float64, numbers, 40 * k),
    )


def _places(ids: IntArray, *numbers: FloatArray) -> bytes:
    parts = [ids.astype(np.int64, copy=False).tobytes()]
    parts += [array.astype(np.float64, copy=False).tobytes() for array in numbers]
    return b"".join(parts)


def _split_message(data: bytes, head: struct.Struct, words: int) -> tuple[str, int, tuple[int, ...], bytearray]:
    """Camera, number of markers, numbers of the head, and ``words`` words of 8 bytes per marker."""
    if len(data) < head.size:
        raise ValueError(f"{len(data)} bytes; the head alone has {head.size}")
    length, k, *stamps = head.unpack_from(data)
    at = head.size + length + -length % 8
    if len(data) != at + 8 * words * k:
        raise ValueError(f"{len(data)} bytes; {k} markers and a name of {length} bytes have {at + 8 * words * k}")
    return data[head.size : head.size + length].decode(), k, tuple(stamps), bytearray(data[at:])


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 8)


def pack_step_message(message: StepMessage) -> bytes:
    """A message for the ring of step records; a step unchanged, all others in msgpack."""
    if isinstance(message, RecordedStep):
        return _STEP.pack(_STEP_MARK, min(message.lost, 0xFFFFFFFF), message.t_ns) + message.data
    return encode(message)


def unpack_step_message(data: bytes) -> StepMessage:
    """Inverse of :func:`pack_step_message`. Raises msgspec.MsgspecError, ValueError, struct.error."""
    if data[:4] != b"\xc1" * 4:
        message: StepMessage = _steps_decoder.decode(data)
        return message
    _, lost, t_ns = _STEP.unpack_from(data)
    return RecordedStep(t_ns, data[_STEP.size :], lost)


_EVENT_LENGTH = struct.Struct("<I")


def store_event(file: BinaryIO, event: Event) -> None:
    """Append an event of the core to ``file``."""
    data = encode(event)
    file.write(_EVENT_LENGTH.pack(len(data)) + data)


def stored_events(file: BinaryIO) -> Iterator[Event]:
    """The events in ``file`` from its position on; one that is still being written is left for the next call."""
    while True:
        at = file.tell()
        head = file.read(_EVENT_LENGTH.size)
        size = _EVENT_LENGTH.unpack(head)[0] if len(head) == _EVENT_LENGTH.size else 0
        data = file.read(size)
        if not size or len(data) < size:
            file.seek(at)
            return
        yield event_decoder.decode(data)


class PlanError(DamagedError):
    """The run plan of a cell cannot be read."""


to_servo_decoder = msgspec.msgpack.Decoder(ToServo, dec_hook=decode_array)
event_decoder = msgspec.msgpack.Decoder(Event, dec_hook=decode_array)
state_decoder = msgspec.msgpack.Decoder(ServoState, dec_hook=decode_array)
_steps_decoder = msgspec.msgpack.Decoder(StepMessage, dec_hook=decode_array)
_OBSERVATION, _PRIOR = struct.Struct("<IIqqq"), struct.Struct("<IIq")
"""Lengths of the camera's name and of the markers; sequence number and stamps. Name, ids, pixels and the other arrays
follow, each aligned to 8 bytes.
"""
_STEP = struct.Struct("<IIq")
"""Head of a step in the ring: mark, steps lost before it, time. Other messages are msgpack, which never begins with
it.
"""
_STEP_MARK = 0xC1C1C1C1  # a byte that msgpack never uses
received_decoder = msgspec.msgpack.Decoder(Received)
report_decoder = msgspec.msgpack.Decoder(Report)
_plan_decoder = msgspec.msgpack.Decoder(RunPlan)


def save_plan(plan: RunPlan) -> None:
    """Write the plan into the runtime directory. Raises OSError."""
    write_atomically(plan_path(Path(plan.runtime)), encode(plan))


def load_plan(runtime: Path) -> RunPlan:
    """Read the plan of a cell from its runtime directory; its secrets are in no error from now on. Raises PlanError."""
    path = plan_path(runtime)
    with decoding(lambda cause: PlanError(path, f"{cause}; this process is started by `stereoservo run`")):
        plan = _plan_decoder.decode(read_bounded(path, MAX_PLAN_BYTES))
    keep_secret(msgspec.to_builtins(plan.cell))
    return plan
