"""Faults of the bus and of encoders, as the master sees them over a scripted protocol."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.master import LatenessMonitor

MS = 1_000_000


def until_latched(bus, limit: int, *velocities: float) -> int:
    """Cycles until a fault latches."""
    for count in range(limit):
        if bus.master.fault is not None:
            return count
        bus.run(*velocities)
    raise AssertionError(f"no fault within {limit} cycles")


def without(*ids: int):
    return lambda cycle, answers: [(delay, f) for delay, f in answers if f.id not in ids]


def test_one_lost_frame_is_counted_and_tolerated(bus) -> None:
    bus.enable()
    bus.answers = without(0x182)
    bus.run(0.1, 0.1)
    bus.answers = None
    bus.run(0.1, 0.1, cycles=50)
    assert bus.master.fault is None
    assert bus.master.statistics.lost == 1
    assert bus.master.statistics.incomplete == 1


def test_as_many_misses_as_allowed_are_tolerated_again_and_again(bus) -> None:
    bus.enable()
    bus.answers = lambda cycle, answers: answers if cycle % 4 == 0 else answers[1:]
    bus.run(0.1, 0.1, cycles=80)
    bus.cycle()
    assert bus.master.fault is None
    assert bus.master.statistics.lost == 60


@pytest.mark.parametrize("ids", [(0x182,), (0x282,), (0x182, 0x282)])
def test_a_silent_node_latches_after_the_allowed_misses(bus, ids: tuple[int, ...]) -> None:
    bus.enable()
    bus.answers = without(*ids)
    assert until_latched(bus, 20, 0.1, 0.1) == 5  # four cycles without, seen by the fifth tick
    fault = bus.master.fault
    assert (fault.code, fault.axis, fault.value, fault.limit) == ("silent", "j2", 4, 3)
    assert "node 2" in fault.message
    assert "4 cycles (16 ms), limit 3" in fault.message
    assert bus.orders[-1][0] == "quick stop"


@pytest.mark.parametrize("survivors", [0, 1, 3])
def test_a_cable_that_is_out_is_not_blamed_on_one_node(bus, survivors: int) -> None:
    bus.enable()
    bus.answers = lambda cycle, answers: answers[:survivors]  # it broke in the middle of a cycle
    bus.run(0.1, 0.1)
    bus.answers = lambda cycle, answers: []
    until_latched(bus, 20, 0.1, 0.1)
    assert bus.master.fault.code == "bus_silent"
    assert "cable" in bus.master.fault.hint


def twice(cycle: int, answers: list) -> list:
    return [item for item in answers for _ in range(2 if item[1].id == 0x181 else 1)]


def test_two_answers_in_three_cycles_in_a_row_are_two_drives(bus) -> None:
    bus.enable()
    bus.answers = twice
    assert until_latched(bus, 20, 0.1, 0.1) == 4
    assert (bus.master.fault.code, bus.master.fault.axis) == ("duplicate", "j1")


def test_answers_that_were_held_up_are_not_two_drives(bus) -> None:
    """Two cycles bring nothing, the next two bring two answers each: an adapter or host that was held up."""
    bus.enable()

    def held_up(cycle: int, answers: list) -> list:
        return [item for item in answers for _ in range((0, 0, 2, 2, 1)[cycle % 5])]

    bus.answers = held_up
    bus.run(0.1, 0.1, cycles=100)
    assert bus.master.fault is None
    assert bus.master.statistics.doubled >= 150


def test_two_drives_are_seen_soon_after_a_frame_was_lost(bus) -> None:
    bus.enable()
    bus.answers = without(0x181)
    bus.run(0.1, 0.1, cycles=2)
    bus.answers = twice
    assert until_latched(bus, 20, 0.1, 0.1) <= 6
    assert bus.master.fault.code == "duplicate"


def test_doubles_now_and_then_are_not(bus) -> None:
    bus.enable()
    bus.answers = lambda cycle, answers: twice(cycle, answers) if cycle % 3 else answers
    bus.run(0.1, 0.1, cycles=60)
    bus.cycle()
    assert bus.master.fault is None
    assert bus.master.statistics.doubled == 40


def test_answers_that_were_held_up_and_come_with_later_ones_are_no_doubles(bus) -> None:
    """A host that stalls: nothing for some cycles, then two at a time until all have come."""
    bus.enable()
    bus.run(0.1, 0.1, cycles=4)

    def held_up(cycle: int, answers: list) -> list:
        phase = cycle % 40
        return [] if phase < 3 else answers * 2 if phase < 6 else answers

    bus.answers = held_up
    bus.run(0.1, 0.1, cycles=200)
    assert bus.master.fault is None
    assert bus.master.statistics.doubled > 0
    # Old losses excuse nobody.
    bus.answers = lambda cycle, answers: answers
    bus.run(0.1, 0.1, cycles=40)
    bus.answers = twice
    assert until_latched(bus, 20, 0.1, 0.1) == 4


def delayed(axis_ids: tuple[int, ...], by_ns: int, jitter: np.random.Generator | None = None):
    def change(cycle: int, answers: list) -> list:
        return [
            (
                delay + (by_ns if f.id in axis_ids else 0) + (int(jitter.integers(0, 400_000)) if jitter else 0),
                f,
            )
            for delay, f in answers
        ]

    return change


@pytest.mark.parametrize("by_ms", [1.4, 2.0, 6.0, 10.0])
def test_a_node_that_is_constantly_late_is_seen_by_its_phase(bus, by_ms: float) -> None:
    rng = np.random.default_rng(3)
    bus.answers = delayed((), 0, rng)
    bus.enable()
    bus.run(0.1, 0.1, cycles=120)
    bus.answers = delayed((0x182, 0x282), round(by_ms * MS), rng)
    assert until_latched(bus, 45, 0.1, 0.1) <= 31
    # More than three periods late, the first answers miss for longer than is allowed.
    assert (bus.master.fault.code, bus.master.fault.axis) == ("late", "j2")


EVERYBODY = (0x181, 0x281, 0x182, 0x282)


@pytest.mark.parametrize("by_ms", [1.2, 2.5])
def test_jitter_and_delays_that_all_have_in_common_do_not_stop_the_arm(bus, by_ms: float) -> None:
    rng = np.random.default_rng(4)
    bus.answers = delayed((), 0, rng)
    bus.enable()
    bus.run(0.1, 0.1, cycles=120)
    bus.answers = delayed(EVERYBODY, round(by_ms * MS), rng)
    bus.run(0.1, 0.1, cycles=200)
    assert bus.master.fault is None
    assert bus.master.statistics.answered_ns > by_ms * MS


def test_one_axis_that_is_late_in_every_other_cycle_is_a_busy_host(bus) -> None:
    bus.enable()
    bus.run(0.1, 0.1, cycles=120)
    late = delayed((0x182, 0x282), 2_000_000)
    bus.answers = lambda cycle, answers: late(cycle, answers) if cycle % 2 else answers
    bus.run(0.1, 0.1, cycles=200)
    assert bus.master.fault is None


@pytest.mark.parametrize("by_ms", [1.5, 2.5])
def test_an_only_drive_is_compared_with_itself(make_bus, by_ms: float) -> None:
    bus = make_bus(1)
    bus.enable()
    bus.run(0.1, cycles=120)
    bus.answers = delayed((0x181, 0x281), round(by_ms * MS))
    bus.run(0.1, cycles=40)
    assert (bus.master.fault is not None) == (by_ms > 2.0)


def test_a_slow_start_is_no_baseline(bus) -> None:
    bus.answers = delayed((0x181, 0x281, 0x182, 0x282), 2_500_000)
    bus.cycle(30)
    bus.answers = None
    bus.cycle(90)
    assert bus.master.fault is None
    bus.answers = delayed((0x182, 0x282), 1_500_000)
    bus.cycle(40)
    assert bus.master.fault.code == "late"


def test_a_babbling_node_is_named(bus) -> None:
    bus.enable()
    flood = [(k * 100_000, CanFrame(0x123, bytes(8))) for k in range(30)]
    bus.answers = lambda cycle, answers: answers + flood
    assert until_latched(bus, 20, 0.1, 0.1) <= 11
    assert bus.master.fault.code == "bus_flood"
    assert "0x123" in bus.master.fault.message


def test_what_all_nodes_say_after_a_stall_is_no_flood(bus) -> None:
    bus.enable()
    burst = [(k * 20_000, CanFrame(0x701 + k % 12, b"\x05")) for k in range(150)]
    bus.answers = lambda cycle, answers: answers + (burst if cycle % 10 == 0 else [])
    bus.run(0.1, 0.1, cycles=60)
    assert bus.master.fault is None


def test_service_traffic_is_no_flood(bus) -> None:
    bus.enable()
    some = [(k * 400_000, CanFrame(0x581, bytes(8))) for k in range(8)]
    bus.answers = lambda cycle, answers: answers + some
    bus.run(0.1, 0.1, cycles=100)
    assert bus.master.fault is None
    assert bus.master.statistics.foreign == 800


def test_a_position_that_jumps(bus) -> None:
    bus.enable()
    bus.run(0.5, 0.5, cycles=20)
    bus.positions = bus.positions + np.array([0.0, 0.05])
    assert until_latched(bus, 5, 0.5, 0.5) <= 2
    assert (bus.master.fault.code, bus.master.fault.axis) == ("encoder_jump", "j2")


def test_full_speed_after_tolerated_misses_is_no_jump(bus) -> None:
    bus.enable()
    bus.answers = lambda cycle, answers: answers if cycle % 4 == 0 else answers[1:]
    bus.run(1.0, -1.0, cycles=100)
    assert bus.master.fault is None


def test_answers_that_are_read_late_by_a_busy_computer_are_no_jump(bus) -> None:
    """They count three cycles after they were measured; the next set comes at once after them."""
    bus.enable()
    held: list = []

    def late(cycle: int, answers: list) -> list:
        phase = cycle % 8
        if phase == 0:
            held[:] = answers
            return []
        if phase in (1, 2):
            return []
        return held if phase == 3 else answers

    bus.answers = late
    bus.run(1.0, -1.0, cycles=100)
    assert bus.master.fault is None
    bus.answers = lambda cycle, answers: answers
    bus.run(1.0, -1.0, cycles=8)
    bus.positions = bus.positions + np.array([0.0, 0.05])
    assert until_latched(bus, 5, 1.0, -1.0) <= 2


def reversed_axis(bus):
    """The second axis counts backwards from where it stands now."""
    pivot = float(bus.positions[1])

    def change(cycle: int, answers: list) -> list:
        mirrored = struct.pack("<Bf", bus.on[1], 2 * pivot - bus.positions[1])
        return [(d, CanFrame(f.id, mirrored) if f.id == 0x182 else f) for d, f in answers]

    return change


@pytest.mark.parametrize("speed", [1.0, 0.05, -0.02])
def test_an_encoder_that_runs_against_its_command(bus, speed: float) -> None:
    bus.enable()
    bus.answers = reversed_axis(bus)
    count = until_latched(bus, 60, speed, speed)
    assert count * bus.period_ns < 200 * MS
    assert (bus.master.fault.code, bus.master.fault.axis) == ("encoder_reversed", "j2")


def test_a_command_that_turns_about_is_no_reversed_encoder(make_bus) -> None:
    """Axes that ramp at their acceleration, and some cycles after their command, to and fro."""
    bus = make_bus(max_acceleration=4.0)
    bus.enable()
    actual = np.zeros(2)
    past = [np.zeros(2)] * 5  # 20 ms behind
    for cycle in range(600):
        target = np.array([0.6, -0.3]) * (1 if cycle // 75 % 2 == 0 else -1)
        bus.command(*target)
        past.append(target)
        actual = actual + np.clip(past.pop(0) - actual, -0.016, 0.016)
        before = bus.positions
        bus.cycle()
        bus.velocities = actual
        bus.positions = before + actual * 0.004
        assert bus.master.fault is None, (cycle, bus.master.fault)


def test_an_arm_at_rest_that_is_pushed_is_no_reversed_encoder(bus) -> None:
    bus.enable()
    for _ in range(100):
        bus.run(0.0, 0.0)
        bus.positions = bus.positions + 0.0005
    assert bus.master.fault is None


@pytest.mark.parametrize("told", [True, False])
def test_frames_a_cycle_late_after_a_miss_make_no_baseline(told: bool) -> None:
    """Told of nothing owed, the monitor takes the late frames of a bus that was overloaded at first for early ones."""
    monitor = LatenessMonitor(("a", "b", "c"), (0, 1, 2), 4 * MS)
    trips = []
    for cycle in range(200):
        monitor.arrivals[:] = [MS // 10 if cycle < 20 else 3 * MS, MS, MS]
        trips.append(monitor.end_cycle(cycle < 20 and told))
    tripped = [trip.bit for trip in trips if trip is not None]
    assert tripped == [] if told else set(tripped) == {0}
