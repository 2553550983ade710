"""From a recording with images to trial data: the cell's detectors on the recorded pictures, at the rests of the
flight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData
from stereoservo.runtime.calibration_job import CalibrationJob
from stereoservo.runtime.cellfile import CellFile, load_cell_file
from stereoservo.runtime.flight import Flight, read_flight
from stereoservo.runtime.image_order import IMAGES_SUFFIX
from stereoservo.runtime.image_trials import ImageTrials
from stereoservo.runtime.ports import CameraObservation, JointDriverDescription, JointSpec
from stereoservo.runtime.recorded_cameras import RecordedCamera, recorded_camera, video_of
from stereoservo.runtime.settings import CoreSettings, core_settings

Note = Callable[[str], None]
Progress = Callable[[str, int], None]


@dataclass(frozen=True)
class FoundTrials:
    """Trial data out of recorded images; ``left_out``: why rests were not used, with their number; ``frames`` averaged;
    ``standing``: markers that stood still.
    """

    trials: TrialData
    stops: int
    frames: int
    left_out: dict[str, int]
    standing: tuple[int, ...]


def flight_of(images: Path) -> Path:
    """The flight recording that a directory of images belongs to: ``NAME.mcap`` beside ``NAME.images``."""
    return images.absolute().with_suffix(".mcap")


def trials_from_images(cell_path: Path, images: Path, note: Note, progress: Progress) -> FoundTrials:
    """Run the cell's detectors over the recorded cameras and average as the trial motions do.

    ``progress`` hears the camera and the number of its frame. Raises CalibrationError (``bad_data``,
    ``too_few_stops``), RecordingError, ImageFileError, PluginError, DriverError, CellFileError.
    """
    cell = load_cell_file(cell_path)
    if not images.is_dir() or images.suffix != IMAGES_SUFFIX:
        raise CalibrationError(
            "bad_data",
            f"{images} is no directory of recorded images; `stereoservo record CELL --images` makes one, "
            f"NAME{IMAGES_SUFFIX} beside NAME.mcap",
        )
    flight = read_flight(flight_of(images))
    cameras = [
        recorded_camera(cell, cell_path, section.name, video_of(images, section.name))
        for section in cell.camera
    ]
    settings = _settings(cell, cell_path, flight, cameras)
    if settings.trials is None:
        raise CalibrationError(
            "bad_data",
            f"{cell_path} has no [calibration] section; base, frames and settle_s of the trial motions are needed",
        )
    gathered = ImageTrials(flight, settings, settings.trials)
    for camera in cameras:
        gathered.add(_observations(camera, gathered, note, progress))
    job = CalibrationJob(settings)
    events = gathered.events()
    for event in events:
        job.add(event)
    trials = job.trials()
    return FoundTrials(trials, len(events), trials.images, gathered.left_out, job.standing)


def _observations(
    camera: RecordedCamera, gathered: ImageTrials, note: Note, progress: Progress
) -> Iterator[CameraObservation]:
    name, frames = camera.description.name, 0

    def wanted(t_shutter_ns: int) -> bool:
        nonlocal frames
        frames += 1
        progress(name, frames)
        return gathered.wants(name, t_shutter_ns)

    return camera.observations(note, wanted)


def _settings(cell: CellFile, cell_path: Path, flight: Flight, cameras: list[RecordedCamera]) -> CoreSettings:
    """The core's settings for the cell file of now, the recorded joints, and the detectors on the recorded cameras."""
    recorded = flight.settings
    limits = {limit.joint: limit for limit in cell.safety.limit}
    if set(limits) != set(recorded.joint_names):
        raise CalibrationError(
            "bad_data",
            f"the flight recording is of joints {', '.join(recorded.joint_names)}; {cell_path} has "
            f"{', '.join(limits)}: is it of this cell?",
        )
    for camera in cameras:
        was = next((one for one in recorded.cameras if one.name == camera.description.name), None)
        size = camera.description.width, camera.description.height
        if was is None or (was.width, was.height) != size:
            told = "has no such camera" if was is None else f"has it with {was.width}x{was.height} px"
            raise CalibrationError(
                "bad_data",
                f"{camera.file} holds pictures of {size[0]}x{size[1]} px of camera {camera.description.name!r}; the "
                f"flight recording {told}: do they belong together?",
            )
    joints = JointDriverDescription(
        driver=cell.joints.driver,
        joints=tuple(
            JointSpec(
                name, kind, limits[name].min, limits[name].max, limits[name].velocity, limits[name].acceleration
            )
            for name, kind in zip(recorded.joint_names, recorded.joint_kinds, strict=True)
        ),
        rate_hz=recorded.rate_hz, pacing="clock", command_timeout_s=0.1, call_budget_us=0.0,
    )  # fmt: skip
    return core_settings(cell, joints, tuple(camera.description for camera in cameras))
