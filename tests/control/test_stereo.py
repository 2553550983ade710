"""The stereo law: kernel against reference, reference against the pseudo-inverse (8.36)."""

import numpy as np
import pytest

from stereoservo.control.stereo_cycle import StereoCycle, stereo_step
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.kernels import triangulate
from stereoservo_sim.benchmarks.cycle import stereo_law


def case(seed, n=6):
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(scale=300.0, size=(2, 4, 2, n))
    pixels, set_points = rng.uniform(0, 480, (2, 2, 4, 2))
    return jacobian, pixels, set_points, rng.uniform(1.0, 10.0, (2, 4))


@pytest.mark.parametrize("seed", range(10))
def test_undamped_law_is_the_weighted_pseudo_inverse(seed):
    jacobian, pixels, set_points, weights = case(seed)
    rows = np.repeat(weights.reshape(-1), 2)
    J, e = jacobian.reshape(-1, 6), (pixels - set_points).reshape(-1)
    expected = -0.7 * np.linalg.pinv(rows[:, None] * J) @ (rows * e)
    step = stereo_law(jacobian, pixels, set_points, weights, 0.7, 0.0)
    np.testing.assert_allclose(step.velocity, expected, atol=1e-10)
    assert step.error_px == pytest.approx(np.linalg.norm(pixels - set_points, axis=-1).max())


@pytest.mark.parametrize("seed", range(10))
def test_kernel_is_the_reference_also_with_missing_markers(seed):
    jacobian, pixels, set_points, weights = case(seed, n=5 + seed % 3)
    weights[0, 1] = weights[1, 3] = 0.0
    pixels[0, 1] = np.nan
    jacobian[0, 1] = np.nan
    expected = stereo_law(jacobian, pixels, set_points, weights, 1.3, 1e-4)
    velocity, error_px, conditioning = stereo_step(jacobian, pixels, set_points, weights, 1.3, 1e-4)
    np.testing.assert_allclose(velocity, expected.velocity, rtol=0, atol=1e-10)
    assert error_px == pytest.approx(expected.error_px, rel=1e-13)
    assert conditioning == pytest.approx(expected.conditioning, rel=1e-8)


def test_nothing_seen_means_no_motion():
    jacobian, pixels, set_points, weights = case(1)
    velocity, error_px, conditioning = stereo_step(jacobian, pixels, set_points, 0.0 * weights, 1.0, 1e-4)
    np.testing.assert_array_equal(velocity, np.zeros(6))
    assert error_px == conditioning == 0.0


@pytest.mark.parametrize("tip_first", [False, True])
@pytest.mark.parametrize("triangulations", [-1, 3])
@pytest.mark.parametrize("mean", [False, True])
def test_the_cycle_in_one_call_is_the_law_step_by_step(virtual, tip_first, triangulations, mean):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        T0, T_star = virtual.random_task(rng, 30, 0.1)
        world = virtual.rx90(rng, T0=T0)
        frame, inverse = world.frame, np.linalg.inv(world.frame)
        generators = frame @ world.generators @ inverse
        generators[4] = frame @ virtual.screw([0.1, 0.5, 0.2]) @ inverse
        kinds = ("revolute",) * 4 + ("prismatic", "revolute")
        zero = world.q - rng.uniform(-0.05, 0.05, 6)
        chain = ProjectiveChain(kinds, generators, zero, tip_first)
        H = chain.displacement(world.q)
        markers = world.hidden(virtual.PLATE @ T0.T) @ np.linalg.inv(H).T
        targets = world.hidden(virtual.PLATE @ T_star.T)
        points = world.hidden(virtual.PLATE @ T0.T)
        pixels = world.pixels(virtual.PLATE @ T0.T) + rng.normal(size=(2, 4, 2))
        set_points, weights = world.pixels(virtual.PLATE @ T_star.T), rng.uniform(1, 3, (2, 4))
        weights[0, 2] = 0.0
        pixels[0, 2] = np.nan
        if triangulations >= 0:
            found, ok = triangulate(world.matrices, pixels, weights, triangulations)
            points = np.where(ok[:, None], found, points)
        jacobian = chain.image_jacobian(world.matrices, world.q, points)
        if mean:
            jacobian = 0.5 * (jacobian + chain.image_jacobian(world.matrices, world.q, targets))
        expected = stereo_law(jacobian, pixels, set_points, weights, 0.9, 1e-5)
        cycle = StereoCycle(
            chain.generators, np.array([k == "prismatic" for k in kinds], np.uint8), zero, world.matrices, markers,
            tip_first,
        )  # fmt: skip
        velocity, conditioning = cycle.step(
            world.q, pixels, set_points, weights, 0.9, 1e-5, target_points=targets if mean else None,
            triangulations=triangulations,
        )  # fmt: skip
        np.testing.assert_allclose(velocity, expected.velocity, rtol=0, atol=1e-9)
        assert conditioning == pytest.approx(expected.conditioning, rel=1e-6)
