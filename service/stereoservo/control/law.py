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
    """Points at which an image Jacobian is evaluated (8.1.1)."""

    CURRENT = 0
    """The current points."""
    DESIRED = 1
    """The points at the goal, with the current operators."""
    MEAN = 2
    """The mean of both: converges from the largest distance."""
    FIXED_DEPTH = 3
    """The current pixels at the depths of the goal."""


class Scene(NamedTuple):
    """The current state: an arm of n joints, c cameras, m markers of the moving body.

    ``operators`` (n, 4, 4): at the current configuration (5.21); ``composition``: a
    `kinematics.composition.Composition`.
    ``matrices`` (c, 3, 4), ``camera_centres`` (c, 4); ``points`` (m, 4), all of height ``a∞ᵀM = 1``.
    ``pixels`` (c, m, 2): ideal; ``weights`` (c, m) = 1/sigma [1/px], 0 where a marker is not seen.
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
    """The goal.

    ``set_points`` (c, m, 2): ideal pixels with ``wanted`` (c, m) 1 or 0, and their velocities ``rates`` (c, m, 2)
    [px/s], zero for a static goal.
    ``target_points`` (m, 4): of height 1 where ``target_known`` (m,) is 1.
    ``centre``, ``centre_target`` (4,): a point of the body, of height 1, now and at the goal.
    ``face`` (3,): markers that span the face that must stay visible.

    Of a plan, for planned laws; empty without one: ``joint_rates`` (n,) [rad/s or m/s], ``joint_error`` (n,) planned
    joints minus the arm's, ``joint_weight`` [0, 1] the fraction of their weight.
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
    """Parameters of a step.

    ``gain`` [1/s].
    ``dt_s`` [s]: time for which the velocity will be held; 0: the instantaneous law, to first order.
    ``rotation_rate`` [rad/s], ``translation_rate`` [lengths of the frame's coordinates a second]: the largest rates of
    a component.
    ``damping``: relative to the largest diagonal element of the normal matrix.
    """

    gain: float
    dt_s: float = 0.0
    jacobian: int = JacobianChoice.MEAN
    damping: float = DAMPING
    rotation_rate: float = inf
    translation_rate: float = inf


class LawStep(NamedTuple):
    """Result of a step: ``velocity`` (n,) [rad/s or m/s]. ``error`` (k,), ``allowed`` (k,), ``status`` (k,): of the
    law's components, see `ComponentStatus` of the planning; k = 0 for laws in the images. ``conditioning``: of the
    normal matrix, 0 singular; 1 if there is none.
    """

    velocity: FloatArray
    error: FloatArray
    allowed: FloatArray
    status: IntArray
    conditioning: float


Path = Literal["free", "straight", "planned"]
"""The path of the body under a law: free (determined by the errors), the straight line that is checked in advance, or a
planned path.
"""
OneCamera = Literal["suffices", "continues", "refused"]
"""Behaviour of a law with one camera: designed for it, continues by prediction once it has started, or is refused."""


@dataclass(frozen=True)
class LawProperties:
    """Properties for choosing a law: its row in the table of docs/goals-and-laws.md, in Markdown."""

    centre: str
    face: str
    works_on: str
    noise_at_rest: str
    one_camera: str
    fails_when: str


@dataclass(frozen=True)
class Law:
    """A control law as a plug-in: its step, the properties that the daemon needs, and its texts.

    ``step``: maps (Scene, Task, Options) to a LawStep. It is pure, allocates little and returns within a fraction of
    the cycle.
    ``reasons``: of a step: why it is held up, empty if it is not.
    ``components``, ``units``: of ``LawStep.error``, which has as many elements.
    ``needs_pose``: the step reads ``target_points``.
    ``path``, ``one_camera``: see `Path` and `OneCamera`.
    ``follows_streams``: the target may move while the law runs.
    ``options``: fields of a goal that belong to this law, of ``centre``, ``jacobian`` and ``profile``.

    ``kernel``: the same step in one compiled call, bit for bit. It takes an array (1,) of a record,
    `core.context.WORKSPACE`, which contains the fields of Scene and Task packed (``weights`` as ``usable``, ``points``
    as ``body``; ``eyes``: the centres of the cameras that must keep the face visible) and of Options ``gain``, ``dt_s``
    and ``jacobian_choice``; the other options have their defaults. It writes ``velocity``, ``components`` (errors, then
    the allowed parts), ``component_status`` and ``conditioning``. None: the step is called.
    For the kernel of a law without components no face is chosen.

    ``summary``: one line for lists. ``colour``: in figures. ``rank``: position of the law in lists.
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
