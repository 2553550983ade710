"""Jobs of the gateway that relocalize moved cameras on request of the core: collects observations at rest, computes
new camera matrices in a child process, sends the model to the core. Also stores cameras that the core re-estimated.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from stereoservo.core.cycle import Event
from stereoservo.daemon.jobs.relocalization_job import RelocalizationPoses, RelocalizationReport, save_events
from stereoservo.gateway.child_jobs import ChildJob, FitFailedError
from stereoservo.gateway.persistence import ModelStore
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.kinematics.model import CellModel, ModelFileError, load_model, save_model
from stereoservo.messages.goals import ReanchorRefused
from stereoservo.numerics.arrays import FloatArray

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
        """The new model and a message on it. Raises FitFailedError, ModelFileError."""
        report = msgspec.convert(self.require("reanchored"), RelocalizationReport)
        return load_model(Path(report.model)), report


class RelocalizationJobs:
    """Handles the core's events ``reanchor``. ``model``: returns the model in use, ``take`` replaces it."""

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
        self._handed: CellModel | None = None

    def core_event(self, event: Event, *, fresh: bool) -> None:
        """Handle an event of the core; ``fresh``: it was not handled before a restart of the gateway."""
        if event.kind == "reanchor":
            self._job.add(event)
            if fresh:
                self._start()
        elif event.kind == "model" and self._handed is not None:
            self._take(self._handed)
            self._handed = None
        elif event.kind == "camera_adjusted" and fresh:
            self._keep_adjusted(event)

    def _keep_adjusted(self, event: Event) -> None:
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
                "warning", origin="gateway", name=event.name,
                message=f"where camera {event.name} stands now is not kept for the next start: {error}",
            )  # fmt: skip

    def _start(self) -> None:
        self.cancel()
        model = self._model()
        if model is None:
            self._refuse("the model that the cameras belong to is gone: calibrate")
            return
        try:
            epoch = self._models.next_epoch()
            self._fit = RelocalizationJob(
                self._job, self._models.path(model.epoch), self._models.path(epoch), epoch
            )
        except OSError as error:
            self._refuse(str(error))

    def poll(self) -> None:
        """Once the process has ended, send its model to the core, or report why there is none."""
        fit = self._fit
        if fit is None:
            return
        ended = fit.ended  # read first, so that the output before the end is processed, too
        for _ in fit.poll():
            pass
        if not ended:
            return
        self._fit = None
        try:
            model, report = fit.report()
        except FitFailedError as error:
            self._refuse(str(error), error.code)
        except ModelFileError as error:
            self._refuse(str(error))
        else:
            self._hand_over(model, report, fit)
        fit.close()

    def _hand_over(self, model: CellModel, report: RelocalizationReport, fit: RelocalizationJob) -> None:
        if not self._link.send_model(model, fit.cameras):
            self._refuse(f"the servo process does not take the model; it is saved as {report.model}")
            return
        self._handed = model
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
