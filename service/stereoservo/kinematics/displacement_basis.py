"""Six twists that span all displacements of a metric frame, in the projective frame of a model."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray


def displacement_basis(projective_to_euclidean: FloatArray, points: FloatArray) -> FloatArray:
    """Twists (6, 4, 4): translations along three axes, then rotations about them through the middle of ``points``
    (m, 4). A unit of translation is the largest distance of a point from the middle, so that all six are of one size.
    """
    H = np.asarray(projective_to_euclidean, dtype=np.float64)
    euclidean = points @ H.T
    euclidean = euclidean[:, :3] / euclidean[:, 3:]
    middle = euclidean.mean(axis=0)
    size = float(np.sqrt(((euclidean - middle) ** 2).sum(axis=1).max())) or 1.0
    basis = np.zeros((6, 4, 4))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        basis[k, k, 3] = size
        basis[3 + k, j, i], basis[3 + k, i, j] = 1.0, -1.0
        basis[3 + k, j, 3], basis[3 + k, i, 3] = -middle[i], middle[j]
    twists: FloatArray = np.linalg.inv(H) @ basis @ H
    return twists
