"""Postures that show given images: all of them, by the arm's forward kinematics, and none where there is none."""

import re

import numpy as np
import pytest

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.kinematics.inverse.postures import postures
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError
from stereoservo.kinematics.joint_angles import measured_joints, refined_joints
from stereoservo.kinematics.joint_reprojection import (
    JointAnglesError,
    joint_problem,
    observed_chain,
    predicted_pixels,
)
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

SIGMA = 0.2


@pytest.mark.parametrize("seed", range(4))
def test_every_posture_shows_the_images_and_the_true_one_is_among_them(seed):
    model = exact_model(synthetic.rx90())
    seen = observed_chain(model)
    rng = np.random.default_rng(seed)
    q = seen.chain.zero + rng.uniform(-0.2, 0.2, 6)
    exact = predicted_pixels(seen, q[None], model.marker_points)[0]
    pixels = exact + rng.normal(0, SIGMA, exact.shape)
    pixels[0, 3:5] = np.nan  # one camera does not see them
    found = postures(model, pixels, SIGMA)
    answers = found.images.solutions
    assert len(answers) == 8  # of an arm with an elbow and a spherical wrist, seen from before
    for answer in answers:
        here = predicted_pixels(seen, answer.q[None], model.marker_points)[0]
        # 0.1 % point of chi-square, over the pixels that are given
        assert np.nansum(((here - pixels) / SIGMA) ** 2) < 2 * np.isfinite(pixels).sum()
    assert min(np.abs(answer.q - q).max() for answer in answers) < 0.02
    # Numbers do not depend on where turns are counted from.
    other = postures(model, pixels, SIGMA, seed=q + rng.uniform(-4, 4, 6)).images.solutions
    turns = np.array([a.q - b.q for a, b in zip(answers, other, strict=True)]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-6)
    # The nearest alone is left by limits around it; none by limits beside all of them.
    only = postures(model, pixels, SIGMA, limits=np.column_stack([q - 0.3, q + 0.3]))
    assert [np.abs(a.q - q).max() < 0.02 for a in only.images.solutions] == [True]
    none = postures(model, pixels, SIGMA, limits=np.column_stack([q + 0.5, q + 0.6]))
    assert (none.found.outcome, none.images.solutions) == ("beyond_limits", ())


def test_images_that_do_not_tell_a_posture_are_refused_with_the_number():
    model = exact_model(synthetic.rx90())
    seen = observed_chain(model)
    pixels = predicted_pixels(seen, seen.chain.zero[None], model.marker_points)[0]
    pixels[1, 2:] = np.nan
    with pytest.raises(InverseKinematicsError, match=r"2 markers are shown to two cameras; 3 are needed"):
        postures(model, pixels, SIGMA)


def test_a_learnt_arm_of_four_joints_has_both_its_elbows():
    """Noise of its operators generates all rigid motions: a goal of such an arm is not refused for being none."""
    cell, rng = synthetic.scara(), np.random.default_rng(0)
    model = fit_model(cell.trials(0.1, rng, 10), epoch=1).model
    room = np.where(np.array(cell.kinds) == "revolute", np.pi, 1.0)
    limits = np.column_stack([cell.home - room, cell.home + room])
    for q in cell.held_out(rng, 3, 0.7):
        pixels = cell.pixels(q[None])[:, 0]
        answers = postures(model, pixels + rng.normal(0, 0.1, pixels.shape), 0.1, limits=limits)
        assert len(answers.images.solutions) == 2
        assert min(np.abs(answer.q - q).max() for answer in answers.images.solutions) < 0.02


def test_starts_that_are_refined_together_end_as_each_by_itself():
    cell, rng = synthetic.rx90(), np.random.default_rng(1)
    seen = observed_chain(exact_model(cell))
    q = cell.held_out(rng, 1, 0.5)[0]
    pixels = cell.pixels(q[None])[:, 0] + rng.normal(0, SIGMA, (2, len(cell.body), 2))
    problem = joint_problem(seen, exact_model(cell).marker_points, pixels, SIGMA)
    starts = np.array([q + 0.05, q + 2.0, q - 0.1])
    for start, found in zip(starts, refined_joints(problem, starts), strict=True):
        if isinstance(found, JointAnglesError):
            with pytest.raises(JointAnglesError, match=re.escape(str(found))):
                measured_joints(problem, start=start, largest_deviation=np.inf)
            continue
        alone = measured_joints(problem, start=start, largest_deviation=np.inf)[0]
        np.testing.assert_allclose(found.q, alone.q, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.covariance, alone.covariance, rtol=1e-5, atol=1e-12)
