"""Times along samples: limits hold between them too, and simple ways take their shortest time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo.planning.path_search import sample_times
from stereoservo.planning.plan import Plan
from stereoservo.planning.tracking import sample_plan

K = 65


def as_plan(times, joints):
    return Plan(
        times,
        joints,
        np.broadcast_to(np.eye(4), (len(times), 4, 4)).copy(),
        np.linspace(0, 1, len(times)),
        "",
        (),
    )


def smooth_way(rng, n, size):
    """Joints along a way with a few bends."""
    s = np.linspace(0, 1, K)[:, None]
    waves = sum(rng.normal(size=n) / k**2 * (np.sin(k * np.pi * s + rng.uniform(0, 2 * np.pi, n))) for k in (1, 2, 3))
    return size * (rng.normal(size=n) * s + waves)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.01, 2.0))
def test_limits_hold_between_the_samples(seed, size):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    joints = smooth_way(rng, n, size)
    v, a = rng.uniform(0.3, 3.0, n), rng.uniform(0.5, 10.0, n)
    times = sample_times(joints, v, a, False)
    assert (np.diff(times) > 0).all()
    plan = as_plan(times, joints)
    t = np.linspace(0, times[-1], 4001)
    rates = np.array([sample_plan(plan, x).joint_rates for x in t])
    assert (np.abs(rates) <= 1.01 * v).all()
    # mean acceleration over a fortieth of the way's time; these ways are rougher than those of an arm
    window = 100
    mean = (rates[window:] - rates[:-window]) / (t[window] - t[0])
    assert (np.abs(mean) <= 1.05 * a).all()
    np.testing.assert_array_equal(rates[0], 0)
    np.testing.assert_array_equal(rates[-1], 0)


def test_limits_hold_between_samples_where_joints_flip():
    """A wrist that passes near its singularity: joints hardly move, then turn by much between two samples."""
    s = np.linspace(0, 1, K)
    flip = 0.5 * np.pi * np.tanh(60.0 * (s - 0.62))
    joints = np.stack([0.4 * s, -0.9 * s, flip, 1.5 * s - 0.9 * flip], axis=1)
    v, a = np.full(4, 0.6), np.full(4, 1.2)
    times = sample_times(joints, v, a, False)
    plan = as_plan(times, joints)
    t = np.linspace(0, times[-1], 4001)
    rates = np.array([sample_plan(plan, x).joint_rates for x in t])
    assert (np.abs(rates) <= 1.01 * v).all()
    at_samples = np.array([sample_plan(plan, x).joint_rates for x in times])
    mean = np.diff(at_samples, axis=0) / np.diff(times)[:, None]
    assert (np.abs(mean) <= 1.25 * a * (1.0 + 1e-9)).all()


@pytest.mark.parametrize(
    ("way", "v", "a", "best"),
    [
        (2.0, 1.0, 4.0, 2.0 / 1.0 + 1.0 / 4.0),  # trapezoid: way/v + v/a
        (0.1, 1.0, 4.0, 2 * np.sqrt(0.1 / 4.0)),  # triangle
    ],
)
def test_one_joint_straight_takes_its_shortest_time(way, v, a, best):
    joints = np.linspace(0, way, K)[:, None]
    times = sample_times(joints, np.array([v]), np.array([a]), False)
    assert best * 0.999 <= times[-1] <= 1.03 * best


def test_the_slowest_joint_sets_the_pace():
    joints = np.linspace(0, 1, K)[:, None] * np.array([1.0, 0.2, -0.5])
    times = sample_times(joints, np.array([9.0, 0.1, 9.0]), np.full(3, 100.0), False)
    assert times[-1] == pytest.approx(2.0, rel=0.04)


def test_twice_the_limits_take_as_scaling_says():
    joints = smooth_way(np.random.default_rng(3), 4, 0.5)
    v, a = np.full(4, 0.7), np.full(4, 2.0)
    slow = sample_times(joints, v, a, False)
    # time scaled by 1/2 doubles velocities and quadruples accelerations
    fast = sample_times(joints, 2 * v, 4 * a, False)
    np.testing.assert_allclose(slow, 2 * fast, rtol=1e-9)


def test_even_pace_is_even_but_for_the_ends():
    joints = (1 - np.exp(-4 * np.linspace(0, 1, K)))[:, None]
    times = sample_times(joints, np.array([1.0]), np.array([50.0]), True)
    steps = np.diff(times)
    middle = steps[5:-5]
    assert middle.max() / middle.min() < 1.0 + 1e-9
    assert steps[0] > middle[0]
    assert steps[-1] > middle[-1]


def test_without_limits_or_motion_times_are_finite_and_grow():
    still = np.zeros((K, 2))
    for joints in (still, np.linspace(0, 1, K)[:, None] * np.ones(2)):
        times = sample_times(joints, np.full(2, np.inf), np.full(2, np.inf), False)
        assert (np.diff(times) > 0).all()
        assert times[-1] < 0.1
    assert sample_times(np.zeros((1, 2)), np.ones(2), np.ones(2), False).tolist() == [0.0]
    two = sample_times(np.array([[0.0], [1.0]]), np.ones(1), np.ones(1), False)
    assert two[1] >= 2.0
