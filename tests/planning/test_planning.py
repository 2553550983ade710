"""Plans over random worlds: they end at the goal, keep limits, tell their closest approaches, refuse with the place."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles.path_visibility import joint_clearances, keep_out_clearances
from stereoservo.core.cycle import decode_array, encode_array
from stereoservo.kinematics.composition import Composition
from stereoservo.planning.path_search import sample_times
from stereoservo.planning.planner import (
    MISSING_FREEDOMS,
    PlanningState,
    PlanRequestError,
    continue_planning,
    plan,
    start_planning,
)
from stereoservo.planning.primitives import TRANSLATION


def dense_clearances(virtual, cells, world, joints, count=400):
    """Least distance from the borders [px] and least elevation [deg] on the way, by the Euclidean truth."""
    s = np.linspace(0, 1, len(joints))
    clearances, elevations = [], []
    for x in np.linspace(0, 1, count):
        q = np.array([np.interp(x, s, column) for column in joints.T])
        T = world.plate_pose(q)
        uv = world.pixels(virtual.PLATE @ T.T)
        clearances.append(min(uv.min() + 0.5, (639.5 - uv[..., 0]).min(), (479.5 - uv[..., 1]).min()))
        middle = T @ np.append(virtual.PLATE[:3, :3].mean(axis=0), 1.0)
        way = world.eyes[:, :3] - middle[:3]
        elevations.append(np.degrees(np.arcsin(-way @ T[:3, 2] / np.linalg.norm(way, axis=1))).min())
    return min(clearances), min(elevations)


def check_ends(virtual, world, found, T_star):
    np.testing.assert_allclose(world.markers(found.joints[-1]), virtual.PLATE @ T_star.T, atol=1e-5)
    np.testing.assert_array_equal(found.joints[0], world.q)
    np.testing.assert_allclose(found.displacements[0], np.eye(4), atol=1e-12)
    assert found.times[0] == 0.0
    assert (np.diff(found.times) > 0).all()
    M = world.hidden(world.markers())
    for k in (20, 45, 64):
        body = (M @ found.displacements[k].T) @ np.linalg.inv(world.frame).T
        np.testing.assert_allclose(body, world.markers(found.joints[k]), atol=1e-8)


@pytest.mark.parametrize("seed", range(12))
def test_straight_paths_are_straight_and_tell_their_approaches(virtual, cells, seed):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(5, 150), rng.uniform(0.02, 0.4))
    world = virtual.free_arm(rng, T0)
    request = cells.request(world, T_star)
    found = plan(request).plan
    assert found is not None
    assert found.description == "linear"
    check_ends(virtual, world, found, T_star)
    # the centre's way and the angle grow evenly
    poses = np.array([world.plate_pose(q) for q in found.joints])
    line = T0[:3, 3] + found.path_parameters[:, None] * (T_star[:3, 3] - T0[:3, 3])
    np.testing.assert_allclose(poses[:, :3, 3], line, atol=1e-6)
    clearance, elevation = dense_clearances(virtual, cells, world, found.joints)
    closest = {approach.kind: approach for approach in found.approaches}
    assert closest["FIELD_OF_VIEW"].value == pytest.approx(clearance, abs=0.5)
    assert closest["FACE_HIDDEN"].value == pytest.approx(elevation, abs=0.3)
    limits = request.limits
    clearances = joint_clearances(found.joints, limits.position_min, limits.position_max)
    assert closest["JOINT_LIMIT"].clearance == pytest.approx(clearances.min())
    assert closest["JOINT_LIMIT"].index == np.unravel_index(clearances.argmin(), clearances.shape)[1]
    assert all(approach.clearance >= 0 for approach in found.approaches)
    expected = sample_times(found.joints, limits.velocity_max, limits.acceleration_max, False)
    np.testing.assert_array_equal(found.times, expected)


@pytest.mark.slow
def test_straight_paths_suffice_for_a_thousand_tasks(virtual, cells):
    rng = np.random.default_rng(100)
    straight = 0
    for _ in range(1000):
        T0, T_star = virtual.random_task(rng, rng.uniform(5, 150), rng.uniform(0.02, 0.4))
        found = plan(cells.request(virtual.free_arm(rng, T0), T_star)).plan
        assert found is not None
        straight += found.description == "linear"
    assert straight >= 990


@pytest.mark.parametrize("make", ["rx90", "seven", "five", "scara", "gantry", "door"])
@pytest.mark.parametrize("seed", [1, 2])
def test_arms_of_one_to_seven_joints_reach_goals_within_their_freedoms(virtual, cells, make, seed):
    rng = np.random.default_rng(seed)
    world = getattr(cells, make)(rng)
    _, T_star = cells.goal_nearby(rng, world, 0.2 if make == "gantry" else 0.5)
    found = plan(cells.request(world, T_star)).plan
    assert found is not None
    np.testing.assert_allclose(world.markers(found.joints[-1]), virtual.PLATE @ T_star.T, atol=2e-4)
    M = world.hidden(world.markers())
    body = (M @ found.displacements[40].T) @ np.linalg.inv(world.frame).T
    np.testing.assert_allclose(body, world.markers(found.joints[40]), atol=1e-8)


@pytest.mark.parametrize("composition", [Composition.TIP_FIRST, Composition.SIMULTANEOUS])
def test_arms_the_other_way_round_and_arms_of_twists(virtual, cells, composition):
    rng = np.random.default_rng(9)
    T0, T_star = virtual.random_task(rng, 80, 0.3)
    if composition == Composition.TIP_FIRST:
        # the same arm, joints counted from the other end
        arm = virtual.rx90(rng)
        _, T_star = cells.goal_nearby(rng, arm, 0.5)
        request = cells.request(arm, T_star)
        operators = np.ascontiguousarray(request.operators[::-1])
        found = plan(
            msgspec.structs.replace(request, operators=operators, joints=arm.q[::-1].copy(), composition=1)
        ).plan
        assert found is not None
        np.testing.assert_allclose(arm.markers(found.joints[-1][::-1]), virtual.PLATE @ T_star.T, atol=1e-5)
        return
    world = virtual.free_arm(rng, T0)
    request = cells.request(world, T_star, composition=composition)
    found = plan(request).plan
    assert found is not None
    np.testing.assert_allclose(request.points @ found.displacements[-1].T, request.targets, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "turn", "missing"),
    [("gantry", [15, 10, 5], None), ("scara", [15, 10, 5], None), ("door", None, TRANSLATION)],
)
def test_a_goal_beyond_the_arms_freedoms_names_what_is_missing(virtual, cells, make, turn, missing):
    world = getattr(cells, make)(np.random.default_rng(4))
    T_star = world.plate_pose().copy()
    if turn is None:
        T_star[:3, 3] += [0.0, 0.06, 0.0]
    else:
        T_star = T_star @ virtual.pose(Rotation.from_euler("xyz", turn, degrees=True), [0, 0, 0])
    done = plan(cells.request(world, T_star))
    assert done.plan is None
    failure = done.failure[0]
    assert failure.kind == "NOT_REACHABLE"
    assert failure.value > failure.limit
    assert failure.path_parameter == 1.0
    named = MISSING_FREEDOMS[failure.index]
    assert named == missing if missing else named != TRANSLATION


def test_self_motion_keeps_a_redundant_arm_off_its_limits(virtual, cells):
    """A seven-joint arm whose present posture is near the limits of two joints."""
    rng = np.random.default_rng(12)
    world = cells.seven(rng)
    _, T_star = cells.goal_nearby(rng, world, 0.3)
    half = np.full(7, 1.2)
    middle = world.q.copy()
    middle[[2, 4]] += [1.1, -1.1]
    limits = {"position_min": middle - half, "position_max": middle + half}
    found = plan(cells.request(world, T_star, limits=limits)).plan
    free = plan(cells.request(world, T_star)).plan
    assert found is not None
    assert free is not None
    check_ends(virtual, world, found, T_star)
    clearance = joint_clearances(found.joints, middle - half, middle + half)
    # it starts with a tenth of a radian and moves away, where the least motion would not
    assert clearance[0].min() == pytest.approx(0.1)
    assert clearance[-1].min() > joint_clearances(free.joints, middle - half, middle + half)[-1].min() + 0.02


def test_out_of_view_goals_and_starts_are_refused_at_their_end(virtual, cells):
    rng = np.random.default_rng(3)
    T0, T_star = virtual.random_task(rng, 30, 0.1)
    outside = T_star.copy()
    outside[:3, 3] = [0.6, 0.0, 1.0]
    failure = start_planning(cells.request(virtual.free_arm(rng, T0), outside)).failure[0]
    assert (failure.kind, failure.path_parameter) == ("FIELD_OF_VIEW", 1.0)
    assert failure.clearance < 0
    world = virtual.free_arm(rng, outside)
    failure = start_planning(cells.request(world, T_star)).failure[0]
    assert (failure.kind, failure.path_parameter) == ("FIELD_OF_VIEW", 0.0)
    uv = world.pixels(world.markers())
    clearances = np.minimum(uv + 0.5, cells.SIZES[:, None] - 0.5 - uv).min(axis=-1)
    assert failure.value == pytest.approx(max(clearances.min(), -640.0))
    assert (failure.index, failure.marker) == np.unravel_index(clearances.argmin(), clearances.shape)


def test_goals_behind_a_camera_or_with_the_back_to_it_are_refused(virtual, cells):
    rng = np.random.default_rng(5)
    T0, T_star = virtual.random_task(rng, 30, 0.1)
    world = virtual.free_arm(rng, T0)
    behind = T_star.copy()
    behind[2, 3] = -1.0
    failure = start_planning(cells.request(world, behind)).failure[0]
    assert (failure.kind, failure.path_parameter) == ("BEHIND_CAMERA", 1.0)
    back = virtual.pose(Rotation.from_euler("x", 180, degrees=True), [0, 0, 1.0])
    front = virtual.pose(Rotation.identity(), [0, 0, 1.0])
    failure = start_planning(cells.request(virtual.free_arm(rng, front), back)).failure[0]
    assert (failure.kind, failure.path_parameter) == ("FACE_HIDDEN", 1.0)
    assert failure.value < 0


def test_markers_that_need_not_be_seen_may_leave(virtual, cells):
    rng = np.random.default_rng(3)
    T0, T_star = virtual.random_task(rng, 30, 0.1)
    T_star[:3, 3] = [0.6, 0.0, 1.0]
    world = virtual.free_arm(rng, T0)
    assert (
        plan(cells.request(world, T_star, must_stay_visible=np.zeros(4), faces=np.zeros((0, 3), dtype=np.int64))).plan
        is not None
    )


def test_joint_limits_and_keep_outs_fail_where_they_are_met(virtual, cells):
    rng = np.random.default_rng(6)
    T0 = virtual.pose(Rotation.from_euler("x", 10, degrees=True), [-0.1, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("x", 10, degrees=True), [0.1, 0, 1.0])
    world = virtual.free_arm(rng, T0)
    upper = np.full(6, np.inf)
    upper[0] = 0.15  # of the 0.2 m that the goal is away
    beyond = plan(cells.request(world, T_star, limits={"position_max": upper}))
    assert beyond.plan is None
    at_goal, on_way = beyond.failure[0], beyond.failure[1]
    assert (at_goal.kind, at_goal.index, at_goal.path_parameter, at_goal.unit) == ("JOINT_LIMIT", 0, 1.0, "m")
    assert at_goal.clearance == pytest.approx(-0.05, abs=1e-6)
    assert on_way.path_parameter == pytest.approx(0.75, abs=1.0 / 32)
    box = np.full((1, 6, 2), [-np.inf, np.inf])
    box[0, 0] = [0.08, 0.12]
    blocked = plan(cells.request(world, T_star, limits={"keep_outs": box}, bend=False))
    assert (blocked.failure[0].kind, blocked.failure[0].index) == ("KEEP_OUT", 0)
    assert blocked.failure[0].path_parameter == pytest.approx(0.4, abs=1.0 / 32)
    # a box that leaves a way round it
    box[0, 1] = [-0.03, np.inf]
    around = plan(cells.request(world, T_star, limits={"keep_outs": box}))
    assert around.plan is not None
    assert "bent" in around.plan.description
    assert keep_out_clearances(around.plan.joints, box).min() >= 0


def test_a_joint_beyond_its_limit_may_come_back(virtual, cells):
    rng = np.random.default_rng(7)
    T0, T_star = virtual.random_task(rng, 10, 0.2)
    world = virtual.free_arm(rng, T0)
    inward = np.sign((T_star - T0)[0, 3])
    limits = {"position_min": np.full(6, -np.inf), "position_max": np.full(6, np.inf)}
    limits["position_min" if inward > 0 else "position_max"][0] = 0.05 * inward
    assert plan(cells.request(world, T_star, limits=limits)).plan is not None


def test_the_present_pose_is_a_plan_of_no_duration(virtual, cells):
    world = cells.rx90(np.random.default_rng(0))
    done = start_planning(cells.request(world, world.plate_pose()))
    assert done.finished
    assert done.plan is not None
    assert done.plan.times.tolist() == [0.0]
    np.testing.assert_array_equal(done.plan.joints, world.q[None])
    assert {approach.kind for approach in done.plan.approaches} >= {"JOINT_LIMIT", "FIELD_OF_VIEW"}


@pytest.mark.parametrize("distance", [0.0, 0.2])
@pytest.mark.parametrize("angle", [180.0, 90.0, 0.0])
def test_half_turns_coplanar_faces_and_a_centre_on_target(virtual, cells, angle, distance):
    """Rolls in the face's plane, 180° exactly among them, with and without a way of the centre."""
    rng = np.random.default_rng(1)
    T0 = virtual.pose(Rotation.identity(), [-0.1, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("z", angle, degrees=True), [-0.1 + distance, 0, 1.0])
    world = virtual.free_arm(rng, T0)
    found = plan(cells.request(world, T_star)).plan
    assert found is not None
    np.testing.assert_allclose(world.markers(found.joints[-1]), virtual.PLATE @ T_star.T, atol=1e-6)
    poses = np.array([world.plate_pose(q) for q in found.joints])
    np.testing.assert_allclose(poses[:, 2, 2], 1.0, atol=1e-9)  # the face stays in its plane


def test_half_a_turn_about_any_axis_is_planned_with_the_face_visible(virtual, cells):
    rng = np.random.default_rng(2)
    for _ in range(5):
        T0, T_star = virtual.random_task(rng, 180.0, 0.2)
        world = virtual.free_arm(rng, T0)
        found = plan(cells.request(world, T_star)).plan
        assert found is not None
        check_ends(virtual, world, found, T_star)
        clearance, elevation = dense_clearances(virtual, cells, world, found.joints)
        assert clearance > 0
        assert elevation > 2.5


def test_measured_operators_still_end_at_the_targets(virtual, cells):
    rng = np.random.default_rng(4)
    T0, T_star = virtual.random_task(rng, 100, 0.3)
    world = virtual.free_arm(rng, T0)
    request = cells.request(world, T_star)
    twists = world.generators + 1e-3 * np.array(
        [virtual.screw(rng.normal(size=3), rng.normal(size=3)) for _ in range(6)]
    )
    noisy = world.frame @ twists @ np.linalg.inv(world.frame) + 2e-4 * rng.normal(size=(6, 4, 4))
    found = plan(msgspec.structs.replace(request, operators=noisy)).plan
    assert found is not None
    np.testing.assert_allclose(request.points @ found.displacements[-1].T, request.targets, atol=2e-3)


def test_slices_of_any_size_give_the_same_bits(virtual, cells):
    rng = np.random.default_rng(21)
    T0, T_star = cells.border_task(rng)
    request = cells.request(virtual.free_arm(rng, T0), T_star)
    whole = plan(request)
    rounds_of = []
    for slices in (1, 7, 40):
        planning = start_planning(request)
        rounds = 0
        while not planning.finished:
            continue_planning(planning, slices)
            rounds += 1
        rounds_of.append(rounds)
        same_bits(planning, whole)
    assert rounds_of[0] > rounds_of[1] > rounds_of[2] > 1


def test_a_planning_that_was_stored_midway_goes_on_the_same(virtual, cells):
    rng = np.random.default_rng(22)
    for _ in range(3):
        T0, T_star = cells.border_task(rng)
        request = cells.request(virtual.free_arm(rng, T0), T_star)
        whole = plan(request)
        planning = start_planning(request)
        while not planning.finished:
            continue_planning(planning, 9)
            stored = msgspec.msgpack.encode(planning, enc_hook=encode_array)
            planning = msgspec.msgpack.decode(stored, type=PlanningState, dec_hook=decode_array)
        same_bits(planning, whole)


def same_bits(one, other):
    assert one.failure == other.failure
    assert (one.plan is None) == (other.plan is None)
    if one.plan is not None:
        for name in ("times", "joints", "displacements", "path_parameters"):
            np.testing.assert_array_equal(getattr(one.plan, name), getattr(other.plan, name))
        assert one.plan.description == other.plan.description
        assert one.plan.approaches == other.plan.approaches


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"points": np.full((4, 4), np.nan)}, "points of a plan's request must be finite"),
        ({"points": np.linspace([0.1, 0, 1, 1], [0.2, 0, 1, 1], 4)}, "one line"),
        ({"speed_scale": 0.0}, "speed_scale is 0"),
        ({"matrices": np.zeros((0, 3, 4)), "camera_centres": np.zeros((0, 4))}, "a camera"),
        ({"camera_centres": np.full((2, 4), np.nan)}, "camera_centres of a plan's request must be finite"),
        ({"faces": np.array([[0, 1, 9]])}, "markers from 0 to 3"),
        ({"faces": np.array([[0, 0, 1]])}, r"\[0, 0, 1\] of a face are on one line"),
    ],
)
def test_requests_without_an_answer_are_refused(virtual, cells, change, match):
    world = virtual.free_arm(np.random.default_rng(0), cells.START)
    flat = virtual.World(world.generators, world.plate, np.eye(4), world.q)
    with pytest.raises(PlanRequestError, match=match):
        start_planning(cells.request(flat, cells.START, **change))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"acceleration_max": np.array([1.0, 1, 1, 1, 1, 0])}, "acceleration_max .* above 0"),
        ({"velocity_max": np.full(6, np.nan)}, "velocity_max .* above 0"),
        ({"position_min": np.full(6, np.nan)}, "position_min .* must be numbers"),
        ({"keep_outs": np.full((1, 6, 2), np.nan)}, "keep_outs .* must be numbers"),
        ({"view_margin_px": np.nan}, "view_margin_px"),
    ],
)
def test_limits_that_are_none_are_refused(virtual, cells, change, match):
    world = virtual.free_arm(np.random.default_rng(0), cells.START)
    request = cells.request(world, cells.START)
    limits = msgspec.structs.replace(request.limits, **change)
    with pytest.raises(PlanRequestError, match=match):
        start_planning(msgspec.structs.replace(request, limits=limits))


def test_a_slower_scale_takes_longer_on_the_same_path(virtual, cells):
    rng = np.random.default_rng(14)
    T0, T_star = virtual.random_task(rng, 60, 0.2)
    world = virtual.rx90(rng, T0=T0)
    full, half = (plan(cells.request(world, T_star, speed_scale=scale)).plan for scale in (1.0, 0.5))
    np.testing.assert_array_equal(full.joints, half.joints)
    # half the velocity, half the acceleration: between √2 and 2 times as long
    assert np.sqrt(2) - 0.01 < half.times[-1] / full.times[-1] < 2.0
