"""Reader and writer of recorded images: ``NAME.avi`` (FFV1, gray, lossless) with stamps and CRCs in ``NAME.jsonl``.

FFV1 with flipped bytes decodes into wrong pixels without an error; only the CRC of each frame's pixels detects it. The
sidecar is JSON Lines: a header, one line per frame, written after its frame, and an end line, which is missing if the
process was killed. Such a recording is read up to the end of the shorter of video and sidecar.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import cv2
import msgspec
import numpy as np

from stereoservo.messages.decoding import decoding
from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.devices import Frame

SCHEMA = "stereoservo-images-1"
CODEC = "FFV1"
SIDECAR = ".jsonl"
LONGEST_LINE = 4096
MOST_SURPLUS = 1000
"""Largest number of frames without a line that are counted."""
SLOWEST_MS = 10_000
"""Time without a frame after which a file counts as ended [ms], for example one with a hole of gigabytes."""
GIB = 1 << 30


class ImageFileError(Exception):
    """A recorded camera cannot be written or read: the message names the file, the frame, the cause and the remedy.

    Attributes:
        code: ``exists``, ``limit``, ``disk``, ``frame``, ``order``, ``closed``, ``codec`` of a writer; ``missing``,
            ``no_sidecar``, ``foreign_sidecar``, ``sidecar``, ``video``, ``size``, ``crc``, ``camera`` of a reader.
        frame: number of the frame in the file, from 0; None if the error does not concern a frame.
    """

    def __init__(self, path: Path, code: str, message: str, *, frame: int | None = None, **data: Any) -> None:
        where = "" if frame is None else f" frame {frame}:"
        super().__init__(f"{path}:{where} {message}")
        self.path = str(path)
        self.code = code
        self.frame = frame
        self.data = data


class ImageHeader(msgspec.Struct, frozen=True, tag="header", tag_field="line"):
    """First line of the sidecar. ``clock``: of the stamps, which can be compared only within the same ``boot`` of the
    host.

    ``width``, ``height``: of the images [px]; those of the video are rounded up to even numbers.
    """

    schema: str
    camera: str
    width: int
    height: int
    rate_hz: float
    driver: str = ""
    codec: str = CODEC
    clock: str = "CLOCK_MONOTONIC"
    boot: str = ""


class ImageLine(msgspec.Struct, frozen=True, tag="frame", tag_field="line", omit_defaults=True):
    """One frame: number in the file, sequence of its source, stamps, CRC-32 of its pixels row by row.

    ``left_out``: number of frames delivered by the camera directly before it and omitted by the recording.
    """

    frame: int
    seq: int
    t_shutter_ns: int
    t_received_ns: int
    crc: int
    left_out: int = 0


class ImageEnd(msgspec.Struct, frozen=True, tag="end", tag_field="line"):
    """Last line of a closed recording: number of frames, number of omitted frames, and the reason for its end."""

    frames: int
    left_out: int
    why: str


@dataclass(frozen=True)
class ImageLimits:
    """Limits of a recording: size of the video, time between first and last frame, disk space to keep free."""

    max_bytes: int = 64 * GIB
    max_seconds: float = 4 * 3600.0
    keep_free_bytes: int = GIB


DEFAULT_LIMITS = ImageLimits()
_encode = msgspec.json.Encoder().encode
_decoder = msgspec.json.Decoder(ImageHeader | ImageLine | ImageEnd)


def _decode(data: bytes) -> ImageHeader | ImageLine | ImageEnd:
    """A line of a sidecar. Raises ValueError for any invalid bytes."""
    with decoding(ValueError):
        line: ImageHeader | ImageLine | ImageEnd = _decoder.decode(data)
    return line


def crc_of(image: ImageArray) -> int:
    """CRC-32 of the pixels ``(height, width)`` row by row."""
    return zlib.crc32(np.ascontiguousarray(image).data)


def boot_id() -> str:
    """Id of the host's current boot, the origin of the monotonic clock; empty if the system does not report it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


def sidecar_of(video: Path) -> Path:
    """The sidecar of a video file."""
    return video.with_suffix(SIDECAR)


class ImageWriter:
    """Writes one camera's frames. Not thread-safe.

    Appended frames survive the end of the process, except those in the buffer of the container's writer: at most the
    last 256 KiB of the video.
    """

    def __init__(
        self,
        video: Path,
        camera: str,
        size: tuple[int, int],
        rate_hz: float,
        *,
        driver: str = "",
        limits: ImageLimits = DEFAULT_LIMITS,
    ) -> None:
        """``size``: width, height [px]. Raises ImageFileError (``exists``, ``disk``, ``codec``); creates no
        directory.
        """
        self.path = video
        self.frames = 0
        self.left_out = 0
        self._width, self._height = size
        self._limits = limits
        self._first_ns = 0
        self._last_ns = -1
        self._closed = False
        sidecar = sidecar_of(video)
        for path in (video, sidecar):
            if path.exists():
                raise ImageFileError(path, "exists", "is there already; a recording never writes over another")
        self._check_room(0)
        header = ImageHeader(SCHEMA, camera, *size, rate_hz, driver, boot=boot_id())
        self._sidecar = _open_sidecar(sidecar)
        self._put(header)
        padded = self._width + self._width % 2, self._height + self._height % 2
        self._padded: ImageArray | None = None if padded == size else np.zeros((padded[1], padded[0]), np.uint8)
        self._video = cv2.VideoWriter(
            str(video),
            cv2.CAP_FFMPEG,
            cv2.VideoWriter.fourcc(*CODEC),
            max(rate_hz, 1.0),
            padded,
            isColor=False,
        )
        if not self._video.isOpened():
            self._sidecar.close()
            raise ImageFileError(
                video,
                "codec",
                f"OpenCV {cv2.__version__} opens no {CODEC} writer there for {padded[0]}x{padded[1]} px",
            )

    def append(self, frame: Frame, left_out: int = 0) -> None:
        """Add a frame; ``left_out``: number of delivered frames before it that are missing.

        Raises ImageFileError: ``limit``, ``disk`` (no more frames can be added; close the writer), ``frame`` (wrong
        size or type), ``order`` (its stamp is not after the previous one), ``closed``.
        """
        image = frame.image
        if self._closed:
            raise ImageFileError(self.path, "closed", "the recording was closed; begin another")
        if image.shape != (self._height, self._width) or image.dtype != np.uint8:
            raise ImageFileError(
                self.path,
                "frame",
                f"a picture of shape {image.shape} {image.dtype}; ({self._height}, {self._width}) uint8 is recorded",
                frame=self.frames,
            )
        if frame.t_shutter_ns <= self._last_ns:
            raise ImageFileError(
                self.path,
                "order",
                f"stamp {frame.t_shutter_ns} ns is not after the last one, {self._last_ns} ns",
                frame=self.frames,
            )
        self._first_ns = self._first_ns if self.frames else frame.t_shutter_ns
        seconds = (frame.t_shutter_ns - self._first_ns) * 1e-9
        if seconds > self._limits.max_seconds:
            raise ImageFileError(
                self.path,
                "limit",
                f"{seconds:.1f} s are recorded; the limit is {self._limits.max_seconds:g} s. Begin another recording",
                frame=self.frames,
                seconds=seconds,
            )
        self._check_room(image.nbytes)
        self._video.write(self._even(image))
        line = ImageLine(self.frames, frame.seq, frame.t_shutter_ns, frame.t_received_ns, crc_of(image), left_out)
        self._put(line)
        self._last_ns = frame.t_shutter_ns
        self.frames += 1
        self.left_out += left_out

    def _even(self, image: ImageArray) -> ImageArray:
        """The image padded to even width and height, as the codec requires."""
        if self._padded is None:
            return np.ascontiguousarray(image)
        self._padded[: self._height, : self._width] = image
        return self._padded

    @property
    def bytes(self) -> int:
        """Size of the video so far."""
        try:
            return self.path.stat().st_size
        except OSError:  # the container's writer creates the file at its first flush
            return 0

    def _check_room(self, coming: int) -> None:
        written = self.bytes
        if written + coming > self._limits.max_bytes:
            raise ImageFileError(
                self.path,
                "limit",
                f"{written} bytes are recorded; the limit is {self._limits.max_bytes}. Begin another recording",
                frame=self.frames,
                bytes=written,
            )
        try:
            found = os.statvfs(self.path.parent)
        except OSError as error:
            raise ImageFileError(self.path, "disk", f"cannot be written: {error.strerror}") from error
        free = found.f_bavail * found.f_frsize
        if free - coming < self._limits.keep_free_bytes:
            raise ImageFileError(
                self.path,
                "disk",
                f"{free} bytes are free on its disk; {self._limits.keep_free_bytes} are left to others. Make room",
                frame=self.frames,
                free=free,
            )

    def _put(self, line: ImageHeader | ImageLine | ImageEnd) -> None:
        try:
            self._sidecar.write(_encode(line) + b"\n")
            self._sidecar.flush()
        except OSError as error:
            raise ImageFileError(
                self.path,
                "disk",
                f"its sidecar cannot be written: {error.strerror}. Make room",
                frame=self.frames,
            ) from error

    def close(self, why: str = "ended", left_out: int = 0) -> None:
        """Finish both files; ``left_out``: delivered frames after the last one. Idempotent.

        Raises ImageFileError (``disk``) if the end cannot be written; the appended frames are readable nevertheless.
        """
        if self._closed:
            return
        self._closed = True
        self.left_out += left_out
        self._video.release()
        try:
            with open(self.path, "rb") as video:
                os.fsync(video.fileno())
            self._put(ImageEnd(self.frames, self.left_out, why))
            os.fsync(self._sidecar.fileno())
        except OSError as error:
            raise ImageFileError(self.path, "disk", f"cannot be finished: {error.strerror}") from error
        finally:
            with suppress(OSError):  # already reported for the line that could not be written
                self._sidecar.close()

    def __enter__(self) -> ImageWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close("ended" if error is None else str(error))


def _open_sidecar(path: Path) -> IO[bytes]:
    try:
        return open(path, "xb")
    except OSError as error:
        raise ImageFileError(path, "disk", f"cannot be made: {error.strerror}") from error


class ImageReader:
    """Reads one camera's recording frame by frame, each checked by its CRC; memory does not grow with the file.

    ``header``: its first line. After ``read`` has returned None: ``lost``, number of frames that are in only one of the
    files, and ``end``, the last line (None: the recording was not closed).
    """

    def __init__(self, video: Path, camera: str = "") -> None:
        """``camera``: expected camera name, if given.

        Raises ImageFileError: ``missing``, ``no_sidecar``, ``foreign_sidecar``, ``video``, ``size``, ``camera``.
        """
        self.path = video
        self.frame = 0
        self.lost = 0
        self.end: ImageEnd | None = None
        self._done = False
        self._last_ns = -1
        if not video.is_file():
            raise ImageFileError(
                video, "missing", "there is no such file; a recorded camera is NAME.avi with NAME.jsonl"
            )
        self._sidecar, self.header = _open_header(sidecar_of(video), video)
        self._capture: cv2.VideoCapture | None = None
        try:
            self._capture = self._open(camera)
        finally:
            if self._capture is None:
                self._sidecar.close()

    def _open(self, camera: str) -> cv2.VideoCapture:
        header = self.header
        if camera and header.camera != camera:
            raise ImageFileError(self.path, "camera", f"is a recording of camera {header.camera!r}, not of {camera!r}")
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, SLOWEST_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, SLOWEST_MS]
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG, limits)
        if not capture.isOpened():
            capture.release()
            raise ImageFileError(
                self.path,
                "video",
                f"holds no video that OpenCV {cv2.__version__} reads: empty, cut off or foreign",
            )
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        even = header.width + header.width % 2, header.height + header.height % 2
        if size != even:
            capture.release()
            raise ImageFileError(
                self.path,
                "size",
                f"holds pictures of {size[0]}x{size[1]} px; its sidecar is of {even[0]}x{even[1]}: is it that file's?",
            )
        return capture

    def read(self) -> Frame | None:
        """The next frame, None at the end.

        Raises ImageFileError: ``crc`` (the pixels differ from the recorded ones), ``sidecar`` (a damaged line).
        """
        line, image = self._next(decode=True)
        if line is None or image is None:
            return None
        pixels = np.ascontiguousarray(image[: self.header.height, : self.header.width, 0])
        found = crc_of(pixels)
        if found != line.crc:
            raise ImageFileError(
                self.path,
                "crc",
                f"its pixels have CRC {found:08x}, recorded were {line.crc:08x}: the file is damaged from here on. "
                "Take another copy, or use what comes before",
                frame=line.frame,
            )
        return Frame(self.header.camera, line.seq, line.t_shutter_ns, line.t_received_ns, pixels)

    def skip(self) -> ImageLine | None:
        """Skip the next frame unchecked; returns its line, None at the end. Raises ImageFileError (``sidecar``)."""
        return self._next(decode=False)[0]

    def _next(self, *, decode: bool) -> tuple[ImageLine | None, ImageArray | None]:
        if self._done or self._capture is None:
            return None, None
        line = self._line()
        if line is None:
            self.lost = 0 if self.end is not None else self._surplus()
            self._done = True
            return None, None
        image: Any = None
        if not self._capture.grab():
            got = False
        elif decode:
            got, image = self._capture.retrieve()
        else:
            got = True
        if not got:
            self.lost = 1 + self._lines_left()
            self._done = True
            return None, None
        self.frame += 1
        return line, image

    def _line(self) -> ImageLine | None:
        """The next frame's line; None at the end line, at the end of the file, or at a truncated last line."""
        data = self._sidecar.readline(LONGEST_LINE)
        if not data:
            return None
        try:
            line = _decode(data)
        except ValueError as error:
            if not data.endswith(b"\n") and len(data) < LONGEST_LINE:
                return None  # truncated last line: the process was killed, or the copy ended early
            raise self._damaged(f"its line is not valid ({error})") from error
        if isinstance(line, ImageEnd):
            self.end = line
            if line.frames != self.frame:
                raise self._damaged(f"it ends after {self.frame} frames and says {line.frames}: lines are missing")
            return None
        if not isinstance(line, ImageLine) or line.frame != self.frame:
            raise self._damaged("its line is another frame's: lines are missing, or out of order")
        if line.t_shutter_ns <= self._last_ns:
            raise self._damaged(f"stamp {line.t_shutter_ns} ns is not after the one before, {self._last_ns} ns")
        self._last_ns = line.t_shutter_ns
        return line

    def _damaged(self, what: str) -> ImageFileError:
        return ImageFileError(
            sidecar_of(self.path),
            "sidecar",
            f"{what}. Take another copy, or use what comes before",
            frame=self.frame,
        )

    def _lines_left(self) -> int:
        """Number of frames in the sidecar after the one just read; reads it to its end."""
        count = 0
        first = self.frame
        self.frame += 1
        try:
            while self._line() is not None:
                count += 1
                self.frame += 1
        finally:
            self.frame = first
        return count

    def _surplus(self) -> int:
        """Number of images of the video after the sidecar's last line, up to ``MOST_SURPLUS``."""
        count = 0
        while self._capture is not None and count < MOST_SURPLUS and self._capture.grab():
            count += 1
        return count

    def __iter__(self) -> Iterator[Frame]:
        while (frame := self.read()) is not None:
            yield frame

    def close(self) -> None:
        """Release both files. Idempotent."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
        self._sidecar.close()

    def __enter__(self) -> ImageReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _open_header(path: Path, video: Path) -> tuple[IO[bytes], ImageHeader]:
    """The sidecar, positioned after its first line. Raises ImageFileError (``no_sidecar``, ``foreign_sidecar``)."""
    try:
        file = open(path, "rb")  # noqa: SIM115 - lives as long as the reader
    except FileNotFoundError as error:
        raise ImageFileError(
            video,
            "no_sidecar",
            f"{path.name} is missing beside it: without it no frame has a stamp. Copy both files",
        ) from error
    except OSError as error:
        raise ImageFileError(path, "no_sidecar", f"cannot be read: {error.strerror}") from error
    data = file.readline(LONGEST_LINE)
    try:
        header = _decode(data)
    except ValueError:
        header = None
    cause = ""
    if not isinstance(header, ImageHeader):
        cause = f"its first line is no header of a recorded camera ({data[:60]!r})"
    elif header.schema != SCHEMA or header.codec != CODEC:
        cause = f"is {header.schema!r} with codec {header.codec!r}; this version reads {SCHEMA!r} with {CODEC!r}"
    elif header.width < 1 or header.height < 1:
        cause = f"its pictures are {header.width}x{header.height} px"
    if cause or not isinstance(header, ImageHeader):
        file.close()
        raise ImageFileError(path, "foreign_sidecar", f"{cause}; it belongs to something else, or is damaged")
    return file, header


def image_lines(video: Path) -> Iterator[ImageLine]:
    """Frames that a recording's sidecar lists, in order; the video is not read.

    Ends at the first invalid line; the lines before it are valid. Raises ImageFileError (``no_sidecar``,
    ``foreign_sidecar``).
    """
    file, _ = _open_header(sidecar_of(video), video)
    with file:
        while data := file.readline(LONGEST_LINE):
            try:
                line = _decode(data)
            except ValueError:
                return
            if not isinstance(line, ImageLine):
                return
            yield line
