"""Goals while light and exposure change are reached truly, without false verdicts; the dark is told."""

import pytest

from stereoservo_sim.experiments.changing_light import LIMIT_PX, goal_run


@pytest.mark.parametrize("light", ["all of it", "the same, automatic exposure", "dark for a second"])
def test_a_goal_is_reached_truly_while_light_changes(light):
    run = goal_run(light, 4)
    assert run["end"] == "goal_reached", run
    assert run["error_px"] < LIMIT_PX
    assert run["verdicts"] == set()


def test_a_dark_cell_says_that_it_is_dark():
    run = goal_run("dark, x 0.08", 4)
    assert run["end"] == "refused"
    assert run["told"] == {"camera_dark"}
