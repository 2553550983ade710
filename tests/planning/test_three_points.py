"""Decomposition (7.21)-(7.24): the three components rebuild the displacement, and never turn the back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from stereoservo.planning.three_point_decomposition import ComponentStatus, DegenerateFaceError, decompose

MOVES, DONE, NOT_REACHABLE, WAITS = (
    ComponentStatus.MOVES,
    ComponentStatus.DONE,
    ComponentStatus.NOT_REACHABLE,
    ComponentStatus.WAITS,
)


def parts(virtual, world, T0, T_star, centre=(0, 0, 0, 1.0), eyes=True):
    P, Q = world.hidden(virtual.PLATE @ T0.T), world.hidden(virtual.PLATE @ T_star.T)
    c, c_star = world.hidden(T0 @ centre), world.hidden(T_star @ centre)
    seen_from = world.camera_centres if eyes else np.zeros((0, 4))
    return decompose(world.operators(), P[:3], Q[:3], c, c_star, seen_from), P, Q


def product(d):
    return (
        expm(d.translation.amount * d.translation.operator)
        @ expm(d.hinge.amount * d.hinge.operator)
        @ expm(d.planar.amount * d.planar.operator)
    )


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    angle=st.floats(0.5, 170.0),
    distance=st.floats(0.001, 0.5),
    six_revolute=st.booleans(),
)
def test_components_rebuild_the_displacement(virtual, seed, angle, distance, six_revolute):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, angle, distance)
    world = virtual.rx90(rng, T0=T0) if six_revolute else virtual.free_arm(rng, T0)
    d, P, Q = parts(virtual, world, T0, T_star)
    np.testing.assert_allclose(P @ product(d).T, Q, atol=1e-8)
    for part in (d.translation, d.hinge, d.planar):
        assert part.status in (MOVES, WAITS)
        assert 0 <= part.allowed <= part.amount
    metres = np.linalg.norm((np.linalg.inv(world.frame) @ d.translation.operator @ world.frame)[:3, 3])
    assert d.translation.amount * metres == pytest.approx(distance, rel=1e-9)
    # both rotations hold the centre
    centre = world.hidden(T0[:, 3])
    np.testing.assert_allclose(d.hinge.operator @ centre, 0, atol=1e-9)
    np.testing.assert_allclose(d.planar.operator @ centre, 0, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), angle=st.floats(20.0, 180.0), distance=st.floats(0.0, 0.6))
def test_the_face_stays_visible_along_the_planned_hinge(virtual, seed, angle, distance):
    """Hinge and translation in step, θ and τ by one abscissa: the face never shows its back to the cameras'
    middle.
    """
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, angle, distance, front=np.cos(np.radians(60)))
    world = virtual.free_arm(rng, T0)
    d, _, _ = parts(virtual, world, T0, T_star)
    inverse = np.linalg.inv(world.frame)
    for s in np.linspace(0, 1, 21):
        axis_rotation = expm(s * d.hinge.amount * d.hinge.operator)
        shift = np.eye(4) + s * d.translation.amount * d.translation.operator
        assert world.front_facing(inverse @ shift @ axis_rotation @ world.frame @ T0).mean() > 0


@pytest.mark.parametrize("tilt", [-60.0, -30.0, 30.0, 60.0])
def test_half_a_turn_about_the_optical_axis(virtual, tilt):
    """Thesis 8.7: roll by 180 degrees, the face tilted; it must turn through frontal, not over its back."""
    T_star = virtual.pose(Rotation.from_euler("y", tilt, degrees=True), [0, 0, 1.0])
    T0 = virtual.pose(
        Rotation.from_euler("z", 180, degrees=True) * Rotation.from_euler("y", tilt, degrees=True),
        [0, 0, 1.0],
    )
    world = virtual.free_arm(np.random.default_rng(3), T0)
    d, P, Q = parts(virtual, world, T0, T_star)
    assert d.translation.status == DONE
    assert d.hinge.amount == pytest.approx(np.radians(2 * abs(tilt)))
    assert d.planar.amount == pytest.approx(np.pi)
    np.testing.assert_allclose(P @ product(d).T, Q, atol=1e-8)
    half = np.linalg.inv(world.frame) @ expm(0.5 * d.hinge.amount * d.hinge.operator) @ world.frame @ T0
    assert world.front_facing(half).min() > 0.98


def test_the_long_way_round_where_only_it_is_visible(virtual):
    """The centre crosses far in front of the rig: the short hinge would go over the back, the long one fronts
    the eyes.
    """
    T0 = virtual.pose(Rotation.from_euler("y", -70 - 50, degrees=True), [-1.2, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("y", 70 + 50, degrees=True), [1.2, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(4), T0)
    assert world.front_facing(T0).min() > 0
    assert world.front_facing(T_star).min() > 0
    d, P, Q = parts(virtual, world, T0, T_star)
    assert d.hinge.amount == pytest.approx(np.radians(240))
    np.testing.assert_allclose(P @ product(d).T, Q, atol=1e-8)
    assert d.hinge.status == WAITS
    blind, _, _ = parts(virtual, world, T0, T_star, eyes=False)
    assert blind.hinge.amount == pytest.approx(np.radians(120))
    assert blind.hinge.status == MOVES


@pytest.mark.parametrize("angle", [179.9, 180.0, 180.1])
def test_opposite_faces_still_have_a_hinge(virtual, angle):
    T0 = virtual.pose(Rotation.identity(), [0, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("y", angle, degrees=True), [0, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(5), T0)
    d, P, Q = parts(virtual, world, T0, T_star)
    assert d.hinge.amount == pytest.approx(np.pi, abs=0.01)
    np.testing.assert_allclose(P @ product(d).T, Q, atol=1e-8)


def test_steps_with_nothing_to_do_are_zero_not_noise(virtual):
    T0 = virtual.pose(Rotation.from_euler("xy", [20, 10], degrees=True), [0.1, 0, 1.0])
    world = virtual.rx90(np.random.default_rng(6), T0=T0)
    d, _, _ = parts(virtual, world, T0, T0)
    assert [c.status for c in (d.translation, d.hinge)] == [DONE, DONE]
    assert d.planar.amount == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(d.translation.screw, np.zeros(6))
    np.testing.assert_array_equal(d.hinge.screw, np.zeros(6))

    in_plane = T0 @ virtual.pose(Rotation.from_euler("z", 70, degrees=True), [0.05, 0.02, 0])
    d, P, Q = parts(virtual, world, T0, in_plane)
    assert d.hinge.amount < 1e-10
    assert d.planar.amount == pytest.approx(np.radians(70))
    np.testing.assert_allclose(P @ product(d).T, Q, atol=1e-9)


def test_a_centre_off_the_face_runs_on_its_own_line(virtual):
    rng = np.random.default_rng(8)
    T0, T_star = virtual.random_task(rng, 80.0, 0.2)
    world = virtual.rx90(rng, T0=T0)
    centre = np.array([0.1, -0.03, 0.12, 1.0])
    d, P, Q = parts(virtual, world, T0, T_star, centre)
    np.testing.assert_allclose(P @ product(d).T, Q, atol=1e-8)
    for part in (d.hinge, d.planar):
        np.testing.assert_allclose(part.operator @ world.hidden(T0 @ centre), 0, atol=1e-9)


def test_a_deficient_arm_moves_what_it_can(virtual):
    """A SCARA: no hinge. The translation and its amount stay right."""
    generators = np.array([virtual.screw(axis) for axis in np.eye(3)] + [virtual.screw([0, 0, 1.0], [0.1, 0, 1])])
    T0 = virtual.pose(Rotation.identity(), [0.05, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("zy", [30, 25], degrees=True), [0.1, 0.1, 1.2])
    world = virtual.World(generators, T0, virtual.random_frame(np.random.default_rng(9)), np.zeros(4))
    d, _, _ = parts(virtual, world, T0, T_star)
    assert (d.translation.status, d.hinge.status, d.planar.status) == (MOVES, NOT_REACHABLE, MOVES)
    assert "about the hinge" in d.hinge.detail
    assert d.hinge.amount > 0.1
    np.testing.assert_array_equal(d.hinge.screw, np.zeros(4))
    moved = np.linalg.inv(world.frame) @ (np.eye(4) + d.translation.amount * d.translation.operator) @ world.frame @ T0
    np.testing.assert_allclose(moved[:3, 3], T_star[:3, 3], atol=1e-9)
    assert d.planar.amount == pytest.approx(np.radians(30), abs=0.1)


def test_collinear_points_span_no_face(virtual):
    T0 = virtual.pose(Rotation.identity(), [0, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(1), T0)
    P = world.hidden(virtual.PLATE @ T0.T)
    line = np.stack([P[0], 0.5 * (P[0] + P[1]), P[1]])
    with pytest.raises(DegenerateFaceError, match="collinear"):
        decompose(world.operators(), line, P[:3], P[0], P[0], world.camera_centres)
    with pytest.raises(DegenerateFaceError, match="collinear"):
        decompose(world.operators(), P[:3], line, P[0], P[0], world.camera_centres)
