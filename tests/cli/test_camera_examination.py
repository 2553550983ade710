"""`stereoservo doctor` before cameras: through drivers, detectors and files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.cli import main as cli
from stereoservo.cli.doctor import cameras
from stereoservo.cli.doctor.camera_findings import CameraRecord, examine_record
from stereoservo.cli.doctor.cameras import WatchedCamera, annotated
from stereoservo.messages.directories import cell_directories, create_directories
from stereoservo.messages.locks import FileLock
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    CameraDescription,
    CameraObservation,
    CameraStatistics,
    DetectorDescription,
    DriverContext,
    DriverError,
    Frame,
    Prior,
)
from stereoservo_drivers.edges import EdgeDetector
from stereoservo_drivers.fake import FakeCameraDriver
from stereoservo_sim.cells import shipped_cell_path

DESCRIPTION = CameraDescription("still", "left", 64, 48, 30.0, "frames", 1000.0, (1, 2))


class StillCamera:
    """A picture whose left half is bright; fails after ``fails_after`` polls."""

    def __init__(self, fails_after: int = 1000) -> None:
        self.polls = 0
        self.fails_after = fails_after
        self.closed = False

    def describe(self) -> CameraDescription:
        return DESCRIPTION

    def configure(self) -> None: ...

    def activate(self) -> None: ...

    def poll(self) -> list[Frame]:
        self.polls += 1
        if self.polls > self.fails_after:
            raise DriverError("frozen", "the picture stands still")
        image = np.zeros((48, 64), np.uint8)
        image[:, :32] = 200
        return [Frame("left", self.polls, self.polls * 33_000_000, self.polls * 33_000_000 + 1, image)]

    def statistics(self) -> CameraStatistics:
        return CameraStatistics(frames=self.polls)

    def deactivate(self) -> None: ...

    def close(self) -> None:
        self.closed = True


class RightHalfDetector:
    """Sees two markers where the right half is brighter: in the mirror image only."""

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None: ...

    def describe(self) -> DetectorDescription:
        return DetectorDescription("right-half", (1, 2))

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        n = 2 if frame.image[:, 32:].mean() > frame.image[:, :32].mean() else 0
        pixels = np.full((n, 2), 20.0)
        return CameraObservation(
            frame.camera, frame.seq, frame.t_shutter_ns, frame.t_received_ns, np.arange(1, n + 1), pixels,
            np.broadcast_to(0.01 * np.eye(2), (n, 2, 2)).copy(),
        )  # fmt: skip


def detector() -> RightHalfDetector:
    context = DriverContext(clock=None, cell="c", runtime_dir=Path(), cell_dir=Path())  # type: ignore[arg-type]
    return RightHalfDetector({}, context)


def test_nothing_found_is_looked_for_in_the_mirror_image() -> None:
    driver = StillCamera()
    camera = WatchedCamera(CameraRecord(DESCRIPTION), driver, detector())
    camera.poll()
    camera.begin()
    for _ in range(5):
        camera.poll()
    camera.finish()
    assert camera.record.flipped == 2
    assert len(camera.record.seen) == 5
    assert camera.record.statistics == CameraStatistics(frames=5)
    assert driver.closed


def test_an_error_ends_the_watch_of_its_camera_and_is_kept() -> None:
    driver = StillCamera(fails_after=2)
    camera = WatchedCamera(CameraRecord(DESCRIPTION), driver, detector())
    for _ in range(4):
        camera.poll()
    camera.finish()
    assert camera.record.error == "the picture stands still"
    assert driver.polls == 3
    assert driver.closed


def test_the_saved_picture_shows_what_was_found() -> None:
    image = np.full((48, 64), 90, np.uint8)
    pixels = np.array([[30.0, 24.0]])
    seen = CameraObservation("left", 1, 0, 0, np.array([7]), pixels, np.full((1, 2, 2), 0.0025) * np.eye(2))
    picture = annotated(image, seen)
    assert picture.shape == (48, 64, 3)
    ring = picture[24, 39]  # nine pixels to the right
    assert ring[1] > ring[0] + 50
    np.testing.assert_array_equal(image, 90)


def test_it_is_told_why_a_detector_reports_no_markers(tmp_path: Path) -> None:
    """The detector of edges, before a picture without its part; then of single vertices, by reason."""
    part = shipped_cell_path("edges").parent
    context = DriverContext(MonotonicClock(), "c", tmp_path, part, camera="left")
    camera = WatchedCamera(CameraRecord(DESCRIPTION), StillCamera(), EdgeDetector({"part": "wedge.part"}, context))
    for _ in range(3):
        camera.poll()
    camera.finish()
    found = {finding.name: finding for finding in examine_record(camera.record, 4)}
    assert found["left refused"].ok is None
    assert "newest picture: no pose of the part explains enough edges" in found["left refused"].message
    camera.record.refused = {401: "its edges do not meet", 400: "its edges do not meet", 402: "it is outside"}
    (finding,) = (one for one in examine_record(camera.record, 4) if one.name == "left refused")
    assert finding.message.endswith("400, 401: its edges do not meet; 402: it is outside")
    camera.record.refused = {}
    assert not any(one.name == "left refused" for one in examine_record(camera.record, 4))


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    path = tmp_path / "cell.toml"
    assert cli.invoke(["init", str(path)]) == 0
    return path


def doctor(capfd: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, dict[str, Any]]]:
    capfd.readouterr()
    code = cli.invoke(["doctor", *arguments, "--json"])
    result = json.loads(capfd.readouterr().out)
    checks = result["error"]["checks"] if code else result["checks"]
    return code, {check["name"]: check for check in checks}


def test_doctor_tells_of_every_camera(cell: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, checks = doctor(capfd, str(cell), "--seconds", "0.5")
    assert code == 0, checks
    for name in ("left rate", "right latency", "left markers", "skew left-right", "views left-right"):
        assert name in checks
    assert "pictures" not in checks  # the fake camera delivers no picture
    _, checks = doctor(capfd, str(cell), "--seconds", "0")
    assert "left rate" not in checks


def test_a_camera_that_cannot_be_opened_is_a_failed_check(
    cell: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def configure(driver: FakeCameraDriver) -> None:
        if driver.name == "left":
            raise DriverError("open", "left: the lens cap is on")

    monkeypatch.setattr(FakeCameraDriver, "configure", configure)
    monkeypatch.setattr(FakeCameraDriver, "activate", lambda _: None)
    monkeypatch.setattr(FakeCameraDriver, "poll", lambda _: [])
    monkeypatch.setattr(cameras, "FIRST_FRAME_S", 0.1)
    code, checks = doctor(capfd, str(cell), "--seconds", "0.1")
    assert code == 1
    assert checks["camera left"]["message"] == "left: the lens cap is on"
    assert "0 frames" in checks["camera right"]["message"]


def test_cameras_of_a_running_daemon_are_left_alone(cell: Path, capfd: pytest.CaptureFixture[str]) -> None:
    name = next(line.split('"')[1] for line in cell.read_text().splitlines() if line.startswith("name = "))
    directories = cell_directories(name)
    create_directories(directories)
    with FileLock(directories.daemon_lock, "cell"):
        code, checks = doctor(capfd, str(cell))
    assert code == 0
    assert "the daemon" in checks["cameras"]["message"]


def test_one_source_of_two_cameras_is_a_failed_check_and_names_both(
    cell: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(cameras, "hardware_lock_path", lambda *_: tmp_path / "channel-video-0.lock")
    code, checks = doctor(capfd, str(cell), "--seconds", "0.1")
    assert code == 1
    assert "'left' and 'right' are one and the same camera" in checks["cameras"]["message"]
    assert "left rate" not in checks
    with FileLock(tmp_path / "channel-video-0.lock", "released"):
        pass
