"""The law ``trajectory`` on hidden Euclidean arms: a held velocity makes the motion that was meant."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.laws import LAWS
from stereoservo.kinematics.composition import Composition

DT = 0.04


def scene_and_task(world, q_then):
    """Set-points at present, which by the end of the step are where joints ``q_then`` bring the markers."""
    X, X_then = world.markers(), world.markers(q_then)
    pixels, then = world.pixels(X), world.pixels(X_then)
    points = world.hidden(X)
    ones = np.ones((2, 4))
    scene = Scene(
        world.operators(), Composition.BASE_FIRST, world.matrices, world.camera_centres, points, pixels, ones
    )
    task = Task(
        pixels, ones, (then - pixels) / DT, world.hidden(X_then), np.ones(4), points.mean(axis=0),
        points.mean(axis=0), np.array([0, 1, 2]),
    )  # fmt: skip
    return scene, task, then


@pytest.mark.parametrize("seed", range(4))
def test_held_velocity_brings_the_pixels_where_the_rates_lead(virtual, seed):
    rng = np.random.default_rng(seed)
    world = virtual.rx90(rng)
    q_then = world.q + DT * rng.uniform(-1.5, 1.5, 6)
    scene, task, then = scene_and_task(world, q_then)
    first = LAWS["trajectory"].step(scene, task, Options(gain=0.5)).velocity
    held = LAWS["trajectory"].step(scene, task, Options(gain=0.5, dt_s=DT)).velocity
    off_first = np.abs(world.pixels(world.markers(world.q + DT * first)) - then).max()
    off_held = np.abs(world.pixels(world.markers(world.q + DT * held)) - then).max()
    assert off_first > 0.05  # the case shows what the correction is for
    assert off_held < 1e-3 * off_first


def test_one_camera_is_enough_and_the_other_is_not_read(virtual):
    rng = np.random.default_rng(7)
    world = virtual.rx90(rng)
    scene, task, _ = scene_and_task(world, world.q + DT * rng.uniform(-1, 1, 6))
    blind = np.array([[1.0] * 4, [0.0] * 4])
    hidden = scene.pixels.copy()
    hidden[1] = np.nan
    options = Options(gain=0.5, dt_s=DT)
    one = LAWS["trajectory"].step(scene._replace(weights=blind), task, options).velocity
    unread = LAWS["trajectory"].step(scene._replace(weights=blind, pixels=hidden), task, options).velocity
    assert np.isfinite(one).all()
    np.testing.assert_array_equal(one, unread)


def test_at_rest_on_its_way_it_rests(virtual):
    world = virtual.rx90(np.random.default_rng(3))
    scene, task, _ = scene_and_task(world, world.q)
    held = LAWS["trajectory"].step(scene, task, Options(gain=0.5, dt_s=DT)).velocity
    assert np.abs(held).max() < 1e-9
