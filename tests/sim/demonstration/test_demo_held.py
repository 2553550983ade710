"""A demonstration does not wait in silence for a cell that is held."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from stereoservo.client import ClientError, FailedError
from stereoservo.daemon.servo import SILENCE
from stereoservo.messages.goals import TaughtTarget
from stereoservo_sim.demonstration import runner
from stereoservo_sim.demonstration.runner import BUSY_COMPUTER, LOOKS, MOST_HOLDS, LiveDemonstrator


class HeldCell:
    """A client, and a goal, of a cell that is held from its ``looks``-th status on; the goal is reached where the cell
    was resumed as often as it is held.
    """

    while_waiting: Any

    def __init__(self, looks: int, cause: str, holds: int = 1) -> None:
        self.looks, self.cause, self.left = looks, cause, holds

    def goal(self, target: Any, **options: Any) -> HeldCell:
        return self

    def wait(self) -> Any:
        while self.left:
            self.while_waiting()
        return SimpleNamespace(outcome="reached", reasons=(), message="")

    reached = wait

    def resume(self) -> None:
        self.left -= 1

    def status(self) -> Any:
        self.looks -= 1
        reasons = (SimpleNamespace(code="HELD"),) if self.looks <= 0 else ()
        return SimpleNamespace(reasons=reasons, last_event=7)

    def events(self, first: int) -> Any:
        assert first == 1
        heard = [("held", f"held by {SILENCE}"), ("held", self.cause), ("lifecycle", "other")]
        return SimpleNamespace(events=[SimpleNamespace(kind=kind, message=text) for kind, text in heard])


@pytest.fixture(autouse=True)
def _looks_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "LOOK_EVERY_S", 0.0)


class LateTold(HeldCell):
    """Is held ``late`` looks before its events say so; until then the last of them is an older one."""

    def __init__(self, late: int, last: tuple[str, str] | None) -> None:
        super().__init__(1, f"held by {SILENCE}")
        self.late, self.last = late, last

    def events(self, first: int) -> Any:
        self.late -= 1
        heard = super().events(first).events[1:] if self.late < 0 else []
        older = [] if self.last is None else [SimpleNamespace(kind=self.last[0], message=self.last[1])]
        return SimpleNamespace(events=[*older, *heard])


@pytest.mark.parametrize("late", range(LOOKS + 1))
@pytest.mark.parametrize("last", [None, ("resumed", "by anna"), ("lifecycle", "active")])
def test_a_state_that_is_told_before_its_event_is_waited_for(last: tuple[str, str] | None, late: int) -> None:
    told: list[str] = []
    cell: Any = LateTold(late, last)
    demonstrator = LiveDemonstrator(cell, lambda _: None, told.append)
    if late < LOOKS:
        demonstrator.move({"j1": 0.0})
        assert told == [f"held by {SILENCE}: resumed"]
    else:
        with pytest.raises(ClientError, match="no event says why"):
            demonstrator.move({"j1": 0.0})


@pytest.mark.parametrize("looks", [1, 3])
def test_a_held_cell_ends_the_demonstration_with_the_cause(looks: int) -> None:
    cell: Any = HeldCell(looks, "held by anna")
    with pytest.raises(ClientError, match=r"held and nobody resumed it: held by anna"):
        LiveDemonstrator(cell, lambda _: None).move({"j1": 0.0})
    assert cell.looks == 0


def test_an_arm_that_a_busy_computer_held_goes_on_and_not_without_end() -> None:
    told: list[str] = []
    cell: Any = HeldCell(1, f"held by {SILENCE}", MOST_HOLDS)
    LiveDemonstrator(cell, lambda _: None, told.append).move({"j1": 0.0})
    assert told == [f"held by {SILENCE}: resumed"] * MOST_HOLDS
    cell = HeldCell(1, f"held by {SILENCE}", MOST_HOLDS + 1)
    with pytest.raises(ClientError, match="said nothing"):
        LiveDemonstrator(cell, lambda _: None).move({"j1": 0.0})


class StoppedCell:
    """A client, goal and result of a cell whose arm is stopped for ``code`` ``stops`` times, whatever it does."""

    def __init__(self, code: str, stops: int) -> None:
        self.reasons, self.message, self.left = (SimpleNamespace(code=code),), f"stop: {code}", stops

    @property
    def outcome(self) -> str:
        return "aborted" if self.left else "reached"

    def goal(self, target: Any, **options: Any) -> StoppedCell:
        return self

    def wait(self) -> StoppedCell:
        return self

    def calibrate(self, progress: Any, learning: Any) -> Any:
        if self.left:
            event: Any = SimpleNamespace(
                kind="calibration_aborted", name="", message=self.message, reasons=self.reasons
            )
            raise FailedError("calibration", event)
        return SimpleNamespace(model="model.json")

    def resume(self) -> None:
        self.left -= 1


def test_what_a_busy_computer_ended_is_begun_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "load_model", lambda path: path.name)
    for code in BUSY_COMPUTER:
        told: list[str] = []
        cell: Any = StoppedCell(code, 2)
        model: Any = LiveDemonstrator(cell, lambda _: None, told.append).calibrate().model
        assert model == "model.json"
        assert told == [f"calibration: calibration aborted: stop: {code}: resumed"] * 2
        cell.left = 1
        demonstrator = LiveDemonstrator(cell, lambda _: None, told.append)
        assert demonstrator.servo(TaughtTarget("near"), "stereo") == "reached"


def test_what_anything_else_ended_is_not() -> None:
    cell: Any = StoppedCell("CONTACT", 1)
    demonstrator = LiveDemonstrator(cell, lambda _: None)
    with pytest.raises(FailedError, match="CONTACT"):
        demonstrator.calibrate()
    assert demonstrator.servo(TaughtTarget("near"), "stereo") == "aborted: stop: CONTACT"
    cell = StoppedCell("LOOP_GAP", MOST_HOLDS + 1)
    with pytest.raises(FailedError, match="LOOP_GAP"):
        LiveDemonstrator(cell, lambda _: None).calibrate()
    assert cell.left == 1
