"""The cameras of a cell as they were recorded: the driver ``video`` in the place of their own, with their detectors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereoservo.runtime.cameras import describe_camera, make_camera
from stereoservo.runtime.cellfile import CameraSection, CellFile
from stereoservo.runtime.clock import MonotonicClock
from stereoservo.runtime.image_files import ImageReader
from stereoservo.runtime.ports import (
    CameraDescription,
    CameraDriver,
    CameraObservation,
    Detector,
    DriverContext,
    DriverError,
    Frame,
)

VIDEO = "video"
OVER = ("end_of_file", "truncated")
"""What the driver says when a recording has no more frames; the second where one of its files is cut off."""


@dataclass(frozen=True)
class RecordedCamera:
    """A camera's recording, opened by :meth:`observations`."""

    file: Path
    description: CameraDescription
    driver: CameraDriver
    detector: Detector

    def observations(
        self, note: Callable[[str], None], wanted: Callable[[int], bool] = lambda t_shutter_ns: True
    ) -> Iterator[CameraObservation]:
        """What the detector finds in frame after frame, without priors; stamps are those of the recording.

        ``wanted`` is asked of each frame before it is given to the detector; ``note`` is told where a file is cut off.
        Raises DriverError: a damaged file, a picture of another size.
        """
        try:
            self.driver.configure()
            self.driver.activate()
            while True:
                try:
                    arrived = self.driver.poll()
                except DriverError as error:
                    if error.code not in OVER:
                        raise
                    if error.code != "end_of_file":
                        note(str(error))
                    return
                for frame in arrived:
                    assert isinstance(frame, Frame)
                    if wanted(frame.t_shutter_ns):
                        yield self.detector.detect(frame, None)
        finally:
            self.driver.deactivate()
            self.driver.close()


def video_of(directory: Path, camera: str) -> Path:
    """Where the recording of a camera lies in a directory of images."""
    return directory / f"{camera}.avi"


def recorded_camera(cell: CellFile, cell_path: Path, name: str, file: Path, start: int = 0) -> RecordedCamera:
    """Driver and detector of camera ``name`` of a cell, on a file recorded of it, from frame ``start`` on.

    The detector is the cell file's, the options of the camera's own driver have had their effect when it was recorded.
    Raises ImageFileError, PluginError, DriverError, CellFileError.
    """
    section = next(camera for camera in cell.camera if camera.name == name)
    with ImageReader(file, name) as reader:
        header = reader.header
    options: dict[str, Any] = {
        "source": str(file.absolute()), "width": header.width, "height": header.height, "rate_hz": header.rate_hz,
        "pace": "every", "start": start,
    }  # fmt: skip
    recorded = CameraSection(
        name=name, driver=VIDEO, detector=section.detector, mount=section.mount, options=options,
        detector_options=section.detector_options,
    )  # fmt: skip
    context = DriverContext(
        clock=MonotonicClock(), cell=cell.cell.name, runtime_dir=file.parent, cell_dir=cell_path.parent, camera=name,
        mount=section.mount,
    )  # fmt: skip
    driver, detector = make_camera(recorded, context)
    description = describe_camera(recorded, driver, detector, cell_path)
    assert detector is not None  # describe_camera refuses a camera of frames without one
    return RecordedCamera(file, description, driver, detector)
