"""Goals from singular postures, in the servo core: what stood still until its time limit."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.experiments.singularities import judged_singular, run_singularities, singular_case
from stereoservo_sim.world.exact_model import twists

STOOD_STILL = (0, 2, 8, 12)
"""Cases in which the laws before `damped_step` ended by the time limit: wrist and shoulder, 0 to 0.33 degrees off."""
TURNED = (57, 62)
"""Cases in which exact steps beside the singularity turn two joints by half a turn against each other."""


@pytest.mark.parametrize("law", ["cartesian3", "cartesian2"])
@pytest.mark.parametrize("seed", STOOD_STILL + TURNED)
def test_cartesian_laws_leave_singularities(seed: int, law: str) -> None:
    (verdict,) = judged_singular(seed, (law,))
    assert verdict.outcome == "reached", verdict


@pytest.mark.parametrize("seed", range(9))
def test_cases_are_singular(seed: int) -> None:
    cell, start, _, offset = singular_case(seed)
    values = np.linalg.svd(twists(cell, start).reshape(6, 16), compute_uv=False)
    assert values[5] < 2.0 * max(abs(offset), 1e-6)


@pytest.mark.slow
def test_no_time_outs_near_singularities() -> None:
    answer = run_singularities(seeds=60)
    assert sum(row["time_outs"] for row in answer["rows"]) == 0, answer["lost"]
    assert not answer["lost"]
