"""Cartesian paths against Euclidean truth hidden by random frames: ends, straight centre, velocities, other bodies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from oracles.displacement_path import cartesian_velocity, displacement_path
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.planning.cartesian_path import IncompleteDecompositionError, cartesian_path
from stereoservo.planning.three_point_decomposition import decompose


def hidden_displacement(virtual, rng, angle_deg):
    """Frame, Euclidean displacement T, centre C, and what a path is asked from."""
    frame = virtual.random_frame(rng)
    T = virtual.pose(Rotation.from_rotvec(np.radians(angle_deg) * unit(rng)), rng.uniform(-0.5, 0.5, 3))
    C = np.append(rng.uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.3]), 1.0)
    inverse = np.linalg.inv(frame)
    return frame, T, C, (frame @ T @ inverse, frame @ C, inverse[3])


def unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def truth(T, C, sigma):
    """Rotation about the centre at an even pace, the centre on a straight line."""
    R = Slerp([0, 1], Rotation.from_matrix([np.eye(3), T[:3, :3]]))(sigma).as_matrix()
    H = np.eye(4)
    H[:3, :3] = R
    H[:3, 3] = C[:3] + sigma * ((T @ C) - C)[:3] - R @ C[:3]
    return H


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), angle=st.floats(0.01, 179.0), sigma=st.floats(0.0, 1.0))
def test_path_is_the_euclidean_one(virtual, seed, angle, sigma):
    rng = np.random.default_rng(seed)
    frame, T, C, asked = hidden_displacement(virtual, rng, angle)
    path = displacement_path(*asked)
    H = np.linalg.inv(frame) @ path.displacement(sigma) @ frame
    np.testing.assert_allclose(H, truth(T, C, sigma), atol=1e-8)
    np.testing.assert_allclose(path.displacement(1.0), asked[0], atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    sigma=st.floats(0.05, 0.95),
    profile=st.sampled_from(["linear", "exponential", "translation-first", "rotation-first"]),
)
def test_velocity_operators_are_derivatives(virtual, seed, sigma, profile):
    rng = np.random.default_rng(seed)
    _, _, _, asked = hidden_displacement(virtual, rng, rng.uniform(5, 170))
    path = displacement_path(*asked, profile=profile)
    step = 1e-6
    rate = (path.displacement(sigma + step) - path.displacement(sigma - step)) / (2 * step)
    H = path.displacement(sigma)
    np.testing.assert_allclose(path.spatial_velocity(sigma) @ H, rate, atol=2e-4)
    np.testing.assert_allclose(H @ path.body_velocity(sigma), rate, atol=2e-4)
    # the centre is driven by the translation alone (7.15)
    centre = H @ path.centre
    along = path.spatial_velocity(sigma) @ centre
    across = along - path.way * (along @ path.way) / (path.way @ path.way)
    assert np.abs(across).max() < 1e-9


def test_half_a_turn_needs_operators_and_ends_at_the_goal(virtual):
    rng = np.random.default_rng(5)
    frame, T, C, asked = hidden_displacement(virtual, rng, 180.0)
    with pytest.raises(GeometryError, match="half a turn"):
        displacement_path(*asked)
    twists = np.array([virtual.screw(axis, rng.normal(size=3)) for axis in np.eye(3)])
    operators = frame @ twists @ np.linalg.inv(frame)
    path = displacement_path(*asked, operators=operators)
    np.testing.assert_allclose(path.displacement(1.0), asked[0], atol=1e-7)
    half = np.linalg.inv(frame) @ path.displacement(0.5) @ frame
    np.testing.assert_allclose(half[:3, :3] @ half[:3, :3].T, np.eye(3), atol=1e-7)
    np.testing.assert_allclose(half @ C, 0.5 * (C + T @ C), atol=1e-8)


def test_pure_translation_turns_nothing_and_identity_moves_nothing(virtual):
    rng = np.random.default_rng(6)
    frame, T, C, asked = hidden_displacement(virtual, rng, 0.0)
    path = displacement_path(*asked)
    assert path.angle == 0.0
    np.testing.assert_allclose(np.linalg.inv(frame) @ path.displacement(0.3) @ frame, truth(T, C, 0.3), atol=1e-10)
    still = displacement_path(np.eye(4), asked[1], asked[2])
    np.testing.assert_allclose(still.displacement(0.7), np.eye(4), atol=1e-15)


def test_another_plane_or_a_centre_in_it_is_refused(virtual):
    rng = np.random.default_rng(7)
    _, _, _, (H, centre, plane) = hidden_displacement(virtual, rng, 40.0)
    with pytest.raises(GeometryError, match="changes the plane"):
        displacement_path(H, centre, plane + np.array([0.1, 0, 0, 0]))
    with pytest.raises(GeometryError, match="lies in the plane"):
        displacement_path(H, centre - plane * (centre @ plane) / (plane @ plane), plane)


def test_a_grasp_drives_the_tool_that_never_defined_it(virtual):
    """Fig. 7.6: displacement of the workpiece's five points drives the gripper's two, which alone define none."""
    rng = np.random.default_rng(8)
    frame, T, C, asked = hidden_displacement(virtual, rng, 70.0)
    workpiece = np.column_stack([rng.uniform(-0.1, 0.1, (5, 3)) + C[:3], np.ones(5)])
    claw = np.column_stack([rng.uniform(-0.1, 0.1, (2, 3)) + C[:3] + [0.2, 0, 0], np.ones(2)])
    path = displacement_path(*asked, profile="rotation-first")
    pieces = np.array([path.drive(workpiece @ frame.T, s) for s in np.linspace(0, 1, 11)]) @ np.linalg.inv(frame).T
    claws = np.array([path.drive(claw @ frame.T, s) for s in np.linspace(0, 1, 11)]) @ np.linalg.inv(frame).T
    np.testing.assert_allclose(pieces[-1], workpiece @ T.T, atol=1e-9)
    np.testing.assert_allclose(claws[-1], claw @ T.T, atol=1e-9)
    both = np.concatenate([pieces, claws], axis=1)[..., :3]
    distances = np.linalg.norm(both[:, :, None] - both[:, None, :], axis=-1)
    np.testing.assert_allclose(distances, np.broadcast_to(distances[0], distances.shape), atol=1e-9)
    # rotation first: in the end it goes straight
    steps = np.diff(claws[-4:, 0, :3], axis=0)
    assert np.linalg.matrix_rank(steps, tol=1e-6) == 1


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    angle=st.floats(1.0, 160.0),
    profile=st.sampled_from(["linear", "exponential", "translation-first", "rotation-first", "planar-first"]),
)
def test_three_components_end_at_the_goal_and_hold_the_line(virtual, seed, angle, profile):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, angle, 0.2)
    world = virtual.free_arm(rng, T0)
    P, Q = world.hidden(virtual.PLATE @ T0.T), world.hidden(virtual.PLATE @ T_star.T)
    c, c_star = world.hidden(T0[:, 3]), world.hidden(T_star[:, 3])
    path = cartesian_path(decompose(world.operators(), P[:3], Q[:3], c, c_star, world.camera_centres), profile)
    np.testing.assert_allclose(P @ path.displacement(1.0).T, Q, atol=1e-8)
    for sigma in (0.2, 0.5, 0.9):
        H = path.displacement(sigma)
        mu = path.amounts(sigma)[0] / path.amounts(1.0)[0]
        np.testing.assert_allclose(H @ c, (1 - mu) * c + mu * c_star, atol=1e-8)
        step = 1e-6
        rate = (path.displacement(sigma + step) - path.displacement(sigma - step)) / (2 * step)
        np.testing.assert_allclose(cartesian_velocity(path, sigma) @ H, rate, atol=1e-3)


def test_a_component_that_the_arm_cannot_make_is_named(virtual):
    rng = np.random.default_rng(2)
    T0, T_star = virtual.random_task(rng, 40, 0.2)
    arm = virtual.free_arm(rng, T0)
    gantry = virtual.World(arm.generators[:3], arm.plate, arm.frame, arm.q[:3])
    P, Q = gantry.hidden(virtual.PLATE @ T0.T), gantry.hidden(virtual.PLATE @ T_star.T)
    parts = decompose(
        gantry.operators(),
        P[:3],
        Q[:3],
        gantry.hidden(T0[:, 3]),
        gantry.hidden(T_star[:, 3]),
        np.zeros((0, 4)),
    )
    with pytest.raises(IncompleteDecompositionError, match="hinge"):
        cartesian_path(parts)
