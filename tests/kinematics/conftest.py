"""Synthetic cells as a chain and cameras in a random projective frame: what a perfect calibration would find."""

import numpy as np
import pytest

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.joint_reprojection import ObservedChain, observed_chain
from stereoservo_sim.world.exact_model import exact_model


def perfect(cell, seed, zero=None):
    """``ObservedChain`` and points (m, 4) of a synthetic cell."""
    frame = np.eye(4) + 0.1 * np.random.default_rng(seed).normal(size=(4, 4))
    back = np.linalg.inv(frame)
    model = exact_model(cell, zero)
    known = observed_chain(model)
    chain = ProjectiveChain(
        known.chain.kinds, frame @ known.chain.generators @ back, known.chain.zero, known.chain.tip_first
    )
    seen = ObservedChain(chain, known.cameras @ back, known.lenses, known.joint_names)
    return seen, model.marker_points @ frame.T


@pytest.fixture
def perfect_calibration():
    return perfect
