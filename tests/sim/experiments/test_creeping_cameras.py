"""A camera creeps while goals are sent: none is called reached beside its place; without a creep none is held."""

from __future__ import annotations

import pytest

from stereoservo_sim.experiments.imperfect_arms import CREEP_FALSE, judged_creep, run_creeping_cameras
from stereoservo_sim.tasks.driven_cell import TOLERANCE_PX


@pytest.mark.parametrize("seed", [10, 15])
def test_a_goal_beside_its_place_is_held_and_the_reason_says_why(seed: int) -> None:
    """Both were called reached 0.41 px and more beside their set-points before the cameras' agreement was asked."""
    (goal,) = judged_creep(seed, creeps=True, goals=1)
    assert goal.crept_px > TOLERANCE_PX, goal
    assert goal.outcome == "aborted", goal
    assert "CAMERAS_DISAGREE" in goal.codes, goal


@pytest.mark.parametrize("seed", [10])
def test_a_healthy_cell_reaches_its_goals(seed: int) -> None:
    for goal in judged_creep(seed, creeps=False, goals=2):
        assert goal.outcome == "reached", goal
        assert goal.error_px <= CREEP_FALSE * TOLERANCE_PX, goal


@pytest.mark.slow
def test_no_goal_is_falsely_called_reached_nor_held() -> None:
    answer = run_creeping_cameras(seeds=40)
    assert not answer["false"]
    assert not answer["held"]
