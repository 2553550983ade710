"""`stereoservo bench can`: figures that are there and hang together; how large they are is nobody's promise here."""

import itertools

import pytest

from stereoservo_drivers.can.load import cycle_load
from stereoservo_sim.benchmarks import can, can_peer
from stereoservo_sim.benchmarks.can import (
    LENGTHS,
    bench_options,
    fastest_paced,
    run_drives,
    saturate,
    time_transport,
)
from stereoservo_sim.benchmarks.can_peer import ANSWERS, COMMANDS, SYNC, empty_loop, peer


def test_the_cycle_is_the_one_of_the_bus_limit():
    assert [len(frame.data) for frame in (SYNC, *COMMANDS, *ANSWERS)] == [0] + [6] * 12 + [4] * 6
    assert sorted(LENGTHS) == sorted(len(frame.data) for frame in (SYNC, *COMMANDS, *ANSWERS))
    assert cycle_load(LENGTHS, 1.0, 1_000_000).max_rate_hz == pytest.approx(498.75, abs=0.01)
    assert bench_options(400.0).feedback == ("velocity",)


@pytest.mark.parametrize("transport", ["virtual", "slcan_tcp", "slcan_pty", "stock_slcan_pty"])
def test_transports_lose_nothing(transport):
    figures = time_transport(transport, 0.05, 5)
    assert figures["lost_cycles"] == 0
    assert figures["cycles_per_s"] > 0
    assert figures["cpu_ms_per_cycle"] > 0
    assert figures["latency_ms_at_200_hz"]["repetitions"] == 5


def test_empty_loop_counts_slots_whose_half_is_over(monkeypatch):
    now = 0
    # How late [in periods of 10 ms] each wait ends: the third skips one slot, the fourth none, the fifth two.
    late = iter([0.0, 0.4, 0.7, 0.0, 2.1, 0.0])

    def sleep(seconds):
        nonlocal now
        now += round(seconds * 1e9) + round(next(late) * 10_000_000)

    monkeypatch.setattr(can_peer.time, "sleep", sleep)
    monkeypatch.setattr(can_peer.time, "monotonic_ns", lambda: now)
    figures = empty_loop(100.0, 0.09)
    assert figures["missed"] == 3
    assert figures["slots"] == 9
    assert len(figures["lateness_us"]) == 9 - 3
    assert max(figures["lateness_us"]) == pytest.approx(21_000.0)


def test_a_peer_that_fails_is_told():
    with pytest.raises(RuntimeError, match="ended at once"), peer("echo"):
        pass


@pytest.mark.process
def test_six_drives_beside_an_empty_loop():
    figures = run_drives(100.0, 0.5, bit_time=False)
    if figures["fault"] is not None:  # a machine that stalls trips the driver's monitors; that is a figure too
        assert set(figures["fault"]) == {"code", "message"}
        return
    assert figures["cycles"] + figures["skipped_cycles"] == pytest.approx(100.0 * figures["seconds"], abs=8)
    assert figures["cpu_ms_per_cycle"]["bus_thread"] <= figures["cpu_ms_per_cycle"]["process"]
    assert figures["empty_loop"]["slots"] == 50
    assert "SCHED_FIFO" in figures["scheduling"]


@pytest.mark.process
def test_back_to_back_cycles_with_bit_times_are_no_faster_than_their_bits():
    figures = saturate(0.3)
    assert 0.0 < figures["bus_busy"] <= 1.0
    assert figures["worst_case_limit_per_s"] == 498.8
    assert figures["cycles_per_s"] > 0.0


def test_the_fastest_rate_is_the_highest_that_was_held(monkeypatch):
    trials = itertools.cycle(
        [
            {"fault": None, "cycles": 400, "incomplete_cycles": 0, "seconds": 1.0},
            {"fault": None, "cycles": 450, "incomplete_cycles": 3, "seconds": 1.0},
            {"fault": None, "cycles": 460, "incomplete_cycles": 20, "seconds": 1.0},
            {"fault": {"code": "bus_silent", "message": ""}, "seconds": 0.0},
        ]
    )
    monkeypatch.setattr(can, "run_drives", lambda rate_hz, seconds, bit_time: dict(next(trials)))
    found = fastest_paced([400.0, 450.0, 460.0, 470.0], 1.0)
    assert found["held_hz"] == 450.0
    assert found["held_share_of_limit"] == pytest.approx(0.902, abs=0.001)
    assert len(found["trials"]) == 4
