"""Cartesian control in two components (8.55), and what both Cartesian laws share: sight, held steps, limits."""

from math import inf

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles.cartesian import CartesianStep, cartesian_law
from stereoservo.control.cartesian_components import FaceTask
from stereoservo.control.law import LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.cartesian2 import cartesian2_reasons
from stereoservo.control.laws.cartesian3 import Pace, cartesian_step
from stereoservo.kinematics.composition import Composition, displacement
from stereoservo.planning.three_point_decomposition import ComponentStatus

PERIOD = 0.04
BOTH = ("cartesian2", "cartesian3")
FREE, SERIAL = Composition.SIMULTANEOUS, Composition.BASE_FIRST


def inputs(virtual, world, composition, T0, T_star, single, gain=1.0, dt_s=0.0, rates=(inf, inf), eyes=True):
    P, Q = world.hidden(virtual.PLATE @ T0.T), world.hidden(virtual.PLATE @ T_star.T)
    seen_from = world.camera_centres if eyes else np.zeros((0, 4))
    gains = gain * np.array([1.0, 0.8, 0.6])[: 2 if single else 3]
    return (
        world.operators(), composition, P[:3], Q[:3], P.mean(axis=0), Q.mean(axis=0), seen_from, gains, dt_s, *rates,
        single,
    )  # fmt: skip


def kernel(operators, composition, points, targets, centre, centre_target, eyes, gains, dt_s, turn, speed, single):
    task, pace = FaceTask(points, targets, centre, centre_target), Pace(gains, dt_s, turn, speed)
    return cartesian_step(operators, int(composition), task, eyes, pace, single)


def assert_same(arguments):
    expected, found = (
        cartesian_law(*arguments),
        kernel(*arguments),
    )
    for name, a, b in zip(expected._fields, expected, found, strict=True):
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-8, err_msg=name)
    return expected


@pytest.mark.parametrize("seed", range(16))
@pytest.mark.parametrize("single", [False, True])
def test_the_kernel_is_the_reference(virtual, seed, single):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(0.5, 178), rng.uniform(0.01, 0.5))
    world, composition = (virtual.rx90(rng, T0=T0), SERIAL) if seed % 2 else (virtual.free_arm(rng, T0), FREE)
    for dt_s, rates in ((0.0, (inf, inf)), (PERIOD, (inf, inf)), (PERIOD, (0.5, 0.2))):
        step = assert_same(inputs(virtual, world, composition, T0, T_star, single, 2.0, dt_s, rates, eyes=seed % 5 > 0))
        assert len(step.task_error) == (2 if single else 3)
    arguments = inputs(virtual, world, composition, T0, T_star, single)
    noisy = arguments[0] + 1e-6 * rng.normal(size=arguments[0].shape)
    assert_same((noisy, *arguments[1:]))
    assert_same((np.ascontiguousarray(arguments[0][: int(rng.integers(1, 6))]), *arguments[1:]))


@pytest.mark.parametrize("seed", range(6))
def test_one_rotation_is_the_shortest_one_between_the_poses(virtual, seed):
    rng = np.random.default_rng(seed)
    angle, distance = rng.uniform(1, 100), rng.uniform(0.05, 0.4)
    T0, T_star = virtual.random_task(rng, angle, distance)
    world = virtual.free_arm(rng, T0)
    step = assert_same(inputs(virtual, world, FREE, T0, T_star, True))
    assert step.task_error[1] == pytest.approx(np.radians(angle), rel=1e-6)
    twist = np.tensordot(step.velocity, world.generators, axes=1)
    turn = Rotation.from_matrix(T_star[:3, :3] @ T0[:3, :3].T).as_rotvec()
    np.testing.assert_allclose([twist[2, 1], twist[0, 2], twist[1, 0]], 0.8 * turn, atol=1e-7)
    np.testing.assert_allclose((twist @ T0[:, 3])[:3], (T_star - T0)[:3, 3], atol=1e-7)


def drive(virtual, world, composition, T_star, law, options, *, noise=0.0, seed=0, limit=1500, tolerance=0.5):
    """Error [px], deviation of the centre from its line [m], least cosine of sight, and the history of the error."""
    rng = np.random.default_rng(seed)
    set_points = world.pixels(virtual.PLATE @ T_star.T)
    targets = world.triangulated(set_points)
    q, T = world.q.copy(), world.plate_pose()
    start, way = T[:3, 3].copy(), T_star[:3, 3] - T[:3, 3]
    length = np.linalg.norm(way)
    deviation, sight, history = 0.0, 1.0, []
    for _ in range(limit):
        pixels = world.pixels(virtual.PLATE @ T.T)
        error = np.linalg.norm(pixels - set_points, axis=-1).max()
        gone = T[:3, 3] - start
        off = np.linalg.norm(np.cross(gone, way)) / length if length > 1e-9 else np.linalg.norm(gone)
        deviation, sight = max(deviation, off), min(sight, world.front_facing(T).min())
        if error < tolerance:
            break
        seen = pixels + noise * rng.normal(size=pixels.shape)
        points = world.triangulated(seen)
        operators = np.ascontiguousarray(world.operators(q))
        scene = Scene(operators, int(composition), world.matrices, world.camera_centres, points, seen, np.ones((2, 4)))
        task = Task(
            set_points, np.ones((2, 4)), np.zeros((2, 4, 2)), targets, np.ones(4), points.mean(axis=0),
            targets.mean(axis=0), np.arange(3),
        )  # fmt: skip
        step = LAWS[law].step(scene, task, options)
        history.append(step)
        if composition == FREE:
            T = displacement(world.generators, FREE, PERIOD * step.velocity) @ T
        else:
            q = q + PERIOD * step.velocity
            T = world.plate_pose(q)
    return error, deviation, sight, history


@pytest.mark.parametrize("law", BOTH)
@pytest.mark.parametrize("seed", range(6))
def test_the_centre_stays_on_its_line_whatever_the_gain(virtual, law, seed):
    """Gain 5 at 25 Hz: without noise the way is straight to rounding, and τ and the angles decay exponentially."""
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(30, 150), rng.uniform(0.05, 0.4))
    world = virtual.free_arm(rng, T0)
    error, deviation, sight, history = drive(virtual, world, FREE, T_star, law, Options(5.0, PERIOD), tolerance=0.05)
    assert error < 0.05
    assert deviation < 1e-9
    assert sight > 0
    errors = np.array([step.error for step in history])
    decay = np.exp(-5.0 * PERIOD * np.arange(len(errors)))
    np.testing.assert_allclose(errors, errors[0] * decay[:, None], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("law", BOTH)
def test_the_six_revolute_arm_goes_straight_too(virtual, law):
    rng = np.random.default_rng(8)
    T0, _ = virtual.random_task(rng, 10, 0.05)
    world = virtual.rx90(rng, T0=T0)
    T_star = world.plate_pose(world.q + np.array([0.15, -0.1, 0.12, 0.5, 0.3, 0.6]))
    error, deviation, _, _ = drive(virtual, world, SERIAL, T_star, law, Options(3.0, PERIOD))
    assert error < 0.5
    assert deviation < 1e-8


@pytest.mark.parametrize("law", BOTH)
@pytest.mark.parametrize("seed", range(6))
def test_random_alignments_come_home_straight_and_in_sight(virtual, law, seed):
    rng = np.random.default_rng(40 + seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(0, 150), rng.uniform(0, 0.4))
    error, deviation, sight, _ = drive(
        virtual, virtual.free_arm(rng, T0), FREE, T_star, law, Options(1.0, PERIOD), noise=0.1, seed=seed
    )
    assert error < 0.5
    assert deviation < 0.001
    assert sight > 0


@pytest.mark.parametrize("law", BOTH)
@pytest.mark.parametrize("seed", [50092, 50189, 50244, 50385, 50395, 50408])
def test_the_back_is_never_shown_where_the_short_rotation_would_show_it(virtual, law, seed):
    """These alignments by 150 to 180 degrees lead the normal behind the horizon on the short arc of its circle."""
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(120, 180), rng.uniform(0, 0.4))
    world = virtual.free_arm(rng, T0)
    turn = Rotation.from_matrix(T_star[:3, :3] @ T0[:3, :3].T).as_rotvec()
    on_the_way = []
    for share in np.linspace(0, 1, 200):
        T = virtual.pose(
            Rotation.from_rotvec(share * turn) * Rotation.from_matrix(T0[:3, :3]),
            T0[:3, 3] + share * (T_star - T0)[:3, 3],
        )
        on_the_way.append(world.front_facing(T).min())
    assert min(on_the_way) < 0
    error, deviation, sight, _ = drive(
        virtual, world, FREE, T_star, law, Options(1.0, PERIOD), noise=0.1, seed=seed % 97
    )
    assert error < 0.5
    assert sight > 0
    assert deviation < 0.001


@pytest.mark.parametrize("law", BOTH)
def test_components_that_wait_for_each_other_arrive(virtual, law):
    """Moved at once, this face would show its back: the translation waits, says so, and arrives."""
    T0 = virtual.pose(Rotation.from_euler("y", -120, degrees=True), [-1.2, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("y", 120, degrees=True), [1.2, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(2), T0)
    error, deviation, sight, history = drive(virtual, world, FREE, T_star, law, Options(2.0, PERIOD))
    assert error < 0.5
    assert sight > 0
    assert deviation < 1e-6
    assert history[0].status[0] == ComponentStatus.WAITS
    (reason,) = LAWS[law].reasons(history[0])
    assert (reason.code, reason.level) == ("VISIBILITY_WAIT", "info")
    assert 0 < reason.threshold < reason.value
    assert LAWS[law].reasons(history[-1]) == ()


@pytest.mark.parametrize("law", BOTH)
@pytest.mark.parametrize("tilt", [0.0, 60.0])
def test_half_a_turn_of_roll(virtual, law, tilt):
    """Thesis 8.7: exactly 180 degrees about the rig's axis, the face tilted."""
    face = Rotation.from_euler("y", tilt, degrees=True)
    T_star = virtual.pose(face, [0, 0, 1.0])
    T0 = virtual.pose(Rotation.from_euler("z", 180, degrees=True) * face, [0, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(1), T0)
    for noise in (0.0, 0.1):
        error, deviation, sight, history = drive(virtual, world, FREE, T_star, law, Options(1.0, PERIOD), noise=noise)
        assert error < 0.5
        assert sight > 0.2
        assert deviation < (1e-3 if noise else 1e-9)
        if law == "cartesian2":
            assert history[0].error[1] == pytest.approx(np.pi, abs=0.02)


@pytest.mark.parametrize("single", [False, True])
def test_degenerate_tasks_have_an_answer(virtual, single):
    facing = virtual.pose(Rotation.identity(), [0.05, 0, 1.0])
    free = virtual.free_arm(np.random.default_rng(3), facing)

    def step(T_star, world=free, **more):
        return assert_same(inputs(virtual, world, FREE, facing, T_star, single, dt_s=PERIOD, **more))

    there = step(facing)
    np.testing.assert_allclose(there.velocity, 0, atol=1e-10)
    assert there.task_error.max() < 1e-10
    moved = step(virtual.pose(Rotation.identity(), [0.1, 0.1, 1.2]))
    assert moved.status[0] == ComponentStatus.MOVES
    assert moved.task_error[1:].max() < 1e-7
    turned = step(virtual.pose(Rotation.from_euler("x", 30, degrees=True), [0.05, 0, 1.0]))
    assert turned.status[0] == ComponentStatus.DONE
    assert turned.task_error[1] == pytest.approx(np.radians(30), rel=1e-6)
    back = step(virtual.pose(Rotation.from_euler("y", 180, degrees=True), [0.05, 0, 1.0]))
    assert back.task_error[1] == pytest.approx(np.pi, rel=1e-6)
    assert np.isfinite(back.velocity).all()

    arguments = list(inputs(virtual, free, FREE, facing, facing, single, dt_s=PERIOD))
    arguments[2] = np.stack([arguments[2][0], arguments[2][:2].mean(axis=0), arguments[2][1]])
    flat = assert_same(tuple(arguments))
    np.testing.assert_array_equal(flat.velocity, np.zeros(6))
    arguments[2] = np.full((3, 4), np.nan)
    unknown = assert_same(tuple(arguments))
    np.testing.assert_array_equal(unknown.velocity, np.zeros(6))
    arguments = list(inputs(virtual, free, FREE, facing, facing, single, dt_s=PERIOD))
    arguments[4] = np.full(4, np.nan)
    nowhere = assert_same(tuple(arguments))
    np.testing.assert_array_equal(nowhere.velocity, np.zeros(6))
    assert {int(s) for s in (*flat.status, *unknown.status, *nowhere.status)} == {int(ComponentStatus.NO_FACE)}


def test_an_arm_without_the_tilt_turns_what_it_can_and_says_so(virtual):
    T0 = virtual.pose(Rotation.identity(), [0.05, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("zy", [30, 25], degrees=True), [0.1, 0.1, 1.2])
    generators = np.array([virtual.screw(axis) for axis in np.eye(3)] + [virtual.screw([0, 0, 1.0], [0.1, 0, 1])])
    world = virtual.World(generators, T0, virtual.random_frame(np.random.default_rng(9)), np.zeros(4))
    step = assert_same(inputs(virtual, world, SERIAL, T0, T_star, True, dt_s=PERIOD))
    assert step.status[1] == ComponentStatus.NOT_REACHABLE
    (reason,) = cartesian2_reasons(LawStep(*step, 1.0))
    assert (reason.code, reason.unit) == ("NOT_REACHABLE", "rad")
    assert np.abs(step.velocity[3]) > 0.1


def test_two_that_wait_for_each_other_for_ever_are_told(virtual):
    waits = int(ComponentStatus.WAITS)
    step = CartesianStep(np.zeros(6), np.array([1.0, 2.0]), np.array([0.0, 1e-4]), np.array([waits, waits]))
    reasons = cartesian2_reasons(LawStep(*step, 1.0))
    assert [reason.code for reason in reasons] == ["VISIBILITY_BLOCKED"] * 2
    assert all(reason.level == "hold" and "trajectory" in reason.hint for reason in reasons)
