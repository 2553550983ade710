"""Threads in virtual time, so that what a driver and its bus thread do together is the same on every machine."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator


class VirtualThreads:
    """What modules take from ``time`` and ``threading``, in virtual time.

    One thread runs until it sleeps or ends; then time advances to the end of the earliest sleep, and that thread runs.
    """

    Lock = staticmethod(threading.Lock)

    def __init__(self) -> None:
        self._now_ns = 1_000_000_000
        self._numbers = itertools.count()
        self._asleep: list[tuple[int, int, threading.Event]] = []

    def monotonic_ns(self) -> int:
        return self._now_ns

    def monotonic(self) -> float:
        return self._now_ns * 1e-9

    def sleep(self, seconds: float) -> None:
        woken = self.queue(seconds)
        self.run_next()
        woken.wait()

    def Thread(self, *, target: Callable[[], None], name: str, daemon: bool) -> VirtualThread:
        return VirtualThread(self, target, name, daemon)

    def queue(self, seconds: float) -> threading.Event:
        """An event that is set when so much time has passed."""
        woken = threading.Event()
        heapq.heappush(self._asleep, (self._now_ns + round(seconds * 1e9), next(self._numbers), woken))
        return woken

    def run_next(self) -> None:
        """Advance to the end of the earliest sleep."""
        if self._asleep:
            self._now_ns, _, woken = heapq.heappop(self._asleep)
            woken.set()


class VirtualThread:
    """A thread that runs where all others sleep or have ended."""

    def __init__(self, time: VirtualThreads, target: Callable[[], None], name: str, daemon: bool) -> None:
        self._time = time
        self._target = target
        self._alive = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=daemon)

    def start(self) -> None:
        self._alive = True
        self._begin = self._time.queue(0.0)
        self._thread.start()

    def is_alive(self) -> bool:
        return self._alive

    def join(self) -> None:
        while self._alive:
            self._time.sleep(0.001)

    def _run(self) -> None:
        self._begin.wait()
        try:
            self._target()
        finally:
            self._alive = False
            self._time.run_next()


class VirtualChannel:
    """A CAN channel to emulated drives whose answers are there when they have ended on the bus, whoever runs then."""

    name = "an emulated bus"

    def __init__(self, emulator: BusEmulator, time: VirtualThreads) -> None:
        self._emulator = emulator
        self._time = time

    def send(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            self._emulator.inject(frame, self._time.monotonic_ns())

    def receive(self, timeout_s: float) -> list[tuple[int, CanFrame]]:
        end_ns = self._time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            now = self._time.monotonic_ns()
            self._emulator.run_until(now)
            frames = [(now, frame) for _, frame in self._emulator.delivered()]
            if frames or now >= end_ns:
                return frames
            self._time.sleep((min(max(self._emulator.due_ns(), now + 1), end_ns) - now) * 1e-9)

    def take_errors(self) -> list[tuple[int, object]]:
        return []

    def close(self) -> None:
        pass
