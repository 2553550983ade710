"""PD tracking: the damping term, and that a target in sinusoidal motion is followed as the closed form predicts."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.control.law import Task
from stereoservo.control.pd import damped_rates, joint_feature_rates, pd_task, tracking_error
from stereoservo.kinematics.kernels import image_jacobian
from stereoservo.numerics.linear import damped_least_squares

LAG = 0.06
DT = 0.01
HELD = LAG + 0.5 * DT
"""A velocity held for a step is late by half of it."""


def test_damped_rates_by_their_formula():
    rng = np.random.default_rng(1)
    rates, measured = rng.normal(size=(2, 3, 4, 2))[:, :2, :3]
    there = np.array([[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
    measured[1, 2] = np.nan
    found = damped_rates(rates, measured, there, 0.4)
    expected = rates - 0.4 * (measured - rates)
    expected[0, 1], expected[1, 2] = rates[0, 1], rates[1, 2]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(damped_rates(rates, measured, there, 0.0), rates)


def test_joint_feature_rates_are_the_jacobian_times_the_velocity():
    rng = np.random.default_rng(2)
    J, v = rng.normal(size=(2, 4, 2, 6)), rng.normal(size=6)
    np.testing.assert_allclose(joint_feature_rates(J, v), J @ v, rtol=0, atol=1e-14)


@pytest.mark.parametrize("damping", [-0.1, 1.0, np.nan])
def test_unstable_damping_is_refused(damping):
    zero = np.zeros((1, 1, 2))
    task = Task(
        zero,
        zero[..., 0],
        zero,
        np.zeros((1, 4)),
        np.zeros(1),
        np.zeros(4),
        np.zeros(4),
        np.zeros(3, np.int64),
    )
    with pytest.raises(ValueError, match="damping"):
        pd_task(task, zero, zero[..., 0], damping)


def follow(virtual, omega, gain, damping, feed_forward):
    """Amplitude of the tracking error over that of the target [px/px]: an arm whose joints lag, a swinging plate."""
    world = virtual.rx90(np.random.default_rng(3))
    middle, axis = world.q.copy(), np.array([0.02, -0.015, 0.02, 0.03, -0.02, 0.04])

    def at(q):
        return world.pixels(world.markers(q))

    def target(t):
        """Where the plate would be with the joints at a swing, and the pixels' velocity there."""
        ahead = at(middle + axis * np.sin(omega * (t + 1e-5)))
        behind = at(middle + axis * np.sin(omega * (t - 1e-5)))
        return at(middle + axis * np.sin(omega * t)), (ahead - behind) / 2e-5

    q, velocity = middle.copy(), np.zeros(6)
    window = round(2 * np.pi / omega / DT)
    steps = window + round(8.0 / gain / DT)
    errors, motions = [], []
    keep = np.exp(-DT / LAG)
    for k in range(steps):
        set_points, rates = target(k * DT)
        pixels = at(q)
        J = image_jacobian(world.operators(q), world.matrices, world.hidden(world.markers(q)))
        task = Task(
            set_points, np.ones((2, 4)), rates if feed_forward else np.zeros_like(rates), np.zeros((4, 4)), np.zeros(4),
            np.zeros(4), np.zeros(4), np.zeros(3, np.int64),
        )  # fmt: skip
        task = pd_task(task, joint_feature_rates(J, velocity), np.ones((2, 4)), damping)
        wanted = task.rates - gain * (pixels - set_points)
        command = damped_least_squares(J.reshape(-1, 6), wanted.ravel(), np.ones(16), 1e-12)[0]
        # first-order lag, exactly over the step
        q = q + command * DT + (velocity - command) * LAG * (1 - keep)
        velocity = command + (velocity - command) * keep
        if k >= steps - window:
            errors.append(pixels - set_points)
            motions.append(set_points)
    errors, motions = np.array(errors), np.array(motions)
    return np.linalg.norm(errors.std(axis=0)) / np.linalg.norm(motions.std(axis=0))


@pytest.mark.parametrize("hertz", [0.5, 1.0])
def test_a_swinging_target_is_followed_as_predicted(virtual, hertz):
    omega, gain = 2 * np.pi * hertz, 4.0
    found = {
        (damping, forward): follow(virtual, omega, gain, damping, forward)
        for damping, forward in ((0.0, False), (0.0, True), (0.5, True))
    }
    for (damping, forward), amplitude in found.items():
        assert amplitude == pytest.approx(tracking_error(omega, gain, HELD, damping, forward), rel=0.05)
    factor = found[0.0, False] / found[0.5, True]
    predicted = tracking_error(omega, gain, HELD, 0.0, False) / tracking_error(omega, gain, HELD, 0.5)
    assert factor == pytest.approx(predicted, rel=0.1)
    # |T p² + p| / |T p²| = sqrt(1 + 1/(ωT)²), and damping on top
    assert factor > np.sqrt(1 + 1 / (omega * HELD) ** 2)


def test_damping_lets_the_gain_be_raised(virtual):
    """At λT = 1.2 the damping ratio is 0.46 without, 0.73 with κ = 0.6: less overshoot after a step of the target."""

    def overshoot(damping):
        world = virtual.free_arm(
            np.random.default_rng(4), virtual.pose(Rotation.from_euler("x", 15, degrees=True), [0, 0, 1.0])
        )
        set_points = world.pixels(world.markers(np.array([0.03, 0, 0, 0, 0, 0])))
        q, velocity, keep, farthest = np.zeros(6), np.zeros(6), np.exp(-DT / LAG), 0.0
        for _ in range(300):
            pixels = world.pixels(world.markers(q))
            J = image_jacobian(world.operators(q), world.matrices, world.hidden(world.markers(q)))
            rates = damped_rates(
                np.zeros_like(pixels), joint_feature_rates(J, velocity), np.ones((2, 4)), damping
            )
            wanted = rates - 20.0 * (pixels - set_points)
            command = damped_least_squares(J.reshape(-1, 6), wanted.ravel(), np.ones(16), 1e-12)[0]
            q = q + command * DT + (velocity - command) * LAG * (1 - keep)
            velocity = command + (velocity - command) * keep
            farthest = max(farthest, q[0] / 0.03 - 1.0)
        return farthest

    def predicted(ratio):
        return np.exp(-np.pi * ratio / np.sqrt(1 - ratio**2))

    ratios = [(1 + k) / (2 * np.sqrt(20.0 * LAG)) for k in (0.0, 0.6)]
    assert overshoot(0.0) == pytest.approx(predicted(ratios[0]), abs=0.05)
    assert overshoot(0.6) == pytest.approx(predicted(ratios[1]), abs=0.05)
    assert overshoot(0.6) < 0.35 * overshoot(0.0)
