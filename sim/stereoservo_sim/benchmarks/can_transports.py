"""Benchmark of CAN transports under the cycle of six drives: SYNC and six commands out, twelve replies in."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.channel import Channel, ChannelSettings
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.benchmarks.can_peer import ANSWERS, COMMANDS, LOOP_PRIORITY, SYNC, peer, real_time
from stereoservo_sim.benchmarks.timing import summary

CYCLE = [SYNC, *COMMANDS]
PACED_HZ = 200.0
ANSWER_S = 1.0
"""A cycle without all answers after this is lost."""
STOCK_OPTIONS: dict[str, str | int | float | bool] = {"sleep_after_open": 0}
TRANSPORTS = ("virtual", "slcan_pty", "slcan_tcp", "stock_slcan_pty", "stock_slcan_tcp")
"""``stock``: python-can's own ``slcan``, the baseline."""


class _InlinePeer:
    """The six nodes on python-can's virtual bus, in this process and thread."""

    def __init__(self, settings: ChannelSettings) -> None:
        self._channel = Channel(settings)

    def answer(self) -> None:
        for _, frame in self._channel.receive(0.0):
            if frame == SYNC:
                self._channel.send(ANSWERS)

    def close(self) -> None:
        self._channel.close()


class _Transport:
    """A channel and, where they run in this process, its nodes."""

    def __init__(self, settings: ChannelSettings, inline: bool) -> None:
        self.channel = Channel(settings)
        self._inline = _InlinePeer(settings) if inline else None

    def cycle(self) -> bool:
        """Run one cycle; False where a reply is missing."""
        self.channel.send(CYCLE)
        if self._inline is not None:
            self._inline.answer()
        heard: list[CanFrame] = []
        deadline = time.monotonic() + ANSWER_S
        while len(heard) < len(ANSWERS):
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            heard += [frame for _, frame in self.channel.receive(left)]
        if heard != ANSWERS:
            raise DriverError("bench", f"{self.channel.name}: other answers than were sent: {heard}")
        return True

    def close(self) -> None:
        self.channel.close()
        if self._inline is not None:
            self._inline.close()


@contextmanager
def _line(transport: str) -> Iterator[_Transport]:
    if transport == "virtual":
        line = _Transport(ChannelSettings("virtual", "bench_can"), inline=True)
        try:
            yield line
        finally:
            line.close()
        return
    stock = transport.startswith("stock_")
    with peer("echo", transport.rpartition("_")[2]) as (_, channel):
        settings = ChannelSettings(
            "slcan" if stock else "stereoservo_slcan",
            channel,
            interface_options=STOCK_OPTIONS if stock else {},
        )
        line = _Transport(settings, inline=False)
        try:
            yield line
        finally:
            line.close()


def time_transport(transport: str, seconds: float, paced_cycles: int) -> dict[str, Any]:
    """Time unpaced cycles for ``seconds``, then paced ones. ``latency_ms``: SYNC sent to the last reply."""
    with real_time(LOOP_PRIORITY), _line(transport) as line:
        for _ in range(5):
            line.cycle()
        cycles = lost = 0
        begun, work = time.monotonic(), time.process_time()
        while (spent := time.monotonic() - begun) < seconds:
            lost += not line.cycle()
            cycles += 1
        work = time.process_time() - work
        latencies = _paced(line, paced_cycles)
    figures: dict[str, Any] = {
        "cycles_per_s": round(cycles / spent, 1),
        "cpu_ms_per_cycle": round(work / cycles * 1e3, 4),
        "lost_cycles": lost,
    }
    if latencies:
        figures[f"latency_ms_at_{PACED_HZ:g}_hz"] = summary(latencies, 1e3)
    return figures


def _paced(line: _Transport, cycles: int) -> list[float]:
    """Durations [s] of each complete cycle, at the paced rate or as fast as the transport can."""
    latencies = []
    due = time.monotonic()
    for _ in range(cycles):
        due = max(due + 1.0 / PACED_HZ, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))
        begun = time.monotonic()
        if line.cycle():
            latencies.append(time.monotonic() - begun)
    return latencies
