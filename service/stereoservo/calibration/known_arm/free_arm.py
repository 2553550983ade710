"""Trial data of known displacements: poses of a body as the positions of a free arm, three translations and three
rotations along and about known axes, in place of the joints of an arm whose axes are to be learnt.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.trial_data import CalibrationError, TrialCamera, TrialData
from stereoservo.geometry.screws import screw_twist
from stereoservo.kinematics.parameterization import Kind
from stereoservo.numerics.arrays import FloatArray

NAMES = ("x", "y", "z", "rz", "ry", "rx")
"""Joints of a free arm, base first."""
KINDS: tuple[Kind, ...] = ("prismatic", "prismatic", "prismatic", "revolute", "revolute", "revolute")
RIGID = 1e-6
"""Largest entry of RᵀR - 1 with which a displacement is taken for a rigid one."""


def free_arm(displacements: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions (s, 6) [m, rad] and generators (6, 4, 4) of a free arm that makes ``displacements`` (s, 4, 4) [m] of a
    body, and the displacement (4, 4) at its zero: their middle.

    ``D = E_x E_y E_z E_rz E_ry E_rx D_zero``, with the rotations about the zero's origin. Raises CalibrationError
    (``bad_data``) for a displacement that is not rigid.
    """
    D = np.asarray(displacements, dtype=np.float64)
    _check_rigid(D)
    zero = np.eye(4)
    zero[:3, :3] = Rotation.from_matrix(D[:, :3, :3]).mean().as_matrix()
    zero[:3, 3] = D[:, :3, 3].mean(axis=0)
    turns = Rotation.from_matrix(D[:, :3, :3] @ zero[:3, :3].T)
    positions = np.hstack([D[:, :3, 3] - zero[:3, 3], turns.as_euler("ZYX")])
    generators = np.zeros((6, 4, 4))
    generators[[0, 1, 2], [0, 1, 2], 3] = 1.0
    generators[3:] = [screw_twist(axis, zero[:3, 3]) for axis in np.eye(3)[::-1]]
    return positions, generators, zero


def _check_rigid(D: FloatArray) -> None:
    if D.ndim != 3 or D.shape[1:] != (4, 4) or not len(D):
        raise CalibrationError(
            "bad_data", f"displacements of shape {D.shape}; (s, 4, 4) with at least one are needed"
        )
    off = np.abs(D[:, :3, :3].transpose(0, 2, 1) @ D[:, :3, :3] - np.eye(3)).max(axis=(1, 2))
    off = np.maximum(off, np.abs(D[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1))
    wrong = ~(off <= RIGID) | ~(np.linalg.det(D[:, :3, :3]) > 0.0) | ~np.isfinite(D).all(axis=(1, 2))
    if wrong.any():
        stop = int(np.flatnonzero(wrong)[0])
        raise CalibrationError(
            "bad_data",
            f"displacement {stop} is not rigid: RᵀR differs from 1 by {off[stop]:.3g}, at most {RIGID:g} is taken, and "
            "its last row must be 0 0 0 1",
            stop=stop,
        )


def trials_of_poses(
    displacements: FloatArray,
    cameras: Sequence[TrialCamera],
    marker_ids: Sequence[int],
    pixels: FloatArray,
    sigmas: FloatArray,
) -> TrialData:
    """Trial data of a body with markers at known ``displacements`` (s, 4, 4) [m], as from a robot that reports its
    hand's poses; ``pixels`` (c, s, m, 2) and ``sigmas`` (c, s, m) as there.

    Raises CalibrationError (``bad_data``).
    """
    positions, generators, _ = free_arm(displacements)
    return TrialData(
        joint_names=NAMES,
        joint_kinds=KINDS,
        cameras=tuple(cameras),
        marker_ids=tuple(marker_ids),
        positions=positions,
        trials=np.full(len(positions), -1),
        pixels=pixels,
        sigmas=sigmas,
        images=int(np.isfinite(pixels).all(axis=-1).any(axis=-1).sum()),
        generators=generators,
    )
