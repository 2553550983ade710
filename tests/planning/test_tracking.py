"""Following a plan: smooth set-points with their rates, rest outside of it, waiting for a body that lags."""

import numpy as np
import pytest

from stereoservo.planning.planner import plan
from stereoservo.planning.tracking import FADE_S, advance, pace, planned_joints, sample_plan


@pytest.fixture(scope="module")
def planned(virtual, cells):
    rng = np.random.default_rng(8)
    T0, T_star = virtual.random_task(rng, 120, 0.3)
    world = virtual.rx90(rng, T0=T0)
    found = plan(cells.request(world, T_star)).plan
    assert found is not None
    return world, found


def test_samples_are_hit_and_rates_are_derivatives(planned):
    _, found = planned
    for k in (0, 1, 30, 63, 64):
        sample = sample_plan(found, found.times[k])
        np.testing.assert_allclose(sample.joints, found.joints[k], atol=1e-12)
        np.testing.assert_allclose(sample.displacement, found.displacements[k], atol=1e-12)
    step = 1e-6
    for t in np.linspace(0.01, 0.99, 37) * found.times[-1]:
        before, here, after = (sample_plan(found, t + d) for d in (-step, 0, step))
        np.testing.assert_allclose((after.joints - before.joints) / (2 * step), here.joint_rates, atol=1e-4)
        np.testing.assert_allclose(
            (after.displacement - before.displacement) / (2 * step), here.displacement_rate, atol=1e-4
        )


def test_between_samples_joints_and_body_agree(planned):
    world, found = planned
    M = world.hidden(world.markers())
    for t in np.linspace(0, 1, 53) * found.times[-1]:
        sample = sample_plan(found, t)
        truth = world.markers(sample.joints)
        body = (M @ sample.displacement.T) @ np.linalg.inv(world.frame).T
        assert np.abs(body - truth).max() < 1e-4  # [m], a tenth of a millimetre


def test_rates_are_continuous_over_the_samples(planned):
    _, found = planned
    for k in range(1, 64):
        before = sample_plan(found, found.times[k] - 1e-9)
        after = sample_plan(found, found.times[k] + 1e-9)
        np.testing.assert_allclose(before.joint_rates, after.joint_rates, atol=1e-6)


def test_outside_it_rests(planned):
    _, found = planned
    for t, k in ((-1.0, 0), (float("nan"), 0), (found.times[-1] + 5, -1)):
        sample = sample_plan(found, t)
        np.testing.assert_array_equal(sample.joints, found.joints[k])
        np.testing.assert_array_equal(sample.joint_rates, 0)
        np.testing.assert_array_equal(sample.displacement_rate, 0)


def test_the_plan_waits_for_a_body_that_lags(planned):
    _, found = planned
    assert advance(found, 0.1, 0.004, 0.0) == pytest.approx(0.104)
    assert advance(found, 0.1, 0.004, 0.5) == pytest.approx(0.104)
    assert 0.1 < advance(found, 0.1, 0.004, 0.8) < 0.103
    for lag in (1.0, 7.0, float("inf"), float("nan")):
        assert advance(found, 0.1, 0.004, lag) == 0.1
    assert advance(found, 0.1, -1.0, 0.0) == 0.1
    assert advance(found, found.times[-1], 1.0, 0.0) == found.times[-1]
    assert advance(found, float("nan"), 0.0, 0.0) == 0.0
    paces = [pace(lag) for lag in np.linspace(0, 1.2, 50)]
    assert (np.diff(paces) <= 0).all()


def test_feed_forward_never_runs_away_from_a_slow_body(planned):
    """A body at a third of the asked rates: the plan's time follows it, the distance stays bounded."""
    _, found = planned
    t, q, tolerated = 0.0, found.joints[0].copy(), 0.05
    worst = 0.0
    for _ in range(20000):
        sample = sample_plan(found, t)
        behind = np.abs(sample.joints - q).max()
        worst = max(worst, behind)
        want = pace(behind / tolerated) * sample.joint_rates + 4.0 * (sample.joints - q)
        limit = 0.33
        q = q + 0.004 * want * min(1.0, limit / max(np.abs(want).max(), 1e-12))
        t = advance(found, t, 0.004, behind / tolerated)
    assert t == found.times[-1]
    assert worst < 1.05 * tolerated
    np.testing.assert_allclose(q, found.joints[-1], atol=1e-6)


def test_planned_joints_lead_to_where_the_plan_has_them_and_fade_out_at_its_end(planned):
    _, found = planned
    end, dt = found.times[-1], 0.04
    at = sample_plan(found, 0.3 * end).joints + 0.01
    joints = planned_joints(found, 0.3 * end, 0.3 * end + dt, dt, at)
    np.testing.assert_allclose(joints.error, -0.01, atol=1e-12)
    np.testing.assert_allclose(
        at + joints.error + dt * joints.rates, sample_plan(found, 0.3 * end + dt).joints, atol=1e-12
    )
    assert joints.weight == 1.0
    assert planned_joints(found, end - 0.5 * FADE_S, end, dt, at).weight == pytest.approx(0.5)
    waiting = planned_joints(found, 0.3 * end, 0.3 * end, dt, at)
    assert not waiting.rates.any()
    for over in (end, end + 1.0, np.nan):
        none = planned_joints(found, over, over, dt, at)
        assert len(none.rates) == len(none.error) == 0
        assert none.weight == 0.0
