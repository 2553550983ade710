import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from oracles.displacement_logarithms import (
    bracket,
    dual_generator,
    log_rotation,
    log_translation,
    normalise_displacement,
    rotation_angle,
    rotation_axis,
    rotation_generator,
    translation_generator,
)
from stereoservo.geometry.displacements import (
    conjugate,
    exp_generator,
    exp_rotation,
    exp_translation,
    nearest_rotation_generator,
    nearest_translation_generator,
)
from stereoservo.geometry.homogeneous import GeometryError

seeds = st.integers(0, 2**32 - 1)
angles = st.floats(-3.1, 3.1)


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


def euclidean_twist(axis, point):
    """Twist of a unit rotation about ``axis`` through ``point``."""
    w = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    twist = np.zeros((4, 4))
    twist[:3, :3] = w
    twist[:3, 3] = -w @ point
    return twist


def random_rotation(rng):
    """Frame, projective generator, and a function of the angle that rotates by Rodrigues in Euclidean
    space.
    """
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    point = rng.uniform(-0.5, 0.5, 3)
    H = frame(rng)

    def truth(theta):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(theta * axis).as_matrix()
        T[:3, 3] = point - T[:3, :3] @ point
        return H @ T @ np.linalg.inv(H)

    return H, H @ euclidean_twist(axis, point) @ np.linalg.inv(H), truth


def random_translation(rng):
    H = frame(rng)
    twist = np.zeros((4, 4))
    twist[:3, 3] = rng.normal(size=3)
    return H @ twist @ np.linalg.inv(H)


@given(seeds, angles)
def test_exponential_of_a_rotation_is_the_conjugate_of_the_euclidean_one(seed, theta):
    _, G, truth = random_rotation(np.random.default_rng(seed))
    assert np.allclose(exp_rotation(G, theta), truth(theta), atol=1e-12)
    assert np.allclose(exp_generator("revolute", G, theta), expm(theta * G), atol=1e-11)


@given(seeds, angles, angles)
def test_group_laws_of_rotations(seed, a, b):
    _, G, _ = random_rotation(np.random.default_rng(seed))
    assert np.allclose(exp_rotation(G, 0.0), np.eye(4))
    assert np.allclose(exp_rotation(G, a) @ exp_rotation(G, b), exp_rotation(G, a + b), atol=1e-11)
    assert np.allclose(exp_rotation(G, a) @ exp_rotation(G, -a), np.eye(4), atol=1e-11)
    assert np.allclose(exp_rotation(G, a) @ G, G @ exp_rotation(G, a), atol=1e-11)
    assert np.isclose(np.linalg.det(exp_rotation(G, a)), 1.0)


@given(seeds, st.floats(-5, 5), st.floats(-5, 5))
def test_group_laws_of_translations(seed, a, b):
    G = random_translation(np.random.default_rng(seed))
    assert np.abs(G @ G).max() < 1e-12 * np.abs(G).max() ** 2 + 1e-300
    assert np.allclose(exp_translation(G, a), expm(a * G), atol=1e-10)
    assert np.allclose(exp_translation(G, a) @ exp_translation(G, b), exp_translation(G, a + b), atol=1e-10)
    assert np.array_equal(exp_generator("prismatic", G, a), exp_translation(G, a))


def test_exponentials_take_stacks_and_refuse_unknown_kinds():
    rng = np.random.default_rng(1)
    G = np.stack([random_rotation(rng)[1] for _ in range(3)])
    theta = np.array([0.1, -2.0, 3.0])
    assert np.allclose(exp_rotation(G, theta)[1], exp_rotation(G[1], -2.0))
    assert exp_rotation(G[0], np.zeros((5, 2))).shape == (5, 2, 4, 4)
    with pytest.raises(GeometryError, match="'helical'"):
        exp_generator("helical", G[0], 0.1)


@given(seeds, st.floats(1e-4, np.pi - 1e-5))
def test_logarithm_of_a_rotation_inverts_the_exponential(seed, theta):
    _, G, truth = random_rotation(np.random.default_rng(seed))
    found, angle = log_rotation(truth(theta))
    tolerance = 1e-11 / np.sin(theta)  # what rounding of H leaves of its odd part
    assert abs(angle - theta) < 1e-9
    assert np.abs(found - G).max() < tolerance * max(1.0, np.abs(G).max())
    assert np.abs(found @ found @ found + found).max() < 1e-12 * max(1.0, np.abs(found).max()) ** 3
    assert np.abs(exp_rotation(found, angle) - truth(theta)).max() < 1e-10


def test_generator_has_the_sense_of_the_shorter_turn():
    _, G, truth = random_rotation(np.random.default_rng(2))
    assert np.allclose(rotation_generator(truth(-0.5)), -G, atol=1e-9)
    assert np.allclose(rotation_generator(truth(2 * np.pi - 0.5)), -G, atol=1e-9)


@given(seeds)
def test_half_turn_tells_axis_and_angle_but_refuses_a_generator(seed):
    _, G, truth = random_rotation(np.random.default_rng(seed))
    half = truth(np.pi)
    assert rotation_angle(half) == pytest.approx(np.pi, abs=1e-5)
    assert np.abs(rotation_axis(half) @ G.T).max() < 1e-9 * max(1.0, np.abs(G).max())
    with pytest.raises(GeometryError) as error:
        log_rotation(exp_rotation(G, np.pi))
    assert error.value.code == "half_turn"


def test_identity_has_no_axis():
    for refuse in (log_rotation, rotation_axis, log_translation):
        with pytest.raises(GeometryError) as error:
            refuse(np.eye(4))
        assert error.value.code == "degenerate"


@given(seeds, st.floats(1e-3, 10))
def test_logarithm_of_a_translation_inverts_the_exponential(seed, tau):
    G = random_translation(np.random.default_rng(seed))
    found = translation_generator(exp_translation(G, tau), tau)
    assert np.abs(found - G).max() < 1e-10 * max(1.0, 1 / tau) * max(1.0, np.abs(G).max() ** 2)
    assert np.abs(found @ found).max() < 1e-14 * max(1.0, np.abs(found).max() ** 2)
    with pytest.raises(GeometryError, match="tau is 0"):
        translation_generator(exp_translation(G, tau), 0.0)


@given(seeds, st.floats(0, 0.03))
def test_nearest_rotation_generator_is_exact_and_near(seed, noise):
    rng = np.random.default_rng(seed)
    _, G, _ = random_rotation(rng)
    disturbance = noise * rng.normal(size=(4, 4))
    found = nearest_rotation_generator(G + disturbance)
    size = max(1.0, np.linalg.norm(G))
    assert np.abs(found @ found @ found + found).max() < 1e-12 * size**3
    assert np.allclose(np.sort(np.linalg.eigvals(found).imag), [-1, 0, 0, 1], atol=1e-6 * size)
    # Perturbation of a projector that belongs to a simple eigenvalue at distance 1 of the others.
    assert np.linalg.norm(found - G) <= 4.0 * size**3 * np.linalg.norm(disturbance) + 1e-12 * size**3
    assert np.abs(nearest_rotation_generator(found) - found).max() < 1e-11 * size**3


def test_nearest_rotation_generator_refuses_real_eigenvalues():
    with pytest.raises(GeometryError, match="no complex pair"):
        nearest_rotation_generator(np.diag([1.0, 2, 3, 4]))
    with pytest.raises(GeometryError, match="finite"):
        nearest_rotation_generator(np.full((4, 4), np.inf))
    with pytest.raises(GeometryError, match=r"\(3, 3\)"):
        nearest_rotation_generator(np.eye(3))


@given(seeds, st.floats(0, 0.1))
def test_nearest_translation_generator_is_nilpotent_and_no_neighbour_is_nearer(seed, noise):
    rng = np.random.default_rng(seed)
    G = random_translation(rng)
    A = G + noise * np.linalg.norm(G) * rng.normal(size=(4, 4)) / 4
    found = nearest_translation_generator(A)
    assert np.abs(found @ found).max() < 1e-13 * np.linalg.norm(G) ** 2
    distance = np.linalg.norm(found - A)
    assert distance <= np.linalg.norm(G - A) + 1e-12
    for _ in range(5):
        X = 1e-2 * rng.normal(size=(4, 4))
        neighbour = expm(X) @ found @ expm(-X) * (1 + 1e-2 * rng.normal())
        assert np.linalg.norm(neighbour - A) >= distance - 1e-12
    with pytest.raises(GeometryError, match="zero"):
        nearest_translation_generator(np.zeros((4, 4)))


@given(seeds, angles, st.sampled_from([-1.0, 1.0]), st.floats(0.01, 100))
def test_normal_form_undoes_any_scale_given_points(seed, theta, sign, scale):
    rng = np.random.default_rng(seed)
    frame_, _, truth = random_rotation(rng)
    H = truth(theta) @ exp_translation(random_translation(rng) * 0, 0.0)
    X = np.hstack([rng.uniform(-1, 1, (5, 3)), np.ones((5, 1))]) @ frame_.T
    heights = rng.uniform(0.5, 2, (2, 5, 1))
    found = normalise_displacement(sign * scale * H, heights[0] * X, heights[1] * (X @ H.T))
    assert np.allclose(found, H, atol=1e-11)
    if abs(np.trace(H)) > 0.1:
        assert np.allclose(normalise_displacement(sign * scale * H), H, atol=1e-11)


def test_normal_form_refuses_reflections_and_untold_signs():
    with pytest.raises(GeometryError) as error:
        normalise_displacement(np.diag([1.0, 1, 1, -1]))
    assert error.value.code == "orientation"
    assert error.value.data["determinant"] < 0
    with pytest.raises(GeometryError, match="positive determinant"):
        normalise_displacement(np.zeros((4, 4)))
    half_turn = np.diag([-1.0, -1, 1, 1])
    with pytest.raises(GeometryError, match="give points"):
        normalise_displacement(half_turn)
    X = np.array([[0.1, 0.2, 3.0, 1.0]])
    assert np.allclose(normalise_displacement(-2 * half_turn, X, X @ half_turn.T), half_turn)
    with pytest.raises(GeometryError, match="heights disagree"):
        normalise_displacement(half_turn, np.vstack([X, X]), np.vstack([X, -X]) @ half_turn.T)


@given(seeds, angles)
def test_planes_move_with_the_dual_generator(seed, theta):
    rng = np.random.default_rng(seed)
    _, G, _ = random_rotation(rng)
    dual = dual_generator(G)
    assert np.allclose(exp_rotation(dual, theta), np.linalg.inv(exp_rotation(G, theta)).T, atol=1e-10)
    M, a = rng.normal(size=4), rng.normal(size=4)
    assert np.isclose((dual @ a) @ M + a @ (G @ M), 0.0, atol=1e-12 * max(1.0, np.abs(G).max()) * 10)


@given(seeds, angles)
@settings(max_examples=50)
def test_adjoint_action_and_bracket(seed, theta):
    rng = np.random.default_rng(seed)
    _, A, _ = random_rotation(rng)
    B = random_rotation(rng)[1]
    h = 1e-5
    moved = [conjugate(exp_rotation(A, s), B) for s in (h, -h)]
    difference = (moved[0] - moved[1]) / (2 * h)
    size = np.linalg.norm(A) ** 3 * np.linalg.norm(B)
    assert np.abs(difference - bracket(A, B)).max() < 1e-8 * max(1.0, size)
    assert np.allclose(bracket(A, B), -bracket(B, A))
    C = random_translation(rng)
    jacobi = bracket(A, bracket(B, C)) + bracket(B, bracket(C, A)) + bracket(C, bracket(A, B))
    assert np.abs(jacobi).max() < 1e-11 * max(1.0, np.linalg.norm(A) * np.linalg.norm(B) * np.linalg.norm(C))
    turned = conjugate(exp_rotation(A, theta), exp_rotation(B, 0.7))
    assert np.allclose(turned, exp_rotation(conjugate(exp_rotation(A, theta), B), 0.7), atol=1e-9)
