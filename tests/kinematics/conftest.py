"""Synthetic cells as a chain and cameras in a random projective frame: what a perfect calibration would find."""

import numpy as np
import pytest

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.joint_sights import SeenChain


def perfect(cell, seed, zero=None):
    """``SeenChain`` and points (m, 4) of a synthetic cell, from its flange's poses alone."""
    rng = np.random.default_rng(seed)
    frame = np.eye(4) + 0.1 * rng.normal(size=(4, 4))
    back = np.linalg.inv(frame)
    zero = cell.home if zero is None else zero

    def displacement(q):
        now, rest = cell.flange(q), cell.flange(zero)
        return now @ np.linalg.inv(rest) if cell.mount == "eye_to_hand" else np.linalg.inv(now) @ rest

    generators, h = [], 1e-3
    for unit, kind in zip(np.eye(len(zero)), cell.kinds, strict=True):
        step = displacement(zero + h * unit) - displacement(zero - h * unit)
        generators.append(frame @ step @ back / (2 * np.sin(h) if kind == "revolute" else 2 * h))
    cameras = np.array([K @ pose[:3] for K, pose in zip(cell.intrinsics, cell.poses, strict=True)]) @ back
    chain = ProjectiveChain(cell.kinds, np.array(generators), zero, cell.mount == "eye_in_hand")
    return SeenChain(chain, cameras, cell.lenses, cell.joint_names), cell.markers(zero[None])[0] @ frame.T


@pytest.fixture
def perfect_calibration():
    return perfect
