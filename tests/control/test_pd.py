"""PD tracking: the damping term, the gain at which it swings, and that a target in sinusoidal motion is followed as the
closed form predicts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.control.pd import damped_velocity, largest_gain
from stereoservo.kinematics.kernels import image_jacobian
from stereoservo.numerics.linear import damped_least_squares

LAG = 0.06
DT = 0.01
HELD = LAG + 0.5 * DT
"""A velocity held for a step is late by half of it."""


def tracking_error(omega: float, gain: float, lag_s: float, damping: float = 0.0, feed_forward: bool = True) -> float:
    """Amplitude of the tracking error over that of a target in sinusoidal motion, by the transfer functions."""
    p = 1j * omega
    characteristic = lag_s * p**2 + (1.0 + damping) * p + gain
    left = lag_s * p**2 + (0.0 if feed_forward else p * (1.0 + damping))
    return float(abs(left / characteristic))


def test_damping_of_joints_is_that_of_the_features() -> None:
    """``J⁺(−λe + ṡ* − κ(J q̇ − ṡ*))``, the thesis's, by an independent least squares."""
    rng = np.random.default_rng(1)
    J, e, measured, expected = (
        rng.normal(size=(16, 6)),
        rng.normal(size=16),
        rng.normal(size=6),
        rng.normal(size=6),
    )
    features = -2.0 * e + J @ expected - 0.4 * (J @ measured - J @ expected)
    law = np.linalg.lstsq(J, -2.0 * e + J @ expected)[0]
    found = damped_velocity(law, expected, measured, 0.4)
    np.testing.assert_allclose(found, np.linalg.lstsq(J, features)[0], rtol=0, atol=1e-12)


def late_loop(gain: float, damping: float, late_s: float, dt_s: float) -> float:
    """Largest error in the last tenth of a long run, over the first: an arm that obeys ``late_s`` later."""
    back = round(late_s / dt_s)
    x, commands = 1.0, [0.0] * (back + 1)
    seen = []
    for _ in range(round(60.0 / gain / dt_s)):
        speed = commands[-back - 1]
        commands.append(-gain * x - damping * speed)
        x += speed * dt_s
        seen.append(abs(x))
    return max(seen[-len(seen) // 10 :])


@pytest.mark.parametrize("damping", [0.0, 0.3, 0.6])
def test_the_largest_gain_is_where_a_late_loop_begins_to_swing(damping: float) -> None:
    late_s, dt_s = 0.15, 1e-3
    gain = largest_gain(damping, late_s + 0.5 * dt_s)
    assert late_loop(0.9 * gain, damping, late_s, dt_s) < 0.3
    assert late_loop(1.1 * gain, damping, late_s, dt_s) > 3.0


def follow(virtual: Any, omega: float, gain: float, damping: float, feed_forward: bool) -> float:
    """Amplitude of the tracking error over that of the target [px/px]: an arm whose joints lag, a swinging plate."""
    world = virtual.rx90(np.random.default_rng(3))
    middle, axis = world.q.copy(), np.array([0.02, -0.015, 0.02, 0.03, -0.02, 0.04])

    def at(q: np.ndarray) -> Any:
        return world.pixels(world.markers(q))

    def target(t: float) -> tuple[Any, Any]:
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
        J = image_jacobian(world.operators(q), world.matrices, world.hidden(world.markers(q))).reshape(-1, 6)
        law = damped_least_squares(J, -gain * (pixels - set_points).ravel(), np.ones(16), 1e-12)[0]
        expected = damped_least_squares(J, rates.ravel(), np.ones(16), 1e-12)[0] if feed_forward else 0.0
        command = damped_velocity(law + expected, expected, velocity, damping)
        # first-order lag, exactly over the step
        q = q + command * DT + (velocity - command) * LAG * (1 - keep)
        velocity = command + (velocity - command) * keep
        if k >= steps - window:
            errors.append(pixels - set_points)
            motions.append(set_points)
    return float(np.linalg.norm(np.std(errors, axis=0)) / np.linalg.norm(np.std(motions, axis=0)))


@pytest.mark.parametrize("hertz", [0.5, 1.0])
def test_a_swinging_target_is_followed_as_predicted(virtual: Any, hertz: float) -> None:
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


def test_damping_lets_the_gain_be_raised(virtual: Any) -> None:
    """At λT = 1.2 the damping ratio is 0.46 without, 0.73 with κ = 0.6: less overshoot after a step of the target."""

    def overshoot(damping: float) -> float:
        world = virtual.free_arm(
            np.random.default_rng(4), virtual.pose(Rotation.from_euler("x", 15, degrees=True), [0, 0, 1.0])
        )
        set_points = world.pixels(world.markers(np.array([0.03, 0, 0, 0, 0, 0])))
        q, velocity, keep, farthest = np.zeros(6), np.zeros(6), np.exp(-DT / LAG), 0.0
        for _ in range(300):
            pixels = world.pixels(world.markers(q))
            J = image_jacobian(world.operators(q), world.matrices, world.hidden(world.markers(q)))
            wanted = -20.0 * (pixels - set_points).ravel()
            law = damped_least_squares(J.reshape(-1, 6), wanted, np.ones(16), 1e-12)[0]
            command = damped_velocity(law, 0.0, velocity, damping)
            q = q + command * DT + (velocity - command) * LAG * (1 - keep)
            velocity = command + (velocity - command) * keep
            farthest = max(farthest, q[0] / 0.03 - 1.0)
        return farthest

    def predicted(ratio: float) -> float:
        return float(np.exp(-np.pi * ratio / np.sqrt(1 - ratio**2)))

    ratios = [(1 + k) / (2 * np.sqrt(20.0 * LAG)) for k in (0.0, 0.6)]
    assert overshoot(0.0) == pytest.approx(predicted(ratios[0]), abs=0.05)
    assert overshoot(0.6) == pytest.approx(predicted(ratios[1]), abs=0.05)
    assert overshoot(0.6) < 0.35 * overshoot(0.0)
