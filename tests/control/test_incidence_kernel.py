"""The compiled incidence law against its readable reference."""

from __future__ import annotations

import numpy as np
import pytest

from oracles.incidence import incidence_reference, joint_metric_reference
from stereoservo.control.incidence import (
    KINDS,
    IncidenceTask,
    image_task,
    incidence_step,
    incidence_task,
    joint_task,
    no_second_task,
)
from stereoservo.control.incidence_kernel import joint_metric
from stereoservo.control.law import Options, Scene
from stereoservo.kinematics.composition import Composition

COUNTS = ((1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))


def scene_of(world, composition=0):
    markers = world.markers()
    pixels = world.pixels(markers)
    return Scene(
        np.ascontiguousarray(world.operators()), composition, np.ascontiguousarray(world.matrices),
        world.camera_centres, np.ascontiguousarray(world.hidden(markers)), pixels, np.ones((2, 4)),
    )  # fmt: skip


@pytest.mark.parametrize("composition", list(Composition))
def test_kernel_is_the_reference(virtual, composition):
    rng = np.random.default_rng(20 + int(composition))
    for _ in range(25):
        T0, T1 = virtual.random_task(rng, rng.uniform(5, 80), 0.2)
        world = virtual.rx90(rng, T0=T0) if rng.random() < 0.5 else virtual.free_arm(rng, T0)
        scene = scene_of(world, composition)
        chosen = rng.permutation(6)[: rng.integers(1, 4)].tolist()
        tasks = [
            incidence_task(
                [KINDS[i]], [rng.permutation(4)[: COUNTS[i][0]].tolist()],
                [world.hidden(virtual.PLATE[rng.permutation(4)[: COUNTS[i][1]]] @ T1.T)], world.infinity, 0.1,
            )
            for i in chosen
        ]  # fmt: skip
        task = IncidenceTask(
            np.concatenate([t.kinds for t in tasks]), np.concatenate([t.markers for t in tasks]),
            np.concatenate([t.fixed for t in tasks]), 0.1, float(rng.integers(2)) * 0.02 * rng.standard_normal((4, 4)),
        )  # fmt: skip
        set_points = world.pixels(virtual.PLATE @ T1.T)
        second = (
            no_second_task(6),
            joint_task(world.q, world.q + rng.normal(0, 0.1, 6), np.ones(6), np.ones(6), 2.0),
            image_task(scene.operators, scene.matrices, scene.points, set_points, np.ones((2, 4)), 2.0),
        )[int(rng.integers(3))]
        options = Options(float(rng.uniform(0.5, 12)), 0.04)
        metric = joint_metric(scene.operators, scene.matrices, scene.points)
        np.testing.assert_allclose(
            metric, joint_metric_reference(scene.operators, scene.matrices, scene.points), rtol=1e-10
        )
        step = incidence_step(scene, task, options, second)
        reference = incidence_reference(scene, task, options, second, metric)
        # (JᵀJ + d)⁻¹ enlarges rounding by its conditioning: that of J, and for a second task 1 / damping.
        scale = float(np.abs(reference.velocity).max())
        allowed = 1e-8 if len(second.rates) else 1e-10 * max(1.0, 1e-3 / reference.conditioning)
        np.testing.assert_allclose(step.velocity / scale, reference.velocity / scale, rtol=0, atol=allowed)
        np.testing.assert_allclose(step.error_px, reference.error_px, rtol=1e-8)
        np.testing.assert_array_equal(step.status, reference.status)
        assert step.rank == reference.rank
        assert step.share == pytest.approx(reference.share, abs=1e-8)
        assert step.conditioning == pytest.approx(reference.conditioning, rel=1e-8)


def test_image_task_is_the_image_law(virtual):
    """Its rows are the image Jacobian, by finite displacement; its rates pull predicted pixels to the set-points."""
    rng = np.random.default_rng(30)
    T0, T1 = virtual.random_task(rng, 30, 0.1)
    world = virtual.free_arm(rng, T0)
    scene = scene_of(world)
    set_points = world.pixels(virtual.PLATE @ T1.T)
    weights = np.array([[1.0, 0, 2, 1], [1, 1, 0, 1]])
    task = image_task(scene.operators, scene.matrices, scene.points, set_points, weights, 3.0)
    seen = np.repeat(weights.ravel(), 2) > 0
    np.testing.assert_allclose(task.rates[seen], -3.0 * (scene.pixels - set_points).reshape(-1)[seen], rtol=1e-9)
    assert not task.rates[~seen].any()
    h = 1e-6
    for j in range(6):
        step = np.zeros(6)
        step[j] = h
        ahead = world.pixels(world.markers(world.q + step))
        back = world.pixels(world.markers(world.q - step))
        np.testing.assert_allclose(task.rows[:, j], ((ahead - back) / (2 * h)).ravel(), atol=1e-4)
