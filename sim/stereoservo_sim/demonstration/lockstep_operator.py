"""Operator of a cell in lockstep: enables, calibrates, teaches, sends goals and waits until they end."""

from __future__ import annotations

import uuid
from collections.abc import Callable

from stereoservo.calibration.change.model_check import (
    check_model_holds,
    examine_model,
    make_check_report,
    reset_zeros,
)
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.core.cycle import Event, ModelUpdate
from stereoservo.daemon.jobs.relocalization_job import relocalize_from_events
from stereoservo.daemon.jobs.rest_poses import RelocalizationPoses
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.daemon.taught_goals import feature_target
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.goals import (
    Calibrate,
    Command,
    Enable,
    FeatureTarget,
    Goal,
    Home,
    PlanReport,
    ReanchorRefused,
    RunGoal,
    Target,
    TaughtTarget,
    Teach,
)
from stereoservo.messages.status import Lifecycle

TERMINAL = frozenset({"goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted"})
CALIBRATION_TIMEOUT_S = 1800.0


class LockstepRefusalError(Exception):
    """The cell refused a command, or aborted its execution; carries the event."""

    def __init__(self, event: Event) -> None:
        super().__init__(event.message)
        self.event = event


class LockstepOperator:
    """Operates a ``LockstepCell`` as a client does a daemon; each call runs virtual time until its end."""

    def __init__(self, cell: LockstepCell, *, seed: int = 0) -> None:
        self.cell = cell
        self.taught: dict[str, FeatureTarget] = {}
        self.trials: TrialData | None = None
        self._epoch = 0
        self._body: tuple[int, ...] | None = None
        self._reanchoring = RelocalizationPoses()
        self.answers = True
        """Whether cameras that have moved are relocalized for the core, as the gateway does."""
        cell.on_event.append(self._answer)
        self._ids = (uuid.UUID(int=(seed << 32) + k) for k in range(1, 1 << 32))

    def _answer(self, event: Event) -> None:
        """Relocalize moved cameras from the observations in the core's event."""
        if event.kind != "reanchor":
            return
        self._reanchoring.add(event)
        model = self.cell.core.state.model
        if not self.answers or model is None:
            return
        try:
            found = relocalize_from_events(self._reanchoring.events, model, max(self._epoch, model.epoch) + 1)
        except CalibrationError as error:
            self.cell.request(ReanchorRefused(str(error)))
            return
        self._epoch = found.model.epoch
        self.cell.update_model(ModelUpdate(found.model, event.cameras))

    def _submit(self, command: Command) -> Event:
        reply = self.cell.submit(command)
        if not reply.accepted:
            raise LockstepRefusalError(reply)
        return reply

    def enable(self) -> None:
        """Enable, and wait until the arm may move. Raises LockstepRefusalError, LockstepTimeoutError."""
        since = self._last_event
        self._submit(Enable())
        self.cell.wait_for(lambda e: e.kind == "lifecycle" and e.name == Lifecycle.ACTIVE, 5.0, since - 1)

    def calibrate(self, progress: Callable[[str, float], None] | None = None) -> CellModel:
        """Run trial motions, fit in this process, send the model to the core. Raises LockstepRefusalError,
        CalibrationError.
        """
        self.trials = self._measure(check=False)
        self._epoch += 1
        model = fit_model(self.trials, epoch=self._epoch, progress=progress).model
        self.use_model(model)
        return model

    def check(self, model: CellModel) -> CheckReport:
        """Run the check motion and test ``model`` with it. Raises LockstepRefusalError, CalibrationError."""
        seen = self._measure(check=True)
        return check_model_holds(model, seen, limit_px=self.cell.settings.tolerance_px)

    def reset_zeros(self, model: CellModel) -> tuple[CellModel, ZeroReset]:
        """Run the check motion and send a model with corrected joint zeros to the core. Raises
        LockstepRefusalError, CalibrationError.
        """
        seen = self._measure(check=True)
        examined = examine_model(model, seen)
        report = make_check_report(examined, limit_px=self.cell.settings.tolerance_px)
        self._epoch += 1
        cured, reset = reset_zeros(examined, report, epoch=self._epoch)
        self.use_model(cured)
        return cured, reset

    def use_model(self, model: CellModel) -> None:
        """Send a model to the core, and wait until it is in use. Raises LockstepTimeoutError."""
        since = self._last_event
        self.cell.update_model(ModelUpdate(model))
        self.cell.wait_for(lambda e: e.kind == "model" and self.cell.status.model_epoch == model.epoch, 5.0, since)
        self._epoch, self._body = model.epoch, model.marker_ids

    @property
    def _last_event(self) -> int:
        """Number of the newest event. Read before a request, since effects may precede its reply."""
        return self.cell.events[-1].seq if self.cell.events else 0

    def _measure(self, *, check: bool) -> TrialData:
        """Run the calibration motion or the check motion; returns its measurements."""
        first, since = len(self.cell.events), self._last_event
        goal_id = str(next(self._ids))
        self._submit(Calibrate(goal_id, check=check))
        ends = ("calibration_finished", "check_finished", "calibration_aborted")
        end = self.cell.wait_for(lambda e: e.id == goal_id and e.kind in ends, CALIBRATION_TIMEOUT_S, since)
        if end.kind == "calibration_aborted":
            raise LockstepRefusalError(end)
        job = TrialCollector(self.cell.settings)
        for event in self.cell.events[first:]:
            job.add(event)
        return job.trials()

    def teach(self, name: str, frames: int = 20) -> Event:
        """Store the current observations as goal ``name``. Raises LockstepRefusalError."""
        since = self._last_event
        self._submit(Teach(name, frames))
        event = self.cell.wait_for(lambda e: e.name == name and e.kind in ("taught", "warning"), 30.0, since)
        if event.kind != "taught":
            raise LockstepRefusalError(event)
        self.taught[name] = feature_target(event, self._epoch, self._body)
        return event

    def goal(self, target: Target | str, *, timeout_s: float = 120.0, **options: object) -> Event:
        """Run a goal (a taught one by its name) to its end. Raises LockstepRefusalError if it is refused."""
        goal = self._goal(target, **options)
        since = self._last_event
        self._submit(RunGoal(goal))
        return self.cell.wait_for(lambda e: e.id == goal.id and e.kind in TERMINAL, timeout_s, since)

    def planned(self, target: Target | str, **options: object) -> PlanReport:
        """Plan of a goal, without motion. Raises LockstepRefusalError if it is refused."""
        reply = self._submit(RunGoal(self._goal(target, check=True, **options)))
        if reply.plan is None:
            raise ValueError(f"goals of this kind are not planned: {target}")
        return reply.plan

    def _goal(self, target: Target | str, **options: object) -> Goal:
        named = target.name if isinstance(target, TaughtTarget) else target
        resolved = self.taught[named] if isinstance(named, str) else named
        return Goal(str(next(self._ids)), resolved, **options)  # type: ignore[arg-type]

    def home(self) -> Event:
        """Move home. Raises LockstepRefusalError."""
        goal_id = str(next(self._ids))
        since = self._last_event
        self._submit(Home(goal_id))
        return self.cell.wait_for(lambda e: e.id == goal_id and e.kind in TERMINAL, 120.0, since)
