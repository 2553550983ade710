"""Layout of a step record: the bytes that the loop writes for each step, with fixed places for all usual data, so that
no encoder is needed and records of a kind can be compared word by word.

A record is a multiple of 8 bytes, little-endian: the header (``HEADER``); the velocity before and after the safety
stage; of joints stamps, positions, velocities, efforts, following errors; of each observation a head, the camera's
name, ids, pixels, covariances. Rare data (requests, a model, a fault of the driver, velocities that it sent in place of
a command, samples of other types) follow in msgpack.
"""

from __future__ import annotations

import struct
import zlib
from operator import attrgetter
from typing import Any

import msgspec
import numpy as np

from stereoservo.core.cycle import (
    NOT_MEASURED,
    Status,
    StepInputs,
    StepOutputs,
    StepResult,
    decode_array,
    encode,
)
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, JointState

LAYOUT = 3
"""Layout number, the first byte of a record. Records of layout 2 have the same content with another checksum; older
records in msgpack start with another byte.
"""
HEADER = struct.Struct("<BBBBIqqqqIHH")
"""Layout, flags, joints of a velocity, observations, CRC of the outputs; step, now, period, parameter epoch; bytes of
the rest, joints of a sample, a mark of the cameras whose observations follow.
"""
SAMPLE = struct.Struct("<qq")
"""Sequence number, and time minus that of the step."""
OBSERVATION = struct.Struct("<IIqqq")
"""Bytes of the camera's name, markers; sequence number, times of shutter and receipt minus that of the step."""
STOP, CONFIGURED, ACTIVE, COMPILING, COMMAND, JOINTS, EFFORTS, FOLLOWING = (1 << k for k in range(8))
LARGEST_COUNT = 255
_NONE = b"\0"


class StepRecord(msgspec.Struct, frozen=True, eq=False, array_like=True):
    """Inputs of step ``step``, the resulting velocity, and a CRC of all outputs; see `outputs_crc` for ``layout``."""

    step: int
    inputs: StepInputs
    command: FloatArray | None
    raw: FloatArray
    outputs_crc: int
    layout: int = 1


_FLOAT, _INTEGER = np.dtype(np.float64), np.dtype(np.int64)
_header, _sample, _observation = HEADER.pack, SAMPLE.pack, OBSERVATION.pack
_old_decoder = msgspec.msgpack.Decoder(StepRecord, dec_hook=decode_array)
_rest_decoder = msgspec.msgpack.Decoder(StepInputs, dec_hook=decode_array)


def _fields(*types: Any) -> tuple[str, ...]:
    """Names of the status's fields of these types."""
    return tuple(field.name for field in msgspec.structs.fields(Status) if field.type in types)


_ARRAYS, _NUMBERS = _fields(FloatArray, FloatArray | None), _fields(float | None)
_SEPARATE = (*_ARRAYS, *_NUMBERS, "t_ns", "step", "reasons", "innovation_px", "health")
_STRINGS = tuple(name for name in Status.__struct_fields__ if name not in _SEPARATE)
_arrays, _numbers, _strings = attrgetter(*_ARRAYS), attrgetter(*_NUMBERS), attrgetter(*_STRINGS)


def result_crc(result: StepResult) -> int:
    """CRC-32 of the result of a step, bit for bit: velocities before and after the safety stage and of the joints, the
    goal's error, events, the request to the driver. All other outputs follow from the state, which checkpoints contain;
    the existence of a command follows from the record's flags.
    """
    crc = zlib.crc32(result.values)  # type: ignore[arg-type]
    events, request = result.events, result.driver_request
    return zlib.crc32(encode((events, request)), crc) if events or request else crc


def outputs_crc(outputs: StepOutputs, layout: int = LAYOUT) -> int:
    """CRC-32 of a step's outputs as in a record of this ``layout`` (1: of their encoding in msgpack; 2: of all outputs
    except time and number; 3: `result_crc`).
    """
    if layout == 1:
        return zlib.crc32(encode(outputs))
    return result_crc(outputs) if layout == LAYOUT else _all_outputs_crc(outputs)


def _all_outputs_crc(outputs: StepOutputs) -> int:
    """CRC-32 of all outputs of a step except their time and number, bit for bit."""
    status = outputs.status
    numbers = [*_numbers(status), *status.innovation_px.values()]
    numbers = [NOT_MEASURED if value is None else value for value in numbers]
    parts: list[Any] = [outputs.command, *_arrays(status), struct.pack(f"<{len(numbers)}d", *numbers)]
    parts = [_NONE if part is None else part for part in parts]
    for prior in outputs.priors:
        parts += (prior.camera.encode(), prior.ids, prior.pixels, prior.velocities, prior.covariances)
    if status.reasons or outputs.events or outputs.driver_request:
        parts.append(encode((status.reasons, outputs.events, outputs.driver_request)))
    return zlib.crc32(_joined(parts), zlib.crc32(encode((_strings(status), status.health))))


def encode_step(inputs: StepInputs, result: StepResult) -> bytes:
    """The record of a step, as bytes."""
    command, joints, seen = result.command, inputs.joints, inputs.observations
    raw = result.raw
    flags = inputs.stop | inputs.driver_configured << 1 | inputs.driver_active << 2 | inputs.compiling << 3
    parts: list[Any] = [b"", raw]
    if command is not None:
        flags |= COMMAND
        parts.append(command)
    n = 0 if joints is None else _add_sample(parts, joints, inputs.now_ns)
    if n:
        flags |= JOINTS
        if joints.efforts is not None:  # type: ignore[union-attr]
            flags |= EFFORTS
        if joints.following_errors is not None:  # type: ignore[union-attr]
            flags |= FOLLOWING
    usual = not seen or _add_observations(parts, seen, inputs.now_ns)
    mark = zlib.crc32("\0".join([one.camera for one in seen]).encode()) & 0xFFFF if seen else 0
    rest = b""
    rare = inputs.requests or inputs.model_update or inputs.driver_fault or inputs.sent is not None
    if rare or not usual or (joints is not None and not n):
        rest = _rest(inputs, joints=n == 0, observations=not usual)
        parts.append(rest)
    parts[0] = _header(
        LAYOUT, flags, len(raw), len(seen) if usual else 0, result_crc(result), result.step, inputs.now_ns,
        inputs.period_ns, inputs.parameter_epoch, len(rest), n, mark,
    )  # fmt: skip
    return _joined(parts)


def _joined(parts: list[Any]) -> bytes:
    """Bytes and arrays, one after the other."""
    try:
        return b"".join(parts)
    except (BufferError, TypeError):  # an array that is not contiguous
        return b"".join([part if isinstance(part, bytes) else part.tobytes() for part in parts])


def _add_sample(parts: list[Any], joints: JointState, now_ns: int) -> int:
    """Add a sample if the layout supports its arrays; returns the number of joints, 0 if it does not."""
    positions, velocities = joints.positions, joints.velocities
    efforts, following = joints.efforts, joints.following_errors
    shape = positions.shape
    if len(shape) != 1 or not 0 < shape[0] <= LARGEST_COUNT or velocities.shape != shape:
        return 0
    if not positions.dtype == velocities.dtype == _FLOAT:
        return 0
    try:
        added: list[Any] = [_sample(joints.seq, joints.t_ns - now_ns), positions, velocities]
    except struct.error:  # a stamp out of range
        return 0
    if efforts is not None:
        if efforts.shape != shape or efforts.dtype != _FLOAT:
            return 0
        added.append(efforts)
    if following is not None:
        if following.shape != shape or following.dtype != _FLOAT:
            return 0
        added.append(following)
    parts += added
    return len(positions)


def _add_observations(parts: list[Any], seen: tuple[CameraObservation, ...], now_ns: int) -> bool:
    """Add observations if the layout supports their arrays; otherwise adds nothing and returns False."""
    added: list[Any] = []
    for observation in seen:
        ids, pixels, covariances = observation.ids, observation.pixels, observation.covariances
        k, name = len(ids), observation.camera.encode()
        if not (
            ids.dtype == _INTEGER
            and pixels.dtype == covariances.dtype == _FLOAT
            and ids.shape == (k,)
            and pixels.shape == (k, 2)
            and covariances.shape == (k, 2, 2)
        ):
            return False
        times = observation.t_shutter_ns - now_ns, observation.t_received_ns - now_ns
        try:
            added.append(_observation(len(name), k, observation.seq, *times))
        except struct.error:  # a stamp out of range
            return False
        added += (_padded(name), ids, pixels, covariances)
    if len(seen) > LARGEST_COUNT:
        return False
    parts += added
    return True


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 8)


def _rest(inputs: StepInputs, *, joints: bool, observations: bool) -> bytes:
    """The data without a fixed place, preceded by their length."""
    bare = msgspec.structs.replace(
        inputs,
        joints=inputs.joints if joints else None,
        observations=inputs.observations if observations else (),
    )
    data = encode(bare)
    return _padded(struct.pack("<Q", len(data)) + data)


class _Reader:
    """Reads the parts of a record, one after the other. Raises ValueError if too few bytes are left."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, count: int) -> bytes:
        end = self._at + count
        if end > len(self._data):
            raise ValueError(f"a record of {len(self._data)} bytes, which says that it has {end}")
        found, self._at = self._data[self._at : end], end
        return found

    def unpack(self, kind: struct.Struct) -> tuple[Any, ...]:
        return kind.unpack(self.take(kind.size))

    def array(self, kind: type, *shape: int) -> Any:
        count = int(np.prod(shape))
        return np.frombuffer(self.take(8 * count), kind).reshape(shape).copy()

    @property
    def left(self) -> int:
        return len(self._data) - self._at


def form_of(record: bytes) -> int:
    """A number that is equal for records of the same length with the same content in the same places."""
    return zlib.crc32(record[1:4] + record[HEADER.size - 2 : HEADER.size])


def decode_step(data: bytes) -> StepRecord:
    """A record of this layout or the previous one. Raises msgspec.MsgspecError, ValueError."""
    if data[:1] not in (b"\2", bytes((LAYOUT,))):
        return _old_decoder.decode(data)
    reader = _Reader(data)
    layout, flags, m, cameras, crc, step, now_ns, period_ns, epoch, rest, n, _ = reader.unpack(HEADER)
    raw = reader.array(np.float64, m)
    command = reader.array(np.float64, m) if flags & COMMAND else None
    joints = _read_joints(reader, flags, n, now_ns) if flags & JOINTS else None
    observations = tuple(_read_observation(reader, now_ns) for _ in range(cameras))
    if reader.left != rest:
        raise ValueError(f"a record with {reader.left} bytes left, which says {rest}")
    inputs = StepInputs(
        now_ns, period_ns, joints, observations, stop=bool(flags & STOP),
        driver_configured=bool(flags & CONFIGURED), driver_active=bool(flags & ACTIVE),
        parameter_epoch=epoch, compiling=bool(flags & COMPILING),
    )  # fmt: skip
    if rest:
        (length,) = struct.unpack("<Q", reader.take(8))
        rare = _rest_decoder.decode(reader.take(length))
        inputs = msgspec.structs.replace(
            rare, joints=joints or rare.joints, observations=observations or rare.observations
        )
    return StepRecord(step, inputs, command, raw, crc, layout)


def _read_joints(reader: _Reader, flags: int, n: int, now_ns: int) -> JointState:
    seq, before_ns = reader.unpack(SAMPLE)
    positions, velocities = reader.array(np.float64, n), reader.array(np.float64, n)
    efforts = reader.array(np.float64, n) if flags & EFFORTS else None
    following = reader.array(np.float64, n) if flags & FOLLOWING else None
    return JointState(seq, now_ns + before_ns, positions, velocities, efforts, following)


def _read_observation(reader: _Reader, now_ns: int) -> CameraObservation:
    length, k, seq, shutter_ns, received_ns = reader.unpack(OBSERVATION)
    name = reader.take(length + -length % 8)[:length].decode()
    return CameraObservation(
        name,
        seq,
        now_ns + shutter_ns,
        now_ns + received_ns,
        reader.array(np.int64, k),
        reader.array(np.float64, k, 2),
        reader.array(np.float64, k, 2, 2),
    )
