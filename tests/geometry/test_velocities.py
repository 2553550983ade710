import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from oracles.rigid_velocities import (
    body_from_spatial,
    body_velocity,
    dual_displacement,
    metric_point_velocity,
    orbital_height,
    plane_velocity,
    point_velocity,
    spatial_from_body,
    spatial_velocity,
    transfer_velocity,
)
from oracles.screw_transfer import twist_vectors
from stereoservo.geometry.displacements import conjugate, exp_rotation
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.screws import twist_matrix

seeds = st.integers(0, 2**32 - 1)


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


def euclidean_motion(rng):
    """``T(t)`` of a body that turns about a moving axis: a product of two constant twists."""
    first, second = twist_matrix(rng.normal(size=(2, 3)), rng.normal(size=(2, 3)))
    return lambda t: expm(t * first) @ expm((0.3 + t) * second)


def derivative(function, t):
    """Fourth order central difference: error about 1e-12."""
    h = 1e-3
    return (8 * (function(t + h) - function(t - h)) - (function(t + 2 * h) - function(t - 2 * h))) / (12 * h)


def test_twists_act_as_cross_product_plus_velocity():
    rng = np.random.default_rng(1)
    w, v, X = rng.normal(size=(3, 5, 3))
    T = twist_matrix(w, v)
    moved = np.einsum("nij,nj->ni", T, np.hstack([X, np.ones((5, 1))]))
    assert np.allclose(moved[:, :3], np.cross(w, X) + v)
    assert np.array_equal(moved[:, 3], np.zeros(5))
    back_w, back_v = twist_vectors(T)
    assert np.allclose(back_w, w)
    assert np.allclose(back_v, v)
    with pytest.raises(GeometryError, match="no Euclidean twist") as error:
        twist_vectors(conjugate(frame(rng), T))
    assert error.value.data["excess"] > 1e-3


@given(seeds, st.floats(-1, 1))
def test_velocities_are_conjugates_of_the_euclidean_ones(seed, t):
    rng = np.random.default_rng(seed)
    T, back = euclidean_motion(rng), frame(rng)  # back = H_PE⁻¹
    up = np.linalg.inv(back)

    def H(time):
        return back @ T(time) @ up

    T_dot, H_dot = derivative(T, t), derivative(H, t)
    spatial, body = spatial_velocity(H(t), H_dot), body_velocity(H(t), H_dot)
    assert np.allclose(spatial, back @ (T_dot @ np.linalg.inv(T(t))) @ up, atol=1e-9)
    assert np.allclose(body, back @ (np.linalg.inv(T(t)) @ T_dot) @ up, atol=1e-9)
    twist_vectors(conjugate(up, spatial), tolerance=1e-8)  # raises unless it is one (2.51)
    assert np.allclose(H_dot, spatial @ H(t), atol=1e-9)  # (2.52)
    assert np.allclose(H_dot, H(t) @ body, atol=1e-9)
    assert np.allclose(spatial_from_body(H(t), body), spatial, atol=1e-8)
    assert np.allclose(body_from_spatial(H(t), spatial), body, atol=1e-8)
    # (2.46): seen in another frame, the velocity is that of the motion seen there.
    S = frame(rng)
    moved = spatial_velocity(np.linalg.inv(S) @ H(t) @ S, np.linalg.inv(S) @ H_dot @ S)
    assert np.allclose(transfer_velocity(S, spatial), moved, atol=1e-8)


@given(seeds, st.floats(-1, 1))
def test_points_keep_their_height_and_move_with_the_metric_velocity(seed, t):
    rng = np.random.default_rng(seed)
    T, back = euclidean_motion(rng), frame(rng)
    up = np.linalg.inv(back)
    plane = up[3]
    X, heights = np.append(rng.normal(size=3), 1.0), rng.uniform(0.3, 3.0) * rng.choice([-1.0, 1.0])
    M = heights * back @ X

    def path(time):
        return back @ T(time) @ up @ M

    spatial = spatial_velocity(back @ T(t) @ up, derivative(lambda s: back @ T(s) @ up, t))
    M_dot = point_velocity(spatial, path(t))
    assert np.isclose(orbital_height(plane, M), heights)
    assert np.isclose(orbital_height(plane, path(t)), heights, atol=1e-10)
    assert abs(orbital_height(plane, M_dot)) < 1e-8
    assert np.allclose(M_dot, derivative(path, t), atol=1e-8)
    X_dot = metric_point_velocity(up, path(t), M_dot)
    assert np.allclose(X_dot, derivative(lambda s: T(s) @ X, t)[:3], atol=1e-7)


@given(seeds, st.floats(-1, 1))
def test_planes_move_with_the_dual(seed, t):
    rng = np.random.default_rng(seed)
    T, back = euclidean_motion(rng), frame(rng)
    up = np.linalg.inv(back)

    def H(time):
        return back @ T(time) @ up

    a, M = rng.normal(size=4), rng.normal(size=4)
    a_t = dual_displacement(H(t)) @ a
    assert np.isclose(a_t @ (H(t) @ M), a @ M, atol=1e-9)  # incidence is kept (2.68)
    spatial = spatial_velocity(H(t), derivative(H, t))
    rate = plane_velocity(spatial, a_t)
    assert np.allclose(rate, derivative(lambda s: dual_displacement(H(s)) @ a, t), atol=1e-7)
    assert np.abs(plane_velocity(spatial, up[3])).max() < 1e-8  # infinity does not move
    S, J = frame(rng), expm(twist_matrix(rng.normal(size=3), rng.normal(size=3)))
    dual = S.T @ dual_displacement(J) @ np.linalg.inv(S).T  # (2.69)
    assert np.allclose(dual_displacement(np.linalg.inv(S) @ J @ S), dual, atol=1e-8)


def test_a_plane_in_which_its_points_move_stands_still():
    rng = np.random.default_rng(2)
    back = frame(rng)
    twist = conjugate(back, twist_matrix(np.array([0, 0, 1.0]), np.zeros(3)))
    ground = np.linalg.inv(back).T @ [0, 0, 1.0, -0.7]
    assert np.abs(plane_velocity(twist, ground)).max() < 1e-14
    assert np.allclose(dual_displacement(exp_rotation(twist, 1.0)) @ ground, ground)


def test_points_at_infinity_have_no_metric_velocity():
    rng = np.random.default_rng(3)
    back = frame(rng)
    M = move_points(back, np.array([[1.0, 2.0, 3.0, 0.0]]))
    with pytest.raises(GeometryError, match="at infinity"):
        metric_point_velocity(np.linalg.inv(back), M, M)
