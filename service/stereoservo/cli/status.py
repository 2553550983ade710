"""Command ``stereoservo status``: prints a cell's current activity, the progress of its goal, and the reasons why it is
slow, held or in fault. On the cell's host it reads the servo process's own state, independent of the gateway.
"""

from __future__ import annotations

import math
import time
from contextlib import closing

import msgspec

from stereoservo.cli.output import CellArgument, CommandError, EndpointOption, JsonOption, code_of, emit
from stereoservo.client import Client, InvalidReplyError, NoReplyError, SessionError
from stereoservo.daemon.heartbeat import GATEWAY_HANG_S, SERVO_HANG_S, HeartbeatReader
from stereoservo.daemon.seqlock import SlotError, SlotReader
from stereoservo.messages.compilation_progress import read_progress
from stereoservo.messages.directories import CellDirectories, cell_directories
from stereoservo.messages.discovery import find_daemon, live_cells
from stereoservo.messages.servo_state import STATE_LAYOUT, decode_state, read_run, state_message
from stereoservo.messages.status import ModelReadiness
from stereoservo.messages.wire import EventMessage, StateMessage

CAUSES = ("held", "stopped", "goal_aborted", "calibration_aborted", "ring_kept")
"""Kinds of events that explain why an arm does not move."""
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
    """A state whose reason ``COMPILING`` has the number of compiled kernels, on the cell's own host."""
    compiling = [one for one in read_progress(directories.runtime) if one.part == "rest"]
    reasons = tuple(
        msgspec.structs.replace(reason, hint=f"{compiling[0].text} are compiled. {reason.hint}")
        if compiling and reason.code == "COMPILING"
        else reason
        for reason in state.reasons
    )
    return msgspec.structs.replace(state, reasons=reasons)


def _causes(client: Client, state: StateMessage) -> list[str]:
    """The last event of each kind that explains why an arm is held, stopped or in fault, oldest first."""
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
    """The failure ``words``, with the last known state: printed, or in the JSON object of the error."""
    if state is None:
        return CommandError(code, words)
    if not as_json:
        age_s = max(0.0, time.time() - state.t_wall)
        emit(None, f"the last that is known, {age_s:.1f} s old:\n{describe(state)}", False)
    return CommandError(code, words, state=state)


def describe(state: StateMessage) -> str:
    """A state as some lines of text."""
    kept = ": kept, not confirmed by the images yet" if state.model == ModelReadiness.UNCONFIRMED else ""
    lines = [
        f"{state.cell}: {state.lifecycle}, model {state.model} (epoch {state.model_epoch}{kept}), {state.source}",
        f"  joints  {_joints(state)}",
        f"  loop    {state.loop.rate_hz:g} Hz, {state.loop.cycles} cycles, {state.loop.overruns} "
        f"overruns, lateness p99 "
        f"{state.loop.lateness_us['p99']:.0f} us, max {state.loop.lateness_us['max']:.0f} us",
        f"  markers {_markers(state)}",
    ]
    if state.halt is not None:
        lines.append(f"  halt    {state.halt.words}, {time.strftime('%H:%M:%S', time.localtime(state.halt.t_wall))}")
    lines += _health(state)
    if state.efforts or state.following_errors:
        lines.append("  loads   " + _loads(state))
    if state.auxiliary:
        lines.append("  beside  " + "  ".join(f"{name} {value:g}" for name, value in state.auxiliary.items()))
    if state.goal:
        progress_text = progress_words(state)
        lines.append(
            f"  goal    {state.goal} ({state.law or 'joints'})" + (f": {progress_text}" if progress_text else "")
        )
    lines += [
        f"  {reason.level:7} {' '.join(filter(None, (reason.code, reason.subject)))}: {reason.hint}"
        for reason in state.reasons
    ]
    if state.refinement is not None:
        lines.append(f"  refine  {state.refinement.text}")
    lines += [f"  note    {text}" for text in state.notes]
    if state.refused_messages:
        lines.append(f"  refused {state.refused_messages} messages that could not be taken since the gateway's start")
    if not state.servo_alive:
        lines.append("  the servo process is silent")
    return "\n".join(lines)


def _joints(state: StateMessage) -> str:
    """Text: positions of the joints and their age, or that they are unknown."""
    if not state.joints:
        return f"unknown: {_silence('sample', state.joints_age_s)}"
    positions = "  ".join(f"{name} {value:+.4f} ({math.degrees(value):+.1f}°)" for name, value in state.joints.items())
    return positions + _age(state.joints_age_s)


def _markers(state: StateMessage) -> str:
    """Text: number of markers that each camera sees and the age of its frame, or that it is unknown."""
    words = []
    for camera in state.camera_age_s or state.visible:  # an older daemon sends no ages
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
    """Progress of the active goal as text; empty if it is unknown."""
    words = []
    if state.progress is not None:
        words.append(f"{100.0 * state.progress:.0f} % of its path")
    if state.seconds_left is not None:
        words.append(f"{state.seconds_left:.1f} s left")
    if state.error_px is not None:
        words.append(f"error {state.error_px:.3f} px")
    return ", ".join(words)


def _health(state: StateMessage) -> list[str]:
    """Text: agreement of each camera with the model, the diagnosis if it is poor, and wrong stamps."""
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
        words.append(f"following {name} {state.following_errors[name]:+.2g} of {state.following_limits[name]:.2g}")
    if not state.effort_limits and not state.following_limits:
        words.append("(no contact is watched for: not learnt yet, or off)")
    return "  ".join(words)


# -- state of this computer ----------------------------------------------------------------------------------
# State of a cell of this host without its gateway: heartbeats, and the servo process's state, from shared memory.


AGAIN_S = 0.2
SERVO_SILENT = (
    "Its drives stop by themselves without its commands, and the supervisor ends a daemon whose servo process is "
    f"silent for {SERVO_HANG_S:g} s; positions and progress are those of before. Where the arm still moves, use the "
    "emergency stop; then see the daemon's log and run the cell again"
)
GATEWAY_SILENT = (
    "Without it the arm is held, and `stereoservo stop` works. The supervisor kills a gateway that hangs for "
    f"{GATEWAY_HANG_S:g} s and starts it again: ask once more"
)


def servo_silence(directories: CellDirectories) -> str:
    """Text on a servo process that gives no sign of life; '' if it does, or if that is unknown."""
    silent = _silent(directories, "servo", SERVO_HANG_S)
    return "" if silent == "" else f"the servo process {silent}: it hangs or was stopped. {SERVO_SILENT}"


def gateway_silence(directories: CellDirectories) -> str:
    """The same for the gateway."""
    silent = _silent(directories, "gateway", GATEWAY_HANG_S)
    return "" if silent == "" else f"the gateway {silent}. {GATEWAY_SILENT}"


def _silent(directories: CellDirectories, process: str, usual_s: float) -> str:
    try:
        reader = HeartbeatReader(directories.heartbeat_slot(process))
    except SlotError:  # of a version without heartbeats
        return ""
    with closing(reader):
        beat = reader.newest()
        if beat is not None and beat.silent_s(usual_s):
            time.sleep(AGAIN_S)  # this process itself may have been suspended
            beat = reader.newest()
    silent_s = 0.0 if beat is None else beat.silent_s(usual_s)
    if not silent_s:
        return ""
    since = time.strftime("%H:%M:%S", time.localtime(time.time() - silent_s))
    return f"has given no sign of life for {silent_s:.1f} s, since {since}"


def newest_state(directories: CellDirectories) -> StateMessage | None:
    """The newest state that the servo process wrote, in the gateway's format; None if it cannot be read.

    The state of a silent servo process is reported as of the time when it was written.
    """
    try:
        run = read_run(directories.runtime)
        reader = SlotReader(directories.state_slot, STATE_LAYOUT)
        record = reader.newest()
        reader.close()
        if record is None:
            return None
        state = decode_state(record)
    except (OSError, ValueError, SlotError, msgspec.MsgspecError):
        return None
    alive = not servo_silence(directories)
    now_ns = time.monotonic_ns() if alive else state.status.t_ns
    return state_message(run, run.boot, state, now_ns=now_ns, servo_alive=alive, last_event=0)


# -- cells of this host ----------------------------------------------------------------------------------------


def ls(json: JsonOption = False) -> None:
    """List the live cells of this user on this host."""
    cells = live_cells()
    text = "\n".join(f"{info.cell:24} process {info.pid:<8} {info.endpoint}  {info.cell_path}" for info in cells)
    emit({"cells": cells}, text or "no live cell", json)
