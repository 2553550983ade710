"""The law on points in numpy: the readable reference of the kernel in `control.laws.points`."""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import JacobianChoice, Options, Scene, Task
from stereoservo.control.laws.stereo import held_gain
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.benchmarks.cycle import damped_least_squares_reference


def _seen(scene: Scene, task: Task) -> FloatArray:
    """Weights (m,) of the markers: of the camera that sees each best, 0 where the goal's point is not known."""
    found: FloatArray = scene.weights.max(axis=0, initial=0.0) * (task.target_known > 0.0)
    return found


def points_velocity(scene: Scene, task: Task, options: Options) -> tuple[FloatArray, float]:
    """Velocity (n,) of least ``Σ w²|G (Ĥ(q̇) M̄ − (M* − M))|²`` times gain, and the conditioning: the reference.

    ``G`` (2c, 4) is ``J_G P`` of all cameras at ``M``, ``M̄`` the point that the Jacobian is developed around.
    """
    M, T = scene.points, task.target_points
    around = {JacobianChoice.MEAN: 0.5 * (M + T), JacobianChoice.DESIRED: T}.get(JacobianChoice(options.jacobian), M)
    m = np.einsum("cij,mj->mci", scene.matrices, M)
    G = (scene.matrices[:, :2] - (m[..., :2] / m[..., 2:])[..., None] * scene.matrices[:, 2:]) / m[..., 2, None, None]
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
