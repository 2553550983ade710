"""The pan-tilt head against Euclidean truth: calibration, prediction, and a target followed in a closed loop."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.pan_tilt_head import (
    calibrate_pan_tilt,
    feed_forward,
    target_motion,
    tracking_velocity,
)
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.joint_angles import homing_displacement, homing_problem, joint_zeros
from stereoservo.kinematics.joint_reprojection import JointAnglesError, SeenChain, points_seen
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
    head, result = calibrate_pan_tilt(cell.trials(0.1, rng, stops=11), epoch=1)
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


def test_another_mechanism_is_no_pan_tilt_head():
    rng = np.random.default_rng(2)
    standing = synthetic.pan_tilt().trials(0.1, rng)
    standing = msgspec.structs.replace(
        standing, cameras=tuple(msgspec.structs.replace(c, mount="eye_to_hand") for c in standing.cameras)
    )
    for trials in (standing, synthetic.gantry().trials(0.1, rng)):
        with pytest.raises(CalibrationError, match="two revolute joints") as error:
            calibrate_pan_tilt(trials, epoch=1)
        assert error.value.code == "bad_data"


def test_points_that_one_camera_misses_are_not_predicted(perfect_calibration):
    cell = synthetic.pan_tilt()
    seen, _ = perfect_calibration(cell, 3)
    pixels = cell.pixels(cell.home[None])[:, 0].copy()
    pixels[1, 4] = np.nan
    predicted = feed_forward(seen, cell.home, pixels, cell.home + 0.05)
    assert np.isnan(predicted[0, :, 4]).all()
    assert np.isfinite(np.delete(predicted, 4, axis=2)).all()


def test_own_motion_of_a_target_is_read_from_its_track():
    rng = np.random.default_rng(4)
    plane = np.array([0.1, -0.2, 0.3, 1.0])
    start, velocity = rng.normal(size=(3, 4)), rng.normal(size=(3, 4))
    start /= (start @ plane)[:, None]
    velocity -= np.outer(velocity @ plane, plane / (plane @ plane))
    times = np.linspace(0, 1, 7)
    track = (start + times[:, None, None] * velocity) * rng.uniform(0.5, 2, (7, 3, 1))  # heights are free
    track[3, 1] = np.nan
    for degree in (1, 2):
        motion = target_motion(times, track, 1.5, plane=plane, degree=degree)
        assert np.allclose(motion.points, start + 1.5 * velocity)
        assert np.allclose(motion.velocity, velocity)
    track[1:, 2] = np.nan
    assert np.isnan(target_motion(times, track, 1.5, plane=plane).points[2]).all()
    with pytest.raises(JointAnglesError, match="needs 2"):
        target_motion([1.0, 1.0], track[:2], 1.5, plane=plane)
    with pytest.raises(JointAnglesError, match="are needed"):
        target_motion(times, track[:2], 1.5, plane=plane)


def follow(cell, seen, feed, path, seconds=6.0, period=0.02, sigma=0.1, gain=2.0, plane=None):
    """Largest image error [px] of the left camera after the first half, the target going along ``path(t)``."""
    rng = np.random.default_rng(5)
    one = SeenChain(seen.chain, seen.cameras[:1], seen.lenses[:1], seen.joint_names)
    q = cell.home.copy()
    wanted = cell.with_body(path(0.0)).pixels(q[None])[:1, 0]
    times, track, errors = [], [], []
    for step in range(int(seconds / period)):
        now = step * period
        moved = cell.with_body(path(now))
        exact = moved.pixels(q[None])[:, 0]
        points, _ = points_seen(seen, q, exact + rng.normal(0, sigma, exact.shape), sigma)
        times, track = [*times, now][-12:], [*track, points][-12:]
        motion = target_motion(
            times[-len(track) :], np.array(track), now, plane=plane, degree=min(2, len(track) - 1)
        )
        if not feed:
            motion = replace(motion, velocity=np.zeros_like(motion.velocity))
        law = tracking_velocity(one, q, motion, wanted, gain)
        assert law.conditioning > 0.01
        q = q + period * law.velocity
        if now > seconds / 2:
            errors.append(np.abs(exact[:1] - wanted).max())
    return max(errors)


def test_a_moving_target_is_kept_at_its_set_point(perfect_calibration):
    """On a circle of 20 cm at 0.25 turns a second: feedback alone lags by speed over gain, feed-forward does not."""
    cell = head_with(1).with_body([[0.0, 0.0, 0.0]])
    seen, _ = perfect_calibration(cell, 6)
    plane = np.linalg.solve(
        (np.eye(4) + 0.1 * np.random.default_rng(6).normal(size=(4, 4))).T, [0, 0, 0, 1.0]
    )

    def path(t):
        angle = 2 * np.pi * 0.25 * t
        return 0.1 * np.array([[np.cos(angle), np.sin(angle), 0.3 * np.sin(angle)]])

    # 0.157 m/s before cameras of f = 800 px at 2 m are 60 px/s or so; gain 2/s.
    lagging = follow(cell, seen, False, path, plane=plane)
    fed = follow(cell, seen, True, path, plane=plane)
    assert lagging > 20.0
    assert fed < 3.0


def test_a_law_without_set_points_or_tracks_is_refused(perfect_calibration):
    cell = synthetic.pan_tilt()
    seen, points = perfect_calibration(cell, 7)
    motion = target_motion([0.0], points[None, :2], 0.0, plane=np.array([0, 0, 0, 1.0]), degree=0)
    pixels = cell.pixels(cell.home[None])[:, 0, :2]
    with pytest.raises(JointAnglesError, match="set-point"):
        tracking_velocity(seen, cell.home, motion, np.full((2, 2, 2), np.nan), 1.0)
    at_rest = tracking_velocity(seen, cell.home, motion, pixels, 1.0)
    assert np.abs(at_rest.velocity).max() < 1e-6
    assert at_rest.error_px < 1e-6
    # Measured pixels count before predicted ones.
    off = tracking_velocity(seen, cell.home, motion, pixels, 1.0, pixels=pixels + 3.0)
    assert off.error_px == pytest.approx(3 * np.sqrt(2))
    J = seen.chain.image_jacobian(seen.cameras, cell.home, points[:2]).reshape(-1, 2)
    assert np.allclose(off.velocity, np.linalg.lstsq(J, np.full(8, -3.0), rcond=None)[0])
