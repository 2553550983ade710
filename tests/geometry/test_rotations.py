"""Projective rotations against Euclidean ones seen in a random projective frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from oracles.displacement_logarithms import generator_between
from oracles.jordan_frames import (
    circle_centres,
    circle_directions,
    generator_from_homographies,
    jordan_rotation,
    rotation_commutator,
)
from stereoservo.geometry.cameras import project_many, triangulate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.rotation_fit import (
    RotationChart,
    bundle_rotation,
    rotation_chart,
    rotation_frame,
    rotation_from_parameters,
    rotation_motion,
    rotation_parameter_derivatives,
    rotation_parameters,
)

seeds = st.integers(0, 2**32 - 1)


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


class Truth:
    """A Euclidean axis (point, unit direction) and the frame ``H`` (Euclidean to projective) it is seen in."""

    def __init__(self, seed, H=None):
        rng = np.random.default_rng(seed)
        self.direction = rng.normal(size=3)
        self.direction /= np.linalg.norm(self.direction)
        self.point = rng.uniform(-0.5, 0.5, 3)
        self.H = frame(rng) if H is None else H
        self.back = np.linalg.inv(self.H)

    def turn(self, theta):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(theta * self.direction).as_matrix()
        T[:3, 3] = self.point - T[:3, :3] @ self.point
        return self.H @ T @ self.back

    @property
    def generator(self):
        h = 1e-3  # the sine's odd part is exact: H(h) - H(-h) = 2 sin h G
        return (self.turn(h) - self.turn(-h)) / (2 * np.sin(h))

    def euclidean(self, M):
        return M @ self.back.T

    def euclidean_planes(self, a):
        return a @ self.H


@given(seeds, st.floats(-3.1, 3.1))
def test_jordan_frames_of_a_rotation_and_their_geometry(seed, theta):
    truth = Truth(seed)
    rng = np.random.default_rng(seed)
    one = rotation_frame(truth.generator)
    size = np.abs(truth.generator).max()
    for found in (one, one.changed(rotation_commutator([0.3, -1.2, *rng.uniform(0.5, 2, 2), -1.0, 0.7]))):
        S = found.planes
        assert np.allclose(np.linalg.inv(S) @ jordan_rotation(theta) @ S, truth.turn(theta), atol=1e-9 * max(1, size))
        assert np.allclose(found.generator, truth.generator, atol=1e-9 * max(1, size))
        # Euclidean: two directions normal to the axis and to each other, of equal length.
        first, second = truth.euclidean(found.normal_directions)
        assert abs(first[3]) < 1e-8
        assert abs(second[3]) < 1e-8
        length = np.linalg.norm(first[:3])
        assert np.linalg.norm(second[:3]) == pytest.approx(length, rel=1e-8)
        assert abs(first[:3] @ second[:3]) < 1e-8 * length**2
        assert abs(first[:3] @ truth.direction) < 1e-8 * length
        # Points on the axis lie on it, or at its infinity.
        for point in truth.euclidean(found.axis):
            off = np.cross(point[:3] - point[3] * truth.point, truth.direction)
            assert np.abs(off).max() < 1e-8 * np.linalg.norm(point)
        # Planes through the axis, normal to each other; planes across it.
        a, b = truth.euclidean_planes(found.axial_planes)
        for plane in (a, b):
            assert abs(plane[:3] @ truth.direction) < 1e-8 * np.linalg.norm(plane)
            assert abs(plane[:3] @ truth.point + plane[3]) < 1e-8 * np.linalg.norm(plane)
        assert abs(a[:3] @ b[:3]) < 1e-8 * np.linalg.norm(a) * np.linalg.norm(b)
        for plane in truth.euclidean_planes(found.planes[2:]):
            assert np.abs(np.cross(plane[:3], truth.direction)).max() < 1e-8 * np.linalg.norm(plane)


@given(seeds)
def test_commutators_commute_and_only_they_do(seed):
    rng = np.random.default_rng(seed)
    p = rng.normal(size=6)
    C = rotation_commutator(p) if abs(p[2] * p[5] - p[3] * p[4]) > 1e-3 else rotation_commutator([1, 2, 1, 0, 0, 1])
    J = jordan_rotation(0.7)
    assert np.allclose(J @ C, C @ J)
    # The commutant of J has six dimensions, as many as there are parameters.
    commutes = np.kron(J, np.eye(4)) - np.kron(np.eye(4), J.T)
    assert (np.linalg.svd(commutes, compute_uv=False) < 1e-12).sum() == 6
    with pytest.raises(GeometryError, match="neither may be zero"):
        rotation_commutator([0, 0, 1, 0, 0, 1])
    with pytest.raises(GeometryError, match=r"\(6,\)"):
        rotation_commutator([1.0, 0])


@given(seeds)
def test_circles_have_their_euclidean_centres_and_directions(seed):
    truth = Truth(seed)
    X = np.hstack([np.random.default_rng(seed).uniform(-1, 1, (4, 3)), np.ones((4, 1))])
    M = X @ truth.H.T
    centres = truth.euclidean(circle_centres(truth.generator, M))
    foot = truth.point + ((X[:, :3] - truth.point) @ truth.direction)[:, None] * truth.direction
    assert np.allclose(centres[:, :3] / centres[:, 3:], foot, atol=1e-8)
    radial, tangential = (truth.euclidean(d) for d in circle_directions(truth.generator, M))
    assert np.allclose(radial[:, :3], foot - X[:, :3], atol=1e-8)
    assert np.allclose(tangential[:, :3], np.cross(truth.direction, X[:, :3] - truth.point), atol=1e-8)


def test_matrices_that_are_no_generators_are_refused():
    for wrong in (np.eye(4), np.zeros((4, 4)), 1.1 * Truth(1).generator):
        with pytest.raises(GeometryError, match="zero is needed") as error:
            rotation_frame(wrong)
        assert error.value.code == "degenerate"
    with pytest.raises(GeometryError, match="finite"):
        rotation_frame(np.full((4, 4), np.nan))


@given(seeds, st.lists(st.floats(-7, 7), min_size=1, max_size=5))
def test_generator_from_exact_homographies(seed, angles):
    truth = Truth(seed)
    if np.linalg.norm(np.sin(angles)) < 1e-3:
        angles = [*angles, 0.8]
    found = generator_from_homographies([truth.turn(a) for a in angles], angles)
    scale = max(1.0, np.abs(truth.generator).max()) ** 2 / np.linalg.norm(np.sin(angles))
    assert np.abs(found - truth.generator).max() < 1e-11 * scale
    assert np.abs(found @ found @ found + found).max() < 1e-11 * max(1.0, np.abs(found).max()) ** 3


def test_near_a_half_turn_the_eigenspaces_are_the_better_source():
    errors = {"odd": [], "between": []}
    angle = np.pi - 0.02
    for seed in range(60):
        truth = Truth(seed)
        H = truth.turn(angle) + 1e-5 * np.random.default_rng(seed).normal(size=(4, 4))
        odd = (H - np.linalg.inv(H)) / (2 * np.sin(angle))
        found = generator_from_homographies([H], [angle])
        assert np.abs(found @ found @ found + found).max() < 1e-10 * np.abs(found).max() ** 3
        errors["between"].append(np.linalg.norm(found - truth.generator) / np.linalg.norm(truth.generator))
        errors["odd"].append(np.linalg.norm(odd - truth.generator) / np.linalg.norm(truth.generator))
    # Of 16 entries only the two within the plane of directions still carry the noise over sin θ.
    assert np.median(errors["between"]) < 0.7 * np.median(errors["odd"])


def test_angles_that_tell_no_generator_are_refused():
    truth = Truth(3)
    for angles, code in (([np.pi, -np.pi, 3 * np.pi], "half_turn"), ([0.0, 2 * np.pi], "degenerate")):
        with pytest.raises(GeometryError) as error:
            generator_from_homographies([truth.turn(a) for a in angles], angles)
        assert error.value.code == code
    with pytest.raises(GeometryError, match="do not fit"):
        generator_from_homographies([np.eye(4)], [0.1, 0.2])
    with pytest.raises(GeometryError, match="finite"):
        generator_from_homographies([np.eye(4)], [np.nan])
    frame_ = rotation_frame(truth.generator)
    mirrored = frame_.points[:2].T @ np.diag([1.0, -1.0]) @ frame_.planes[:2]
    with pytest.raises(GeometryError, match="hides its sense"):
        generator_between(mirrored, truth.generator @ truth.generator)


@given(seeds)
def test_ten_parameters_say_the_generator_and_back(seed):
    truth = Truth(seed)
    chart = rotation_chart(truth.generator)
    x = rotation_parameters(truth.generator, chart)
    size = np.abs(truth.generator).max()
    assert x.shape == (10,)
    assert np.abs(rotation_from_parameters(x, chart) - truth.generator).max() < 1e-10 * max(1, size) ** 2
    # Nearby parameters are generators as well, and come back as they are.
    other = x + 0.05 * np.random.default_rng(seed).normal(size=10)
    G = rotation_from_parameters(other, chart)
    assert np.abs(G @ G @ G + G).max() < 1e-9 * max(1, np.abs(G).max()) ** 3
    assert np.allclose(rotation_parameters(G, chart), other, rtol=1e-6, atol=1e-7)


@given(seeds)
@settings(max_examples=30)
def test_derivatives_of_the_parameters(seed):
    truth = Truth(seed)
    chart = rotation_chart(truth.generator)
    x = rotation_parameters(truth.generator, chart)
    exact = rotation_parameter_derivatives(x, chart)
    step = 1e-6
    for p, unit in enumerate(np.eye(10)):
        difference = (
            rotation_from_parameters(x + step * unit, chart) - rotation_from_parameters(x - step * unit, chart)
        ) / (2 * step)
        assert np.abs(difference - exact[p]).max() < 1e-5 * max(1, np.abs(exact).max())
    # Ten freedoms, none of them twice.
    assert np.linalg.matrix_rank(exact.reshape(10, 16), tol=1e-8) == 10
    H, slopes = rotation_motion(chart, np.array([0.4, -1.0]))(x)
    assert np.allclose(H[0], truth.turn(0.4), atol=1e-9 * max(1, np.abs(H).max()))
    ahead = rotation_motion(chart, np.array([0.4, -1.0]))(x + step * np.eye(10)[4])[0]
    assert np.abs((ahead - H) / step - slopes[:, 4]).max() < 1e-3 * max(1, np.abs(slopes).max()) ** 2


def test_parameters_outside_a_chart_are_refused():
    G = np.zeros((4, 4))
    G[:2, :2] = [[0, -1], [1, 0]]  # about z: h1, h2 have no third and fourth coordinate
    with pytest.raises(GeometryError, match="first pivot"):
        rotation_parameters(G, RotationChart(np.array([2, 3, 0, 1])))
    with pytest.raises(GeometryError, match="second pivot"):
        rotation_parameters(G, RotationChart(np.array([0, 2, 1, 3])))
    assert np.allclose(rotation_parameters(G, rotation_chart(G)), [0, 0, 0, 1, 0, 0, 0, 0, 0, 0])
    with pytest.raises(GeometryError, match="h'22"):
        rotation_from_parameters(np.zeros(10), rotation_chart(G))
    with pytest.raises(GeometryError, match="ten finite"):
        rotation_from_parameters(np.zeros(9), rotation_chart(G))


ANGLES = np.radians(np.linspace(-12, 12, 7))


def scene(rig, seed, points=12):
    """Cameras, exact pixels (s, c, m, 2), points (m, 4) and the truth in the rig's own projective frame."""
    rng = np.random.default_rng(1000 + seed)
    X = rig.points(rng, points)
    H = np.eye(4) + 0.1 * rng.normal(size=(4, 4))
    truth = Truth(seed, H)
    truth.point = truth.point * 0.3 + [0, 0, rig.baseline / np.tan(np.deg2rad(rig.vergence_deg))]
    Ps = rig.Ps @ truth.back
    M = X @ H.T
    exact = np.stack([project_many(Ps, M @ truth.turn(a).T) for a in ANGLES])
    return truth, Ps, M, exact


def start(truth, seed, size=0.02):
    """A generator near the truth: what a linear estimate gives."""
    rng = np.random.default_rng(seed)
    return generator_from_homographies(
        [truth.turn(a) + size * np.sin(a) * rng.normal(size=(4, 4)) for a in (0.2, -0.2)], [0.2, -0.2]
    )


def test_exact_pixels_give_the_exact_generator(rig):
    truth, Ps, M, exact = scene(rig, 1)
    found = bundle_rotation(Ps, exact, M, start(truth, 1), ANGLES, 0.3)
    assert np.abs(found.generator - truth.generator).max() < 1e-6
    assert found.cost < 1e-6
    assert np.allclose(rotation_from_parameters(found.parameters, found.chart), found.generator)


def test_fits_reach_the_cramer_rao_bound_and_state_it(rig):
    """Normalised squared errors of the generator, and costs, pooled over 60 seeds: chi-square at 1 %."""
    sigma, runs = 0.3, 60
    normalised, cost, freedom = 0.0, 0.0, 0
    for seed in range(runs):
        truth, Ps, _, exact = scene(rig, seed)
        rng = np.random.default_rng(seed)
        pixels = exact + rng.normal(0, sigma, exact.shape)
        pixels[2, 1, 3] = np.nan
        middle = triangulate(Ps, pixels[3], sigma)
        fit = bundle_rotation(Ps, pixels, middle, start(truth, seed), ANGLES, sigma)
        error = fit.parameters - rotation_parameters(truth.generator, fit.chart)
        normalised += error @ np.linalg.solve(fit.covariance, error)
        cost += fit.cost
        freedom += fit.freedom
        assert np.linalg.matrix_rank(fit.generator_covariance, tol=1e-12) <= 10
    low, high = chi2.ppf([0.005, 0.995], 10 * runs)
    assert low < normalised < high, normalised / (10 * runs)
    low, high = chi2.ppf([0.005, 0.995], freedom)
    assert low < cost < high, cost / freedom


def test_a_flat_scene_will_do(rig):
    truth, Ps, M, _ = scene(rig, 5)
    X = truth.euclidean(M)
    X[:, 2] = X[:, 2].mean() + 0.2 * X[:, 0]
    M = X @ truth.H.T
    exact = np.stack([project_many(Ps, M @ truth.turn(a).T) for a in ANGLES])
    rng = np.random.default_rng(5)
    found = bundle_rotation(Ps, exact + rng.normal(0, 0.1, exact.shape), M, start(truth, 5), ANGLES, 0.1)
    error = found.parameters - rotation_parameters(truth.generator, found.chart)
    assert error @ np.linalg.solve(found.covariance, error) < chi2.isf(1e-3, 10)


def test_what_cannot_be_fitted_is_refused(rig):
    truth, Ps, M, exact = scene(rig, 2)
    G = truth.generator
    with pytest.raises(GeometryError, match="do not fit"):
        bundle_rotation(Ps, exact, M, G, ANGLES[:3], 0.3)
    with pytest.raises(GeometryError, match="zero is needed"):
        bundle_rotation(Ps, exact, M, np.eye(4), ANGLES, 0.3)
    few = np.full_like(M, np.nan)
    few[0] = M[0]
    with pytest.raises(GeometryError, match="parameters"):
        bundle_rotation(Ps, exact[:2], few, G, ANGLES[:2], 0.3)
    on_axis = truth.H @ np.array([*truth.point, 1.0])
    still = np.tile(on_axis, (len(M), 1)) + 1e-9 * M
    images = np.stack([project_many(Ps, still @ truth.turn(a).T) for a in ANGLES])
    with pytest.raises((GeometryError), match=r"undetermined|coplanar"):
        bundle_rotation(Ps, images, still, G, ANGLES, 0.3)
