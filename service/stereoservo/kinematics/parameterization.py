"""Minimal local parameters of joint generators, cameras, lenses and points for least squares, without gauge freedoms
(thesis 4.4, 5.4.2); exponentials of the joints' generators.

Conjugation preserves a generator's spectrum, so its neighbours are ``T Ĥ₀ T⁻¹`` with ``T`` from the structure group of
the stratum: GL(4), the affine or the similarity group. Directions of the group's algebra that commute with ``Ĥ₀`` do
not change it; the other directions span the chart. Their number is minimal:

    stratum      revolute   prismatic
    projective   10         6
    affine       8          3
    metric       4          3   (a direction and the scale of [m])
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereoservo.geometry.displacements import exp_generator
from stereoservo.kinematics.model import Stratum
from stereoservo.numerics.arrays import FloatArray

Kind = Literal["revolute", "prismatic"]
LensModel = Literal["none", "radial", "radial_centre", "brown"]
"""Free lens parameters of each camera: none, one radial parameter, that and its centre, or in addition the second
radial and both tangential terms.
"""
LENS_PARAMETERS = (0, 1, 2, 4, 5, 6)
"""Entries of a lens (7,) that can be free, k, cu, cv, k2, p1, p2: all but the reference radius."""

CHART_SIZE: dict[tuple[Stratum, Kind], int] = {
    ("projective", "revolute"): 10,
    ("projective", "prismatic"): 6,
    ("affine", "revolute"): 8,
    ("affine", "prismatic"): 3,
    ("metric", "revolute"): 4,
    ("metric", "prismatic"): 3,
}


def algebra(stratum: Stratum, kind: Kind) -> FloatArray:
    """Basis (a, 4, 4) of the Lie algebra whose group moves a joint of ``kind``: gl(4), aff(3), or that of the
    similarities.

    Affine and metric algebras are those of a frame whose plane at infinity is (0, 0, 0, 1). The scale is omitted for
    metric revolute joints: a translation can move the axis in the same way, and Cayley's map of both together is not in
    the group.
    """
    full = np.eye(16).reshape(16, 4, 4)
    if stratum == "projective":
        return full
    if stratum == "affine":
        return full[:12]
    basis = np.zeros((7, 4, 4))
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        basis[k, i, j], basis[k, j, i] = 1.0, -1.0
        basis[3 + k, k, 3] = 1.0
    basis[6, :3, :3] = np.eye(3)
    return basis[:6] if kind == "revolute" else basis


def generator_basis(generator: FloatArray, kind: Kind, stratum: Stratum) -> FloatArray:
    """Directions ``Δ_k`` (p, 4, 4) in which conjugation changes ``generator`` (4, 4), each by about one unit.

    Orthogonal complement of the commutant of the generator in the stratum's algebra; p as in ``CHART_SIZE``.
    """
    directions = algebra(stratum, kind)
    changes = directions @ generator - generator @ directions
    _, values, rows = np.linalg.svd(changes.reshape(len(directions), 16).T)
    p = CHART_SIZE[stratum, kind]
    coefficients = rows[:p] / values[:p, None]
    basis: FloatArray = np.einsum("pa,aij->pij", coefficients, directions)
    return basis


def conjugation(basis: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Group element ``T(x)`` (4, 4) of a chart and its left-trivialised derivatives ``dT/dx_k T⁻¹`` (p, 4, 4).

    Cayley's map ``(I - Δ/2)⁻¹ (I + Δ/2)`` stays in GL(4), in the affine and in the Euclidean group, and
    ``dT T⁻¹ = (I - Δ/2)⁻¹ dΔ (I + Δ/2)⁻¹``.
    """
    half = 0.5 * np.einsum("p,pij->ij", x, basis)
    left = np.linalg.inv(np.eye(4) - half)
    right = np.linalg.inv(np.eye(4) + half)
    return left @ (np.eye(4) + half), left @ basis @ right


def exponentials(generators: FloatArray, kinds: tuple[Kind, ...], q: FloatArray) -> FloatArray:
    """``exp(q_j Ĥ_j)`` (s, n, 4, 4) for joint vectors ``q`` (s, n) (4.27, 3.21)."""
    steps = [exp_generator(kind, generators[j], q[:, j]) for j, kind in enumerate(kinds)]
    return np.stack(steps, axis=1)


def camera_basis(matrix: FloatArray, role: Literal["right", "other", "left_metric"], stratum: Stratum) -> FloatArray:
    """Directions (p, 3, 4) of a camera ``matrix`` (3, 4) without gauge freedoms.

    ``other``: all but the matrix's scale (11). ``right``: in addition without changes of frame that keep the left
    camera: 4 freedoms in the projective stratum (7 remain), 1 in the affine and metric strata (10 remain).
    ``left_metric``: the five entries of ``K`` in ``K [I | 0]``.
    """
    if role == "left_metric":
        basis = np.zeros((5, 3, 4))
        for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2))):
            basis[k, i, j] = 1.0
        return basis
    fixed = [matrix.ravel()]
    if role == "right":
        for column in range(4) if stratum == "projective" else (3,):
            change = np.zeros((3, 4))
            change[:, column] = matrix[:, 3]
            fixed.append(change.ravel())
    rows = np.linalg.svd(np.array(fixed))[2]
    return rows[len(fixed) :].reshape(-1, 3, 4)


def lens_basis(model: LensModel) -> FloatArray:
    """Free directions (p, 7) of a lens (k, cu, cv, r0, k2, p1, p2): see `LensModel`."""
    free = {"none": 0, "radial": 1, "radial_centre": 3, "brown": 6}[model]
    return np.asarray(np.eye(7)[list(LENS_PARAMETERS[:free])])


def lens_model_of(lenses: FloatArray) -> LensModel:
    """The lens model of the fit that returned ``lenses`` (c, 4 or 7)."""
    if lenses[:, 4:].any():
        return "brown"
    return "radial_centre" if lenses[:, 0].any() else "none"


def point_bases(points: FloatArray, stratum: Stratum) -> FloatArray:
    """Directions (m, 3, 4) of points (m, 4): all but their scale, or the three finite coordinates if affine."""
    if stratum != "projective":
        return np.tile(np.eye(4)[:3], (len(points), 1, 1))
    return np.asarray(np.linalg.svd(points[:, None, :])[2][:, 1:])
