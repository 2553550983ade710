"""Connection of the gateway to the servo process: sends requests and heartbeats, receives events, state and step
records.
"""

from __future__ import annotations

import time
from contextlib import suppress
from functools import partial

import msgspec

from stereoservo.core.cycle import Event, encode
from stereoservo.daemon.channels.seqpacket import ChannelError, PacketChannel
from stereoservo.daemon.heartbeat import SERVO_HANG_S, HeartbeatReader
from stereoservo.daemon.ipc_messages import (
    Ask,
    Heartbeat,
    NewModel,
    Received,
    ServoState,
    event_decoder,
    state_decoder,
    unpack_step_message,
)
from stereoservo.daemon.process_control import write_log
from stereoservo.daemon.record_ring import RingReader
from stereoservo.daemon.seqlock import SlotError, SlotReader
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.decoding import RecordBoundary
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.goals import Command, Request
from stereoservo.messages.servo_state import STATE_LAYOUT
from stereoservo.recording.step_messages import StepMessage

HEARTBEAT_EVERY_S = 0.05
RECONNECT_EVERY_S = 0.1
MOST_COVARIANCE_BYTES = 256 * 1024
"""Largest covariance that the loop takes, of 181 parameters: a checkpoint of the state takes about 1 µs a kB for it."""


class ServoConnection:
    """Connection to the servo process; reconnects by itself, never blocks. ``records``: also receive step records."""

    def __init__(self, directories: CellDirectories) -> None:
        self._directories = directories
        self.records = False
        self._control: PacketChannel | None = None
        self._steps: RingReader | None = None
        self._state = SlotReader(directories.state_slot, STATE_LAYOUT)
        self._boundary = RecordBoundary("messages of the servo process", partial(write_log, "gateway"))
        self._heartbeat = HeartbeatReader(directories.heartbeat_slot("servo"))
        self._last_beat = 0.0
        self._last_try = 0.0
        self._last_event = 0
        # A restarted gateway receives old replies again: its numbers must differ from those of its predecessor.
        self._next_request = time.monotonic_ns() // 1000

    @property
    def note(self) -> str:
        """Text on messages that could not be read; empty if there were none."""
        return self._boundary.note

    @property
    def connected(self) -> bool:
        """Whether the servo process accepts requests."""
        return self._control is not None and self._control.is_open

    def poll_connection(self) -> None:
        """Connect if needed, and send a heartbeat when one is due."""
        now = time.monotonic()
        if now - self._last_try >= RECONNECT_EVERY_S:
            self._last_try = now
            if not self.connected:
                self._control = _try(self._directories, "control_socket")
                if self._control is not None:
                    self._control.send(encode(Received(self._last_event)))
            if self._steps is None:
                with suppress(SlotError):  # not available yet; tried again
                    self._steps = RingReader(self._directories.steps_ring)
        if self._steps is not None and self._steps.reading != self.records:
            (self._steps.attach if self.records else self._steps.detach)()
        if self._control is not None and now - self._last_beat >= HEARTBEAT_EVERY_S:
            self._last_beat = now
            self._control.send(encode(Heartbeat()))

    def restart_steps(self) -> None:
        """Restart the stream of step records with a checkpoint, for a recording that starts now."""
        if self._steps is not None:
            self._steps.attach()

    def send_command(self, command: Command, operator: str) -> int | None:
        """Send a command; returns its request number, None if the servo process is not connected."""
        number = self._next_request
        self._next_request += 1
        if self._control is None or not self._control.send(encode(Ask(Request(number, operator, command)))):
            return None
        return number

    def send_model(self, model: CellModel, reanchored: tuple[str, ...] = (), *, kept: bool = False) -> bool:
        """Send a model to the core, with the coplanar groups of its markers, which the loop has no time to compute.
        ``reanchored``, ``kept``: see `cycle.ModelUpdate`.

        A covariance beyond `MOST_COVARIANCE_BYTES` is omitted.
        """
        if model.marker_groups is None:  # of an older version; the fit stores them, and the gateway needs no kernel
            from stereoservo.control.marker_groups import with_groups

            model = with_groups(model)
        size = 0 if model.covariance is None else model.covariance.covariance.nbytes
        if size > MOST_COVARIANCE_BYTES:
            write_log(
                "gateway",
                f"the covariance of model {model.epoch} has {size // 1024} kB, the loop takes "
                f"{MOST_COVARIANCE_BYTES // 1024}: that the cameras agree is not tested where goals end",
            )
            model = msgspec.structs.replace(model, covariance=None)
        return self._control is not None and self._control.send(encode(NewModel(model, reanchored, kept)))

    def events(self) -> list[Event]:
        """Core events since the last call, in order."""
        if self._control is None:
            return []
        found: list[Event] = []
        for data in self._control.receive(256):
            with self._boundary:
                found.append(event_decoder.decode(data))
        if found:
            self._last_event = max(self._last_event, found[-1].seq)
        return found

    def steps(self, limit: int = 512) -> list[StepMessage]:
        """Step records since the last call, at most ``limit``."""
        if self._steps is None:
            return []
        found: list[StepMessage] = []
        records: list[bytes] = []
        with self._boundary:
            records = self._steps.read(limit)
        for data in records:
            with self._boundary:
                found.append(unpack_step_message(data))
        return found

    def state(self) -> ServoState | None:
        """The servo process's newest state, None unless it is new."""
        data = self._state.poll()
        if data is not None:
            with self._boundary:
                return state_decoder.decode(data)
        return None

    def announced_silence(self) -> bool:
        """Whether the servo process has announced that it writes no state while it configures drives."""
        beat = self._heartbeat.newest()
        return beat is not None and beat.limit_s > SERVO_HANG_S and not beat.silent_s(SERVO_HANG_S)

    def close(self) -> None:
        """Release all; idempotent."""
        self._heartbeat.close()
        if self._control is not None:
            self._control.close()
        if self._steps is not None:
            self._steps.close()
        self._state.close()


def _try(directories: CellDirectories, name: str) -> PacketChannel | None:
    try:
        return PacketChannel.connect(getattr(directories, name))
    except ChannelError:  # not available (yet); tried again
        return None
