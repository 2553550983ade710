"""Sides of faces, images and joint limits along ways, against Euclidean truth; kernels against their references."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from oracles.path_visibility import (
    common_shares,
    joint_clearances,
    keep_out_clearances,
    rotation_bounds,
    translation_bound,
    view_rooms,
    visible_shares,
)
from stereoservo.geometry.distortion import distort
from stereoservo.geometry.homogeneous import plane_of_points
from stereoservo.planning.cartesian_path import cartesian_path
from stereoservo.planning.three_point_decomposition import decompose
from stereoservo.planning.visibility_constraints import Constraints, check_joints, check_view, empty_table


def hidden_scene(virtual, rng):
    """A plate, a camera's centre on its printed side or not, and the frame that hides them."""
    frame = virtual.random_frame(rng)
    T = virtual.pose(Rotation.random(random_state=int(rng.integers(2**31))), [0, 0, 1.0])
    eye = np.append(rng.uniform(-0.3, 0.3, 3), 1.0)
    face = plane_of_points(*(virtual.PLATE[:3] @ T.T @ frame.T))
    sign = np.sign(np.linalg.det(frame))
    return frame, T, eye, face, sign


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_translation_bound_is_where_the_plane_meets_the_camera(virtual, seed):
    rng = np.random.default_rng(seed)
    frame, T, eye, face, _ = hidden_scene(virtual, rng)
    direction = rng.normal(size=3)
    H_t = frame @ virtual.screw(direction) @ np.linalg.inv(frame)
    normal = T[:3, 2]
    truth = normal @ (eye[:3] - T[:3, 3]) / (normal @ direction)
    assert translation_bound(face, H_t, frame @ eye) == pytest.approx(truth, rel=1e-6)


def test_a_translation_within_the_face_never_meets_the_camera(virtual):
    frame, T, eye, face, _ = hidden_scene(virtual, np.random.default_rng(1))
    H_t = frame @ virtual.screw(T[:3, 0]) @ np.linalg.inv(frame)
    assert np.isinf(translation_bound(face, H_t, frame @ eye))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_rotation_bounds_hold_the_visible_angles(virtual, seed):
    rng = np.random.default_rng(seed)
    frame, T, eye, face, sign = hidden_scene(virtual, rng)
    axis = rng.normal(size=3)
    G = virtual.screw(axis / np.linalg.norm(axis), rng.uniform(-0.2, 0.2, 3) + np.array([0, 0, 1.0]))
    bounds = rotation_bounds(face, frame @ G @ np.linalg.inv(frame), frame @ eye)
    edges = virtual.PLATE[:3] @ T.T
    for theta in np.linspace(-np.pi, np.pi, 25):
        a, b, c = (edges @ virtual_rotation(virtual, G, theta).T)[:, :3]
        # det[a b c O] of homogeneous points is minus the normal times the way to the camera
        front = sign * np.linalg.det(np.column_stack([np.append(a, 1), np.append(b, 1), np.append(c, 1), eye]))
        if bounds is None:
            assert front < 1e-9
            continue
        low, high = bounds
        inside = any(low < theta + axis_rotation < high for axis_rotation in (-2 * np.pi, 0, 2 * np.pi))
        assert inside == (front > 0) or abs(front) < 1e-9


def virtual_rotation(virtual, G, theta):
    return np.eye(4) + np.sin(theta) * G + (1 - np.cos(theta)) * G @ G


def test_intervals_of_a_whole_path_for_both_cameras(virtual):
    rng = np.random.default_rng(11)
    T0, T_star = virtual.random_task(rng, 150, 0.3)
    world = virtual.free_arm(rng, T0)
    P, Q = world.hidden(virtual.PLATE @ T0.T), world.hidden(virtual.PLATE @ T_star.T)
    c, c_star = world.hidden(T0[:, 3]), world.hidden(T_star[:, 3])
    none = np.zeros((0, 4))
    # without cameras the hinge takes the shorter way, whatever it shows
    path = cartesian_path(decompose(world.operators(), P[:3], Q[:3], c, c_star, none))
    face = plane_of_points(*P[:3])
    face = face * np.sign(face @ world.camera_centres[0])
    both = [visible_shares(path.displacement, face, eye) for eye in world.camera_centres]
    common = common_shares(*both)
    for sigma in np.linspace(0.003, 0.997, 60):
        T = np.linalg.inv(world.frame) @ path.displacement(sigma) @ world.frame @ T0
        seen = world.front_facing(T) > 0
        for intervals, truth in zip([*both, common], [*seen, seen.all()], strict=True):
            assert any(low <= sigma <= high for low, high in intervals) == truth


def test_a_face_that_is_lost_and_found_has_two_intervals(virtual):
    frame = virtual.random_frame(np.random.default_rng(0))
    T = virtual.pose(Rotation.identity(), [0, 0, 1.0])
    G = frame @ virtual.screw([1.0, 0, 0], [0, 0, 1.0]) @ np.linalg.inv(frame)
    face = plane_of_points(*(virtual.PLATE[:3] @ T.T @ frame.T))
    eye = frame @ np.array([0, 0, 0, 1.0])
    face = face * np.sign(face @ eye)

    def whole_turn(sigma):
        return np.eye(4) + np.sin(2 * np.pi * sigma) * G + (1 - np.cos(2 * np.pi * sigma)) * G @ G

    (a, b), (c, d) = visible_shares(whole_turn, face, eye)
    np.testing.assert_allclose([a, b, c, d], [0, 0.25, 0.75, 1], atol=1e-9)
    np.testing.assert_allclose(visible_shares(whole_turn, -face, eye), [(0.25, 0.75)], atol=1e-9)


def surroundings_of(world, points, lenses, cells, lower, upper, keep_outs):
    """The kernels' view of a Euclidean world: its own frame is a motion frame."""
    cameras = np.ascontiguousarray(world.euclidean)
    return Constraints(
        body=np.ascontiguousarray(points[:, :3]), must_stay_visible=np.ones(len(points)), cameras=cameras,
        camera_centres=np.ascontiguousarray(world.eyes[:, :3]), sizes=cells.SIZES, lenses=lenses,
        margins=np.zeros(2), depths=np.ones(2), faces=np.array([[0, 1, 2]]), sides=-np.ones((1, 2)),
        grazing=np.zeros((1, 2)), lower=lower, upper=upper, keep_outs=keep_outs,
    )  # fmt: skip


def test_kernels_enter_the_least_clearances_of_the_references(virtual, cells):
    rng = np.random.default_rng(21)
    lenses = np.array([[-0.1, 322.0, 238.0, 320.0], [0.05, 318.0, 241.0, 320.0]])
    lower, upper = np.array([-1.0, -2.0, -np.inf]), np.array([1.0, 2.0, np.inf])
    boxes = np.array([[[0.2, 0.4], [-np.inf, np.inf], [0.0, 0.5]], [[-3, -2], [-3, -2], [-3, -2.0]]])
    for _ in range(20):
        T = virtual.random_task(rng, 10, 0.01)[0]
        world = virtual.free_arm(rng, T)
        X = virtual.PLATE @ T.T
        s = surroundings_of(world, X, lenses, cells, lower, upper, boxes)
        table = empty_table()
        check_view(s.body, 0.25, s, table, True)
        clearances, depths = view_rooms(np.eye(4)[None], X, world.euclidean, lenses, cells.SIZES)
        raw = np.array([distort(lens, uv) for lens, uv in zip(lenses, world.pixels(X), strict=True)])
        truth = np.minimum(raw + 0.5, cells.SIZES[:, None] - 0.5 - raw).min(axis=-1)
        np.testing.assert_allclose(clearances[0], truth, atol=1e-9)
        assert table[2, 1] == pytest.approx(clearances.min(), abs=1e-9)
        assert clearances[0, int(table[2, 4]), int(table[2, 5])] == clearances.min()
        assert table[4, 1] == pytest.approx(depths.min() - 0.05, abs=1e-12)
        centre = T[:3, 3] + (virtual.PLATE[:3, :3].mean(axis=0)) @ T[:3, :3].T
        way = world.eyes[:, :3] - centre
        elevation = np.degrees(np.arcsin(-way @ T[:3, 2] / np.linalg.norm(way, axis=1)))
        assert table[3, 1] == pytest.approx(elevation.min(), abs=1e-9)
        q = rng.uniform(-1.5, 1.5, 3)
        check_joints(q, 0.25, s, table)
        assert table[0, 1] == pytest.approx(np.min(joint_clearances(q[None], lower, upper)))
        assert table[1, 1] == pytest.approx(np.min(keep_out_clearances(q[None], boxes)))
        assert (table[:5, 6] == 0.25).all()


def test_behind_a_camera_and_beyond_the_fold_are_far_outside(virtual, cells):
    world = virtual.free_arm(np.random.default_rng(0), cells.START)
    behind = np.array([[0.0, 0, -1.0, 1.0]])
    clearances, depths = view_rooms(np.eye(4)[None], behind, world.euclidean, cells.PINHOLES, cells.SIZES)
    assert (depths < 0).all()
    assert (clearances == -640).all()
    folded = np.array([[-0.3, 320.0, 240.0, 320.0]] * 2)
    wide = np.array([[3.0, 0, 1.0, 1.0]])
    clearances, _ = view_rooms(np.eye(4)[None], wide, world.euclidean, folded, cells.SIZES)
    assert (clearances == -640).all()


def test_a_joint_in_a_keep_out_is_broken_and_named():
    world_less = np.zeros((0, 3))
    s = Constraints(
        world_less, np.zeros(0), np.zeros((0, 3, 4)), world_less, np.zeros((0, 2)), np.zeros((0, 4)), np.zeros(0),
        np.zeros(0), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 0)), np.zeros((0, 0)), np.full(2, -9.0),
        np.full(2, 9.0), np.array([[[0.0, 1.0], [-1.0, 1.0]]]),
    )  # fmt: skip
    table = empty_table()
    assert check_joints(np.array([0.5, 0.9]), 0.5, s, table) == 1
    assert table[1, 1] == pytest.approx(-0.1)
    assert check_joints(np.array([1.2, 0.0]), 0.5, s, empty_table()) == -1
    assert check_joints(np.array([9.5, 0.0]), 0.5, s, empty_table()) == 0
