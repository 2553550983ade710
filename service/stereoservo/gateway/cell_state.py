"""The state of the cell as the gateway publishes it: the servo process's own, with what that cannot know, which is
whether it lives itself, why a camera is silent, and who stopped the arm.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import msgspec

from stereoservo.core.cycle import Event
from stereoservo.daemon.heartbeat import VISION_HANG_S, HeartbeatReader
from stereoservo.daemon.ipc_messages import RunPlan, ServoState
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.reasons import Level, Reason
from stereoservo.messages.servo_state import silence_limit_s, state_message
from stereoservo.messages.status import Halt
from stereoservo.messages.wire import StateMessage
from stereoservo.ports.devices import CameraDescription

SERVO_STALE_S = 0.5
CAMERA_SILENT = "CAMERA_SILENT"


class CellState:
    """The newest state of a cell, and the message of it. Raises SlotError."""

    def __init__(self, plan: RunPlan, boot: str, servo: ServoConnection) -> None:
        self._plan = plan
        self._boot = boot
        self._servo = servo
        self._heard_s = 0.0
        self._cameras = CameraWatch(plan.directories, plan.cameras)
        self._halt = _Halts()
        self.newest: ServoState | None = None

    def read(self) -> ServoState | None:
        """The servo process's state, None unless it is new."""
        state = self._servo.state()
        if state is not None:
            self._heard_s = time.monotonic()
            self.newest = state
        return state

    def take_event(self, event: Event, operator: str, *, repeated: bool) -> None:
        """Note who halts the arm. ``operator``: of a stop, where known; ``repeated``: told to an earlier gateway."""
        self._halt.take(event, operator, repeated=repeated)

    def message(self, **told: Any) -> StateMessage | None:
        """The state in the clients' format at this moment, with what is ``told`` to `state_message` beside it; None
        before the first.
        """
        if self.newest is None:
            return None
        heard = time.monotonic() - self._heard_s <= SERVO_STALE_S
        alive = heard or self._servo.announced_silence()
        state = state_message(
            self._plan, self._boot, self.newest, now_ns=time.monotonic_ns(), servo_alive=alive, **told
        )
        silent = self._cameras.reasons(state) if heard else ()  # a silent servo process takes no frames
        halted = any(reason.code in ("STOPPED", "HELD") for reason in state.reasons)
        return msgspec.structs.replace(
            state,
            reasons=(*state.reasons, *silent),
            level="slow" if state.level == "ok" and any(r.level == "slow" for r in silent) else state.level,
            halt=self._halt.now if halted else None,
        )

    def close(self) -> None:
        """Release the slots. Idempotent."""
        self._cameras.close()


class _Halts:
    """Who has stopped or held the arm, by the core's events."""

    def __init__(self) -> None:
        self.now: Halt | None = None
        self._stopped = False

    def take(self, event: Event, operator: str, *, repeated: bool) -> None:
        if event.kind == "resumed" or (event.kind == "lifecycle" and event.name == "active"):
            self.now, self._stopped = None, False
        elif event.kind == "stopped":
            self._stopped = True
            self._set(event, _stop_words(event, operator, repeated))
        elif event.kind == "held" and not self._stopped:
            self._set(event, event.message)

    def _set(self, event: Event, words: str) -> None:
        self.now = Halt(words, time.time() - (time.monotonic_ns() - event.t_ns) * 1e-9)


def _stop_words(event: Event, operator: str, repeated: bool) -> str:
    codes = [reason.code for reason in event.reasons if reason.code != "STOPPED"]
    if codes:
        return f"stopped for {', '.join(codes)}"
    if operator:
        return f"stopped by {operator}"
    return "stopped" if repeated else "stopped on the cell's host"


class CameraWatch:
    """Finds the cameras that deliver no frames, and why, by the heartbeats of their processes. Raises SlotError."""

    def __init__(self, directories: CellDirectories, cameras: Sequence[CameraDescription]) -> None:
        self._cameras = {
            camera.name: (
                HeartbeatReader(directories.heartbeat_slot(f"vision-{camera.name}")),
                silence_limit_s(camera.rate_hz),
            )
            for camera in cameras
        }

    def reasons(self, state: StateMessage) -> tuple[Reason, ...]:
        """A reason for each camera that is silent, or whose process has ended."""
        found = []
        for name, (heartbeat, limit_s) in self._cameras.items():
            age_s = state.camera_age_s.get(name)
            lives = heartbeat.process_lives()
            if not lives or age_s is None or age_s > limit_s:
                level, hint = _why_silent(heartbeat, lives, age_s)
                found.append(Reason(CAMERA_SILENT, level, name, age_s, limit_s, "s", hint))
        return tuple(found)

    def close(self) -> None:
        """Release the slots. Idempotent."""
        for heartbeat, _ in self._cameras.values():
            heartbeat.close()


def _why_silent(heartbeat: HeartbeatReader, lives: bool, age_s: float | None) -> tuple[Level, str]:
    """Level and hint of the reason of a camera whose newest frame has this age [s]; None: there was none."""
    beat = heartbeat.newest()
    if not lives:
        if beat is None:
            return "info", "its process is being started"
        return (
            "slow",
            "its process has ended; the supervisor starts it again, and the daemon's log says how it ended",
        )
    silent_s = 0.0 if beat is None else beat.silent_s(VISION_HANG_S)
    if silent_s:
        return "slow", (
            f"its process hangs: no sign of life for {silent_s:.1f} s. After {VISION_HANG_S:g} s the supervisor kills "
            "it and starts it again"
        )
    if age_s is None:
        return "info", "it is being opened and has delivered no frame yet"
    return "slow", (
        f"its newest usable frame is {age_s:.1f} s old, though its process lives: look at the camera's cable and "
        "power; the daemon opens it again by itself"
    )
