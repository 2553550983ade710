"""Interface of control laws: the struct `Law` that a plug-in registers, and the arguments and result of its step
(scene, task, options, joint velocity with errors).

Arrays only; a law is a pure function of them. `control.law_registry.LAWS` holds the installed laws by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from math import inf
from typing import Literal, NamedTuple

import numpy as np

from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray, Record


class JacobianChoice(IntEnum):
    """Around what an image Jacobian is developed (8.1.1)."""

    CURRENT = 0
    """The present points."""
    DESIRED = 1
    """The points at the goal, with the operators at present."""
    MEAN = 2
    """The mean of both: converges from farthest."""
    FIXED_DEPTH = 3
    """The present pixels at the depths of the goal."""


class Scene(NamedTuple):
    """The present: an arm of n joints, c cameras, m markers of the moving body.

    ``operators`` (n, 4, 4) at the current configuration (5.21), ``composition`` a `kinematics.composition.Composition`.
    ``matrices`` (c, 3, 4), ``camera_centres`` (c, 4); ``points`` (m, 4), all of height ``a∞ᵀM = 1``. ``pixels``
    (c, m, 2) ideal, ``weights`` (c, m) = 1/sigma [1/px], 0 where a marker is not seen.
    """

    operators: FloatArray
    composition: int
    matrices: FloatArray
    camera_centres: FloatArray
    points: FloatArray
    pixels: FloatArray
    weights: FloatArray


NO_JOINTS = np.zeros(0)


class Task(NamedTuple):
    """Where to go.

    ``set_points`` (c, m, 2) ideal pixels with ``wanted`` (c, m) 1 or 0, and their velocities ``rates`` (c, m, 2)
    [px/s], zero for a goal that stands. ``target_points`` (m, 4) of height 1 where ``target_known`` (m,) is 1.
    ``centre`` now and ``centre_target``, (4,) of height 1: one point of the body. ``face`` (3,): markers that span
    the face whose sight is kept.

    Of a plan, for planned laws; empty where there is none: ``joint_rates`` (n,) [rad/s or m/s],
    ``joint_error`` (n,) planned joints less the arm's, ``joint_weight`` [0, 1] what share of their weight they have.
    """

    set_points: FloatArray
    wanted: FloatArray
    rates: FloatArray
    target_points: FloatArray
    target_known: FloatArray
    centre: FloatArray
    centre_target: FloatArray
    face: IntArray
    joint_rates: FloatArray = NO_JOINTS
    joint_error: FloatArray = NO_JOINTS
    joint_weight: float = 0.0


DAMPING = 1e-6


class Options(NamedTuple):
    """How to go there.

    ``gain`` [1/s]. ``dt_s`` [s]: how long the velocity will be held; 0: the instantaneous law, to first order.
    ``rotation_rate`` [rad/s], ``translation_rate`` [lengths of the frame's coordinates a second]: the largest that a
    component may be driven at. ``damping`` relative to the largest diagonal of the normal matrix.
    """

    gain: float
    dt_s: float = 0.0
    jacobian: int = JacobianChoice.MEAN
    damping: float = DAMPING
    rotation_rate: float = inf
    translation_rate: float = inf


class LawStep(NamedTuple):
    """``velocity`` (n,) [rad/s or m/s]. ``error`` (k,), ``allowed`` (k,), ``status`` (k,): of the law's components, see
    `ComponentStatus` of the planning; k = 0 for laws in the images. ``conditioning``: of the normal matrix, 0
    singular; 1 where there is none.
    """

    velocity: FloatArray
    error: FloatArray
    allowed: FloatArray
    status: IntArray
    conditioning: float


Path = Literal["free", "straight", "planned"]
"""Where a law leads the body: where its errors take it, on the straight line that is checked before, along a plan."""
OneCamera = Literal["suffices", "continues", "refused"]
"""What a law does with one camera: made for it, goes on by prediction once it has begun, or is refused."""


@dataclass(frozen=True)
class LawProperties:
    """What a user weighs when choosing a law: the row of a law in the table of docs/goals-and-laws.md, in Markdown."""

    centre: str
    face: str
    works_on: str
    noise_at_rest: str
    one_camera: str
    fails_when: str


@dataclass(frozen=True)
class Law:
    """A control law as a plug-in: its step, what the daemon must know of it, and its words.

    ``step`` maps (Scene, Task, Options) to a LawStep. It is pure, allocates little and returns within a fraction of
    the cycle. ``reasons`` of a step: what holds it up, empty where nothing does. ``components``, ``units``: of
    ``LawStep.error``, which has as many elements.

    ``needs_pose``: the step reads ``target_points``; ``path`` and ``one_camera``: see `Path` and `OneCamera`;
    ``follows_streams``: the target may move while the law runs. ``options``: fields of a goal that belong to this
    law, of ``centre``, ``jacobian`` and ``profile``.

    ``kernel``: the same step in one compiled call, bit for bit. It takes an array (1,) of a record,
    `core.context.WORKSPACE`, which has the fields of Scene and Task packed (``weights`` as ``usable``, ``points`` as
    ``body``; of the cameras that keep sight of the face the centres as ``eyes``) and of Options ``gain``, ``dt_s`` and
    ``jacobian_choice``, whose rest is as by default; it fills in ``velocity``, ``components`` (errors, then what
    is allowed), ``component_status`` and ``conditioning``. None: the step is called.
    For the kernel of a law without components no face is chosen.

    ``summary``: one line for lists. ``colour``: in figures. ``rank``: where the law stands in lists.
    """

    step: Callable[[Scene, Task, Options], LawStep]
    summary: str
    needs_pose: bool = False
    path: Path = "free"
    one_camera: OneCamera = "continues"
    follows_streams: bool = True
    options: tuple[str, ...] = ()
    components: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    reasons: Callable[[LawStep], tuple[Reason, ...]] = lambda step: ()
    kernel: Callable[[Record], None] | None = None
    properties: LawProperties | None = None
    colour: str = "#7f7f7f"
    rank: int = 1000
    planned: bool = field(init=False)
    """Whether the law follows a plan, and waits for one."""
    needs_goal_pose: bool = field(init=False)
    """Whether a goal of this law must determine a pose: for the step, or for the plan."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "planned", self.path == "planned")
        object.__setattr__(self, "needs_goal_pose", self.needs_pose or self.planned)
