"""Cartesian control with one rotation (thesis 8.55): the centre on a straight line, the body turned about one axis."""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import LawStep, Options, Scene, Task
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.trajectory.primitives import TRANSLATION
from stereoservo.trajectory.three_points import ComponentStatus, DegenerateFaceError, decompose

ROTATION = "rotation of the body about its centre"
COMPONENTS = (TRANSLATION, ROTATION)
UNITS = ("", "rad")


def one_rotation(
    H_r: FloatArray, theta_r: float, H_p: FloatArray, theta_p: float
) -> tuple[FloatArray, float]:
    """``Ĥ_s`` (eigenvalues ±i) and θ_s in [0, π] of ``exp(θ_rĤ_r)exp(θ_pĤ_p)`` (8.50 to 8.52, errata)."""
    s_r, c_r, s_p, c_p = np.sin(theta_r / 2), np.cos(theta_r / 2), np.sin(theta_p / 2), np.cos(theta_p / 2)
    cosine = c_r * c_p + s_r * s_p * np.trace(H_r @ H_p) / 2
    V = s_r * c_p * H_r + c_r * s_p * H_p + s_r * s_p * (H_r @ H_p - H_p @ H_r)
    sine = float(np.sqrt(max(0.0, -0.5 * np.trace(V @ V))))
    if cosine < 0.0:
        V, cosine = -V, -cosine
    if not sine > 0.0:
        return np.zeros((4, 4)), 0.0
    return V / sine, 2.0 * float(np.arctan2(sine, cosine))


def cartesian2(scene: Scene, task: Task, options: Options) -> LawStep:
    """(8.55)."""
    n = scene.operators.shape[0]
    try:
        parts = decompose(
            scene.operators, scene.points[task.face], task.target_points[task.face], task.centre, task.centre_target,
            scene.camera_centres,
        )  # fmt: skip
    except DegenerateFaceError:
        return LawStep(np.zeros(n), np.zeros(2), np.zeros(2), np.full(2, int(ComponentStatus.NO_FACE)), 1.0)
    H_s, theta_s = one_rotation(
        parts.hinge.operator, parts.hinge.amount, parts.planar.operator, parts.planar.amount
    )
    basis = scene.operators.reshape(n, 16).T
    q_s = np.linalg.lstsq(basis, H_s.reshape(16), rcond=1e-4)[0]
    velocity = options.gain * (parts.translation.allowed * parts.translation.screw + theta_s * q_s)
    status = (
        int(parts.hinge.status) if parts.hinge.status != ComponentStatus.DONE else int(parts.planar.status)
    )
    return LawStep(
        velocity,
        np.array([parts.translation.amount, theta_s]),
        np.array([parts.translation.allowed, theta_s]),
        np.array([int(parts.translation.status), status]),
        1.0,
    )
