"""``stereoservo auxiliary`` waits for a gripper for as long as it moves, however slowly."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from stereoservo.cli import operator_commands
from stereoservo.cli.output import CellOptions
from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.messages.wire import LoopInfo, StateMessage

SPEED, STOPS_AT = 0.008, 0.05
"""[m/s, m]: a tenth of the range a second, as far as a part that it closes on."""


class Gripper:
    """A client of a cell whose gripper moves slowly; its own clock."""

    def __init__(self, *_: object, **__: object) -> None:
        self.now_s = 0.0

    def __enter__(self) -> Gripper:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def monotonic(self) -> float:
        return self.now_s

    def info(self) -> Any:
        return SimpleNamespace(auxiliary=(AuxiliarySpec("gripper", "prismatic", 0.0, 0.08, SPEED),))

    def auxiliary(self, values: dict[str, float]) -> None:
        self.ordered = values["gripper"]

    def status(self) -> StateMessage:
        position = min(SPEED * self.now_s, self.ordered, STOPS_AT)
        return StateMessage(
            cell="demo", boot="b", t_ns=1, step=0, t_wall=1.0, lifecycle="active", model="valid",
            model_epoch=1, source="hold", goal="", law="", level="ok", reasons=(), joints={}, velocities={}, command={},
            error_px=None, task_error=(), innovation_px={}, visible={}, auxiliary={"gripper": position},
            loop=LoopInfo(250.0, 1, 0, 0, {}, {}),
        )  # fmt: skip


@pytest.mark.parametrize(("ordered", "waits_s", "ends_at"), [(0.03, 3.75, 0.03), (0.08, 6.25, STOPS_AT)])
def test_it_waits_until_a_slow_gripper_is_there_or_stands(
    monkeypatch: pytest.MonkeyPatch, ordered: float, waits_s: float, ends_at: float
) -> None:
    gripper, told = Gripper(), []
    monkeypatch.setattr(CellOptions, "client", lambda *_, **__: gripper)
    monkeypatch.setattr(operator_commands, "time", gripper)
    monkeypatch.setattr(CellOptions, "emit", lambda _, state, text: told.append(state.auxiliary["gripper"]))
    operator_commands.auxiliary("demo", [f"gripper={ordered}"], wait=10.0)
    assert told == [pytest.approx(ends_at, abs=0.001)]
    assert gripper.now_s == pytest.approx(waits_s, abs=operator_commands.STANDS_S + 0.2)
