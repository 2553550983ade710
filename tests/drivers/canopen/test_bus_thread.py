"""The grid of the bus thread's cycles, and what the thread does with frames that it reads late."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen import bus_thread
from stereoservo_drivers.canopen.bus_thread import BusThread, next_slot

from .virtual_threads import VirtualThreads

MS = 1_000_000


def test_in_time_every_slot_is_served() -> None:
    assert next_slot(100 * MS, 100 * MS + 60_000, 4 * MS) == (104 * MS, 0)
    assert next_slot(100 * MS, 102 * MS, 4 * MS) == (104 * MS, 0)


def test_a_slot_that_is_nearly_over_is_left_out() -> None:
    assert next_slot(100 * MS, 103 * MS, 4 * MS) == (108 * MS, 1)
    assert next_slot(100 * MS, 141 * MS, 4 * MS) == (144 * MS, 10)


@given(slot=st.integers(0, 10**15), late=st.integers(0, 10**9), period=st.integers(10**6, 10**8))
def test_the_first_slot_of_the_grid_that_leaves_half_a_period(slot: int, late: int, period: int) -> None:
    now = slot + late
    chosen, skipped = next_slot(slot, now, period)
    assert (chosen - slot) % period == 0
    assert chosen == slot + (1 + skipped) * period
    assert chosen >= now + period // 2
    assert skipped == 0 or chosen - period < now + period // 2


class StallingChannel:
    """Answers 3 ms after each poll, to a reader that loses its processor for 5 ms where it finds nothing."""

    def __init__(self, bus: Any, time: VirtualThreads) -> None:
        self._bus = bus
        self._time = time
        self._polled_ns = 0
        self._answers: list[CanFrame] = []

    def send(self, frames: list[CanFrame]) -> None:
        if frames != self._bus.codec.heartbeat():
            self._polled_ns = self._time.monotonic_ns()
            self._answers = [frame for _, frame in self._bus.answers_now()]

    def receive(self, timeout_s: float) -> list[tuple[int, CanFrame]]:
        now = self._time.monotonic_ns()
        if not self._answers or now < self._polled_ns + 3 * MS:
            self._time.sleep(0.005)
            return []
        answers, self._answers = self._answers, []
        return [(now, frame) for frame in answers]

    def close(self) -> None:
        pass


def test_answers_that_came_while_the_thread_did_not_run_belong_to_the_cycle_that_ends(
    make_bus: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    time, bus = VirtualThreads(), make_bus()
    monkeypatch.setattr(bus_thread, "time", time)
    monkeypatch.setattr(bus_thread, "threading", time)
    thread = BusThread(StallingChannel(bus, time), bus.master)  # type: ignore[arg-type]
    thread.begin_cycle()
    time.sleep(0.1)
    thread.end()
    statistics = bus.master.statistics
    assert thread.statistics.late_max_ns >= MS
    assert statistics.cycles >= 10
    assert statistics.incomplete == 0
