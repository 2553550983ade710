"""Control in the images of cameras that have moved (8.27, 8.28)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.moved_cameras import image_of_moved_cameras, with_resected_cameras
from stereoservo.kinematics.composition import Composition, displacement

BODY = np.array(
    [[-5, -5, 0], [5, -5, 1], [5, 5, -2], [-5, 5, 0], [0, 2, -5], [-3, 1, -4], [2, -3, 4], [1, 4, 3.0]]
)
BODY = np.column_stack([BODY / 100.0, np.ones(8)])


def moved(world, virtual, rng, amount):
    """The rig's cameras after each has been knocked, seen from the old frame."""
    knocks = [
        virtual.pose(Rotation.from_rotvec(amount * rng.normal(size=3)), amount * rng.normal(size=3))
        for _ in range(2)
    ]
    return np.array([P @ knock for P, knock in zip(world.euclidean, knocks, strict=True)])


def pixels(cameras, X):
    m = np.einsum("cij,mj->cmi", cameras, X)
    return m[..., :2] / m[..., 2:]


def scene_at(world, cameras, T, weights):
    X = BODY @ T.T
    return Scene(
        world.operators(), int(Composition.SIMULTANEOUS), world.matrices, world.camera_centres, world.hidden(X),
        pixels(cameras, X), weights,
    )  # fmt: skip


def test_the_cameras_are_found_where_they_went(virtual):
    rng = np.random.default_rng(0)
    T0, _ = virtual.random_task(rng, 30, 0.1)
    world = virtual.free_arm(rng, T0)
    cameras = moved(world, virtual, rng, 0.05)
    found = with_resected_cameras(scene_at(world, cameras, T0, np.ones((2, 8))))
    X = rng.uniform(-0.2, 0.2, (20, 4)) + np.array([0, 0, 1, 0])
    X[:, 3] = 1.0
    np.testing.assert_allclose(pixels(found.matrices, world.hidden(X)), pixels(cameras, X), atol=1e-5)
    eyes = np.array([np.linalg.svd(P)[2][3] for P in cameras])
    np.testing.assert_allclose(found.camera_centres, world.hidden(eyes / eyes[:, 3:]), atol=1e-6)


def test_a_camera_that_sees_five_or_a_plane_has_no_weight(virtual):
    rng = np.random.default_rng(1)
    T0, _ = virtual.random_task(rng, 30, 0.1)
    world = virtual.free_arm(rng, T0)
    weights = np.ones((2, 8))
    weights[1, 5:] = 0.0
    found = with_resected_cameras(scene_at(world, world.euclidean, T0, weights))
    assert found.weights[0].all()
    assert not found.weights[1].any()
    flat = scene_at(world, world.euclidean, T0, np.ones((2, 8)))
    X = BODY * [1, 1, 0, 1] @ T0.T
    flat = flat._replace(points=world.hidden(X), pixels=world.pixels(X))
    assert not with_resected_cameras(flat).weights.any()


@pytest.mark.parametrize("seed", range(3))
def test_control_goes_on_with_cameras_that_keep_moving(virtual, seed):
    """The goal is what the cameras show at it from where they stand; without new estimates the way would bend."""
    rng = np.random.default_rng(seed)
    T0, T_star = virtual.random_task(rng, 30, 0.1)
    world = virtual.free_arm(rng, T0)
    cameras = moved(world, virtual, rng, 0.15)
    T, weights = T0.copy(), np.ones((2, 8))
    for _ in range(300):
        cameras = cameras @ virtual.pose(
            Rotation.from_rotvec(1e-3 * rng.normal(size=3)), 1e-3 * rng.normal(size=3)
        )
        scene = scene_at(world, cameras, T, weights)
        set_points = pixels(cameras, BODY @ T_star.T)
        error = np.linalg.norm(scene.pixels - set_points, axis=-1).max()
        if error < 0.5:
            break
        Y = world.hidden(BODY @ T_star.T)
        task = Task(
            set_points, weights, np.zeros((2, 8, 2)), Y, np.ones(8), scene.points.mean(0), Y.mean(0), np.arange(3)
        )  # fmt: skip
        velocity = image_of_moved_cameras(scene, task, Options(1.0, 0.04)).velocity
        T = displacement(world.generators, Composition.SIMULTANEOUS, 0.04 * velocity) @ T
    assert error < 0.5
    exact = scene._replace(matrices=cameras @ np.linalg.inv(world.frame))
    step = LAWS["image"].step(exact, task, Options(1.0, 0.04))
    np.testing.assert_allclose(
        image_of_moved_cameras(scene, task, Options(1.0, 0.04)).velocity, step.velocity, atol=1e-5
    )
