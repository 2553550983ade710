"""Compilation of the path planner's numba kernels by planning example paths (straight, around a keep-out,
unreachable), so that the servo loop compiles none.
"""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.plan import PlanLimits, PlanRequest
from stereoservo.planning.planner import plan
from stereoservo.planning.tracking import advance, sample_plan

AWAY = 0.2
"""Distance of the example goal [m]."""


def warm_up_planner() -> None:
    """Plan a straight path, detours around a keep-out and an unreachable goal; sample the first."""
    request = _request()
    found = plan(request).plan
    if found is None:
        raise RuntimeError("the example cell's straight path must be feasible")
    sample_plan(found, advance(found, 0.1, 0.004, 0.0))
    box = np.full((1, 6, 2), [-np.inf, np.inf])
    box[0, 0] = 0.4 * AWAY, 0.6 * AWAY
    box[0, 1, 0] = -0.03
    plan(_limited(request, keep_outs=box))
    beyond = np.full(6, np.inf)
    beyond[0] = 0.7 * AWAY
    plan(_limited(request, position_max=beyond))
    gantry = request.operators.copy()
    gantry[3:] = 0.0  # it cannot turn: the refusal says which freedom it lacks
    plan(msgspec.structs.replace(request, operators=gantry))
    plan(msgspec.structs.replace(request, targets=request.points, centre_target=request.centre))


def _limited(request: PlanRequest, **limits: FloatArray) -> PlanRequest:
    return msgspec.structs.replace(request, limits=msgspec.structs.replace(request.limits, **limits))


def _request() -> PlanRequest:
    start = np.array([-0.5 * AWAY, 0.0, 1.0])
    operators = np.zeros((6, 4, 4))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        operators[k, k, 3] = 1.0
        operators[3 + k, j, i], operators[3 + k, i, j] = 1.0, -1.0
        operators[3 + k, j, 3], operators[3 + k, i, 3] = -start[i], start[j]
    camera = np.array([[600.0, 0.0, 320.0, 0.0], [0.0, 600.0, 240.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    matrices = np.stack([camera, camera])
    matrices[:, 0, 3] = 60.0, -60.0
    eyes = np.array([[-0.1, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 1.0]])
    corners = 0.05 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    turned = np.stack([-corners[:, 1], corners[:, 0], corners[:, 2]], axis=1)
    aside = np.array([AWAY, 0.0, 0.0])
    return PlanRequest(
        operators=operators,
        composition=0,
        joints=np.zeros(6),
        matrices=matrices,
        camera_centres=eyes,
        points=_of_height_1(start + corners),
        targets=_of_height_1(start + aside + turned),
        kept=np.ones(4),
        centre=np.append(start, 1.0),
        centre_target=np.append(start + aside, 1.0),
        faces=np.array([[0, 1, 2]]),
        limits=PlanLimits(
            position_min=np.full(6, -np.inf),
            position_max=np.full(6, np.inf),
            velocity_max=np.ones(6),
            acceleration_max=np.full(6, 4.0),
            keep_outs=np.zeros((0, 6, 2)),
            sizes=np.array([[640.0, 480.0], [640.0, 480.0]]),
            lenses=np.array([[0.01, 320.0, 240.0, 320.0], [0.01, 320.0, 240.0, 320.0]]),
            view_margin_px=4.0,
        ),
    )


def _of_height_1(points: FloatArray) -> FloatArray:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)
