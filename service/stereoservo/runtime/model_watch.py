"""What follows from images that contradict the model: cameras found anew, markers left out, a model that is suspect."""

from __future__ import annotations

from stereoservo.control.reasons import Reason
from stereoservo.kinematics.model import CellModel
from stereoservo.runtime import ending, health, mobile, reanchoring
from stereoservo.runtime.cycle import ModelReadiness
from stereoservo.runtime.estimate import SUSPECT_FRAMES, TRUSTED_FRAMES
from stereoservo.runtime.health_state import Verdict
from stereoservo.runtime.motion import Present
from stereoservo.runtime.state import LawRun, Visiting


def fitted(model: CellModel) -> ModelReadiness:
    """What a model is before the images have said anything of it."""
    good = model.statistics is not None and model.statistics.chi2_ok
    return ModelReadiness.VALID if good else ModelReadiness.CANDIDATE


def watch_health(present: Present) -> None:
    """Say what explains the images, when that has changed, and do what follows."""
    state = present.state
    run = state.reanchoring
    if run is not None and run.phase != "verify":
        if run.phase == "collect":
            health.watch(present)  # for `reanchoring`, which looks whether they have moved at all
        return  # at rest, what stands is watched by `reanchoring`
    verdict = health.watch(present)
    if mobile.takes(present):
        return
    if state.reanchoring is None and state.watching.verdict.kind in health.MOVED:
        _camera_moved(state.watching.verdict, present, fresh=verdict is not None)
    if verdict is None or (state.reanchoring is not None and state.reanchoring.phase == "verify"):
        return
    health.tell(verdict, present)
    if verdict.kind == "joint_zero":
        for estimate in state.cameras:  # images decide where the arm goes: they are believed from here on
            estimate.seen_ns[:] = 0
    if verdict.kind == "marker_slipped" and health.mask(verdict, present):
        subject = ", ".join(verdict.subjects)
        present.emit("warning", message=f"marker {subject} is not used any more", name=subject)


def _camera_moved(verdict: Verdict, present: Present, *, fresh: bool) -> None:
    """Find it anew, where that is allowed; else the model is suspect, and what relies on it ends."""
    state = present.state
    reason = health.verdict_reason(verdict)
    assert reason is not None
    if isinstance(state.source, Visiting):
        if fresh:
            ending.end_source(present, "goal_aborted", (reason,), verdict.text)
        return
    if verdict.moved_px <= present.settings.tolerance_px or state.readiness == ModelReadiness.SUSPECT:
        return
    if present.settings.reanchor:
        reanchoring.begin(verdict, present)
        return
    state.readiness = ModelReadiness.SUSPECT
    hint = f"{verdict.text}; it is not found anew by itself ([servo] reanchor): calibrate"
    present.emit("model", message=hint, name=str(state.readiness), reasons=(reason,))
    if isinstance(state.source, LawRun):
        ending.end_source(present, "goal_aborted", (reason,), hint)


def watch_model(present: Present) -> None:
    """Images that contradict the model for many frames make it SUSPECT; ones that agree with it clear it."""
    state = present.state
    if state.reanchoring is not None:
        return
    if state.readiness == ModelReadiness.SUSPECT and state.model is not None:
        if min(estimate.agreeing_frames for estimate in state.cameras) >= TRUSTED_FRAMES:
            state.readiness = fitted(state.model)
            present.emit("model", message="the images agree with the model again", name=str(state.readiness))
        return
    if state.readiness not in (ModelReadiness.VALID, ModelReadiness.CANDIDATE):
        return
    for camera, estimate in zip(present.settings.cameras, state.cameras, strict=True):
        if estimate.rejected_frames < SUSPECT_FRAMES:
            continue
        state.readiness = ModelReadiness.SUSPECT
        reason = Reason(
            "MODEL_SUSPECT", "hold", camera.name, float(estimate.rejected_frames), float(SUSPECT_FRAMES), "frames",
            state.watching.verdict.text
            or f"camera {camera.name} contradicts the model: was it moved, has a marker slipped? Calibrate again",
        )  # fmt: skip
        present.emit("model", message=reason.hint, name=str(state.readiness), reasons=(reason,))
        if isinstance(state.source, LawRun):
            ending.end_source(present, "goal_aborted", (reason,), reason.hint)
        return
