"""Path of a displacement about a centre: a translation along a line and a rotation (thesis 7.3-7.17)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from oracles.displacement_logarithms import HALF_TURN_SINE, log_rotation, rotation_angle, rotation_axis
from stereoservo.geometry.displacements import conjugate, exp_rotation, exp_translation
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.cartesian_path import CartesianPath
from stereoservo.planning.motion_frame import (
    DECAY,
    ENDS,
    EXPONENTIAL,
    FIRST,
    HANDS_OVER,
    LAST,
    motion_frame,
    progress,
)
from stereoservo.planning.path_search import shapes
from stereoservo.planning.plan import Profile

KEEPS_PLANE = 1e-6
"""Change of the plane at infinity under the displacement, relative to its norm, above which the two do not fit."""


@dataclass(frozen=True, eq=False)
class DisplacementPath:
    """``H_C = H_T(τ) H_R(θ)`` about ``centre`` (4,) (7.3, 7.9): ``H_T = I + τ k a∞ᵀ``, ``H_R = exp(θĤ_R)``.

    ``way`` k (4,) and ``plane`` a∞ (4,), scaled to ``a∞ᵀ centre = 1``; ``generator`` Ĥ_R (4, 4), zero where nothing
    turns; ``angle`` θ* in [0, π] [rad]; τ* = 1. Profiles of translation and rotation.
    """

    centre: FloatArray
    plane: FloatArray
    way: FloatArray
    generator: FloatArray
    angle: float
    profile: Profile = "linear"

    def translation(self, tau: float) -> FloatArray:
        """``H_T(τ)`` (4, 4) (7.7)."""
        H: FloatArray = np.eye(4) + tau * np.outer(self.way, self.plane)
        return H

    def rotation(self, theta: float) -> FloatArray:
        """``H_R(θ)`` (4, 4) about the centre's initial position (7.6)."""
        return exp_rotation(self.generator, theta)

    def displacement(self, sigma: float) -> FloatArray:
        """``H_C(σ)`` (4, 4) for σ in [0, 1] (7.9, 7.10)."""
        tau, theta, _, _ = self._amounts(sigma)
        H: FloatArray = self.translation(tau) @ self.rotation(theta)
        return H

    def spatial_velocity(self, sigma: float) -> FloatArray:
        """``Ĥ_C = Ĥ_T + H_T Ĥ_R H_T⁻¹`` (4, 4) per unit of σ (7.13)."""
        tau, _, tau_rate, theta_rate = self._amounts(sigma)
        translation = tau_rate * np.outer(self.way, self.plane)
        velocity: FloatArray = translation + theta_rate * conjugate(self.translation(tau), self.generator)
        return velocity

    def body_velocity(self, sigma: float) -> FloatArray:
        """``Ȟ_C = H_R⁻¹ Ĥ_T H_R + Ĥ_R`` (4, 4) per unit of σ (7.17)."""
        _, theta, tau_rate, theta_rate = self._amounts(sigma)
        translation = tau_rate * np.outer(self.way, self.plane)
        velocity: FloatArray = conjugate(self.rotation(-theta), translation) + theta_rate * self.generator
        return velocity

    def drive(self, points: FloatArray, sigma: float) -> FloatArray:
        """Points (..., 4) of any body rigidly attached, at σ: a grasped tool, a gripper (fig. 7.6)."""
        moved: FloatArray = np.asarray(points, dtype=np.float64) @ self.displacement(sigma).T
        return moved

    def _amounts(self, sigma: float) -> tuple[float, float, float, float]:
        away = float(np.linalg.norm(self.way))
        of_translation, of_rotation, _ = shapes(self.profile, (away, self.angle, 0.0))
        return (
            progress(of_translation, sigma),
            self.angle * progress(of_rotation, sigma),
            progress_rate(of_translation, sigma),
            self.angle * progress_rate(of_rotation, sigma),
        )


def displacement_path(
    H: FloatArray,
    centre: FloatArray,
    plane: FloatArray,
    operators: FloatArray | None = None,
    profile: Profile = "linear",
) -> DisplacementPath:
    """Decompose a displacement ``H`` (4, 4), normalised, about ``centre`` (4,), with ``plane`` (4,) at infinity
    (7.4-7.8).

    Half a turn tells its axis, not its generator; then ``operators`` (k, 4, 4), of joints that turn about two
    directions or more, are needed, and the sense is free. Raises GeometryError: ``degenerate`` where H does not keep
    the plane or the centre lies in it, ``half_turn`` without operators.
    """
    height = float(plane @ centre)
    size = float(np.linalg.norm(plane))
    if not abs(height) > KEEPS_PLANE * size * float(np.linalg.norm(centre)):
        raise GeometryError("degenerate", f"the centre {centre.tolist()} lies in the plane at infinity")
    change = float(np.linalg.norm(plane @ H - plane)) / size
    if not change < KEEPS_PLANE:
        raise GeometryError(
            "degenerate",
            f"the displacement changes the plane at infinity by {change:.3g} of it; both must be of one frame, the "
            "displacement normalised (normalise_displacement)",
            change=change,
        )
    plane = plane / height
    way = H @ centre - centre  # (7.8), heights 1 for a centre of height 1
    H_R = (np.eye(4) - np.outer(way, plane)) @ H
    angle = rotation_angle(H_R)
    if angle < HALF_TURN_SINE:
        return DisplacementPath(centre, plane, way, np.zeros((4, 4)), 0.0, profile)
    if math.pi - angle < HALF_TURN_SINE and operators is not None:
        generator = _generator_about(rotation_axis(H_R), centre, plane, operators)
        return DisplacementPath(centre, plane, way, generator, math.pi, profile)
    generator, angle = log_rotation(H_R)
    return DisplacementPath(centre, plane, way, generator, angle, profile)


def _generator_about(axis: FloatArray, centre: FloatArray, plane: FloatArray, operators: FloatArray) -> FloatArray:
    """Generator (4, 4) of the rotation about the line of two points ``axis`` (2, 4) through ``centre`` (4,)."""
    frame = motion_frame(operators, plane, centre / (plane @ centre), np.zeros((0, 4)))
    if not np.isfinite(frame).all():
        raise GeometryError("half_turn", "the operators leave no frame to turn in; joints that turn are needed")
    points = np.linalg.solve(frame, axis.T).T
    # the axis's point at infinity: the combination of its two points of height zero
    direction = (points[0] * points[1, 3] - points[1] * points[0, 3])[:3]
    x, y, z = direction / np.linalg.norm(direction)
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    return conjugate(frame, twist)


def _first_rate(sigma: float) -> float:
    rate = 2.0 / (HANDS_OVER + ENDS)
    if sigma <= HANDS_OVER:
        return rate
    if sigma >= ENDS:
        return 0.0
    x = (sigma - HANDS_OVER) / (ENDS - HANDS_OVER)
    return rate * 0.5 * (1.0 + math.cos(math.pi * x))


def progress_rate(shape: float, sigma: float) -> float:
    """``dμ/dσ`` of one component."""
    sigma = min(1.0, max(0.0, sigma))
    if shape == FIRST:
        return _first_rate(sigma)
    if shape == LAST:
        return _first_rate(1.0 - sigma)
    if shape == EXPONENTIAL:
        return -DECAY * math.exp(-DECAY * sigma) / math.expm1(-DECAY)
    return 1.0


def cartesian_velocity(path: CartesianPath, sigma: float) -> FloatArray:
    """``(dH_c/dσ) H_c⁻¹`` (4, 4) of a path of three components (7.25)."""
    d = path.decomposition
    amounts = (d.translation.amount, d.hinge.amount, d.planar.amount)
    tau, theta_r, _ = path.amounts(sigma)
    rates = [
        whole * progress_rate(shape, sigma) for whole, shape in zip(amounts, shapes(path.profile, amounts), strict=True)
    ]
    H_t = exp_translation(d.translation.operator, tau)
    H_tr = H_t @ exp_rotation(d.hinge.operator, theta_r)
    velocity: FloatArray = (
        rates[0] * d.translation.operator
        + rates[1] * conjugate(H_t, d.hinge.operator)
        + rates[2] * conjugate(H_tr, d.planar.operator)
    )
    return velocity
