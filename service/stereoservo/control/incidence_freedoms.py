"""Before anything moves: has the arm, as it stands, the freedoms that incidences need? Which is missing, in words."""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.body_frame import body_frame
from stereoservo.control.incidence import IncidenceTask, incidence_step
from stereoservo.control.incidence_images_kernel import METRIC_FLOOR
from stereoservo.control.law import Options, Scene
from stereoservo.control.mobility import REACH, Freedom, attainable_motions, missing_freedom, rigid_motions
from stereoservo.control.mobility_kernel import point_jacobian
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import invert4

DEAR = 10.0
"""Cost of a motion that no joint makes, relative to one that joints make, so that these are used first."""


def incidence_freedoms(
    scene: Scene,
    task: IncidenceTask,
    plane_at_infinity: FloatArray,
    H_projective_to_euclidean: FloatArray | None = None,
    camera: str = "the first camera",
    tolerance: float = REACH,
    anywhere: bool = False,
) -> tuple[Freedom | None, ...]:
    """For each incidence by itself the freedom that it lacks here, None where the arm brings it nearer in all respects.

    To first order, as the arm stands: a freedom that is lost at a singularity counts as missing. ``anywhere``: only
    one that the arm lacks wherever it stands (a SCARA's tilts, the turns of slides). What the body would have to do
    besides all that the arm can is named; ``tolerance``: part of the residual that may be left, besides the task's
    own. Raises GeometryError as `mobility.mobility` does.
    """
    E = body_frame(
        scene.operators, scene.matrices, scene.points, plane_at_infinity, H_projective_to_euclidean
    )
    rigid = np.ascontiguousarray(rigid_motions(E))
    if anywhere:
        scene = scene._replace(
            operators=attainable_motions(E, scene.operators), composition=Composition.SIMULTANEOUS
        )
    operators = np.concatenate([scene.operators, rigid])
    free = scene._replace(operators=operators, composition=Composition.SIMULTANEOUS)
    form = np.ascontiguousarray(invert4(E)[:3])
    cost = np.sqrt((point_jacobian(operators, scene.points, form) ** 2).sum(axis=0))
    cost = np.maximum(cost, METRIC_FLOOR * cost.max(initial=1.0))
    cost[len(scene.operators) :] *= DEAR
    options = Options(1.0)
    found: list[Freedom | None] = []
    for k in range(len(task.kinds)):
        alone = IncidenceTask(
            task.kinds[k : k + 1], task.markers[k : k + 1], task.fixed[k : k + 1], task.tolerance_px
        )
        step = incidence_step(scene, alone, options)
        body = incidence_step(free, alone, options, metric=cost)
        # On a ridge, or at its goal, nothing tells the motion that is needed.
        needed = step.error_px[0] > task.tolerance_px and body.share > 1.0 - tolerance
        unmade = math.sqrt(1.0 - step.share**2)
        if not needed or unmade <= tolerance or unmade * step.error_px[0] <= task.tolerance_px:
            found.append(None)
            continue
        wanted = (body.velocity[len(scene.operators) :, None, None] * rigid).sum(axis=0)
        found.append(
            missing_freedom(
                scene.operators, scene.matrices, scene.points, plane_at_infinity, wanted,
                H_projective_to_euclidean, camera, tolerance,
            )
        )  # fmt: skip
    return tuple(found)
