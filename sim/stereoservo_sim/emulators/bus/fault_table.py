"""Summary of the trials of one fault as a row of the fault table."""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Sequence

import msgspec
import numpy as np

from stereoservo_sim.emulators.bus.fault_cases import FaultCase
from stereoservo_sim.emulators.bus.fault_trials import RATE_HZ, Trial, run_trial


class FaultRow(msgspec.Struct, frozen=True):
    """Summary of one fault over several trials.

    Times [ms] after the fault. ``detected_cycles``: largest, in cycles of the master. ``codes``: count of each code
    latched first. ``restarts``: trials in which something moved or was powered again by itself.
    """

    protocol: str
    fault: str
    trials: int
    detected_ms_median: float | None
    detected_ms_max: float | None
    detected_cycles: int | None
    rest_ms_median: float | None
    rest_ms_max: float | None
    bound_ms: float | None
    by: str
    codes: dict[str, int]
    restarts: int
    problems: tuple[str, ...]
    ok: bool


def trial_rng(case: FaultCase, protocol: str, seed: int, trial: int) -> np.random.Generator:
    """Random generator of one trial's phase and directions, different for every fault."""
    return np.random.default_rng([seed, trial, zlib.crc32(f"{protocol} {case.name}".encode())])


def run_row(case: FaultCase, protocol: str, trials: int, seed: int, *, run_on_s: float = 1.0) -> FaultRow:
    """Run ``trials`` trials. Raises TrialError."""
    return sum_up(
        case,
        protocol,
        [run_trial(case, protocol, trial_rng(case, protocol, seed, k), run_on_s=run_on_s) for k in range(trials)],
    )


def sum_up(case: FaultCase, protocol: str, trials: Sequence[Trial]) -> FaultRow:
    """Row of a fault's trials. If only the drives detect a fault, a later latch of the master is no detection."""
    seen = [] if case.host in ("killed", "cycle_hangs") else [trial.detected_ms for trial in trials]
    detected_median, detected_max = _median_and_max(seen)
    rest_median, rest_max = _median_and_max([trial.rest_ms for trial in trials])
    problems = tuple(sorted({trial.problem for trial in trials if trial.problem}))
    return FaultRow(
        protocol=protocol,
        fault=case.name,
        trials=len(trials),
        detected_ms_median=detected_median,
        detected_ms_max=detected_max,
        detected_cycles=None if detected_max is None else math.ceil(detected_max * 1e-3 * RATE_HZ),
        rest_ms_median=rest_median,
        rest_ms_max=rest_max,
        bound_ms=case.bound_ms,
        by=case.by,
        codes=dict(Counter(trial.code for trial in trials if trial.code)),
        restarts=sum(trial.restarted for trial in trials),
        problems=problems,
        ok=not problems,
    )


def _median_and_max(values: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Median and maximum of the values that are not None, to 0.01; None if there are none."""
    there = [value for value in values if value is not None]
    if not there:
        return None, None
    return round(float(np.median(there)), 2), round(max(there), 2)
