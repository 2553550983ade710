"""ServoCore: one step from inputs to a joint velocity. Pure given its state: no clock, no I/O, no random number."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.control.reasons import Level, Reason
from stereoservo.control.safety import SafetyInputs, SafetyLimits, SafetyResult, safety_stage
from stereoservo.kinematics.model import CellModel
from stereoservo.runtime import (
    contact,
    ending,
    following,
    goals,
    going_on,
    health,
    intake,
    mobile,
    progress,
    reanchoring,
)
from stereoservo.runtime.check import check_step
from stereoservo.runtime.cycle import (
    Event,
    Lifecycle,
    ModelReadiness,
    ModelUpdate,
    Status,
    StepInputs,
    StepOutputs,
)
from stereoservo.runtime.estimate import (
    ModelArrays,
    accept_sights,
    frame_sights,
    ideal_observation,
    joint_correction,
    joints_at,
    marker_weights,
    model_arrays,
    motion_at,
    pixels_now,
    predict,
    priors,
    remember_joints,
)
from stereoservo.runtime.incidences import incidence_motion
from stereoservo.runtime.model_watch import fitted, watch_health, watch_model
from stereoservo.runtime.motion import Motion, Present, joint_move
from stereoservo.runtime.ports import CameraObservation, FloatArray
from stereoservo.runtime.servoing import servo_step
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.state import (
    Awaiting,
    Checking,
    CoreState,
    Holding,
    Incidence,
    Jogging,
    JointMove,
    LawRun,
    Servoing,
    Source,
    Trials,
    Visiting,
    camera_estimate,
    initial_state,
)
from stereoservo.runtime.teaching import teach_step
from stereoservo.runtime.trials import trials_step

PRIOR_RATE_HZ = 125.0
VELOCITY_FILTER_S = 0.01
AT_REST = 1e-3  # [rad/s or m/s]
FRESH_S = 0.15
FRESH_FRAMES = 2.5  # without a frame for so many periods a law is said to coast

SOURCES: dict[type[Source], str] = {
    Holding: "hold", Awaiting: "acknowledge", Jogging: "jog", JointMove: "joints", Servoing: "law", Incidence: "law",
    Trials: "calibrate", Checking: "check",
}  # fmt: skip


class ServoCore:
    """The servo loop's algorithm. ``state`` is all that it remembers."""

    def __init__(self, settings: CoreSettings, state: CoreState | None = None) -> None:
        self.settings = settings
        self.state = initial_state(settings) if state is None else state
        self._arrays: ModelArrays | None = None
        if self.state.model is not None:
            self._arrays = model_arrays(self.state.model, settings)
        limits = settings.limits
        self._limits = SafetyLimits(
            joint_names=settings.joint_names,
            position_min=limits.position_min,
            position_max=limits.position_max,
            velocity_max=limits.velocity_max,
            acceleration_max=limits.acceleration_max,
            position_margin=limits.position_margin,
            keep_outs=limits.keep_outs,
            keep_out_names=limits.keep_out_names,
            joint_timeout_s=limits.joint_timeout_s,
            coast_s=limits.coast_s,
            features_fresh_s=max(
                FRESH_S, FRESH_FRAMES / min((c.rate_hz for c in settings.cameras), default=30.0)
            ),
        )
        self._contact_limits = self._contact_thresholds()
        self._prior_every = max(1, round(settings.rate_hz / PRIOR_RATE_HZ))

    def step(self, inputs: StepInputs) -> StepOutputs:
        """One cycle: age-gate, estimate, motion source, safety stage, status and priors."""
        state = self.state
        events: list[Event] = []
        state.driver_request = ""

        def emit(kind: str, **fields: Any) -> None:
            state.event_seq += 1
            events.append(Event(state.event_seq, inputs.now_ns, kind, **fields))  # type: ignore[arg-type]

        q = self._take_joints(inputs)
        self._follow_driver(inputs, emit)
        self._take_model(inputs, emit)
        present = mobile.step(self._present(inputs, q, emit))
        self._arrays = present.arrays if present.arrays is not None else self._arrays
        if inputs.stop:
            self._stop(present)
        intake.answer_all(inputs.requests, present)
        self._watch_contact(present, inputs)
        self._watch_following(present)
        teach_step(present)
        watch_health(present)
        watch_model(present)
        reanchoring.step(present)
        going_on.go_on(present)
        intake.answer_waiting(present)
        motion = self._move(present)
        safety = self._safety(inputs, present, motion)
        active = state.lifecycle == Lifecycle.ACTIVE
        state.command = safety.limited.copy() if active else np.zeros_like(q)
        if motion.finished:
            going_on.finish(motion, present)
        state.step += 1
        return StepOutputs(
            command=state.command.copy() if active else None,
            status=self._status(inputs, present, motion, safety),
            priors=self._priors(present),
            events=tuple(events),
            driver_request=state.driver_request,  # type: ignore[arg-type]
        )

    # -- inputs ---------------------------------------------------------------------------------------------

    def _take_joints(self, inputs: StepInputs) -> FloatArray:
        """Append a new joint sample to the history; return the newest positions (zero before the first)."""
        state = self.state
        sample = inputs.joints
        if sample is not None and sample.seq != state.last_joints_seq and sample.t_ns > state.last_joints_ns:
            if state.history.count > 0:
                elapsed_s = (sample.t_ns - state.last_joints_ns) * 1e-9
                previous = state.history.positions[(state.history.count - 1) % len(state.history.t_ns)]
                share = elapsed_s / (elapsed_s + VELOCITY_FILTER_S)
                state.velocities = state.velocities + share * (
                    (sample.positions - previous) / elapsed_s - state.velocities
                )
            remember_joints(state.history, sample)
            state.last_joints_seq, state.last_joints_ns = sample.seq, sample.t_ns
        if state.history.count == 0:
            return np.zeros_like(state.command)
        newest: FloatArray = state.history.positions[
            (state.history.count - 1) % len(state.history.t_ns)
        ].copy()
        return newest

    def _follow_driver(self, inputs: StepInputs, emit: Any) -> None:
        """The lifecycle follows what the servo process did with the driver; a fault is latched."""
        state = self.state
        before = state.lifecycle
        if inputs.driver_fault is not None and (before != Lifecycle.FAULT or not state.fault):
            reason = Reason(
                "DRIVER_FAULT",
                "fault",
                hint=f"{inputs.driver_fault.code}: {inputs.driver_fault.message}; clear the cause, then reset",
            )
            state.fault = [reason]
            state.lifecycle = Lifecycle.FAULT
            state.driver_request = "deactivate"
            emit("fault", message=reason.hint, reasons=(reason,))
        elif before == Lifecycle.FAULT:
            if inputs.driver_fault is None and not state.fault:
                state.lifecycle = Lifecycle.INACTIVE
        elif not inputs.driver_configured:
            state.lifecycle = Lifecycle.UNCONFIGURED
        else:
            state.lifecycle = Lifecycle.ACTIVE if inputs.driver_active else Lifecycle.INACTIVE
        if state.lifecycle != before:
            emit("lifecycle", message=f"{before} -> {state.lifecycle}", name=str(state.lifecycle))

    def _take_model(self, inputs: StepInputs, emit: Any) -> None:
        """A new model waits until the arm rests and no law runs; then every estimate starts anew."""
        state = self.state
        if inputs.model_update is not None:
            try:
                model_arrays(inputs.model_update.model, self.settings)
            except ValueError as error:
                emit("warning", message=f"model refused: {error}")
            else:
                self._await(inputs.model_update, emit)
        if state.pending_model is None:
            return
        run = state.reanchoring
        if state.pending_reanchored:
            if run is None or run.phase != "take":
                return
            self._use_model(state.pending_model, masked=health.masked_ids(state))
            reanchoring.taken(run, state, inputs.now_ns)
        elif isinstance(state.source, LawRun) or state.planning is not None or self._moving():
            return
        else:
            self._use_model(state.pending_model)
            state.reanchoring = None
        assert self._arrays is not None
        mobile.start(state, self.settings, self._arrays, state.pending_reanchored, emit)
        state.pending_model, state.pending_reanchored = None, ()
        emit("model", message=f"model epoch {self._epoch()} is {state.readiness}", name=str(state.readiness))

    def _moving(self) -> bool:
        return bool((np.abs(self.state.command) > AT_REST).any())

    def _await(self, update: ModelUpdate, emit: Any) -> None:
        """Keep a model until it may be used; a re-anchored one must be the one that is waited for."""
        state = self.state
        if update.reanchored:
            refusal = reanchoring.misfit(state, update)
            if refusal:
                emit("warning", message=f"re-anchored model refused: {refusal}")
                return
        state.pending_model = mobile.with_adjusted(state, update.model, update.reanchored)
        state.pending_reanchored = update.reanchored

    def _use_model(self, model: CellModel, masked: tuple[int, ...] = ()) -> None:
        """``masked``: markers that have slipped and stay unused."""
        state = self.state
        self._arrays = model_arrays(model, self.settings)
        health.start(state, self._arrays, self.settings, masked)
        state.model = model
        self._contact_limits = self._contact_thresholds()
        state.readiness = fitted(model)
        state.cameras = [camera_estimate(len(model.marker_ids)) for _ in self.settings.cameras]

    def _contact_thresholds(self) -> tuple[FloatArray, FloatArray] | None:
        if not self.settings.watch_following:
            return None
        model = self.state.model
        return contact.thresholds(self.settings, None if model is None else model.loads)

    def _present(self, inputs: StepInputs, q: FloatArray, emit: Any) -> Present:
        """Fold the observations in, each at its own stamp, and predict the present."""
        state = self.state
        fresh: list[CameraObservation] = []
        unknown = reanchoring.unknown_cameras(state)
        usable = state.watching.masked == 0.0
        for sighting in state.watching.sightings:
            sighting.fresh = False
        for observation in inputs.observations:
            camera = next(
                (i for i, c in enumerate(self.settings.cameras) if c.name == observation.camera), None
            )
            if camera is None or observation.seq <= state.cameras[camera].last_seq:
                continue
            estimate = state.cameras[camera]
            estimate.last_seq = observation.seq
            estimate.last_visible = int(observation.ids.size)
            fresh.append(observation)
            at_shutter = joints_at(state.history, observation.t_shutter_ns)
            if self._arrays is not None and at_shutter is not None:
                ideal = ideal_observation(self._arrays, camera, observation)
                then = predict(self._arrays, at_shutter)
                motion = motion_at(state.history, observation.t_shutter_ns)
                speed = state.velocities if motion is None else motion
                sights = frame_sights(self._arrays, camera, ideal, then, speed)
                if motion is not None:  # where the arm was is known, and not only expected
                    sights = mobile.see(
                        state, self.settings, self._arrays, camera, sights, then, at_shutter, emit
                    )
                    health.see(state.watching, camera, sights, at_shutter)
                if observation.camera not in (*unknown, *mobile.moving_cameras(state, self.settings)):
                    accept_sights(estimate, sights, usable, self.settings)
        common: dict[str, Any] = {
            "now_ns": inputs.now_ns, "dt_s": inputs.period_ns * 1e-9, "q": q, "state": state,
            "settings": self.settings, "observations": tuple(fresh), "emit": emit,
        }  # fmt: skip
        if self._arrays is None or state.history.count == 0:
            return Present(**common)
        prediction = predict(self._arrays, q)
        weights = marker_weights(state.cameras, inputs.now_ns, self.settings.limits.coast_s)
        state.correction = joint_correction(prediction, state.cameras, weights)
        return Present(
            **common, arrays=self._arrays, prediction=prediction, weights=weights,
            pixels=pixels_now(prediction, state.cameras),
        )  # fmt: skip

    # -- what happens ---------------------------------------------------------------------------------------

    def _stop(self, present: Present) -> None:
        reason = Reason("STOPPED", "hold", hint="resume, then send the goal again")
        present.state.contact.reason = None
        self._stop_because(reason, "stopped", "stop: the arm brakes and holds", present)

    @staticmethod
    def _stop_because(reason: Reason, ended: str, message: str, present: Present) -> None:
        ending.end_source(present, "goal_aborted", (reason,), ended)
        ending.end_queue(present, (reason,), ended)
        goals.refuse_waiting((reason,), present)
        present.state.stopped = True
        present.emit("stopped", message=message, reasons=(reason,))

    def _watch_contact(self, present: Present, inputs: StepInputs) -> None:
        """The arm has met something: it stops with its drives on, as if a person had stopped it."""
        reason = contact.watch(self.state, self.settings, self._contact_limits, inputs.joints)
        if reason is not None:
            self._stop_because(reason, reason.hint, f"contact: {reason.hint}", present)

    def _watch_following(self, present: Present) -> None:
        """A joint that does not go where it is sent: its encoder, brake or drive is at fault, and so is the cell."""
        if not self.settings.watch_following or self.state.history.count == 0:
            return
        reason = following.watch(self.state, self.settings, present.q, present.dt_s)
        if reason is None or self.state.lifecycle != Lifecycle.ACTIVE:
            return  # an arm that is off may be moved by hand
        ending.end_source(present, "goal_aborted", (reason,), reason.hint)
        ending.end_queue(present, (reason,), reason.hint)
        self.state.fault = [reason]
        self.state.lifecycle = Lifecycle.FAULT
        self.state.driver_request = "deactivate"
        present.emit("fault", message=reason.hint, reasons=(reason,))

    def _move(self, present: Present) -> Motion:
        """The active source's joint velocity; nothing in hold, stop or outside ACTIVE."""
        state = self.state
        rest = Motion(np.zeros_like(present.q))
        if state.lifecycle != Lifecycle.ACTIVE:
            if not isinstance(state.source, Holding):
                reason = Reason("NOT_ACTIVE", "hold", hint=f"the cell became {state.lifecycle}")
                ending.end_source(
                    present, "goal_aborted", (reason, *state.fault), f"the cell became {state.lifecycle}"
                )
                ending.end_queue(present, (reason,), f"the cell became {state.lifecycle}")
            return rest
        source = state.source
        if isinstance(source, LawRun | JointMove | Visiting) and source.lease_expired(present.now_ns):
            hint = "the client did not renew its lease: is it alive?"
            reason = Reason("LEASE_EXPIRED", "hold", "", source.lease_s, source.lease_s, "s", hint)
            ending.end_source(present, "goal_aborted", (reason,), reason.hint)
            return rest
        if state.held or state.stopped or reanchoring.suspended(state):
            return rest
        if isinstance(source, Jogging):
            if present.now_ns >= source.until_ns:
                state.source = Holding()
                return rest
            return Motion(source.velocity)
        if isinstance(source, JointMove):
            return joint_move(source, present)
        if isinstance(source, Trials):
            return trials_step(source, present)
        if isinstance(source, Checking):
            return check_step(source, present)
        if isinstance(source, Servoing):
            return servo_step(source, present)
        if isinstance(source, Incidence):
            return incidence_motion(source, present)
        return rest

    def _safety(self, inputs: StepInputs, present: Present, motion: Motion) -> SafetyResult:
        state = self.state
        newest = max((e.accepted_ns for e in state.cameras), default=0)
        return safety_stage(
            SafetyInputs(
                raw=motion.velocity,
                positions=present.q,
                previous=state.command,
                dt_s=present.dt_s,
                joint_age_s=(inputs.now_ns - state.last_joints_ns) * 1e-9,
                feature_age_s=(inputs.now_ns - newest) * 1e-9,
                needs_features=motion.needs_features,
                speed_scale=motion.speed_scale * self.settings.limits.speed_scale,
                brake=state.held or state.stopped or reanchoring.suspended(state),
            ),
            self._limits,
        )

    # -- outputs --------------------------------------------------------------------------------------------

    def _priors(self, present: Present) -> tuple[Any, ...]:
        if present.prediction is None or self._arrays is None or self.state.step % self._prior_every:
            return ()
        arrays, prediction, cameras, unknown = mobile.to_look_from(self._arrays, present)
        return priors(
            arrays, self.settings, prediction, cameras, self.state.velocities, present.now_ns, unknown
        )

    def _epoch(self) -> int:
        return 0 if self.state.model is None else self.state.model.epoch

    def _reasons(self, present: Present, motion: Motion, safety: SafetyResult) -> tuple[Reason, ...]:
        state = self.state
        found = [*state.fault, *safety.reasons, *motion.reasons]
        found.extend(reanchoring.reasons(state))
        found.extend(mobile.reasons(state, self.settings))
        if state.reanchoring is None and (reason := health.verdict_reason(health.shown(state))) is not None:
            found.append(reason)
        if isinstance(state.source, LawRun) and not (
            state.held or state.stopped or reanchoring.suspended(state)
        ):
            found.extend(progress.watch(state.source, present, tuple(found)))
        if state.planning is not None:
            found.append(progress.planning_reason(state.planning))
        if state.stopped:
            if state.contact.reason is not None:
                found.append(state.contact.reason)
            found.append(Reason("STOPPED", "hold", hint="resume to go on"))
        elif state.held:
            found.append(Reason("HELD", "hold", hint="resume to go on"))
        if state.readiness == ModelReadiness.SUSPECT:
            found.append(Reason("MODEL_SUSPECT", "hold", hint="calibrate again"))
        return tuple(found)

    def _status(self, inputs: StepInputs, present: Present, motion: Motion, safety: SafetyResult) -> Status:
        state = self.state
        reasons = self._reasons(present, motion, safety)
        source = state.source
        done, left_s = progress.share_and_seconds(source, present)
        return Status(
            t_ns=inputs.now_ns,
            step=state.step,
            lifecycle=str(state.lifecycle),
            model=str(state.readiness),
            model_epoch=self._epoch(),
            source=SOURCES[type(source)],
            goal=source.id if isinstance(source, Awaiting) else ending.goal_of(source),
            law=source.law if isinstance(source, Servoing) else "",
            level=_level(reasons),
            reasons=reasons,
            positions=present.q,
            velocities=state.velocities.copy(),
            command_raw=motion.velocity,
            command=state.command.copy(),
            error_px=motion.error_px,
            task_error=motion.task_error,
            innovation_px={
                c.name: e.rms_px for c, e in zip(self.settings.cameras, state.cameras, strict=True)
            },
            visible={
                c.name: e.last_visible for c, e in zip(self.settings.cameras, state.cameras, strict=True)
            },
            progress=done,
            seconds_left=left_s,
            health=health.health_now(
                state, self.settings, "" if state.reanchoring is None else state.reanchoring.phase
            ),
            **contact.told(state.contact, self._contact_limits),
        )


def _level(reasons: tuple[Reason, ...]) -> str:
    order: tuple[Level, ...] = ("info", "slow", "hold", "fault")
    worst = max((order.index(reason.level) for reason in reasons), default=0)
    return "ok" if worst == 0 else order[worst]
