"""Jobs of the gateway that update the model in use: relocalization of moved cameras on request of the core, and on-line
refinement by the rest poses of goals. Each collects observations at rest, computes a new model in a child process, and
sends it to the core. Also stores cameras that the core re-estimated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import msgspec

from stereoservo.calibration.trial_data import LEAST_POSES, CalibrationError, save_trials
from stereoservo.core.cycle import Event, Status
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.jobs.rest_poses import MOST_POSES, RelocalizationPoses, RestPoses, save_events
from stereoservo.daemon.taught_goals import TaughtGoal
from stereoservo.gateway.calibration_jobs import CalibrationJobs
from stereoservo.gateway.child_jobs import ChildJob, FitFailedError
from stereoservo.gateway.persistence import ModelStore, TaughtStore
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.kinematics.model import CellModel, ModelFileError, load_model, save_model
from stereoservo.messages.check_report import RefinementReport, RelocalizationReport
from stereoservo.messages.goals import ReanchorRefused
from stereoservo.messages.status import RefinementState
from stereoservo.messages.wire import MessageError, RunningGoals
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation

OPERATOR = "the gateway"


class RelocalizationJob(ChildJob):
    """A running relocalization of ``cameras`` in a child process."""

    def __init__(self, job: RelocalizationPoses, model_path: Path, new_path: Path, epoch: int) -> None:
        self.cameras = job.events[-1].cameras
        self.goal = job.events[-1].id
        events_file = new_path.with_name("reanchor.msgpack")
        save_events(events_file, job.events)
        super().__init__(
            "stereoservo.daemon.jobs.relocalization_job",
            str(events_file),
            str(model_path),
            str(new_path),
            "--epoch",
            str(epoch),
        )

    def report(self) -> tuple[CellModel, RelocalizationReport]:
        """The new model and a message about it. Raises FitFailedError, ModelFileError."""
        report = msgspec.convert(self.require("reanchored"), RelocalizationReport)
        return load_model(Path(report.model)), report


class RelocalizationJobs:
    """Handles the core's events ``reanchor``. ``model`` returns the model in use, ``take`` replaces it."""

    def __init__(
        self,
        models: ModelStore,
        link: ServoConnection,
        log: EventLog,
        model: Callable[[], CellModel | None],
        take: Callable[[CellModel], None],
    ) -> None:
        self._models, self._link, self._log = models, link, log
        self._model, self._take = model, take
        self._job = RelocalizationPoses()
        self._fit: RelocalizationJob | None = None
        self._pending: CellModel | None = None

    @property
    def busy(self) -> bool:
        """Whether a new model is being computed."""
        return self._fit is not None

    def on_core_event(self, event: Event, *, fresh: bool) -> None:
        """Handle an event of the core; ``fresh``: it was not handled before a restart of the gateway."""
        if event.kind == "reanchor":
            self._job.add(event)
            if fresh:
                self._start()
        elif event.kind == "camera_adjusted" and fresh:
            self._store_adjusted_matrix(event)

    def on_model_applied(self, epoch: int) -> None:
        """Handle the core's change to the model of ``epoch``."""
        if self._pending is not None and epoch >= self._pending.epoch:
            applied, self._pending = self._pending, None
            if epoch == applied.epoch:
                self._take(applied)

    def _store_adjusted_matrix(self, event: Event) -> None:
        """Store the re-estimated matrix of a mobile camera in the model and in its file."""
        model = self._model()
        if model is None or event.matrix is None or model.epoch != event.epoch:
            return
        adjusted = with_matrix(model, event.name, event.matrix)
        self._take(adjusted)
        try:
            save_model(adjusted, self._models.path(adjusted.epoch))
        except (OSError, ModelFileError) as error:
            self._log.add(
                "warning",
                origin="gateway",
                name=event.name,
                message=f"where camera {event.name} stands now is not kept for the next start: {error}",
            )

    def _start(self) -> None:
        self.cancel()
        model = self._model()
        if model is None:
            self._refuse("the model that the cameras belong to is gone: calibrate")
            return
        try:
            epoch = self._models.next_epoch()
            self._fit = RelocalizationJob(self._job, self._models.path(model.epoch), self._models.path(epoch), epoch)
        except OSError as error:
            self._refuse(str(error))

    def poll(self) -> None:
        """Once the process has ended, send its model to the core, or report why it has none."""
        fit = self._fit
        if fit is None or not fit.finished():
            return
        self._fit = None
        try:
            model, report = fit.report()
        except FitFailedError as error:
            self._refuse(str(error), error.code)
        except ModelFileError as error:
            self._refuse(str(error))
        else:
            self._replace_model(model, report, fit)
        fit.close()

    def _replace_model(self, model: CellModel, report: RelocalizationReport, fit: RelocalizationJob) -> None:
        if not self._link.send_model(model, fit.cameras):
            self._refuse(f"the servo process does not take the model; it is saved as {report.model}")
            return
        self._pending = model
        self._log.add(
            "reanchor_model",
            message=report.message,
            id=fit.goal,
            name=", ".join(fit.cameras),
            origin="gateway",
        )

    def _refuse(self, message: str, code: str = "") -> None:
        self._log.add("reanchor_model", message=message, name=code, accepted=False, origin="gateway")
        self._link.send_command(ReanchorRefused(message), OPERATOR)

    def cancel(self) -> None:
        """Cancel the running job. Idempotent."""
        if self._fit is not None:
            self._fit.close()
        self._fit = None


def with_matrix(model: CellModel, camera: str, matrix: FloatArray) -> CellModel:
    """The model with one camera's matrix (3, 4) replaced."""
    cameras = tuple(
        msgspec.structs.replace(known, matrix=matrix.copy()) if known.name == camera else known
        for known in model.cameras
    )
    return msgspec.structs.replace(model, cameras=cameras)


class RefinementJobs:
    """On-line refinement of the model in use by rest poses of goals; ``on``: whether it is enabled.

    Poses are used while the model monitor finds nothing; any diagnosis discards them all. With `LEAST_POSES`, and
    whenever their number has doubled since, a child process refines the calibrated model. The result is applied while
    no goal runs, also to the taught goals; the calibrated model is kept, and `restore` returns to it.
    """

    def __init__(
        self, settings: CoreSettings, on: bool, models: ModelStore, link: ServoConnection, log: EventLog,
        calibration: CalibrationJobs, relocalization: RelocalizationJobs, taught: TaughtStore,
        running: Callable[[], RunningGoals],
    ) -> None:  # fmt: skip
        moving = settings.body_moves or any(camera.mobile for camera in settings.cameras)
        self._on = on and not moving
        if on and moving:
            log.add("warning", message=f"[calibration] refine: {NO_REFINEMENT}", origin="gateway")
        self._models, self._link, self._log, self._taught = models, link, log, taught
        self._calibration, self._relocalization, self._running = calibration, relocalization, running
        self._poses = RestPoses(settings)
        self._cameras = frozenset(camera.name for camera in settings.cameras)
        self._due = LEAST_POSES
        self._restored = False
        self._epoch = 0
        self._job: ChildJob | None = None
        self._found: tuple[CellModel, RefinementReport] | None = None
        self._pending: tuple[int, int, str] | None = None
        """Replaced epoch, new epoch, and the message reported once the core uses the new one."""
        self._idle = False

    def add_frame(self, observation: CameraObservation) -> None:
        """Add a camera's newest observation."""
        if self._on:
            self._poses.add_frame(observation)

    def on_state(self, status: Status) -> None:
        """Handle the core's newest state: a rest pose, or a condition that ends the collection."""
        if self._pending is not None and status.model_epoch == self._pending[0]:
            self._poses.leave()
            return
        if self._pending is not None:
            if status.model_epoch == self._pending[1]:
                self._log.add("refined", message=self._pending[2], accepted=True, origin="gateway")
            self._pending = None
        self._idle = status.source == "hold" and not status.goal and not status.command.any()
        if not self._on:
            return
        if status.model_epoch != self._epoch:
            self._drop_poses("")
            self._epoch, self._due, self._restored = status.model_epoch, LEAST_POSES, False
        health = status.health
        if health.verdict not in ("ok", "unknown") or health.masked or health.reanchoring:
            self._drop_poses(f"the watch over the model finds {health.verdict}: {health.text}")
        elif self._trusted(status):
            self._poses.add_state(status)
        else:
            self._poses.leave()

    def state(self) -> RefinementState | None:
        """Progress of the refinement; None if nothing is refined."""
        if not self._on:
            return None
        model, poses = self._calibration.model, len(self._poses.poses)
        doing = "refining" if self._job is not None else "waiting" if self._found is not None else "collecting"
        return RefinementState(
            poses,
            self._due if self._due <= MOST_POSES else None,
            doing,
            0 if model is None else model.refined_from,
        )

    def _trusted(self, status: Status) -> bool:
        """Whether the core uses all cameras and their stamps, with a valid model, and does not calibrate."""
        return (
            status.model == "valid"
            and status.health.verdict == "ok"
            and status.source not in ("calibration", "check")
            and self._cameras <= status.innovation_px.keys()
            and all(math.isfinite(value) for value in status.innovation_px.values())
            and not any(camera.timing for camera in status.health.cameras.values())
        )

    def _drop_poses(self, why: str) -> None:
        """Drop all poses, and the running refinement."""
        dropped = len(self._poses.poses)
        self._poses.clear()
        self._due = MOST_POSES + 1 if self._restored else LEAST_POSES
        if why and (dropped or self._job is not None):
            self._refuse(f"not refined: {why}. {dropped} rest poses are dropped", "watch")
        self.cancel()

    def poll(self) -> None:
        """Start a refinement that is due, handle a finished one, apply a model while no goal runs."""
        if not self._on:
            return
        if self._job is not None:
            self._poll_job(self._job)
            return
        model = self._calibration.model
        if model is None or model.epoch != self._epoch or self._calibration.busy or self._relocalization.busy:
            return
        if self._found is None:
            if len(self._poses.poses) >= self._due:
                self._start(model)
        elif self._idle and not self._running().goals:
            (found, report), self._found = self._found, None
            self._replace_model(model, found, f"{report.message}. {UNDO}")

    def _start(self, model: CellModel) -> None:
        self._due = 2 * self._due if self._due < MOST_POSES else MOST_POSES + 1
        base = self._models.path(model.refined_from or model.epoch)
        poses, self._path = base.with_name("refine.npz"), base.with_name("refined.json")
        try:
            save_trials(self._poses.trials(), poses)
            self._job = ChildJob(
                "stereoservo.daemon.jobs.refinement_job",
                str(poses),
                str(base),
                str(self._models.path(model.epoch)),
                str(self._path),
            )
        except (CalibrationError, OSError) as error:
            self._refuse(str(error), getattr(error, "code", ""))

    def _poll_job(self, job: ChildJob) -> None:
        if not job.finished():
            return
        self._job = None
        try:
            report = msgspec.convert(job.require("refined"), RefinementReport)
            self._found = load_model(self._path), report
        except FitFailedError as error:
            self._refuse(str(error), error.code)
            if error.code not in ("not_better", "too_few_stops"):
                self._poses.clear()
        except (ModelFileError, msgspec.ValidationError) as error:
            self._refuse(str(error))
        job.close()

    def _replace_model(self, used: CellModel, found: CellModel, why: str) -> bool:
        """Replace ``used`` by ``found``, with a new epoch, also for the taught goals. Returns whether that succeeded;
        if not, nothing has changed and the reason is reported.

        The model's file is the commit: after a crash the next start restates the goals by it (`complete_replacement`).
        """
        epoch = self._models.next_epoch()
        model = msgspec.structs.replace(found, epoch=epoch, in_place_of=used.epoch)
        before = self._taught.goals
        try:
            # From here on the next start uses this model, and its goals.
            save_model(model, self._models.path(epoch))
            self._taught.refine(used, model)
        except (OSError, ModelFileError) as error:
            self._refuse(f"model epoch {epoch} cannot be stored: {error}{self._roll_back(epoch, before)}")
            return False
        if not self._link.send_model(model):
            self._refuse(
                f"the servo process does not take model epoch {epoch}; epoch {used.epoch} stays in use"
                f"{self._roll_back(epoch, before)}"
            )
            return False
        self._epoch, self._calibration.model = epoch, model
        self._pending = used.epoch, epoch, f"model epoch {epoch}: {why}"
        return True

    def _roll_back(self, epoch: int, goals: dict[str, TaughtGoal]) -> str:
        """Undo a hand-over, deleting the model's file last: while it exists, the next start completes the hand-over.
        Returns a text on what could not be undone.
        """
        try:
            self._taught.restore_goals(goals)
            self._models.path(epoch).unlink(missing_ok=True)
        except OSError as error:
            return f". Its file stays ({error.strerror}): the next start uses it, with the goals restated in it"
        return ""

    def complete_replacement(self) -> None:
        """Restate the taught goals in the model in use, if a crash prevented it. Called once, at the start."""
        model = self._calibration.model
        if model is None or not model.in_place_of:
            return
        used = self._models.of_epoch(model.in_place_of)
        try:
            if used is not None:
                self._taught.refine(used, model)
        except OSError as error:
            self._warn(f"taught goals are not stored as restated in model epoch {model.epoch}: {error}")
        of_used = [
            name for name, goal in sorted(self._taught.goals.items()) if goal.target.model_epoch == model.in_place_of
        ]
        if used is None and of_used:
            self._warn(
                f"taught goals {', '.join(of_used)} cannot be restated in model epoch {model.epoch}: the file of model "
                f"epoch {model.in_place_of} is gone or damaged; teach them again"
            )

    def _warn(self, message: str) -> None:
        self._log.add("warning", message=message, origin="gateway")

    def restore(self) -> str:
        """Return to the calibrated model from which the one in use was refined, and refine no more until the next
        calibration or start. Returns a description. Raises MessageError.
        """
        used = self._calibration.model
        if used is None or not used.refined_from:
            raise MessageError("the model in use is not refined: there is nothing to undo")
        busy = self._calibration.busy or self._relocalization.busy
        if busy or not self._idle or self._running().goals:
            raise MessageError("the arm is at work: wait until no goal runs, or cancel it, then undo again")
        if self._pending is not None:
            raise MessageError(f"refined model epoch {used.epoch} is just being taken in: undo again in a moment")
        base = self._models.of_epoch(used.refined_from)
        if base is None:
            raise MessageError(f"the file of calibrated model epoch {used.refined_from} is gone: calibrate again")
        self.cancel()
        self._poses.clear()
        text = f"the calibrated model epoch {base.epoch} is back, in place of refined epoch {used.epoch}"
        if not self._replace_model(used, base, text):
            raise MessageError(f"refined epoch {used.epoch} stays in use; event `refined` says why nothing was undone")
        self._due, self._restored = MOST_POSES + 1, True
        return text

    def _refuse(self, message: str, code: str = "") -> None:
        self._log.add("refined", message=message, name=code, accepted=False, origin="gateway")

    def cancel(self) -> None:
        """Cancel the running job, and drop its result. Idempotent."""
        if self._job is not None:
            self._job.close()
        self._job = self._found = None


UNDO = "The calibrated model comes back by `calibrate CELL --undo-refinement`"
NO_REFINEMENT = (
    "nothing is refined in a cell whose cameras are mobile or whose marker body moves by itself: what its rest poses "
    "show is not the arm alone"
)
