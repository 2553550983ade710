"""Links of the servo process to the vision processes and the gateway, by slots in shared memory and sockets."""

from __future__ import annotations

import select

import msgspec

from stereoservo.core.cycle import Event, ModelUpdate, encode
from stereoservo.daemon.channels.seqpacket import ChannelServer, Outbox, PacketChannel
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_LAYOUT,
    PRIOR_CAPACITY,
    PRIOR_LAYOUT,
    STATE_CAPACITY,
    Ask,
    NewModel,
    Received,
    ServoState,
    ToServo,
    decode_observation,
    encode_prior,
    pack_step_message,
    to_servo_decoder,
)
from stereoservo.daemon.links import GatewayMessages
from stereoservo.daemon.record_ring import RingWriter
from stereoservo.daemon.seqlock import SlotReader, SlotWriter, StopSlot
from stereoservo.messages.decoding import RecordBoundary
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.servo_state import STATE_LAYOUT
from stereoservo.ports.devices import CameraObservation, Prior
from stereoservo.recording.step_messages import StepMessage

RETAINED_EVENTS = 2048
"""Number of newest events that are kept, even if received: they are all sent to a restarted gateway."""
NOTHING_WAITS = GatewayMessages(False, (), None)


class _RecorderPeer:
    """A reader of the ring of step records, as a `StepSink`; messages too large for the ring are not accepted."""

    def __init__(self, ring: RingWriter, reader: int) -> None:
        self._ring = ring
        self.reader = reader

    def send(self, message: StepMessage) -> bool:
        return self._ring.write(pack_step_message(message))


class ProcessLinks:
    """`ServoLinks` of the servo process. Raises SlotError if a slot is missing or has another writer."""

    def __init__(self, directories: CellDirectories, cameras: tuple[str, ...]) -> None:
        self._stop = StopSlot(directories.stop_slot)
        slots = [directories.observation_slot(name) for name in cameras]
        self._observations = [(SlotReader(slot, OBSERVATION_LAYOUT), RecordBoundary(slot.name)) for slot in slots]
        self._gateway_boundary = RecordBoundary("messages of the gateway")
        self._priors = {
            name: SlotWriter(directories.prior_slot(name), PRIOR_CAPACITY, PRIOR_LAYOUT) for name in cameras
        }
        self._state = SlotWriter(directories.state_slot, STATE_CAPACITY, STATE_LAYOUT)
        self._control = ChannelServer(directories.control_socket, single=True)
        self._steps = RingWriter(directories.steps_ring)
        self._gateway: PacketChannel | None = None
        self._greeted = False
        """Whether the gateway has reported which events it has; no events are sent to it before that."""
        self._recorder: _RecorderPeer | None = None
        self._outbox = Outbox(RETAINED_EVENTS)
        self._waiting = select.epoll()
        """Reports in one call whether a peer or a message waits; closed sockets are removed automatically."""
        self._waiting.register(self._control.fileno(), select.EPOLLIN)

    def receive(self) -> GatewayMessages:
        """Requests and model of the gateway; a message that cannot be decoded is skipped. A restarted gateway replaces
        the previous one, whose last messages are received first.
        """
        if not self._waiting.poll(0):
            return NOTHING_WAITS
        messages, connected = [] if self._gateway is None else self._messages_of(self._gateway), False
        for peer in self._control.accept():
            self._gateway, self._greeted = peer, False
            self._waiting.register(peer.fileno(), select.EPOLLIN)
            messages += self._messages_of(peer)
            connected = True
        models = [ModelUpdate(m.model, m.reanchored, m.kept) for m in messages if isinstance(m, NewModel)]
        return GatewayMessages(
            connected or bool(messages),
            tuple(message.request for message in messages if isinstance(message, Ask)),
            models[-1] if models else None,
        )

    def _messages_of(self, gateway: PacketChannel) -> list[ToServo]:
        found: list[ToServo] = []
        for data in gateway.receive():
            with self._gateway_boundary:
                message: ToServo = to_servo_decoder.decode(data)
                found.append(message)
                if isinstance(message, Received):
                    self._outbox.resume(message.number)
                    self._greeted = True
        return found

    def observations(self) -> tuple[CameraObservation, ...]:
        """The newest observation of each camera, unless returned before; records that cannot be decoded are skipped."""
        found = []
        for reader, boundary in self._observations:
            data = reader.poll()
            if data is not None:
                with boundary:
                    found.append(decode_observation(data))
        return tuple(found)

    def stop_raised(self) -> bool:
        """Whether the stop slot was raised since the last call; acknowledges it."""
        return self._stop.poll()

    def step_recorder(self) -> _RecorderPeer | None:
        """The reader of the ring of step records, if there is one."""
        reader = self._steps.reader
        known = 0 if self._recorder is None else self._recorder.reader
        if reader != known:
            self._recorder = _RecorderPeer(self._steps, reader) if reader else None
        return self._recorder

    def publish_prior(self, prior: Prior) -> None:
        """Write a camera's prior slot."""
        self._priors[prior.camera].write(encode_prior(prior))

    def publish_state(self, state: ServoState) -> None:
        """Write the state slot, with notes on skipped records."""
        boundaries = (self._gateway_boundary, *(boundary for _, boundary in self._observations))
        if any(boundary.refused for boundary in boundaries):
            notes = tuple(boundary.note for boundary in boundaries if boundary.refused)
            state = msgspec.structs.replace(state, notes=notes)
        self._state.write(encode(state))

    def publish_events(self, events: tuple[Event, ...]) -> None:
        """Queue events and send the queue, as far as the gateway's socket accepts it."""
        for event in events:
            self._outbox.add(event.seq, encode(event))
        if self._gateway is not None and self._greeted and self._gateway.is_open:
            self._outbox.flush(self._gateway)

    def close(self) -> None:
        """Release all; idempotent."""
        self._waiting.close()
        self._control.close()
        self._steps.close()
        self._state.close()
        for writer in self._priors.values():
            writer.close()
        for reader, _ in self._observations:
            reader.close()
        self._stop.close()
