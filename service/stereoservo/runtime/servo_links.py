"""The servo process's sockets and slots, its events on their way out, its step records. Nothing here blocks."""

from __future__ import annotations

from collections import deque

from stereoservo.runtime.channel import Channel, ChannelServer
from stereoservo.runtime.core import ServoCore
from stereoservo.runtime.cycle import Event, StepInputs, StepOutputs
from stereoservo.runtime.directories import CellDirectories
from stereoservo.runtime.handover import SlotReader, SlotWriter, StopSlot
from stereoservo.runtime.interprocess import (
    OBSERVATION_LAYOUT,
    PRIOR_CAPACITY,
    PRIOR_LAYOUT,
    STATE_CAPACITY,
    STATE_LAYOUT,
    RecordedCheckpoint,
    RecordedStep,
    RecordingStart,
    encode,
)
from stereoservo.runtime.record import encode_step, fingerprint
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.state import encode_state

CHECKPOINT_EVERY_S = 5.0
RETAINED_EVENTS = 2048


class ServoLinks:
    """Sockets and slots of the servo process. Nothing here blocks."""

    def __init__(self, directories: CellDirectories, cameras: tuple[str, ...]) -> None:
        self._directories = directories
        self.stop = StopSlot(directories.stop_slot)
        self.observations = [
            SlotReader(directories.observation_slot(name), OBSERVATION_LAYOUT) for name in cameras
        ]
        self.priors = {
            name: SlotWriter(directories.prior_slot(name), PRIOR_CAPACITY, PRIOR_LAYOUT) for name in cameras
        }
        self.state = SlotWriter(directories.state_slot, STATE_CAPACITY, STATE_LAYOUT)
        self.control = ChannelServer(directories.control_socket, single=True)
        self.steps = ChannelServer(directories.steps_socket, single=True)

    def close(self) -> None:
        """Release all; idempotent."""
        self.control.close()
        self.steps.close()
        self.state.close()
        for writer in self.priors.values():
            writer.close()
        for reader in self.observations:
            reader.close()
        self.stop.close()


class EventOutbox:
    """Events on their way to the gateway, kept until a later one has pushed them out of a bounded memory."""

    def __init__(self) -> None:
        self._retained: deque[tuple[int, bytes]] = deque(maxlen=RETAINED_EVENTS)
        self._sent = 0

    def add(self, events: tuple[Event, ...]) -> None:
        """Queue events; their numbers ascend."""
        for event in events:
            self._retained.append((event.seq, encode(event)))

    def rewind(self, last_known: int) -> None:
        """The gateway knows events up to ``last_known``; send the later ones (again)."""
        self._sent = last_known

    def flush(self, peer: Channel) -> None:
        """Send what is due, as far as the socket takes it."""
        if not self._retained or self._retained[-1][0] <= self._sent:
            return
        for seq, data in self._retained:
            if seq > self._sent:
                if not peer.send(data):
                    return
                self._sent = seq


class StepStream:
    """Step records and checkpoints to the gateway's recorder; drops and counts where the socket is full."""

    def __init__(self, settings: CoreSettings, rate_hz: float) -> None:
        self._start = encode(RecordingStart(settings, fingerprint()))
        self._every = max(1, round(CHECKPOINT_EVERY_S * rate_hz))
        self._peer: Channel | None = None
        self._since_checkpoint = 0
        self._lost = 0
        self.dropped = 0

    def before(self, server: ChannelServer, core: ServoCore, now_ns: int) -> None:
        """Take a new peer; send a checkpoint when one is due (start, period, after a gap)."""
        for peer in server.accept():
            self._peer = peer if peer.send(self._start) else None
            self._since_checkpoint, self._lost = self._every, 0
        if self._peer is None:
            return
        if not self._peer.is_open:
            self._peer = None
            return
        if self._since_checkpoint >= self._every or self._lost:
            record = RecordedCheckpoint(now_ns, core.state.step, encode_state(core.state), self._lost)
            if self._peer.send(encode(record)):
                self._since_checkpoint, self._lost = 0, 0

    def after(self, inputs: StepInputs, outputs: StepOutputs) -> None:
        """Send the step."""
        if self._peer is None:
            return
        self._since_checkpoint += 1
        if self._lost or not self._peer.send(
            encode(RecordedStep(inputs.now_ns, encode_step(inputs, outputs)))
        ):
            self._lost += 1
            self.dropped += 1
