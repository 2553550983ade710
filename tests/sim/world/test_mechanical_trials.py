"""Trial data of synthetic arms that are not perfect."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.world.mechanical_trials import (
    approaches,
    links_and_readings,
    mechanical_trials,
    synthetic_load,
)
from stereoservo_sim.world.mechanics import Mechanics, preset
from stereoservo_sim.world.random_cells import random_case
from stereoservo_sim.world.synthetic import gantry, rx90, scara, seven


@pytest.mark.parametrize("make", [rx90, seven, scara])
def test_every_arm_sags_down_and_no_joint_bears_more_than_all(make):
    cell = make()
    up, rng = cell.base[:3, 2], np.random.default_rng(1)
    for _ in range(30):
        q = cell.home + rng.uniform(-1.0, 1.0, len(cell.home))
        load = synthetic_load(cell, q)
        assert np.abs(load).max() <= 1.0 + 1e-9
        heights = [cell.frames(p)[:, :3, 3] @ up for p in (q, q + 1e-5 * load)]
        middles = [0.5 * (h[:-1] + h[1:]) for h in heights]
        assert middles[1].sum() <= middles[0].sum() + 1e-12


def test_a_vertical_slide_bears_all_and_a_level_one_nothing():
    cell = gantry()
    up = cell.base[:3, 2]
    axes = cell.frames(cell.home)[:-1, :3, 2]
    assert np.allclose(synthetic_load(cell, cell.home), -axes @ up)


def test_approaches_are_the_last_motions():
    positions = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, -0.2], [0.0, -0.2], [0.0, -0.1]])
    assert approaches(positions, np.zeros(2)).tolist() == [[0, 0], [1, 0], [1, -1], [-1, -1], [-1, 1]]


def test_perfect_mechanics_give_the_trials_of_a_perfect_arm():
    cell = random_case(3).cell
    plain = cell.trials(0.1, np.random.default_rng(7), 9)
    same = mechanical_trials(cell, (Mechanics(),) * len(cell.home), 0.1, np.random.default_rng(7), 9)
    assert np.array_equal(plain.pixels, same.pixels)
    assert np.array_equal(plain.positions, same.positions)


@pytest.mark.parametrize("name", ["strain_wave", "planetary_qdd", "serial_servo"])
def test_pixels_are_of_the_links_and_positions_of_the_encoders(name):
    cell = random_case(3).cell
    gears = preset(name, len(cell.home))
    motors, _ = cell.stops(9)
    links, readings = links_and_readings(cell, gears, motors)
    trials = mechanical_trials(cell, gears, 0.0, np.random.default_rng(7), 9)
    assert np.array_equal(trials.positions, readings)
    assert np.allclose(trials.pixels, cell.pixels(links))
    off = np.abs(links - readings).max()
    if name == "serial_servo":  # its encoders sit on the joints
        assert off <= 0.5 * gears[0].encoder_step * (1.0 + 1e-9)
        assert np.abs(links - motors).max() > 0.01
    else:
        assert 1e-4 < off < 0.01


def test_the_play_of_a_joint_without_load_shows_by_the_direction_of_approach():
    cell = rx90()
    gears = (Mechanics(play=0.01),) + (Mechanics(),) * 5  # the first axis is upright
    q = np.tile(cell.home, (4, 1))
    q[:, 0] += [-0.1, 0.0, 0.1, 0.0]
    links, readings = links_and_readings(cell, gears, q)
    assert np.allclose((links - readings)[:, 0], [0.005, -0.005, -0.005, 0.005])
