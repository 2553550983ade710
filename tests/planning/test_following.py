"""The arm along a way: near singularities, between samples, and back to where a sample ends exactly."""

import numpy as np
import pytest

from stereoservo.planning.path_ik import (
    Arm,
    CandidatePath,
    FollowSettings,
    PathRecord,
    SampleRange,
    follow_path,
    freedoms,
    reach,
)
from stereoservo.planning.planner import plan, start_planning
from stereoservo.planning.tracking import sample_plan
from stereoservo.planning.visibility_constraints import NOT_REACHABLE, empty_table, moved


def along(planning, samples, tolerance=2.0):
    """The whole of the first way in ``samples`` samples."""
    p, n = planning, len(planning.joints)
    arm = Arm(0, p.start_operators.copy(), p.joints.copy(), np.eye(4), np.zeros(n))
    record = PathRecord(np.zeros((samples, n)), np.zeros((samples, 4, 4)), empty_table())
    way, following = CandidatePath(0, p.path, p.residual, p.joint_step), FollowSettings(False, tolerance)
    return follow_path(way, SampleRange(0, samples), p.constraints, arm, following, record)


def test_too_few_samples_are_noticed_between_them(virtual, cells):
    rng = np.random.default_rng(3)
    T0, T_star = virtual.random_task(rng, 140, 0.1)
    planning = start_planning(cells.request(virtual.free_arm(rng, T0), T_star))
    assert along(planning, 65) == (-1, 65)
    kind, where = along(planning, 3)
    assert kind == NOT_REACHABLE
    assert where in (1, 2)


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_past_a_wrist_singularity_the_body_stays_on_its_path(virtual, cells, seed):
    """The fifth joint changes its sign: joints run, yet between the samples the body is where the plan says."""
    rng = np.random.default_rng(seed)
    q = virtual.RX90_MIDDLE.copy()
    q[4] = np.radians(rng.uniform(5, 20))
    world = virtual.rx90(rng, q=q)
    goal = q.copy()
    goal[4] = -q[4]
    goal[:4] += rng.uniform(-0.1, 0.1, 4)
    request = cells.request(world, world.plate_pose(goal))
    found = plan(request).plan
    assert found is not None
    for t in np.linspace(0, found.times[-1], 300):
        sample = sample_plan(found, t)
        planned = (request.points @ sample.displacement.T) @ np.linalg.inv(world.frame).T
        assert np.abs(world.pixels(planned) - world.pixels(world.markers(sample.joints))).max() < 2.0


@pytest.mark.parametrize(
    ("make", "expected"), [("rx90", 6), ("seven", 6), ("five", 5), ("scara", 4), ("gantry", 3), ("door", 1)]
)
def test_freedoms_are_counted(cells, make, expected):
    world = getattr(cells, make)(np.random.default_rng(2))
    planning = start_planning(cells.request(world, world.plate_pose()))
    assert planning.rank == freedoms(planning.start_operators) == expected


def test_reach_arrives_or_comes_nearest(virtual, cells):
    rng = np.random.default_rng(5)
    world = cells.rx90(rng)
    q, T_star = cells.goal_nearby(rng, world, 0.3)
    p = start_planning(cells.request(world, T_star))
    joints, H = world.q.copy(), np.eye(4)
    no_limit = np.full(6, np.inf)
    free = p.constraints._replace(lower=-no_limit, upper=no_limit)
    left = reach(p.goal, free, Arm(0, p.start_operators.copy(), joints, H, np.zeros(6)), False, 20)
    assert left < 1e-7
    np.testing.assert_allclose(joints, q, atol=1e-5)
    np.testing.assert_allclose(moved(H, p.constraints.body), p.goal, atol=1e-6)
    # three joints come nearest: no step of them makes the distance smaller
    three = p.start_operators[:3].copy()
    joints, H = world.q[:3].copy(), np.eye(4)
    free = p.constraints._replace(lower=-no_limit[:3], upper=no_limit[:3])
    reach(p.goal, free, Arm(0, three, joints, H, np.zeros(3)), False, 50)
    body = np.column_stack([moved(H, p.constraints.body), np.ones(4)])
    distance = (p.goal - body[:, :3]).ravel()
    gradient = np.array([(G @ body.T).T[:, :3].ravel() @ distance for G in three])
    assert np.abs(gradient).max() < 1e-4 * np.abs(distance).max()
