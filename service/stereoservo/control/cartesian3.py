"""Cartesian control from three points (thesis 8.42): the centre on a straight line, the face about it.

``cartesian3_law`` is the readable reference; the loop runs `control.cartesian3_kernel.cartesian3_step`,
tested against it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.control.reasons import Reason
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.trajectory.primitives import HINGE, PLANAR, TRANSLATION
from stereoservo.trajectory.three_points import ComponentStatus, DegenerateFaceError, decompose

IntArray = npt.NDArray[np.int64]

COMPONENTS = (TRANSLATION, HINGE, PLANAR)
UNITS = ("", "rad", "rad")


class Cartesian3Step(NamedTuple):
    """``velocity`` (n,) [rad/s or m/s]; ``task_error`` (3,): τ, θ_r [rad], θ_p [rad] still to be made, all >=
    0.

    τ in lengths of the centre's displacement in the frame's coordinates: along one line proportional to
    metres. ``allowed`` (3,): what of it visibility lets the components plan for; ``status`` (3,):
    `ComponentStatus` of each.
    """

    velocity: FloatArray
    task_error: FloatArray
    allowed: FloatArray
    status: IntArray


def cartesian3_law(
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    centre: FloatArray,
    centre_target: FloatArray,
    camera_centres: FloatArray,
    gains: FloatArray,
) -> Cartesian3Step:
    """``q̇ = [q̂_t q̂_r q̂_p] Λ e`` with ``e`` the motion still to be made (8.42).

    ``operators`` (n, 4, 4) at the current configuration (5.21), ``points`` and ``targets`` (3, 4) of one
    face, ``centre`` and ``centre_target`` (4,), ``camera_centres`` (c, 4): all of height ``a∞ᵀM = 1``.
    ``gains`` (3,) [1/s]. A component that the arm cannot make, or that visibility holds back, does not hold
    up the others.
    """
    n = operators.shape[0]
    try:
        parts = decompose(operators, points, targets, centre, centre_target, camera_centres)
    except DegenerateFaceError:
        status = np.full(3, int(ComponentStatus.NO_FACE), dtype=np.int64)
        return Cartesian3Step(np.zeros(n), np.zeros(3), np.zeros(3), status)
    components = (parts.translation, parts.hinge, parts.planar)
    screws = np.stack([component.screw for component in components])
    allowed = np.array([component.allowed for component in components])
    return Cartesian3Step(
        (gains * allowed) @ screws,
        np.array([component.amount for component in components]),
        allowed,
        np.array([int(component.status) for component in components], dtype=np.int64),
    )


def cartesian3_reasons(task_error: FloatArray, allowed: FloatArray, status: IntArray) -> tuple[Reason, ...]:
    """What a step of the law has to tell: components that the arm cannot make, or that wait. Empty when all
    move.
    """
    reasons = []
    for i, (component, unit) in enumerate(zip(COMPONENTS, UNITS, strict=True)):
        left, may = float(task_error[i]), float(allowed[i])
        if status[i] == ComponentStatus.NOT_REACHABLE:
            hint = "the arm lacks this freedom here: leave the singularity by joints, or give another goal"
            # an angle can only be measured by the operator that the arm lacks
            value = left if component == TRANSLATION else None
            reasons.append(Reason("NOT_REACHABLE", "slow", component, value, None, unit, hint))
        elif status[i] == ComponentStatus.WAITS:
            hint = "waits for the other components, so that the cameras keep seeing the face"
            reasons.append(Reason("VISIBILITY_WAIT", "info", component, left, may, unit, hint))
        elif status[i] == ComponentStatus.NO_FACE:
            hint = "the three points of the face lie on one line: choose others"
            reasons.append(Reason("NO_FACE", "hold", component, None, None, "", hint))
    return tuple(reasons)
