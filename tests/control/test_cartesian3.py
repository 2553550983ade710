"""Cartesian control (8.42): the kernel is the reference; reasons; the loop closed on virtual cells."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from oracles.cartesian import cartesian3_law
from stereoservo.control.cartesian_components import FaceTask
from stereoservo.control.law import LawStep
from stereoservo.control.laws.cartesian3 import cartesian3_reasons, cartesian3_step
from stereoservo.control.stereo_cycle import stereo_step
from stereoservo.kinematics.kernels import image_jacobian
from stereoservo.planning.three_point_decomposition import ComponentStatus

PERIOD = 0.04


def inputs(virtual, world, T0, T_star, gains=(1.0, 0.8, 0.6), eyes=True):
    P, Q = world.hidden(virtual.PLATE @ T0.T), world.hidden(virtual.PLATE @ T_star.T)
    seen_from = world.camera_centres if eyes else np.zeros((0, 4))
    return world.operators(), P[:3], Q[:3], P.mean(axis=0), Q.mean(axis=0), seen_from, np.array(gains)


def kernel(operators, points, targets, centre, centre_target, camera_centres, gains):
    task = FaceTask(points, targets, centre, centre_target)
    return cartesian3_step(operators, task, camera_centres, gains)


def assert_same(arguments):
    expected, found = cartesian3_law(*arguments), kernel(*arguments)
    for name, a, b in zip(expected._fields, expected, found, strict=True):
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-9, err_msg=name)
    return expected


@pytest.mark.parametrize("seed", range(60))
def test_the_kernel_is_the_reference(virtual, seed):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(0.1, 180), rng.uniform(0.001, 0.5))
    q = virtual.RX90_MIDDLE + rng.uniform(-0.3, 0.3, 6)
    world = virtual.rx90(rng, q, T0) if seed % 2 else virtual.free_arm(rng, T0)
    arguments = inputs(virtual, world, T0, T_star, eyes=seed % 5 > 0)
    step = assert_same(arguments)
    assert (step.allowed > 0).all()
    noisy = arguments[0] + 1e-6 * rng.normal(size=arguments[0].shape)
    assert_same((noisy, *arguments[1:]))
    assert_same((arguments[0][: int(rng.integers(1, 6))], *arguments[1:]))
    assert_same((np.concatenate([arguments[0], arguments[0][:2].sum(axis=0)[None]]), *arguments[1:]))


def test_the_kernel_is_the_reference_in_special_cases(virtual):
    T0 = virtual.pose(Rotation.from_euler("xy", [25, 10], degrees=True), [0.1, 0, 1.0])
    world = virtual.rx90(np.random.default_rng(6), T0=T0)
    at_target = assert_same(inputs(virtual, world, T0, T0))
    np.testing.assert_allclose(at_target.velocity, 0, atol=1e-12)
    rolled = T0 @ virtual.pose(Rotation.from_euler("z", 90, degrees=True), [0, 0, 0])
    assert assert_same(inputs(virtual, world, T0, rolled)).task_error[2] == pytest.approx(np.pi / 2)
    facing = virtual.pose(Rotation.identity(), [0, 0, 1.0])
    turned = virtual.pose(Rotation.from_euler("y", 180, degrees=True), [0, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(7), facing)
    assert assert_same(inputs(virtual, world, facing, turned)).task_error[1] == pytest.approx(np.pi)
    arguments = inputs(virtual, world, facing, turned)
    line = np.stack([arguments[1][0], 0.5 * (arguments[1][0] + arguments[1][1]), arguments[1][1]])
    step = assert_same((arguments[0], line, *arguments[2:]))
    np.testing.assert_array_equal(step.velocity, np.zeros(6))
    assert {r.code for r in cartesian3_reasons(LawStep(*step, 1.0))} == {"NO_FACE"}
    step = assert_same((np.zeros((6, 4, 4)), *arguments[1:]))
    np.testing.assert_array_equal(step.velocity, np.zeros(6))


def test_reasons_name_the_component(virtual):
    T0 = virtual.pose(Rotation.identity(), [0.05, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("zy", [30, 25], degrees=True), [0.1, 0.1, 1.2])
    generators = np.array([virtual.screw(axis) for axis in np.eye(3)] + [virtual.screw([0, 0, 1.0], [0.1, 0, 1])])
    world = virtual.World(generators, T0, virtual.random_frame(np.random.default_rng(9)), np.zeros(4))
    step = assert_same(inputs(virtual, world, T0, T_star))
    (reason,) = cartesian3_reasons(LawStep(*step, 1.0))
    assert (reason.code, reason.unit) == ("NOT_REACHABLE", "rad")
    assert "hinge" in reason.subject
    assert reason.value is None
    assert step.task_error[1] > 0.05

    T0 = virtual.pose(Rotation.from_euler("y", -120, degrees=True), [-1.2, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("y", 120, degrees=True), [1.2, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(4), T0)
    step = assert_same(inputs(virtual, world, T0, T_star))
    waiting = {r.subject.split(" ")[0]: r for r in cartesian3_reasons(LawStep(*step, 1.0))}
    assert waiting["translation"].code == "VISIBILITY_WAIT"
    assert waiting["translation"].threshold < waiting["translation"].value
    assert step.task_error[1] == pytest.approx(np.radians(240), rel=1e-6)
    assert (step.status >= ComponentStatus.MOVES).all()


def test_moves_with_the_gain_and_not_with_the_scale_of_a_joint(virtual):
    """(8.42): the component motions are lambda e, whatever unit a joint is driven in."""
    rng = np.random.default_rng(11)
    T0, T_star = virtual.random_task(rng, 60, 0.2)
    world = virtual.rx90(rng, T0=T0)
    arguments = inputs(virtual, world, T0, T_star)
    once, twice = kernel(*arguments)[0], kernel(*arguments[:-1], 2 * arguments[-1])[0]
    np.testing.assert_allclose(twice, 2 * once, atol=1e-12)
    scaled = arguments[0].copy()
    scaled[2] *= 10.0
    tenth = kernel(scaled, *arguments[1:])[0]
    np.testing.assert_allclose(tenth[2] * 10.0, once[2], atol=1e-9)


def close_the_loop(virtual, world, T_star, law, *, gain, noise=0.0, seed=0, tolerance=0.5, limit=900):
    """Drive the virtual arm at 25 Hz; what happened, judged on the truth."""
    rng = np.random.default_rng(seed)
    set_points = world.pixels(virtual.PLATE @ T_star.T)
    targets = world.triangulated(set_points)
    start = world.plate_pose()[:3, 3]
    way = T_star[:3, 3] - start
    length = np.linalg.norm(way)
    history, deviation, least_sight, q = [], 0.0, 1.0, world.q.copy()
    for _ in range(limit):
        pose = world.plate_pose(q)
        pixels = world.pixels(virtual.PLATE @ pose.T)
        error = np.linalg.norm(pixels - set_points, axis=-1).max()
        gone = pose[:3, 3] - start
        off = np.linalg.norm(np.cross(gone, way)) / length if length > 1e-9 else np.linalg.norm(gone)
        deviation, least_sight = max(deviation, off), min(least_sight, world.front_facing(pose).min())
        if error < tolerance:
            break
        seen = pixels + noise * rng.normal(size=pixels.shape)
        points, operators = world.triangulated(seen), world.operators(q)
        if law == "cartesian3":
            gains = np.full(3, gain)
            centre, centre_star = points.mean(axis=0), targets.mean(axis=0)
            velocity, e, _, _ = kernel(
                operators, points[:3], targets[:3], centre, centre_star, world.camera_centres, gains
            )
            history.append(e)
        else:
            J = 0.5 * (
                image_jacobian(operators, world.matrices, points) + image_jacobian(operators, world.matrices, targets)
            )
            velocity = stereo_step(J, seen, set_points, np.ones((2, 4)), gain, 1e-8)[0]
        q = q + PERIOD * velocity
    return error, deviation, least_sight, np.array(history)


def rx90_goal(virtual, rng, smallest, largest):
    """The arm and a pose that it can reach, the plate seen all right in both, turned by so many degrees."""
    while True:
        T0, _ = virtual.random_task(rng, 10, 0.05)
        world = virtual.rx90(rng, T0=T0)
        for _ in range(100):
            q = world.q + rng.uniform(-1.2, 1.2, 6)
            T = world.plate_pose(q)
            pixels = world.pixels(virtual.PLATE @ T.T)
            angle = Rotation.from_matrix(T0[:3, :3].T @ T[:3, :3]).magnitude()
            if (
                q[4] > 0.3
                and T[2, 3] > 0.5
                and smallest < np.degrees(angle) < largest
                and np.linalg.norm(T[:3, 3] - T0[:3, 3]) < 0.4
                and (pixels > 20).all()
                and (pixels[..., 0] < 620).all()
                and (pixels[..., 1] < 460).all()
                and (world.front_facing(T) > 0.26).all()
            ):
                return world, T


@pytest.mark.parametrize("seed", range(10))
def test_cartesian3_brings_random_alignments_home_on_a_straight_line(virtual, seed):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(0, 150), rng.uniform(0, 0.4))
    world = virtual.free_arm(rng, T0)
    error, deviation, least_sight, _ = close_the_loop(
        virtual, world, T_star, "cartesian3", gain=rng.uniform(0.5, 1.0), noise=0.1, seed=seed
    )
    assert error < 0.5
    assert deviation < 0.001
    assert least_sight > 0


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_cartesian3_drives_the_six_revolute_arm(virtual, seed, noise):
    rng = np.random.default_rng(100 + seed)
    world, T_star = rx90_goal(virtual, rng, 20, 115)
    gain = 0.5 if seed % 2 else 1.0
    error, deviation, least_sight, _ = close_the_loop(
        virtual, world, T_star, "cartesian3", gain=gain, noise=noise, seed=seed
    )
    assert error < 0.5
    assert deviation < 0.005
    assert least_sight > 0


def test_half_a_turn_decays_exponentially_with_the_face_in_sight(virtual):
    """Thesis 8.7: 180 degrees of roll, the face tilted by 60, here with a way to go: each error decays on its
    own.
    """
    T_star = virtual.pose(Rotation.from_euler("y", 60, degrees=True), [0.08, 0.0, 1.0])
    T0 = virtual.pose(
        Rotation.from_euler("z", 180, degrees=True) * Rotation.from_euler("y", 60, degrees=True),
        [-0.08, 0.02, 1.1],
    )
    world = virtual.free_arm(np.random.default_rng(1), T0)
    gain = 0.8
    error, deviation, least_sight, e = close_the_loop(virtual, world, T_star, "cartesian3", gain=gain)
    assert error < 0.5
    assert deviation < 0.001
    assert least_sight > 0.3
    steps = np.arange(len(e))
    decay = (1.0 - gain * PERIOD) ** steps
    np.testing.assert_allclose(e[:, 0], e[0, 0] * decay, rtol=0.02)
    np.testing.assert_allclose(e[:, 1], e[0, 1] * decay, rtol=0.02, atol=1e-3)
    # the three move together: what the others leave of second order in a period falls on the last one
    np.testing.assert_allclose(e[:, 2], e[0, 2] * decay, atol=0.08)


def test_the_face_stays_in_sight_where_components_must_wait(virtual):
    """Turned by its goal's rotation at once, or moved at once, this face would show its back: one waits for
    the other.
    """
    T0 = virtual.pose(Rotation.from_euler("y", -100, degrees=True), [-0.9, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("y", 100, degrees=True), [0.9, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(2), T0)
    assert world.front_facing(T0).min() > 0.2
    error, deviation, least_sight, e = close_the_loop(virtual, world, T_star, "cartesian3", gain=1.0, limit=1500)
    assert error < 0.5
    assert least_sight > 0
    assert deviation < 0.002
    assert e[0, 1] == pytest.approx(np.radians(200), rel=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_the_stereo_law_reaches_goals_at_small_and_medium_distance(virtual, seed):
    rng = np.random.default_rng(200 + seed)
    if seed % 2:
        world, T_star = rx90_goal(virtual, rng, 10, 50)
    else:
        T0, T_star = virtual.random_task(rng, rng.uniform(5, 60), rng.uniform(0.02, 0.15))
        world = virtual.free_arm(rng, T0)
    error, _, least_sight, _ = close_the_loop(virtual, world, T_star, "stereo", gain=1.0, noise=0.1, seed=seed)
    assert error < 0.5
    assert least_sight > 0


def test_the_step_is_the_same_bit_for_bit(virtual):
    rng = np.random.default_rng(5)
    T0, T_star = virtual.random_task(rng, 90, 0.2)
    arguments = inputs(virtual, virtual.rx90(rng, T0=T0), T0, T_star)
    first = kernel(*arguments)
    shuffled = tuple(np.array(a, order="C") for a in arguments)
    for a, b in zip(first, kernel(*shuffled), strict=True):
        np.testing.assert_array_equal(a, b)


def test_exponentials_of_the_step_move_the_arm_as_the_operators_say(virtual):
    """The velocity, driven for an instant, displaces the centre by gain times the way left."""
    rng = np.random.default_rng(12)
    T0, T_star = virtual.random_task(rng, 70, 0.25)
    world = virtual.rx90(rng, T0=T0)
    velocity = kernel(*inputs(virtual, world, T0, T_star, gains=(0.5, 0.5, 0.5)))[0]
    h = 1e-6
    moved = world.plate_pose(world.q + h * velocity)
    np.testing.assert_allclose((moved[:3, 3] - T0[:3, 3]) / h, 0.5 * (T_star[:3, 3] - T0[:3, 3]), atol=1e-5)
    assert np.linalg.norm(expm(np.tensordot(h * velocity, world.operators(), 1)) - np.eye(4)) > 0
