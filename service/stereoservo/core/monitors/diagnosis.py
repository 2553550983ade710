"""Consequences of a fault diagnosis from the images: its event and status reason, exclusion of a slipped marker,
relocalization of moved cameras. Also the initial state of the model monitor.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stereoservo.core.context import Finding, StepContext
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitor_state import (
    MOVED,
    ModelDiagnosis,
    ModelMonitor,
    nothing_sighted,
)
from stereoservo.core.monitors import camera_relocalization
from stereoservo.core.monitors.fault_isolation import LEAST_PX, present_problem, without_joint_errors
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import MODEL_SIGMA_PX, camera_chi2, improbable
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState
from stereoservo.core.target.track import restart
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import ModelReadiness

FEWEST_LEFT = 4
"""Least number of markers of a camera that must remain if others are masked."""


def start_model_monitor(
    state: CoreState, arrays: ModelArrays, settings: CoreSettings, masked: tuple[int, ...] = ()
) -> None:
    """Start monitoring a new model. ``masked``: ids of markers that stay unused."""
    m = len(arrays.marker_ids)
    watching = nothing_sighted(len(settings.cameras), len(arrays.row_ids), len(settings.joint_names), m)
    for marker in masked:
        if marker in arrays.index:
            watching.masked[arrays.index[marker]] = 1.0
    state.watching = watching
    restart(state, arrays, settings)


def emit_diagnosis(verdict: ModelDiagnosis, context: StepContext) -> None:
    """Report a new diagnosis in an event."""
    message = verdict.text or "the images agree with the model again"
    reason = diagnosis_reason(verdict)
    context.emit(
        "health",
        message=message,
        name=verdict.kind,
        reasons=() if reason is None else (reason,),
        cameras=verdict.subjects if verdict.kind in MOVED else (),
    )


def diagnosis_reason(verdict: ModelDiagnosis) -> Reason | None:
    """A diagnosis as a reason; None if there is no fault."""
    subject, value = ", ".join(verdict.subjects), verdict.size
    if verdict.kind in MOVED:
        return Reason("CAMERA_MOVED", "hold", subject, verdict.moved_px, None, "px", verdict.text)
    if verdict.kind == "cameras_or_arm":
        return Reason("CAMERAS_OR_ARM", "hold", subject, verdict.moved_px, LEAST_PX, "px", verdict.text)
    if verdict.kind == "marker_slipped":
        return Reason("MARKER_SLIPPED", "info", subject, verdict.moved_px, None, "px", verdict.text)
    if verdict.kind == "joint_zero":
        return Reason("JOINT_ZERO_DRIFTED", "info", subject, value, verdict.deviation, verdict.unit, verdict.text)
    if verdict.kind == "unclear":
        return Reason("IMAGES_UNEXPLAINED", "info", subject, verdict.moved_px, None, "px", verdict.text)
    return None


def mask_marker(verdict: ModelDiagnosis, context: StepContext) -> bool:
    """Stop using a slipped marker, if every camera has enough others; returns whether it was masked."""
    state, arrays = context.state, context.arrays
    assert arrays is not None
    slipped = [arrays.index[int(marker)] for marker in verdict.subjects if int(marker) in arrays.index]
    masked = state.watching.masked.copy()
    masked[slipped] = 1.0
    seen = [s.seen[: masked.size] for s in state.watching.sightings if bool((s.seen > 0.0).any())]
    if not slipped or min((float((s * (1.0 - masked)).sum()) for s in seen), default=0.0) < FEWEST_LEFT:
        return False
    state.watching.masked = masked
    state.watching.back[slipped] = 0
    for estimate in state.cameras:
        estimate.seen_ns[slipped] = 0
    return True


def camera_moved_findings(verdict: ModelDiagnosis, context: StepContext, *, fresh: bool) -> Iterator[Finding]:
    """The findings if a camera has moved: relocalization starts at rest; if it is not allowed, the model becomes
    suspect and the goals that rely on it end.
    """
    state = context.state
    reason = diagnosis_reason(verdict)
    assert reason is not None
    source = MOTION_SOURCES[type(state.source)]
    if source.measures:  # a calibration or a check decides itself whether the arm moved
        if fresh and verdict.kind in MOVED:
            yield Finding("abort", reason, verdict.text)
        return
    if verdict.moved_px <= context.settings.tolerance_px or state.readiness == ModelReadiness.SUSPECT:
        return
    if context.settings.reanchor:
        camera_relocalization.begin(verdict, context)
        return
    state.readiness = ModelReadiness.SUSPECT
    hint = f"{verdict.text}; it is not relocalized automatically ([servo] reanchor): calibrate"
    context.emit("model", message=hint, name=str(state.readiness), reasons=(reason,))
    if source.runs_law:
        yield Finding("abort", reason, hint)


BACK_ROUNDS = 30
"""Rounds in which a masked marker must be at its place before it is used again."""


def unmask_returned(watching: ModelMonitor, known: list[int], context: StepContext) -> None:
    """Use a masked marker again that is back in its place in every camera that sees it."""
    arrays = context.arrays
    assert arrays is not None
    masked = np.flatnonzero(watching.masked > 0.0)
    if not masked.size:
        return
    problem = present_problem(context.state, known, arrays, context.settings)
    found = without_joint_errors(problem, problem.weights)
    innovation = problem.innovation if found is None else found[0]
    for i in masked:
        seen = [
            (watching.sightings[c].spread, innovation[row])
            for row, c in enumerate(known)
            if watching.sightings[c].seen[i] > 0.0
        ]
        if not seen:
            continue
        only, alone = slice(i, i + 1), np.ones(1)
        good = all(
            camera_chi2(shown[only], covariance[only], alone, MODEL_SIGMA_PX)[0] <= improbable(2.0)
            for covariance, shown in seen
        )
        watching.back[i] = watching.back[i] + 1 if good else 0
        if watching.back[i] >= BACK_ROUNDS:
            watching.masked[i] = 0.0
            marker = arrays.marker_ids[int(i)]
            message = f"marker {marker} is where it should be again: it is used again"
            context.emit("health", message=message, name="ok")
