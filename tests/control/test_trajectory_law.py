"""Tracking along a planned way: in closed loop, with both cameras and with one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.laws import LAWS
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
    deviations, error = track(
        virtual, virtual.free_arm(rng, T0), Composition.SIMULTANEOUS, T_star, 1.0, noise=0.1
    )
    assert deviations.max() < 0.001
    assert error < 0.5
