"""From the projective to the affine and metric strata: plane at infinity (5.59), intrinsics, metric start (5.4.3-5.4.4).

Frames: projective ``P`` with ``P_left = [N⁻¹ | 0]``; affine ``A`` with the plane at infinity (0, 0, 0, 1) and the same left
camera; Euclidean ``E`` with ``P_left = [K | 0]``. A generator's upper block in ``A`` is ``K̃ [w]ₓ K̃⁻¹`` with ``K̃ = N K``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.displacements import nearest_rotation_generator, nearest_translation_generator
from stereoservo.kinematics.calibration.bundle import Rig

FloatArray = npt.NDArray[np.float64]

SEPARATION = 10.0
"""How far a singular value must stand above its noise to count as not zero."""


def plane_at_infinity(generators: FloatArray, noise: float) -> tuple[FloatArray, bool]:
    """Plane (4,) that all generators (n, 4, 4) leave fixed, and whether it is the only one: ``ker`` of the stack of ``-Ĥᵀ``.

    ``noise``: standard deviation of a generator's entries. Where axes are parallel a pencil of planes is left; then
    the one nearest to (0, 0, 0, 1), the infinity of the canonical frame's nominal cameras, is given.
    """
    stack = -generators.transpose(0, 2, 1).reshape(-1, 4)
    _, values, rows = np.linalg.svd(stack)
    floor = max(SEPARATION * noise * np.sqrt(len(stack)), 1e-9 * values[0])
    unique = bool(values[2] > floor and values[2] > SEPARATION * values[3])
    kernel = rows[3:] if unique else rows[values <= max(floor, values[3])]
    plane: FloatArray = kernel.T @ kernel[:, 3]
    return plane, unique


def scaled_plane(plane: FloatArray, points: FloatArray) -> FloatArray | None:
    """``plane`` (4,) scaled to mean height 1 over points (m, 4) of depth 1; None when it passes between the points."""
    heights = points @ plane / points[:, 2]
    mean = float(heights.mean())
    if mean == 0.0 or (heights / mean).min() <= 0.0:
        return None
    result: FloatArray = plane / mean
    return result


def affine_rig(rig: Rig, plane: FloatArray) -> tuple[Rig, FloatArray]:
    """The rig in the affine frame of ``plane`` (4,), generators snapped to it, and ``H_PA`` (4, 4)."""
    upgrade = np.eye(4)
    upgrade[3] = plane
    back = np.linalg.inv(upgrade)
    points = rig.points @ upgrade.T
    points = points / points[:, 3:]
    generators = upgrade @ rig.generators @ back
    generators[:, 3] = 0.0
    for j, kind in enumerate(rig.kinds):
        if kind == "revolute":
            generators[j] = nearest_rotation_generator(generators[j])
            generators[j, 3] = 0.0
        else:
            generators[j] = _translation(generators[j])
    return Rig(rig.kinds, generators, rig.cameras @ back, points), upgrade


def _translation(generator: FloatArray) -> FloatArray:
    result = np.zeros((4, 4))
    result[:3, 3] = generator[:3, 3]
    # A direction that vanishes in the noise has no chart; the nilpotent form keeps its main part.
    return result if np.linalg.norm(result) > 0 else nearest_translation_generator(generator)


def image_of_absolute_conic(generators: FloatArray, revolute: npt.NDArray[np.bool_], noise: float) -> FloatArray | None:
    """Dual image ``Ω = K̃ K̃ᵀ`` (3, 3), ``Ω₃₃ = 1``, from affine generators (n, 4, 4): ``A Ω + Ω Aᵀ = 0``, linear.

    None where the rotations do not determine it (fewer than two directions of axes) or noise leaves it indefinite.
    """
    blocks = generators[revolute, :3, :3]
    if len(blocks) < 2:
        return None
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        basis[k, i, j] = basis[k, j, i] = 1.0
    system = blocks[:, None] @ basis + basis @ blocks[:, None].transpose(0, 1, 3, 2)
    _, values, rows = np.linalg.svd(system.transpose(0, 2, 3, 1).reshape(-1, 6))
    if values[4] <= max(SEPARATION * noise * np.sqrt(9 * len(blocks)), 3.0 * values[5], 1e-9 * values[0]):
        return None
    omega = np.tensordot(rows[5], basis, axes=1)
    if omega[2, 2] == 0.0:
        return None
    omega = omega / omega[2, 2]
    return omega if np.linalg.eigvalsh(omega)[0] > 0.0 else None


def triangular_root(omega: FloatArray) -> FloatArray:
    """Upper triangular ``K̃`` (3, 3), positive diagonal, ``K̃₃₃ = 1``, with ``K̃ K̃ᵀ ~ Ω``. Raises LinAlgError if indefinite."""
    flip = np.eye(3)[::-1]
    root: FloatArray = flip @ np.linalg.cholesky(flip @ omega @ flip) @ flip
    return root / root[2, 2]


def metric_rig(rig: Rig, intrinsics: FloatArray) -> Rig:
    """The affine ``rig`` in the Euclidean frame of ``K̃`` (3, 3): generators snapped to unit twists without pitch."""
    back = np.eye(4)
    back[:3, :3] = intrinsics
    upgrade = np.linalg.inv(back)
    generators = upgrade @ rig.generators @ back
    for j, kind in enumerate(rig.kinds):
        if kind == "revolute":
            generators[j] = _unit_twist(generators[j])
    return Rig(rig.kinds, generators, rig.cameras @ back, rig.points @ upgrade.T)


def _unit_twist(generator: FloatArray) -> FloatArray:
    skew = 0.5 * (generator[:3, :3] - generator[:3, :3].T)
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    axis /= np.linalg.norm(axis)
    result = np.zeros((4, 4))
    result[:3, :3] = [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]
    result[:3, 3] = generator[:3, 3] - axis * (axis @ generator[:3, 3])
    return result


def projective_frame(normaliser: FloatArray, intrinsics: FloatArray, plane: FloatArray) -> FloatArray:
    """``H_EP`` (4, 4): Euclidean points into the projective frame in which ``plane`` (4,) is the plane at infinity.

    ``intrinsics`` (3, 3) = K; the left camera becomes ``[N⁻¹ | 0]`` and ``plane @ (H_EP X) = 1`` for ``X`` of height 1.
    """
    frame = np.zeros((4, 4))
    frame[:3, :3] = normaliser @ intrinsics
    frame[3, :3] = -plane[:3] @ frame[:3, :3] / plane[3]
    frame[3, 3] = 1.0 / plane[3]
    return frame
