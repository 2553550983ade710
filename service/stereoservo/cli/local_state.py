"""State of a cell of this host without its gateway: heartbeat and state of the servo process, from shared memory."""

from __future__ import annotations

import time

import msgspec

from stereoservo.daemon.heartbeat import SERVO_HANG_S, Beat, HeartbeatReader
from stereoservo.daemon.seqlock import SlotError, SlotReader
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import daemon_info
from stereoservo.messages.wire import StateMessage

SILENT_S = 0.5
"""A servo process beats each 20 ms; what is shorter may be a stall of the machine."""
AGAIN_S = 0.2
WHAT_TO_DO = (
    "Its drives stop by themselves without its commands, and the supervisor ends a daemon whose servo process is "
    f"silent for {SERVO_HANG_S:g} s; positions and progress are those of before. Where the arm still moves, use the "
    "emergency stop; then see the daemon's log and run the cell again"
)


def servo_silence(directories: CellDirectories) -> str:
    """Words on a servo process that gives no sign of life although its daemon is up; else ''."""
    info = daemon_info(directories)
    if info is None:
        return ""
    try:
        reader = HeartbeatReader(directories.heartbeat_slot("servo"))
    except SlotError:  # of a version without one
        return ""
    beat = reader.newest()
    if beat is not None and _age_s(beat) > _allowed_s(beat):
        time.sleep(AGAIN_S)  # this process itself may have stood
        beat = reader.newest()
    reader.close()
    if beat is None or _age_s(beat) <= _allowed_s(beat):
        return ""
    since = time.strftime("%H:%M:%S", time.localtime(time.time() - _age_s(beat)))
    return (
        f"the servo process of cell {info.cell!r} has given no sign of life for {_age_s(beat):.1f} s, since {since}: "
        f"it hangs or was stopped. {WHAT_TO_DO}"
    )


def _age_s(beat: Beat) -> float:
    return (time.monotonic_ns() - beat.t_ns) * 1e-9


def _allowed_s(beat: Beat) -> float:
    """How long a beat lasts: where drives are configured the servo process has said so, and how long that may take."""
    return SILENT_S if beat.limit_s <= SERVO_HANG_S else beat.limit_s


def newest_state(directories: CellDirectories) -> StateMessage | None:
    """The newest state that the servo process wrote, as the gateway would tell it; None where it cannot be read."""
    # All the numerical libraries, for a cell that is in trouble only.
    from stereoservo.daemon.ipc_messages import STATE_LAYOUT, PlanError, load_plan, state_decoder
    from stereoservo.gateway.publisher import state_message

    try:
        plan = load_plan(directories.runtime)
        reader = SlotReader(directories.state_slot, STATE_LAYOUT)
        record = reader.newest()
        reader.close()
        if record is None:
            return None
        state = state_decoder.decode(record)
    except (PlanError, SlotError, msgspec.MsgspecError):
        return None
    alive = not servo_silence(directories)
    return state_message(plan, plan.boot, state, servo_alive=alive, last_event=0)
