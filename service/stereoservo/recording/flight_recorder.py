"""Flight recorder: writes the servo loop's step records and state checkpoints into an MCAP file."""

from __future__ import annotations

import os
from contextlib import suppress
from io import FileIO
from pathlib import Path
from types import TracebackType

import msgspec
from mcap.writer import CompressionType, IndexType, Writer

from stereoservo.core.cycle import encode
from stereoservo.core.settings import CoreSettings
from stereoservo.recording.compression import Checkpoints, StepBlocks
from stereoservo.recording.step_messages import Fingerprint, RecordedCheckpoint, RecordedStep

FORMAT = "stereoservo-flight-2"
FORMATS = ("stereoservo-flight-1", FORMAT)
"""Formats that can be read; in the first one each step is a message of its own, in msgpack, in chunks of LZ4."""
CHUNK_BYTES = 256 * 1024
"""Largest size of a chunk [bytes], before compression; data that are not in a complete chunk are lost if the process is
killed.
"""
CHUNK_S = 0.4
"""Longest time of the loop in a chunk [s]."""


TOPICS = {"header": "msgpack", "steps": "step-blocks", "state": "zstd-msgpack", "gap": "msgpack"}
"""Topics of a file, and how their messages are encoded (`step_layout`, `compression`)."""


class _OutputFile:
    """File that writes each block completely or not at all, so that it ends with a complete record on a full disk."""

    def __init__(self, path: Path, durable: bool) -> None:
        self._path = path
        self._file = FileIO(path, "wb")
        self._durable = durable
        self.size = 0

    def write(self, data: bytes) -> int:
        """Append ``data``. Raises OSError; the file is then unchanged."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with suppress(OSError):
                self._file.truncate(self.size)
                self._file.seek(self.size)
            raise
        self.size += len(data)
        return len(data)

    def tell(self) -> int:
        """Number of bytes written."""
        return self.size

    def discard(self) -> None:
        """Close and remove a file in which nothing was recorded."""
        self._file.close()
        with suppress(OSError):
            self._path.unlink()

    def close(self) -> None:
        """Close; a durable file is written to the disk first. Idempotent. Raises OSError."""
        if self._file.closed:
            return
        try:
            if self._durable:
                os.fsync(self._file.fileno())
        finally:
            self._file.close()


class FlightRecorder:
    """Writes one recording. Steps and checkpoints are passed as bytes, already encoded by the servo process
    (`step_layout`).

    The file grows chunk by chunk, so that a crash loses at most the last ``CHUNK_S``; ``close`` adds the index, and, if
    it is ``durable``, waits until the disk has stored everything. If writing fails, the file ends with its last
    complete chunk: ``failure`` then contains the cause, ``steps`` counts those in the file, ``dropped`` the later ones,
    which are not.

    Raises OSError if the file cannot be created.
    """

    def __init__(self, path: Path, settings: CoreSettings, fingerprint: Fingerprint, *, durable: bool = True) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.steps = 0
        self.dropped = 0
        self.failure = ""
        self._pending = 0
        self._closed = False
        self._stream = _OutputFile(path, durable)
        self._block: list[bytes] = []
        self._block_bytes = 0
        self._block_ns = 0
        self._blocks, self._checkpoints = StepBlocks(), Checkpoints()
        # A message is a chunk: its content is compressed already, by a method for its kind.
        self._writer = Writer(
            self._stream,
            chunk_size=1,
            compression=CompressionType.NONE,
            enable_data_crcs=True,
            index_types=IndexType.CHUNK,
        )
        try:
            self._writer.start(profile=FORMAT, library="stereoservo")
        except OSError:
            self._stream.discard()
            raise
        encoded = encode(settings)
        self._channels = {
            topic: self._writer.register_channel(topic=topic, message_encoding=encoding, schema_id=0)
            for topic, encoding in TOPICS.items()
        }
        self._sequence = 0
        header = msgspec.msgpack.encode({"fingerprint": msgspec.to_builtins(fingerprint), "settings": encoded})
        self._add("header", header, 0)

    @property
    def size(self) -> int:
        """Bytes in the file so far, without the last chunk."""
        return self._stream.tell()

    def write(self, message: RecordedStep | RecordedCheckpoint) -> None:
        """Append a message of the servo loop, with the gap before it."""
        if message.lost:
            self.gap(message.lost, message.t_ns)
        if isinstance(message, RecordedCheckpoint):
            self.checkpoint(message.step, message.state, message.t_ns)
        else:
            self.step(message.data, message.t_ns)

    def step(self, data: bytes, t_ns: int) -> None:
        """Append one encoded step."""
        if self.failure:
            self.dropped += 1
            return
        if not self._block:
            self._block_ns = t_ns
        self._block.append(data)
        self._block_bytes += len(data)
        self.steps += 1
        self._pending += 1
        if self._block_bytes >= CHUNK_BYTES or not 0 <= t_ns - self._block_ns < CHUNK_S * 1e9:
            self._flush()

    def checkpoint(self, step: int, state: bytes, t_ns: int) -> None:
        """Append the state before step ``step``."""
        self._flush()
        self._blocks.begin()
        self._add("state", self._checkpoints.compress(msgspec.msgpack.encode((step, state))), t_ns)

    def gap(self, lost: int, t_ns: int) -> None:
        """Record that ``lost`` steps are missing here."""
        self._flush()
        self._add("gap", msgspec.msgpack.encode(lost), t_ns)

    def _flush(self) -> None:
        """Write the steps of the current block."""
        if self._block:
            block, self._block, self._block_bytes = self._block, [], 0
            self._add("steps", self._blocks.compress(block), self._block_ns)

    def _add(self, topic: str, data: bytes, t_ns: int) -> None:
        if self.failure:
            return
        self._sequence += 1
        size = self._stream.size
        try:
            self._writer.add_message(
                channel_id=self._channels[topic],
                log_time=t_ns,
                publish_time=t_ns,
                sequence=self._sequence,
                data=data,
            )
        except OSError as error:
            self._fail(error, size)
            return
        self._pending = len(self._block)

    def _fail(self, error: OSError, size: int) -> None:
        """End the recording; the current chunk is in the file if the file has grown beyond ``size``."""
        if self._stream.size > size:
            self._pending = 0
        self.failure = error.strerror or str(error)
        self.steps -= self._pending
        self.dropped += self._pending
        self._pending = 0

    def close(self) -> None:
        """Finish the file, as far as it can be written. Idempotent."""
        if self._closed:
            return
        self._closed = True
        size = self._stream.size
        try:
            try:
                self._flush()
                if not self.failure:
                    self._writer.finish()
            finally:
                self._stream.close()
        except OSError as error:
            self._fail(error, size)

    def abandon(self) -> None:
        """Leave the file as it is: the disk accepts no more data."""
        with suppress(OSError):
            self._stream.close()

    def __enter__(self) -> FlightRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
