"""Observations at rest that the gateway collects for the refinement and relocalization jobs, and the file that passes
them.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.calibration.trial_data import TrialData
from stereoservo.core.cycle import Event, Status, decode_array, encode
from stereoservo.core.monitor_state import ObservationStatistics
from stereoservo.core.rest_averages import add_observation, averages, measurement_buffers
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.files import read_bounded, write_atomically
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation

MOST_POSES = 128
LEAST_DISTANCE = 0.02
"""Distance of two poses [rad or m, over all joints] below which they count as equal."""
STILL = 2e-4
"""Motion of a joint [rad or m] that ends a rest."""
MOST_READINGS = 200
"""Largest number of joint readings of a rest; their mean is its pose."""
FRAMES, SETTLE_S = 5, 0.15
"""Values without a [calibration] section of the cell: averaged frames per camera, and settling time before them [s]."""
RELOCALIZATION_POSES = 12
"""Number of poses that are used: the newest ones."""
MAX_EVENTS_BYTES = 1 << 26


class RestPoses:
    """Rest poses at the ends of goals: mean joint readings, and each camera's mean pixels over some frames.

    Equal poses are stored once; of more than `MOST_POSES`, those farthest apart in joint space are kept. A frame is
    used if its shutter time lies between two states of the arm at rest, after settling.
    """

    def __init__(self, settings: CoreSettings) -> None:
        self._settings = settings
        trials = settings.trials
        self._frames, settle_s = (FRAMES, SETTLE_S) if trials is None else (trials.frames, trials.settle_s)
        self._settle_ns = round(1e9 * settle_s)
        self._readings: list[FloatArray] = []
        self._places: list[FloatArray] = []
        self._settled_ns = 0
        self._waiting: list[CameraObservation] = []
        self._done = False
        self.poses: list[Event] = []

    def clear(self) -> None:
        """Delete all poses, including the current one."""
        self.poses.clear()
        self._places.clear()
        self.leave()

    def leave(self) -> None:
        """Discard the data of the current rest: the arm moves, or its state is not trusted."""
        self._readings.clear()
        self._waiting.clear()
        self._done = False

    def add_frame(self, observation: CameraObservation) -> None:
        """Add a frame of a camera; it is kept until a later state shows whether the arm was at rest."""
        late = self._readings and not self._done and observation.t_shutter_ns >= self._settled_ns
        mine = sum(one.camera == observation.camera for one in self._waiting)
        newer = all(one.seq != observation.seq for one in self._waiting if one.camera == observation.camera)
        if late and newer and mine < self._frames and observation.t_received_ns >= observation.t_shutter_ns:
            self._waiting.append(observation)

    def add_state(self, status: Status) -> bool:
        """Add a trusted state of the arm; returns whether a pose was added."""
        positions = status.positions
        if status.command.any() or (self._readings and float(np.abs(positions - self._readings[0]).max()) > STILL):
            self.leave()
        if status.command.any():
            return False
        if not self._readings:
            self._settled_ns = status.t_ns + self._settle_ns
        settled = status.t_ns >= self._settled_ns or not self._readings
        if settled and not self._done and len(self._readings) < MOST_READINGS:
            self._readings.append(positions.copy())
        if self._done or len(self._waiting) < self._frames * len(self._settings.cameras):
            return False
        if max(one.t_shutter_ns for one in self._waiting) > status.t_ns:
            return False
        sums = ObservationStatistics(**measurement_buffers(self._settings))
        for observation in self._waiting:
            add_observation(sums, self._settings, observation, self._frames, self._settled_ns - 1)
        joints = np.mean(self._readings[1:] or self._readings, axis=0)
        self._done = True
        self._waiting.clear()
        samples = averages(sums, self._settings)
        pose = Event(0, status.t_ns, "calibration_sample", id="rest", joints=joints, samples=samples)
        return self._keep(pose, joints)

    def _keep(self, pose: Event, joints: FloatArray) -> bool:
        away = [float(np.linalg.norm(place - joints)) for place in self._places]
        if away and min(away) < LEAST_DISTANCE:
            self.poses[int(np.argmin(away))] = pose  # the newer one describes the current cell
            return False
        self.poses.append(pose)
        self._places.append(joints)
        if len(self.poses) > MOST_POSES:
            configurations = np.array(self._places)
            distances = np.linalg.norm(configurations[:, None] - configurations[None], axis=2)
            distances[np.diag_indices(len(configurations))] = np.inf
            # Of the two nearest poses, the one with the nearer second neighbour is removed.
            pair = np.unravel_index(int(distances.argmin()), distances.shape)
            second = [float(np.partition(distances[k], 1)[1]) for k in pair]
            gone = int(pair[int(np.argmin(second))])
            del self.poses[gone], self._places[gone]
        return True

    def trials(self) -> TrialData:
        """The poses as trial data. Raises CalibrationError."""
        collector = TrialCollector(self._settings)
        for pose in self.poses:
            collector.add(pose)
        return collector.trials()


class RelocalizationPoses:
    """Observations at rest poses since the cameras last moved; an event with ``trial`` 0 starts a new set."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def add(self, event: Event) -> None:
        """Add an event ``reanchor``."""
        if event.trial <= 0:
            self.events.clear()
        self.events = [*self.events, event][-RELOCALIZATION_POSES:]


def save_events(path: Path, events: list[Event]) -> None:
    """Save events for the process that fits. Raises OSError."""
    write_atomically(path, encode(events))


def load_events(path: Path) -> list[Event]:
    """Inverse of :func:`save_events`. Raises DamagedError."""
    with decoding(partial(DamagedError, path)):
        data = read_bounded(path, MAX_EVENTS_BYTES)
        return msgspec.msgpack.decode(data, type=list[Event], dec_hook=decode_array)
