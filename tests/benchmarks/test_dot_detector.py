"""Speed of the dot detector beside one labelling pass of OpenCV: ``pytest -n 0 tests/benchmarks --benchmark-enable``.

With that option the ratio of the fastest of interleaved calls is held, which load does not change; times are never
asserted. Without it each runs once and only what is found is compared.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from stereoservo_sim.benchmarks.features import IMAGES, Pictures, pictures

LIMITS = {"cold": 2.0, "track": 0.36, "track_two": 0.26}
"""Largest ratios to threshold and labelling of the whole image: a third above what is measured."""


def fastest(call: Callable[[int], object], baseline: Callable[[int], object], repetitions: int) -> float:
    """Ratio of the two calls' fastest times, taken in turn."""
    times = np.full((2, repetitions), np.inf)
    for k in range(repetitions):
        for row, function in enumerate((call, baseline)):
            at = time.perf_counter()
            function(k)
            times[row, k] = time.perf_counter() - at
    own, other = times.min(axis=1)
    return float(own / other)


@pytest.fixture(scope="module")
def shown() -> Pictures:
    return pictures(0, lambda *_: None)


@pytest.mark.parametrize("what", LIMITS)
def test_dots_beside_a_labelling_pass(benchmark: Any, shown: Pictures, what: str) -> None:
    call = getattr(shown, what)
    found = benchmark(call, 0)
    ids = [observation.ids for observation in (found if isinstance(found, list) else [found])]
    for k, seen in enumerate(ids):
        expected = shown.fours[k].ids if what == "track_two" else shown.priors[k].ids
        np.testing.assert_array_equal(seen, expected)
    if benchmark.enabled:
        assert fastest(call, shown.label, 50 * IMAGES) < LIMITS[what]
