"""Scales of joints told by their own trials: a factor is named only where it explains the trial to the noise."""

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.diagnosis.joint_scales import trial_scales
from stereoservo.calibration.initial_reconstruction import initial_reconstruction
from stereoservo.calibration.lens_estimation import undistorted, undistorted_lenses
from stereoservo_sim.world import synthetic

SIGMA, JOINT, FACTOR = 0.1, 2, 1.2


def reported_scales(report):
    """Factors (6,) told where joint ``JOINT`` reports ``report`` of its way from home."""
    cell = synthetic.rx90()
    trials = cell.trials(SIGMA, np.random.default_rng(31), 11)
    positions = trials.positions.copy()
    positions[:, JOINT] = cell.home[JOINT] + report(positions[:, JOINT] - cell.home[JOINT])
    trials = msgspec.structs.replace(trials, positions=positions)
    return trial_scales(trials, *initial_reconstruction(undistorted(trials, undistorted_lenses(trials))))


@pytest.mark.slow  # in the suite: test_wrong_revolute_scale, by the whole fit
def test_a_factor_that_explains_the_trial_is_reported():
    factors = reported_scales(lambda way: FACTOR * way)
    assert factors[JOINT] == pytest.approx(FACTOR, rel=0.02)
    assert (np.delete(factors, JOINT) == 1.0).all()


def test_a_factor_that_helps_but_does_not_explain_is_not_reported():
    """An encoder that bends, too: the best factor mends most of the misfit, what is left is no noise."""
    assert (reported_scales(lambda way: FACTOR * way + 0.4 * way**2) == 1.0).all()
