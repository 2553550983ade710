"""``reproduce unsynchronised``: cameras without a trigger cost no accuracy."""

from __future__ import annotations

import json

import pytest

from stereoservo.cli import main as cli
from stereoservo_sim.experiments.unsynchronised import CONDITIONS, SKEW_S, WRONG_S, cell_of


def test_the_conditions_differ_in_shutters_and_stamps_alone() -> None:
    cells = [cell_of(condition) for condition in CONDITIONS]
    for cell, condition in zip(cells, CONDITIONS, strict=True):
        left, right = (camera.options for camera in cell.camera)
        assert right["phase_s"] - left["phase_s"] == condition.skew_s
        assert left["told_latency_s"] == right["told_latency_s"] == condition.told_s
    assert [condition.skew_s for condition in CONDITIONS] == [0.0, SKEW_S, SKEW_S, SKEW_S]
    errors = [condition.told_s - CONDITIONS[0].told_s for condition in CONDITIONS]
    assert errors == pytest.approx([0.0, 0.0, -WRONG_S, WRONG_S])


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_without_a_trigger_goals_are_reached_as_well(capsys: pytest.CaptureFixture[str]) -> None:
    """A ratio is a median over six pairs of the same noise and different ways; 1.25 is thrice its scatter."""
    assert cli.invoke(["reproduce", "unsynchronised", "--seeds", "2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["reached"] for row in rows] == ["6 of 6"] * 4
    assert rows[1]["final_error_px_ratio"] <= 1.25
    assert rows[1]["line_deviation_mm_ratio"] <= 1.25
    for row in rows[2:]:
        assert row["innovation_px"]["median"] > 2.0 * rows[1]["innovation_px"]["median"]
