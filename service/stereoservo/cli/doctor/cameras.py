"""Examination of the cameras for ``stereoservo doctor``: opens them, records detections for some seconds, collects the
findings, and writes annotated pictures.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import cv2
import msgspec
import numpy as np

from stereoservo.cli.doctor.camera_findings import CameraRecord, examine_record, examine_skew, near_border
from stereoservo.cli.doctor.plate_motion import examine_sides
from stereoservo.cli.doctor.view_consistency import examine_coverage, examine_views, same_camera_twice
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.camera_setup import make_camera
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, hardware_lock_path, holder
from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    CameraDriver,
    CameraObservation,
    CameraStatistics,
    CountingCameraDriver,
    Detector,
    DriverError,
    ExaminationFinding,
    ExplainingDetector,
    Frame,
)

SAME_REMEDY = "camera.options of one of them: each camera has its own"
FIRST_FRAME_S = 6.0
"""How long a camera may take to deliver its first frame."""
POLL_S = 0.002
DEFAULT_MARKERS = 4
GREEN, RED = (0, 200, 0), (0, 0, 230)


class WatchedCamera:
    """An open camera, whose frames are detected in and recorded."""

    def __init__(self, record: CameraRecord, driver: CameraDriver, detector: Detector | None) -> None:
        self.record = record
        self._driver = driver
        self._detector = detector
        self._began: CameraStatistics | None = None
        self._began_s = time.monotonic()

    def poll(self) -> None:
        """Take the frames that arrived; an error ends the observation of this camera, not of the others."""
        if self.record.error:
            return
        try:
            arrived = self._driver.poll()
            if not arrived:
                return
            newest = arrived[-1]
            if isinstance(newest, Frame):
                self.record.frame = newest
                assert self._detector is not None  # describe_camera has seen to it
                newest = self._detector.detect(newest, None)
            assert isinstance(newest, CameraObservation)
            self.record.seen.append(newest)
        except DriverError as error:
            self.record.error = str(error)

    def begin(self) -> None:
        """Discard the frames so far: first frames are late, kernels are compiled, cameras are opened one after the
        other.
        """
        self.record.seen.clear()
        self._began = self._counts()
        self._began_s = time.monotonic()

    def _counts(self) -> CameraStatistics | None:
        return self._driver.statistics() if isinstance(self._driver, CountingCameraDriver) else None

    def finish(self) -> None:
        """Final counts and, where nothing was found, a search in the mirror image. Releases the camera."""
        now = self._counts()
        if now is not None:
            before = self._began or CameraStatistics()
            self.record.statistics = CameraStatistics(
                frames=now.frames - before.frames, dropped=now.dropped - before.dropped,
                frozen=now.frozen - before.frozen, reconnects=now.reconnects - before.reconnects,
                settings=now.settings, server_clock=now.server_clock,
            )  # fmt: skip
            self.record.watched_s = time.monotonic() - self._began_s
        frame = self.record.frame
        none = not any(o.ids.size for o in self.record.seen)
        if isinstance(self._detector, ExplainingDetector):
            self.record.refused = dict(self._detector.refused)
        if frame is not None and self._detector is not None and none and not self.record.error:
            mirror = msgspec.structs.replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]))
            self.record.flipped = int(self._detector.detect(mirror, None).ids.size)
        try:
            self._driver.deactivate()
        finally:
            self._driver.close()


def examine_cameras(
    plan: RunPlan, settings: CoreSettings, model: CellModel | None, seconds: float, pictures: Path
) -> Iterator[ExaminationFinding]:
    """Findings on the cell's cameras; an image of each is written to ``pictures``. Skipped while another process
    has them.
    """
    directories = plan.directories
    pid = holder(directories.daemon_lock)
    if pid is not None:
        yield ExaminationFinding(
            "cameras", None, f"not examined: the daemon (process {pid}) has them", f"`kill {pid}`"
        )
        return
    with ExitStack() as locks:
        try:
            twice = lock_cameras(plan, locks)
        except AlreadyRunningError as error:
            yield ExaminationFinding("cameras", None, f"not examined: {error}")
            return
        if twice:
            yield ExaminationFinding("cameras", False, twice, SAME_REMEDY)
            return
        records = watch_cameras(plan, seconds)
    min_markers = DEFAULT_MARKERS if settings.trials is None else settings.trials.min_markers
    for record in records:
        yield from examine_record(record, min_markers)
        if (finding := near_border(record)) is not None:
            yield finding
    yield from examine_skew(records)
    if (same := same_camera_twice(records)) is not None:
        yield same
    elif (sides := examine_sides(records)) is not None:
        yield sides
    yield from examine_views(records, model)
    if model is not None and settings.trials is not None:
        yield from examine_coverage(model, settings.trials, records)
    yield from _save_pictures(records, pictures)


def lock_cameras(plan: RunPlan, locks: ExitStack) -> str:
    """Take the locks of the cell's cameras for as long as ``locks`` lasts; which two are one and the same, else ''.

    Raises AlreadyRunningError where another process has one.
    """
    owners: dict[Path, str] = {}
    for section in plan.cell.camera:
        path = hardware_lock_path(plan.directories.runtime.parent, section.driver, section.options)
        if path is None:
            continue
        if path in owners:
            return f"{owners[path]!r} and {section.name!r} are one and the same camera"
        locks.enter_context(ChannelLock(path, f"camera {section.name!r}"))
        owners[path] = section.name
    return ""


def watch_cameras(plan: RunPlan, seconds: float) -> list[CameraRecord]:
    """Open all cameras, observe them for ``seconds`` from their first frames, release them."""
    clock = MonotonicClock()
    records, watched = [], []
    for section, description in zip(plan.cell.camera, plan.cameras, strict=True):
        record = CameraRecord(description)
        records.append(record)
        driver, detector = make_camera(section, plan.driver_context(clock, section))
        camera = WatchedCamera(record, driver, detector)
        watched.append(camera)
        try:
            driver.configure()
            driver.activate()
        except DriverError as error:
            record.error = str(error)
    try:
        give_up_ns = clock.now_ns() + int(FIRST_FRAME_S * 1e9)
        until_ns = 0
        while not until_ns or clock.now_ns() < until_ns:
            for camera in watched:
                camera.poll()
            everybody = all(record.seen or record.error for record in records)
            if not until_ns and (everybody or clock.now_ns() > give_up_ns):
                until_ns = clock.now_ns() + int(seconds * 1e9)
                for camera in watched:
                    camera.begin()
            time.sleep(POLL_S)
    finally:
        for camera in watched:
            camera.finish()
    return records


def annotated(image: ImageArray, observation: CameraObservation) -> ImageArray:
    """The image in colour with the detected markers: circles, ids, standard deviations a hundredfold."""
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for marker, (u, v), C in zip(
        observation.ids.tolist(), observation.pixels, observation.covariances, strict=True
    ):
        centre = (round(u * 16), round(v * 16))
        sigma = float(np.sqrt(0.5 * np.trace(C)))
        cv2.circle(picture, centre, 16 * 9, GREEN, 1, cv2.LINE_AA, 4)
        cv2.circle(picture, centre, max(16, round(16 * 100 * sigma)), RED, 1, cv2.LINE_AA, 4)
        cv2.putText(
            picture, str(marker), (round(u) + 10, round(v) - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, GREEN, 1, cv2.LINE_AA
        )  # fmt: skip
    caption = f"{observation.camera}: {observation.ids.size} markers; red: 100 standard deviations"
    cv2.putText(picture, caption, (8, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, GREEN, 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def _save_pictures(records: list[CameraRecord], directory: Path) -> Iterator[ExaminationFinding]:
    saved = []
    for record in records:
        if record.frame is None or not record.seen:
            continue
        path = directory / f"{record.name}.png"
        try:
            directory.mkdir(parents=True, exist_ok=True)
            done, data = cv2.imencode(".png", annotated(record.frame.image, record.seen[-1]))
            if not done:
                raise OSError(f"{path}: the picture could not be encoded as PNG")
            path.write_bytes(data.tobytes())
        except OSError as error:
            yield ExaminationFinding(
                "pictures", None, f"not saved: {error}", "--pictures DIR that can be written"
            )
            return
        saved.append(str(path))
    if saved:
        yield ExaminationFinding(
            "pictures", True, "what each camera sees, and what was found in it: " + ", ".join(saved)
        )
