"""The arms of the tasks: exact motion, all configurations within the limits, what trial motions show."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from stereoservo_sim.tasks.arms import (
    MID_RANGE,
    PLATE_ON_FLANGE,
    RX90_LIMITS,
    FreeArm,
    free_cell,
    inverse_kinematics,
    rx90_cell,
    rx90_reach,
)
from stereoservo_sim.tasks.calibrations import calibrate, known_at_start, with_trial_ranges
from stereoservo_sim.tasks.ground_truth import sight
from stereoservo_sim.tasks.setting import HOMOGENEOUS_MARKERS, camera_matrices, cartesian_twists


def test_free_arm_moves_by_the_exponential_of_its_twist(drawn):
    rng = np.random.default_rng(0)
    start = drawn(1, 1)[0].start
    arm = FreeArm(start)
    expected = start
    for _ in range(3):
        velocity = rng.normal(size=6)
        arm.move(velocity, 0.3)
        twist = np.zeros((4, 4))
        w, v = velocity[3:], velocity[:3]
        twist[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
        twist[:3, 3] = v - np.cross(w, start[:3, 3])
        expected = expm(0.3 * twist) @ expected
    np.testing.assert_allclose(arm.pose, expected, atol=1e-11)


def test_rx90_solutions_are_all_within_limits_and_reach_the_pose():
    cell = rx90_cell()
    rng = np.random.default_rng(1)
    back = np.linalg.inv(cell.base)
    for _ in range(60):
        q = rng.uniform(RX90_LIMITS[:, 0], RX90_LIMITS[:, 1])
        flange = back @ cell.flange(q)
        solutions = inverse_kinematics(flange, RX90_LIMITS)
        assert np.abs(solutions - q).max(axis=1).min() < 1e-7
        assert (solutions >= RX90_LIMITS[:, 0] - 1e-12).all()
        assert (solutions <= RX90_LIMITS[:, 1] + 1e-12).all()
        for found in solutions:
            np.testing.assert_allclose(back @ cell.flange(found), flange, atol=1e-9)


def test_rx90_out_of_reach_is_said_to_be():
    cell = rx90_cell()
    far = MID_RANGE.copy()
    far[2, 3] = 4.0
    assert rx90_reach(cell, MID_RANGE, far) is None
    reach = rx90_reach(cell, MID_RANGE, MID_RANGE)
    assert reach is not None
    np.testing.assert_allclose(cell.flange(reach.start) @ PLATE_ON_FLANGE, MID_RANGE, atol=1e-9)
    np.testing.assert_array_equal(reach.start, reach.goal)


def test_straight_wrist_has_a_configuration():
    cell = rx90_cell()
    q = np.array([0.3, -1.0, 2.5, 0.0, 0.0, 0.7])
    flange = np.linalg.inv(cell.base) @ cell.flange(q)
    found = inverse_kinematics(flange, RX90_LIMITS)
    assert np.abs(found - q).max(axis=1).min() < 1e-7


@pytest.mark.parametrize("make", [free_cell, rx90_cell])
def test_trial_motions_keep_the_face_in_both_views(make):
    cell = with_trial_ranges(make())
    assert (cell.ranges > 0.1).all()
    positions, _ = cell.stops(9)
    for q in positions:
        pose = cell.flange(q) if make is free_cell else cell.flange(q) @ PLATE_ON_FLANGE
        seen = sight(pose)
        assert seen.margin_px > 19
        assert seen.facing > np.cos(np.radians(66))


def operators_in_images(knowledge, points):
    """The velocity of every marker's pixels with each joint (2, 4, 2, n): what no frame changes."""
    x = np.einsum("cij,mj->cmi", knowledge.matrices, points)
    v = np.einsum("cij,njk,mk->cmin", knowledge.matrices, knowledge.basis, points)
    return (v[..., :2, :] - (x[..., :2] / x[..., 2:])[..., None] * v[..., 2:, :]) / x[..., 2, None, None]


@pytest.mark.parametrize("kind", ["exact", "self"])
def test_free_arm_is_known_at_a_tasks_start_from_its_own_readings(drawn, kind):
    calibration = calibrate("free", kind, 0.1, 0)
    for task in drawn(5, 6):
        knowledge = known_at_start(calibration, task, None)
        x = np.einsum("cij,mj->cmi", knowledge.matrices, knowledge.points)
        off = np.abs(x[..., :2] / x[..., 2:] - sight(task.start).pixels).max()
        truth = np.einsum(
            "cij,njk,mk->cmin",
            camera_matrices(),
            cartesian_twists(task.start[:3, 3]),
            HOMOGENEOUS_MARKERS @ task.start.T,
        )
        X = np.einsum("cij,mj->cmi", camera_matrices(), HOMOGENEOUS_MARKERS @ task.start.T)
        J = (truth[..., :2, :] - (X[..., :2] / X[..., 2:])[..., None] * truth[..., 2:, :]) / X[..., 2, None, None]
        error = np.abs(operators_in_images(knowledge, knowledge.points) - J).max() / np.abs(J).max()
        assert off < (1e-8 if kind == "exact" else 1.0)
        assert error < (1e-10 if kind == "exact" else 0.01)
        np.testing.assert_allclose(knowledge.points @ knowledge.plane_at_infinity, 1.0, atol=1e-9)


def test_coarse_calibration_is_off_by_what_it_says(drawn):
    task = drawn(6, 1)[0]
    knowledge = known_at_start(calibrate("free", "coarse", 0.1, 0), task, None)
    turned = np.stack([twist[:3, 3] for twist in knowledge.basis[:3]], axis=1)
    error = Rotation.from_matrix(turned).as_rotvec()
    np.testing.assert_allclose(error, np.radians(5) * task.error_axis, atol=1e-12)
    ratio = knowledge.matrices[0] - camera_matrices()[0]
    assert np.linalg.norm(ratio) > 10
    middle = np.array([*task.start[:3, 3], 1.0])
    np.testing.assert_allclose(knowledge.basis[3:] @ middle, 0.0, atol=1e-12)
