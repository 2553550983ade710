"""Peer processes of ``bench can``: an adapter with six replying nodes, emulated drives, an empty loop.

Run as a module with ``echo tcp|pty``, ``drives OPTIONS`` (JSON) or ``empty RATE_HZ SECONDS``. The first line on stdout
states the listening address; they end with their stdin. The empty loop prints ``ready`` and starts with a line on
stdin.
"""

from __future__ import annotations

import json
import os
import pty
import select
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import msgspec

from stereoservo.daemon.pacing import realtime_for_a_while
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.slcan_adapter import SlcanAdapter
from stereoservo_drivers.canopen.options import CanOptions

AXES = 6
SYNC = CanFrame(0x80)
COMMANDS = [CanFrame(0x200 + node, bytes(6)) for node in range(1, AXES + 1)]
ANSWERS = [
    CanFrame(base + node, bytes(length)) for base, length in ((0x180, 6), (0x280, 4)) for node in range(1, AXES + 1)
]
"""Replies to a SYNC: status word and position, then velocity."""
ENDING_S = 10.0
LOOP_PRIORITY, DRIVES_PRIORITY = 50, 5
"""SCHED_FIFO priority of the driver's process and the empty loop (the default of a cell), and of the emulated drives.
"""


@contextmanager
def real_time(priority: int) -> Iterator[str]:
    """Set SCHED_FIFO for this thread, as the daemon does, where permitted; returns the scheduling as text."""
    with realtime_for_a_while(priority) as refused:
        yield "ordinary scheduling: SCHED_FIFO is not allowed here" if refused else f"SCHED_FIFO {priority}"


@contextmanager
def peer(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Context manager that runs one of these processes; yields it and its first line."""
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        if not line:
            raise RuntimeError(f"the process {' '.join(words)!r} of the bench ended at once; its message is above")
        yield process, line
    finally:
        if process.stdin is not None and not process.stdin.closed:
            process.stdin.close()
        try:
            process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def serve_echo(kind: str) -> None:
    """Serve an adapter whose bus has six nodes that reply to every SYNC."""
    if kind == "tcp":
        with socket.create_server(("127.0.0.1", 0)) as server:
            print(f"socket://127.0.0.1:{server.getsockname()[1]}", flush=True)
            connection, _ = server.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        fd = connection.detach()
    else:
        fd, slave = pty.openpty()
        tty.setraw(slave)
        print(os.ttyname(slave), flush=True)
    with real_time(DRIVES_PRIORITY), suppress(ConnectionError):  # the host may disconnect before it has read everything
        _answer_syncs(fd)


def _answer_syncs(fd: int) -> None:
    adapter = SlcanAdapter()
    while True:
        ready = select.select([fd, sys.stdin], [], [])[0]
        if sys.stdin in ready:
            return
        chunk = os.read(fd, 8192)
        if not chunk:
            return
        frames, answer = adapter.feed(chunk)
        for _ in range(frames.count(SYNC)):
            answer += adapter.deliver(ANSWERS)
        os.write(fd, answer)


def serve_drives(text: str) -> None:
    """Serve emulated drives with an ideal plant on a free TCP port. ``text``: ``{"bit_time": …, "options": …}``."""
    from stereoservo_sim.emulators.bus.bus_server import BusServer, open_endpoint
    from stereoservo_sim.emulators.bus.factory import DrivesSettings, make_bus_emulator

    wanted: dict[str, Any] = json.loads(text)
    options = msgspec.convert(wanted["options"], CanOptions)
    settings = DrivesSettings(plant="ideal", bit_time=wanted["bit_time"])
    emulator = make_bus_emulator(options, settings, t_ns=time.monotonic_ns())
    server = BusServer(emulator, open_endpoint("socket://127.0.0.1:0", options.bitrate))
    ended = False

    def end() -> None:
        nonlocal ended
        ended = True

    server.watch(sys.stdin.fileno(), end)
    print(server.channel, flush=True)
    with real_time(DRIVES_PRIORITY):
        server.run(lambda: ended)


def empty_loop(rate_hz: float, seconds: float) -> dict[str, Any]:
    """Run a loop that only waits for absolute deadlines: its lateness [µs], and the slots it missed.

    A slot counts as missed as in the drivers' bus thread: when more than half of its period is over.
    """
    period = round(1e9 / rate_hz)
    slots = round(rate_hz * seconds)
    first = time.monotonic_ns() + period
    slot = missed = 0
    lateness = []
    while slot < slots:
        due = first + slot * period
        left = due - time.monotonic_ns()
        if left > 0:
            time.sleep(left * 1e-9)
        late = time.monotonic_ns() - due
        lateness.append(late * 1e-3)
        skipped = max(-(-(late - period // 2) // period), 0)
        missed += skipped
        slot += 1 + skipped
    return {"slots": slots, "missed": missed, "lateness_us": lateness}


def _main(words: list[str]) -> None:
    if words[0] == "echo":
        serve_echo(words[1])
    elif words[0] == "drives":
        serve_drives(words[1])
    else:
        print("ready", flush=True)
        sys.stdin.readline()
        with real_time(LOOP_PRIORITY):
            figures = empty_loop(float(words[1]), float(words[2]))
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    _main(sys.argv[1:])
