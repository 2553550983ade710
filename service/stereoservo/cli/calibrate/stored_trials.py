"""Calibration from stored trial data for ``stereoservo calibrate CELL --trials FILE.npz``: lenses from a file of
straight lines, fit, stored model, and its sources.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.calibration.single_joint_fit import MIN_STOPS
from stereoservo.calibration.trial_data import CalibrationError, TrialData, report_folder
from stereoservo.cli.output import CommandError, log, read_columns
from stereoservo.core.cycle import Event, PathFrame, PathRecord
from stereoservo.core.monitor_state import ObservationStatistics
from stereoservo.core.rest_averages import add_observation, averages, measurement_buffers
from stereoservo.core.settings import CoreSettings, TrialSettings, core_settings
from stereoservo.core.sources.measure_at_pose import too_few_seen
from stereoservo.core.sources.sweeps import path_frame
from stereoservo.daemon.camera_setup import RecordedCamera, recorded_camera, video_of
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.gateway.child_jobs import calibration_result
from stereoservo.gateway.persistence import ModelStore
from stereoservo.messages.cell_file import CellFile, JointLimit, load_cell_file
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.locks import holder
from stereoservo.messages.recording_request import IMAGES_SUFFIX
from stereoservo.messages.wire import CalibrationResult
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, JointDriverDescription, JointSpec
from stereoservo.recording.recorded_motion import (
    RecordedMotion,
    RestInterval,
    StraightMotion,
    read_motion,
    rest_intervals,
    straight_motions,
)


class LinesUsed(msgspec.Struct, frozen=True):
    """Straight lines that determined the lenses: names of the lines by camera, noise of their pixels [px]."""

    file: str
    sigma_px: float
    cameras: dict[str, tuple[str, ...]]


class StoredFit(CalibrationResult, frozen=True):
    """A fit of stored trials. ``use``: when the cell starts to use it. ``lines``: None without ``--lines``."""

    use: str = ""
    lines: LinesUsed | None = None


def source_of_stored(result: StoredFit) -> str:
    """Sources and use of a fit of stored trials, as lines of text."""
    lines = [f"  fitted in {result.seconds:.1f} s"]
    if result.lines is not None:
        used = "; ".join(f"{name}: {', '.join(names)}" for name, names in result.lines.cameras.items())
        lines.append(f"  lines  {result.lines.file} (noise {result.lines.sigma_px:g} px), {used}")
    lines.append(f"  {result.use}")
    return "\n".join(lines)


def fit_stored_trials(cell: str, path: Path, lines: Path | None, lines_sigma: float, output: Path | None) -> StoredFit:
    """Fit stored trial data in this process; the model is stored among the cell's models unless ``output`` is given.

    It is stored there only while no daemon runs: a daemon would keep its model, and use this one unrequested at its
    next start.

    Raises CommandError, CalibrationError, ModelFileError, OSError, CellFileError.
    """
    # scipy and the fit are slow to import; commands that only talk to a daemon do without them.
    from stereoservo.calibration.fit_assessment import assess_failure
    from stereoservo.calibration.trial_data import CalibrationError, load_trials
    from stereoservo.daemon.jobs.fit_job import fit_trials, report_fit

    file, name, directory = resolve_cell(cell, output)
    data = load_trials(path)
    if file is not None:
        _must_fit(file, data, path)
    beside = output is None
    if output is None:
        directory.mkdir(parents=True, exist_ok=True)
        store = ModelStore(directory)
        epoch = store.next_epoch()
        output = store.path(epoch)
    else:
        epoch = 0
    calibration = None if file is None else file.calibration
    known = "" if calibration is None else calibration.known_length
    priors, used = (None, None) if lines is None else read_lines(lines, lines_sigma, data)
    started = time.monotonic()
    try:
        result, assessment = fit_trials(data, output, epoch, lens_priors=priors)
    except CalibrationError as error:
        failure = assess_failure(error.code, error.message)
        page_path = report_fit(data, path, output, None, failure)
        raise CommandError(error.code, f"{failure.text} A report is in {page_path}", report=str(page_path)) from error
    seconds = time.monotonic() - started
    try:
        page: Path | None = report_fit(data, path, output, result, assessment, known)
    except OSError as error:
        log(f"no report could be written into {report_folder(output)}: {error}")
        page = None
    figures = calibration_result(result.model, output, assessment, page, path, seconds)
    use = (
        f"the daemon of cell {name!r} takes this model at its next start, where it fits the cell's joints, cameras and "
        "markers (`stereoservo doctor` tells); remove the file if it is not to"
        if beside
        else f"no daemon takes this model: it lies outside of {directory}"
    )
    return StoredFit(**msgspec.structs.asdict(figures), use=use, lines=used)


def resolve_cell(cell: str, output: Path | None) -> tuple[CellFile | None, str, Path]:
    """The cell file, if given, the cell's name, and its directory of models.

    Raises CommandError if a fit could not be stored, CellFileError.
    """
    from stereoservo.messages.files import check_writable

    if output is not None:
        try:
            check_writable(output)
        except OSError as error:
            raise CommandError("output", f"--output: {error.filename}: {error.strerror}") from error
    file = load_cell_file(Path(cell)) if cell.endswith(".toml") else None
    name = cell if file is None else file.cell.name
    directory = cell_directories(name).models
    if output is None:
        _must_not_run(name)
    elif output.resolve().parent == directory.resolve():
        raise CommandError(
            "output",
            f"--output: {directory} is where cell {name!r} keeps its numbered models: leave --output away to put the "
            "model there, or give another directory",
        )
    return file, name, directory


def _must_not_run(name: str) -> None:
    directories = cell_directories(name)
    pid = holder(directories.daemon_lock)
    if pid is not None:
        raise CommandError(
            "daemon_running",
            f"the daemon of cell {name!r} runs (pid {pid or 'unknown'}): it would keep its model and silently take "
            "this one at its next start. Either give --output FILE.json in another directory than "
            f"{directories.models}, or stop the daemon and run this again",
            cell=name,
            pid=pid,
        )


def _must_fit(file: CellFile, data: Any, path: Path) -> None:
    cameras = [camera.name for camera in file.camera]
    joints = {limit.joint for limit in file.safety.limit} or set(data.joint_names)  # not stated for a simulated arm
    if [camera.name for camera in data.cameras] != cameras or set(data.joint_names) != joints:
        raise CommandError(
            "other_cell",
            f"{path} is of joints {', '.join(data.joint_names)} and cameras "
            f"{', '.join(camera.name for camera in data.cameras)}; the cell has joints {', '.join(sorted(joints))} and "
            f"cameras {', '.join(cameras)}",
        )


def read_lines(path: Path, sigma: float, data: Any) -> tuple[dict[str, Any], LinesUsed]:
    """Lens of each camera, and the lines from which it was estimated: a table ``camera,line,u,v``, with this header.

    Raises CommandError naming the row, or the camera whose lines do not determine its lens.
    """
    if not 0.0 < sigma < np.inf:
        raise CommandError("lines", f"--lines-sigma is {sigma:g} px; a positive finite number is needed")
    from stereoservo.geometry.distortion import lens_from_lines
    from stereoservo.geometry.homogeneous import GeometryError

    sizes = {camera.name: (camera.width, camera.height) for camera in data.cameras}
    found: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for number, row in read_columns(path, ("camera", "line", "u", "v"), "lines"):
        try:
            pixel = float(row["u"]), float(row["v"])
        except ValueError as error:
            raise CommandError("lines", f"{path}: line {number}: u and v are numbers [px]") from error
        if row["camera"] not in sizes:
            raise CommandError(
                "lines", f"{path}: line {number}: no camera {row['camera']!r}; cameras: {', '.join(sizes)}"
            )
        width, height = sizes[row["camera"]]
        if not (-0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5):
            raise CommandError(
                "lines",
                f"{path}: line {number}: pixel ({pixel[0]:g}, {pixel[1]:g}) is outside the image of {width}x{height} "
                "px",
            )
        found[row["camera"]][row["line"]].append(pixel)
    lenses = {}
    for camera, of_camera in found.items():
        lines = [np.array(line) for line in of_camera.values()]
        try:
            lenses[camera] = lens_from_lines(lines, sigma, *sizes[camera])
        except GeometryError as error:
            names = ", ".join(repr(line) for line in of_camera)
            raise CommandError(
                "lines", f"{path}: lines of camera {camera!r} ({names}, counted from 0): {error}", camera=camera
            ) from error
    names_of = {camera: tuple(of_camera) for camera, of_camera in found.items()}
    return lenses, LinesUsed(str(path), sigma, names_of)


# -- recorded images -----------------------------------------------------------------------------------------
# Calibration from recorded images for ``stereoservo calibrate CELL.toml --images DIR``: extracts the trial data,
# stores and fits them, and formats the result.


TRIALS_FILE = "trials.npz"
TELL_EVERY = 500


class ImagesUsed(msgspec.Struct, frozen=True):
    """Images used by a calibration. ``left_out``: number of rests that were not used, by reason."""

    directory: str
    stops: int
    frames: int
    left_out: dict[str, int]
    standing: tuple[int, ...]


class ImageFit(StoredFit, frozen=True):
    """A fit of recorded images."""

    from_images: ImagesUsed | None = None


def fit_images(cell: str, images: Path, output: Path | None) -> ImageFit:
    """Find the trials in recorded images, store them beside the images, and fit them.

    Raises CommandError, CalibrationError, RecordingError, ImageFileError, DriverError, PluginError, CellFileError.
    """
    from stereoservo.calibration.trial_data import save_trials

    pass

    if not cell.endswith(".toml"):
        raise CommandError(
            "usage", f"--images needs the cell file, for its cameras' detectors; {cell!r} is a name. Give CELL.toml"
        )
    resolve_cell(cell, output)

    def progress(camera: str, frames: int) -> None:
        if frames % TELL_EVERY == 0:
            log(f"camera {camera}: {frames} frames")

    found = trials_from_images(Path(cell), images, log, progress)
    for why, number in found.left_out.items():
        log(f"{number} rests are not used: {why}")
    if found.standing:
        markers = ", ".join(str(marker) for marker in found.standing)
        log(f"markers {markers} stood still: they are not of the body, and left out")
    path = images / TRIALS_FILE
    save_trials(found.trials, path)
    log(f"{found.stops} stops, {found.frames} frames; the trial data are kept in {path}")
    used = ImagesUsed(str(images), found.stops, found.frames, found.left_out, found.standing)
    fit = fit_stored_trials(cell, path, None, 0.3, output)
    return ImageFit(**{**msgspec.structs.asdict(fit), "from_images": used})


def source_of_images(result: ImageFit) -> str:
    """Sources of the fit, as lines of text."""
    used = result.from_images
    what = "" if used is None else f"\n  images {used.directory}: {used.stops} stops, {used.frames} frames"
    return source_of_stored(result) + what


# -- trial data of the pictures ------------------------------------------------------------------------------
# Trial data from a recording with images: runs the cell's detectors on the frames taken at rest and averages the
# marker pixels of each stop, for a calibration without the arm.


Note = Callable[[str], None]
Progress = Callable[[str, int], None]


@dataclass(frozen=True)
class RecordedTrials:
    """Trial data from recorded images. ``left_out``: number of rests that were not used, by reason; ``frames``
    averaged; ``standing``: static markers.
    """

    trials: TrialData
    stops: int
    frames: int
    left_out: dict[str, int]
    standing: tuple[int, ...]


def flight_recording_of(images: Path) -> Path:
    """Flight recording that a directory of images belongs to: ``NAME.mcap`` beside ``NAME.images``."""
    return images.absolute().with_suffix(".mcap")


def trials_from_images(cell_path: Path, images: Path, note: Note, progress: Progress) -> RecordedTrials:
    """Run the cell's detectors on the recorded cameras and average as the trial motions do.

    ``progress`` is called with the camera and the number of its frame. Raises CalibrationError (``bad_data``,
    ``too_few_stops``), RecordingError, ImageFileError, PluginError, DriverError, CellFileError.
    """
    cell = load_cell_file(cell_path)
    if not images.is_dir() or images.suffix != IMAGES_SUFFIX:
        raise CalibrationError(
            "bad_data",
            f"{images} is no directory of recorded images; `stereoservo record CELL --images` makes one, "
            f"NAME{IMAGES_SUFFIX} beside NAME.mcap",
        )
    motion = read_motion(flight_recording_of(images))
    cameras = [
        recorded_camera(cell, cell_path, section.name, video_of(images, section.name)) for section in cell.camera
    ]
    settings = _settings(cell, cell_path, motion, cameras)
    if settings.trials is None:
        raise CalibrationError(
            "bad_data",
            f"{cell_path} has no [calibration] section; base, frames and settle_s of the trial motions are needed",
        )
    gathered = RecordedTrialCollector(motion, settings, settings.trials)
    for camera in cameras:
        gathered.add(_observations(camera, gathered, log, progress))
    job = TrialCollector(settings)
    events = gathered.events()
    stops = sum(event.kind == "calibration_sample" for event in events)
    if stops == len(events) and stops < MIN_STOPS:
        raise CalibrationError(
            "too_few_stops",
            f"the recording shows the arm at rest {stops} times with markers in view, and no straight motion; at least "
            f"{MIN_STOPS} stops a joint are needed, or sweeps: record a calibration",
            stops=stops,
        )
    for event in events:
        job.add(event)
    trials = job.trials()
    return RecordedTrials(trials, stops, trials.images, gathered.left_out, job.standing)


def _observations(
    camera: RecordedCamera, gathered: RecordedTrialCollector, note: Note, progress: Progress
) -> Iterator[CameraObservation]:
    name, frames = camera.description.name, 0

    def is_usable(t_shutter_ns: int) -> bool:
        nonlocal frames
        frames += 1
        progress(name, frames)
        return gathered.wants(name, t_shutter_ns)

    return camera.observations(log, is_usable)


def _settings(cell: CellFile, cell_path: Path, motion: RecordedMotion, cameras: list[RecordedCamera]) -> CoreSettings:
    """The core's settings for the current cell file, the recorded joints, and the detectors on the recorded cameras."""
    recorded = motion.settings
    ranges = cell.safety.limit or _recorded_limits(recorded)  # optional for a simulated arm
    limits = {limit.joint: limit for limit in ranges}
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
            stated = "has no such camera" if was is None else f"has it with {was.width}x{was.height} px"
            raise CalibrationError(
                "bad_data",
                f"{camera.file} holds pictures of {size[0]}x{size[1]} px of camera {camera.description.name!r}; the "
                f"flight recording {stated}: do they belong together?",
            )
    joints = JointDriverDescription(
        driver=cell.joints.driver,
        joints=tuple(
            JointSpec(
                name, kind, limits[name].min, limits[name].max, limits[name].velocity,
                limits[name].acceleration, resolution,
            )
            for name, kind, resolution in zip(
                recorded.joint_names, recorded.joint_kinds, recorded.resolution or (0.0,) * len(limits), strict=True
            )
        ),
        rate_hz=recorded.rate_hz, pacing="clock", command_timeout_s=0.1, call_budget_us=0.0,
        home=() if recorded.trials is None else tuple(recorded.trials.base.tolist()),
        simulated=not cell.safety.limit,
    )  # fmt: skip
    return core_settings(cell, joints, tuple(camera.description for camera in cameras))


def _recorded_limits(recorded: CoreSettings) -> tuple[JointLimit, ...]:
    limits = recorded.limits
    rows = np.stack([limits.position_min, limits.position_max, limits.velocity_max, limits.acceleration_max])
    return tuple(JointLimit(name, *row) for name, row in zip(recorded.joint_names, rows.T.tolist(), strict=True))


SAME_POSITION = 4.0
"""Joint positions nearer than this many arrival tolerances are equal: each of two arrivals is within one, and settles.
"""
BEFORE_NS = 500_000_000


@dataclass
class _Stop:
    """A rest whose frames are being collected."""

    rest: RestInterval
    sums: ObservationStatistics
    joint_sum: FloatArray
    frames: int = 0


@dataclass
class _Sweep:
    """A straight motion whose frames are being collected."""

    motion: StraightMotion
    frames: list[PathFrame] = field(default_factory=list)


@dataclass
class RecordedTrialCollector:
    """Collects the observations of all cameras, in any order of cameras, into the stops of the trial motions, or, where
    the arm hardly rests, into their sweeps.

    ``settings``: those of the flight, with the cameras and markers of the detectors used now. ``left_out``: number of
    rests that were not used, by reason.
    """

    motion: RecordedMotion
    settings: CoreSettings
    trial: TrialSettings
    left_out: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.motion.settings.joint_names)
        self._stops = [
            _Stop(rest, ObservationStatistics(**measurement_buffers(self.settings)), np.zeros(n))
            for rest in rest_intervals(self.motion, self.trial.settle_s)
        ]
        self._settled = [stop.rest.settled_ns for stop in self._stops]
        sweeps = straight_motions(self.motion) if len(self._stops) < MIN_STOPS else []
        self._sweeps = [_Sweep(motion) for motion in sweeps]
        self._begins = [motion.begin_ns for motion in sweeps]
        self.used = 0

    def wants(self, camera: str, t_ns: int) -> bool:
        """Whether a frame of this time may be used, or shortly precedes one that may: a tracking detector must see it,
        too.
        """
        column = next(k for k, one in enumerate(self.settings.cameras) if one.name == camera)
        if self._sweep_at(t_ns) is not None or self._sweep_at(t_ns + BEFORE_NS) is not None:
            return True
        newest = bisect_right(self._settled, t_ns + BEFORE_NS) - 1
        return any(
            t_ns <= stop.rest.end_ns and stop.sums.frames[column] < self.trial.frames
            for stop in self._stops[max(newest - 1, 0) : newest + 1]
        )

    def _sweep_at(self, t_ns: int) -> _Sweep | None:
        """The sweep in which a frame of this time was taken."""
        number = bisect_right(self._begins, t_ns) - 1
        inside = number >= 0 and t_ns <= self._sweeps[number].motion.end_ns
        return self._sweeps[number] if inside else None

    def add(self, observations: Iterable[CameraObservation]) -> None:
        """Add one camera's observations in order of time; those that belong to no stop or sweep are skipped."""
        columns = {camera.name: k for k, camera in enumerate(self.settings.cameras)}
        for observation in observations:
            sweep = self._sweep_at(observation.t_shutter_ns)
            if sweep is not None:
                sweep.frames.append(path_frame(columns[observation.camera], observation))
                self.used += 1
                continue
            number = bisect_right(self._settled, observation.t_shutter_ns - 1) - 1
            if number < 0:
                continue
            stop = self._stops[number]
            joints = self.motion.joints_at(observation.t_shutter_ns)
            if observation.t_shutter_ns > stop.rest.end_ns or joints is None:
                continue
            if add_observation(stop.sums, self.settings, observation, self.trial.frames, stop.rest.settled_ns):
                stop.joint_sum += joints
                stop.frames += 1
                self.used += 1

    def events(self) -> list[Event]:
        """The stops as events of the core's trial motions. Raises CalibrationError (``too_few_stops``)."""
        self.left_out = {}
        seen = [(stop, stop.joint_sum / stop.frames) for stop in self._stops if stop.frames and self._good(stop)]
        if not seen:
            raise CalibrationError(
                "too_few_stops",
                f"none of {len(self._stops)} rests of the flight recording has pictures with enough markers "
                f"({self.used} frames fall into rests): do pictures and flight belong together, and does the cell's "
                "detector find its markers in them?",
                rests=len(self._stops),
                frames=self.used,
            )
        base = self._base([joints for _, joints in seen])
        near = SAME_POSITION * self.settings.arrival
        events: list[Event] = []
        places: list[FloatArray] = []
        together = 0
        for stop, joints in seen:
            moved = np.flatnonzero(np.abs(joints - base) > near)
            alone = moved[moved != self.trial.spread_joint]
            if alone.size > 1 and together == self.trial.together:
                self._leave_out("more than one joint is away from the base")
            elif any(bool((np.abs(joints - place) < near).all()) for place in places):
                self._leave_out("the arm was there before")
            else:
                places.append(joints)
                trial = int(alone[0]) if alone.size else (self.trial.spread_joint if moved.size else -1)
                if alone.size > 1:
                    together, trial = together + 1, -1
                samples = averages(stop.sums, self.settings)
                event = Event(len(events) + 1, stop.rest.end_ns, "calibration_sample", id="images", joints=joints)
                events.append(msgspec.structs.replace(event, samples=samples, trial=trial))
        for leg, sweep in enumerate(self._sweeps):
            motion, ends_ns = sweep.motion, [*self._begins, np.iinfo(np.int64).max][leg + 1]
            event = Event(len(events) + 1, motion.end_ns, "calibration_frames", id="images", trial=motion.joint)
            inside = (self.motion.joint_ns >= motion.begin_ns) & (self.motion.joint_ns < min(motion.end_ns, ends_ns))
            path = PathRecord(tuple(sweep.frames), self.motion.joint_ns[inside], self.motion.positions[inside], leg)
            events.append(msgspec.structs.replace(event, path=path))
        return events

    def _good(self, stop: _Stop) -> bool:
        if too_few_seen(averages(stop.sums, self.settings), self.trial) is None:
            return True
        self._leave_out("some camera shows too few markers, or too few frames")
        return False

    def _leave_out(self, why: str) -> None:
        self.left_out[why] = self.left_out.get(why, 0) + 1

    def _base(self, places: list[FloatArray]) -> FloatArray:
        """Positions (n,) of the joints that do not move: the cell file's base; or, if most of ``places`` (n,) differ
        from it in more than one joint, the configuration from which most others differ in one joint.
        """
        candidates = np.array([self.trial.base, *places])
        away = np.abs(candidates[:, None] - np.array(places)) > SAME_POSITION * self.settings.arrival
        if self.trial.spread_joint >= 0:
            away[..., self.trial.spread_joint] = False
        near = (away.sum(axis=-1) <= 1).sum(axis=1)
        best: FloatArray = candidates[0 if 2 * near[0] >= len(places) else int(near.argmax())]
        return best
