"""Channels: frames through any interface, failures with value and cure."""

import errno
import socket
import time

import can
import pytest
import serial

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can import channel as can_channel
from stereoservo_drivers.can.channel import BATCH, BusError, Channel, ChannelSettings, bus_error
from stereoservo_drivers.can.frames import CanFrame

FRAMES = [
    CanFrame(0x80),
    CanFrame(0x201, b"\x0f\x00\x01\x02\x03\x04"),
    CanFrame(0x1ABCDEF0, b"\x01\x02", extended=True),
    CanFrame(0x181, remote=True, length=6),
]


def all_frames(channel: Channel, count: int) -> list[CanFrame]:
    got: list[CanFrame] = []
    while len(got) < count and (some := channel.receive(5.0)):
        got += [frame for _, frame in some]
    return got


def refused(settings: ChannelSettings) -> DriverError:
    with pytest.raises(DriverError) as caught:
        Channel(settings)
    error = caught.value
    assert error.code == "can_open"
    assert repr(settings.interface) in str(error)
    assert repr(settings.channel) in str(error)
    assert error.data["channel"] == settings.channel
    return error


def test_frames_through_slcan_with_stamps(adapter):
    channel = Channel(ChannelSettings("stereoservo_slcan", adapter.channel))
    before = time.monotonic_ns()
    channel.send(FRAMES)
    received = []
    while len(received) < len(FRAMES):
        received += channel.receive(5.0)
    assert [frame for _, frame in received] == FRAMES
    stamps = [t_ns for t_ns, _ in received]
    assert stamps == sorted(stamps)
    assert before <= stamps[0] <= stamps[-1] <= time.monotonic_ns()
    assert (channel.frames_sent, channel.frames_received) == (4, 4)
    assert channel.receive(0.0) == []
    channel.close()
    channel.close()


def test_frames_through_virtual_come_not_back_to_the_sender():
    settings = ChannelSettings("virtual", "test_channel_virtual")
    here, there = Channel(settings), Channel(settings)
    here.send(FRAMES)
    assert all_frames(there, 4) == FRAMES
    assert here.receive(0.0) == []
    here.close()
    there.close()


def test_a_flood_is_given_in_batches():
    settings = ChannelSettings("virtual", "test_channel_flood")
    here, there = Channel(settings), Channel(settings)
    here.send([CanFrame(k % 2048) for k in range(BATCH + 10)])
    assert len(there.receive(0.0)) == BATCH
    assert len(there.receive(0.0)) == 10
    here.close()
    there.close()


def test_unknown_interface_lists_those_there_are():
    error = refused(ChannelSettings("soketcan", "can0"))
    assert "Did you mean 'socketcan'?" in str(error)
    for known in ("stereoservo_slcan", "pcan", "virtual"):
        assert known in error.data["known"]
        assert known in str(error)
    assert not error.retry


def test_missing_device():
    error = refused(ChannelSettings("stereoservo_slcan", "/dev/ttyNoSuchAdapter"))
    assert "No such file" in str(error)
    assert "plugged in" in str(error)
    assert error.retry


def test_refused_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    error = refused(ChannelSettings("stereoservo_slcan", f"socket://127.0.0.1:{port}"))
    assert "refused" in str(error)
    assert "stereoservo emulate drives" in str(error)
    assert error.retry


def test_device_in_use(pty_adapter):
    settings = ChannelSettings("stereoservo_slcan", pty_adapter.channel)
    first = Channel(settings)
    error = refused(settings)
    assert "lock" in str(error)
    assert "fuser -v" in str(error)
    first.close()


def test_no_permission(monkeypatch):
    def forbidden(*args, **kwargs):
        raise serial.SerialException(errno.EACCES, "could not open port /dev/ttyACM0: Permission denied")

    monkeypatch.setattr("stereoservo_drivers.can.slcan.serial.Serial", forbidden)
    error = refused(ChannelSettings("stereoservo_slcan", "/dev/ttyACM0"))
    assert "dialout" in str(error)


def test_bitrate_that_the_adapter_has_not():
    error = refused(ChannelSettings("stereoservo_slcan", "/dev/ttyACM0", 123_456))
    assert "123456 bit/s" in str(error)
    assert "1000000" in str(error)
    assert not error.retry


def test_unknown_interface_option():
    error = refused(ChannelSettings("stereoservo_slcan", "/dev/ttyACM0", interface_options={"speed": 3}))
    assert "speed" in str(error)
    assert "interface_options" in str(error)
    assert not error.retry


def test_unplugged_while_receiving_and_sending(adapter):
    channel = Channel(ChannelSettings("stereoservo_slcan", adapter.channel))
    adapter.unplug()
    with pytest.raises(DriverError, match=r"receiving: .*(plugged in|still running)") as caught:
        channel.receive(5.0)
    assert caught.value.code == "connection_lost"
    assert caught.value.retry
    with pytest.raises(DriverError) as caught:  # noqa: PT012 (TCP may take the first writes)
        for _ in range(1000):
            channel.send(FRAMES)
            time.sleep(0.001)
    assert caught.value.code == "connection_lost"
    channel.close()


def test_refused_frame_tells_the_adapters_status(tcp_adapter):
    channel = Channel(
        ChannelSettings("stereoservo_slcan", tcp_adapter.channel, interface_options={"reply_timeout_s": 5.0})
    )
    tcp_adapter.adapter.listen_only = True
    tcp_adapter.adapter.flags = 0x82
    channel.send(FRAMES[:1])
    with pytest.raises(DriverError, match="transmit buffer full, bus error") as caught:
        channel.receive(5.0)
    assert caught.value.code == "send_refused"
    channel.close()


def test_malformed_lines_are_reported_beside_frames(tcp_adapter):
    channel = Channel(ChannelSettings("stereoservo_slcan", tcp_adapter.channel))
    tcp_adapter.to_host(b"t0010\rt12\rt0020\r")
    assert all_frames(channel, 2) == [CanFrame(1), CanFrame(2)]
    errors = [error for _, error in channel.take_errors()]
    assert [error.code for error in errors] == ["malformed_line"]
    assert "t12" in errors[0].message
    assert channel.take_errors() == []
    channel.close()


class FailingBus(can.BusABC):
    """Stands in for a python-can interface: gives messages, raises errors."""

    def __init__(self, script):
        self.script = list(script)
        super().__init__("fails")

    def send(self, msg, timeout=None):
        raise self.script.pop(0)

    def _recv_internal(self, timeout):
        if not self.script:
            return None, True
        step = self.script.pop(0)
        if isinstance(step, Exception):
            raise step
        return step, True


@pytest.fixture
def channel_over(monkeypatch):
    def open_it(*script) -> Channel:
        monkeypatch.setattr(can, "Bus", lambda **options: FailingBus(script))
        return Channel(ChannelSettings("pcan", "PCAN_USBBUS1", 500_000))

    return open_it


def error_frame(number: int, data: bytes = bytes(8)) -> can.Message:
    return can.Message(arbitration_id=number, data=data, is_error_frame=True)


@pytest.mark.parametrize(
    ("error", "code", "part"),
    [
        (
            can.CanOperationError("Failed to transmit: No buffer space", errno.ENOBUFS),
            "send_timeout",
            "terminators",
        ),
        (can.CanOperationError("Transmit buffer full"), "send_timeout", "500000 bit/s"),
        (can.CanTimeoutError("too late"), "send_timeout", "acknowledge"),
        (can.CanOperationError("Network is down", errno.ENETDOWN), "connection_lost", "plug"),
        (OSError(errno.ENODEV, "No such device"), "connection_lost", "plug"),
        (can.CanOperationError("something else"), "connection_lost", "something else"),
    ],
)
def test_failures_of_sending(channel_over, error, code, part):
    with pytest.raises(DriverError, match=part) as caught:
        channel_over(error).send([CanFrame(0x80)])
    assert caught.value.code == code
    assert caught.value.retry


def test_bus_off_is_raised_and_other_errors_are_kept(channel_over):
    message = can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x01")
    warning = error_frame(0x4, b"\x00\x08\x00\x00\x00\x00\x60\x00")
    channel = channel_over(message, warning, error_frame(0x40), message)
    with pytest.raises(DriverError, match=r"bus-off.*500000 bit/s") as caught:
        channel.receive(0.0)
    assert caught.value.code == "bus_off"
    assert not caught.value.retry
    assert [error.code for _, error in channel.take_errors()] == ["error_warning", "bus_off"]


@pytest.mark.parametrize(
    ("number", "data", "code", "part"),
    [
        (0x40, bytes(8), "bus_off", "left the bus"),
        (0x44, b"\x00\x10" + bytes(6), "bus_off", "left the bus"),
        (0x20, bytes(8), "no_acknowledge", "terminators"),
        (0x4, b"\x00\x20\x00\x00\x00\x00\x88\x05", "error_passive", "136 transmit, 5 receive"),
        (0x4, b"\x00\x01" + bytes(6), "overflow", "lost"),
        (0x8, bytes(8), "protocol", "bit rate"),
        (0x100, bytes(8), "restarted", "restarted"),
        (0x0, b"\x01", "bus_error", "0x0"),
    ],
)
def test_error_frames_in_words(number, data, code, part):
    error = bus_error(error_frame(number, data))
    assert error.code == code
    assert part in error.message


LINK = {
    "ifname": "can0",
    "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
    "txqlen": 1000,
    "linkinfo": {
        "info_kind": "can",
        "info_data": {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 500000}},
    },
}
"""As `ip -json -details link show can0` prints it, shortened."""


def test_socketcan_state_is_read_from_ip():
    state = can_channel.state_of(LINK)
    assert state == can_channel.SocketcanState("can", True, "ERROR-ACTIVE", 500_000, 100, 1000)
    assert can_channel.objection(state, "can0", 500_000) is None
    assert can_channel.state_of({"flags": [], "linkinfo": {"info_kind": "vcan"}}).restart_ms is None


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"bitrate": 1_000_000}, ("1000000 bit/s", "500000", "ip link set can0 up type can bitrate 500000")),
        ({"up": False}, ("down", "bitrate 500000 restart-ms 0", "deploy/can")),
        ({"kind": ""}, ("not of CAN",)),
        ({"state": "BUS-OFF"}, ("bus-off", "ip link set can0 down")),
    ],
)
def test_socketcan_objections(change, parts):
    facts = {"kind": "can", "up": True, "state": "ERROR-ACTIVE", "bitrate": 500_000, **change}
    text = can_channel.objection(can_channel.SocketcanState(**facts), "can0", 500_000)
    assert text is not None
    for part in parts:
        assert part in text


def test_a_silent_restart_is_noted(monkeypatch):
    monkeypatch.setattr(can_channel, "read_state", lambda channel: can_channel.state_of(LINK))
    monkeypatch.setattr(can_channel, "enlarge_receive_buffer", lambda bus: 0)
    monkeypatch.setattr(can, "Bus", lambda **options: FailingBus([]))
    channel = Channel(ChannelSettings("socketcan", "can0", 500_000))
    ((_, error),) = channel.take_errors()
    assert isinstance(error, BusError)
    assert error.code == "restart_ms"
    assert "100 ms" in error.message
    with pytest.raises(DriverError, match="runs at 500000 bit/s, the cell says 1000000"):
        Channel(ChannelSettings("socketcan", "can0", 1_000_000))


def test_socketcan_without_the_interface_or_the_kernel():
    error = refused(ChannelSettings("socketcan", "nocan7"))
    assert "modprobe can_raw" in str(error) or "ip link show nocan7" in str(error)


@pytest.mark.parametrize(
    ("interface", "channel", "cure"),
    [
        ("stereoservo_slcan", "/", "That is no serial port"),
        ("stereoservo_slcan", "/dev/null", "That is no serial port"),
        ("socketcand", "x", "Check `interface_options` (none given) against"),
    ],
)
def test_what_is_no_adapter_is_told_as_such(interface, channel, cure):
    assert cure in str(refused(ChannelSettings(interface, channel)))


@pytest.mark.parametrize(
    ("interface", "channel", "needed"),
    [
        ("pcan", "PCAN_USBBUS1", "PCAN-Basic library (libpcanbasic.so"),
        ("kvaser", 0, "libcanlib.so"),
        ("canalystii", 0, "pip install canalystii"),
        ("gs_usb", 0, "python-can[gs_usb]"),
    ],
)
def test_an_interface_without_its_package_says_which_it_needs(interface, channel, needed):
    """As python-can of this computer raises it, if it has no such adapter."""
    assert needed in str(refused(ChannelSettings(interface, channel)))


def test_whatever_the_interface_of_another_raises_is_told(monkeypatch):
    def broken(**_: object) -> None:
        raise NameError("name 'canGetNumberOfChannels' is not defined")

    monkeypatch.setattr(can, "Bus", broken)
    error = refused(ChannelSettings("kvaser", 0))
    assert "canGetNumberOfChannels" in str(error)
    assert "libcanlib" in str(error)


def test_a_host_that_is_not_known(monkeypatch):
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    assert "No such host" in str(refused(ChannelSettings("stereoservo_slcan", "socket://nobody:5400")))


def test_a_channel_on_a_network_is_told_without_its_password():
    with pytest.raises(DriverError) as caught:
        Channel(ChannelSettings("stereoservo_slcan", "socket://operator:Tulpe@127.0.0.1:1"))
    assert "Tulpe" not in str(caught.value) + repr(caught.value.data)
    assert "socket://***@127.0.0.1:1" in str(caught.value)
