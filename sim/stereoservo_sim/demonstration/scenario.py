"""Scenario of the demonstration: which goals are taught, by which law each is reached, and in which order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import DisplacementTarget, LawName, TaughtTarget
from stereoservo.numerics.arrays import FloatArray

TEACH_FRAMES = 20
REST_S = 0.4  # after a move, before the cameras are believed
JUDGE_S = 1.2  # rest after a goal, of which one second is judged


@dataclass(frozen=True)
class ShownGoal:
    """A goal of the demonstration, one of ``world.goals_of``: the law that reaches it, and the kind of its target.

    ``taught``: by its name, the pixels that were shown. ``displacement``: by what the body has to do from where it is,
    a projective 4x4 in the model's frame, without a pixel of the goal.
    """

    name: str
    law: LawName
    stated: Literal["taught", "displacement"] = "taught"


GOALS = (
    ShownGoal("near", "stereo"),
    ShownGoal("roll", "cartesian3"),
    ShownGoal("far", "trajectory", "displacement"),
)
"""From home: 29, 180 and 94 degrees of rotation, 0.12, 0.14 and 0.37 m; see ``world``."""


@dataclass(frozen=True)
class Calibrated:
    """Result of the calibration, with the durations of trial motions and fit [s]."""

    model: CellModel
    seconds: float


VisualTarget = TaughtTarget | DisplacementTarget


class Operator(Protocol):
    """Protocol of the cell's operator: a client over zenoh, or the same in lockstep. Every call returns when the
    arm has finished.
    """

    def enable(self) -> None: ...

    def calibrate(self) -> Calibrated: ...

    def move(self, joints: dict[str, float]) -> None: ...

    def teach(self, name: str, frames: int) -> None: ...

    def home(self) -> None: ...

    def joints(self) -> FloatArray:
        """Measured joint positions (n,) [rad]."""
        ...

    def planned_s(self, target: VisualTarget, law: LawName) -> float:
        """Duration of a goal by its plan, without motion."""
        ...

    def servo(self, target: VisualTarget, law: LawName) -> str:
        """Execute a goal; returns its outcome: ``reached`` or what else ended it, with the message."""
        ...

    def rest(self, seconds: float) -> None: ...


def perform(
    operator: Operator,
    joint_names: tuple[str, ...],
    configurations: Mapping[str, FloatArray],
    tell: Callable[[str], None],
    goals: Sequence[ShownGoal] = GOALS,
) -> tuple[Calibrated, dict[str, str]]:
    """Run the whole demonstration, ``goals`` taught at ``configurations`` (n,); returns the calibration and each
    goal's outcome.
    """
    operator.enable()
    tell("calibrating: each joint moves alone in view of both cameras")
    calibrated = operator.calibrate()
    statistics = calibrated.model.statistics
    rms = "" if statistics is None else f", residual {statistics.rms_px:.4f} px"
    tell(f"calibrated in {calibrated.seconds:.0f} s{rms}")
    for goal in goals:
        tell(f"showing goal {goal.name!r}")
        operator.move(dict(zip(joint_names, configurations[goal.name].tolist(), strict=True)))
        operator.rest(REST_S)
        operator.teach(goal.name, TEACH_FRAMES)
    outcomes = {}
    for goal in goals:
        operator.home()
        operator.rest(REST_S)
        target: VisualTarget = TaughtTarget(goal.name)
        if goal.stated == "displacement":
            target = displacement_to(calibrated.model, operator.joints(), configurations[goal.name])
        seconds = operator.planned_s(target, goal.law)
        tell(f"goal {goal.name!r}, stated as {goal.stated}, with law {goal.law}: planned {seconds:.1f} s")
        outcomes[goal.name] = operator.servo(target, goal.law)
        operator.rest(JUDGE_S)
        tell(f"goal {goal.name!r}: {outcomes[goal.name]}")
    return calibrated, outcomes


def displacement_to(model: CellModel, joints: FloatArray, goal: FloatArray) -> DisplacementTarget:
    """Displacement of the marker body from its pose at ``joints`` (n,) to that at ``goal`` (n,)."""
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
    H = chain.displacement(goal) @ np.linalg.inv(chain.displacement(joints))
    return DisplacementTarget(tuple(H.ravel().tolist()), model_epoch=model.epoch)
