"""Time in contract tests: virtual where the device simulates, real where it does not; measured call budgets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.ports.devices import DriverContext
from stereoservo_drivers.kit.bench import Paced, call_times_us


class PacedSuite(Paced):
    """Common base of the contract tests. Override :attr:`real_time` and :meth:`make_context` where a device needs
    it.
    """

    @pytest.fixture
    def context(self, tmp_path: Path) -> DriverContext:
        """A context of its own for each test."""
        return self.make_context(tmp_path)


def measure(
    calls: int, call: Callable[[], Any], before: Callable[[], Any] = lambda: None
) -> dict[str, float]:
    """Median, 99th percentile and maximum [us] of ``calls`` calls, each after an untimed ``before``."""
    times = call_times_us(calls, call, before)
    median, p99 = np.percentile(times, [50, 99])
    return {"median_us": float(median), "p99_us": float(p99), "max_us": float(times.max())}


def report_budget(
    record: Callable[[str, object], None], name: str, budget_us: float, **calls: dict[str, float]
) -> None:
    """Print call times beside the declared budget, and add them to the JUnit report; without an assertion, since
    machines stall.
    """
    for call, figures in calls.items():
        text = ", ".join(f"{key[:-3]} {value:.0f}" for key, value in figures.items())
        print(f"{name}.{call}: {text} us; declared budget {budget_us:.0f} us")
        record(f"{name}.{call}", figures)
    record(f"{name}.call_budget_us", budget_us)
