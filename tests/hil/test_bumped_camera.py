"""A camera of a running daemon is bumped: the goal, and goals taught before, are reached all the same."""

from __future__ import annotations

import pytest

from stereoservo.client import Client
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.goals import JointTarget
from stereoservo_sim.world.workpiece import Moved, MovedFile

from .conftest import eventually

pytestmark = pytest.mark.process


def test_bumped_camera_is_found_anew_in_mid_goal_and_taught_goals_stay_good(
    kept_state: None, own: Client, directories: CellDirectories
) -> None:
    joints = dict(own.status().joints)
    away = JointTarget({name: q + 0.1 for name, q in joints.items()})
    assert own.goal(away).wait(30.0).outcome == "reached"
    epoch = own.status().model_epoch
    first = own.events(1 << 60).next
    handle = own.send(own.make_goal("park"))
    bumps = MovedFile(directories.runtime, "simulated-camera-left.json")
    try:
        bumps.write(Moved((0.03, 0.0, 0.0), (0.0, 5.0, 0.0)))
        assert handle.wait(60.0).outcome == "reached"
        eventually(
            "the camera is known again",
            lambda: own.status().health.verdict == "ok" and own.status().model_epoch > epoch,
        )
        events = own.events(first).events
        told = [e.kind for e in events if e.kind in ("health", "reanchor", "reanchor_model", "reanchored")]
        assert told == ["health", "reanchor", "reanchor_model", "reanchored"], [e.message for e in events]
        assert own.goal(away).wait(30.0).outcome == "reached"
        assert own.goal("park").wait(60.0).outcome == "reached"  # taught before the bump, said in the new pixels
        assert max(abs(q - joints[name]) for name, q in own.status().joints.items()) < 0.02
    finally:
        bumps.path.unlink()
