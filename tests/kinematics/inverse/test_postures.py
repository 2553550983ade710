"""Postures that show given images: all of them, by the arm's forward kinematics, and none where there is none."""

import numpy as np
import pytest

from stereoservo.kinematics.inverse.postures import postures
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError
from stereoservo.kinematics.joint_reprojection import predicted_pixels, seen_chain
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

SIGMA = 0.2


@pytest.mark.parametrize("seed", range(4))
def test_every_posture_shows_the_images_and_the_true_one_is_among_them(seed):
    model = exact_model(synthetic.rx90())
    seen = seen_chain(model)
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
    seen = seen_chain(model)
    pixels = predicted_pixels(seen, seen.chain.zero[None], model.marker_points)[0]
    pixels[1, 2:] = np.nan
    with pytest.raises(InverseKinematicsError, match=r"2 markers are shown to two cameras; 3 are needed"):
        postures(model, pixels, SIGMA)
