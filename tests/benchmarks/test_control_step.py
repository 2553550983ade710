"""Speed of the stereo control step, kernels beside the reference: ``pytest -n 0 tests/benchmarks --benchmark-enable``.

Without that option each runs once and only the results are compared. Figures are medians; times are never asserted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stereoservo_sim.benchmarks.cycle import stereo_problem, with_kernels, with_reference


@pytest.mark.parametrize("step", [with_kernels, with_reference], ids=["kernels", "reference"])
def test_stereo_control_step(benchmark: Any, step: Any) -> None:
    p = stereo_problem()
    velocity = benchmark(step, p)
    np.testing.assert_allclose(velocity, with_reference(p), rtol=1e-9, atol=1e-12)
