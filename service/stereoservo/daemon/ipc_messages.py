"""Messages between the processes of one cell: structs with msgpack codecs (run plan, requests, heartbeats, servo state,
reports), and, what passes with every frame, bytes of fixed places; the capacities and layouts of their shared-memory
slots.
"""

from __future__ import annotations

import struct
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.core.cycle import Event, Status, StepInputs, decode_array, encode
from stereoservo.core.settings import CoreSettings, core_settings
from stereoservo.kinematics.model import CellModel
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
from stereoservo.recording.step_records import RecordedStep, StepMessage

OBSERVATION_LAYOUT = "CameraObservation.2"
PRIOR_LAYOUT = "Prior.2"
OBSERVATION_CAPACITY = 1 << 16
PRIOR_CAPACITY = 1 << 16
STATE_CAPACITY = 1 << 16
PIXEL_STEP = 2.0**-12
"""Of detected pixels; it adds a noise of 0.00007 px."""


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
        """The core's settings. Raises CellFileError where cell file and drivers contradict each other."""
        cap = COMMISSIONING_SPEED if self.commissioning else 1.0
        return core_settings(self.cell, self.joints, self.cameras, speed_cap=cap, watch_following=not self.dry_run)


class Received(msgspec.Struct, frozen=True, tag="received"):
    """What a receiver has: a sender's messages up to ``number`` (see `Outbox`). The servo process sends no event over a
    connection before the gateway has said this.
    """

    number: int


class Heartbeat(msgspec.Struct, frozen=True, tag="heartbeat"):
    """Heartbeat of the gateway; without it a moving arm is held."""


class Ask(msgspec.Struct, frozen=True, tag="ask"):
    """A request forwarded to the core."""

    request: Request


class NewModel(msgspec.Struct, frozen=True, tag="model", eq=False):
    """A model for the core. ``reanchored``: see `cycle.ModelUpdate`."""

    model: CellModel
    reanchored: tuple[str, ...] = ()


ToServo = Received | Heartbeat | Ask | NewModel


class ServoState(msgspec.Struct, frozen=True, eq=False):
    """State of the servo process, published some tens of times a second."""

    status: Status
    loop: LoopStatistics
    driver_configured: bool
    driver_active: bool
    gateway: bool
    records_dropped: int
    differences: tuple[str, ...]
    """Reasons why the drives were sent something other than the core's command; empty where they were not."""
    notes: tuple[str, ...] = ()
    """Records of other processes that could not be read and were left out, by source."""
    auxiliary: dict[str, float] = {}
    joints_ns: int = 0
    """Stamp of the newest joint sample; 0: there was none yet."""
    frames_ns: dict[str, int] = {}
    """Stamp of the shutter of each camera's newest frame, but of none of the future."""


def newest_stamps(inputs: StepInputs, joints_ns: int, frames_ns: dict[str, int]) -> tuple[int, dict[str, int]]:
    """Stamps of the newest joint sample and of each camera's newest frame [ns], given those before this step.

    A stamp of the future tells no age.
    """
    sample = inputs.joints
    if sample is not None and joints_ns < sample.t_ns <= inputs.now_ns:
        joints_ns = sample.t_ns
    for seen in inputs.observations:
        if seen.t_shutter_ns <= inputs.now_ns:
            frames_ns = {**frames_ns, seen.camera: seen.t_shutter_ns}
    return joints_ns, frames_ns


class Report(msgspec.Struct, frozen=True):
    """A message of a vision process or the supervisor that the gateway passes on to clients: ``number`` (1 and up) of
    ``stream``, which each process begins anew.
    """

    origin: str
    kind: str
    message: str
    t_ns: int
    images: RecordedImages | None = None
    """Of a recording of images that has ended."""
    stream: int = 0
    number: int = 0


def rounded(observation: CameraObservation) -> CameraObservation:
    """The observation with no more digits than a detector knows: a hundredth of a pixel's noise takes half of a
    number's bits, and every one of them is recorded.

    Pixels in steps of ``PIXEL_STEP``. Variances upwards by a 32nd at most, correlations towards zero by a 16th at most,
    so that a covariance stays one, and neither its variances nor its determinant are less. Along the long axis of a
    slanted ellipse the variance may be less, by a 32nd at most.
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
    """An observation of right shapes (`core.cycle.check_observation`) as bytes of fixed places."""
    name, o = observation.camera.encode(), observation
    head = _OBSERVATION.pack(len(name), len(o.ids), o.seq, o.t_shutter_ns, o.t_received_ns)
    return head + _padded(name) + _places(o.ids, o.pixels, o.covariances)


def decode_observation(data: bytes) -> CameraObservation:
    """Inverse of :func:`encode_observation`. Raises ValueError, before anything is allocated."""
    name, k, (seq, shutter_ns, received_ns), numbers = _apart(data, _OBSERVATION, 7)
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
    """A prior as bytes of fixed places."""
    name = prior.camera.encode()
    head = _PRIOR.pack(len(name), len(prior.ids), prior.t_ns)
    return head + _padded(name) + _places(prior.ids, prior.pixels, prior.velocities, prior.covariances)


def decode_prior(data: bytes) -> Prior:
    """Inverse of :func:`encode_prior`. Raises ValueError, before anything is allocated."""
    name, k, (t_ns,), numbers = _apart(data, _PRIOR, 9)
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


def _apart(data: bytes, head: struct.Struct, words: int) -> tuple[str, int, tuple[int, ...], bytearray]:
    """Camera, number of markers, numbers of the head, and ``words`` of 8 bytes a marker."""
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
    """A message for the ring of step records; a step as it is, all else in msgpack."""
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


class PlanError(DamagedError):
    """The run plan of a cell cannot be read."""


to_servo_decoder = msgspec.msgpack.Decoder(ToServo, dec_hook=decode_array)
event_decoder = msgspec.msgpack.Decoder(Event, dec_hook=decode_array)
state_decoder = msgspec.msgpack.Decoder(ServoState, dec_hook=decode_array)
_steps_decoder = msgspec.msgpack.Decoder(StepMessage, dec_hook=decode_array)
_OBSERVATION, _PRIOR = struct.Struct("<IIqqq"), struct.Struct("<IIq")
"""Bytes of the camera's name, markers; sequence number and stamps. Name, ids, pixels and what else there is follow,
each from a multiple of 8 bytes on.
"""
_STEP = struct.Struct("<IIq")
"""Before a step in the ring: mark, steps lost before it, time. What is rare is msgpack, which no mark begins."""
_STEP_MARK = 0xC1C1C1C1  # a byte that msgpack never uses
received_decoder = msgspec.msgpack.Decoder(Received)
report_decoder = msgspec.msgpack.Decoder(Report)
_plan_decoder = msgspec.msgpack.Decoder(RunPlan)


def save_plan(plan: RunPlan) -> None:
    """Write the plan into the runtime directory. Raises OSError."""
    write_atomically(plan_path(Path(plan.runtime)), encode(plan))


def load_plan(runtime: Path) -> RunPlan:
    """Read the plan of the cell whose runtime directory this is. Raises PlanError."""
    path = plan_path(runtime)
    with decoding(lambda cause: PlanError(path, f"{cause}; this process is started by `stereoservo run`")):
        return _plan_decoder.decode(read_bounded(path, MAX_PLAN_BYTES))
