"""``stereoservo_slcan`` as a python-can interface, against an adapter thread over TCP and over a pty."""

import contextlib
import queue
import socket
import threading

import can
import pytest

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.slcan import (
    GARBLED_LINES,
    SlcanBus,
    SlcanGarbledError,
    SlcanLostError,
    SlcanRefusedError,
)

MESSAGES = [
    can.Message(arbitration_id=0x80, is_extended_id=False),
    can.Message(arbitration_id=0x201, is_extended_id=False, data=b"\x0f\x00\x01\x02\x03\x04\x05\x06"),
    can.Message(arbitration_id=0x12ABCDEF, is_extended_id=True, data=b"\x01"),
    can.Message(arbitration_id=0x181, is_extended_id=False, is_remote_frame=True, dlc=6),
    can.Message(arbitration_id=0x1ABCDEF, is_extended_id=True, is_remote_frame=True),
]


def test_python_can_finds_it_by_name(adapter):
    with can.Bus(interface="stereoservo_slcan", channel=adapter.channel, bitrate=500_000) as bus:
        assert isinstance(bus, SlcanBus)
        assert adapter.channel in str(bus)
        assert adapter.adapter.bitrate == 500_000
        for message in MESSAGES:
            bus.send(message)
        for message in MESSAGES:
            got = bus.recv(5.0)
            assert got is not None
            assert got.equals(message, timestamp_delta=None, check_channel=False)
        assert bus.recv(0.0) is None
        assert bus.recv(0.01) is None


def test_send_many_receive_many(adapter):
    frames = [CanFrame(k, bytes([k % 256] * (k % 9)), extended=k % 2 == 1) for k in range(600)]
    with SlcanBus(adapter.channel, 1_000_000) as bus:
        got = []
        for k in range(0, 600, 100):
            bus.send_many(frames[k : k + 100], 5.0)
            while len(got) < k + 100 and (some := bus.receive_many(5.0)):
                got += some
        assert got == frames
        assert bus.receive_many(0.0) == []
    assert adapter.received == frames


def test_notifier_and_filters(tcp_adapter):
    with SlcanBus(tcp_adapter.channel, 1_000_000, can_filters=[{"can_id": 0x80, "can_mask": 0x7FF}]) as bus:
        heard: queue.Queue[can.Message] = queue.Queue()
        notifier = can.Notifier(bus, [heard.put], timeout=0.1)
        bus.send_many([CanFrame(0x81), CanFrame(0x80, b"\x01")])
        assert heard.get(timeout=60.0).data == b"\x01"
        notifier.stop()
        assert heard.empty()


def test_without_bitrate_the_adapter_keeps_its_own(tcp_adapter):
    with SlcanBus(tcp_adapter.channel):
        assert tcp_adapter.adapter.bitrate is None
        assert tcp_adapter.adapter.is_open


def test_shutdown_closes_the_adapters_channel_once(adapter):
    bus = SlcanBus(adapter.channel, 1_000_000)
    assert adapter.adapter.is_open
    bus.shutdown()
    bus.shutdown()
    adapter.wait_until(lambda: not adapter.adapter.is_open)
    with pytest.raises(can.CanOperationError):
        bus.recv(0.0)


def test_an_adapter_that_answers_nothing_is_taken(tcp_adapter):
    tcp_adapter.adapter.feed = lambda chunk: ([], b"")
    with SlcanBus(tcp_adapter.channel, 1_000_000, reply_timeout_s=0.01) as bus:
        tcp_adapter.to_host(b"t0801AA\r")
        assert bus.receive_many(5.0) == [CanFrame(0x80, b"\xaa")]


def test_an_adapter_that_refuses_the_bitrate_is_not(tcp_adapter):
    real = tcp_adapter.adapter.feed
    tcp_adapter.adapter.feed = lambda chunk: ([], b"\a") if b"S" in chunk else real(chunk)
    with pytest.raises(can.CanInitializationError, match="refused command 'S8'"):
        SlcanBus(tcp_adapter.channel, 1_000_000)


def test_bell_is_an_error_once(tcp_adapter):
    with SlcanBus(tcp_adapter.channel, 1_000_000) as bus:
        tcp_adapter.adapter.listen_only = True
        bus.send(MESSAGES[0])
        with pytest.raises(SlcanRefusedError, match="refused 1 "):
            bus.recv(5.0)
        assert bus.recv(0.01) is None
        tcp_adapter.to_host(b"\a\a")
        with pytest.raises(SlcanRefusedError):
            bus.receive_many(5.0)


def test_frames_before_a_bell_are_not_lost(tcp_adapter):
    with SlcanBus(tcp_adapter.channel, 1_000_000) as bus:
        tcp_adapter.to_host(b"t0010\rt0020\r\at0030\r")
        with pytest.raises(SlcanRefusedError):
            bus.receive_many(5.0)
        assert bus.receive_many(5.0) == [CanFrame(1), CanFrame(2), CanFrame(3)]


def test_status_flags(tcp_adapter):
    with SlcanBus(tcp_adapter.channel, 1_000_000, reply_timeout_s=5.0) as bus:
        tcp_adapter.adapter.flags = 0x82
        bus.send(MESSAGES[0])
        assert bus.status_flags() == 0x82
        assert bus.receive_many(5.0) == [CanFrame(0x80)]


def test_malformed_lines_are_skipped_and_counted(adapter):
    with SlcanBus(adapter.channel, 1_000_000) as bus:
        adapter.to_host(b"t0010\rt12\rhello\rt9990\rt0020\r")
        got = []
        while len(got) < 2:
            got += bus.receive_many(5.0)
        assert got == [CanFrame(1), CanFrame(2)]
        assert bus.malformed == 3
        assert bus.last_malformed is not None
        assert bus.last_malformed.line == b"t9990"


def test_nothing_but_garbage_is_an_error(tcp_adapter):
    with SlcanBus(tcp_adapter.channel, 1_000_000) as bus:
        tcp_adapter.to_host(b"garbage\r" * GARBLED_LINES)
        with pytest.raises(SlcanGarbledError, match="garbage"):
            bus.receive_many(5.0)


def test_unplugged(adapter):
    with SlcanBus(adapter.channel, 1_000_000) as bus:
        adapter.unplug()
        with pytest.raises(SlcanLostError):
            bus.recv(5.0)
        with pytest.raises(SlcanLostError):  # noqa: PT012 (TCP may take the first write)
            for _ in range(100):
                bus.send(MESSAGES[0])
                bus.recv(0.01)


def test_a_full_line_is_a_timeout_and_no_line_is_torn():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        channel = f"socket://127.0.0.1:{server.getsockname()[1]}"
        bus = SlcanBus(channel, reply_timeout_s=0.0, send_timeout_s=0.01)
        peer, _ = server.accept()
        with peer:
            frames = [CanFrame(k % 2048, bytes(8)) for k in range(20_000)]
            with pytest.raises(can.CanTimeoutError, match=r"took no more for 0\.01 s"):  # noqa: PT012
                for _ in range(100):
                    bus.send_many(frames)
            peer.settimeout(5.0)
            stream = bytearray()
            waiting = len(bus._unsent)
            while waiting:
                stream += peer.recv(1 << 20)
                with contextlib.suppress(can.CanTimeoutError):
                    bus.send_many([])
                waiting = len(bus._unsent)
            bus.shutdown()
            while piece := peer.recv(1 << 20):
                stream += piece
    lines = bytes(stream).split(b"\r")
    frames_sent = [line for line in lines if line[:1] == b"t"]
    assert lines[-2] == b"C"
    assert len(frames_sent) >= 20_000
    assert all(len(line) == 21 for line in frames_sent)


def test_threads_do_not_tear_each_others_lines(tcp_adapter):
    tcp_adapter.echo = False
    with SlcanBus(tcp_adapter.channel, 1_000_000) as bus:

        def send(number: int) -> None:
            for _ in range(200):
                bus.send_many([CanFrame(number, bytes([number] * 8))] * 3, 5.0)

        threads = [threading.Thread(target=send, args=(number,)) for number in (1, 2, 3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        while bus.receive_many(0.05):
            pass
    tcp_adapter.wait_until(lambda: len(tcp_adapter.received) >= 1800)
    assert tcp_adapter.adapter.malformed == 0
    assert len(tcp_adapter.received) == 1800
    assert all(frame.data == bytes([frame.id] * 8) for frame in tcp_adapter.received)


@pytest.mark.parametrize(
    ("channel", "options", "part"),
    [
        ("socket://127.0.0.1", {}, "socket://HOST:PORT"),
        ("socket://127.0.0.1:5400/x", {}, "socket://HOST:PORT"),
        ("socket://127.0.0.1:99999", {}, "socket://HOST:PORT"),
        ("rfc2217://127.0.0.1:5400", {}, "socket://HOST:PORT"),
        ("", {}, "/dev/ttyACM0"),
        ("/dev/ttyACM0", {"bitrate": 123_456}, "123456 bit/s has no"),
    ],
)
def test_wrong_settings(channel, options, part):
    with pytest.raises(ValueError, match=part):
        SlcanBus(channel, **options)


def test_can_fd_is_refused(tcp_adapter):
    with SlcanBus(tcp_adapter.channel, 1_000_000) as bus, pytest.raises(ValueError, match="CAN FD"):
        bus.send(can.Message(arbitration_id=1, is_fd=True, data=bytes(16)))
