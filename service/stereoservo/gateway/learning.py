"""Progress of a running calibration in the gateway: counts the trial data, and runs the job that predicts the accuracy
learnt so far in a child process of low priority.
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np

from stereoservo.core.cycle import TRIALS_BEGIN, Event
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.ipc_messages import store_event
from stereoservo.gateway.child_jobs import ChildJob, FitFailedError
from stereoservo.messages.learning import JointLearning, LearningState, LearntAccuracy


class LearningProgress:
    """Progress of the calibration that is running. ``runtime``: the cell's runtime directory, with its plan; None: no
    accuracies are predicted.
    """

    def __init__(self, settings: CoreSettings, runtime: Path | None) -> None:
        self._names = settings.joint_names
        self._runtime = runtime
        self._id = ""
        self._job: ChildJob | None = None
        self._events: BinaryIO | None = None
        self._path = Path() if runtime is None else runtime / "learning-events.msgpack"
        self._state: LearningState | None = None
        self._ranges = np.zeros((2, len(self._names)))
        self._pace: list[tuple[int, float]] = []
        """Time [ns] and completed fraction: when the first joint began to move, and when the fraction rose last."""

    def on_event(self, event: Event) -> None:
        """Handle an event of the core."""
        if event.kind == "calibration_progress" and event.message == TRIALS_BEGIN:
            self._begin(event)
        elif self._state is None or event.id != self._id:
            return
        elif event.kind in ("calibration_sample", "calibration_frames"):
            self._state = self._counted(self._state, event)
            if self._events is not None:
                with suppress(OSError):  # a full disk: no accuracy is predicted from then on
                    store_event(self._events, event)
        elif event.kind == "calibration_finished":
            self._end_job()
            self._state = msgspec.structs.replace(self._state, doing="fitting")
        elif event.kind == "calibration_aborted":
            self.end()

    def state(self) -> LearningState | None:
        """The progress; None while there is no calibration."""
        if self._state is None or self._state.doing == "fitting":
            return self._state
        if self._job is not None:
            self._state = self._read(self._job, self._state)
        return msgspec.structs.replace(self._state, seconds_left=self._seconds_left(time.monotonic_ns()))

    def end(self) -> None:
        """End the progress. Idempotent."""
        self._end_job()
        self._state = None

    def _begin(self, event: Event) -> None:
        self.end()
        n = len(self._names)
        self._id, self._pace = event.id, []
        self._ranges = np.array([np.full(n, np.inf), np.full(n, -np.inf)])
        note = "the first joint's motion is not done"
        try:
            if self._runtime is not None:
                self._events = self._path.open("wb", buffering=0)
                self._job = ChildJob("stereoservo.daemon.jobs.learning_progress", str(self._runtime), str(self._path))
        except OSError as error:
            note = f"the job that predicts it does not start: {error}"
        self._state = LearningState("moving", 0, n + 1, 0, tuple(map(JointLearning, self._names)), note=note)

    def _counted(self, state: LearningState, event: Event) -> LearningState:
        """The progress with the images and motions of an event."""
        frames = () if event.kind == "calibration_sample" or event.path is None else event.path.frames
        images = len(frames) + sum(sample.frames for sample in event.samples)
        motion, joints = state.motion, state.joints
        if event.trial >= 0:
            motion = event.trial + 1
            moved = self._moved(event)
            joints = tuple(
                msgspec.structs.replace(joint, moved=moved) if j == event.trial else joint
                for j, joint in enumerate(joints)
            )
        elif motion == len(self._names):
            motion += 1
        if motion and event.progress is not None and (not self._pace or event.progress > self._pace[-1][1]):
            self._pace = [*self._pace[:1], (event.t_ns, event.progress)]
        return msgspec.structs.replace(state, images=state.images + images, motion=motion, joints=joints)

    def _moved(self, event: Event) -> float:
        """Range [rad or m] in which the joint of the event's own trial motion has been driven."""
        path = event.path
        positions = event.joints if event.joints is not None or path is None else path.positions
        if positions is not None:
            reached = np.atleast_2d(positions)[:, event.trial]
            self._ranges[0, event.trial] = min(self._ranges[0, event.trial], reached.min())
            self._ranges[1, event.trial] = max(self._ranges[1, event.trial], reached.max())
        return float(max(0.0, np.ptp(self._ranges[:, event.trial])))

    def _seconds_left(self, now_ns: int) -> float | None:
        """Time until the motions end at their mean pace so far [s]; None before it is known."""
        if len(self._pace) < 2:
            return None
        (began_ns, before), (at_ns, done) = self._pace
        per_share = (at_ns - began_ns) * 1e-9 / (done - before)
        return max(0.0, (1.0 - done) * per_share - (now_ns - at_ns) * 1e-9)

    @staticmethod
    def _read(job: ChildJob, state: LearningState) -> LearningState:
        """The progress with the newest accuracy that the job has printed, or with the cause of its end."""
        ended = job.finished()
        if not ended and "learning" not in job.output:
            return state
        try:
            learnt = msgspec.convert(job.require("learning"), LearntAccuracy)
        except FitFailedError as error:
            learnt = LearntAccuracy(note=f"the job that predicts it has ended: {error}")
        joints = tuple(
            msgspec.structs.replace(joint, predicted_px=learnt.joints.get(joint.name)) for joint in state.joints
        )
        return msgspec.structs.replace(
            state, joints=joints, predicted_px=learnt.predicted_px, coverage=learnt.coverage, note=learnt.note
        )

    def _end_job(self) -> None:
        """End the job, so that it does not delay the final fit, and remove its events. Idempotent."""
        if self._job is not None:
            self._job.close()
        if self._events is not None:
            self._events.close()
            self._path.unlink(missing_ok=True)
        self._job = self._events = None
