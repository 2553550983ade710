"""Goals of arms that are not perfect: none is falsely called reached, and nothing moves to and fro afterwards."""

from __future__ import annotations

import pytest

from stereoservo_sim.experiments.imperfect_arms import FALSE, judged_case, run_imperfect_arms
from stereoservo_sim.tasks.driven_cell import TOLERANCE_PX


@pytest.mark.parametrize("seed", [0, 2])
def test_what_is_called_reached_is_there(seed: int) -> None:
    case = judged_case(seed, "exact", rest_s=2.0)
    assert [goal.outcome for goal in case.goals] == ["reached", "reached"], case
    for goal in case.goals:
        assert max(goal.error_px, goal.later_px) <= FALSE * TOLERANCE_PX, goal
        assert goal.reversals == 0, goal


@pytest.mark.slow
def test_no_goal_is_falsely_called_reached() -> None:
    answer = run_imperfect_arms(seeds=60, model="exact")
    assert not answer["false"]
    assert answer["rows"][2]["count"] == 0
