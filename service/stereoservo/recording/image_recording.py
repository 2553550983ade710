"""Recording of one camera's frames into a video file by a thread, on request; frames that it cannot process in time are
left out and counted.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from stereoservo.messages.decoding import DamagedError
from stereoservo.messages.files import set_aside
from stereoservo.messages.recording_request import ImageRecordingRequest, RecordedImages, read_request
from stereoservo.ports.devices import CameraObservation, Frame
from stereoservo.ports.image_files import DEFAULT_LIMITS, ImageFileError, ImageLimits, ImageWriter

REQUEST_EVERY_NS = 250_000_000
WAITING_FRAMES = 64
WAITING_BYTES = 64 << 20
CLOSING_S = 3.0
"""Time [s] within which queued frames must be written when the process ends; its supervisor kills it after 4 s."""
NICENESS = 10
ENDING = ("limit", "disk", "exists", "codec", "closed")
"""Errors of a writer after which nothing more can be recorded; others leave out one frame."""

ImageReport = Callable[[str, str, RecordedImages | None], None]


@dataclass
class _Recording:
    """One recording: the queue of frames, guarded by ``lock``, and the result once its thread has ended."""

    number: int
    file: Path
    waiting: deque[tuple[Frame, int]] = field(default_factory=deque)
    waiting_bytes: int = 0
    skipped: int = 0
    """Number of frames left out since the last one that was queued."""
    ending: bool = False
    frames: int = 0
    left_out: int = 0
    bytes: int = 0
    why: str = "ended"
    failed: bool = False
    lock: threading.Condition = field(default_factory=threading.Condition)
    thread: threading.Thread | None = None


class ImageRecorder:
    """Records one camera while a recording is requested. ``report(kind, message, images)`` is called with each result.

    Never raises on errors of the disk or the camera: a recording that cannot continue ends and is reported.
    """

    def __init__(
        self,
        order: Path,
        camera: str,
        driver: str,
        rate_hz: float,
        report: ImageReport,
        limits: ImageLimits = DEFAULT_LIMITS,
    ) -> None:
        self._order = order
        self._camera = camera
        self._driver = driver
        self._rate_hz = rate_hz
        self._report = report
        self._limits = limits
        self._polled_ns = -REQUEST_EVERY_NS
        self._done = 0
        self._recording: _Recording | None = None

    def take(self, delivered: list[Frame] | list[CameraObservation]) -> None:
        """Queue a copy of the frames that the camera delivered; never waits for the thread."""
        recording = self._recording
        if recording is None or recording.ending:  # later frames would prevent a slow disk or computer from finishing
            return
        for frame in delivered:
            if not isinstance(frame, Frame):
                continue  # observations: the gateway has refused to record them
            with recording.lock:
                full = (
                    len(recording.waiting) >= WAITING_FRAMES
                    or recording.waiting_bytes + frame.image.nbytes > WAITING_BYTES
                )
                if full or recording.failed:
                    recording.skipped += 1
                    continue
                kept = msgspec.structs.replace(frame, image=frame.image.copy())
                recording.waiting.append((kept, recording.skipped))
                recording.waiting_bytes += frame.image.nbytes
                recording.skipped = 0
                recording.lock.notify()

    def poll_request(self, now_ns: int) -> None:
        """Read the request and check the thread; at most once in ``REQUEST_EVERY_NS``."""
        if now_ns - self._polled_ns < REQUEST_EVERY_NS:
            return
        self._polled_ns = now_ns
        try:
            order = read_request(self._order)
        except DamagedError as error:  # set aside, it is reported once
            done = set_aside(self._order)
            self._report(
                "warning",
                f"camera {self._camera}: the order to record images cannot be read: {error}; {done}",
                None,
            )
            order = None
        self._apply_request(order if order is not None else ImageRecordingRequest())

    def _apply_request(self, order: ImageRecordingRequest) -> None:
        recording = self._recording
        if recording is not None:
            if not order.directory or order.number != recording.number:
                _end(recording)
            if recording.thread is not None and not recording.thread.is_alive():
                self._report_result(recording)
            return
        if order.directory and order.number != self._done:
            self._begin(order)

    def _begin(self, order: ImageRecordingRequest) -> None:
        recording = _Recording(order.number, Path(order.directory) / f"{self._camera}.avi")
        recording.thread = threading.Thread(
            target=self._write, args=(recording,), name=f"images-{self._camera}", daemon=True
        )
        recording.thread.start()
        self._recording = recording

    def _report_result(self, recording: _Recording) -> None:
        """Report a recording whose thread has ended."""
        self._recording, self._done = None, recording.number
        left_out = recording.left_out + recording.skipped
        result = RecordedImages(
            self._camera, str(recording.file), recording.frames, left_out, recording.bytes, recording.why
        )
        text = f"camera {self._camera}: {result.frames} frames in {result.file}"
        text += f", {left_out} left out" if left_out else ""
        if recording.failed:
            text += f"; it ended early: {recording.why}"
        self._report("images_ended", text, result)

    def close(self) -> None:
        """End the recording within ``CLOSING_S``. Idempotent."""
        recording = self._recording
        if recording is None or recording.thread is None:
            return
        _end(recording)
        recording.thread.join(CLOSING_S)
        if not recording.thread.is_alive():
            self._report_result(recording)

    # -- the thread -----------------------------------------------------------------------------------------

    def _write(self, recording: _Recording) -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)  # Linux: of this thread alone
        writer: ImageWriter | None = None
        missing = 0
        try:
            while (item := _next(recording)) is not None:
                frame, skipped = item
                missing += skipped + 1
                if writer is None:
                    writer = self._open(recording.file, frame)
                try:
                    writer.append(frame, missing - 1)
                except ImageFileError as error:
                    if error.code in ENDING:
                        raise
                    continue
                missing = 0
        except Exception as error:  # a recording may fail in any way; the camera continues
            recording.failed, recording.why = True, str(error) or type(error).__name__
        finally:
            with recording.lock:
                missing += recording.skipped + sum(1 + skipped for _, skipped in recording.waiting)
                recording.skipped = 0
                recording.waiting.clear()
            _finish(recording, writer, missing)

    def _open(self, file: Path, first: Frame) -> ImageWriter:
        """Create the files with the size of the first picture. Raises ImageFileError, OSError."""
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        height, width = first.image.shape
        return ImageWriter(file, self._camera, (width, height), self._rate_hz, driver=self._driver, limits=self._limits)


def _finish(recording: _Recording, writer: ImageWriter | None, missing: int) -> None:
    recording.left_out = missing
    if writer is None:
        return
    try:
        writer.close(recording.why, missing)
    except ImageFileError as error:
        recording.failed, recording.why = True, str(error)
    recording.frames, recording.left_out, recording.bytes = writer.frames, writer.left_out, writer.bytes


def _end(recording: _Recording) -> None:
    with recording.lock:
        recording.ending = True
        recording.lock.notify()


def _next(recording: _Recording) -> tuple[Frame, int] | None:
    """Next queued frame, with the number left out before it; None once none will come."""
    with recording.lock:
        while not recording.waiting and not recording.ending:
            recording.lock.wait()
        if not recording.waiting:
            return None
        frame, left_out = recording.waiting.popleft()
        recording.waiting_bytes -= frame.image.nbytes
        return frame, left_out
