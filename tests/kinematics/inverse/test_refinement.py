"""(6.8): solutions in closed form refined on the images; goals measured with noise."""

import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.geometry.cameras import triangulate
from stereoservo.kinematics.inverse.postures import refined_on_images
from stereoservo.kinematics.inverse.recognition import recognise
from stereoservo.kinematics.inverse.solver import inverse_kinematics
from stereoservo.kinematics.joint_reprojection import JointAnglesError, observed_chain, predicted_pixels
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

SIGMA = 0.2


@pytest.fixture(scope="module")
def cell():
    model = exact_model(synthetic.rx90())
    return model, observed_chain(model), recognise(model)


def measured(cell, seed):
    """A goal within view, its pixels with noise, and the solutions for the points triangulated from them."""
    model, seen, known = cell
    rng = np.random.default_rng(seed)
    q = seen.chain.zero + rng.uniform(-0.15, 0.15, 6)
    exact = predicted_pixels(seen, q[None], model.marker_points)[0]
    pixels = exact + rng.normal(0, SIGMA, exact.shape)
    targets = triangulate(seen.cameras, pixels, np.full(pixels.shape[:2], SIGMA))
    found = inverse_kinematics(
        seen.chain, points=model.marker_points, targets=targets, tolerance=0.05, recognition=known
    )
    return q, pixels, found


def test_refined_on_images_is_the_least_squares_of_the_pixels(cell):
    """Every solution of the noisy reconstruction; errors at the stated covariance, inside 99.9 % over 6 goals."""
    model, seen, _ = cell
    total = 0.0
    for seed in range(6):
        q, pixels, found = measured(cell, seed)
        assert found.reached
        refined = refined_on_images(seen, found, model.marker_points, pixels, SIGMA)
        best = min(refined.solutions, key=lambda angles: np.abs(angles.q - q).max())
        error = best.q - q
        total += error @ np.linalg.solve(best.covariance, error)
        for angles in refined.solutions:
            # No step of a thousandth of a deviation leads lower.
            here = predicted_pixels(seen, angles.q[None], model.marker_points)[0]
            cost = (((here - pixels) / SIGMA) ** 2).sum()
            assert cost == pytest.approx(angles.cost, rel=1e-9)
            for direction in np.random.default_rng(seed).normal(size=(6, 6)):
                step = 1e-3 * angles.deviations * direction
                there = predicted_pixels(seen, (angles.q + step)[None], model.marker_points)[0]
                assert (((there - pixels) / SIGMA) ** 2).sum() >= cost * (1 - 1e-9)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 6 * 6)
    assert low < total < high


def test_all_configurations_that_give_the_same_image_are_kept(cell):
    _, pixels, found = measured(cell, 3)
    model, seen, _ = cell
    refined = refined_on_images(seen, found, model.marker_points, pixels, SIGMA)
    assert len(found.joints) == len(refined.solutions) + len(refined.refused) == 8
    costs = [angles.cost for angles in refined.solutions]
    assert costs == sorted(costs)
    assert costs[-1] == pytest.approx(costs[0], rel=1e-6)


def test_images_of_something_else_are_refused_with_the_reason(cell):
    model, seen, _ = cell
    _, pixels, found = measured(cell, 4)
    swapped = pixels[:, ::-1]
    refined = refined_on_images(seen, found, model.marker_points, swapped, SIGMA)
    assert not refined.solutions
    assert len(refined.refused) == len(found.joints)
    assert "residual" in refined.refused[0][1]
    with pytest.raises(JointAnglesError):
        refined_on_images(seen, found, model.marker_points[:2], pixels, SIGMA)


def test_limits_hold_in_the_images(cell):
    model, seen, _ = cell
    q, pixels, found = measured(cell, 5)
    limits = np.column_stack([q - 0.5, q + 0.5])
    refined = refined_on_images(seen, found, model.marker_points, pixels, SIGMA, limits=limits)
    assert len(refined.solutions) == 1
    assert np.abs(refined.solutions[0].q - q).max() < 0.1
