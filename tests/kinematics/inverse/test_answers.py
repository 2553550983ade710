"""Limits, seeds, singular and unreachable goals, goals by points, eye-in-hand, and input that makes no sense."""

import dataclasses

import numpy as np
import pytest

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.inverse.recognition import chain_of, recognise
from stereoservo.kinematics.inverse.self_motion import null_directions
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError
from stereoservo.kinematics.inverse.solver import fixed_planes, inverse_kinematics
from stereoservo_sim.experiments import inverse_kinematics as families
from stereoservo_sim.experiments.inverse_kinematics import (
    PUMA_ROWS,
    aligned_wrist,
    differences,
    from_rows,
    hide,
    kept_along,
    singular_handled,
)
from stereoservo_sim.experiments.metric_inverse import crossing, three_parallel
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SEVEN_ROWS

TURN = 2 * np.pi
WIDE = np.tile([-TURN, TURN], (6, 1))


@pytest.fixture
def puma():
    return hide(from_rows(PUMA_ROWS), np.random.default_rng(1))


@pytest.fixture
def goal(puma):
    return puma.chain.displacement(puma.chain.zero + np.array([0.4, -0.8, 0.6, 0.9, 1.1, -0.5]))


def in_frame(arm, pose):
    return arm.frame @ pose @ np.linalg.inv(arm.frame)


def turned_inside(q, limits):
    """By trying all whole turns: the first representative inside, or None."""
    shifts = q[:, None] + TURN * np.arange(-3, 4)
    inside = (shifts >= limits[:, :1]) & (shifts <= limits[:, 1:])
    return inside.any(axis=1).all()


def test_limits_keep_exactly_the_solutions_that_some_whole_turn_brings_inside(puma, goal):
    everything = inverse_kinematics(puma.chain, displacement=goal)
    assert len(everything.joints) == 8
    rng = np.random.default_rng(2)
    seen = set()
    for _ in range(12):
        low = rng.uniform(-5, 0, 6)
        limits = np.column_stack([low, low + rng.uniform(3, 7, 6)])
        found = inverse_kinematics(puma.chain, displacement=goal, limits=limits)
        wanted = [turned_inside(q, limits) for q in everything.joints]
        assert len(found.joints) == sum(wanted)
        assert len(found.beyond_limits) == 8 - sum(wanted)
        assert (found.joints >= limits[:, 0] - 1e-6).all()
        assert (found.joints <= limits[:, 1] + 1e-6).all()
        assert found.outcome == ("isolated" if any(wanted) else "beyond_limits")
        assert found.reached == any(wanted)
        seen.add(found.outcome)
        for q in found.joints:
            assert puma.chain.displacement(q) == pytest.approx(goal, abs=1e-10)
    assert seen == {"isolated", "beyond_limits"}


def test_solutions_are_turned_to_the_seed_and_the_nearest_comes_first(puma, goal):
    seed = puma.chain.zero + np.array([0.3, -0.7, 0.5, 1.0 + TURN, 1.0, -0.4 - TURN])
    found = inverse_kinematics(puma.chain, displacement=goal, seed=seed)
    assert found.joints[0] - seed == pytest.approx([0.1, -0.1, 0.1, -0.1, 0.1, -0.1], abs=1e-9)
    assert (np.abs(found.joints - seed) <= np.pi + 1e-9).all()
    distances = np.linalg.norm(found.joints - seed, axis=1)
    assert (np.diff(distances) >= 0).all()


def test_a_singular_wrist_keeps_the_seed_of_its_first_joint_and_names_what_is_free(puma):
    rng = np.random.default_rng(3)
    pose = aligned_wrist(puma.axes, rng)
    seed = puma.chain.zero + np.array([0.0, 0, 0, 0.77, 0, 0])
    H = in_frame(puma, puma.axes.displacements(pose.joints[None])[0])
    found = inverse_kinematics(puma.chain, displacement=H, seed=seed)
    assert found.outcome == "continuum"
    free = [i for i, joints in enumerate(found.free_joints) if joints == (3, 5)]
    assert free
    for i in free:
        assert found.joints[i, 3] == pytest.approx(seed[3], abs=1e-9)
        assert len(found.self_motions[i]) == 1
        for walk in (-1.0, 0.5, 2.0):
            q = found.joints[i] + walk * found.self_motions[i][0]
            assert puma.chain.displacement(q) == pytest.approx(H, abs=1e-9)


def test_a_continuum_is_slid_inside_the_limits(puma):
    """The seed's representative breaks the limit of joint 6; others on the same self-motion do not."""
    pose = aligned_wrist(puma.axes, np.random.default_rng(3))
    H = in_frame(puma, puma.axes.displacements(pose.joints[None])[0])
    seed = puma.chain.zero.copy()
    free = inverse_kinematics(puma.chain, displacement=H, seed=seed)
    i = next(i for i, joints in enumerate(free.free_joints) if joints == (3, 5))
    limits = np.tile([-7.0, 7.0], (6, 1))
    limits[5] = free.joints[i, 5] + np.array([0.4, 0.6])
    slid = inverse_kinematics(puma.chain, displacement=H, seed=seed, limits=limits)
    chosen = [q for q, joints in zip(slid.joints, slid.free_joints, strict=True) if joints == (3, 5)]
    assert chosen
    for q in chosen:
        assert limits[5, 0] - 1e-6 <= q[5] <= limits[5, 1] + 1e-6
        assert puma.chain.displacement(q) == pytest.approx(H, abs=1e-7)


@pytest.mark.parametrize("bend", [1e-3, 1e-5, 1e-7, 1e-9, 1e-11])
def test_near_a_singular_wrist_the_goal_is_still_reached(puma, bend):
    pose = aligned_wrist(puma.axes, np.random.default_rng(5))
    q = pose.joints + bend * np.eye(6)[4]
    H = in_frame(puma, puma.axes.displacements(q[None])[0])
    found = inverse_kinematics(puma.chain, displacement=H)
    assert len(found.joints) >= 4
    assert found.residuals.max() < 1e-8
    if bend >= 1e-5:
        # Rounding of the goal, over the bend.
        assert differences(puma.axes, q[None], found.joints - puma.chain.zero)[0] < 1e-12 / bend


def offset_arm(a2, a3, d2, d4, d5):
    return from_rows(((0, -90, 0.3), (a2, 0, d2), (a3, 0, 0), (0, -90, d4), (0, 90, d5), (0, 0, 0.1)))


STRETCHED = offset_arm(0.43474537, 0.44744545, 0.0777268, 0.1207119, 0.10501307)
"""Its descents to the elbow nearly stretched (0.7 mrad) ended 0.02 to 2 mrad before the two solutions."""
NEAR_DOUBLE = np.array([0.8869, 1.6168, 0.00066204, -0.6259, 0.0039911, 0.0626249])


@pytest.mark.parametrize("seed", range(3))
def test_two_solutions_that_nearly_coincide_are_found_once_each(seed):
    goal = STRETCHED.displacements(NEAR_DOUBLE[None])
    right = three_parallel(STRETCHED, goal)[0]
    right = right[~np.isnan(right).any(axis=1)]
    arm = hide(STRETCHED, np.random.default_rng(seed))
    found = arm.solve(goal[0], None)
    assert len(found.joints) == len(right) == 4
    assert found.residuals.max() < 1e-12
    assert differences(STRETCHED, right, found.joints - arm.chain.zero).max() < 1e-6


NEARLY_ALIGNED = offset_arm(0.4180984022, 0.4583458334, 0.08295815394, 0.1262323843, 0.1161110323)


@pytest.mark.parametrize("seed", range(3))
def test_the_solutions_beside_a_nearly_aligned_wrist_are_found(seed):
    """0.3 mrad from it few descents end at them, most on the curve of joints that keeps the goal to 1e-6."""
    q = np.array([0.720814867, 2.3204857436, 2.894044572, -1.240471081, 3.1413159867, -2.901612091])
    goal = NEARLY_ALIGNED.displacements(q[None])
    right = three_parallel(NEARLY_ALIGNED, goal)[0]
    arm = hide(NEARLY_ALIGNED, np.random.default_rng(seed))
    found = arm.solve(goal[0], None)
    assert len(found.joints) == len(right) == 8
    assert differences(NEARLY_ALIGNED, right, found.joints - arm.chain.zero).max() < 1e-6


STRETCHED_AND_NEARLY_ALIGNED = np.array(
    [3.025177518764, 2.201887272465, -1.523818410447, 2.397444754533, 3.14108429955, -0.100496312107]
)
"""PUMA: the elbow stretched, the wrist 0.5 mrad from aligned."""


def at_stretched_elbow(puma, q):
    q = families.stretched(puma.axes, crossing(puma.axes, 3, 4), 1, q, 1.0)
    return families.SingularPose(q, None, None), puma.axes.displacements(q[None])[0]


def test_a_stretched_elbow_behind_a_wrist_that_is_nearly_aligned_is_a_continuum_to_within_the_tolerance(puma):
    """The elbow moves by some 0.5 mrad x 0.05 rad, the goal by some (25 urad)², 6e-10: metric kinematics agrees."""
    pose, goal = at_stretched_elbow(puma, STRETCHED_AND_NEARLY_ALIGNED)
    found = puma.solve(goal, None)
    assert found.outcome == "continuum"
    assert kept_along(puma, found, goal, None)
    assert singular_handled(pose, puma)


def test_a_stretched_elbow_is_no_continuum_and_the_judge_takes_none_for_it(puma):
    bent = STRETCHED_AND_NEARLY_ALIGNED - 0.3 * np.eye(6)[4]
    pose, goal = at_stretched_elbow(puma, bent)
    found = puma.solve(goal, None)
    assert found.outcome == "isolated"
    assert singular_handled(pose, puma)
    directions = tuple(null_directions(puma.chain, np.eye(4), q) for q in found.joints)
    assert any(map(len, directions))
    assert not kept_along(puma, dataclasses.replace(found, self_motions=directions), goal, None)
    assert not kept_along(puma, found, goal, None)


def test_out_of_reach_states_which_joint_and_by_how_much():
    """Two links of 0.4 and 0.3 m, asked to 1.4 m: ``cosθ₂ = (1.4² - 0.25) / 0.24 = 7.125``."""
    axes = families.joined(from_rows(((0.4, 0, 0),)), from_rows(((0.3, 0, 0),)))
    axes.points[1, 0] = 0.4
    arm = hide(axes, np.random.default_rng(0))
    points, targets = np.array([[0.7, 0, 0, 1.0]]), np.array([[0, 1.4, 0, 1.0]])
    found = inverse_kinematics(arm.chain, points=points @ arm.frame.T, targets=targets @ arm.frame.T)
    assert found.outcome == "unreachable"
    assert not found.reached
    assert found.shortfall.joint == 1
    assert found.shortfall.excess == pytest.approx(6.125)
    assert found.shortfall.residual > 1e-3


def test_just_out_of_reach_is_reached_within_the_tolerance():
    axes = families.joined(from_rows(((0.4, 0, 0),)), from_rows(((0.3, 0, 0),)))
    axes.points[1, 0] = 0.4
    arm = hide(axes, np.random.default_rng(0))
    points, targets = np.array([[0.7, 0, 0, 1.0]]), np.array([[0, 0.7001, 0, 1.0]])
    ask = {"points": points @ arm.frame.T, "targets": targets @ arm.frame.T}
    assert inverse_kinematics(arm.chain, **ask).outcome == "unreachable"
    found = inverse_kinematics(arm.chain, tolerance=1e-3, **ask)
    assert found.outcome == "isolated"
    assert found.joints - arm.chain.zero == pytest.approx(np.array([[np.pi / 2, 0.0]]), abs=0.05)


@pytest.mark.parametrize("scale", [1.0, -3.0, 0.01])
@pytest.mark.parametrize("roll", [0.3, np.pi])
def test_a_displacement_of_any_scale_and_half_a_turn(puma, scale, roll):
    q = np.array([0.0, 0, 0, 0, 0, roll])
    H = puma.chain.displacement(puma.chain.zero + q)
    found = inverse_kinematics(puma.chain, displacement=scale * H)
    assert differences(puma.axes, q[None], found.joints - puma.chain.zero)[0] < 1e-6


@pytest.mark.parametrize("count", [3, 4, 7])
def test_points_of_any_heights_tell_the_displacement(puma, goal, count):
    """Three points do, and points of one plane: the arm's own joints know what a rigid motion is."""
    rng = np.random.default_rng(count)
    flat = np.column_stack([rng.uniform(-0.1, 0.1, (count, 2)), np.full(count, 0.05), np.ones(count)])
    points = flat @ puma.frame.T
    targets = points @ goal.T
    scales = rng.uniform(0.2, 5.0, (count, 1)) * rng.choice([-1, 1], (count, 1))
    by_points = inverse_kinematics(puma.chain, points=points, targets=scales * targets)
    by_displacement = inverse_kinematics(puma.chain, displacement=goal)
    assert len(by_points.joints) == 8
    assert by_points.joints == pytest.approx(by_displacement.joints, abs=1e-7)


def test_two_points_leave_a_six_axis_arm_a_freedom(puma, goal):
    points = np.array([[0.1, 0, 0.3, 1], [0.1, 0.2, 0.1, 1]]) @ puma.frame.T
    found = inverse_kinematics(puma.chain, points=points, targets=points @ goal.T)
    assert found.case == "numerical"
    assert found.outcome == "continuum"
    assert found.self_motions[0].shape == (1, 6)


def test_mirrored_swapped_and_strange_goals_are_refused(puma, goal):
    corners = np.array([[0, 0, 0, 1], [0.1, 0, 0, 1], [0, 0.2, 0, 1], [0, 0, 0.3, 1.0]])
    points = corners @ puma.frame.T
    targets = points @ goal.T
    mirrored = (corners * [1, 1, -1, 1]) @ puma.frame.T @ goal.T
    for wrong in (mirrored, targets[[1, 0, 2, 3]], (corners * [2, 2, 2, 1]) @ puma.frame.T):
        with pytest.raises(InverseKinematicsError) as refused:
            inverse_kinematics(puma.chain, points=points, targets=wrong)
        assert refused.value.code == "not_rigid"
    mirror = in_frame(puma, np.diag([1.0, 1, -1, 1]))
    for H, code in (
        (mirror, "mirrored"),
        (np.zeros((4, 4)), "mirrored"),
        (np.full((4, 4), np.nan), "not_finite"),
    ):
        with pytest.raises(InverseKinematicsError) as refused:
            inverse_kinematics(puma.chain, displacement=H)
        assert refused.value.code == code


def test_a_collineation_that_is_no_displacement_is_out_of_reach(puma):
    stretch = in_frame(puma, np.diag([1.2, 1, 1, 1]))
    found = inverse_kinematics(puma.chain, displacement=stretch)
    assert found.outcome == "unreachable"
    assert found.shortfall.residual > 1e-3


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"displacement": None}, "shape"),
        ({"displacement": np.eye(3)}, "shape"),
        ({"points": np.ones((1, 4)), "targets": np.ones((1, 4))}, "shape"),
        ({"displacement": None, "points": np.ones((2, 4)), "targets": np.ones((1, 4))}, "shape"),
        ({"displacement": None, "points": np.zeros((1, 4)), "targets": np.ones((1, 4))}, "degenerate"),
        ({"displacement": None, "points": np.ones((0, 4)), "targets": np.ones((0, 4))}, "shape"),
        ({"seed": np.zeros(5)}, "shape"),
        ({"seed": np.full(6, np.inf)}, "not_finite"),
        ({"limits": np.zeros((5, 2))}, "limits"),
        ({"limits": np.tile([1.0, -1.0], (6, 1))}, "limits"),
        ({"limits": np.full((6, 2), np.nan)}, "limits"),
        ({"tolerance": 0.0}, "shape"),
    ],
)
def test_questions_that_make_no_sense(puma, goal, change, code):
    with pytest.raises(InverseKinematicsError) as refused:
        inverse_kinematics(puma.chain, **{"displacement": goal, **change})
    assert refused.value.code == code


def test_a_point_at_infinity_is_refused(puma):
    far = puma.frame @ np.array([1.0, 2, 3, 0])
    with pytest.raises(InverseKinematicsError) as refused:
        inverse_kinematics(puma.chain, points=far[None], targets=far[None])
    assert refused.value.code == "degenerate"


def test_heights_need_no_luck_where_a_pencil_of_planes_stays_fixed():
    """Parallel axes: whatever plane of the pencil a point lies on, another one tells its height."""
    arm = hide(families.parallel_pair(np.random.default_rng(3)), np.random.default_rng(4))
    planes = fixed_planes(arm.chain.generators)
    assert planes.shape == (2, 4)
    q = np.array([0.5, 1.0])
    for plane in planes:
        point = np.linalg.svd(np.stack([plane, np.eye(4)[0]]))[2][2]
        assert abs(plane @ point) < 1e-12
        target = -2.0 * arm.chain.displacement(arm.chain.zero + q) @ point
        found = inverse_kinematics(arm.chain, points=point[None], targets=target[None])
        assert differences(arm.axes, q[None], found.joints - arm.chain.zero)[0] < 1e-9


def test_two_points_off_the_centre_tell_a_wrist():
    arm = hide(families.square_wrist(np.random.default_rng(3)), np.random.default_rng(4))
    q = np.array([0.5, 1.0, -0.7])
    points = np.array([[0.5, 0.1, 0.3, 1], [-0.2, 0.6, 0.1, 1]]) @ arm.frame.T
    targets = points @ arm.chain.displacement(arm.chain.zero + q).T
    found = inverse_kinematics(arm.chain, points=points, targets=targets)
    assert (found.case, len(found.joints)) == ("wrist", 2)
    assert differences(arm.axes, q[None], found.joints - arm.chain.zero)[0] < 1e-9


def test_pan_and_tilt_with_the_cameras_on_it():
    chain = chain_of(exact_model(synthetic.pan_tilt()))
    q = chain.zero + np.array([0.3, -0.2])
    found = inverse_kinematics(chain, displacement=chain.displacement(q))
    assert found.case == "two_revolute"
    assert found.joints == pytest.approx(q[None], abs=1e-9)


def test_prismatic_joints_without_closed_form_need_limits():
    axes = families.joined(families.one(np.random.default_rng(0)), families.sliding(1)(np.random.default_rng(1)))
    arm = hide(axes, np.random.default_rng(2))
    q = np.array([0.4, 0.2])
    H = arm.chain.displacement(arm.chain.zero + q)
    with pytest.raises(InverseKinematicsError) as refused:
        inverse_kinematics(arm.chain, displacement=H)
    assert refused.value.code == "limits"
    with pytest.raises(InverseKinematicsError) as refused:
        inverse_kinematics(arm.chain, displacement=H, limits=np.tile([-np.inf, np.inf], (2, 1)))
    assert refused.value.code == "limits"
    limits = np.array([[-9.0, 9.0], [-3.0, 3.0]])
    found = inverse_kinematics(arm.chain, displacement=H, limits=limits)
    assert found.joints == pytest.approx((arm.chain.zero + q)[None], abs=1e-9)


def mirrored_chain(arm):
    """The same joints with the cameras on the tip: operators of the inverse motion, factors in opposite order."""
    return ProjectiveChain(arm.chain.kinds, -arm.chain.generators, arm.chain.zero, tip_first=True)


def test_cameras_on_the_tip_see_the_inverse_motion_and_find_the_same_joints(puma, goal):
    riding = mirrored_chain(puma)
    known = recognise(riding)
    assert (known.case, known.inverted) == ("arm_with_wrist", True)
    found = inverse_kinematics(riding, displacement=np.linalg.inv(goal))
    standing = inverse_kinematics(puma.chain, displacement=goal)
    assert found.joints == pytest.approx(standing.joints, abs=1e-9)
    spread = np.random.default_rng(0).uniform(-0.3, 0.3, (4, 3))
    points = np.column_stack([spread, np.ones(4)]) @ puma.frame.T
    by_points = inverse_kinematics(riding, points=points, targets=points @ np.linalg.inv(goal).T)
    assert by_points.joints == pytest.approx(standing.joints, abs=1e-7)


def test_a_wrist_first_arm_is_solved_by_its_inverse(puma):
    """The same mechanism held at its other end; out of reach, the first joint to fail is the elbow, from that end."""
    chain = ProjectiveChain(puma.chain.kinds, puma.chain.generators[::-1].copy(), puma.chain.zero)
    known = recognise(chain)
    assert (known.case, known.inverted) == ("arm_with_wrist", True)
    q = chain.zero + np.array([0.4, -0.8, 0.6, 0.9, 1.1, -0.5])
    found = inverse_kinematics(chain, displacement=chain.displacement(q))
    assert len(found.joints) in (4, 8)
    assert np.abs(found.joints - q).max(axis=1).min() < 1e-9
    away = np.eye(4)
    away[:3, 3] = 3.0, 0.2, 0.1
    short = inverse_kinematics(chain, displacement=chain.displacement(q) @ in_frame(puma, away)).shortfall
    assert short.joint == 3
    assert short.excess > 0.0


@pytest.mark.parametrize(
    ("name", "stratum", "count"),
    [("scara", "affine", 2), ("mixed", "metric", 1), ("parallel", "projective", 2)],
)
def test_arms_of_few_joints_are_searched_in_their_stratum(name, stratum, count):
    """An elbow left and right for the parallel ones; a goal that the missing freedoms forbid is out of reach."""
    chain = chain_of(exact_model(getattr(synthetic, name)(), stratum=stratum))
    n, rng = chain.joints, np.random.default_rng(8)
    limits = np.array([[-7.0, 7.0] if kind == "revolute" else [-0.5, 0.5] for kind in chain.kinds])
    for _ in range(3):
        q = np.where([kind == "revolute" for kind in chain.kinds], rng.uniform(-2, 2, n), rng.uniform(-0.3, 0.3, n))
        H = chain.displacement(q)
        found = inverse_kinematics(chain, displacement=H, limits=limits)
        assert (found.case, found.outcome, len(found.joints)) == ("numerical", "isolated", count)
        assert np.abs(found.joints - q).max(axis=1).min() < 1e-8
    tilted = chain_of(exact_model(synthetic.rx90())).generators[4]
    away = H @ (np.eye(4) + np.sin(0.3) * tilted + (1 - np.cos(0.3)) * tilted @ tilted)
    found = inverse_kinematics(chain, displacement=away, limits=limits)
    assert found.outcome == "unreachable"
    assert found.shortfall.residual > 1e-4


def test_seven_joints_stay_near_the_seed_and_tell_their_spare_motion():
    arm = hide(from_rows(SEVEN_ROWS), np.random.default_rng(6))
    rng = np.random.default_rng(7)
    for _ in range(5):
        q = arm.chain.zero + rng.uniform(-1.2, 1.2, 7)
        seed = q + rng.uniform(-0.1, 0.1, 7)
        H = arm.chain.displacement(q)
        found = inverse_kinematics(arm.chain, displacement=H, seed=seed)
        assert found.outcome == "continuum"
        assert len(found.joints) == 1
        assert found.self_motions[0].shape == (1, 7)
        # The pose's own joints are on the same self-motion, so that the nearest is no farther than they are.
        assert np.linalg.norm(found.joints[0] - seed) <= np.linalg.norm(q - seed) + 1e-6
        away = seed - found.joints[0]
        assert abs(found.self_motions[0][0] @ away) < 1e-4


def test_seven_joints_inside_narrow_limits():
    arm = hide(from_rows(SEVEN_ROWS), np.random.default_rng(6))
    q = arm.chain.zero + np.array([0.3, 0.8, -0.4, -1.1, 0.5, 0.9, 0.2])
    limits = np.column_stack([q - 0.3, q + 0.3])
    found = inverse_kinematics(arm.chain, displacement=arm.chain.displacement(q), seed=q + 0.25, limits=limits)
    assert found.reached
    assert (found.joints >= limits[:, 0] - 1e-6).all()
    assert (found.joints <= limits[:, 1] + 1e-6).all()


def test_a_point_on_an_axis_frees_that_joint(puma):
    one = dataclasses.replace(puma.axes.part(slice(0, 1)))
    arm = hide(one, np.random.default_rng(1))
    on_axis = (arm.frame @ np.append(one.points[0] + 0.2 * one.directions[0], 1))[None]
    found = inverse_kinematics(arm.chain, points=on_axis, targets=on_axis, seed=np.array([0.4]))
    assert found.outcome == "continuum"
    assert found.joints == pytest.approx(np.array([[0.4]]), abs=1e-9)
    assert found.free_joints == ((0,),)
