"""Scripted emulated buses in real time behind serial-line CAN, spoken to with plain sockets and files."""

from __future__ import annotations

import os
import select
import socket
import time

import can
import numpy as np
import pytest

from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator
from stereoservo_sim.emulators.bus.bus_server import (
    BusServer,
    EndpointError,
    PythonCanEndpoint,
    SlcanPty,
    SlcanTcp,
    open_endpoint,
    served_channel,
)
from stereoservo_sim.emulators.bus.plant import AxisPlant
from stereoservo_sim.emulators.fault_engine import FaultCommandError
from stereoservo_sim.world.velocity_drives import IdealPlant

PATIENCE_S = 60.0


@pytest.fixture
def serve(scripted):
    """Starts a server of two scripted nodes at an endpoint, in a thread."""
    servers = []

    def start(endpoint, bitrate=None):
        now = time.monotonic_ns()
        axes = [scripted.axis(k) for k in range(2)]
        nodes = [scripted.node(k + 1, axis, beat_ns=10**12) for k, axis in enumerate(axes)]
        emulator = BusEmulator(nodes, AxisPlant(axes, IdealPlant(np.zeros(2)), t_ns=now), bitrate=bitrate, t_ns=now)
        server = BusServer(emulator, endpoint).__enter__()
        servers.append(server)
        return server

    yield start
    for server in servers:
        server.__exit__(None, None, None)


class Wired:
    """A host on a file descriptor: writes bytes, waits for bytes."""

    def __init__(self, descriptor):
        self.descriptor = descriptor
        self.heard = b""

    def say(self, data):
        os.write(self.descriptor, data)

    def wait_for(self, wanted):
        """Read until ``wanted`` came; what came, and forget it."""
        until = time.monotonic() + PATIENCE_S
        while wanted not in self.heard:
            assert time.monotonic() < until, f"{wanted!r} never came, only {self.heard!r}"
            if select.select([self.descriptor], [], [], 0.5)[0]:
                self.heard += os.read(self.descriptor, 4096)
        heard, self.heard = self.heard, b""
        return heard


@pytest.fixture
def connect():
    """TCP clients of a server."""
    clients = []

    def open_client(server):
        host, _, port = server.channel.removeprefix("socket://").rpartition(":")
        client = socket.create_connection((host, int(port)), timeout=PATIENCE_S)
        clients.append(client)
        return client

    yield open_client
    for client in clients:
        client.close()


def last_answer(wire):
    """SYNC, and what it brings up to the last TPDO."""
    wire.say(b"t0800\r")
    return wire.wait_for(b"t282455555555\r")


@pytest.mark.parametrize("bitrate", [None, 1_000_000])
def test_two_drives_over_tcp(serve, connect, bitrate):
    server = serve(SlcanTcp(0, 1_000_000), bitrate)
    wire = Wired(connect(server).fileno())
    wire.say(b"S8\rO\r")
    wire.wait_for(b"\r\r")
    answer = last_answer(wire)
    assert answer.index(b"z\r") < answer.index(b"t1818") < answer.index(b"t1828") < answer.index(b"t2814")
    assert server.stalls.turns > 0


def test_an_axis_moves_in_real_time(serve, connect, scripted):
    server = serve(SlcanTcp(0, 1_000_000))
    wire = Wired(connect(server).fileno())
    wire.say(b"O\r")
    wire.wait_for(b"\r")
    frame = scripted.command(1, 0.5)
    ordered = time.monotonic()
    wire.say(b"t2015" + frame.data.hex().encode() + b"\r")
    position = 0.0
    while position < 0.05:
        assert time.monotonic() < ordered + PATIENCE_S
        answer = last_answer(wire)
        at = answer.index(b"t1818") + 5
        position = int.from_bytes(bytes.fromhex(answer[at : at + 16].decode()), "little", signed=True) * 1e-6
    assert position <= 0.5 * (time.monotonic() - ordered)


def test_a_closed_channel_passes_nothing(serve, connect):
    server = serve(SlcanTcp(0, 1_000_000))
    wire = Wired(connect(server).fileno())
    wire.say(b"t0800\rO\r")
    assert wire.wait_for(b"\r").startswith(b"\a")


def test_at_another_bit_rate_than_the_bus_there_is_silence_and_a_bus_error(serve, connect):
    server = serve(SlcanTcp(0, 1_000_000))
    wire = Wired(connect(server).fileno())
    wire.say(b"S6\rO\rF\r")
    assert wire.wait_for(b"F00\r") == b"\r\rF00\r"
    wire.say(b"t0800\r")
    wire.wait_for(b"z\r")
    wire.say(b"F\r")
    assert wire.wait_for(b"FA4\r") == b"FA4\r"
    assert all(frame.id != 0x80 for node in server.emulator.nodes for _, frame in node.heard)
    wire.say(b"C\rS8\rO\r")
    wire.wait_for(b"\r\r\r")
    assert b"t181" in last_answer(wire)


def test_one_client_at_a_time_and_the_next_may_come(serve, connect):
    server = serve(SlcanTcp(0, 1_000_000))
    first = connect(server)
    wire = Wired(first.fileno())
    wire.say(b"O\r")
    wire.wait_for(b"\r")
    second = connect(server)
    assert second.recv(1) == b""  # turned away
    assert b"t181" in last_answer(wire)
    first.close()
    until = time.monotonic() + PATIENCE_S
    while True:
        third = connect(server)
        third.sendall(b"O\r")
        try:
            if third.recv(1) == b"\r":
                break
        except ConnectionResetError:
            pass
        assert time.monotonic() < until
    assert b"t181" in last_answer(Wired(third.fileno()))


def test_an_unplugged_adapter_hangs_up_and_nobody_listens_until_it_is_back(serve, connect):
    server = serve(SlcanTcp(0, 1_000_000))
    client = connect(server)
    Wired(client.fileno()).say(b"O\r")
    assert client.recv(1) == b"\r"
    assert server.order("adapter out") == "adapter out"
    assert client.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        connect(server)
    server.order("adapter in")
    wire = Wired(connect(server).fileno())
    wire.say(b"O\r")
    wire.wait_for(b"\r")
    assert b"t181" in last_answer(wire)


def test_over_a_pty(serve):
    server = serve(SlcanPty(500_000))
    terminal = os.open(server.channel, os.O_RDWR | os.O_NOCTTY)
    try:
        wire = Wired(terminal)
        wire.say(b"S6\rO\r")
        wire.wait_for(b"\r\r")
        assert b"t181" in last_answer(wire)
    finally:
        os.close(terminal)


def test_over_python_can_in_one_process(serve):
    serve(PythonCanEndpoint("virtual", "rack-test"))
    with can.Bus(interface="virtual", channel="rack-test") as bus:
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        heard = []
        until = time.monotonic() + PATIENCE_S
        while 0x282 not in heard:
            assert time.monotonic() < until
            message = bus.recv(timeout=0.5)
            if message is not None:
                heard.append(message.arbitration_id)
    assert [i for i in heard if i < 0x700] == [0x181, 0x182, 0x281, 0x282]


def test_orders_from_another_thread(serve):
    server = serve(SlcanTcp(0, 1_000_000))
    assert "silent" in server.order("silence 2")
    assert "server loop" in server.order("status")
    with pytest.raises(FaultCommandError, match="nodes: 1, 2"):
        server.order("silence 7")


def test_a_defect_of_a_node_ends_the_server_and_is_raised(scripted):
    now = time.monotonic_ns()
    axis = scripted.axis()
    node = scripted.node(1, axis)
    emulator = BusEmulator([node], AxisPlant([axis], IdealPlant(np.zeros(1)), t_ns=now), bitrate=None, t_ns=now)

    def broken(t_ns):
        raise ZeroDivisionError("a defect")

    node.advance = broken
    server = BusServer(emulator, SlcanTcp(0, 1_000_000)).__enter__()
    server._thread.join(PATIENCE_S)
    with pytest.raises(FaultCommandError, match="the server has ended"):
        server.order("status")
    with pytest.raises(ZeroDivisionError, match="a defect"):
        server.__exit__(None, None, None)


def test_a_busy_port_is_told():
    taken = SlcanTcp(0, 1_000_000)
    try:
        with pytest.raises(EndpointError, match="0: a free one"):
            SlcanTcp(int(taken.channel.rpartition(":")[2]), 1_000_000)
    finally:
        taken.close()


@pytest.mark.parametrize(
    "channel",
    ["socket://0.0.0.0:5400", "socket://127.0.0.1", "socket://127.0.0.1:70000", "can0", ":x", "/dev/null"],
)
def test_channels_that_cannot_be_served(channel):
    with pytest.raises(EndpointError, match=r"socket://127\.0\.0\.1:PORT"):
        open_endpoint(channel, 1_000_000)


def options(interface, channel):
    joint = {
        "name": "j1", "node_id": 1, "counts_per_rev": 4096.0, "max_velocity": 1.0, "max_acceleration": 4.0,
        "quick_stop_deceleration": 10.0, "position_min": -1.0, "position_max": 1.0,
    }  # fmt: skip
    import msgspec

    return msgspec.convert({"interface": interface, "channel": channel, "joint": [joint]}, CanOptions)


def test_the_cells_own_channel():
    assert served_channel(options("stereoservo_slcan", "socket://127.0.0.1:5400")) == "socket://127.0.0.1:5400"
    assert served_channel(options("socketcan", "vcan0")) == "socketcan:vcan0"
    with pytest.raises(EndpointError, match="--channel pty"):
        served_channel(options("stereoservo_slcan", "/dev/ttyACM0"))


def test_an_interface_without_its_makers_library_is_told(monkeypatch):
    def broken(**_):
        raise NameError("name 'canGetNumberOfChannels' is not defined")

    monkeypatch.setattr(can, "Bus", broken)
    with pytest.raises(EndpointError, match="cannot open kvaser:0: name 'canGetNumberOfChannels'"):
        PythonCanEndpoint("kvaser", "0")
