"""Stage 3, monitor: requests, then what must stop the arm, put the cell in fault, or end a goal.

Each monitor of `MONITORS` is called with the context, in the order of the table, and gives its findings, on which the
stage acts at once: what one monitor stops, the next ones see stopped. To add one: a function, and a line in the table.

Requests are answered here, after the stop and before all other monitors: hold, resume, enable, teach and jog change
what is monitored in this very step, and a goal that is accepted in a step in which something is found ends in that step
with an event of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from stereoservo.core.context import Finding, StepContext
from stereoservo.core.estimate import fitted_readiness
from stereoservo.core.goals.accept import answer_all, refuse_waiting
from stereoservo.core.goals.execute import end_queue, end_source
from stereoservo.core.monitor_state import MOVED, ModelDiagnosis
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.joints import monitor_collision, monitor_following
from stereoservo.core.monitors.model import diagnosis_reason, emit_diagnosis, finish_round, mask_marker
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import SUSPECT_FRAMES, TRUSTED_FRAMES
from stereoservo.core.sources.teaching import teach_step
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle, ModelReadiness

Findings = Iterable[Finding]


class Monitor(NamedTuple):
    """A monitor: ``watch`` accounts for one step and gives what it has found."""

    name: str
    watch: Callable[[StepContext], Findings]


def monitor(context: StepContext) -> tuple[Finding, ...]:
    """What the monitors have found in this step, all of it acted on."""
    found: list[Finding] = []
    for entry in MONITORS:
        for finding in entry.watch(context):
            _act(finding, context)
            found.append(finding)
    return tuple(found)


def _act(finding: Finding, context: StepContext) -> None:
    """Stop the arm, latch the fault, or end the active goal."""
    state, reason = context.state, finding.reason
    end_source(context, "goal_aborted", (reason,), finding.ended)
    if finding.effect == "abort":
        return
    end_queue(context, (reason,), finding.ended)
    if finding.effect == "fault":
        state.fault = [reason]
        state.lifecycle = Lifecycle.FAULT
        state.driver_request = "deactivate"
        context.emit("fault", message=finding.message, reasons=(reason,))
        return
    refuse_waiting((reason,), context)
    state.stopped = True
    state.stop_reason = reason if finding.latched else None
    context.emit("stopped", message=finding.message, reasons=(reason,))


# -- monitors -----------------------------------------------------------------------------------------------


def _monitor_stop(context: StepContext) -> Findings:
    """Somebody has raised the stop."""
    if not context.inputs.stop:
        return ()
    reason = Reason("STOPPED", "hold", hint="resume, then send the goal again")
    return (Finding("stop", reason, "stopped", "stop: the arm brakes and holds", latched=False),)


def _answer_requests(context: StepContext) -> Findings:
    """Requests of clients; none is a finding."""
    if context.inputs.requests:
        answer_all(context.inputs.requests, context)
    return ()


def _monitor_inputs(context: StepContext) -> Findings:
    """Inputs that cannot be right, or a loop that stood still, stop an arm that may move."""
    stops = context.ingested.stops
    if not stops or context.state.lifecycle != Lifecycle.ACTIVE or context.state.stopped:
        return ()
    reason = stops[0]
    return (Finding("stop", reason, reason.hint, f"stop: {reason.hint}"),)


def _monitor_teaching(context: StepContext) -> Findings:
    """A goal that is being taught, which motion ends."""
    if context.state.teaching is not None:
        teach_step(context)
    return ()


def _monitor_innovations(context: StepContext) -> Iterator[Finding]:
    """What explains the images, where that has changed: an event, and what follows from it."""
    state = context.state
    run = state.reanchoring
    if run is not None and run.phase != "verify":
        if run.phase == "collect":
            finish_round(context)  # for `reanchoring`, which looks whether they have moved at all
        return  # at rest, what stands is watched by `reanchoring`
    verdict = finish_round(context)
    if any(state.mobile) and moving_camera.takes(context):
        return
    if state.reanchoring is None and state.watching.verdict.kind in (*MOVED, "cameras_or_arm"):
        yield from _camera_moved(state.watching.verdict, context, fresh=verdict is not None)
    if verdict is None or (state.reanchoring is not None and state.reanchoring.phase == "verify"):
        return
    emit_diagnosis(verdict, context)
    if verdict.kind == "joint_zero":
        for estimate in state.cameras:  # images decide where the arm goes: they are believed from here on
            estimate.seen_ns[:] = 0
    if verdict.kind == "marker_slipped" and mask_marker(verdict, context):
        subject = ", ".join(verdict.subjects)
        context.emit("warning", message=f"marker {subject} is not used any more", name=subject)


def _camera_moved(verdict: ModelDiagnosis, context: StepContext, *, fresh: bool) -> Iterator[Finding]:
    """Look at rest, and find it anew where it has moved; without leave for that the model is suspect, and what relies
    on it ends.
    """
    state = context.state
    reason = diagnosis_reason(verdict)
    assert reason is not None
    source = MOTION_SOURCES[type(state.source)]
    if source.measures:  # a calibration, or a check, finds out itself whether it was the arm
        if fresh and verdict.kind in MOVED:
            yield Finding("abort", reason, verdict.text)
        return
    if verdict.moved_px <= context.settings.tolerance_px or state.readiness == ModelReadiness.SUSPECT:
        return
    if context.settings.reanchor:
        camera_relocalization.begin(verdict, context)
        return
    state.readiness = ModelReadiness.SUSPECT
    hint = f"{verdict.text}; it is not found anew by itself ([servo] reanchor): calibrate"
    context.emit("model", message=hint, name=str(state.readiness), reasons=(reason,))
    if source.runs_law:
        yield Finding("abort", reason, hint)


def _monitor_model(context: StepContext) -> Iterator[Finding]:
    """Images that contradict the model for many frames make it SUSPECT; ones that agree with it clear it."""
    state = context.state
    if state.reanchoring is not None:
        return
    if state.readiness == ModelReadiness.SUSPECT and state.model is not None:
        if min(estimate.agreeing_frames for estimate in state.cameras) >= TRUSTED_FRAMES:
            state.readiness = fitted_readiness(state.model)
            context.emit("model", message="the images agree with the model again", name=str(state.readiness))
        return
    if state.readiness not in (ModelReadiness.VALID, ModelReadiness.CANDIDATE):
        return
    for camera, estimate in zip(context.settings.cameras, state.cameras, strict=True):
        if estimate.rejected_frames < SUSPECT_FRAMES:
            continue
        state.readiness = ModelReadiness.SUSPECT
        reason = Reason(
            "MODEL_SUSPECT", "hold", camera.name, float(estimate.rejected_frames), float(SUSPECT_FRAMES), "frames",
            state.watching.verdict.text
            or f"camera {camera.name} contradicts the model: was it moved, has a marker slipped? Calibrate again",
        )  # fmt: skip
        context.emit("model", message=reason.hint, name=str(state.readiness), reasons=(reason,))
        if MOTION_SOURCES[type(state.source)].runs_law:
            yield Finding("abort", reason, reason.hint)
        return


def _monitor_relocalization(context: StepContext) -> Findings:
    """Cameras that are being found again; laws wait meanwhile."""
    if context.state.reanchoring is not None:
        camera_relocalization.step(context)
    return ()


MONITORS: tuple[Monitor, ...] = (
    Monitor("stop", _monitor_stop),
    Monitor("requests", _answer_requests),
    Monitor("inputs", _monitor_inputs),
    Monitor("collision", monitor_collision),
    Monitor("following error", monitor_following),
    Monitor("teaching", _monitor_teaching),
    Monitor("innovations", _monitor_innovations),
    Monitor("model", _monitor_model),
    Monitor("relocalization", _monitor_relocalization),
)
