"""What the demonstration does: which goals are shown, with which law each is reached again, and in which order."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.model import CellModel

FloatArray = npt.NDArray[np.float64]

TEACH_FRAMES = 20
REST_S = 0.4  # after a move, before the cameras are believed
JUDGE_S = 1.2  # rest after a goal, of which one second is judged


@dataclass(frozen=True)
class ShownGoal:
    """A goal of the demonstration, one of ``world.goals_of``, and the law that reaches it again."""

    name: str
    law: str


GOALS = (ShownGoal("near", "stereo"), ShownGoal("roll", "cartesian3"), ShownGoal("far", "cartesian3"))
"""From home: about 27, 130 and 90 degrees of rotation, 0.15, 0.15 and 0.38 m; see ``world``."""


@dataclass(frozen=True)
class Calibrated:
    """What the calibration gave, and how long trial motions and fit took [s]."""

    model: CellModel
    seconds: float


class Operator(Protocol):
    """Who works the cell: a client over zenoh, or the same in lockstep. Every call ends when the arm has done it."""

    def enable(self) -> None: ...

    def calibrate(self) -> Calibrated: ...

    def move(self, joints: dict[str, float]) -> None: ...

    def teach(self, name: str, frames: int) -> None: ...

    def home(self) -> None: ...

    def servo(self, name: str, law: str) -> str:
        """Run a taught goal; gives its outcome: ``reached`` or what else ended it, with the message."""
        ...

    def rest(self, seconds: float) -> None: ...


def perform(
    operator: Operator,
    joint_names: tuple[str, ...],
    configurations: Mapping[str, FloatArray],
    tell: Callable[[str], None],
) -> tuple[Calibrated, dict[str, str]]:
    """The whole demonstration, goals shown at ``configurations`` (n,); the calibration and each goal's outcome."""
    operator.enable()
    tell("calibrating: each joint moves alone in view of both cameras")
    calibrated = operator.calibrate()
    statistics = calibrated.model.statistics
    rms = "" if statistics is None else f", residual {statistics.rms_px:.4f} px"
    tell(f"calibrated in {calibrated.seconds:.0f} s{rms}")
    for goal in GOALS:
        tell(f"showing goal {goal.name!r}")
        operator.move(dict(zip(joint_names, configurations[goal.name].tolist(), strict=True)))
        operator.rest(REST_S)
        operator.teach(goal.name, TEACH_FRAMES)
    outcomes = {}
    for goal in GOALS:
        operator.home()
        operator.rest(REST_S)
        tell(f"goal {goal.name!r} with law {goal.law}")
        outcomes[goal.name] = operator.servo(goal.name, goal.law)
        operator.rest(JUDGE_S)
        tell(f"goal {goal.name!r}: {outcomes[goal.name]}")
    return calibrated, outcomes
