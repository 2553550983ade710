"""Real-time server of emulated drives: bus time is CLOCK_MONOTONIC, the master is connected by an endpoint."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import socket
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, Self

import msgspec

from stereoservo.messages.addresses import Address
from stereoservo_drivers.can.frames import CanFrame, from_message, to_message
from stereoservo_drivers.can.slcan_adapter import SlcanAdapter
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator, BusEvent
from stereoservo_sim.emulators.fault_engine import FaultCommandError

SPIN_NS = 100_000
"""Before an event the loop polls for this time instead of sleeping, since a sleep ends some 60 µs late; with bit times
only.
"""
ASKING_NS = 200_000
"""Polling period of an endpoint without a descriptor."""
STALL_NS = 2_000_000
"""Lateness of the loop that counts as a stall."""
LATE_FRAME_NS = 500_000
ENDING_NS = 500_000_000
"""Time limit after power off until the arm must be at rest."""


class Stalls(msgspec.Struct):
    """Lateness of the serving loop: the largest lateness and gap, number of stalls (over STALL_NS), and number of
    frames that left more than LATE_FRAME_NS after their end on the bus.
    """

    turns: int = 0
    frames: int = 0
    late_frames: int = 0
    stalls: int = 0
    latest_ns: int = 0
    longest_gap_ns: int = 0

    def words(self) -> str:
        """The statistics as text."""
        return (
            f"server loop: {self.turns} turns, latest {self.latest_ns * 1e-6:.2f} ms, longest gap "
            f"{self.longest_gap_ns * 1e-6:.2f} ms, {self.stalls} stalls over {STALL_NS * 1e-6:g} ms; "
            f"{self.late_frames} of {self.frames} frames left {LATE_FRAME_NS * 1e-6:g} ms late or later"
        )


class _Request:
    """A fault command of another thread, and its reply."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.done = threading.Event()
        self.answer = ""
        self.error: Exception | None = None


class BusServer:
    """Serves the emulated bus ``emulator`` at ``endpoint`` until terminated.

    ``on_event`` is called with every event of the emulated bus, in the serving thread. ``run`` serves in the calling
    thread. As a context manager the server runs in its own thread, and an exception there is raised at the end.
    """

    def __init__(
        self, emulator: BusEmulator, endpoint: Endpoint, *, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.emulator = emulator
        self.endpoint = endpoint
        self.stalls = Stalls()
        self.on_event: Callable[[BusEvent], None] | None = None
        self._clock_ns = clock_ns
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        self._requests: deque[_Request] = deque()
        self._lock = threading.Lock()
        self._over = False
        self._watched: dict[int, Callable[[], None]] = {}
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None
        self._turned_ns = clock_ns()
        emulator.on_adapter = endpoint.plug

    @property
    def start_ns(self) -> int:
        """Time at which the drives were switched on."""
        return self.emulator.start_ns

    @property
    def channel(self) -> str:
        """Channel at which a master connects to the drives."""
        return self.endpoint.channel

    def watch(self, descriptor: int, act: Callable[[], None]) -> None:
        """Call ``act`` in the serving loop whenever ``descriptor`` is readable."""
        self._watched[descriptor] = act

    def unwatch(self, descriptor: int) -> None:
        """Stop watching a descriptor."""
        self._watched.pop(descriptor, None)

    def obey(self, text: str) -> str:
        """Execute a fault command, from the serving thread itself. Raises FaultCommandError."""
        answer = self.emulator.order(text, self._clock_ns())
        return f"{answer}\n{self.stalls.words()}" if text.split()[:1] == ["status"] else answer

    def order(self, text: str, timeout_s: float = 10.0) -> str:
        """Execute a fault command, from any other thread. Raises FaultCommandError."""
        request = _Request(text)
        with self._lock:
            if self._over:
                raise FaultCommandError(f"{text!r}: the server has ended")
            self._requests.append(request)
            os.write(self._wake_write, b"\0")
        if not request.done.wait(timeout_s):
            raise FaultCommandError(f"{text!r}: no answer within {timeout_s:g} s; the server does not run")
        if request.error is not None:
            raise request.error
        return request.answer

    def run(self, ended: Callable[[], bool]) -> None:
        """Serve until ``ended``; then power off, and let the arm come to rest. Closes endpoint and emulator."""
        try:
            self._turned_ns = self._clock_ns()
            self.emulator.run_until(self._turned_ns)
            while not ended():
                self.turn()
            now = self._clock_ns()
            self.endpoint.close()
            self.emulator.power_off(now)
            while not self.emulator.at_rest() and self._clock_ns() < now + ENDING_NS:
                self._sleep([], self.emulator.due_ns())
                self.emulator.run_until(self._clock_ns())
            self._pass_events()
        finally:
            self.endpoint.close()
            self.emulator.close()
            self._end_requests()

    def _end_requests(self) -> None:
        with self._lock:
            self._over = True
            os.close(self._wake_read)
            os.close(self._wake_write)
            while self._requests:
                request = self._requests.popleft()
                request.error = FaultCommandError(f"{request.text!r}: the server has ended")
                request.done.set()

    def turn(self) -> None:
        """Wait for the next event or input, and advance the bus to the current time."""
        descriptors = self.endpoint.descriptors()
        wanted = self.emulator.due_ns()
        if not descriptors:
            wanted = min(wanted, self._clock_ns() + ASKING_NS)
        ready = self._sleep([*descriptors, self._wake_read, *self._watched], wanted)
        now = self._clock_ns()
        self._count(now, wanted)
        come = not descriptors or not set(ready).isdisjoint(descriptors)
        frames = self.endpoint.take() if come else []
        for t_ns, frame in self._stamped(frames, wanted, now):
            self.emulator.inject(frame, t_ns)
        self._catch_up(now)
        if self._wake_read in ready:
            self._answer()
        for descriptor in [one for one in self._watched if one in ready]:
            self._watched[descriptor]()
        self._pass_events()
        self._turned_ns = now

    def _sleep(self, descriptors: list[int], until_ns: int) -> list[int]:
        """Wait for input or until ``until_ns``; returns the readable descriptors. With bit times the last part is
        polled.
        """
        spin = SPIN_NS if self.emulator.wire.bitrate is not None else 0
        left_ns = until_ns - self._clock_ns() - spin
        return select.select(descriptors, [], [], max(left_ns, 0) * 1e-9)[0]

    def _stamped(self, frames: list[CanFrame], wanted: int, now: int) -> list[tuple[int, CanFrame]]:
        """Send times of the master's frames: now; frames that arrived during a stall are spread evenly over it.

        Otherwise the drives' time-outs would expire before frames that were in time are processed.
        """
        if now - wanted < STALL_NS:
            return [(now, frame) for frame in frames]
        step = (now - wanted) // (len(frames) + 1)
        return [(wanted + (k + 1) * step, frame) for k, frame in enumerate(frames)]

    def _count(self, now: int, wanted: int) -> None:
        stalls = self.stalls
        stalls.turns += 1
        stalls.latest_ns = max(stalls.latest_ns, now - wanted)
        stalls.longest_gap_ns = max(stalls.longest_gap_ns, now - self._turned_ns)
        stalls.stalls += now - wanted > STALL_NS

    def _catch_up(self, now: int) -> None:
        """Advance to ``now``. Frames that have ended on the bus are delivered before the arm's next step is
        computed.
        """
        while (due := self.emulator.due_ns()) <= now:
            self.emulator.run_until(due)
            self._give()
        self.emulator.run_until(now)
        self._give()

    def _give(self) -> None:
        delivered = self.emulator.delivered()
        if delivered:
            self.endpoint.give(delivered)
            late_ns = self._clock_ns() - delivered[0][0]
            self.stalls.frames += len(delivered)
            self.stalls.late_frames += len(delivered) * (late_ns > LATE_FRAME_NS)

    def _answer(self) -> None:
        os.read(self._wake_read, 4096)
        while self._requests:
            request = self._requests.popleft()
            try:
                request.answer = self.obey(request.text)
            except FaultCommandError as error:
                request.error = error
            request.done.set()

    def _pass_events(self) -> None:
        news = self.emulator.take_events()
        if self.on_event is not None:
            for event in news:
                self.on_event(event)

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._serve, name="emulated-drives", daemon=True)
        self._thread.start()
        return self

    def _serve(self) -> None:
        try:
            self.run(self._ended.is_set)
        except BaseException as error:  # raised by __exit__
            self._failure = error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        if self._failure is not None and error is None:
            raise self._failure


def open_endpoint(channel: str, bus_bitrate: int) -> Endpoint:
    """The endpoint for ``channel``.

    ``socket://127.0.0.1:PORT`` (0: a free port), ``pty``, or python-can's ``INTERFACE:CHANNEL``.
    Raises EndpointError.
    """
    if channel == "pty":
        return SlcanPty(bus_bitrate)
    if channel.startswith("socket://"):
        host, _, port = channel.removeprefix("socket://").rpartition(":")
        if host not in ("127.0.0.1", "localhost") or not port.isdecimal() or int(port) > 65_535:
            raise EndpointError(
                f"channel {Address(channel)!r}: emulated drives listen on this host only: "
                "socket://127.0.0.1:PORT (0: free)"
            )
        return SlcanTcp(int(port), bus_bitrate)
    interface, separator, name = channel.partition(":")
    if separator and interface and name:
        return PythonCanEndpoint(interface, name)
    raise EndpointError(
        f"channel {Address(channel)!r} cannot be served; valid: socket://127.0.0.1:PORT (0: a free one), pty, or a "
        "python-can interface as INTERFACE:CHANNEL, e.g. socketcan:vcan0"
    )


def served_channel(options: CanOptions) -> str:
    """The channel at which a cell's master expects its drives. Raises EndpointError if it cannot be served."""
    channel = str(options.channel)
    if channel.startswith("socket://"):
        return channel
    if options.interface in ("stereoservo_slcan", "slcan", "virtual"):
        raise EndpointError(
            f"the cell's channel is {options.interface} {Address(channel)!r}, which another process cannot stand in for"
            "; give --channel pty or --channel socket://127.0.0.1:0, and the cell the channel that is then printed"
        )
    return f"{options.interface}:{channel}"


# -- endpoints -----------------------------------------------------------------------------------------------
# Endpoints by which a master connects to an emulated bus: serial-line CAN on TCP or a pty, or any python-can
# interface.


READ_SIZE = 65_536
BACKLOG_LIMIT = 1 << 20
"""Unread bytes that are kept for a client; further ones are lost, as in an adapter whose buffer is full."""
DATA_OVERRUN = 0x08
WRONG_BITRATE = 0x80 | 0x20 | 0x04
"""Bus error, error passive, error warning: final state of an adapter whose bit rate differs from the bus's."""


class EndpointError(Exception):
    """A channel cannot be served; the text names it and the cause."""


class Endpoint(Protocol):
    """Protocol of the master's side of the bus.

    ``channel``: address at which a master connects. ``descriptors``: to wait for; empty if it must be polled.
    """

    channel: str

    def descriptors(self) -> list[int]:
        """File descriptors that become readable when data arrive."""
        ...

    def take(self) -> list[CanFrame]:
        """Frames that the master sent; does not block."""
        ...

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Send frames to the master, with their bus times [ns]; does not block."""
        ...

    def plug(self, plugged: bool) -> None:
        """Unplug the adapter (False), or plug it in again."""
        ...

    def close(self) -> None:
        """Release it."""
        ...


class _SerialClient:
    """One serial-line client, with an emulated adapter between bytes and frames."""

    def __init__(self, descriptor: int, bus_bitrate: int) -> None:
        self.descriptor = descriptor
        self.adapter = SlcanAdapter()
        self._bitrate = bus_bitrate
        self._unsent = b""

    @property
    def deaf(self) -> bool:
        """Whether the host has set another bit rate than the bus's."""
        rate = self.adapter.bitrate
        return self.adapter.registers is not None or (rate is not None and rate != self._bitrate)

    def take(self) -> list[CanFrame]:
        """Frames of the host. Raises OSError if it is disconnected."""
        try:
            chunk = os.read(self.descriptor, READ_SIZE)
        except BlockingIOError:
            return []
        if not chunk:
            raise ConnectionResetError("the client has closed the connection")
        was_open = self.adapter.is_open
        frames, answer = self.adapter.feed(chunk)
        if was_open and not self.adapter.is_open:
            self._unsent = b""  # frames of a closed channel
        if frames and self.deaf:
            self.adapter.flags |= WRONG_BITRATE
            frames = []
        self.write(answer)
        return frames

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Send frames to the host. Raises OSError if it is disconnected."""
        if not self.adapter.is_open:
            return
        if self.deaf:
            self.adapter.flags |= WRONG_BITRATE
            return
        self.write(self.adapter.deliver([frame for _, frame in frames], frames[-1][0]))

    def write(self, data: bytes) -> None:
        """Write as much as the host accepts now."""
        self._unsent += data
        if not self._unsent:
            return
        with contextlib.suppress(BlockingIOError):
            self._unsent = self._unsent[os.write(self.descriptor, self._unsent) :]
        if len(self._unsent) > BACKLOG_LIMIT:
            self._unsent = b""
            self.adapter.flags |= DATA_OVERRUN


class SlcanTcp:
    """Serial-line CAN on 127.0.0.1, one client at a time; a second one is refused. Port 0: a free one."""

    def __init__(self, port: int, bus_bitrate: int) -> None:
        self._bitrate = bus_bitrate
        self._client: socket.socket | None = None
        self._line: _SerialClient | None = None
        self._listener: socket.socket | None = None
        self._port = port
        self._listen()
        self.channel = f"socket://127.0.0.1:{self._port}"

    def _listen(self) -> None:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("127.0.0.1", self._port))
            listener.listen(4)
        except OSError as error:
            listener.close()
            raise EndpointError(
                f"cannot listen on 127.0.0.1:{self._port}: {error.strerror}; end what listens there, or take another "
                "port (0: a free one)"
            ) from error
        listener.setblocking(False)
        self._port = listener.getsockname()[1]
        self._listener = listener

    def descriptors(self) -> list[int]:
        """Descriptors of the listener and of the client."""
        return [end.fileno() for end in (self._listener, self._client) if end is not None]

    def take(self) -> list[CanFrame]:
        """Frames of the client, if there is one."""
        frames = self._read()
        self._accept(frames)
        return frames

    def _read(self) -> list[CanFrame]:
        if self._line is None:
            return []
        try:
            return self._line.take()
        except OSError:
            self._drop()
            return []

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Send frames to the client, if there is one; otherwise they are lost."""
        if self._line is None:
            return
        try:
            self._line.give(frames)
        except OSError:
            self._drop()

    def plug(self, plugged: bool) -> None:
        """Plug or unplug: unplugged, the connection is closed and the port does not listen."""
        if plugged and self._listener is None:
            self._listen()
        elif not plugged:
            self._drop()
            if self._listener is not None:
                self._listener.close()
                self._listener = None

    def close(self) -> None:
        """Close the connection and the listener."""
        self.plug(False)

    def _accept(self, frames: list[CanFrame]) -> None:
        if self._listener is None:
            return
        try:
            client, _ = self._listener.accept()
        except BlockingIOError:
            return
        # A client that closes a connection may open the next at once: the old one's last data are processed first.
        while self._client is not None and select.select([self._client], [], [], 0)[0]:
            frames += self._read()
        if self._client is not None:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        self._line = _SerialClient(client.fileno(), self._bitrate)

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = self._line = None


class SlcanPty:
    """Serial-line CAN on a pseudo terminal, for masters that open a device by its path."""

    def __init__(self, bus_bitrate: int) -> None:
        self._bitrate = bus_bitrate
        self._open()

    def _open(self) -> None:
        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._line = _SerialClient(self._ours, self._bitrate)
        self.channel = os.ttyname(self._theirs)

    def descriptors(self) -> list[int]:
        """Descriptor of our end."""
        return [self._ours] if self._ours >= 0 else []

    def take(self) -> list[CanFrame]:
        """Bytes written to the terminal. Our own open end keeps it alive between masters."""
        return self._line.take() if self._ours >= 0 else []

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Send frames to the reader of the terminal."""
        if self._ours >= 0:
            self._line.give(frames)

    def plug(self, plugged: bool) -> None:
        """Plug or unplug: unplugged, the terminal does not exist; plugged in again it may have another path."""
        if plugged and self._ours < 0:
            self._open()
        elif not plugged and self._ours >= 0:
            os.close(self._theirs)
            os.close(self._ours)
            self._ours = -1

    def close(self) -> None:
        """Remove the terminal."""
        self.plug(False)


class PythonCanEndpoint:
    """Any python-can interface: ``virtual`` for a master in the same process, ``socketcan`` for a kernel's bus."""

    def __init__(self, interface: str, channel: str | int, **options: Any) -> None:
        import can

        self.channel = f"{interface}:{channel}"
        self._error = can.CanError
        try:
            self._bus = can.Bus(interface=interface, channel=channel, **options)
        except Exception as error:  # interfaces whose vendor library is missing raise anything
            what = str(error) or type(error).__name__
            raise EndpointError(f"python-can cannot open {self.channel}: {what}") from error
        self._plugged = True
        self.lost = 0

    def descriptors(self) -> list[int]:
        """Descriptor of the bus, if it has one."""
        try:
            descriptor = self._bus.fileno()
        except NotImplementedError:
            return []
        return [descriptor] if descriptor >= 0 else []

    def take(self) -> list[CanFrame]:
        """Frames on the bus."""
        frames = []
        while (message := self._bus.recv(timeout=0)) is not None:
            if not message.is_error_frame:
                frames.append(from_message(message))
        return frames if self._plugged else []

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Send to the bus; frames that its transmit buffer does not accept are lost and counted in ``lost``."""
        if not self._plugged:
            return
        for _, frame in frames:
            try:
                self._bus.send(to_message(frame))
            except self._error:
                self.lost += 1

    def plug(self, plugged: bool) -> None:
        """Plug or unplug: unplugged, no frame passes (a python-can bus cannot be removed from its master)."""
        self._plugged = plugged

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()
