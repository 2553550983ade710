"""`ik` on the model that the arm has learnt, and a goal reached in the posture that was chosen from its list."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from stereoservo.cli import main as cli
from stereoservo.client import Client

from .conftest import CELL

pytestmark = pytest.mark.process

SAME_RAD = 0.1
"""Of one posture. A goal is reached within its tolerance, and 0.5 px are some hundredths of a radian of a wrist's axes;
other postures are beyond 2 rad."""


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert cli.invoke([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def apart(client: Client, row: Any) -> float:
    """Largest distance of a joint from a posture in the list [rad]."""
    return max(abs(row["joints"][name] - q) for name, q in client.status().joints.items())


def test_a_goal_is_reached_in_another_posture(
    client: Client, calibrated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    listed = told(capsys, "ik", CELL, "park")
    assert listed["case"] == "arm_with_wrist"
    park, there = sorted(listed["postures"], key=lambda row: apart(client, row))
    assert apart(client, park) < SAME_RAD  # `park` is where the arm is, and a wrist turned over is there as well
    assert there["refused"] is None
    assert apart(client, there) > 2.0
    for row in (there, park):
        options = ("--posture", str(row["number"]), "--tolerance", "0.5")
        assert told(capsys, "goal", CELL, "park", *options)["outcome"] == "reached"
        assert apart(client, row) < SAME_RAD
    # Numbers stay as they are when the arm has moved, and without a daemon that plans the ways.
    again = told(capsys, "ik", str(calibrated), "park")
    assert [row["cost"] for row in again["postures"]] == pytest.approx([row["cost"] for row in listed["postures"]])
    assert again["postures"][0]["room"] == pytest.approx(listed["postures"][0]["room"], abs=1e-6)


def test_what_cannot_be_chosen_is_refused_in_words(
    client: Client, calibrated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, arguments in {
        "are valid: see `stereoservo ik`": ("goal", CELL, "park", "--posture", "99"),
        "--posture goes with NAME or --set-points": ("goal", CELL, "--joint", "j1=0", "--posture", "1"),
        "taught: park": ("ik", str(calibrated), "nowhere"),
    }.items():
        assert cli.invoke([*arguments, "--json"]) != 0
        assert words in json.loads(capsys.readouterr().out)["error"]["message"]
