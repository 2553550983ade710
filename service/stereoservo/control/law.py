"""What every law gets and gives: one interface, arrays only. A law is a pure function of these (thesis 8).

``Scene`` is the present, ``Task`` where to go, ``Options`` how; `control.laws.LAWS` has the laws by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from math import inf
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.control.reasons import Reason
from stereoservo.geometry.homogeneous import FloatArray

IntArray = npt.NDArray[np.int64]


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

    Of a planned way, for law ``trajectory``; empty where there is none: ``joint_rates`` (n,) [rad/s or m/s],
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


class Options(NamedTuple):
    """How to go there.

    ``gain`` [1/s]. ``dt_s`` [s]: how long the velocity will be held; 0: the instantaneous law, to first order.
    ``rotation_rate`` [rad/s], ``translation_rate`` [lengths of the frame's coordinates a second]: the largest that a
    component may be driven at. ``damping`` relative to the largest diagonal of the normal matrix.
    """

    gain: float
    dt_s: float = 0.0
    jacobian: int = JacobianChoice.MEAN
    damping: float = 1e-6
    rotation_rate: float = inf
    translation_rate: float = inf


class LawStep(NamedTuple):
    """``velocity`` (n,) [rad/s or m/s]. ``error`` (k,), ``allowed`` (k,), ``status`` (k,): of the law's components, see
    `trajectory.three_points.ComponentStatus`; k = 0 for laws in the images. ``conditioning``: of the normal matrix, 0
    singular; 1 where there is none.
    """

    velocity: FloatArray
    error: FloatArray
    allowed: FloatArray
    status: IntArray
    conditioning: float


@dataclass(frozen=True)
class Law:
    """A law by its step. ``components``, ``units``: of its error; ``needs_pose``: works on ``target_points``."""

    step: Callable[[Scene, Task, Options], LawStep]
    needs_pose: bool
    components: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    reasons: Callable[[LawStep], tuple[Reason, ...]] = lambda step: ()
