"""Screw motions in any projective frame: twist of an axis with a pitch, its angle, exponential in closed form, and
conversion of Euclidean twists to angular and linear velocities (thesis appendix A.1).

A twist ``X`` (4, 4) is the logarithm of a displacement ``H_RT``: ``X = θĜ + N``, Ĝ a revolute generator, N nilpotent
(the translation along the same axis), ``ĜN = NĜ = 0``, so that ``X⁴ = -θ²X²``. Displacements are scaled
to ``det H = 1``.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.lines import cross_matrix
from stereoservo.numerics.arrays import FloatArray


def screw_twist(direction: FloatArray, point: FloatArray, pitch: float = 0.0) -> FloatArray:
    """Euclidean generator (4, 4) of a screw: unit ``direction`` (3,), ``point`` (3,) on the axis [m], pitch [m/rad].

    Raises GeometryError for a direction of zero length.
    """
    length = float(np.linalg.norm(direction))
    if not length > 0:
        raise GeometryError("degenerate", "the screw's direction is zero; a unit vector is needed")
    w = np.asarray(direction, dtype=np.float64) / length
    return twist_matrix(w, np.cross(point, w) + pitch * w)


def twist_angle(X: FloatArray) -> FloatArray:
    """θ >= 0 (...) [rad] of twists ``(..., 4, 4)``: ``tr X² = -2θ²``, accurate to about 1e-8 of the norm near zero.

    Raises GeometryError if the eigenvalues are real: no rigid motion.
    """
    X = np.asarray(X, dtype=np.float64)
    squared = -0.5 * np.einsum("...ij,...ji->...", X, X)
    if not (squared >= -1e-12 * (X**2).sum(axis=(-2, -1))).all():
        raise GeometryError(
            "degenerate",
            f"tr X² is {(-2 * squared).tolist()}; that of a twist is not positive",
            squared=squared,
        )
    angle: FloatArray = np.sqrt(np.maximum(squared, 0.0))
    return angle


def exp_twist(X: FloatArray) -> FloatArray:
    """``exp(X) = I + X + (1 - cosθ)/θ² X² + (θ - sinθ)/θ³ X³`` (..., 4, 4) of any twist, θ = 0 included (A.9).

    Also the exponential of a sum ``τĤ_T + θĤ_R`` that is not aligned (errata to A.1). Raises GeometryError if the
    eigenvalues of X are not those of a twist.
    """
    X = np.asarray(X, dtype=np.float64)
    theta = twist_angle(X)[..., None, None]
    square = X @ X
    half = 0.5 * np.sinc(0.5 * theta / np.pi) ** 2
    H: FloatArray = np.eye(4) + X + half * square + _sine_excess(theta) * (square @ X)
    return H


def _sine_excess(theta: FloatArray) -> FloatArray:
    """Coefficient ``(θ - sinθ)/θ³``, accurate at 0."""
    s = theta**2
    series = (1 - s / 20 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110 * (1 - s / 156))))) / 6
    large = np.where(s > 0.25, theta, 1.0)
    result: FloatArray = np.where(s > 0.25, (large - np.sin(large)) / large**3, series)
    return result


def twist_matrix(w: FloatArray, v: FloatArray) -> FloatArray:
    """``T̂ = [[w]ₓ v; 0 0]`` (..., 4, 4) of angular ``w`` [rad/s] and linear ``v`` [m/s] (..., 3) (2.39)."""
    w, v = np.broadcast_arrays(np.asarray(w, dtype=np.float64), np.asarray(v, dtype=np.float64))
    T = np.zeros((*w.shape[:-1], 4, 4))
    T[..., :3, :3] = cross_matrix(w)
    T[..., :3, 3] = v
    return T
