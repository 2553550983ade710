"""Tracking along a planned way: in closed loop, with both cameras and with one."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from oracles.trajectory import trajectory_velocity
from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.trajectory import trajectory
from stereoservo.geometry.screws import twist_matrix
from stereoservo.kinematics.composition import Composition, displacement

PERIOD, DURATION = 0.04, 3.0


def track(virtual, world, composition, T_star, gain, *, cameras=(1.0, 1.0), offset=0.0, noise=0.0, seed=0):
    """Follow the straight way with a smooth pace: deviations of the centre [m] at each step, last error [px]."""
    rng = np.random.default_rng(seed)
    q, T = world.q.copy(), world.plate_pose()
    T0 = T.copy()
    turn = Rotation.from_matrix(T_star[:3, :3] @ T0[:3, :3].T).as_rotvec()

    def planned(t):
        x = np.clip(t / DURATION, 0, 1)
        share = x**3 * (10 - 15 * x + 6 * x * x)
        R = Rotation.from_rotvec(share * turn) * Rotation.from_matrix(T0[:3, :3])
        return virtual.pose(R, T0[:3, 3] + share * (T_star - T0)[:3, 3])

    T[0, 3] += offset
    deviations, t = [], 0.0
    weights = np.outer(cameras, np.ones(4))
    for _ in range(round(DURATION / PERIOD) + 25):
        deviations.append(np.linalg.norm((T - planned(t))[:3, 3]))
        X = virtual.PLATE @ T.T
        pixels = world.pixels(X) + noise * rng.normal(size=(2, 4, 2))
        now, then = (world.pixels(virtual.PLATE @ planned(at).T) for at in (t, t + PERIOD))
        scene = Scene(
            np.ascontiguousarray(world.operators(q)), int(composition), world.matrices, world.camera_centres,
            world.hidden(X), np.where(weights[..., None] > 0, pixels, np.nan), weights,
        )  # fmt: skip
        Y = world.hidden(virtual.PLATE @ T_star.T)
        task = Task(
            now, np.ones((2, 4)), (then - now) / PERIOD, Y, np.ones(4), scene.points.mean(0), Y.mean(0), np.arange(3)
        )  # fmt: skip
        velocity = LAWS["trajectory"].step(scene, task, Options(gain, PERIOD)).velocity
        t += PERIOD
        if composition == Composition.SIMULTANEOUS:
            T = displacement(world.generators, composition, PERIOD * velocity) @ T
        else:
            q = q + PERIOD * velocity
            T = world.plate_pose(q)
    error = np.linalg.norm(world.pixels(virtual.PLATE @ T.T) - now, axis=-1).max()
    return np.array(deviations), error


@pytest.mark.parametrize("cameras", [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
def test_the_way_is_followed_exactly_by_a_free_arm(virtual, cameras):
    rng = np.random.default_rng(1)
    T0, T_star = virtual.random_task(rng, 100, 0.3)
    deviations, error = track(
        virtual, virtual.free_arm(rng, T0), Composition.SIMULTANEOUS, T_star, 2.0, cameras=cameras
    )
    assert deviations.max() < 2e-6
    assert error < 0.01


def test_the_way_is_followed_by_the_six_revolute_arm(virtual):
    rng = np.random.default_rng(8)
    T0, _ = virtual.random_task(rng, 10, 0.05)
    world = virtual.rx90(rng, T0=T0)
    T_star = world.plate_pose(world.q + np.array([0.15, -0.1, 0.12, 0.5, 0.3, 0.6]))
    deviations, error = track(virtual, world, Composition.BASE_FIRST, T_star, 2.0)
    assert deviations.max() < 1e-5
    assert error < 0.01


def test_a_deviation_decays_while_the_way_goes_on(virtual):
    rng = np.random.default_rng(2)
    T0, T_star = virtual.random_task(rng, 60, 0.2)
    world = virtual.free_arm(rng, T0)
    deviations, _ = track(virtual, world, Composition.SIMULTANEOUS, T_star, 2.0, offset=0.01)
    assert deviations[0] == pytest.approx(0.01)
    steps = np.arange(30)
    np.testing.assert_allclose(deviations[:30], 0.01 * np.exp(-2.0 * PERIOD * steps), rtol=0.1, atol=1e-4)


def test_noise_does_not_lead_it_astray(virtual):
    rng = np.random.default_rng(3)
    T0, T_star = virtual.random_task(rng, 100, 0.3)
    deviations, error = track(virtual, virtual.free_arm(rng, T0), Composition.SIMULTANEOUS, T_star, 1.0, noise=0.1)
    assert deviations.max() < 0.001
    assert error < 0.5


STRETCHED, BEND = np.pi / 2, 0.3
"""Third joint [rad] of the six-revolute arm where its elbow is stretched, and how far from there the way begins."""


def through_the_stretched_elbow(virtual, seed, *, joints_planned, model_error):
    """Follow joints through a stretched elbow: its bend at each step [rad], last error [px] and of the joints [rad].

    The model's axes are off by ``model_error`` [rad, m]. The shoulder makes up for the elbow, so that the body goes out
    and, seen in the images alone, back on the same way.
    """
    rng = np.random.default_rng(seed)
    start = np.array([0.1, -0.9, STRETCHED + BEND, 0.4, 0.8, 0.2])
    goal = start + np.array([0.1, 1.3 * BEND, -2.0 * BEND, 0.1, 0.1, 0.1])
    truth = virtual.rx90(rng, start)
    E = np.array([expm(model_error * twist_matrix(*rng.uniform(-1.0, 1.0, (2, 3)))) for _ in start])
    model = virtual.World(E @ truth.generators @ np.linalg.inv(E), truth.plate, truth.frame, start)
    model.plate = np.linalg.inv(model.displacement(start)) @ truth.plate_pose(start)

    def planned(t):
        x = np.clip(t / DURATION, 0, 1)
        return start + x**3 * (10 - 15 * x + 6 * x * x) * (goal - start)

    q, bends, every = start, [], np.ones((2, 4))
    for k in range(round(DURATION / PERIOD) + 50):
        t = k * PERIOD
        now, then = (model.pixels(model.markers(planned(at))) for at in (t, t + PERIOD))
        seen = truth.pixels(truth.markers(q)) + 0.1 * rng.normal(size=(2, 4, 2))
        X = model.hidden(model.markers(q))
        scene = Scene(
            model.operators(q), int(Composition.BASE_FIRST), model.matrices, model.camera_centres, X, seen, every
        )  # fmt: skip
        task = Task(now, every, (then - now) / PERIOD, X, np.zeros(4), X[0], X[0], np.arange(3))
        if joints_planned and t < DURATION:
            task = task._replace(
                joint_rates=(planned(t + PERIOD) - planned(t)) / PERIOD,
                joint_error=planned(t) - q,
                joint_weight=min(1.0, 2.0 * (DURATION - t)),
            )
        q = q + PERIOD * LAWS["trajectory"].step(scene, task, Options(1.0, PERIOD)).velocity
        bends.append(q[2] - STRETCHED)
    error = np.linalg.norm(truth.pixels(truth.markers(q)) - now, axis=-1).max()
    return np.array(bends), error, np.abs(q - goal).max()


def test_an_arm_goes_through_a_stretched_elbow_as_it_is_planned(virtual):
    """The images alone lead back to the branch that the arm comes from; the planned joints lead through."""
    for seed in range(2):
        bends, error, off = through_the_stretched_elbow(virtual, seed, joints_planned=True, model_error=1e-3)
        assert bends[-1] == pytest.approx(-BEND, abs=0.02)
        assert (np.diff(bends) < 2e-3).all()
        assert off < 0.01
        assert error < 0.2
    bends, _, _ = through_the_stretched_elbow(virtual, 0, joints_planned=False, model_error=1e-3)
    assert bends[-1] == pytest.approx(BEND, abs=0.02)


def test_a_redundant_arm_moves_in_itself_as_it_is_planned(virtual):
    """The seventh joint stands where the first one does: what one turns, the other may turn back, unseen."""
    rng = np.random.default_rng(6)
    six = virtual.rx90(rng)
    world = virtual.World(
        np.concatenate([six.generators[:1], six.generators]), six.plate, six.frame, np.concatenate([[0.0], six.q])
    )  # fmt: skip
    X = world.markers()
    scene = Scene(
        world.operators(), int(Composition.BASE_FIRST), world.matrices, world.camera_centres, world.hidden(X),
        world.pixels(X), np.ones((2, 4)),
    )  # fmt: skip
    still = Task(
        scene.pixels, np.ones((2, 4)), np.zeros((2, 4, 2)), scene.points, np.zeros(4), scene.points[0],
        scene.points[0], np.arange(3),
    )  # fmt: skip
    planned = np.array([0.3, -0.3, 0, 0, 0, 0, 0])
    for dt_s in (0.0, PERIOD):
        for rates, error in ((planned, np.zeros(7)), (np.zeros(7), planned)):
            task = still._replace(joint_rates=rates, joint_error=error, joint_weight=1.0)
            gain = 1.0 if rates.any() or dt_s == 0.0 else -np.expm1(-PERIOD) / PERIOD
            found = LAWS["trajectory"].step(scene, task, Options(1.0, dt_s)).velocity
            np.testing.assert_allclose(found, gain * planned, rtol=0, atol=1e-9)


def test_planned_joints_of_another_arm_are_refused_and_unknown_ones_rest(virtual):
    world = virtual.rx90(np.random.default_rng(7))
    X = world.hidden(world.markers())
    pixels, every = world.pixels(world.markers()), np.ones((2, 4))
    scene = Scene(
        world.operators(), int(Composition.BASE_FIRST), world.matrices, world.camera_centres, X, pixels, every
    )
    task = Task(pixels, every, np.ones((2, 4, 2)), X, np.zeros(4), X[0], X[0], np.arange(3))
    with pytest.raises(ValueError, match="6 joints"):
        trajectory(scene, task._replace(joint_rates=np.zeros(5), joint_error=np.zeros(5)), Options(1.0))
    with pytest.raises(ValueError, match="6 joints"):
        trajectory(scene, task._replace(joint_rates=np.zeros(6)), Options(1.0))
    unknown = task._replace(joint_rates=np.full(6, np.nan), joint_error=np.zeros(6), joint_weight=1.0)
    for velocity, conditioning in (
        trajectory(scene, unknown, Options(1.0, PERIOD))[::4],
        trajectory_velocity(scene, unknown, Options(1.0, PERIOD)),
    ):
        assert not velocity.any()
        assert conditioning == 0.0
