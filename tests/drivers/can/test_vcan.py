"""A channel over the kernel's virtual CAN, where this kernel has it and lets us."""

import socket
import subprocess
from collections.abc import Iterator

import pytest

from stereoservo_drivers.can import channel
from stereoservo_drivers.can.channel import Channel, ChannelSettings
from stereoservo_drivers.can.frames import CanFrame

NAME = "vcan0"


def ip(*words: str) -> str | None:
    """Runs `ip`; what went wrong, or None."""
    try:
        done = subprocess.run(["ip", *words], capture_output=True, text=True, timeout=10, check=False)
    except OSError as error:
        return f"no `ip`: {error}"
    return f"ip {' '.join(words)}: {done.stderr.strip()}" if done.returncode else None


@pytest.fixture(scope="module")
def interface() -> Iterator[str]:
    """The name of a virtual CAN that is up: the one there is, or one made for these tests."""
    if not hasattr(socket, "AF_CAN"):
        pytest.skip("no AF_CAN in this system")
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        pytest.skip(f"no CAN sockets in this kernel: {error}")
    made = NAME not in [name for _, name in socket.if_nameindex()]
    if made:
        failure = ip("link", "add", NAME, "type", "vcan") or ip("link", "set", NAME, "up")
        if failure is not None:
            pytest.skip(f"no {NAME}, and it cannot be made: {failure}")
    yield NAME
    if made:
        ip("link", "delete", NAME)


@pytest.fixture
def pair(interface) -> Iterator[tuple[Channel, Channel]]:
    settings = ChannelSettings("socketcan", interface)
    here, there = Channel(settings), Channel(settings)
    yield here, there
    here.close()
    there.close()


def test_frames_through_the_kernel(pair):
    here, there = pair
    frames = [
        CanFrame(0x80),
        CanFrame(0x201, bytes(range(8))),
        CanFrame(0x1ABCDEF0, b"\x01", extended=True),
        CanFrame(0x181, remote=True, length=6),
    ]
    here.send(frames)
    got: list[CanFrame] = []
    while len(got) < 4 and (some := there.receive(5.0)):
        got += [frame for _, frame in some]
    assert got == frames
    assert here.receive(0.0) == []


def test_a_burst_fits_the_enlarged_buffer(pair):
    here, there = pair
    granted = channel.enlarge_receive_buffer(there._bus)
    # The kernel accounts some 800 bytes a frame; the default of 208 KiB holds fewer than 400.
    burst = min(600, granted // 1024)
    sent = [CanFrame(k, bytes([k % 256])) for k in range(burst)]
    for frame in sent:
        here.send([frame])
    got: list[CanFrame] = []
    while some := there.receive(0.2):
        got += [frame for _, frame in some]
    assert got == sent


def test_the_state_is_told(pair):
    state = channel.read_state(NAME)
    if state is None:
        pytest.skip("no `ip` to ask")
    assert state.kind == "vcan"
    assert channel.objection(state, NAME, 1_000_000) is None
