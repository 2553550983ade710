"""The judge against independent geometry: SciPy's rotations, cameras written out, no shared code."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo_sim.tasks.ground_truth import error_px, line_deviations, noise_floor_px, sight


def independent(pose):
    """Pixels (2, 4, 2), depths (2, 4), cosine of the viewing angle (2,), written out."""
    plate = np.array([(-0.05, -0.05, 0), (0.05, -0.05, 0), (0.05, 0.05, 0), (-0.05, 0.05, 0)])
    X = plate @ pose[:3, :3].T + pose[:3, 3]
    pixels, depths, facing = [], [], []
    for side in (-1.0, 1.0):
        eye = np.array([0.1 * side, 0, 0])
        camera = Rotation.from_euler("y", -10.0 * side, degrees=True)
        x = camera.inv().apply(X - eye)
        pixels.append(800 * x[:, :2] / x[:, 2:] + [320, 240])
        depths.append(x[:, 2])
        way = eye - pose[:3, 3]
        facing.append(way @ -pose[:3, 2] / np.linalg.norm(way))
    return np.array(pixels), np.array(depths), np.array(facing)


def random_pose(rng):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    pose[:3, 3] = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4), rng.uniform(0.2, 1.6)
    return pose


def test_sight_is_that_of_independent_cameras():
    rng = np.random.default_rng(0)
    outside = behind = 0
    for _ in range(300):
        pose = random_pose(rng)
        pixels, depths, facing = independent(pose)
        seen = sight(pose)
        np.testing.assert_allclose(seen.pixels, pixels, rtol=1e-9, atol=1e-7)
        assert seen.depth_m == pytest.approx(depths.min(), abs=1e-12)
        assert seen.facing == pytest.approx(facing.min(), abs=1e-12)
        inside = (pixels >= 0).all() and (pixels[..., 0] < 640).all() and (pixels[..., 1] < 480).all()
        assert seen.in_view == (inside and (depths > 0.01).all())
        alone = sight(pose, 1)
        left = pixels[0]
        inside_left = (left >= 0).all() and (left < [640, 480]).all() and (depths[0] > 0.01).all()
        assert alone.in_view == inside_left
        assert alone.facing == pytest.approx(facing[0], abs=1e-12)
        outside += not inside
        behind += bool((facing <= 0).any())
    assert 50 < outside < 290
    assert 50 < behind < 290


def test_borders_are_as_the_format_says():
    pose = np.eye(4)
    pose[2, 3] = 1.0
    seen = sight(pose)
    assert seen.in_view
    assert seen.facing > 0.9
    turned = pose.copy()
    turned[:3, :3] = np.diag([1.0, -1.0, -1.0])
    assert sight(turned).facing < -0.9


def test_error_looks_through_the_cameras_used():
    a = np.zeros((2, 4, 2))
    b = a.copy()
    b[0, 1] = 3, 4
    b[1, 2] = 6, 8
    assert error_px(b, a, 1) == pytest.approx(5)
    assert error_px(b, a, 2) == pytest.approx(10)


def test_line_deviation_is_the_distance_from_the_segment():
    rng = np.random.default_rng(1)
    start, goal = random_pose(rng), random_pose(rng)
    way = goal[:3, 3] - start[:3, 3]
    aside = np.cross(way, rng.normal(size=3))
    aside /= np.linalg.norm(aside)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[0, :3, 3] = start[:3, 3] + 0.3 * way + 0.007 * aside
    poses[1, :3, 3] = goal[:3, 3] + 0.02 * way / np.linalg.norm(way)
    poses[2, :3, 3] = start[:3, 3]
    np.testing.assert_allclose(line_deviations(poses, start, goal), [0.007, 0.02, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        line_deviations(poses, start, start), np.linalg.norm(poses[:, :3, 3] - start[:3, 3], axis=1)
    )


def test_noise_floor_is_what_a_linear_loop_leaves():
    """A proportional loop on least-squares poses of noisy frames, simulated by itself with a numerical Jacobian."""
    goal = np.eye(4)
    goal[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    goal[:3, 3] = 0.05, -0.02, 1.1
    exact = independent(goal)[0].ravel()
    J = np.empty((16, 6))
    for k in range(6):
        twist = np.zeros(6)
        twist[k] = 1e-6
        moved = goal.copy()
        moved[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix() @ goal[:3, :3]
        moved[:3, 3] += twist[:3]
        J[:, k] = (independent(moved)[0].ravel() - exact) / 1e-6
    rng = np.random.default_rng(2)
    gain, dt, sigma = 2.0, 0.04, 0.1
    share = 1.0 - np.exp(-gain * dt)
    x, pinv, errors = np.zeros(6), np.linalg.pinv(J), []
    for _ in range(40_000):
        x = x - share * (x + pinv @ rng.normal(0, sigma, 16))
        errors.append(np.sqrt(((J @ x).reshape(8, 2) ** 2).sum(axis=1)).max())
    floor = noise_floor_px(goal, sigma, gain, dt, 2)
    assert floor == pytest.approx(np.mean(errors[500:]), rel=0.03)
    assert noise_floor_px(goal, 0.0, gain, dt, 2) == 0.0


def test_the_floor_of_any_gain_is_that_of_one_frame_at_most():
    goal = np.eye(4)
    goal[2, 3] = 1.0
    floors = [noise_floor_px(goal, 0.1, gain, 1.0, 2) for gain in (0.01, 1.0, 2.0, 50.0)]
    assert np.isfinite(floors).all()
    assert (np.diff(floors) > 0).all()
    # all of a frame's noise, of which six of sixteen freedoms are a pose
    assert floors[-1] < 0.1 * np.sqrt(16)
