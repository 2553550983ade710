"""Trial motions out of recorded pictures: what a detector finds in them, at the rests of the flight recording."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from stereoservo.kinematics.calibration.trials import CalibrationError
from stereoservo.runtime.averaging import add_observation, averages
from stereoservo.runtime.cycle import Event
from stereoservo.runtime.flight import Flight, Rest, rests
from stereoservo.runtime.motion import ARRIVED, measurement_buffers
from stereoservo.runtime.ports import CameraObservation, FloatArray
from stereoservo.runtime.settings import CoreSettings, TrialSettings
from stereoservo.runtime.sums import Sums
from stereoservo.runtime.visiting import too_few_seen

SAME = 4.0 * ARRIVED
"""Joints nearer than this are in one place [rad or m]: each of two arrivals is within ``ARRIVED``, and settles."""
BEFORE_NS = 500_000_000


@dataclass
class _Stop:
    """A rest while its frames are gathered."""

    rest: Rest
    sums: Sums
    joint_sum: FloatArray
    frames: int = 0


@dataclass
class ImageTrials:
    """Gathers observations of all cameras, in any order of cameras, into the stops of the trial motions.

    ``settings``: of the flight, with the cameras and markers of the detectors that are used now. ``left_out``: why
    rests were not used, with their number.
    """

    flight: Flight
    settings: CoreSettings
    trial: TrialSettings
    left_out: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.flight.settings.joint_names)
        self._stops = [
            _Stop(rest, Sums(**measurement_buffers(self.settings)), np.zeros(n))
            for rest in rests(self.flight, self.trial.settle_s)
        ]
        self._settled = [stop.rest.settled_ns for stop in self._stops]
        self.used = 0

    def wants(self, camera: str, t_ns: int) -> bool:
        """Whether a frame of this time may count, or comes so little before one that does that a detector which follows
        its markers from frame to frame is to see it.
        """
        column = next(k for k, one in enumerate(self.settings.cameras) if one.name == camera)
        newest = bisect_right(self._settled, t_ns + BEFORE_NS) - 1
        return any(
            t_ns <= stop.rest.end_ns and stop.sums.frames[column] < self.trial.frames
            for stop in self._stops[max(newest - 1, 0) : newest + 1]
        )

    def add(self, observations: Iterable[CameraObservation]) -> None:
        """Take one camera's observations in the order of time; what was seen in motion is passed over."""
        for observation in observations:
            number = bisect_right(self._settled, observation.t_shutter_ns - 1) - 1
            if number < 0:
                continue
            stop = self._stops[number]
            joints = self.flight.joints_at(observation.t_shutter_ns)
            if observation.t_shutter_ns > stop.rest.end_ns or joints is None:
                continue
            if add_observation(
                stop.sums, self.settings, observation, self.trial.frames, stop.rest.settled_ns
            ):
                stop.joint_sum += joints
                stop.frames += 1
                self.used += 1

    def events(self) -> list[Event]:
        """The stops as the core's trial motions tell them. Raises CalibrationError (``too_few_stops``)."""
        self.left_out = {}
        seen = [
            (stop, stop.joint_sum / stop.frames) for stop in self._stops if stop.frames and self._good(stop)
        ]
        if not seen:
            raise CalibrationError(
                "too_few_stops",
                f"none of {len(self._stops)} rests of the flight recording has pictures with enough markers "
                f"({self.used} frames fall into rests): do pictures and flight belong together, and does the cell's "
                "detector find its markers in them?",
                rests=len(self._stops), frames=self.used,
            )  # fmt: skip
        base = self._base([joints for _, joints in seen])
        events: list[Event] = []
        places: list[FloatArray] = []
        for stop, joints in seen:
            moved = np.flatnonzero(np.abs(joints - base) > SAME)
            alone = moved[moved != self.trial.spread_joint]
            if alone.size > 1:
                self._leave_out("more than one joint is away from the base")
            elif any(bool((np.abs(joints - place) < SAME).all()) for place in places):
                self._leave_out("the arm was there before")
            else:
                places.append(joints)
                trial = int(alone[0]) if alone.size else (self.trial.spread_joint if moved.size else -1)
                samples = averages(stop.sums, self.settings)
                event = Event(
                    len(events) + 1, stop.rest.end_ns, "calibration_sample", id="images", joints=joints
                )
                events.append(msgspec.structs.replace(event, samples=samples, trial=trial))
        return events

    def _good(self, stop: _Stop) -> bool:
        if too_few_seen(averages(stop.sums, self.settings), self.trial) is None:
            return True
        self._leave_out("some camera shows too few markers, or too few frames")
        return False

    def _leave_out(self, why: str) -> None:
        self.left_out[why] = self.left_out.get(why, 0) + 1

    def _base(self, places: list[FloatArray]) -> FloatArray:
        """Where the joints stand that do not move: the cell file's base, or, where most of ``places`` (n,) are more
        than one joint away from that, the place that the most others are one joint away from.
        """
        candidates = np.array([self.trial.base, *places])
        away = np.abs(candidates[:, None] - np.array(places)) > SAME
        if self.trial.spread_joint >= 0:
            away[..., self.trial.spread_joint] = False
        near = (away.sum(axis=-1) <= 1).sum(axis=1)
        best: FloatArray = candidates[0 if 2 * near[0] >= len(places) else int(near.argmax())]
        return best
