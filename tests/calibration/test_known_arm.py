"""Poses in place of joints: the fit of trials whose generators are known, against Euclidean truth."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from stereoservo.calibration.known_arm import frame_of_known_arm, free_arm, trials_of_poses
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialCamera, decode_trials, encode_trials
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.kinematics.model import decode_model, encode_model

CORNERS = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.1], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.2]]) * 0.02
CORNERS += np.array([0.03, -0.02, 0.06])
CENTRES = np.array([[0.30, 0.75, 0.65], [0.70, 0.70, 0.55], [0.1, 0.6, 0.3]])
LENSES = np.array([[0.03, 310.0, 245.0, 320.0], [-0.05, 325.0, 235.0, 320.0], [0.0, 319.5, 239.5, 320.0]])
SIGMA = 0.05


def truth(count, rng):
    """Poses (s, 4, 4) of a hand over 30 cm and some tens of degrees, cameras (3, 3, 4) from its base."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = (
        Rotation.from_rotvec(rng.normal(0, 0.35, (count, 3))) * Rotation.from_euler("x", 125, degrees=True)
    ).as_matrix()
    poses[:, :3, 3] = np.array([0.45, 0.0, 0.35]) + rng.uniform(-0.15, 0.15, (count, 3))
    cameras = []
    for centre, focal in zip(CENTRES, (640.0, 560.0, 600.0), strict=True):
        forward = np.array([0.45, 0.03, 0.38]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[focal, 0.5, 318.0], [0.0, 1.003 * focal, 243.0], [0.0, 0.0, 1.0]])
        cameras.append(K @ np.hstack([R, -(R @ centre)[:, None]]))
    return poses, np.array(cameras)


def pixels_of(poses, cameras, lenses=LENSES):
    """Exact raw pixels (c, s, 4, 2)."""
    points = np.hstack([CORNERS, np.ones((4, 1))]) @ poses.transpose(0, 2, 1)
    images = np.einsum("cij,smj->csmi", cameras, points)
    ideal = images[..., :2] / images[..., 2:]
    return np.array([distort(lens, one) for lens, one in zip(lenses, ideal, strict=True)])


def trials_at(poses, pixels, sigma=SIGMA):
    cameras = [TrialCamera(f"c{i}", 640, 480) for i in range(len(pixels))]
    return trials_of_poses(poses, cameras, range(4), pixels, np.full(pixels.shape[:3], sigma))


def disturbed(poses, rng, turn=2e-3, shift=3e-4):
    """Poses as they are where these are reported: a robot's own errors, about its hand."""
    there = poses.copy()
    there[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, turn, (len(poses), 3))).as_matrix() @ poses[:, :3, :3]
    there[:, :3, 3] += rng.normal(0, shift, (len(poses), 3))
    return there


def test_a_free_arm_makes_the_displacements():
    poses, _ = truth(9, np.random.default_rng(3))
    positions, generators, zero = free_arm(poses)
    for q, pose in zip(positions, poses, strict=True):
        product = np.eye(4)
        for angle, generator in zip(q, generators, strict=True):
            product = product @ expm(angle * generator)
        np.testing.assert_allclose(product @ zero, pose, atol=1e-12)
    poses[4, 0, 1] += 0.01
    with pytest.raises(CalibrationError, match="displacement 4 is not rigid"):
        free_arm(poses)


def test_cameras_lenses_and_markers_in_metres_through_a_wrong_view():
    rng = np.random.default_rng(5)
    poses, cameras = truth(24, rng)
    pixels = pixels_of(poses, cameras) + rng.normal(0, SIGMA, (3, 24, 4, 2))
    pixels[2, rng.random(24) < 0.4] = np.nan
    pixels[1, 7] += 40.0  # a tag taken for another
    trials = trials_at(poses, pixels)
    fit = fit_model(trials, epoch=3)
    report, model = fit.report, fit.model
    assert report.chi2_ok
    assert report.lens.model == "radial_centre"
    assert report.joints == ()
    assert {(one.camera, one.stop) for one in report.outliers} == {("c1", 7)}
    for camera, lens in zip(report.cameras, LENSES, strict=True):
        assert abs(camera.lens[0] - lens[0]) < 4.5 * camera.lens_std[0]
    _, generators, zero = free_arm(poses)
    to_base = np.linalg.inv(frame_of_known_arm(model, generators)) @ model.projective_to_euclidean
    corners = model.marker_points @ to_base.T @ np.linalg.inv(zero).T
    np.testing.assert_allclose(corners[:, :3] / corners[:, 3:], CORNERS, atol=2e-4)
    for camera, centre in zip(model.cameras, CENTRES, strict=True):
        found = np.linalg.svd(camera.matrix @ np.linalg.inv(to_base))[2][-1]
        np.testing.assert_allclose(found[:3] / found[3], centre, atol=5e-3)
    again = decode_model(encode_model(model))
    np.testing.assert_allclose(again.covariance.covariance, model.covariance.covariance)


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_predicted_covariances_hold_where_the_poses_have_errors(seed):
    """Squared errors of the middle of each held-out view, in predicted deviations, are chi-squares of 2: twelve poses
    to learn from, twenty-eight to predict."""
    rng = np.random.default_rng(seed)
    poses, cameras = truth(40, rng)
    straight = np.tile(LENSES[2], (3, 1))
    pixels = pixels_of(disturbed(poses, rng), cameras, straight) + rng.normal(0, SIGMA, (3, 40, 4, 2))
    trials = trials_at(poses, pixels)
    some = msgspec.structs.replace(
        trials,
        positions=trials.positions[:12],
        trials=trials.trials[:12],
        pixels=pixels[:, :12],
        sigmas=trials.sigmas[:, :12],
    )
    fit = fit_model(some, epoch=1)
    assert fit.report.joints  # errors of the poses were seen
    predicted, covariances = pixel_covariances(fit.model, trials.positions)
    errors = (predicted - pixels)[:, 12:]
    covariances = covariances[:, 12:] + SIGMA**2 * np.eye(2)
    squares = np.einsum("csma,csmab,csmb->csm", errors, np.linalg.inv(covariances), errors)
    print(f"seed {seed}: mean {squares.mean():.2f}, largest {np.sqrt(squares.max()):.2f} deviations")
    assert np.sqrt(squares.max()) < 4.5
    # 28 poses of six errors: a mean of 2 within 4 standard errors below; above, the spread of 12 poses' variances.
    assert 0.4 < squares.mean() < 2.0 + 4.0 * np.sqrt(2.0 * 2.0 / 28) + 0.8


def test_sigmas_that_are_stated_too_small_are_estimated_and_said():
    rng = np.random.default_rng(8)
    poses, cameras = truth(24, rng)
    pixels = pixels_of(poses, cameras) + rng.normal(0, 4 * SIGMA, (3, 24, 4, 2))
    report = fit_model(trials_at(poses, pixels), epoch=1).report
    assert report.sigma_factor == pytest.approx(4.0, rel=0.15)
    assert any("times as much as stated" in one for one in report.notes)


def test_what_cannot_be_fitted_is_refused_with_its_cause():
    rng = np.random.default_rng(2)
    poses, cameras = truth(12, rng)
    pixels = pixels_of(poses, cameras)
    with pytest.raises(CalibrationError) as still:
        fit_model(trials_at(np.repeat(poses[:1], 12, axis=0), pixels), epoch=1)
    assert still.value.code == "joint_did_not_move"
    few = pixels.copy()
    few[1, 5:] = np.nan
    with pytest.raises(CalibrationError, match="'c1' 5") as counted:
        fit_model(trials_at(poses, few), epoch=1)
    assert (counted.value.code, counted.value.data["minimum"]) == ("too_few_stops", 6)
    trials = trials_at(poses, pixels)
    with pytest.raises(CalibrationError, match=r"generators of shape \(5, 4, 4\)"):
        fit_model(msgspec.structs.replace(trials, generators=trials.generators[:5]), epoch=1)
    on_tip = tuple(msgspec.structs.replace(one, mount="eye_in_hand") for one in trials.cameras)
    with pytest.raises(CalibrationError, match="inverses of the hand's"):
        fit_model(msgspec.structs.replace(trials, cameras=on_tip), epoch=1)


def test_known_generators_are_stored_with_the_trials():
    poses, cameras = truth(8, np.random.default_rng(4))
    trials = trials_at(poses, pixels_of(poses, cameras))
    again = decode_trials(encode_trials(trials))
    assert np.array_equal(again.generators, trials.generators)
    plain = msgspec.structs.replace(trials, generators=None)
    assert decode_trials(encode_trials(plain)).generators is None
