"""Scenario of the demonstration: the goals that are taught, the law that reaches each, and their order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from stereoservo.kinematics.joint_angles import measured_joints
from stereoservo.kinematics.joint_reprojection import joint_problem, observed_chain
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import DisplacementTarget, LawName, TaughtTarget
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.demonstration.belt import Belt
from stereoservo_sim.world.arms.arm_goals import goes_straight
from stereoservo_sim.world.simulated_cell import SimulatedCell

TEACH_FRAMES = 20
SEEN_FRAMES = 20
"""Frames of each camera whose mean is the observation."""
SIGHT_S = 20.0
"""Time limit for these frames."""
SEEN_PX = 0.3
"""Standard deviation of an observation: errors of marker centres depend on the posture."""
REST_S = 0.4  # after a move, before observations are used
JUDGE_S = 1.2  # rest after a goal, of which one second is evaluated


@dataclass(frozen=True)
class ShownGoal:
    """A goal of the demonstration, one of ``arm_goals.goals_of``: the law that reaches it, and the kind of its target.

    ``taught``: stated by its name, as the recorded pixels. ``displacement``: stated as the body's displacement from its
    current pose, a projective 4x4 in the model's frame, without pixels of the goal. ``follows``: it continues on a part
    that the belt carries.
    """

    name: str
    law: LawName
    stated: Literal["taught", "displacement"] = "taught"
    follows: bool = False


GOALS = (
    ShownGoal("near", "stereo"),
    ShownGoal("roll", "cartesian3"),
    ShownGoal("far", "trajectory", "displacement"),
)
"""Goals at 29, 180 and 94 degrees of rotation and 0.12, 0.14 and 0.37 m from home; see ``world``."""


ON_BELT = (
    ShownGoal("near", "stereo", follows=True),
    ShownGoal("roll", "cartesian3", follows=True),
    ShownGoal("far", "points", follows=True),
)
"""The same poses, taught on a static part and reached on parts that the belt carries."""


def shown_goals(cell: SimulatedCell, *, on_belt: bool = False) -> tuple[ShownGoal, ...]:
    """The goals of a cell's demonstration, with laws that its arm can follow.

    An arm with few degrees of freedom cannot rotate a face independently about its hinge and in its plane, as the
    Cartesian laws do. An arm that does not reach its poses on straight paths uses an image-based law there, too.
    """
    robot = cell.robot
    if on_belt:
        return ON_BELT
    if len(robot.joints) >= 6 or robot.prismatic.all():
        return GOALS
    near, roll, far = GOALS
    bent = far if goes_straight(robot, cell.base) else replace(far, law="stereo")
    return near, replace(roll, law="image"), bent


@dataclass(frozen=True)
class Calibrated:
    """Result of the calibration, with the durations of trial motions and fit [s]."""

    model: CellModel
    seconds: float


VisualTarget = TaughtTarget | DisplacementTarget
MarkerSights = Mapping[str, Mapping[int, Sequence[tuple[float, float]]]]
"""Raw pixels by camera and marker, one per frame."""


class SightCollection:
    """Collects frames of the ``cameras`` until there are ``frames`` of each."""

    def __init__(self, cameras: Iterable[str], frames: int) -> None:
        self.sights: dict[str, dict[int, list[tuple[float, float]]]] = {name: {} for name in cameras}
        self._left = dict.fromkeys(self.sights, frames)

    def add(self, camera: str, ids: Iterable[int], pixels: Iterable[tuple[float, float]]) -> None:
        """Add a frame."""
        if self._left[camera] > 0:
            self._left[camera] -= 1
            for marker, pixel in zip(ids, pixels, strict=True):
                self.sights[camera].setdefault(marker, []).append(pixel)

    @property
    def complete(self) -> bool:
        """Whether there are enough frames."""
        return not any(self._left.values())

    @property
    def missing(self) -> str:
        """Sentence on the frames that did not arrive in `SIGHT_S`."""
        late = ", ".join(f"{name} {left}" for name, left in self._left.items() if left)
        return f"frames that did not come in {SIGHT_S:g} s, by camera: {late}"


class Operator(Protocol):
    """Protocol of the cell's operator: a zenoh client, or the same in lockstep. Every call returns when the arm has
    finished.
    """

    def enable(self) -> None: ...

    def calibrate(self) -> Calibrated: ...

    def move(self, joints: dict[str, float]) -> None: ...

    def teach(self, name: str, frames: int) -> None: ...

    def home(self) -> None: ...

    def joints(self) -> FloatArray:
        """Measured joint positions (n,) [rad]."""
        ...

    def sights(self, frames: int) -> MarkerSights:
        """Observations of the arm at rest, the required number of frames of each camera."""
        ...

    def planned_s(self, target: VisualTarget, law: LawName) -> float:
        """Planned duration of a goal, without motion."""
        ...

    def servo(self, target: VisualTarget, law: LawName, follow: tuple[int, ...] = ()) -> str:
        """Execute a goal; with ``follow`` it continues with moving markers. Returns its outcome: ``reached``, or
        another end with its message.
        """
        ...

    def rest(self, seconds: float) -> None: ...


def perform(
    operator: Operator,
    joint_names: tuple[str, ...],
    configurations: Mapping[str, FloatArray],
    tell: Callable[[str], None],
    goals: Sequence[ShownGoal] = GOALS,
    belt: Belt | None = None,
) -> tuple[Calibrated, dict[str, str]]:
    """Run the whole demonstration; returns the calibration and each goal's outcome.

    ``goals`` are taught at ``configurations`` (n,); those that follow are executed on parts that the ``belt`` carries.
    """
    operator.enable()
    tell("calibrating: each joint moves alone in view of both cameras")
    calibrated = operator.calibrate()
    statistics = calibrated.model.statistics
    rms = "" if statistics is None else f", residual {statistics.rms_px:.4f} px"
    tell(f"calibrated in {calibrated.seconds:.0f} s{rms}")
    shown: dict[str, FloatArray] = {}
    for goal in goals:
        tell(f"showing goal {goal.name!r}")
        operator.move(dict(zip(joint_names, configurations[goal.name].tolist(), strict=True)))
        operator.rest(REST_S)
        operator.teach(goal.name, TEACH_FRAMES)
        if goal.stated == "displacement":
            shown[goal.name] = joints_by_images(calibrated.model, operator)
    outcomes = {}
    for goal in goals:
        if belt is not None:
            belt.clear()
        operator.home()
        operator.rest(REST_S)
        target: VisualTarget = TaughtTarget(goal.name)
        if goal.stated == "displacement":
            here = joints_by_images(calibrated.model, operator)
            target = displacement_between(calibrated.model, here, shown[goal.name])
        if belt is not None and goal.follows:
            outcomes[goal.name] = _met_on_belt(operator, goal, calibrated.model, belt, tell)
            continue
        seconds = operator.planned_s(target, goal.law)
        tell(f"goal {goal.name!r}, stated as {goal.stated}, with law {goal.law}: planned {seconds:.1f} s")
        outcomes[goal.name] = operator.servo(target, goal.law)
        operator.rest(JUDGE_S)
        tell(f"goal {goal.name!r}: {outcomes[goal.name]}")
    return calibrated, outcomes


def _met_on_belt(operator: Operator, goal: ShownGoal, model: CellModel, belt: Belt, tell: Callable[[str], None]) -> str:
    """Follow a part from the start of the belt until it stops; returns the outcome."""
    belt.put()
    operator.rest(REST_S)
    belt.run()
    speed = 1e3 * float(np.linalg.norm(belt.conveyor.velocity_m_s))
    tell(f"goal {goal.name!r}, on a part that the belt carries at {speed:.0f} mm/s, with law {goal.law}")
    outcome = operator.servo(TaughtTarget(goal.name), goal.law, model.marker_ids)
    operator.rest(JUDGE_S)
    tell(f"goal {goal.name!r}: {outcome}")
    return outcome


def joints_by_images(model: CellModel, operator: Operator) -> FloatArray:
    """Joints (n,) at which the model's marker body agrees with the observed pixels.

    With play, sag or ripple, the encoders differ from the true joint positions, and goals are taught as images. Raises
    JointAnglesError if no joints explain the pixels.
    """
    sights = operator.sights(SEEN_FRAMES)
    pixels = np.full((len(model.cameras), len(model.marker_ids), 2), np.nan)
    for c, camera in enumerate(model.cameras):
        for marker, seen in sights[camera.name].items():
            if marker in model.marker_ids:
                pixels[c, model.marker_ids.index(marker)] = np.mean(seen, axis=0)
    problem = joint_problem(observed_chain(model), model.marker_points, pixels, SEEN_PX)
    return measured_joints(problem, start=operator.joints(), largest_deviation=np.inf)[0].q


def displacement_between(model: CellModel, here: FloatArray, there: FloatArray) -> DisplacementTarget:
    """Displacement of the marker body from its pose at joints ``here`` (n,) to that at ``there`` (n,)."""
    chain = observed_chain(model).chain
    H = chain.displacement(there) @ np.linalg.inv(chain.displacement(here))
    return DisplacementTarget(tuple(H.ravel().tolist()), model_epoch=model.epoch)
