"""Faults while a moving target is followed are named; a joint zero that creeps before carried cameras is not, and is no
moved camera either.
"""

from __future__ import annotations

import pytest

from stereoservo_sim.experiments.moving_targets import (
    CELLS,
    FAULTS,
    STANDING,
    Fault,
    disturb,
    run_moving_faults,
)

UNSEEN: Fault = "joint zero drifts"


@pytest.mark.parametrize("place", CELLS)
@pytest.mark.parametrize("fault", FAULTS)
def test_what_happens_while_a_target_is_followed_is_named(place: str, fault: Fault) -> None:
    found = disturb(place, fault, "20 mm/s", 1)
    assert found.early == ()
    if fault == UNSEEN and place != STANDING:
        assert found.verdict == ""  # as a target that moves otherwise looks the same
    else:
        assert found.right, found
        assert found.delay_s < 0.5


@pytest.mark.slow
def test_faults_are_named_over_seeds() -> None:
    answer = run_moving_faults(seeds=10, seed=100, progress=lambda *_: None)
    assert answer["false_verdicts"] == 0
    for row in answer["rows"]:
        if row["fault"] == UNSEEN and row["cameras"] != STANDING:
            assert row["wrong"] == 0, row
        else:
            assert row["right"] >= 9, row
