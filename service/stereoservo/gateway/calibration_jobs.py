"""Jobs of calibration, model check and zero reset in the gateway: collect the samples of the motion, run the fit or
check in a child process, store the new model and send it to the core; and the progress of a running calibration, whose
accuracy so far another child process predicts.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np

from stereoservo.calibration.fit_assessment import assess_failure
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.core.cycle import RESET_ZEROS, TRIALS_BEGIN, Event
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.ipc_messages import store_event
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.gateway.child_jobs import CheckJob, ChildJob, FitFailedError, FitJob, calibration_result
from stereoservo.gateway.persistence import ModelStore
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.kinematics.model import CellModel, ModelFileError
from stereoservo.messages.check_report import ZeroReset
from stereoservo.messages.learning import JointLearning, LearningState, LearntAccuracy
from stereoservo.messages.wire import CalibrationResult


class CalibrationJobs:
    """The cell's model and the jobs that produce it. ``model`` is the last one sent to the core.

    ``notes``: problems of the model files, until a newer model is available.
    """

    def __init__(
        self,
        settings: CoreSettings,
        models: ModelStore,
        link: ServoConnection,
        log: EventLog,
        history: Path,
        known_length: str = "",
        runtime: Path | None = None,
    ) -> None:
        self._settings = settings
        self._models = models
        self._link = link
        self._log = log
        self._history = history
        self._known_length = known_length
        self._job = TrialCollector(settings)
        self.learning = LearningProgress(settings, runtime)
        self._worker = ThreadPoolExecutor(max_workers=1)
        self._reduction: tuple[TrialCollector, Future[TrialData]] | None = None
        self._fit: FitJob | None = None
        self._fit_id = ""
        self._reported = False
        self._check: CheckJob | None = None
        self._check_id = ""
        self._handed: tuple[str, CalibrationResult | ZeroReset] | None = None
        self.model: CellModel | None = None
        self.notes: tuple[str, ...] = ()

    @property
    def busy(self) -> bool:
        """Whether a new model is being computed, or waits to be used."""
        return any(one is not None for one in (self._reduction, self._fit, self._check, self._handed))

    def load(self, core_epoch: int) -> None:
        """Send the newest fitting model on disk to the core, unless the core (epoch ``core_epoch``) already has it."""
        try:
            model, passed = self._models.newest_fitting(self._settings, recover=True)
        except OSError as error:
            model, passed = None, [f"{error.filename}: {error.strerror}"]
        used = "no model is used" if model is None else f"model epoch {model.epoch} is used instead"
        self.notes = tuple(f"model passed over: {text}; {used}" for text in passed)
        for text in self.notes:
            self._log.add("warning", message=text, origin="gateway")
        # Not sent again, after a restart of the gateway, to a core that has it: that would reset the core's estimates.
        if model is not None and (model.epoch == core_epoch or self._link.send_model(model, kept=True)):
            self.model = model

    def on_core_event(self, event: Event, *, fresh: bool) -> None:
        """Handle an event of the core; ``fresh``: it was not handled before a restart of the gateway."""
        self._job.add(event)
        self.learning.on_event(event, fresh=fresh)
        if event.kind == "calibration_finished" and fresh:
            self._start_fit(event.id)
        elif event.kind == "check_finished" and fresh:
            self._start_check(reset=event.name == RESET_ZEROS)
        elif event.kind == "warning" and event.message.startswith("model refused"):
            goal_id = self._fit_id if self._handed is None else self._handed[0]
            self._handed = None
            self._failed(goal_id, event.message)

    def on_model_applied(self, epoch: int) -> None:
        """Handle the core's change to the model of ``epoch``: report it if it is the model that was sent."""
        if self._handed is None or epoch < self._handed[1].epoch:
            return
        (goal_id, what), self._handed = self._handed, None
        if epoch > what.epoch:
            self._failed(goal_id, f"model epoch {epoch} came before epoch {what.epoch} was used: calibrate again")
            return
        self.notes = ()
        self._report_applied(goal_id, what)

    def _report_applied(self, goal_id: str, what: CalibrationResult | ZeroReset) -> None:
        """Report that the core has applied the model that was sent."""
        self.learning.end()
        if isinstance(what, ZeroReset):
            self._log.add("zeros_reset", message=what.message, id=goal_id, reset=what, origin="gateway")
            return
        self._log.add(
            "calibrated",
            message=f"model epoch {what.epoch}: {what.rms_px:.4f} px rms. {what.verdict}",
            id=goal_id,
            calibration=what,
            origin="gateway",
        )

    def _start_fit(self, goal_id: str) -> None:
        """Reduce what was collected to trial data, in a thread: it takes longer than the gateway may be silent."""
        self.cancel()
        self._fit_id, self._reported = goal_id, False
        collected, self._job = self._job, TrialCollector(self._settings)
        self._reduction = collected, self._worker.submit(collected.trials)

    def _fit_to(self, collected: TrialCollector, trials: Future[TrialData]) -> None:
        self._reduction = None
        try:
            epoch = self._models.next_epoch()
            self._fit = FitJob(trials.result(), self._models.path(epoch), epoch, self._known_length)
        except (CalibrationError, OSError) as error:
            self._failed(self._fit_id, str(error), getattr(error, "code", ""))
            return
        message = f"{collected.frames} frames of sweeps" if collected.frames else f"{collected.stops} stops"
        if collected.standing:
            markers = ", ".join(str(marker) for marker in collected.standing)
            message += f"; markers {markers} stood still: they are not of the body, and left out"
        if collected.strayed:
            markers = ", ".join(str(marker) for marker in collected.strayed)
            message += (
                f"; markers {markers} are static by the cell file's [scene], but moved in the images: they are left "
                "out of the scene. Are they on the arm, did something push them?"
            )
        self._log.add("fit_started", message=message, id=self._fit_id, progress=0.0, origin="gateway")

    def _start_check(self, *, reset: bool) -> None:
        if self._check is not None:
            self._check.close()
            self._check = None
        self._check_id = self._job.id
        if self.model is None:
            self._failed(self._check_id, "the model that was to be checked is gone")
            return
        path = self._models.path(self.model.epoch)
        try:
            epoch = self._models.next_epoch()
            self._check = CheckJob(
                self._job.trials(),
                path,
                self._history,
                self._settings.tolerance_px,
                body_moves=self._settings.body_moves,
                reset_to=self._models.path(epoch) if reset else None,
                epoch=epoch,
            )
        except (CalibrationError, OSError) as error:
            self._failed(self._check_id, str(error), getattr(error, "code", ""))

    def poll(self) -> None:
        """Report the progress of a running fit or check, and handle its result."""
        if self._reduction is not None and self._reduction[1].done():
            self._fit_to(*self._reduction)
        if self._fit is not None:
            self._poll_fit(self._fit)
        if self._check is not None:
            self._poll_check(self._check)

    def _poll_fit(self, fit: FitJob) -> None:
        ended = fit.ended  # read first, so that output printed before the end is processed, too
        for step in fit.poll():
            self._log.add(
                "fit_progress",
                message=step.message,
                id=self._fit_id,
                progress=step.progress,
                origin="gateway",
            )
        if fit.decided and not self._reported:
            self._reported = True
            self._decide(fit)
        if not ended:
            return
        report = fit.output.get("report")
        if report is not None:
            self._log.add(
                "calibration_report",
                message=f"report in {report}",
                id=self._fit_id,
                name=report,
                origin="gateway",
            )
        elif "model" in fit.output or "error" in fit.output:
            cause = fit.output.get("report_error", "its process ended early")
            self._log.add(
                "calibration_report",
                message=f"no report could be written: {cause}",
                id=self._fit_id,
                accepted=False,
                origin="gateway",
            )
        fit.close()
        self._fit = None

    def _decide(self, fit: FitJob) -> None:
        try:
            model, verdict, seconds = fit.model()
            result = calibration_result(model, fit.model_path, verdict, fit.report_path, fit.trials_path, seconds)
        except (FitFailedError, ModelFileError) as error:
            code = getattr(error, "code", "")
            kept = f"The trial data are kept in {fit.trials_path}, a report is in {fit.report_path}"
            self._failed(self._fit_id, f"{assess_failure(code, str(error)).text} {kept}", code)
            return
        self._send_to_core(model, self._fit_id, result, fit.model_path)

    def _send_to_core(self, model: CellModel, goal_id: str, what: CalibrationResult | ZeroReset, path: Path) -> None:
        """Send a model to the core, which applies it once the arm is at rest; ``what`` is then reported."""
        if not self._link.send_model(model):
            self._failed(goal_id, f"the servo process does not take the model; it is saved as {path}")
            return
        self.model, self._handed = model, (goal_id, what)

    def _poll_check(self, check: CheckJob) -> None:
        if not check.finished():
            return
        try:
            report = check.report()
        except FitFailedError as error:
            self._failed(self._check_id, str(error), error.code)
        else:
            text = "; ".join(part for part in (report.message, report.trend) if part)
            self._log.add("checked", message=text, id=self._check_id, check=report, origin="gateway")
            if check.reset_to is not None:
                self._send_corrected_zeros(check, check.reset_to)
        check.close()
        self._check = None

    def _send_corrected_zeros(self, check: CheckJob, path: Path) -> None:
        try:
            model, reset = check.reset()
        except FitFailedError as error:
            self._failed(self._check_id, str(error), error.code)
        except ModelFileError as error:
            self._failed(self._check_id, str(error))
        else:
            self._send_to_core(model, self._check_id, reset, path)

    def _failed(self, goal_id: str, message: str, code: str = "") -> None:
        self.learning.end()
        self._log.add("calibration_failed", message=message, id=goal_id, name=code, origin="gateway")

    def cancel(self) -> None:
        """Cancel the running job. Idempotent."""
        for job in (self._fit, self._check):
            if job is not None:
                job.close()
        self._reduction = self._fit = self._check = None

    def close(self) -> None:
        """Cancel all jobs. Idempotent."""
        self.cancel()
        self._worker.shutdown(wait=False)
        self.learning.end()


# -- the progress of a calibration ---------------------------------------------------------------------------


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

    def on_event(self, event: Event, *, fresh: bool = True) -> None:
        """Handle an event of the core; ``fresh``: as for `CalibrationJobs.on_core_event`."""
        if event.kind == "calibration_progress" and event.message == TRIALS_BEGIN:
            self._begin(event)
        elif self._state is None or event.id != self._id:
            return
        elif event.kind in ("calibration_sample", "calibration_frames"):
            self._state = self._counted(self._state, event)
            if self._events is not None:
                with suppress(OSError):  # a full disk: no accuracy is predicted from then on
                    store_event(self._events, event)
        elif event.kind == "calibration_finished" and fresh:
            self._end_job()
            self._state = msgspec.structs.replace(self._state, doing="fitting")
        elif event.kind in ("calibration_finished", "calibration_aborted"):
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
                self._job.timeout_s = math.inf  # as long as the motions
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
