"""A Euclidean stereo rig as independent truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 640, 480


def cross_matrix(t):
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


@dataclass(frozen=True)
class Rig:
    """Two cameras that look at a point ``distance`` [m] ahead; F from K, R, t, not from projection
    matrices.
    """

    focal: float = 800.0
    baseline: float = 0.2
    vergence_deg: float = 20.0
    roll_deg: float = 3.0

    @property
    def K(self):
        return np.array([[self.focal, 0, 319.5], [0, self.focal, 239.5], [0, 0, 1.0]])

    @property
    def R(self):
        """Left to right coordinates."""
        return Rotation.from_euler("yz", [self.vergence_deg, self.roll_deg], degrees=True).as_matrix()

    @property
    def t(self):
        return -self.R @ np.array([self.baseline, 0.01, 0.02])

    @property
    def Ps(self):
        left = self.K @ np.hstack([np.eye(3), np.zeros((3, 1))])
        return np.stack([left, self.K @ np.hstack([self.R, self.t[:, None]])])

    @property
    def F(self):
        K_inverse = np.linalg.inv(self.K)
        F = K_inverse.T @ cross_matrix(self.t) @ self.R @ K_inverse
        return F / np.linalg.norm(F)

    def points(self, rng, n):
        """Homogeneous points (n, 4) of height 1 around where the optical axes cross."""
        distance = self.baseline / np.tan(np.deg2rad(self.vergence_deg))
        X = rng.uniform(-0.3, 0.3, (n, 3)) * distance + [0, 0, distance]
        return np.hstack([X, np.ones((n, 1))])

    def pixels(self, X):
        """(2, n, 2) by hand, one camera after the other."""
        images = []
        for P in self.Ps:
            m = (P @ X.T).T
            images.append(m[:, :2] / m[:, 2:])
        return np.stack(images)


@pytest.fixture(scope="session")
def make_rig():
    return Rig


@pytest.fixture(scope="session")
def rig():
    return Rig()
