"""Flight recordings in the gateway: starts and ends them, writes the servo process's step records into a file, and
requests the cameras' images beside it.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path

from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.gateway.persistence import SetNote
from stereoservo.gateway.publisher import EventLog
from stereoservo.messages.recording_request import (
    ImageRecordingRequest,
    ImagesRecorded,
    RecordedImages,
    images_directory,
    request_path,
    write_request,
)
from stereoservo.recording.flight_recorder import FlightRecorder
from stereoservo.recording.ring import RingLimits, RingThread
from stereoservo.recording.step_messages import RecordingStart, StepMessage

REPORT_TIMEOUT_S = 5.0
"""Time limit for vision processes to finish their files [s]; then the gateway reports that they did not."""


class CannotRecordError(Exception):
    """A recording is not possible; the text has the cause."""


class ImageRecordings:
    """Image recording by the vision processes: requests it and collects their reports."""

    def __init__(self, plan: RunPlan, log: EventLog) -> None:
        self._log = log
        self._path = request_path(plan.directories)
        self._cameras = tuple(camera.name for camera in plan.cameras if camera.delivers == "frames")
        self._others = tuple(camera.name for camera in plan.cameras if camera.delivers != "frames")
        self._directory = ""
        self._until: float | None = None
        self._reports: dict[str, RecordedImages] = {}
        self._path.unlink(missing_ok=True)  # of an earlier gateway: its recording has ended

    @property
    def running(self) -> bool:
        """Whether images are being recorded."""
        return bool(self._directory) and self._until is None

    def check(self) -> None:
        """Raise CannotRecordError if no camera of the cell delivers images."""
        if not self._cameras:
            names = ", ".join(self._others)
            raise CannotRecordError(
                f"cameras {names} deliver observations, no pictures: there are no images to record. Record without "
                "--images; the observations are in every recording"
            )

    def begin(self, recording: Path) -> None:
        """Request all cameras to record along with ``recording``."""
        if self._until is not None:
            self._until = 0.0  # the time limit of the previous recording has passed
            self.poll()
        directory = images_directory(recording)
        try:
            write_request(self._path, ImageRecordingRequest(time.monotonic_ns(), str(directory)))
        except OSError as error:
            text = f"no images are recorded: {self._path}: {error.strerror}"
            self._log.add("warning", message=text, name=str(directory), origin="gateway")
            return
        self._directory, self._until, self._reports = str(directory), None, {}
        left = f"; {', '.join(self._others)} deliver observations and are not in it" if self._others else ""
        self._log.add(
            "images",
            message=f"images of {', '.join(self._cameras)} into {directory}{left}",
            name=str(directory),
            origin="gateway",
        )

    def end(self) -> None:
        """Request the cameras to stop recording. Idempotent."""
        if self.running:
            self._path.unlink(missing_ok=True)
            self._until = time.monotonic() + REPORT_TIMEOUT_S

    def add_report(self, images: RecordedImages) -> None:
        """Add a vision process's report on its recording."""
        if self._directory and Path(images.file).parent == Path(self._directory):
            self._reports[images.camera] = images

    def poll(self) -> None:
        """Report the recorded images once all cameras have reported, or after a time limit."""
        if self._until is None:
            return
        missing = [name for name in self._cameras if name not in self._reports]
        if missing and time.monotonic() < self._until:
            return
        silent = {
            name: RecordedImages(
                name,
                f"{self._directory}/{name}.avi",
                0,
                0,
                0,
                f"or more: its vision process did not report how many within {REPORT_TIMEOUT_S:g} s; see the log",
            )
            for name in missing
        }
        found = tuple((self._reports | silent)[name] for name in self._cameras)
        text = "; ".join(
            f"{images.camera}: {images.frames} frames"
            + (f", {images.left_out} left out" if images.left_out else "")
            + (f", {images.why}" if images.why != "ended" else "")
            for images in found
        )
        self._log.add(
            "images_recorded",
            message=f"{self._directory}: {text}",
            name=self._directory,
            images=ImagesRecorded(self._directory, found),
            origin="gateway",
        )
        self._directory, self._until = "", None


class Recordings:
    """The flight ring, and the current recording on request, if any. ``path``: its file, or that of the last one.

    A file that cannot be written ends early or is never started (``refused``); events and notes by ``tell`` have the
    cause.
    """

    def __init__(self, plan: RunPlan, log: EventLog, set_note: SetNote) -> None:
        self._plan = plan
        self._log = log
        self._set_note = set_note
        self._requested = bool(plan.record)
        section = plan.cell.recording
        limits = RingLimits(
            60.0 * section.ring_minutes,
            section.ring_mib << 20,
            section.reserve_mib << 20,
            section.kept_faults,
        )
        self._ring = RingThread(plan.directories.recordings, limits) if limits.bytes else None
        self._recorder: FlightRecorder | None = None
        self._with_images = False
        self._failed = False
        self.images = ImageRecordings(plan, log)
        self.path = ""
        self.refused = False

    @property
    def running(self) -> bool:
        """Whether a file is being written; one that a full disk has ended is not."""
        return self._recorder is not None and not self._recorder.failure

    @property
    def wants_steps(self) -> bool:
        """Whether step records are needed at all."""
        return self._requested or self._ring is not None

    def request(self) -> None:
        """Record into a separate file from the next stream of steps on."""
        self._requested = True

    def keep_ring(self, t_ns: int) -> None:
        """Save the ring, for a fault at ``t_ns``."""
        if self._ring is not None:
            self._ring.keep(t_ns)

    def poll(self) -> None:
        """Publish the ring's reports, with a note while it is not written, and the state of image recordings."""
        if self._ring is not None:
            while self._ring.reports:
                kind, message = self._ring.reports.popleft()
                if kind == "warning":
                    self._set_note("flight ring", message)
                else:
                    self._log.add(kind, message=message, origin="gateway")
            if not self._ring.trouble:
                self._set_note("flight ring", "")
        self.images.poll()

    def close(self) -> None:
        """Finish the ring's segment and the recording. Idempotent."""
        self.stop()
        if self._ring is not None:
            self._ring.close()
        self.poll()

    def want_images(self) -> None:
        """Also record images: now, or with the recording that is about to start. Raises CannotRecordError."""
        self.images.check()
        self._with_images = True
        if self._recorder is not None and self.running and not self.images.running:
            self.images.begin(self._recorder.path)

    def take(self, item: StepMessage) -> None:
        """Write messages of the servo process; the first one starts a file, if one is requested."""
        if self._ring is not None:
            self._ring.take(item)
        if isinstance(item, RecordingStart) and self._requested:
            again = self._with_images
            self.stop()
            self._requested = True
            self._begin(item)
            if again and self._recorder is not None:
                self.want_images()
        elif self._recorder is not None and not isinstance(item, RecordingStart):
            self._recorder.write(item)
            if self._recorder.failure and not self._failed:
                self._fail(_summary(self._recorder))

    def _begin(self, start: RecordingStart) -> None:
        self._failed = False
        path = self._new_path()
        self.path = str(path)
        try:
            self._recorder = FlightRecorder(path, start.settings, start.fingerprint)
        except OSError as error:
            self.refused, self._requested = True, False
            self._fail(f"{path}: no recording: {error.strerror}")
            return
        self.refused = False
        self._set_note("recording", "")
        self._log.add("recording", message=self.path, origin="gateway")

    def _fail(self, text: str) -> None:
        self._failed = True
        self._log.add("recording_failed", message=text, name=self.path, accepted=False, origin="gateway")
        self._set_note("recording", text)

    def _new_path(self) -> Path:
        """The requested file; another name if it exists (a restarted gateway continues in a new file)."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        requested = Path(self._plan.record) if self._plan.record not in ("", "auto") else None
        if requested is not None:
            return requested.with_stem(f"{requested.stem}-{stamp}") if requested.exists() else requested
        return self._plan.directories.recordings / f"{self._plan.cell.cell.name}-{stamp}.mcap"

    def stop(self) -> str:
        """Finish the file and the image recordings; returns the content's statistics. Idempotent."""
        self._requested = self._with_images = False
        self.refused = False
        self.images.end()
        if self._recorder is None:
            return f"{self.path}: 0 steps"
        recorder, self._recorder = self._recorder, None
        recorder.close()
        if recorder.failure and not self._failed:
            self._fail(_summary(recorder))
        return _summary(recorder)


def _summary(recorder: FlightRecorder) -> str:
    """Steps of a recording, and the reason why it ended early."""
    text = f"{recorder.path}: {recorder.steps} steps"
    if recorder.failure:
        text += f", {recorder.dropped} left out: {recorder.failure}"
    return text
