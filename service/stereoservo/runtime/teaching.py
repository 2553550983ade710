"""Showing the cell a goal: what the cameras see at rest, averaged, becomes an event with samples."""

from __future__ import annotations

import numpy as np

from stereoservo.runtime.averaging import add_observation, averages
from stereoservo.runtime.commands import Request, Teach
from stereoservo.runtime.mobile import moving_cameras, refuse_moving
from stereoservo.runtime.motion import Present, measurement_buffers
from stereoservo.runtime.reanchoring import refuse_while_moved
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.state import Teaching

AT_REST = 1e-3
"""[rad/s or m/s]"""
TEACH_TIMEOUT_S = 20.0


def start_teaching(command: Teach, request: Request, present: Present) -> str:
    """Begin to average. Raises RefusalError without a model, in motion, and while another goal is taught."""
    state = present.state
    if state.model is None:
        raise RefusalError(
            "NO_MODEL", "the cell has no model yet: calibrate first, so that the goal can carry its epoch"
        )
    if state.teaching is not None:
        raise RefusalError(
            "TEACHING", f"goal {state.teaching.name!r} is still being taught", subject=state.teaching.name
        )
    refuse_while_moved(state)
    refuse_moving(moving_cameras(state, present.settings))
    if bool((np.abs(state.command) > AT_REST).any()):
        raise RefusalError(
            "MOVING",
            "the arm moves; a goal is taught at rest",
            value=float(np.abs(state.command).max()),
            threshold=AT_REST,
            unit="rad/s or m/s",
        )
    state.teaching = Teaching(
        command.name, request.request, command.frames, present.now_ns, **measurement_buffers(present.settings)
    )
    return f"teaching {command.name!r} from {command.frames} frames a camera"


def teach_step(present: Present) -> None:
    """One step of what `start_teaching` began; it ends in event ``taught``, or in a warning."""
    state, settings = present.state, present.settings
    teaching = state.teaching
    if teaching is None:
        return
    if bool((np.abs(state.command) > AT_REST).any()):
        _give_up(teaching, present, "the arm moved")
        return
    if state.reanchoring is not None or moving_cameras(state, settings):
        _give_up(teaching, present, "a camera moved")
        return
    for observation in present.observations:
        add_observation(teaching, settings, observation, teaching.frames_wanted, teaching.started_ns)
    if bool((teaching.frames >= teaching.frames_wanted).all()):
        state.teaching = None
        present.emit(
            "taught", request=teaching.request, name=teaching.name, joints=present.q,
            samples=averages(teaching, settings), message=f"goal {teaching.name!r} taught",
        )  # fmt: skip
    elif (present.now_ns - teaching.started_ns) * 1e-9 > TEACH_TIMEOUT_S:
        slow = settings.cameras[int(teaching.frames.argmin())].name
        _give_up(
            teaching, present,
            f"camera {slow} gave {int(teaching.frames.min())} of {teaching.frames_wanted} frames in "
            f"{TEACH_TIMEOUT_S:.0f} s",
        )  # fmt: skip


def _give_up(teaching: Teaching, present: Present, why: str) -> None:
    present.state.teaching = None
    present.emit(
        "warning", request=teaching.request, accepted=False, name=teaching.name,
        message=f"teaching {teaching.name!r} failed: {why}",
    )  # fmt: skip
