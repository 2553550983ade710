"""Flight recorder: writes the servo loop's step records and state checkpoints into an MCAP file."""

from __future__ import annotations

import os
from contextlib import suppress
from io import FileIO
from pathlib import Path
from types import TracebackType

import msgspec
from mcap.writer import CompressionType, Writer

from stereoservo.core.cycle import encode
from stereoservo.core.settings import CoreSettings
from stereoservo.recording.step_records import Fingerprint, RecordedCheckpoint, RecordedStep

FORMAT = "stereoservo-flight-1"
CHUNK_BYTES = 256 * 1024
"""At most in a chunk; what is not in a whole chunk yet is lost where the process is killed."""
CHUNK_S = 0.25
"""Of the loop's time in a chunk, at most."""
LEAST_STEP_BYTES = 400
"""Less than the record of any step."""
LEAST_CHUNK_BYTES = 4 * 1024


class _OutputFile:
    """File that takes each block as a whole or not at all, so that it ends with a whole record on a full disk."""

    def __init__(self, path: Path, durable: bool) -> None:
        self._path = path
        self._file = FileIO(path, "wb")
        self._durable = durable
        self.size = 0

    def write(self, data: bytes) -> int:
        """Append ``data``. Raises OSError, and the file is as before then."""
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
        """Close and remove a file that has not begun."""
        self._file.close()
        with suppress(OSError):
            self._path.unlink()

    def close(self) -> None:
        """Close, with what is durable on the disk. Idempotent. Raises OSError."""
        if self._file.closed:
            return
        try:
            if self._durable:
                os.fsync(self._file.fileno())
        finally:
            self._file.close()


class FlightRecorder:
    """Writes one recording. Steps and checkpoints come as bytes, already encoded by the servo process.

    The file grows chunk by chunk, so that a crash loses the last ``CHUNK_S`` at most; ``close`` adds the index, and,
    where it is ``durable``, waits until the disk has it all. A file that cannot be written any more ends with its last
    whole chunk: ``failure`` has the cause then, ``steps`` counts those in the file, ``dropped`` those that came later
    and are not.

    Raises OSError where the file cannot be begun.
    """

    def __init__(
        self, path: Path, settings: CoreSettings, fingerprint: Fingerprint, *, durable: bool = True
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.steps = 0
        self.dropped = 0
        self.failure = ""
        self._pending = 0
        self._closed = False
        self._stream = _OutputFile(path, durable)
        due = int(settings.rate_hz * CHUNK_S) * LEAST_STEP_BYTES
        chunk = min(CHUNK_BYTES, max(LEAST_CHUNK_BYTES, due))
        self._writer = Writer(
            self._stream, chunk_size=chunk, compression=CompressionType.LZ4, enable_data_crcs=True
        )
        try:
            self._writer.start(profile=FORMAT, library="stereoservo")
        except OSError:
            self._stream.discard()
            raise
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
        if self.failure:
            self.dropped += 1
            return
        self.steps += 1
        self._pending += 1
        self._add("step", data, t_ns)

    def checkpoint(self, step: int, state: bytes, t_ns: int) -> None:
        """Append the state as it was before step ``step``."""
        self._add("checkpoint", msgspec.msgpack.encode((step, state)), t_ns)

    def gap(self, lost: int, t_ns: int) -> None:
        """Record that ``lost`` steps are missing here."""
        self._add("gap", msgspec.msgpack.encode(lost), t_ns)

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
        if self._stream.size > size:
            self._pending = 0

    def _fail(self, error: OSError, size: int) -> None:
        """End the recording; the chunk at hand is in the file where it has grown beyond ``size``."""
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
                if not self.failure:
                    self._writer.finish()
            finally:
                self._stream.close()
        except OSError as error:
            self._fail(error, size)

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
