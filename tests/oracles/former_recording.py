"""Recordings of format 1, as they were written before steps had a layout of their own: msgpack, in chunks of LZ4."""

from __future__ import annotations

import zlib
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec
from mcap.writer import CompressionType, Writer

from stereoservo.core.cycle import StepInputs, StepOutputs, encode
from stereoservo.core.settings import CoreSettings
from stereoservo.recording.step_layout import StepRecord
from stereoservo.recording.step_messages import Fingerprint


def encode_step(inputs: StepInputs, outputs: StepOutputs) -> bytes:
    """A step record of then: its checksum is of all outputs in msgpack."""
    crc = zlib.crc32(encode(outputs))
    record = StepRecord(outputs.status.step, inputs, outputs.command, outputs.status.command_raw, crc)
    return msgspec.msgpack.encode(msgspec.msgpack.decode(encode(record))[:5])


class FormerRecorder:
    """A recorder of then, with no more than a recording on a good disk needs."""

    def __init__(self, path: Path, settings: CoreSettings, fingerprint: Fingerprint) -> None:
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, chunk_size=16_384, compression=CompressionType.LZ4, enable_data_crcs=True)
        self._writer.start(profile="stereoservo-flight-1", library="stereoservo")
        self._channels = {
            topic: self._writer.register_channel(topic=topic, message_encoding="msgpack", schema_id=0)
            for topic in ("header", "step", "checkpoint", "gap")
        }
        made = {"fingerprint": msgspec.to_builtins(fingerprint), "settings": encode(settings)}
        self._add("header", msgspec.msgpack.encode(made), 0)

    def step(self, data: bytes, t_ns: int) -> None:
        """Append a step record."""
        self._add("step", data, t_ns)

    def checkpoint(self, step: int, state: bytes, t_ns: int) -> None:
        """Append a state."""
        self._add("checkpoint", msgspec.msgpack.encode((step, state)), t_ns)

    def _add(self, topic: str, data: bytes, t_ns: int) -> None:
        times: dict[str, Any] = {"log_time": t_ns, "publish_time": t_ns}
        self._writer.add_message(channel_id=self._channels[topic], sequence=0, data=data, **times)

    def __enter__(self) -> FormerRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()
        self._stream.close()
