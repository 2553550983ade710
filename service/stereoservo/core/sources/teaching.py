"""Teaching of a goal: averages the markers' pixels in all cameras while the arm rests, and emits them as an event for
the gateway, which stores the goal.
"""

from __future__ import annotations

import numpy as np

from stereoservo.core.context import RefusalError, StepContext, no_model
from stereoservo.core.monitors.camera_relocalization import refuse_while_moved
from stereoservo.core.monitors.moving_camera import moving_cameras, refuse_moving
from stereoservo.core.rest_averages import add_observation, averages, measurement_buffers
from stereoservo.core.state import TeachingState
from stereoservo.messages.goals import Request, Teach

AT_REST = 1e-3
"""Joint command below which the arm counts as at rest [rad/s or m/s]."""
TEACH_TIMEOUT_S = 20.0


def start_teaching(command: Teach, request: Request, context: StepContext) -> str:
    """Start averaging. Raises RefusalError without a model, in motion, and while another goal is taught."""
    state = context.state
    if state.model is None:
        raise no_model(context, "the cell has no model yet: calibrate first, so that the goal can carry its epoch")
    if state.teaching is not None:
        raise RefusalError(
            "TEACHING", f"goal {state.teaching.name!r} is still being taught", subject=state.teaching.name
        )
    refuse_while_moved(state)
    refuse_moving(moving_cameras(state, context.settings))
    if bool((np.abs(state.block.command) > AT_REST).any()):
        raise RefusalError(
            "MOVING",
            "the arm moves; a goal is taught at rest",
            value=float(np.abs(state.block.command).max()),
            threshold=AT_REST,
            unit="rad/s or m/s",
        )
    state.teaching = TeachingState(
        command.name, request.request, command.frames, context.now_ns, **measurement_buffers(context.settings)
    )
    return f"teaching {command.name!r} from {command.frames} frames a camera"


def teach_step(context: StepContext) -> None:
    """One step of the averaging started by `start_teaching`; it ends with the event ``taught``, or with a warning."""
    state, settings = context.state, context.settings
    teaching = state.teaching
    if teaching is None:
        return
    if bool((np.abs(state.block.command) > AT_REST).any()):
        _give_up(teaching, context, "the arm moved")
        return
    if state.reanchoring is not None or moving_cameras(state, settings):
        _give_up(teaching, context, "a camera moved")
        return
    for camera, observation in context.ingested.observations:
        after_ns = teaching.started_ns - state.cameras[camera].offset_ns
        add_observation(teaching, settings, observation, teaching.frames_wanted, after_ns)
    if bool((teaching.frames >= teaching.frames_wanted).all()):
        state.teaching = None
        context.emit(
            "taught",
            request=teaching.request,
            name=teaching.name,
            joints=context.q,
            samples=averages(teaching, settings),
            message=f"goal {teaching.name!r} taught",
        )
    elif (context.now_ns - teaching.started_ns) * 1e-9 > TEACH_TIMEOUT_S:
        slow = settings.cameras[int(teaching.frames.argmin())].name
        _give_up(
            teaching,
            context,
            f"camera {slow} gave {int(teaching.frames.min())} of {teaching.frames_wanted} frames in "
            f"{TEACH_TIMEOUT_S:.0f} s",
        )


def _give_up(teaching: TeachingState, context: StepContext, why: str) -> None:
    context.state.teaching = None
    context.emit(
        "warning",
        request=teaching.request,
        accepted=False,
        name=teaching.name,
        message=f"teaching {teaching.name!r} failed: {why}",
    )
