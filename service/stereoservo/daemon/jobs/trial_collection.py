"""Collects the events of the calibration motion (mean marker pixels at each stop, frames of each sweep) into trial data
for the fit.
"""

from __future__ import annotations

import numpy as np

from stereoservo.calibration.sweeps import (
    LONGEST_DELAY_S,
    Leg,
    LegMeans,
    leg_means,
    links_displaced,
    smoothed_readings,
    sweep_timing,
)
from stereoservo.calibration.trial_data import (
    CalibrationError,
    PathObservations,
    TrialCamera,
    TrialData,
    finite_rows,
    static_markers,
    static_observations,
)
from stereoservo.core.cycle import Event, PathFrame
from stereoservo.core.rest_averages import marker_rows
from stereoservo.core.settings import CameraSettings, CoreSettings
from stereoservo.kinematics.model import JointLoads
from stereoservo.numerics.arrays import FloatArray

LEAST_NOISE = 1e-9
"""Fraction of a variance below which noise is only the rounding error of a difference."""
MOST_NOISE = 3.0
"""Stated variance of one observation, relative to the median over all stops, above which it includes more than
noise.
"""


class TrialCollector:
    """Collects the stops of one calibration; a sample with another goal's id starts a new one."""

    def __init__(self, settings: CoreSettings) -> None:
        self._settings = settings
        self.id = ""
        self._stops: list[Event] = []
        self._sweeps: list[Event] = []
        self.standing: tuple[int, ...] = ()
        self.strayed: tuple[int, ...] = ()
        self._loads: JointLoads | None = None

    @property
    def stops(self) -> int:
        """Number of stops collected so far."""
        return len(self._stops)

    @property
    def frames(self) -> int:
        """Number of frames of sweeps collected so far."""
        return sum(len(event.path.frames) for event in self._sweeps if event.path is not None)

    def add(self, event: Event) -> None:
        """Add an event: ``calibration_sample``, ``calibration_frames``, or ``calibration_finished`` with the joints'
        loads.
        """
        if event.kind == "calibration_finished" and event.id == self.id:
            self._loads = event.loads
        if event.kind not in ("calibration_sample", "calibration_frames"):
            return
        if event.id != self.id:
            self.id = event.id
            self._stops.clear()
            self._sweeps.clear()
            self._loads = None
        if event.kind == "calibration_frames":
            self._sweeps.append(event)
            return
        self._sweeps.clear()  # stops after sweeps: their stamps are not exact enough
        self._stops.append(event)

    def trials(self) -> TrialData:
        """All stops as trial data, without markers that no camera ever saw or that are static (``standing``).

        Ids that are static by the cell file are stored in ``TrialData.static``, except those that moved (``strayed``).
        Raises CalibrationError (``too_few_stops``) if there is no stop.
        """
        if not self._stops:
            raise CalibrationError(
                "too_few_stops", "the trial motions gave no stop; at least 4 a joint are needed", stops=0
            )
        settings = self._settings
        legs = self._legs()
        means = _means_of_legs(legs, settings)
        cameras = settings.cameras
        row = {camera.name: c for c, camera in enumerate(cameras)}
        factors = [self._factor_at_stops(camera) for camera in cameras]
        in_motion = np.array([_factor_in_motion(means, c) for c in range(len(cameras))])[:, None, None]
        shape = (len(cameras), len(self._stops), len(settings.marker_ids))
        pixels, sigmas = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
        images = sum(int(of_leg.frames.sum()) for _, of_leg in means)
        for s, event in enumerate(self._stops):
            for sample in event.samples:
                images += sample.frames
                c, at = row[sample.camera], marker_rows(settings, sample.ids)
                noise = 0.5 * np.trace(sample.covariances, axis1=1, axis2=2) - cameras[c].systematic_px ** 2
                pixels[c, s, at] = sample.pixels
                sigmas[c, s, at] = np.sqrt(factors[c] * noise + cameras[c].systematic_px ** 2)
        positions = [np.array([_joints(event) for event in self._stops])]
        trials = [np.array([event.trial for event in self._stops], dtype=np.int64)]
        for leg, of_leg in means:
            # A marker that moves meets the detector's systematic errors by turns: they are averaged, too.
            noise = in_motion * of_leg.single / np.maximum(of_leg.counts, 1.0)
            pixels = np.concatenate([pixels, of_leg.pixels], axis=1)
            sigmas = np.concatenate([sigmas, np.sqrt(noise)], axis=1)
            positions.append(of_leg.positions)
            trials.append(np.full(len(of_leg.positions), leg.trial, dtype=np.int64))
        ever = np.asarray(finite_rows(pixels).any(axis=(0, 1)))
        markers = tuple(marker for marker, some in zip(settings.marker_ids, ever.tolist(), strict=True) if some)
        pixels, sigmas = pixels[:, :, ever], sigmas[:, :, ever]
        declared = np.array([marker in settings.scene_ids for marker in markers], dtype=bool)
        static, self.strayed = static_observations(
            tuple(marker for marker in markers if marker in settings.scene_ids),
            pixels[:, :, declared],
            sigmas[:, :, declared],
        )
        still = static_markers(pixels, sigmas)
        self.standing = tuple(
            marker for marker, is_static, known in zip(markers, still, declared, strict=True) if is_static and not known
        )
        still |= declared
        markers = tuple(marker for marker, out in zip(markers, still, strict=True) if not out)
        return TrialData(
            joint_names=settings.joint_names,
            joint_kinds=settings.joint_kinds,
            cameras=tuple(
                TrialCamera(camera.name, camera.width, camera.height, camera.mount) for camera in settings.cameras
            ),
            marker_ids=markers,
            positions=np.concatenate(positions),
            trials=np.concatenate(trials),
            pixels=pixels[:, :, ~still],
            sigmas=sigmas[:, :, ~still],
            images=images,
            loads=self._loads,
            static=static,
            way=self._paths(),
        )

    def _paths(self) -> PathObservations | None:
        """Observations between the stops and on the sweeps; None if there are none."""
        records = [(k, event.path) for k, event in enumerate(self._stops) if event.path is not None]
        records += [(event.path.leg, event.path) for event in self._sweeps if event.path is not None]
        frames = [(k, frame) for k, record in records for frame in record.frames]
        if not frames:
            return None
        most = max(len(frame.ids) for _, frame in frames)
        markers = np.full((len(frames), most), -1, dtype=np.int64)
        pixels = np.full((len(frames), most, 2), np.nan)
        for row, (_, frame) in enumerate(frames):
            markers[row, : len(frame.ids)] = frame.ids
            pixels[row, : len(frame.ids)] = frame.pixels
        start_ns = int(records[0][1].joints_ns[0])  # clock of this boot: relative seconds keep their precision
        return PathObservations(
            ways=np.array([k for k, _ in frames], dtype=np.int64),
            cameras=np.array([frame.camera for _, frame in frames], dtype=np.int64),
            times=np.array([1e-9 * (frame.t_ns - start_ns) for _, frame in frames]),
            markers=markers,
            pixels=pixels,
            joint_ways=np.concatenate([np.full(len(record.joints_ns), k) for k, record in records]).astype(np.int64),
            joint_times=np.concatenate([1e-9 * (record.joints_ns - start_ns) for _, record in records]),
            positions=np.concatenate([record.positions for _, record in records]),
        )

    def _legs(self) -> list[Leg]:
        """The sweeps. A frame belongs to the sweep in which it is stamped, whenever it arrived."""
        records = [(event.trial, event.path) for event in self._sweeps if event.path is not None]
        if not records:
            return []
        start_ns = int(records[0][1].joints_ns[0])  # clock of this boot: relative seconds keep their precision
        times = np.concatenate([1e-9 * (record.joints_ns - start_ns) for _, record in records])
        positions = np.concatenate([record.positions for _, record in records])
        trial_of = {record.leg: trial for trial, record in records}
        # Of the records of a leg the first one counts.
        starts = {record.leg: 1e-9 * (int(record.joints_ns[0]) - start_ns) for _, record in reversed(records)}
        order = sorted(starts)
        frames = sorted((frame for _, record in records for frame in record.frames), key=lambda frame: frame.t_ns)
        resolution = np.array(self._settings.resolution or (0.0,) * positions.shape[1])
        times, positions = smoothed_readings(times, positions, resolution)
        legs = []
        for leg, following in zip(order, [*order[1:], None], strict=True):
            begin, end = starts[leg], float(times[-1]) if following is None else starts[following]
            mine = [frame for frame in frames if begin <= 1e-9 * (frame.t_ns - start_ns) < end]
            around = (times >= begin - LONGEST_DELAY_S) & (times <= end + LONGEST_DELAY_S)
            observed = [
                _observations(mine, camera, start_ns, self._settings) for camera in range(len(self._settings.cameras))
            ]
            legs.append(
                Leg(
                    trial_of[leg],
                    begin,
                    end,
                    times[around],
                    positions[around],
                    tuple(stamps for stamps, _, _ in observed),
                    tuple(pixels for _, pixels, _ in observed),
                    tuple(variances for _, _, variances in observed),
                    resolution,
                    tuple(camera.height for camera in self._settings.cameras),
                )
            )
        return legs

    def _factor_at_stops(self, camera: CameraSettings) -> float:
        """Variance of a camera's pixels over the frames of a stop, relative to the detector's stated noise."""
        samples = [sample for event in self._stops for sample in event.samples if sample.camera == camera.name]
        if not samples:
            return 1.0
        counts = np.concatenate([sample.sights for sample in samples])
        scatter = np.concatenate([sample.scatter for sample in samples])
        variance = np.concatenate([0.5 * np.trace(s.covariances, axis1=1, axis2=2) for s in samples])
        noise = variance - camera.systematic_px**2
        noise[noise <= LEAST_NOISE * variance] = 0.0
        return _noise_factor(counts - 1.0, scatter, noise * counts)


def _factor_in_motion(means: list[tuple[Leg, LegMeans]], camera: int) -> float:
    """Variance of a camera's pixels about their tracks, relative to the detector's stated variance."""
    freedom, scatter, single = [], [], []
    for _, of_leg in means:
        known = of_leg.freedom[camera] > 0.0
        freedom.append(of_leg.freedom[camera, known])
        scatter.append(of_leg.scatter[camera, known])
        single.append(np.nanmean(of_leg.single[camera][:, known], axis=0))
    return _noise_factor(*(np.concatenate(values) if values else np.zeros(0) for values in (freedom, scatter, single)))


def _noise_factor(freedom: FloatArray, scatter: FloatArray, single: FloatArray) -> float:
    """Observed variances ``scatter`` (k,) with ``freedom`` (k,), relative to those of ``single`` (k,) observations:
    maximum likelihood, the mean of the ratios by degrees of freedom.

    A ratio of sums would be dominated by few markers of large variance: one of 0.16 px among thousands of 0.005 px
    changes it by a sixth. Markers beyond MOST_NOISE are not used: their stated variance expresses doubt (touching
    dots, a dot that does not fit its face), which does not appear as scatter. 1 if single frames were taken or the
    detector states no noise.
    """
    known = (freedom > 0.0) & (single > 0.0)
    if not known.any():
        return 1.0
    known &= single <= MOST_NOISE * np.median(single[known])
    factor = float(np.average(scatter[known] / single[known], weights=freedom[known]))
    return factor if factor > 0.0 else 1.0


def _means_of_legs(legs: list[Leg], settings: CoreSettings) -> list[tuple[Leg, LegMeans]]:
    """The sweeps with their means, each of as many frames as are averaged at a stop, at the cameras' own delays."""
    if not legs or settings.trials is None:
        return []
    timing = sweep_timing(legs, len(settings.cameras))
    found = []
    for leg, displaced in zip(legs, links_displaced(legs, timing.play), strict=True):
        means = leg_means(leg, timing, settings.trials.frames)
        if means is not None:
            found.append((leg, means._replace(positions=means.positions + displaced)))
    return found


def _observations(
    frames: list[PathFrame], camera: int, start_ns: int, settings: CoreSettings
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Stamps (f,) [s] of a camera's frames, pixels (f, m, 2) and variances (f, m) of the cell's markers in them."""
    mine = [frame for frame in frames if frame.camera == camera]
    pixels = np.full((len(mine), len(settings.marker_ids), 2), np.nan)
    variances = np.full(pixels.shape[:2], np.nan)
    for f, frame in enumerate(mine):
        rows = marker_rows(settings, frame.ids)
        pixels[f, rows[rows >= 0]] = frame.pixels[rows >= 0]
        if frame.variances is not None:
            variances[f, rows[rows >= 0]] = frame.variances[rows >= 0]
    return np.array([1e-9 * (frame.t_ns - start_ns) for frame in mine]), pixels, variances


def _joints(event: Event) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if event.joints is None:
        raise CalibrationError("bad_data", f"calibration sample {event.seq} carries no joint positions")
    return event.joints
