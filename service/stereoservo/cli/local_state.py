"""State of a cell of this host without its gateway: heartbeats, and the servo process's state, from shared memory."""

from __future__ import annotations

import time
from contextlib import closing

import msgspec

from stereoservo.daemon.heartbeat import GATEWAY_HANG_S, SERVO_HANG_S, HeartbeatReader
from stereoservo.daemon.seqlock import SlotError, SlotReader
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.servo_state import STATE_LAYOUT, decode_state, read_run, state_message
from stereoservo.messages.wire import StateMessage

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
    """Words on a servo process that gives no sign of life; '' where it does, or where nothing is known."""
    silent = _silent(directories, "servo", SERVO_HANG_S)
    return "" if silent == "" else f"the servo process {silent}: it hangs or was stopped. {SERVO_SILENT}"


def gateway_silence(directories: CellDirectories) -> str:
    """Likewise of the gateway."""
    silent = _silent(directories, "gateway", GATEWAY_HANG_S)
    return "" if silent == "" else f"the gateway {silent}. {GATEWAY_SILENT}"


def _silent(directories: CellDirectories, process: str, usual_s: float) -> str:
    try:
        reader = HeartbeatReader(directories.heartbeat_slot(process))
    except SlotError:  # of a version without one
        return ""
    with closing(reader):
        beat = reader.newest()
        if beat is not None and beat.silent_s(usual_s):
            time.sleep(AGAIN_S)  # this process itself may have stood
            beat = reader.newest()
    silent_s = 0.0 if beat is None else beat.silent_s(usual_s)
    if not silent_s:
        return ""
    since = time.strftime("%H:%M:%S", time.localtime(time.time() - silent_s))
    return f"has given no sign of life for {silent_s:.1f} s, since {since}"


def newest_state(directories: CellDirectories) -> StateMessage | None:
    """The newest state that the servo process wrote, as the gateway would tell it; None where it cannot be read.

    Of a silent servo process: as it was when it wrote it.
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
