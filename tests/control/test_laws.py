"""All laws behind one interface: kernels against references, frames, promises of convergence in closed loop."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles.image import image_velocity
from oracles.points import points_velocity
from oracles.trajectory import trajectory_velocity
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.daemon.kernel_compilation import warm_up_laws
from stereoservo.kinematics.composition import Composition, displacement
from stereoservo.numerics.compilation import overloads
from stereoservo_sim.tasks.closed_loop import CLASSICAL, euclidean_points

PERIOD = 0.04
FREE, SERIAL = Composition.SIMULTANEOUS, Composition.BASE_FIRST


def scene_of(virtual, world, composition, T, operators=None, pixels=None, weights=None):
    """The present with the plate at ``T``, nothing unknown."""
    X = virtual.PLATE @ T.T
    seen = world.pixels(X) if pixels is None else pixels
    return Scene(
        world.operators() if operators is None else operators, int(composition), world.matrices,
        world.camera_centres, world.hidden(X), seen, np.ones((2, 4)) if weights is None else weights,
    )  # fmt: skip


def task_of(virtual, world, scene, T_star, known=True):
    Y = virtual.PLATE @ T_star.T
    targets = world.hidden(Y) if known else np.zeros((4, 4))
    return Task(
        world.pixels(Y), np.ones((2, 4)), np.zeros((2, 4, 2)), targets, np.full(4, float(known)),
        scene.points.mean(axis=0), targets.mean(axis=0), np.arange(3),
    )  # fmt: skip


def arms(virtual, seed, angle=60.0, distance=0.2):
    """A free arm and a six-revolute arm with the plate at the same place, and a goal."""
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, angle, distance)
    return T0, T_star, ((virtual.free_arm(rng, T0), FREE), (virtual.rx90(rng, T0=T0), SERIAL))


def follow(virtual, world, T0, T_star, law, options, *, limit=2000, noise=0.0, weights=None, seed=0):
    """Drive a free arm; error [px], deviation of the centre from its line [m], least cosine of sight."""
    rng = np.random.default_rng(seed)
    step, T = LAWS[law].step, T0.copy()
    way = T_star[:3, 3] - T0[:3, 3]
    length = np.linalg.norm(way)
    deviation, sight = 0.0, 1.0
    operators = np.ascontiguousarray(world.operators())
    set_points = world.pixels(virtual.PLATE @ T_star.T)
    for _ in range(limit):
        pixels = world.pixels(virtual.PLATE @ T.T)
        error = np.linalg.norm(pixels - set_points, axis=-1).max()
        sight = min(sight, world.front_facing(T).min())
        gone = T[:3, 3] - T0[:3, 3]
        off = np.linalg.norm(np.cross(gone, way)) / length if length > 1e-9 else np.linalg.norm(gone)
        deviation = max(deviation, off)
        if error < 0.5:
            break
        scene = scene_of(virtual, world, FREE, T, operators, weights=weights)
        if noise:
            seen = pixels + noise * rng.normal(size=pixels.shape)
            scene = scene._replace(pixels=seen, points=world.triangulated(seen))
        task = task_of(virtual, world, scene, T_star)
        velocity = step(scene, task, options).velocity
        T = displacement(world.generators, FREE, velocity * PERIOD) @ T
    return error, deviation, sight


def test_every_name_of_the_wire_has_its_law(virtual):
    T0, T_star, (free, _) = arms(virtual, 0)
    scene = scene_of(virtual, *free, T0)
    task = task_of(virtual, free[0], scene, T_star)
    assert set(LAWS) == {"stereo", "image", "points", "cartesian3", "cartesian2", "trajectory"}
    for law in LAWS.values():
        step = law.step(scene, task, Options(1.0))
        assert isinstance(step, LawStep)
        assert step.velocity.shape == (6,)
        assert len(law.components) == len(law.units) == len(step.error) == len(step.allowed) == len(step.status)
        assert law.reasons(step) == ()


@pytest.mark.parametrize("choice", list(JacobianChoice))
@pytest.mark.parametrize("dt_s", [0.0, PERIOD])
def test_image_and_points_kernels_are_their_references(virtual, choice, dt_s):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T0, T_star, both = arms(virtual, seed)
        for world, composition in both:
            weights = rng.uniform(1.0, 5.0, (2, 4))
            weights[0, 1] = weights[1, 2] = 0.0
            pixels = world.pixels(virtual.PLATE @ T0.T) + rng.normal(size=(2, 4, 2))
            pixels[0, 1] = np.nan
            scene = scene_of(virtual, world, composition, T0, pixels=pixels, weights=weights)
            task = task_of(virtual, world, scene, T_star)
            known = task.target_known.copy()
            known[seed % 4] = 0.0
            task = task._replace(target_known=known)
            options = Options(1.3, dt_s, choice, 1e-7)
            for law, expected in (
                ("stereo", image_velocity(scene, task, options, choice, np.zeros_like(task.rates))),
                ("image", image_velocity(scene, task, options, choice, np.zeros_like(task.rates))),
                ("points", points_velocity(scene, task, options)),
            ):
                step = LAWS[law].step(scene, task, options)
                np.testing.assert_allclose(step.velocity, expected[0], rtol=0, atol=1e-10, err_msg=law)
                assert step.conditioning == pytest.approx(expected[1], rel=1e-6)


@pytest.mark.parametrize("joint_weight", [None, 0.0, 1.0])
@pytest.mark.parametrize("dt_s", [0.0, PERIOD])
def test_the_trajectory_kernel_is_its_reference(virtual, dt_s, joint_weight):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T0, _, both = arms(virtual, seed)
        for world, composition in both:
            scene = scene_of(virtual, world, composition, T0)
            near = scene.pixels + 3.0 * rng.normal(size=scene.pixels.shape)
            task = task_of(virtual, world, scene, T0)._replace(
                set_points=near, rates=40.0 * rng.normal(size=near.shape)
            )
            if joint_weight is not None:
                task = task._replace(
                    joint_rates=0.3 * rng.normal(size=6), joint_error=0.1 * rng.normal(size=6),
                    joint_weight=joint_weight,
                )  # fmt: skip
            options = Options(2.0, dt_s)
            expected, conditioning = trajectory_velocity(scene, task, options)
            step = LAWS["trajectory"].step(scene, task, options)
            np.testing.assert_allclose(step.velocity, expected, rtol=0, atol=1e-10)
            assert step.conditioning == pytest.approx(conditioning, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("dt_s", [0.0, PERIOD])
def test_no_law_depends_on_the_projective_frame(virtual, seed, dt_s):
    """One Euclidean truth behind two frames: the joints get the same command."""
    T0, T_star, both = arms(virtual, seed, 80.0)
    rng = np.random.default_rng(1000 + seed)
    for world, composition in both:
        other = virtual.World(world.generators, world.plate, virtual.random_frame(rng), world.q)
        for name, law in [*LAWS.items(), ("stereo-block", None)]:
            for choice in (JacobianChoice.MEAN, JacobianChoice.FIXED_DEPTH):
                velocities = []
                for frame in (world, other):
                    scene = scene_of(virtual, frame, composition, T0)
                    task = task_of(virtual, frame, scene, T_star)
                    if name == "trajectory":
                        task = task._replace(
                            set_points=scene.pixels + 1.0, rates=0.1 * (task.set_points - scene.pixels)
                        )
                    step = CLASSICAL[name] if law is None else law.step
                    velocities.append(step(scene, task, Options(1.0, dt_s, choice, 0.0)).velocity)
                scale = np.abs(velocities[0]).max()
                np.testing.assert_allclose(velocities[0], velocities[1], rtol=0, atol=1e-8 * scale, err_msg=name)


def test_fixed_depth_is_the_present_pixel_at_the_depth_of_the_goal(virtual):
    """Against the classical interaction matrix with Z*, for a body moved by twists in the left camera's frame."""
    rng = np.random.default_rng(3)
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    X = np.column_stack([rng.uniform(-0.1, 0.1, (4, 2)), rng.uniform(0.8, 1.2, 4), np.ones(4)])
    Y = X + np.array([0.05, -0.02, 0.3, 0.0])
    axes = np.eye(3)
    operators = np.array([virtual.screw(a) for a in axes] + [virtual.screw(a, np.zeros(3)) for a in axes])
    P = (K @ np.eye(3, 4))[None]
    project = lambda M: (M @ P[0].T)[:, :2] / (M @ P[0].T)[:, 2:]  # noqa: E731
    scene = Scene(operators, int(FREE), P, np.array([[0.0, 0, 0, 1]]), X, project(X)[None], np.ones((1, 4)))
    task = Task(
        project(Y)[None],
        np.ones((1, 4)),
        np.zeros((1, 4, 2)),
        Y,
        np.ones(4),
        X.mean(0),
        Y.mean(0),
        np.arange(3),
    )
    rows = []
    for (x, y), Z in zip(X[:, :2] / X[:, 2:3], Y[:, 2], strict=True):
        rows += [(1 / Z, 0, -x / Z, -x * y, 1 + x * x, -y), (0, 1 / Z, -y / Z, -1 - y * y, x * y, x)]
    expected = 0.7 * np.linalg.pinv(800.0 * np.array(rows)) @ (project(Y) - project(X)).reshape(-1)
    step = LAWS["image"].step(scene, task, Options(0.7, 0.0, JacobianChoice.FIXED_DEPTH, 0.0))
    np.testing.assert_allclose(step.velocity, expected, atol=1e-9)


def test_the_error_of_a_law_held_for_a_step_decays_as_its_gain_says(virtual):
    """Near the goal, gain 5 at 25 Hz: exp(−0.2) a step; and a gain too large for the loop does not overshoot."""
    T_star = virtual.pose(Rotation.from_euler("xyz", [10, 20, 30], degrees=True), [0.05, 0, 1.0])
    T0 = T_star @ virtual.pose(Rotation.from_rotvec([0.01, 0.02, -0.01]), [0.002, 0.001, 0.002])
    world = virtual.free_arm(np.random.default_rng(0), T0)
    for name, law in LAWS.items():
        for gain in (5.0, 200.0):
            scene = scene_of(virtual, world, FREE, T0)
            task = task_of(virtual, world, scene, T_star)
            velocity = law.step(scene, task, Options(gain, PERIOD)).velocity
            T = displacement(world.generators, FREE, PERIOD * velocity) @ T0
            before, after = (np.abs(world.pixels(virtual.PLATE @ M.T) - task.set_points).max() for M in (T0, T))
            assert after / before == pytest.approx(np.exp(-gain * PERIOD), abs=0.03), name


@pytest.mark.parametrize("name", list(LAWS))
def test_no_law_turns_or_moves_the_body_faster_than_it_may(virtual, name):
    T0, T_star, both = arms(virtual, 5, 90.0, 0.3)
    for world, composition in both:
        scene = scene_of(virtual, world, composition, T0)
        task = task_of(virtual, world, scene, T_star)
        free = LAWS[name].step(scene, task, Options(3.0, PERIOD)).velocity
        velocity = LAWS[name].step(scene, task, Options(3.0, PERIOD, rotation_rate=0.2, translation_rate=0.05)).velocity
        twist = np.tensordot(velocity, scene.operators, axes=1)
        # each of the two rotations of cartesian3 may turn at the rate; of second order in the step, joints turn more
        assert np.sqrt(-0.5 * np.trace(twist @ twist)) < 0.2 * np.sqrt(2.0) * 1.02
        assert np.linalg.norm(twist @ task.centre) < 0.05 * 1.03
        assert np.linalg.norm(velocity) < np.linalg.norm(free)


@pytest.mark.parametrize("seed", range(12))
def test_stereo_with_the_mean_jacobian_comes_home_from_far(virtual, seed):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(60, 150), rng.uniform(0, 0.4))
    error, *_ = follow(virtual, virtual.free_arm(rng, T0), T0, T_star, "stereo", Options(1.0))
    assert error < 0.5


@pytest.mark.parametrize("seed", range(8))
def test_points_come_home_from_anywhere_short_of_half_a_turn(virtual, seed):
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, rng.uniform(120, 178), rng.uniform(0, 0.4))
    error, *_ = follow(
        virtual, virtual.free_arm(rng, T0), T0, T_star, "points", Options(1.0, PERIOD), noise=0.1, seed=seed
    )
    assert error < 0.5


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("law", ["image", "stereo", "points"])
def test_one_camera_is_enough_once_the_points_are_known(virtual, law, camera):
    """(8.29), (8.30): the other camera has dropped out, the kinematics carry the points."""
    rng = np.random.default_rng(20 + camera)
    T0, T_star = virtual.random_task(rng, 40, 0.15)
    weights = np.zeros((2, 4))
    weights[camera] = 1.0
    error, *_ = follow(virtual, virtual.free_arm(rng, T0), T0, T_star, law, Options(1.0, PERIOD), weights=weights)
    assert error < 0.5


def test_half_a_turn_is_no_way_for_points_and_said_so(virtual):
    T0 = virtual.pose(Rotation.identity(), [0, 0, 1.0])
    T_star = virtual.pose(Rotation.from_euler("z", 180, degrees=True), [0, 0, 1.0])
    world = virtual.free_arm(np.random.default_rng(0), T0)
    scene = scene_of(virtual, world, FREE, T0)
    step = LAWS["points"].step(scene, task_of(virtual, world, scene, T_star), Options(1.0))
    assert np.isfinite(step.velocity).all()
    assert [reason.code for reason in LAWS["points"].reasons(step)] == ["JACOBIAN_ILL_CONDITIONED"]


@pytest.mark.parametrize("law", ["stereo", "image", "points", "trajectory"])
def test_nothing_seen_or_not_a_number_means_no_motion(virtual, law):
    T0, T_star, ((world, composition), _) = arms(virtual, 1)
    scene = scene_of(virtual, world, composition, T0, weights=np.zeros((2, 4)))
    task = task_of(virtual, world, scene, T_star)
    step = LAWS[law].step(scene, task, Options(1.0, PERIOD))
    np.testing.assert_array_equal(step.velocity, np.zeros(6))
    (reason,) = LAWS[law].reasons(step)
    assert (reason.code, reason.value) == ("JACOBIAN_ILL_CONDITIONED", 0.0)
    assert reason.threshold is not None
    assert reason.hint
    broken = scene._replace(points=np.full((4, 4), np.nan), weights=np.ones((2, 4)))
    step = LAWS[law].step(broken, task, Options(1.0, PERIOD))
    np.testing.assert_array_equal(step.velocity, np.zeros(6))


def test_stereo_blocks_are_the_mean_of_the_cameras_laws(virtual):
    T0, T_star, (_, (world, composition)) = arms(virtual, 2, 30.0)
    scene = scene_of(virtual, world, composition, T0)
    task = task_of(virtual, world, scene, T_star)
    options = Options(1.0, damping=0.0)
    alone = [
        LAWS["image"].step(scene._replace(weights=np.outer(mask, np.ones(4))), task, options).velocity
        for mask in np.eye(2)
    ]
    np.testing.assert_allclose(
        CLASSICAL["stereo-block"](scene, task, options).velocity, np.mean(alone, axis=0), atol=1e-12
    )
    blind = CLASSICAL["stereo-block"](scene._replace(weights=np.zeros((2, 4))), task, options)
    np.testing.assert_array_equal(blind.velocity, np.zeros(6))
    assert blind.conditioning == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_euclidean_points_are_the_pseudo_inverse_in_metres(virtual, seed):
    T0, T_star, both = arms(virtual, seed)
    for world, composition in both:
        scene = scene_of(virtual, world, composition, T0)
        task = task_of(virtual, world, scene, T_star)
        step = euclidean_points(np.linalg.inv(world.frame))(scene, task, Options(0.7, 0.0, JacobianChoice.CURRENT, 0.0))
        X, Y = virtual.PLATE @ T0.T, virtual.PLATE @ T_star.T
        operators = np.linalg.inv(world.frame) @ scene.operators @ world.frame
        J = np.einsum("nij,mj->min", operators, X)[:, :3].reshape(-1, 6)
        np.testing.assert_allclose(step.velocity, 0.7 * np.linalg.pinv(J) @ (Y - X)[:, :3].reshape(-1), atol=1e-8)


def test_after_the_warm_up_no_law_has_anything_to_compile(virtual):
    warm_up_laws()

    def of_laws():
        return {overload for overload in overloads() if overload.module.startswith("stereoservo.control.")}

    compiled = of_laws()
    assert compiled
    for world, composition in arms(virtual, 6)[2]:
        T0, T_star, _ = arms(virtual, 6)
        scene = scene_of(virtual, world, composition, T0)
        for law in LAWS.values():
            for dt_s in (0.0, PERIOD):
                law.step(scene, task_of(virtual, world, scene, T_star), Options(1.0, dt_s, rotation_rate=0.1))
    assert of_laws() == compiled
