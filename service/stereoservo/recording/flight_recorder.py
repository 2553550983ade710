"""Flight recorder: writes the servo loop's step records and state checkpoints into an MCAP file."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import msgspec
from mcap.writer import CompressionType, Writer

from stereoservo.core.cycle import encode
from stereoservo.core.settings import CoreSettings
from stereoservo.recording.step_records import Fingerprint, RecordedCheckpoint, RecordedStep

FORMAT = "stereoservo-flight-1"
CHUNK_BYTES = 256 * 1024


class FlightRecorder:
    """Writes one recording. Steps and checkpoints come as bytes, already encoded by the servo process.

    The file grows chunk by chunk, so that a crash loses the last chunk at most; ``close`` adds the index, and, where it
    is ``durable``, waits until the disk has it all.
    """

    def __init__(
        self, path: Path, settings: CoreSettings, fingerprint: Fingerprint, *, durable: bool = True
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.steps = 0
        self._durable = durable
        self._stream = open(path, "wb")  # noqa: SIM115 - lives as long as the recorder
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile=FORMAT, library="stereoservo")
        encoded = encode(settings)
        self._channels = {
            topic: self._writer.register_channel(topic=topic, message_encoding="msgpack", schema_id=0)
            for topic in ("header", "step", "checkpoint", "gap")
        }
        self._sequence = 0
        header = msgspec.msgpack.encode(
            {"fingerprint": msgspec.to_builtins(fingerprint), "settings": encoded}
        )
        self._add("header", header, 0)

    @property
    def size(self) -> int:
        """Bytes in the file so far; the last chunk is not in it yet."""
        return self._stream.tell()

    def write(self, message: RecordedStep | RecordedCheckpoint) -> None:
        """Append what the servo loop sent, with the gap before it."""
        if message.lost:
            self.gap(message.lost, message.t_ns)
        if isinstance(message, RecordedCheckpoint):
            self.checkpoint(message.step, message.state, message.t_ns)
        else:
            self.step(message.data, message.t_ns)

    def step(self, data: bytes, t_ns: int) -> None:
        """Append one encoded step."""
        self.steps += 1
        self._add("step", data, t_ns)

    def checkpoint(self, step: int, state: bytes, t_ns: int) -> None:
        """Append the state as it was before step ``step``."""
        self._add("checkpoint", msgspec.msgpack.encode((step, state)), t_ns)

    def gap(self, lost: int, t_ns: int) -> None:
        """Record that ``lost`` steps are missing here."""
        self._add("gap", msgspec.msgpack.encode(lost), t_ns)

    def _add(self, topic: str, data: bytes, t_ns: int) -> None:
        self._sequence += 1
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=t_ns,
            publish_time=t_ns,
            sequence=self._sequence,
            data=data,
        )

    def close(self) -> None:
        """Finish the file. Idempotent."""
        if self._stream.closed:
            return
        self._writer.finish()
        self._stream.flush()
        if self._durable:
            os.fsync(self._stream.fileno())
        self._stream.close()

    def abandon(self) -> None:
        """Leave the file as it is: of a disk that takes no more."""
        with suppress(OSError):
            self._stream.close()

    def __enter__(self) -> FlightRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
