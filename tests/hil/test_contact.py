"""An arm that meets something, as real processes: it stops with its drives on, says why, and can be jogged away."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from stereoservo.client import Client, RefusedError
from stereoservo.messages.discovery import DaemonProcess

from .conftest import CELL, eventually

pytestmark = pytest.mark.process

BLOCKED = """
[joints.options.faults]
block_after = 1
block_joint = "j1"

[safety.contact]
effort = { j1 = 6.0 }
following = { j1 = 1.0 }

[servo]
"""


def test_contact_stops_the_arm_and_lets_it_go_back(cell_file: Path, start: Callable[..., DaemonProcess]) -> None:
    path = cell_file.with_name("blocked.toml")
    path.write_text(cell_file.read_text().replace("[servo]\n", BLOCKED, 1))
    start(path)
    with Client(CELL) as client:
        client.enable()
        at = client.status().joints["j1"]
        result = client.goal({"j1": at + 0.3}).wait(30.0)
        assert result.outcome == "aborted"
        reason = result.reasons[0]
        assert (reason.code, reason.subject, reason.threshold) == ("CONTACT_EFFORT", "j1", 6.0)
        assert reason.value is not None
        assert reason.value > 6.0
        assert "is something in its way?" in reason.hint

        eventually("the arm rests", lambda: not any(client.status().command.values()))
        state = client.status()
        assert (state.lifecycle, state.driver_active) == ("active", True)
        assert [r.code for r in state.reasons][-2:] == ["CONTACT_EFFORT", "STOPPED"]
        assert state.effort_limits == {"j1": 6.0}
        assert state.efforts["j1"] > 6.0
        assert state.following_errors["j1"] > 0.0
        with pytest.raises(RefusedError, match="stopped"):
            client.jog({"j1": -0.1})

        client.resume()

        def away() -> bool:
            client.jog({"j1": -0.2}, 0.5)
            return client.status().joints["j1"] < at - 0.02

        eventually("it goes back", away)
        assert "CONTACT_EFFORT" not in [r.code for r in client.status().reasons]
        eventually("the load is gone", lambda: client.status().efforts["j1"] == 0.0)
