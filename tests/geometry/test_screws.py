import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from oracles.displacement_logarithms import normalise_displacement
from oracles.screw_motions import (
    exp_screw,
    log_displacement,
    nearest_twist,
    screw_axis,
    screw_pitch,
    split_twist,
)
from stereoservo.geometry.displacements import conjugate, exp_rotation, exp_translation
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.lines import line_through_points
from stereoservo.geometry.screws import exp_twist, screw_twist, twist_angle, twist_matrix

seeds = st.integers(0, 2**32 - 1)
pitches = st.floats(-1.0, 1.0)


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


class Truth:
    """A Euclidean screw in a random projective frame; its motion by Rodrigues and a shift along the axis."""

    def __init__(self, rng, pitch):
        self.axis = rng.normal(size=3)
        self.axis /= np.linalg.norm(self.axis)
        self.point = rng.uniform(-0.5, 0.5, 3)
        self.pitch = pitch
        self.back = frame(rng)  # H_PE⁻¹
        self.up = np.linalg.inv(self.back)

    @property
    def generator(self):
        return self.back @ screw_twist(self.axis, self.point, self.pitch) @ self.up

    def displacement(self, theta, shift=None):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(theta * self.axis).as_matrix()
        shift = theta * self.pitch if shift is None else shift
        T[:3, 3] = self.point - T[:3, :3] @ self.point + shift * self.axis
        return self.back @ T @ self.up


@given(seeds, pitches, st.floats(-7, 7))
def test_exponential_of_a_screw_is_the_conjugate_of_the_euclidean_one(seed, pitch, theta):
    truth = Truth(np.random.default_rng(seed), pitch)
    expected = truth.displacement(theta)
    assert np.allclose(exp_screw(truth.generator, theta), expected, atol=1e-10)
    assert np.allclose(exp_twist(theta * truth.generator), expected, atol=1e-10)


@given(seeds, st.floats(0, 12))
def test_exponential_of_a_small_or_pure_translation_twist_is_expm(seed, decimals):
    rng = np.random.default_rng(seed)
    back = frame(rng)
    for w in (rng.normal(size=3) * 10.0**-decimals, np.zeros(3)):
        X = conjugate(back, twist_matrix(w, rng.normal(size=3)))
        assert np.allclose(exp_twist(X), expm(X), atol=1e-12 * np.linalg.cond(back) ** 2)


def test_exponentials_take_stacks():
    truth = Truth(np.random.default_rng(1), 0.3)
    angles = np.linspace(-3, 3, 5)
    stacked = exp_screw(truth.generator, angles)
    assert stacked.shape == (5, 4, 4)
    assert np.allclose(stacked, [truth.displacement(a) for a in angles])
    assert np.allclose(exp_twist(angles[:, None, None] * truth.generator), stacked)
    assert np.allclose(twist_angle(angles[:, None, None] * truth.generator), np.abs(angles))


@given(seeds, st.floats(-2, 2), st.floats(-3, 3))
def test_unaligned_sums_and_products_as_corrected(seed, tau, theta):
    """Appendix A.1: the product (A.16) as printed, the exponential of the sum with its erratum."""
    rng = np.random.default_rng(seed)
    truth = Truth(rng, 0.0)
    R = truth.generator
    T = conjugate(truth.back, twist_matrix(np.zeros(3), rng.normal(size=3)))
    product = exp_translation(T, tau) @ exp_rotation(R, theta)
    assert np.allclose(product, np.eye(4) + np.sin(theta) * R + (1 - np.cos(theta)) * R @ R + tau * T, atol=1e-10)
    total = exp_twist(tau * T + theta * R)
    assert np.allclose(total, expm(tau * T + theta * R), atol=1e-10)
    if abs(theta) > 1e-2:
        shift = tau * R @ R @ T
        corrected = (
            np.eye(4)
            + (tau * T + shift)
            + np.sin(theta) * (R - shift / theta)
            + (1 - np.cos(theta)) * (R @ R + tau / theta * R @ T)
        )
        assert np.allclose(total, corrected, atol=1e-9)


@given(seeds, pitches, st.floats(1e-12, np.pi - 1e-3))
def test_logarithm_inverts_the_exponential(seed, pitch, theta):
    truth = Truth(np.random.default_rng(seed), pitch)
    X = log_displacement(truth.displacement(theta))
    assert np.allclose(X, theta * truth.generator, atol=1e-9)


@given(seeds, pitches, st.floats(3, 6.5))
def test_logarithm_near_half_a_turn_loses_only_what_the_matrix_has_lost(seed, pitch, decimals):
    gap = 10.0**-decimals
    truth = Truth(np.random.default_rng(seed), pitch)
    H = truth.displacement(np.pi - gap)
    X = log_displacement(H)
    assert np.allclose(exp_twist(X), H, atol=1e-8)
    # The sense rests on sin θ = gap, known to rounding: an error of 1e-15/gap at least.
    assert np.allclose(X, (np.pi - gap) * truth.generator, atol=1e-12 / gap + 1e-8)


@given(seeds, st.floats(0.0, 12.0))
def test_logarithm_of_small_motions_and_translations_is_exact(seed, decimals):
    rng = np.random.default_rng(seed)
    back = frame(rng)
    size = 10.0**-decimals
    for w in (size * rng.normal(size=3) / 3, np.zeros(3)):
        X = conjugate(back, twist_matrix(w, size * rng.normal(size=3)))
        assert np.allclose(log_displacement(expm(X)), X, atol=1e-13 * np.linalg.cond(back) ** 2)
    assert np.abs(log_displacement(np.eye(4))).max() == 0.0


@given(seeds, pitches, st.floats(0.01, 3.1), st.floats(0.1, 5.0), st.sampled_from([-1.0, 1.0]))
def test_normal_form_then_logarithm_of_a_scaled_homography(seed, pitch, theta, scale, sign):
    truth = Truth(np.random.default_rng(seed), pitch)
    points = np.random.default_rng(seed).normal(size=(8, 4))
    H = truth.displacement(theta)
    normal = normalise_displacement(sign * scale * H, points, points @ H.T)
    assert np.allclose(log_displacement(normal), theta * truth.generator, atol=1e-7)


@given(seeds, pitches, st.floats(0.01, 3.0))
def test_rotation_and_translation_commute_and_make_the_screw(seed, pitch, theta):
    truth = Truth(np.random.default_rng(seed), pitch)
    H = truth.displacement(theta)
    screw = split_twist(log_displacement(H))
    R, N = screw.rotation, screw.translation
    assert np.isclose(screw.angle, theta, atol=1e-9)
    assert np.allclose(R @ R @ R, -R, atol=1e-8)
    assert np.abs(N @ N).max() < 1e-8
    assert np.abs(R @ N).max() + np.abs(N @ R).max() < 1e-8
    turn, shift = exp_rotation(R, screw.angle), exp_translation(N, 1.0)
    assert np.allclose(turn, truth.displacement(theta, shift=0.0), atol=1e-7)
    assert np.allclose(shift, truth.displacement(0.0, shift=theta * pitch), atol=1e-7)
    assert np.allclose(turn @ shift, H, atol=1e-7)
    assert np.allclose(shift @ turn, H, atol=1e-7)


def test_a_pure_translation_splits_into_itself():
    rng = np.random.default_rng(2)
    X = conjugate(frame(rng), twist_matrix(np.zeros(3), rng.normal(size=3)))
    screw = split_twist(X)
    assert screw.angle == 0.0
    assert np.array_equal(screw.translation, X)
    assert not screw.rotation.any()


@given(seeds, pitches, st.floats(0.01, np.pi))
def test_pitch_and_axis(seed, pitch, theta):
    truth = Truth(np.random.default_rng(seed), pitch)
    assert np.isclose(screw_pitch(theta * truth.generator, truth.up), pitch, atol=1e-9)
    assert np.isclose(screw_pitch(screw_twist(truth.axis, truth.point, pitch)), pitch, atol=1e-12)
    points = screw_axis(truth.displacement(theta))
    assert np.allclose(points @ points.T, np.eye(2))
    found = line_through_points(*(points @ truth.up.T))
    expected = np.concatenate([truth.axis, np.cross(truth.point, truth.axis)])
    found, expected = found / np.linalg.norm(found), expected / np.linalg.norm(expected)
    assert np.isclose(abs(found @ expected), 1.0, atol=1e-9)


def test_half_a_turn_tells_its_axis_but_no_logarithm():
    truth = Truth(np.random.default_rng(3), 0.2)
    with pytest.raises(GeometryError) as error:
        log_displacement(truth.displacement(np.pi))
    assert error.value.code == "half_turn"


@given(seeds, pitches, st.floats(0.3, 2.8), st.floats(0.0, 1e-3))
def test_nearest_twist_is_exact_and_near(seed, pitch, theta, noise):
    rng = np.random.default_rng(seed)
    truth = Truth(rng, pitch)
    X = theta * truth.generator
    found = nearest_twist(X + noise * rng.normal(size=(4, 4)))
    angle = twist_angle(found)
    square = found @ found
    assert np.abs(square @ square + angle**2 * square).max() < 1e-9
    assert np.abs(found - X).max() < 1e-7 + 300 * noise
    assert np.allclose(exp_twist(found), expm(found), atol=1e-9)
    assert np.allclose(nearest_twist(found), found, atol=1e-7)


def test_what_is_no_screw_is_refused():
    with pytest.raises(GeometryError, match="normalise_displacement"):
        log_displacement(2.0 * np.eye(4))
    with pytest.raises(GeometryError, match="not positive"):
        exp_twist(np.diag([1.0, -1.0, 0, 0]))
    with pytest.raises(GeometryError, match="no axis"):
        screw_axis(np.eye(4) + np.eye(1, 4).T @ np.eye(4)[3:])
    with pytest.raises(GeometryError, match="infinite"):
        screw_pitch(twist_matrix(np.zeros(3), np.ones(3)))
    with pytest.raises(GeometryError, match="direction is zero"):
        screw_twist(np.zeros(3), np.zeros(3))
    with pytest.raises(GeometryError, match="complex pair"):
        nearest_twist(np.diag([1.0, 2.0, 3.0, 4.0]))
