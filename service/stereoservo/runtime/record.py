"""One step as it is recorded: the inputs as consumed, and enough of the outputs to compare a replay with."""

from __future__ import annotations

import platform
import zlib
from functools import cache

import msgspec
import numba
import numpy as np

import stereoservo
from stereoservo.runtime.cycle import StepInputs, StepOutputs, decode_array, encode_array
from stereoservo.runtime.ports import FloatArray


class StepRecord(msgspec.Struct, frozen=True, eq=False, array_like=True):
    """Inputs of step ``step``, the velocity that came of it, and a CRC of all outputs."""

    step: int
    inputs: StepInputs
    command: FloatArray | None
    raw: FloatArray
    outputs_crc: int


class Fingerprint(msgspec.Struct, frozen=True):
    """What bit-for-bit replay depends on."""

    stereoservo: str
    python: str
    numpy: str
    numba: str
    processor: str
    libc: str


_encoder = msgspec.msgpack.Encoder(enc_hook=encode_array)
_decoder = msgspec.msgpack.Decoder(StepRecord, dec_hook=decode_array)


def encode_step(inputs: StepInputs, outputs: StepOutputs) -> bytes:
    """A step record as bytes; the CRC covers every output."""
    record = StepRecord(
        outputs.status.step,
        inputs,
        outputs.command,
        outputs.status.command_raw,
        zlib.crc32(_encoder.encode(outputs)),
    )
    return _encoder.encode(record)


def decode_step(data: bytes) -> StepRecord:
    """Inverse of :func:`encode_step`. Raises msgspec.MsgspecError."""
    return _decoder.decode(data)


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
    )


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            found = [
                line.split(":", 1)[1].strip() for line in file if line.startswith(("model name", "flags"))
            ]
    except OSError:
        return platform.processor()
    flags = f"{zlib.crc32(found[1].encode()):08x}" if len(found) > 1 else ""
    return f"{found[0]} {flags}".strip() if found else platform.processor()
