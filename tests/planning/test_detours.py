"""Bent ways: tasks near the borders whose straight way leaves the view are solved, others refused, by the truth."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.planning.motion_frame import axis_rotation
from stereoservo.planning.path_search import CANDIDATES
from stereoservo.planning.planner import plan, rotation_variants


def least_clearances(cells, world, joints):
    clearances = [cells.clearances_of(world, world.plate_pose(q)) for q in joints]
    return min(clearance for clearance, _ in clearances), min(elevation for _, elevation in clearances)


def solve_border_tasks(virtual, cells, seed, count):
    """Of ``count`` tasks whose straight way fails: how many are solved, each checked against the truth."""
    rng = np.random.default_rng(seed)
    solved = failed = 0
    while solved + failed < count:
        T0, T_star = cells.border_task(rng)
        world = virtual.free_arm(rng, T0)
        straight = plan(cells.request(world, T_star, bend=False))
        if straight.plan is not None:
            continue
        assert straight.failure[0].kind in ("FIELD_OF_VIEW", "FACE_HIDDEN", "BEHIND_CAMERA")
        assert 0.0 < straight.failure[0].path_parameter < 1.0
        done = plan(cells.request(world, T_star))
        if done.plan is None:
            failed += 1
            continue
        solved += 1
        assert done.plan.description != "linear"
        clearance, elevation = least_clearances(cells, world, done.plan.joints)
        assert clearance > 0.0
        assert elevation > 0.0
        np.testing.assert_allclose(world.markers(done.plan.joints[-1]), virtual.PLATE @ T_star.T, atol=1e-5)
    return solved


def test_border_tasks_are_solved_where_the_straight_path_leaves_the_view(virtual, cells):
    # measured: 100 of 100 on other seeds; a 97 % planner misses one of 12 in 31 % of runs, so one may be missed
    assert solve_border_tasks(virtual, cells, 31, 12) >= 11


@pytest.mark.slow
def test_border_tasks_in_number(virtual, cells):
    assert solve_border_tasks(virtual, cells, 32, 200) >= 196


def test_a_roll_at_the_border_moves_inwards_first(virtual, cells):
    rng = np.random.default_rng(1)
    # 90° about the optical axis in the corner: the plate's corners swing out of the image
    T0 = virtual.pose(Rotation.identity(), [0.02, -0.205, 0.9])
    T_star = virtual.pose(Rotation.from_euler("z", 90, degrees=True), [0.02, -0.205, 0.9])
    world = virtual.free_arm(rng, T0)
    straight = plan(cells.request(world, T_star, bend=False))
    assert straight.plan is None
    assert straight.failure[0].kind == "FIELD_OF_VIEW"
    found = plan(cells.request(world, T_star)).plan
    assert found is not None
    assert "bent" in found.description
    middle = world.plate_pose(found.joints[32])
    assert middle[1, 3] > T0[1, 3] + 0.01 or middle[2, 3] > T0[2, 3] + 0.05


def test_cheapest_candidates_come_first_and_none_twice():
    assert CANDIDATES[0] == (0, 0, (0.0, 0.0, 0.0))
    assert len(set(CANDIDATES)) == len(CANDIDATES)
    sizes = [math.hypot(*c.bend) for c in CANDIDATES if c.turning == 0 and c.profile == 0]
    assert sizes == sorted(sizes)


@pytest.mark.parametrize("angle", [0.3, 1.5, 3.0, math.pi])
def test_every_kind_of_turning_ends_at_the_same_rotation(angle):
    rng = np.random.default_rng(2)
    for _ in range(20):
        axis, normal = rng.normal(size=(2, 3))
        axis, normal = axis / np.linalg.norm(axis), normal / np.linalg.norm(normal)
        R = Rotation.from_rotvec(angle * axis).as_matrix()
        for face in (normal, axis, None):
            for kind in rotation_variants(np.append(axis, angle), face):
                hinge, planar = axis_rotation(kind[:3].copy(), kind[3]), axis_rotation(kind[4:7].copy(), kind[7])
                np.testing.assert_allclose(hinge @ planar, R, atol=1e-9)
                assert abs(kind[3]) <= 2 * math.pi
        hinge = rotation_variants(np.append(axis, angle), normal)[0]
        assert abs(hinge[:3] @ normal) < 1e-9  # the hinge lies in the face


def test_another_posture_or_winding_where_the_straight_paths_ends_beyond_limits(virtual, cells):
    """Limits that hold the goal's posture, but not the one that the straight way arrives in."""
    rng = np.random.default_rng(50)
    tried = solved = 0
    while tried < 8:
        world = virtual.rx90(rng)
        q, T_star = cells.goal_nearby(rng, world, 1.6)
        limits = {
            "position_min": np.minimum(world.q, q) - rng.uniform(0.02, 0.25, 6),
            "position_max": np.maximum(world.q, q) + rng.uniform(0.02, 0.25, 6),
        }
        if plan(cells.request(world, T_star, limits=limits, bend=False)).plan is not None:
            continue
        tried += 1
        found = plan(cells.request(world, T_star, limits=limits)).plan
        if found is None:
            continue
        solved += 1
        assert (found.joints >= limits["position_min"] - 1e-9).all()
        assert (found.joints <= limits["position_max"] + 1e-9).all()
        np.testing.assert_allclose(world.markers(found.joints[-1]), virtual.PLATE @ T_star.T, atol=1e-5)
        clearance, elevation = least_clearances(cells, world, found.joints)
        assert clearance > 0.0
        assert elevation > 0.0
    # measured: 60 of 60; the way that made the limits exists, but may leave the view
    assert solved >= 7
