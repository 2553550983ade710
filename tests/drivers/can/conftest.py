"""Adapters for serial-line CAN in a thread: over TCP and over a pseudo terminal."""

from __future__ import annotations

import os
import pty
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator

import pytest
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.slcan_adapter import SlcanAdapter


class AdapterThread:
    """Serves one host at a time: sends back what arrives (``echo``) and whatever is put in ``to_host``."""

    def __init__(self, channel: str, accept: Callable[[], int], release: Callable[[int], None]) -> None:
        self.channel = channel
        self.adapter = SlcanAdapter()
        self.echo = True
        self.received: list[CanFrame] = []
        self._accept = accept
        self._release = release
        self._wake, self._waker = os.pipe()
        self._to_host: list[bytes] = []
        self._unplug = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def to_host(self, content: bytes) -> None:
        """Raw bytes to the host."""
        self._to_host.append(content)
        os.write(self._waker, b"x")

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Give the thread time; fails where the condition does not come true."""
        deadline = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < deadline, "the adapter's thread did not get there"
            time.sleep(0.002)

    def unplug(self) -> None:
        """Be gone; returns when it is."""
        self._unplug.set()
        os.write(self._waker, b"x")
        self._thread.join(5.0)

    def _serve(self) -> None:
        fd = self._accept()
        while not self._unplug.is_set():
            ready = select.select([fd, self._wake], [], [])[0]
            if self._wake in ready:
                os.read(self._wake, 100)
                while self._to_host:
                    os.write(fd, self._to_host.pop(0))
            if fd in ready:
                try:
                    chunk = os.read(fd, 4096)
                except OSError:
                    break
                if not chunk:
                    break
                frames, answer = self.adapter.feed(chunk)
                self.received += frames
                os.write(fd, answer + (self.adapter.deliver(frames) if self.echo else b""))
        self._release(fd)


def over_tcp() -> AdapterThread:
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(10.0)

    def accept() -> int:
        connection, _ = server.accept()
        server.close()
        connection.setblocking(True)
        return connection.detach()

    return AdapterThread(f"socket://127.0.0.1:{server.getsockname()[1]}", accept, os.close)


def over_pty() -> AdapterThread:
    master, slave = pty.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)

    def release(fd: int) -> None:
        os.close(slave)
        os.close(fd)

    return AdapterThread(name, lambda: master, release)


@pytest.fixture(params=["tcp", "pty"])
def adapter(request: pytest.FixtureRequest) -> Iterator[AdapterThread]:
    served = over_tcp() if request.param == "tcp" else over_pty()
    yield served
    served.unplug()


@pytest.fixture
def tcp_adapter() -> Iterator[AdapterThread]:
    served = over_tcp()
    yield served
    served.unplug()


@pytest.fixture
def pty_adapter() -> Iterator[AdapterThread]:
    served = over_pty()
    yield served
    served.unplug()


def _frames() -> SearchStrategy[CanFrame]:
    @st.composite
    def frame(draw: st.DrawFn) -> CanFrame:
        extended, remote = draw(st.booleans()), draw(st.booleans())
        number = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
        if remote:
            return CanFrame(number, b"", True, extended, draw(st.integers(0, 8)))
        return CanFrame(number, draw(st.binary(max_size=8)), False, extended)

    return frame()


FRAMES = _frames()


@pytest.fixture(scope="session")
def any_frame() -> SearchStrategy[CanFrame]:
    """Strategy of classical frames, for ``data.draw``."""
    return FRAMES
