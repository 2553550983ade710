"""The pan-tilt head against Euclidean truth: calibration and prediction."""

import numpy as np

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.kinematics.joint_angles import homing_displacement, homing_problem, joint_zeros
from stereoservo.kinematics.joint_reprojection import observed_chain
from stereoservo_sim.experiments.pan_tilt import feed_forward
from stereoservo_sim.world import synthetic


def head_with(markers, seed=0):
    rng = np.random.default_rng(seed)
    return synthetic.pan_tilt(body=rng.uniform(-0.25, 0.25, (markers, 3)))


def test_learnt_generators_are_the_inverse_motion_of_the_cameras(perfect_calibration):
    """(4.44) with errata: points move by the inverse of the head's pose, and so do the derivatives."""
    cell = synthetic.pan_tilt()
    seen, points = perfect_calibration(cell, 1, zero=np.zeros(2))
    q = np.array([0.2, -0.15])
    base_first = -seen.chain.generators  # those of the cameras' own motion
    E = [np.eye(4) + np.sin(a) * G + (1 - np.cos(a)) * G @ G for a, G in zip(q, base_first, strict=True)]
    H, slopes = (array[0] for array in seen.displacements(q[None]))
    assert np.allclose(H, np.linalg.inv(E[0] @ E[1]))
    for j, behind in enumerate((E[1], np.eye(4))):
        M = points @ H.T
        expected = -np.linalg.inv(behind) @ base_first[j] @ behind @ M.T
        assert np.allclose(slopes[j] @ points.T, expected)


def test_a_calibrated_head_predicts_homes_and_resets_its_zeros():
    cell = head_with(40)
    rng = np.random.default_rng(1)
    result = fit_model(cell.trials(0.1, rng, stops=11), epoch=1)
    head = observed_chain(result.model)
    assert head.chain.tip_first
    assert result.report.chi2_ok
    q = cell.held_out(rng, 6)
    exact = cell.pixels(q)
    predicted = feed_forward(head, q[0], exact[:, 0], q[1:])
    assert np.abs(predicted.swapaxes(0, 1) - exact[:, 1:]).max() < 0.15
    home = homing_displacement(homing_problem(head, q[0], exact[:, 0, :1], exact[:, 1, :1], 0.1), q[0])
    assert np.abs(home.displacement - (q[0] - q[1])).max() < np.radians(0.02)
    zeros = joint_zeros(head, result.model.marker_points, exact.swapaxes(0, 1)[:2], 0.1, q[:2] - [0.3, -0.2])
    assert np.abs(zeros.offset - [0.3, -0.2]).max() < np.radians(0.02)
    assert (zeros.deviations < np.radians(0.01)).all()


def test_points_that_one_camera_misses_are_not_predicted(perfect_calibration):
    cell = synthetic.pan_tilt()
    seen, _ = perfect_calibration(cell, 3)
    pixels = cell.pixels(cell.home[None])[:, 0].copy()
    pixels[1, 4] = np.nan
    predicted = feed_forward(seen, cell.home, pixels, cell.home + 0.05)
    assert np.isnan(predicted[0, :, 4]).all()
    assert np.isfinite(np.delete(predicted, 4, axis=2)).all()
