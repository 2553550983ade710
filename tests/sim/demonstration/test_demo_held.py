"""A demonstration does not wait in silence for a cell that is held."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from stereoservo.client import ClientError, TimedOutError
from stereoservo_sim.demonstration.live_demonstrator import LiveDemonstrator


class HeldGoal:
    """A goal that never ends."""

    id = "g1"

    def wait(self, timeout_s: float) -> Any:
        raise TimedOutError(f"goal g1: nothing within {timeout_s:g} s")


class HeldCell:
    """A client of a cell whose ``looks``-th status says that it is held."""

    def __init__(self, looks: int) -> None:
        self.looks = looks

    def goal(self, target: Any, **options: Any) -> HeldGoal:
        return HeldGoal()

    def status(self) -> Any:
        self.looks -= 1
        reasons = (SimpleNamespace(code="HELD"),) if self.looks <= 0 else ()
        return SimpleNamespace(reasons=reasons, last_event=7)

    def events(self, first: int) -> Any:
        assert first == 1
        heard = [("held", "first"), ("held", "the gateway was silent for 0.6 s"), ("lifecycle", "other")]
        return SimpleNamespace(events=[SimpleNamespace(kind=kind, message=text) for kind, text in heard])


@pytest.mark.parametrize("looks", [1, 3])
def test_a_held_cell_ends_the_demonstration_with_the_cause(looks: int) -> None:
    cell: Any = HeldCell(looks)
    with pytest.raises(ClientError, match=r"held.*silent for 0\.6 s"):
        LiveDemonstrator(cell, lambda _: None).move({"j1": 0.0})
    assert cell.looks == 0
