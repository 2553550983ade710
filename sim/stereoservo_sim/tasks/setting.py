"""Scene of task files v1, as specified by their head comments: two cameras, a plate of four markers, limits.

Rig frame: origin mid-baseline, x from the left to the right camera, z ahead [m]. Plate: its printed face looks
along -z.
"""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.synthetic import rotation, translation

FOCAL, CENTRE_U, CENTRE_V = 800.0, 320.0, 240.0
"""Intrinsic parameters [px]."""
WIDTH, HEIGHT = 640, 480
"""Image size: a point is in view if 0 <= u < 640 and 0 <= v < 480."""
BASELINE, YAW_DEG = 0.20, 10.0
"""Baseline [m], and inward rotation of each camera [°]."""
MARKERS = np.array([(-0.05, -0.05, 0.0), (0.05, -0.05, 0.0), (0.05, 0.05, 0.0), (-0.05, 0.05, 0.0)])
"""Markers (4, 3) in the plate's frame [m]."""
FACE = np.array([0, 1, 2], dtype=np.int64)
"""Three markers that span the face."""
MIN_DEPTH = 0.01
"""Least depth [m]: a marker nearer to a camera's plane counts as behind it."""
SUCCESS_PX = 0.5
MAX_ITERATIONS = 2000
FOCAL_ERROR, HAND_EYE_ERROR_DEG = 0.1, 5.0
"""Errors of the coarse calibration: share of the focal length, angle about the task's own axis."""

HOMOGENEOUS_MARKERS = np.hstack([MARKERS, np.ones((4, 1))])


def intrinsics(scale: float = 1.0) -> FloatArray:
    """Intrinsics (3, 3) with the focal length times ``scale``."""
    return np.array([[FOCAL * scale, 0.0, CENTRE_U], [0.0, FOCAL * scale, CENTRE_V], [0.0, 0.0, 1.0]])


def camera_poses() -> FloatArray:
    """Poses rMcl, rMcr (2, 4, 4) of left and right camera in the rig's frame."""
    return np.array(
        [
            translation(-0.5 * BASELINE, 0, 0) @ rotation("y", YAW_DEG),
            translation(0.5 * BASELINE, 0, 0) @ rotation("y", -YAW_DEG),
        ]
    )


def camera_matrices(focal_scale: float = 1.0) -> FloatArray:
    """Camera matrices (2, 3, 4): points of the rig's frame to pixels."""
    K = intrinsics(focal_scale)
    return np.array([K @ np.linalg.inv(pose)[:3] for pose in camera_poses()])


def twist(direction: FloatArray, point: FloatArray | None = None) -> FloatArray:
    """Twist (4, 4): rotation about the unit ``direction`` (3,) through ``point`` (3,), or translation along it."""
    T = np.zeros((4, 4))
    if point is None:
        T[:3, 3] = direction
        return T
    x, y, z = direction
    T[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    T[:3, 3] = -T[:3, :3] @ point
    return T


def cartesian_twists(middle: FloatArray, axes: FloatArray | None = None) -> FloatArray:
    """Twists (6, 4, 4): translations along and rotations about the columns of ``axes`` (3, 3) through ``middle``
    (3,).
    """
    columns = (np.eye(3) if axes is None else axes).T
    return np.array([twist(a) for a in columns] + [twist(a, middle) for a in columns])
