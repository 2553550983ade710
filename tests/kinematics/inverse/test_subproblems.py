"""The equations of chapter 6, with their errata, on Euclidean mechanisms hidden by random frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo.geometry.displacements import exp_rotation
from stereoservo.kinematics.inverse.closed_forms import (
    arm,
    axis_points,
    circle_meets_plane,
    common_point,
    normal_plane,
    prismatic_joints,
    turn_between,
    two_general,
    two_parallel,
    wrist,
)
from stereoservo_sim.experiments import inverse_kinematics as families
from stereoservo_sim.experiments.inverse_kinematics import hide

SEEDS = st.integers(0, 10**6)
COUNT = settings(max_examples=25, deadline=None)


def drawn(make, seed):
    rng = np.random.default_rng(seed)
    return hide(make(rng), rng), rng


def near(angles, wanted, tolerance=1e-9):
    apart = np.mod(np.asarray(angles) - wanted + np.pi, 2 * np.pi) - np.pi
    return float(np.abs(apart).reshape(len(angles), -1).max(axis=1).min()) < tolerance


@COUNT
@given(SEEDS, st.floats(-3, 3))
def test_circle_meets_plane_in_both_roots(seed, theta):
    """(6.8) through the point at a known angle: that root is found, and both lie in the plane."""
    arm_, rng = drawn(families.one, seed)
    G = arm_.chain.generators[0]
    A = arm_.frame @ np.append(rng.uniform(-1, 1, 3), 1)
    moved = exp_rotation(G, theta) @ A
    plane = np.linalg.svd(moved[None])[2][1:].T @ rng.normal(size=3)
    crossing = circle_meets_plane(G, A, plane)
    assert len(crossing.angles) == 2
    assert crossing.excess == 0.0
    for angle in crossing.angles:
        assert abs(plane @ exp_rotation(G, angle) @ A) < 1e-10 * np.linalg.norm(plane) * np.linalg.norm(A)
    assert near(crossing.angles, theta, 1e-6)


def test_circle_short_of_a_plane_comes_nearest_and_states_by_how_much():
    """A unit circle about z and the plane x = 3: nearest at angle 0, three radii are two too many."""
    G = np.zeros((4, 4))
    G[0, 1], G[1, 0] = -1.0, 1.0
    A = np.array([0.0, 1.0, 0.0, 1.0])
    crossing = circle_meets_plane(G, A, np.array([1.0, 0.0, 0.0, -3.0]))
    assert near(crossing.angles, -np.pi / 2)
    assert crossing.excess == pytest.approx(2.0)
    assert not crossing.free


def test_circle_in_its_own_plane_is_free_and_parallel_to_it_is_out_of_reach():
    G = np.zeros((4, 4))
    G[0, 1], G[1, 0] = -1.0, 1.0
    A = np.array([0.0, 1.0, 2.0, 1.0])
    inside = circle_meets_plane(G, A, np.array([0.0, 0.0, 1.0, -2.0]), seed=0.3)
    assert inside.free
    assert inside.angles == pytest.approx([0.3])
    beside = circle_meets_plane(G, A, np.array([0.0, 0.0, 1.0, -1.0]))
    assert not beside.free
    assert np.isinf(beside.excess)


@COUNT
@given(SEEDS, st.floats(-3.1, 3.1))
def test_one_revolute_joint_brings_a_point_to_its_target(seed, theta):
    arm_, rng = drawn(families.one, seed)
    G = arm_.chain.generators[0]
    A = arm_.frame @ np.append(rng.uniform(-1, 1, 3), 1)
    found = turn_between(G, A, exp_rotation(G, theta) @ A)
    assert near(found.steps[:, 0], theta)
    assert found.excess[0, 0] < 1e-9


@COUNT
@given(SEEDS)
def test_off_the_circle_the_nearest_angle_is_that_of_the_axial_plane(seed):
    """Errata to (6.11): the plane of the target and the axis, which is the Euclidean nearest point's, too."""
    arm_, rng = drawn(families.one, seed)
    w, c = arm_.axes.directions[0], arm_.axes.points[0]
    point, goal = rng.uniform(-1, 1, (2, 3))
    angles = np.linspace(-np.pi, np.pi, 20001)
    u = point - c
    turned = (
        np.cos(angles)[:, None] * u
        + np.sin(angles)[:, None] * np.cross(w, u)
        + (1 - np.cos(angles))[:, None] * (u @ w) * w
    )
    best = angles[int(np.argmin(np.linalg.norm(turned + c - goal, axis=1)))]
    A, target = arm_.frame @ np.append(point, 1), arm_.frame @ np.append(goal, 1)
    step = turn_between(arm_.chain.generators[0], A, target).steps
    assert near(step[:, 0], best, 2 * np.pi / 20000)


@COUNT
@given(SEEDS)
def test_planes_across_and_points_on_an_axis(seed):
    """Across: holds the whole circle, as (6.23) wants; a point on the axis has its plane, too."""
    arm_, rng = drawn(families.one, seed)
    G = arm_.chain.generators[0]
    on_axis = axis_points(G).T @ rng.normal(size=2)
    assert np.abs(G @ on_axis).max() < 1e-12
    for A in (arm_.frame @ np.append(rng.uniform(-1, 1, 3), 1), on_axis):
        a = normal_plane(G, A)
        assert np.linalg.norm(a) > 1e-3 * np.linalg.norm(A)
        for angle in (0.0, 1.0, 2.5):
            assert abs(a @ exp_rotation(G, angle) @ A) < 1e-12


@pytest.mark.parametrize("count", [1, 2, 3])
def test_prismatic_joints_need_no_heights(count):
    arm_, rng = drawn(families.sliding(count), count)
    tau = rng.uniform(-0.5, 0.5, count)
    A = arm_.frame @ np.append(rng.uniform(-1, 1, 3), 1)
    target = -3.7 * (np.eye(4) + np.tensordot(tau, arm_.chain.generators, axes=1)) @ A
    assert prismatic_joints(arm_.chain.generators, A[None], target[None]).steps[0] == pytest.approx(tau)


def test_prismatic_joints_in_one_direction_share_the_path_and_are_free():
    arm_, rng = drawn(families.sliding(2), 4)
    G = arm_.chain.generators
    G = np.array([G[0], 2.0 * G[0], G[1]])
    A = arm_.frame @ np.append(rng.uniform(-1, 1, 3), 1)
    target = (np.eye(4) + 0.5 * G[0] + 0.2 * G[2]) @ A
    found = prismatic_joints(G, A[None], target[None])
    assert found.steps[0] == pytest.approx([0.1, 0.2, 0.2])
    assert found.free[0].tolist() == [True, True, False]


@COUNT
@given(SEEDS)
def test_two_joints_and_the_arm_find_what_they_were_moved_by(seed):
    for make, solver, n in (
        (families.two, two_general, 2),
        (families.parallel_pair, two_parallel, 2),
        (families.shoulder_and_elbow, arm, 3),
    ):
        arm_, rng = drawn(make, seed)
        q = rng.uniform(-np.pi, np.pi, n)
        A = arm_.frame @ np.append(rng.uniform(-1, 1, 3), 1)
        target = arm_.chain.displacement(arm_.chain.zero + q) @ A
        found = solver(arm_.chain.generators, A, target, np.zeros(n))
        assert near(found.steps, q, 1e-5)


@COUNT
@given(SEEDS)
def test_wrist_finds_the_rotation_and_its_flip(seed):
    arm_, rng = drawn(families.square_wrist, seed)
    q = rng.uniform(-np.pi, np.pi, 3)
    H = arm_.chain.displacement(arm_.chain.zero + q)
    found = wrist(arm_.chain.generators, H, np.zeros(3))
    assert near(found.steps, q, 1e-5)
    assert len(found.steps) == 2
    for steps in found.steps:
        assert arm_.chain.displacement(arm_.chain.zero + steps) == pytest.approx(H, abs=1e-8)


def test_common_point_is_the_centre():
    arm_, _ = drawn(families.square_wrist, 5)
    centre = np.linalg.inv(arm_.frame) @ common_point(arm_.chain.generators)
    for w, c in zip(arm_.axes.directions, arm_.axes.points, strict=True):
        assert np.cross(centre[:3] / centre[3] - c, w) == pytest.approx(np.zeros(3), abs=1e-9)
