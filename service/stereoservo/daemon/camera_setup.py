"""Constructs the camera drivers and detectors of a cell from its cell file, describes them for the other processes, and
opens recorded cameras instead of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from stereoservo.daemon.ipc_messages import rounded
from stereoservo.messages.cell_file import CameraSection, CellFile, CellFileError
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    CameraDescription,
    CameraDriver,
    CameraObservation,
    Detector,
    DriverContext,
    DriverError,
    Frame,
)
from stereoservo.ports.image_files import ImageReader


def make_camera(section: CameraSection, context: DriverContext) -> tuple[CameraDriver, Detector | None]:
    """Driver and detector of a camera, constructed and not connected. Raises PluginError, DriverError."""
    driver: CameraDriver = plugins.load(plugins.CAMERA_DRIVERS, section.driver)(section.options, context)
    detector: Detector | None = None
    if section.detector:
        detector = plugins.load(plugins.DETECTORS, section.detector)(section.detector_options, context)
    return driver, detector


def describe_camera(
    section: CameraSection, driver: CameraDriver, detector: Detector | None, cell_path: Path | str = "<cell>"
) -> CameraDescription:
    """The driver's description with the cell's name for the camera, the detector's marker ids and systematic error.

    Raises CellFileError for an unexpected or missing detector, or a camera that can report no marker.
    """
    description = msgspec.structs.replace(driver.describe(), name=section.name)
    if detector is not None:
        if description.delivers == "observations":
            raise CellFileError(
                cell_path,
                "camera.detector",
                f"camera {section.name!r} delivers observations; leave the detector out",
            )
        found = detector.describe()
        description = msgspec.structs.replace(
            description, marker_ids=found.marker_ids, systematic_px=found.systematic_px
        )
    elif description.delivers == "frames":
        known = ", ".join(plugins.names(plugins.DETECTORS)) or "none installed"
        raise CellFileError(
            cell_path,
            "camera.detector",
            f"camera {section.name!r} delivers frames and needs a detector; there are: {known}",
        )
    if not description.marker_ids:
        raise CellFileError(
            cell_path, "camera", f"camera {section.name!r} can report no marker; check its detector's options"
        )
    return description


VIDEO = "video"
END_CODES = ("end_of_file", "truncated")
"""Codes of the driver's error when a recording has no more frames; the second if one of its files is truncated."""


@dataclass(frozen=True)
class RecordedCamera:
    """A camera's recording, opened by :meth:`observations`."""

    file: Path
    description: CameraDescription
    driver: CameraDriver
    detector: Detector

    def observations(
        self, log: Callable[[str], None], accepts: Callable[[int], bool] = lambda t_shutter_ns: True
    ) -> Iterator[CameraObservation]:
        """Observations of the frames in order, detected without priors; stamps are those of the recording.

        Markers are detected only in frames whose shutter time is ``accepts``; ``log`` is called if a file is truncated.
        Raises DriverError for a damaged file or an image of another size.
        """
        try:
            self.driver.configure()
            self.driver.activate()
            while True:
                try:
                    arrived = self.driver.poll()
                except DriverError as error:
                    if error.code not in END_CODES:
                        raise
                    if error.code != "end_of_file":
                        log(str(error))
                    return
                for frame in arrived:
                    assert isinstance(frame, Frame)
                    if accepts(frame.t_shutter_ns):
                        yield rounded(self.detector.detect(frame, None))
        finally:
            self.driver.deactivate()
            self.driver.close()


def video_of(directory: Path, camera: str) -> Path:
    """File of a camera's recording in a directory of images."""
    return directory / f"{camera}.avi"


def recorded_camera(cell: CellFile, cell_path: Path, name: str, file: Path, start: int = 0) -> RecordedCamera:
    """Driver and detector of camera ``name`` of a cell, for a file recorded from it, from frame ``start`` on.

    The detector is that of the cell file; the options of the camera's driver are not used, because they took effect
    during the recording. Raises ImageFileError, PluginError, DriverError, CellFileError.
    """
    section = next(camera for camera in cell.camera if camera.name == name)
    with ImageReader(file, name) as reader:
        header = reader.header
    options: dict[str, Any] = {
        "source": str(file.absolute()),
        "width": header.width,
        "height": header.height,
        "rate_hz": header.rate_hz,
        "pace": "every",
        "start": start,
    }
    recorded = CameraSection(
        name=name,
        driver=VIDEO,
        detector=section.detector,
        mount=section.mount,
        options=options,
        detector_options=section.detector_options,
    )
    context = DriverContext(
        clock=MonotonicClock(),
        cell=cell.cell.name,
        runtime_dir=file.parent,
        cell_dir=cell_path.parent,
        camera=name,
        mount=section.mount,
    )
    driver, detector = make_camera(recorded, context)
    description = describe_camera(recorded, driver, detector, cell_path)
    assert detector is not None  # describe_camera rejects a camera that delivers frames without one
    return RecordedCamera(file, description, driver, detector)
