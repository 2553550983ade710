"""General screws in any frame: logarithm, pitch, axis, split into commuting rotation and translation (thesis A.1).

A twist ``X`` (4, 4) is the logarithm of a displacement ``H_RT``: ``X = θĜ + N``, Ĝ a revolute generator, N nilpotent
(the translation along the same axis), ``ĜN = NĜ = 0``, so that ``X⁴ = -θ²X²``. Displacements are normalised
(`displacement_logarithms.normalise_displacement`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oracles.displacement_logarithms import log_rotation, rotation_angle
from oracles.screw_transfer import twist_vectors
from stereoservo.geometry.displacements import conjugate, nearest_rotation_generator
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.screws import (
    _sine_excess,
    twist_angle,
)
from stereoservo.numerics.arrays import FloatArray

NO_TURN = 1e-6
"""Angle, relative to the twist's norm, below which a turn cannot be told from none: its square is rounding."""
NEAR_HALF_TURN = 0.75 * np.pi
"""Angle [rad] from which on the logarithm reads the axis from the eigenspaces: the odd part fades at π."""


def exp_screw(G: FloatArray, theta: npt.ArrayLike) -> FloatArray:
    """``exp(θĜ) = I - sinθ Ĝ³ + (1 - cosθ) Ĝ² + θ(Ĝ³ + Ĝ)`` (A.9): ``G`` (..., 4, 4) with eigenvalues 0, 0, ±i.

    ``theta`` (...) [rad]. A twist of any size, a translation included, goes to `exp_twist`.
    """
    angle = np.asarray(theta, dtype=np.float64)[..., None, None]
    square = G @ G
    cube = square @ G
    H: FloatArray = np.eye(4) - np.sin(angle) * cube + 2.0 * np.sin(0.5 * angle) ** 2 * square + angle * (cube + G)
    return H


def log_displacement(H: FloatArray) -> FloatArray:
    """Twist ``X`` (4, 4), θ in [0, π), with ``exp(X) = H`` of any displacement ``H`` (4, 4), normalised (A.10-A.14).

    With the odd part ``H⁻ = (H - H⁻¹)/2``, ``X = H⁻ - (θ - sinθ)/sin³θ (H⁻)³``: exact at the identity and for
    translations. Near θ = π, where H⁻ fades, the rotation is read between the eigenspaces of the even part, as in
    `log_rotation`. Raises GeometryError where H is not normalised and for half a turn, which has two logarithms
    (`screw_axis` still tells the axis).
    """
    theta = rotation_angle(H)
    determinant = float(np.linalg.det(H))
    if not abs(determinant - 1.0) < 1e-6:
        raise GeometryError(
            "orientation",
            f"det H is {determinant:.6g}; scale the displacement to 1 first (normalise_displacement)",
            determinant=determinant,
        )
    odd = 0.5 * (H - np.linalg.inv(H))
    if theta < NEAR_HALF_TURN:
        ratio = _sine_excess(np.asarray(theta)) / np.sinc(theta / np.pi) ** 3
        near: FloatArray = odd - float(ratio) * (odd @ odd @ odd)
        return near
    plane = _rotation_plane(H, theta)
    rest = np.eye(4) - plane
    G, theta = log_rotation(rest + plane @ H)
    X: FloatArray = theta * G + rest @ odd @ rest
    return X


def _rotation_plane(H: FloatArray, theta: float) -> FloatArray:
    """Projector (4, 4) of rank two onto the eigenspace of ``exp(±iθ)``, along that of 1: ``(H⁺ - I)/(cosθ - 1)``."""
    even = 0.5 * (H + np.linalg.inv(H)) - np.eye(4)
    projector: FloatArray = -even / (2.0 * np.sin(0.5 * theta) ** 2)
    return projector


@dataclass(frozen=True)
class Screw:
    """A twist split into two that commute, ``X = angle * rotation + translation``: its exponential is their product.

    ``angle`` [rad], 0 for a pure translation; ``rotation`` (4, 4) a revolute generator, zero if the angle is;
    ``translation`` (4, 4) nilpotent, zero for a pure rotation.
    """

    angle: float
    rotation: FloatArray
    translation: FloatArray


def split_twist(X: FloatArray) -> Screw:
    """Commuting rotation and translation of a twist ``X`` (4, 4): ``θĜ = -X³/θ²``, ``N = X - θĜ`` (A.9, A.15).

    A turn below `NO_TURN` of the norm counts as none: the axis of so small a turn lies at infinity. Raises
    GeometryError where X is no twist.
    """
    X = np.asarray(X, dtype=np.float64)
    theta = float(twist_angle(X))
    if theta <= NO_TURN * float(np.linalg.norm(X)):
        return Screw(0.0, np.zeros((4, 4)), X.copy())
    G = X / theta
    cube = G @ G @ G
    return Screw(theta, -cube, X + theta * cube)


def screw_pitch(X: FloatArray, H_projective_to_euclidean: FloatArray | None = None) -> float:
    """Pitch ``wᵀv/|w|²`` [m/rad] of a twist ``X`` (4, 4) in the frame that ``H_PE`` (4, 4) upgrades; default Euclidean.

    A length: it needs the Euclidean frame. Whether it is zero does not (`split_twist`: the translation vanishes).
    Raises GeometryError for a pure translation and where the upgraded twist is none.
    """
    T = X if H_projective_to_euclidean is None else conjugate(H_projective_to_euclidean, X)
    w, v = twist_vectors(T, tolerance=1e-6)
    square = float(w @ w)
    if not square > NO_TURN**2 * float(square + v @ v):
        raise GeometryError("degenerate", "the motion is a translation; its pitch is infinite")
    return float(w @ v) / square


def screw_axis(H: FloatArray) -> FloatArray:
    """Two orthonormal points ``(2, 4)`` on the axis of any displacement ``H`` (4, 4), normalised, half turns included.

    The line that the motion maps to itself: the kernel of ``X²``, near half a turn of the even part. Raises
    GeometryError for a translation or the identity, which has no axis.
    """
    theta = rotation_angle(H)
    if theta < NEAR_HALF_TURN:
        X = log_displacement(H)
        if float(twist_angle(X)) <= NO_TURN * float(np.linalg.norm(X)):
            raise GeometryError("degenerate", f"the motion turns by {theta:.3g} rad; it has no axis", theta=theta)
        operator = X @ X
    else:
        operator = _rotation_plane(H, theta)
    return np.ascontiguousarray(np.linalg.svd(operator)[2][2:])


def nearest_twist(A: FloatArray) -> FloatArray:
    """An exact twist (``X⁴ = -θ²X²``) near a measured one ``A`` (4, 4), which turns.

    The rotation from the complex eigenvectors (`nearest_rotation_generator`); in the two directions that it leaves,
    the nearest nilpotent. Raises GeometryError where A has no complex pair of eigenvalues.
    """
    A = np.asarray(A, dtype=np.float64)
    G = nearest_rotation_generator(A)
    theta = -0.5 * float(np.trace(G @ A))
    rest = np.eye(4) + G @ G
    columns = np.linalg.svd(rest)[0][:, :2]
    rows = columns.T @ rest
    X: FloatArray = theta * G + columns @ _nearest_nilpotent(rows @ A @ columns) @ rows
    return X


def _nearest_nilpotent(B: FloatArray) -> FloatArray:
    """Nearest nilpotent to ``B`` (2, 2): its symmetric part free of trace and its odd part get one size."""
    even = np.array([0.5 * (B[0, 0] - B[1, 1]), 0.5 * (B[0, 1] + B[1, 0])])
    odd = 0.5 * (B[0, 1] - B[1, 0])
    size = float(np.linalg.norm(even))
    middle = 0.5 * (size + abs(odd))
    # Without a symmetric part all directions are as near.
    x, y = even * (middle / size) if size > 0 else (middle, 0.0)
    z = np.copysign(middle, odd)
    return np.array([[x, y + z], [y - z, -x]])
