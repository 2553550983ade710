"""Collects the ``calibration_sample`` events of the calibration motion (mean marker pixels at each stop) into trial
data for the fit.
"""

from __future__ import annotations

import numpy as np

from stereoservo.calibration.static_points import static_markers, static_observations
from stereoservo.calibration.trial_data import CalibrationError, TrialCamera, TrialData, WayObservations
from stereoservo.core.cycle import Event
from stereoservo.core.settings import CameraSettings, CoreSettings
from stereoservo.kinematics.model import JointLoads

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
        self.standing: tuple[int, ...] = ()
        self.strayed: tuple[int, ...] = ()
        self._loads: JointLoads | None = None

    @property
    def stops(self) -> int:
        """Number of stops collected so far."""
        return len(self._stops)

    def add(self, event: Event) -> None:
        """Add an event: ``calibration_sample``, or ``calibration_finished`` with the joints' loads."""
        if event.kind == "calibration_finished" and event.id == self.id:
            self._loads = event.loads
        if event.kind != "calibration_sample":
            return
        if event.id != self.id:
            self.id = event.id
            self._stops.clear()
            self._loads = None
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
        seen = {int(i) for event in self._stops for sample in event.samples for i in sample.ids}
        markers = tuple(marker for marker in settings.marker_ids if marker in seen)
        column = {marker: k for k, marker in enumerate(markers)}
        row = {camera.name: c for c, camera in enumerate(settings.cameras)}
        shape = (len(settings.cameras), len(self._stops), len(markers))
        pixels = np.full((*shape, 2), np.nan)
        sigmas = np.full(shape, np.nan)
        images = 0
        factors = {camera.name: self._noise_factor(camera) for camera in settings.cameras}
        for s, event in enumerate(self._stops):
            for sample in event.samples:
                images += sample.frames
                for marker, pixel, covariance in zip(sample.ids, sample.pixels, sample.covariances, strict=True):
                    where = row[sample.camera], s, column[int(marker)]
                    pixels[where] = pixel
                    systematic = settings.cameras[where[0]].systematic_px ** 2
                    noise = 0.5 * np.trace(covariance) - systematic
                    sigmas[where] = np.sqrt(factors[sample.camera] * noise + systematic)
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
            positions=np.array([_joints(event) for event in self._stops]),
            trials=np.array([event.trial for event in self._stops], dtype=np.int64),
            pixels=pixels[:, :, ~still],
            sigmas=sigmas[:, :, ~still],
            images=images,
            loads=self._loads,
            static=static,
            way=self._way(),
        )

    def _way(self) -> WayObservations | None:
        """Observations between the stops; None if there are none."""
        records = [(k, event.way) for k, event in enumerate(self._stops) if event.way is not None]
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
        return WayObservations(
            ways=np.array([k for k, _ in frames], dtype=np.int64),
            cameras=np.array([frame.camera for _, frame in frames], dtype=np.int64),
            times=np.array([1e-9 * (frame.t_ns - start_ns) for _, frame in frames]),
            markers=markers,
            pixels=pixels,
            joint_ways=np.concatenate([np.full(len(record.joints_ns), k) for k, record in records]).astype(np.int64),
            joint_times=np.concatenate([1e-9 * (record.joints_ns - start_ns) for _, record in records]),
            positions=np.concatenate([record.positions for _, record in records]),
        )

    def _noise_factor(self, camera: CameraSettings) -> float:
        """Variance of the pixels over the frames of a stop, relative to the detector's stated one: maximum likelihood
        over all stops, the mean of the ratios by degrees of freedom.

        A ratio of sums would be dominated by few markers of large variance: one of 0.16 px among thousands of 0.005 px
        changes it by a sixth. Markers beyond MOST_NOISE are not used: their stated variance expresses doubt (touching
        dots, a dot that does not fit its face), which does not appear as scatter. 1 if single frames were taken or the
        detector states no noise.
        """
        samples = [sample for event in self._stops for sample in event.samples if sample.camera == camera.name]
        if not samples:
            return 1.0
        frame_counts = np.concatenate([sample.sights for sample in samples])
        scatter = np.concatenate([sample.scatter for sample in samples])
        variance = np.concatenate([0.5 * np.trace(s.covariances, axis1=1, axis2=2) for s in samples])
        noise = variance - camera.systematic_px**2
        single = noise * frame_counts
        known = (noise > LEAST_NOISE * variance) & (frame_counts > 1.0)
        if not known.any():
            return 1.0
        known &= single <= MOST_NOISE * np.median(single[known])
        factor = float(np.average(scatter[known] / single[known], weights=frame_counts[known] - 1.0))
        return factor if factor > 0.0 else 1.0


def _joints(event: Event) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if event.joints is None:
        raise CalibrationError("bad_data", f"calibration sample {event.seq} carries no joint positions")
    return event.joints
