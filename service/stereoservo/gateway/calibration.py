"""From trial motions to a model in the core: gathers samples, runs the fit process, hands the model over."""

from __future__ import annotations

from stereoservo.gateway.fitting import Fit, FitFailedError, calibration_result
from stereoservo.gateway.messages import CalibrationResult
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.servolink import ServoLink
from stereoservo.gateway.stores import ModelStore
from stereoservo.kinematics.calibration.trials import CalibrationError
from stereoservo.kinematics.model import CellModel, ModelFileError
from stereoservo.runtime.calibration_job import CalibrationJob
from stereoservo.runtime.cycle import Event
from stereoservo.runtime.settings import CoreSettings


class Calibration:
    """The cell's model and how it comes about. ``model`` is the one that was given to the core last."""

    def __init__(self, settings: CoreSettings, models: ModelStore, link: ServoLink, log: EventLog) -> None:
        self._settings = settings
        self._models = models
        self._link = link
        self._log = log
        self._job = CalibrationJob(settings)
        self._fit: Fit | None = None
        self._result: CalibrationResult | None = None
        self.model: CellModel | None = None

    def load(self, core_epoch: int) -> None:
        """Give the newest fitting model of the disk to the core, unless that (epoch ``core_epoch``) has it."""
        model, passed = self._models.newest_fitting(self._settings)
        for text in passed:
            self._log.add("warning", message=f"model passed over: {text}", origin="gateway")
        # Given again to a core that has it, after a restart of the gateway, it would lose its estimates.
        if model is not None and (model.epoch == core_epoch or self._link.give_model(model)):
            self.model = model

    def core_event(self, event: Event, *, fresh: bool) -> None:
        """Take an event of the core; ``fresh``: it was not acted upon before a restart of the gateway."""
        self._job.add(event)
        if event.kind == "calibration_finished" and fresh:
            self._start()
        elif event.kind == "model" and self._result is not None:
            result, self._result = self._result, None
            self._log.add(
                "calibrated",
                message=f"model epoch {result.epoch}: {result.rms_px:.4f} px rms",
                id=self._job.id,
                calibration=result,
                origin="gateway",
            )
        elif event.kind == "warning" and event.message.startswith("model refused"):
            self._result = None
            self._failed(event.message)

    def _start(self) -> None:
        self.cancel()
        try:
            epoch = self._models.next_epoch()
            self._fit = Fit(self._job.trials(), self._models.path(epoch), epoch)
        except (CalibrationError, OSError) as error:
            self._failed(str(error))
            return
        self._log.add(
            "fit_started", message=f"{self._job.stops} stops", id=self._job.id, progress=0.0, origin="gateway"
        )

    def follow(self) -> None:
        """Tell the fit's progress; when it has ended, hand its model over."""
        if self._fit is None:
            return
        for step in self._fit.poll():
            self._log.add(
                "fit_progress",
                message=step.message,
                id=self._job.id,
                progress=step.progress,
                origin="gateway",
            )
        if not self._fit.ended:
            return
        fit, self._fit = self._fit, None
        try:
            model, seconds = fit.result()
            result = calibration_result(model, fit.model_path, seconds)
        except (FitFailedError, ModelFileError) as error:
            self._failed(str(error))
            return
        if not self._link.give_model(model):
            self._failed(f"the servo process does not take the model; it is saved as {fit.model_path}")
            return
        self.model, self._result = model, result

    def _failed(self, message: str) -> None:
        self._log.add("calibration_failed", message=message, id=self._job.id, origin="gateway")

    def cancel(self) -> None:
        """End a running fit. Idempotent."""
        if self._fit is not None:
            self._fit.cancel()
            self._fit = None
