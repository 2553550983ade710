"""Command ``stereoservo status``: prints what a cell does now, the progress of its goal, and the reasons why it is
slow, held or in fault. On the cell's host it believes the servo process itself, whatever becomes of the gateway.
"""

from __future__ import annotations

import math
import time

import msgspec

from stereoservo.cli.local_state import (
    GATEWAY_SILENT,
    SERVO_SILENT,
    gateway_silence,
    newest_state,
    servo_silence,
)
from stereoservo.cli.output import CellArgument, CommandError, EndpointOption, JsonOption, code_of, emit
from stereoservo.client import Client, InvalidReplyError, NoReplyError, SessionError
from stereoservo.messages.compilation_progress import read_progress
from stereoservo.messages.directories import CellDirectories, cell_directories
from stereoservo.messages.discovery import find_daemon
from stereoservo.messages.wire import EventMessage, StateMessage

CAUSES = ("held", "stopped", "goal_aborted", "calibration_aborted", "ring_kept")
"""Kinds of the events that tell why an arm stands."""
RECENT_EVENTS = 100


def status(cell: CellArgument, endpoint: EndpointOption = None, json: JsonOption = False) -> None:
    """What the cell does now, and why it does not do more. Fails where its servo process or its daemon is silent."""
    directories = cell_directories(find_daemon(cell).cell) if endpoint is None else None
    if directories is not None and (silence := servo_silence(directories)):
        raise _failure("servo_silent", silence, newest_state(directories), json)
    if directories is not None and (silence := gateway_silence(directories)):
        raise _failure("no_reply", silence, newest_state(directories), json)
    try:
        with Client(cell, endpoint=endpoint) as client:
            state = client.status()
            causes = _causes(client, state)
    except (InvalidReplyError, NoReplyError, SessionError) as error:
        if directories is None:
            raise
        silence = servo_silence(directories) or f"the gateway does not answer ({error}). {GATEWAY_SILENT}"
        raise _failure(code_of(error), silence, newest_state(directories), json) from error
    if not state.servo_alive:
        raise _failure("servo_silent", f"the servo process is silent. {SERVO_SILENT}", state, json)
    if directories is not None:
        state = with_progress(state, directories)
    emit(state, "\n".join([describe(state), *causes]), json)


def with_progress(state: StateMessage, directories: CellDirectories) -> StateMessage:
    """A state whose reason ``COMPILING`` says how many kernels are compiled, on the cell's own host."""
    compiling = [one for one in read_progress(directories.runtime) if one.part == "rest"]
    reasons = tuple(
        msgspec.structs.replace(reason, hint=f"{compiling[0].words} are compiled. {reason.hint}")
        if compiling and reason.code == "COMPILING"
        else reason
        for reason in state.reasons
    )
    return msgspec.structs.replace(state, reasons=reasons)


def _causes(client: Client, state: StateMessage) -> list[str]:
    """The last event of each kind that tells why an arm that is held, stopped or in fault stands, oldest first."""
    if not any(reason.level in ("hold", "fault") for reason in state.reasons):
        return []
    recent: dict[str, EventMessage] = {}
    page = client.events(max(1, state.last_event - RECENT_EVENTS))
    for event in page.events:
        if event.kind == "resumed" or (event.kind, event.name) == ("lifecycle", "active"):
            recent.clear()
        elif event.kind in CAUSES:
            recent[event.kind] = event
    return [
        f"  event   {time.strftime('%H:%M:%S', time.localtime(event.t_wall))} {event.kind}: {event.message}"
        for event in sorted(recent.values(), key=lambda event: event.seq)
    ]


def _failure(code: str, words: str, state: StateMessage | None, as_json: bool) -> CommandError:
    """The failure ``words``, with the last state that is known: printed, or in the JSON object of the error."""
    if state is None:
        return CommandError(code, words)
    if not as_json:
        age_s = max(0.0, time.time() - state.t_wall)
        emit(None, f"the last that is known, {age_s:.1f} s old:\n{describe(state)}", False)
    return CommandError(code, words, state=state)


def describe(state: StateMessage) -> str:
    """A state as some lines of text."""
    lines = [
        f"{state.cell}: {state.lifecycle}, model {state.model} (epoch {state.model_epoch}), {state.source}",
        f"  joints  {_joints(state)}",
        f"  loop    {state.loop.rate_hz:g} Hz, {state.loop.cycles} cycles, {state.loop.overruns} "
        f"overruns, lateness p99 "
        f"{state.loop.lateness_us['p99']:.0f} us, max {state.loop.lateness_us['max']:.0f} us",
        f"  markers {_markers(state)}",
    ]
    if state.halt is not None:
        lines.append(
            f"  halt    {state.halt.words}, {time.strftime('%H:%M:%S', time.localtime(state.halt.t_wall))}"
        )
    lines += _health(state)
    if state.efforts or state.following_errors:
        lines.append("  loads   " + _loads(state))
    if state.auxiliary:
        lines.append("  beside  " + "  ".join(f"{name} {value:g}" for name, value in state.auxiliary.items()))
    if state.goal:
        progress_text = progress_words(state)
        lines.append(
            f"  goal    {state.goal} ({state.law or 'joints'})"
            + (f": {progress_text}" if progress_text else "")
        )
    lines += [
        f"  {reason.level:7} {' '.join(filter(None, (reason.code, reason.subject)))}: {reason.hint}"
        for reason in state.reasons
    ]
    if state.refinement is not None:
        lines.append(f"  refine  {state.refinement.text}")
    lines += [f"  note    {text}" for text in state.notes]
    if state.refused_messages:
        lines.append(
            f"  refused {state.refused_messages} messages that could not be taken since the gateway's start"
        )
    if not state.servo_alive:
        lines.append("  the servo process is silent")
    return "\n".join(lines)


def _joints(state: StateMessage) -> str:
    """Text: positions of the joints and their age, or that they are unknown."""
    if not state.joints:
        return f"unknown: {_silence('sample', state.joints_age_s)}"
    positions = "  ".join(
        f"{name} {value:+.4f} ({math.degrees(value):+.1f}°)" for name, value in state.joints.items()
    )
    return positions + _age(state.joints_age_s)


def _markers(state: StateMessage) -> str:
    """Text: number of markers that each camera sees and the age of its frame, or that it is unknown."""
    words = []
    for camera in state.camera_age_s or state.visible:  # a daemon of before tells no ages
        age_s = state.camera_age_s.get(camera)
        if camera in state.visible:
            words.append(f"{camera} {state.visible[camera]}{_age(age_s)}")
        else:
            words.append(f"{camera} unknown ({_silence('frame', age_s)})")
    return "  ".join(words)


def _age(age_s: float | None) -> str:
    return "" if age_s is None else f" ({1e3 * age_s:.0f} ms old)"


def _silence(what: str, age_s: float | None) -> str:
    return f"no {what} yet" if age_s is None else f"no {what} for {age_s:.1f} s"


def progress_words(state: StateMessage) -> str:
    """Progress of the active goal as text; empty where it is unknown."""
    words = []
    if state.progress is not None:
        words.append(f"{100.0 * state.progress:.0f} % of its path")
    if state.seconds_left is not None:
        words.append(f"{state.seconds_left:.1f} s left")
    if state.error_px is not None:
        words.append(f"error {state.error_px:.3f} px")
    return ", ".join(words)


def _health(state: StateMessage) -> list[str]:
    """Text: agreement of each camera with the model, the diagnosis where it is poor, and wrong stamps."""
    health = state.health
    if health.verdict == "unknown" and not health.text:
        return []
    agreement = "  ".join(
        f"{name} {camera.rms_px:.2f} px" + (f" ({camera.place})" if camera.place else "")
        for name, camera in health.cameras.items()
    )
    lines = [f"  model   {health.verdict.replace('_', ' ')}" + (f": {agreement}" if agreement else "")]
    lines += [f"          {health.text}"] if health.text else []
    lines += [f"          camera {name}: {c.timing}" for name, c in health.cameras.items() if c.timing]
    return lines


def _loads(state: StateMessage) -> str:
    """Text: efforts, the following error nearest to its limit, and whether a contact would stop the arm."""
    words = [f"{name} {value:+.3g}" for name, value in state.efforts.items()]
    used = {
        name: abs(error) / state.following_limits[name]
        for name, error in state.following_errors.items()
        if name in state.following_limits
    }
    if used:
        name = max(used, key=used.__getitem__)
        words.append(
            f"following {name} {state.following_errors[name]:+.2g} of {state.following_limits[name]:.2g}"
        )
    if not state.effort_limits and not state.following_limits:
        words.append("(no contact is watched for: not learnt yet, or off)")
    return "  ".join(words)
