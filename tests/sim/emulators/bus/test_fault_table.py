"""Every fault of the CAN arm in virtual time: known, at rest within its bound, nothing moves again by itself.

The times are the emulated bus's, not this machine's: the same for the same seed wherever the tests run.
"""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.emulators.bus.fault_trials import (
    CASES,
    CIA402_CASES,
    FaultCase,
    FaultRig,
    Trial,
    run_row,
    run_trial,
    summarize,
    trial_rng,
    trial_speed,
)

ALL = [
    pytest.param(protocol, case, id=f"{protocol}: {case.name}") for protocol, cases in CASES.items() for case in cases
]
RUN_ON_S = 0.15


def check(row) -> None:
    assert not row.problems, row
    assert row.ok
    assert row.restarts == 0
    if row.bound_ms is not None:
        assert row.rest_ms_max <= row.bound_ms
    if row.by == "nobody":
        assert row.codes == {}


@pytest.mark.parametrize(("protocol", "case"), ALL)
def test_a_fault_ends_as_the_table_says(protocol, case):
    check(run_row(case, protocol, 1, seed=0, run_on_s=RUN_ON_S))


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "case"), ALL)
def test_a_fault_ends_as_the_table_says_at_any_phase(protocol, case):
    check(run_row(case, protocol, 12, seed=1))


def case_named(name: str) -> FaultCase:
    (case,) = [case for case in CIA402_CASES if case.name == name]
    return case


def test_a_trial_is_the_same_for_the_same_seed():
    case = CASES["odrive"][0]
    first, again, other = (
        run_trial(case, "odrive", trial_rng(case, "odrive", seed, 0), run_on_s=0.05) for seed in (3, 3, 4)
    )
    assert first == again
    assert first.rest_ms != other.rest_ms


def test_a_master_that_stops_nobody_is_found_out():
    """The trial itself can fail: with quick stops that say "go on", the axes never rest."""
    case = case_named("emergency alone")

    class Deaf(FaultRig):
        def __init__(self, case, protocol) -> None:
            super().__init__(case, protocol)
            codec = self.master.codec
            codec.quick_stop = lambda: codec.command(np.full(6, trial_speed()))

    trial = run_trial(case, "cia402", np.random.default_rng(0), run_on_s=0.05, rig=Deaf)
    assert trial.rest_ms is None
    assert trial.problem == "never at rest"


def test_a_row_tells_its_worst_trial():
    case = case_named("node silent")
    good = Trial(detected_ms=14.0, rest_ms=30.0, code="silent", restarted=False, problem="")
    bad = Trial(detected_ms=19.0, rest_ms=70.0, code="late", restarted=True, problem="at rest after 70.0 ms")
    row = summarize(case, "cia402", [good, good, bad])
    assert (row.detected_ms_median, row.detected_ms_max, row.detected_cycles) == (14.0, 19.0, 5)
    assert (row.rest_ms_median, row.rest_ms_max) == (30.0, 70.0)
    assert row.codes == {"silent": 2, "late": 1}
    assert (row.restarts, row.ok, row.problems) == (1, False, ("at rest after 70.0 ms",))
