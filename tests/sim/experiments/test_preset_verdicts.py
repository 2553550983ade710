"""Arms at work with shipped mechanics: the watch finds nothing where nothing has happened."""

from __future__ import annotations

import pytest

from stereoservo_sim.experiments.imperfect_arms import watched_preset
from stereoservo_sim.world.mechanics import PRESETS


@pytest.mark.slow
@pytest.mark.parametrize("name", list(PRESETS))
def test_no_verdict_where_nothing_has_happened(name: str) -> None:
    found = watched_preset(0, name, minutes=1.0)
    assert (found.code, found.verdicts, list(found.ends)) == ("", (), ["goal_reached"])
    assert found.minutes >= 1.0
