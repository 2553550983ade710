"""A camera of a cell: its driver and detector made from the cell file, and what the two together say of themselves."""

from __future__ import annotations

from pathlib import Path

import msgspec

from stereoservo.runtime import plugins
from stereoservo.runtime.cellfile import CameraSection, CellFileError
from stereoservo.runtime.ports import CameraDescription, CameraDriver, Detector, DriverContext


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
    """The driver's description under the cell's name of it, with the detector's marker ids and systematic error.

    Raises CellFileError: a detector too many or too few, a camera that can report no marker.
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
