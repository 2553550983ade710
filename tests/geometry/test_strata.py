import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from oracles.projective_points import move_cameras, move_planes
from oracles.strata_relations import (
    absolute_dual_quadric,
    affine_to_euclidean,
    euclidean_to_affine,
    fixed_plane_residual,
    fixed_quadric_residual,
    infinity_homography,
    plane_at_infinity,
    strata_of,
    strata_of_quadric,
)
from stereoservo.geometry.cameras import pixel_normaliser, project
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.strata import (
    affine_to_projective,
    decompose_camera,
    euclidean_to_projective,
    oriented_plane,
    projective_to_affine,
    projective_to_euclidean,
    upper_triangular,
)

seeds = st.integers(0, 2**32 - 1)


def random_twists(rng, n):
    twists = np.zeros((n, 4, 4))
    w = rng.normal(size=(n, 3))
    twists[:, 2, 1], twists[:, 0, 2], twists[:, 1, 0] = w.T
    twists -= twists.transpose(0, 2, 1)
    twists[:, :3, 3] = rng.normal(size=(n, 3))
    return twists


def random_strata(rng):
    """A plane at infinity and K̃ of a frame of order one."""
    plane = np.append(rng.uniform(-0.5, 0.5, 3), rng.uniform(0.5, 2.0)) * rng.choice([-1.0, 1.0])
    K = np.array(
        [
            [rng.uniform(1, 3), rng.normal(0, 0.1), rng.normal(0, 0.2)],
            [0, rng.uniform(1, 3), rng.normal(0, 0.2)],
            [0, 0, 1],
        ]
    )
    return plane, K


@given(seeds)
def test_inverses_and_composition(seed):
    plane, K = random_strata(np.random.default_rng(seed))
    up, down = projective_to_euclidean(plane, K), euclidean_to_projective(plane, K)
    assert np.allclose(up @ down, np.eye(4), atol=1e-12)
    assert np.allclose(projective_to_affine(plane) @ affine_to_projective(plane), np.eye(4), atol=1e-12)
    assert np.allclose(affine_to_euclidean(K) @ euclidean_to_affine(K), np.eye(4), atol=1e-12)
    assert np.allclose(affine_to_euclidean(K) @ projective_to_affine(plane), up, atol=1e-12)
    assert np.array_equal(plane_at_infinity(up), plane)
    assert np.allclose(move_planes(up, plane), [0, 0, 0, 1], atol=1e-12)


@given(seeds)
def test_a_projective_rig_is_upgraded_to_the_euclidean_one(rig, seed):
    """Cameras, points, generators of a canonical projective frame against the rig's own K, R, t and motions."""
    rng = np.random.default_rng(seed)
    N = pixel_normaliser(640, 480)
    plane, _ = random_strata(rng)
    K = N @ rig.K
    to_projective = np.zeros((4, 4))  # by hand: first camera [N⁻¹ | 0], heights 1 for Euclidean points
    to_projective[:3, :3] = K
    to_projective[3] = np.append(-plane[:3] @ K, 1.0) / plane[3]
    X, twists = rig.points(rng, 8), random_twists(rng, 3)
    M, Ps, generators = (
        move_points(to_projective, X),
        move_cameras(to_projective, rig.Ps),
        conjugate(to_projective, twists),
    )
    assert np.allclose(Ps[0], np.hstack([np.linalg.inv(N), np.zeros((3, 1))]), atol=1e-9 * np.abs(Ps[0]).max())
    assert np.allclose(M @ plane, 1.0)

    up = projective_to_euclidean(plane, K)
    assert np.allclose(move_points(up, M), X, atol=1e-9)
    assert np.allclose(move_cameras(up, Ps), rig.Ps, rtol=1e-9, atol=1e-7)
    assert np.allclose(conjugate(up, generators), twists, atol=1e-9)
    K_right, R, t = decompose_camera(move_cameras(up, Ps)[1])
    assert np.allclose(K_right, rig.K, rtol=1e-8)
    assert np.allclose(R, rig.R, atol=1e-9)
    assert np.allclose(t, rig.t, atol=1e-9)

    affine = projective_to_affine(plane)
    assert np.abs(conjugate(affine, generators)[:, 3]).max() < 1e-10
    blocks = conjugate(affine, generators)[:, :3, :3]
    assert np.allclose(blocks, K @ twists[:, :3, :3] @ np.linalg.inv(K), atol=1e-9)  # (2.41) with its erratum
    assert np.allclose(conjugate(affine, generators)[:, :3, 3], twists[:, :3, 3] @ K.T, atol=1e-9)


@given(seeds)
def test_the_homography_of_infinity_maps_vanishing_points(rig, seed):
    rng = np.random.default_rng(seed)
    directions = np.hstack([rng.normal(size=(6, 2)) * 0.3, np.ones((6, 1)), np.zeros((6, 1))])
    H_projective = euclidean_to_projective(*random_strata(rng))
    Ps, plane = move_cameras(H_projective, rig.Ps), move_planes(H_projective, np.array([0, 0, 0, 1.0]))
    H = infinity_homography(*Ps, plane)
    expected = rig.K @ rig.R @ np.linalg.inv(rig.K)
    assert np.allclose(H / H[2, 2], expected / expected[2, 2], rtol=1e-7, atol=1e-7)
    left = np.hstack([project(rig.Ps[0], directions), np.ones((6, 1))]) @ H.T
    assert np.allclose(left[:, :2] / left[:, 2:], project(rig.Ps[1], directions), atol=1e-6)


@given(seeds)
def test_strata_of_any_upgrade_wherever_its_euclidean_frame_stands(seed):
    rng = np.random.default_rng(seed)
    plane, K = random_strata(rng)
    rigid = np.eye(4)
    scale = rng.uniform(0.5, 2.0)
    rigid[:3, :3] = scale * Rotation.random(random_state=int(seed % 1000)).as_matrix()
    rigid[:3, 3] = rng.normal(size=3)
    H = rigid @ projective_to_euclidean(plane, K)
    found_plane, found_K, found_rigid = strata_of(H)
    assert np.allclose(found_plane, plane)
    assert np.allclose(found_K, K, atol=1e-10)
    assert np.allclose(found_rigid, rigid, atol=1e-10)

    Q = absolute_dual_quadric(H)
    assert np.abs(Q @ plane).max() < 1e-11 * np.abs(Q).max()
    quadric_plane, quadric_K = strata_of_quadric(-3.0 * Q)
    assert np.allclose(quadric_plane / quadric_plane[3], plane / plane[3], atol=1e-8)
    assert np.allclose(quadric_K, K, atol=1e-8)


@given(seeds)
def test_rigid_motions_keep_what_is_absolute_and_others_do_not(seed):
    rng = np.random.default_rng(seed)
    plane, K = random_strata(rng)
    back = euclidean_to_projective(plane, K)
    rigid = conjugate(back, random_twists(rng, 4))
    Q = absolute_dual_quadric(np.linalg.inv(back))
    assert fixed_plane_residual(rigid, plane).max() < 1e-12
    assert fixed_quadric_residual(rigid, Q).max() < 1e-12
    sheared = random_twists(rng, 4)
    sheared[:, 0, 1] += 1.0
    sheared = conjugate(back, sheared)
    assert fixed_plane_residual(sheared, plane).max() < 1e-12  # affine motions keep infinity ...
    assert fixed_quadric_residual(sheared, Q).min() > 1e-3  # ... but not angles
    general = rng.normal(size=(4, 4, 4))
    assert fixed_plane_residual(general, plane).max() > 1e-3


def test_triangular_factor_against_its_definition():
    rng = np.random.default_rng(1)
    for _ in range(20):
        A = rng.normal(size=(3, 3))
        K, R = upper_triangular(A)
        assert np.allclose(np.tril(K, -1), 0, atol=1e-14)
        assert (np.diag(K) > 0).all()
        assert np.isclose(K[2, 2], 1.0)
        assert np.allclose(R @ R.T, np.eye(3))
        ratio = (K @ R) / A
        assert np.allclose(ratio, ratio[0, 0], rtol=1e-9)
        assert ratio[0, 0] > 0


def test_a_plane_between_the_points_is_refused_by_name(rig):
    M = rig.points(np.random.default_rng(2), 6)
    M = M / M[:, 2:3]
    plane = np.array([0, 0, 0, -1.0])
    assert np.array_equal(oriented_plane(plane, M), [0, 0, 0, 1.0])
    cutting = np.array([0.0, 0.0, -1.0, 1.0]) * [1, 1, np.sort(M[:, 3])[1] * 1.001, 1]
    with pytest.raises(GeometryError, match="beyond the plane at infinity") as error:
        oriented_plane(cutting, M)
    assert error.value.data["points"] == sorted(np.argsort(M[:, 3])[:2].tolist())


def test_degenerate_strata_are_refused():
    with pytest.raises(GeometryError, match="first camera's centre"):
        projective_to_affine(np.array([1.0, 0, 0, 0]))
    with pytest.raises(GeometryError, match="singular"):
        affine_to_euclidean(np.diag([1.0, 1.0, 0.0]))
    with pytest.raises(GeometryError, match=r"\(4,\) and \(3, 3\)"):
        projective_to_euclidean(np.ones(3), np.eye(3))
    with pytest.raises(GeometryError, match="regular"):
        strata_of(np.zeros((4, 4)))
    with pytest.raises(GeometryError, match="one zero and three"):
        strata_of_quadric(np.diag([1.0, 1.0, -1.0, 0.0]))
    with pytest.raises(GeometryError, match="singular"):
        decompose_camera(np.eye(3, 4) * [1, 1, 0, 0])
    with pytest.raises(GeometryError, match="lies in the plane"):
        infinity_homography(np.eye(3, 4), np.eye(3, 4), np.array([1.0, 0, 0, 0]))
