"""The law on points in space (8.13 to 8.17, 8.34): their differences from the goal's, measured in pixels.

A projective frame has no lengths of its own: a displacement of a point counts as what it moves in the images of all
cameras. The command then does not depend on the frame. ``points_velocity`` is the readable reference; the loop runs
`control.points_kernel.points_step`, tested against it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stereoservo.control.damped import damped_least_squares_reference
from stereoservo.control.image import held_gain, limited
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.points_kernel import pixel_metrics, points_step
from stereoservo.geometry.homogeneous import FloatArray


def points(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(M* − M)`` over the markers that any camera sees and whose goal is known, in pixels.

    With the mean Jacobian ``Ĥ_j (M + M*)/2`` the motion is the screw from here to the goal, from anywhere short of
    half a turn. There is no fixed depth in space: that choice is the present points.
    """
    velocity, conditioning = points_step(
        scene.operators, scene.points, task.target_points, _seen(scene, task),
        pixel_metrics(scene.matrices, scene.points), held_gain(options), int(options.jacobian), options.damping,
    )  # fmt: skip
    return limited(scene, task, options, velocity, conditioning)


def euclidean_points(
    H_projective_to_euclidean: FloatArray,
) -> Callable[[Scene, Task, Options], LawStep]:
    """The law on points in metric coordinates (8.17), for a calibrated rig: what others do, for comparison.

    ``H_projective_to_euclidean`` (4, 4) maps the frame's points to the metric frame of that rig.
    """
    H = np.ascontiguousarray(H_projective_to_euclidean, dtype=np.float64)

    def step(scene: Scene, task: Task, options: Options) -> LawStep:
        X, X_star = scene.points @ H.T, task.target_points @ H.T
        known = task.target_known > 0.0
        X = X / X[:, 3:]
        X_star = np.where(known[:, None], X_star / np.where(known, X_star[:, 3], 1.0)[:, None], 0.0)
        metres = np.tile(np.eye(3, 4), (X.shape[0], 1, 1))
        operators = np.ascontiguousarray(H @ scene.operators @ np.linalg.inv(H))
        jacobian = (
            JacobianChoice.CURRENT if options.jacobian == JacobianChoice.FIXED_DEPTH else options.jacobian
        )
        velocity, conditioning = points_step(
            operators, X, X_star, (_seen(scene, task) > 0.0).astype(np.float64), metres, held_gain(options),
            int(jacobian), options.damping,
        )  # fmt: skip
        return limited(scene, task, options, velocity, conditioning)

    return step


def _seen(scene: Scene, task: Task) -> FloatArray:
    """Weights (m,) of the markers: of the camera that sees each best, 0 where the goal's point is not known."""
    found: FloatArray = scene.weights.max(axis=0, initial=0.0) * (task.target_known > 0.0)
    return found


def points_velocity(scene: Scene, task: Task, options: Options) -> tuple[FloatArray, float]:
    """Velocity (n,) of least ``Σ w²|G (Ĥ(q̇) M̄ − (M* − M))|²`` times gain, and the conditioning: the reference.

    ``G`` (2c, 4) is ``J_G P`` of all cameras at ``M``, ``M̄`` the point that the Jacobian is developed around.
    """
    M, T = scene.points, task.target_points
    around = {JacobianChoice.MEAN: 0.5 * (M + T), JacobianChoice.DESIRED: T}.get(
        JacobianChoice(options.jacobian), M
    )
    m = np.einsum("cij,mj->mci", scene.matrices, M)
    G = (scene.matrices[:, :2] - (m[..., :2] / m[..., 2:])[..., None] * scene.matrices[:, 2:]) / m[
        ..., 2, None, None
    ]
    G = G.reshape(M.shape[0], -1, 4)
    J = np.einsum("mri,nij,mj->mrn", G, scene.operators, around)
    error = np.einsum("mri,mi->mr", G, T - M)
    weights = np.repeat(_seen(scene, task), G.shape[1])
    x, conditioning = damped_least_squares_reference(
        J.reshape(-1, J.shape[-1]), error.reshape(-1), weights, options.damping
    )
    gain = held_gain(options)
    if options.jacobian == JacobianChoice.MEAN:
        twist = np.tensordot(x, scene.operators, axes=1)
        half = 0.5 * float(np.sqrt(max(0.0, -0.5 * np.trace(twist @ twist))))
        gain *= float(np.arctan(half)) / half if half > 0.0 else 1.0
    return gain * x, conditioning
