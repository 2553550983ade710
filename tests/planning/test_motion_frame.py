"""The frame that operators leave: Euclidean up to its unit; Horn's rotation in it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereoservo.planning.motion_frame import axis_rotation, motion_frame, plane_at_infinity, rotation_between


@pytest.mark.parametrize("make", ["free", "rx90", "seven", "five", "scara", "door", "gantry"])
def test_operators_become_twists_and_heights_one(virtual, cells, make):
    rng = np.random.default_rng(3)
    world = virtual.free_arm(rng, cells.START) if make == "free" else getattr(cells, make)(rng)
    points = np.concatenate([world.hidden(world.markers()), world.camera_centres])
    plane = plane_at_infinity(world.operators(), points)
    np.testing.assert_allclose(plane, world.infinity, atol=1e-10)
    centre = world.hidden(world.plate_pose()[:, 3])
    W = motion_frame(world.operators(), plane, centre, world.camera_centres)
    np.testing.assert_allclose(plane @ W, [0, 0, 0, 1], atol=1e-10)
    local = np.linalg.inv(W) @ world.operators() @ W
    np.testing.assert_allclose(local[:, 3], 0, atol=1e-10)
    blocks = local[:, :3, :3]
    np.testing.assert_allclose(blocks, -blocks.transpose(0, 2, 1), atol=1e-8)
    turning = np.array([G[:3, :3].any() for G in world.generators])
    lengths = np.sqrt((blocks**2).sum(axis=(1, 2)) / 2)
    np.testing.assert_allclose(lengths, turning, atol=1e-8)
    eyes = np.linalg.solve(W, world.camera_centres.T)[:3]
    assert np.linalg.norm(eyes, axis=0).mean() == pytest.approx(1.0, rel=1e-9)
    if make in ("free", "rx90", "seven", "five"):
        euclidean = np.linalg.norm(world.eyes[:, :3] - world.plate_pose()[:3, 3], axis=1)
        measured = np.linalg.norm(eyes, axis=0)
        assert measured[0] / measured[1] == pytest.approx(euclidean[0] / euclidean[1], rel=1e-8)


def test_measured_operators_leave_a_frame_as_good_as_they_are(virtual, cells):
    rng = np.random.default_rng(4)
    world = cells.rx90(rng)
    noisy = world.operators() * (1 + 1e-4 * rng.normal(size=(6, 4, 4)))
    points = np.concatenate([world.hidden(world.markers()), world.camera_centres])
    plane = plane_at_infinity(noisy, points)
    W = motion_frame(noisy, plane, world.hidden(world.plate_pose()[:, 3]), world.camera_centres)
    blocks = (np.linalg.inv(W) @ world.operators() @ W)[:, :3, :3]
    assert np.abs(blocks + blocks.transpose(0, 2, 1)).max() < 3e-3


def test_no_plane_gives_no_frame(virtual, cells):
    world = cells.rx90(np.random.default_rng(0))
    W = motion_frame(world.operators(), np.zeros(4), world.hidden(world.plate_pose()[:, 3]), world.camera_centres)
    assert np.isnan(W).any()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), angle=st.floats(0.0, np.pi), flat=st.booleans())
def test_rotation_between_point_sets(seed, angle, flat):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    X = rng.normal(size=(5, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
    R = Rotation.from_rotvec(angle * axis)
    np.testing.assert_allclose(axis_rotation(axis, angle), R.as_matrix(), atol=1e-14)
    found = rotation_between(X, R.apply(X) + rng.normal(size=3))
    assert 0 <= found[3] <= np.pi + 1e-12
    np.testing.assert_allclose(axis_rotation(found[:3].copy(), found[3]), R.as_matrix(), atol=1e-6)
