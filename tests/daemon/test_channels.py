"""Every channel between processes, whichever of its ends is killed, hangs or starts anew, at every moment: nothing is
lost, nothing comes twice.

A process that is killed leaves what the kernel leaves of it: closed sockets with what they hold unread, and its files.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import Event, encode
from stereoservo.daemon.channels.reports import KEPT_REPORTS, Reporter, ReportIntake
from stereoservo.daemon.channels.seqpacket import ChannelServer, PacketChannel
from stereoservo.daemon.heartbeat import HEARTBEAT_BYTES, HEARTBEAT_LAYOUT
from stereoservo.daemon.ipc_messages import Received, Report, event_decoder, report_decoder
from stereoservo.daemon.kernel_compilation import example_model
from stereoservo.daemon.seqlock import create_slot, create_stop_slot
from stereoservo.daemon.servo_links import ProcessLinks
from stereoservo.gateway.persistence import HandledEvents
from stereoservo.gateway.servo_connection import MOST_COVARIANCE_BYTES, ServoConnection
from stereoservo.kinematics.model import ModelCovariance
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.goals import Hold
from stereoservo.ports.clock import VirtualClock

MESSAGES = 6
LARGE = 400_000
"""Characters: a socket holds one or two such messages."""


class Killed(BaseException):
    """A process ends in the midst of its work."""


def kill_server(server: ChannelServer) -> None:
    """What SIGKILL does: nobody removes the socket file, nobody reads what waits."""
    for peer in server.peers:
        peer.close()
    server._socket.close()


class Reports:
    """From a vision process to the gateway."""

    refused: tuple[int, ...] = ()

    def __init__(self, directory: Path, size: int) -> None:
        self.path, self.size = directory / "reports.sock", size
        self.told: list[list[int]] = []
        """Numbers of messages, by each life of the receiver."""
        self.dies_before = -1
        self.start_sender()
        self.start_receiver()

    @property
    def kept(self) -> list[int]:
        """What outlives the receiver: its journal."""
        return [number for life in self.told for number in life]

    def start_sender(self) -> None:
        self.sender = Reporter(self.path, "vision-left", VirtualClock())

    def kill_sender(self) -> None:
        if self.sender._channel is not None:
            self.sender._channel.close()

    def send(self, number: int) -> None:
        self.sender.report("camera_lost", f"{number} ".ljust(self.size))

    def poll_sender(self) -> None:
        self.sender.flush()

    def start_receiver(self) -> None:
        self.told.append([])
        self.receiver = ReportIntake(self.path)

    def kill_receiver(self) -> None:
        kill_server(self.receiver._server)

    def poll_receiver(self) -> None:
        self.receiver.poll(self._take)

    def _take(self, report: Report) -> None:
        number = int(report.message.split()[0])
        if number == self.dies_before:
            self.dies_before = -1
            raise Killed
        self.told[-1].append(number)

    def close(self) -> None:
        self.kill_sender()
        self.receiver.close()


class Control:
    """Between servo process and gateway. The servo process is never started anew: with it the run ends."""

    refused: tuple[int, ...] = ()

    def __init__(self, directory: Path, size: int) -> None:
        self.directories, self.size = CellDirectories("bench", directory, directory), size
        create_stop_slot(self.directories.stop_slot)
        create_slot(self.directories.heartbeat_slot("servo"), HEARTBEAT_BYTES, HEARTBEAT_LAYOUT)
        self.servo = ProcessLinks(self.directories, ())
        self.gateways: list[ServoConnection] = []
        """All lives of it: what a dead one has mapped goes with its process, here with the test."""
        self.told: list[list[int]] = []
        self.start_gateway()

    @property
    def gateway(self) -> ServoConnection:
        return self.gateways[-1]

    def start_gateway(self) -> None:
        self.gateways.append(ServoConnection(self.directories))

    def kill_gateway(self) -> None:
        if self.gateway._control is not None:
            self.gateway._control.close()

    def poll_gateway(self) -> None:
        self.gateway._last_try = float("-inf")  # it is time to connect
        self.gateway.poll_connection()

    @property
    def kept(self) -> list[int]:
        return [number for life in self.told for number in life]

    def close(self) -> None:
        for gateway in self.gateways:
            gateway.close()
        self.servo.close()


class Events(Control):
    """The core's events, which each gateway is told from the first on; its journal must have them once."""

    def __init__(self, directory: Path, size: int) -> None:
        self.journal: list[int] = []
        self.dies_before = -1
        super().__init__(directory, size)
        self.told.append([])
        self.handle_events()

    @property
    def kept(self) -> list[int]:
        return self.journal

    def send(self, number: int) -> None:
        self.servo.publish_events((Event(number + 1, 0, "warning", f"{number} ".ljust(self.size)),))

    def poll_sender(self) -> None:
        self.servo.receive()
        self.servo.publish_events(())

    def start_receiver(self) -> None:
        self.told.append([])
        self.start_gateway()
        self.handle_events()

    def handle_events(self) -> None:
        self.handled = HandledEvents(self.directories.runtime / "handled.slot", lambda *note: None)

    def kill_receiver(self) -> None:
        self.kill_gateway()
        self.handled.close()

    def close(self) -> None:
        self.handled.close()
        super().close()

    def poll_receiver(self) -> None:
        self.poll_gateway()
        for event in self.gateway.events():
            number = int(event.message.split()[0])
            if number == self.dies_before:
                self.dies_before = -1
                raise Killed
            assert self.handled.missed_before(event) == 0
            self.told[-1].append(number)
            if not self.handled.is_journaled(event):
                self.journal.append(number)
            self.handled.mark(event, acted=False)


class Requests(Control):
    """Clients' requests, forwarded by the gateway, which answers those that it could not send."""

    def __init__(self, directory: Path, size: int) -> None:
        super().__init__(directory, size)
        self.told.append([])
        self.dies_before = -1
        self.poll_sender()
        self.poll_receiver()

    def start_sender(self) -> None:
        self.start_gateway()
        self.poll_sender()

    def kill_sender(self) -> None:
        self.kill_gateway()

    def send(self, number: int) -> None:
        if self.gateway.send_command(Hold(), f"{number} ".ljust(self.size)) is None:
            self.refused += (number,)

    def poll_sender(self) -> None:
        self.poll_gateway()

    def poll_receiver(self) -> None:
        for request in self.servo.receive().requests:
            self.told[-1].append(int(request.operator.split()[0]))


class Fault(NamedTuple):
    """What happens to one end of a channel; ``killed``: before it is away, after that, ``within`` its work, or not."""

    end: Literal["sender", "receiver"]
    killed: Literal["", "before", "after", "within"]


RECEIVER_ENDS = [Fault("receiver", "before"), Fault("receiver", "after"), Fault("receiver", "within")]
HANGS = [Fault("receiver", ""), Fault("sender", "")]
SENDER_ENDS = [Fault("sender", "before"), Fault("sender", "after")]
CHANNELS: list[tuple[Callable[[Path, int], Any], list[Fault]]] = [
    (Reports, [*RECEIVER_ENDS, *HANGS, *SENDER_ENDS]),
    (Events, [*RECEIVER_ENDS, *HANGS]),
    (Requests, [*HANGS, *SENDER_ENDS]),
]
"""With a servo process that is killed the run ends: see tests/hil/test_lifecycle.py."""


def fly(channel: Any, fault: Fault, at: int, every: int, away: int) -> None:
    """Send a message a round, with ``fault`` in round ``at``, for ``away`` rounds; the receiver looks in every
    ``every``-th one.
    """
    left = list(range(MESSAGES))
    for k in range(MESSAGES + away + 1):
        if k == at and fault.killed == "within":
            channel.dies_before = at
        if k == at and fault.killed == "before":
            getattr(channel, f"kill_{fault.end}")()
        if k == at + away and fault.killed == "after":
            getattr(channel, f"kill_{fault.end}")()
        if k == at + away and fault.killed in ("before", "after"):
            getattr(channel, f"start_{fault.end}")()
        there = fault.killed == "within" or not at <= k < at + away
        if there or fault.end == "receiver":
            if left:
                channel.send(left.pop(0))
            channel.poll_sender()
        if k % every == 0 and (there or fault.end == "sender"):
            look(channel)
    assert not left
    for _ in range(4 * MESSAGES):  # until nothing moves
        channel.poll_sender()
        look(channel)


def look(channel: Any) -> None:
    """The receiver takes what is there; where that kills it, it is started anew."""
    try:
        channel.poll_receiver()
    except Killed:
        channel.kill_receiver()
        channel.start_receiver()


@pytest.mark.parametrize("size", [0, LARGE], ids=["", "sockets full"])
@pytest.mark.parametrize(
    ("make", "fault"),
    [(make, fault) for make, faults in CHANNELS for fault in faults],
    ids=lambda value: f"{value.end} killed: {value.killed or 'no'}" if isinstance(value, Fault) else None,
)
def test_nothing_is_lost_and_nothing_comes_twice(
    make: Callable[[Path, int], Any], fault: Fault, size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stereoservo.daemon.channels.reports.write_log", lambda origin, message: None)
    for at, every, away in product(range(MESSAGES), (1, 3), (0, 4)):
        case = f"round {at}, looks every {every}, away for {away}"
        directory = tmp_path / f"{at}{every}{away}"  # a socket's path is short
        directory.mkdir()
        channel = make(directory, size)
        fly(channel, fault, at, every, away)
        assert channel.kept == [k for k in range(MESSAGES) if k not in channel.refused], case
        assert all(life == sorted(set(life)) for life in channel.told), case
        channel.close()


def test_no_event_is_sent_before_the_gateway_has_said_which_it_has(tmp_path: Path) -> None:
    """Those that waited were sent twice: at once, and with all others once the gateway had said so."""
    channel = Events(tmp_path, 0)
    for k in range(3):
        channel.send(k)
    with PacketChannel.connect(channel.directories.control_socket) as gateway:
        channel.poll_sender()
        assert gateway.receive() == []
        assert gateway.send(encode(Received(1)))
        channel.poll_sender()
        assert [event_decoder.decode(data).seq for data in gateway.receive()] == [2, 3]
    channel.close()


def test_reports_are_taken_once_where_the_channel_breaks_before_they_are_acknowledged(tmp_path: Path) -> None:
    channel = Reports(tmp_path, 0)
    for k in range(3):
        channel.send(k)
        channel.poll_receiver()
        channel.kill_sender()  # its channel alone
    channel.poll_sender()
    channel.poll_receiver()
    assert channel.kept == [0, 1, 2]
    channel.close()


def test_reports_that_are_too_many_to_keep_are_counted(tmp_path: Path) -> None:
    reporter = Reporter(tmp_path / "reports.sock", "vision-left", VirtualClock())
    for k in range(KEPT_REPORTS + 5):
        reporter.report("camera_lost", str(k))
    intake, told = ReportIntake(tmp_path / "reports.sock"), list[str]()
    for _ in range(3):
        reporter.flush()
        intake.poll(lambda report: told.append(report.message))
    assert told[:-1] == [str(5 + k) for k in range(KEPT_REPORTS)]
    assert told[-1].startswith("5 reports were dropped while the gateway was away")
    intake.close()


def test_events_that_are_too_many_to_keep_are_counted(tmp_path: Path) -> None:
    handled = HandledEvents(tmp_path / "handled.slot", lambda *note: None)
    assert handled.missed_before(Event(1, 0, "warning")) == 0
    handled.mark(Event(1, 0, "warning"), acted=False)
    assert handled.missed_before(Event(1, 0, "warning")) == 0
    assert handled.missed_before(Event(2, 0, "warning")) == 0
    assert handled.missed_before(Event(5, 0, "warning")) == 3
    handled.close()


def test_what_a_gateway_answers_wrongly_ends_no_sender(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "reports.sock")
    reporter = Reporter(tmp_path / "reports.sock", "vision-left", VirtualClock())
    reporter.report("camera_lost", "one")
    (peer,) = server.accept()
    assert peer.send(b"\xff")
    reporter.flush()
    reporter.report("camera_back", "two")
    assert [report_decoder.decode(data).message for data in peer.receive()] == ["one", "two"]
    server.close()


@pytest.mark.parametrize("within", [True, False])
def test_a_models_covariance_reaches_the_loop_if_it_is_not_too_large(
    tmp_path: Path, within: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    most = int((MOST_COVARIANCE_BYTES // 8) ** 0.5)
    size = most if within else most + 1
    points = (np.random.default_rng(size).normal(size=(size, 4)),)
    covariance = ModelCovariance((), (), (), points, np.random.default_rng(1).normal(size=(size, size)))
    model = msgspec.structs.replace(example_model(), covariance=covariance, epoch=5)
    channel = Requests(tmp_path, 0)
    try:
        assert channel.gateway.send_model(model, kept=True)
        update = channel.servo.receive().model_update
    finally:
        channel.close()
    assert update is not None
    assert update.kept
    said = capfd.readouterr().err
    if within:
        assert update.model.covariance is not None
        assert (update.model.covariance.covariance == covariance.covariance).all()
        assert "covariance" not in said
    else:
        assert update.model.covariance is None
        assert "covariance of model 5" in said
