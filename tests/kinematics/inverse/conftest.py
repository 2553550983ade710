"""Euclidean arms hidden by random projective frames, as the experiment hides them."""

import numpy as np
import pytest

from stereoservo_sim.experiments.inverse_kinematics import hide


@pytest.fixture
def hidden():
    """``hidden(axes, seed)``: the arm, its frame, its chain and what it is recognised as."""
    return lambda axes, seed: hide(axes, np.random.default_rng(seed))
