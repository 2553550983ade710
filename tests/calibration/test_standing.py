"""Markers that stand still beside the body: found, and nothing else taken for them."""

from dataclasses import replace

import numpy as np
import pytest

from stereoservo.calibration.trial_data import static_markers
from stereoservo_sim.world.synthetic import flat_plate, gantry, rx90


def with_table(cell, rng, sigma=0.05, count=4):
    """Trials in which the last ``count`` markers stand on a table."""
    trials = cell.trials(sigma, rng)
    stops = trials.pixels.shape[1]
    still = np.repeat(trials.pixels[:, :1, :count] + [30.0, -20.0], stops, axis=1)
    still = still + rng.normal(0, sigma, still.shape)
    return (
        np.concatenate([trials.pixels, still], axis=2),
        np.concatenate([trials.sigmas, np.full(still.shape[:3], sigma)], axis=2),
    )


@pytest.mark.parametrize("cell", [rx90(), rx90(flat_plate()), gantry()])
def test_markers_on_a_table_are_distinguished_from_those_on_the_arm(cell):
    pixels, sigmas = with_table(cell, np.random.default_rng(1))
    pixels[0, 3:7, -1] = np.nan
    assert static_markers(pixels, sigmas).tolist() == [False] * len(cell.marker_ids) + [True] * 4


def test_a_small_motion_is_none_that_stands_still():
    cell = rx90()
    small = replace(cell, ranges=0.02 * cell.ranges)
    pixels, sigmas = with_table(small, np.random.default_rng(2))
    assert static_markers(pixels, sigmas).sum() == 4


def test_where_nothing_moves_no_marker_is_blamed():
    cell = rx90()
    trials = replace(cell, ranges=0.0 * cell.ranges).trials(0.05, np.random.default_rng(3))
    assert not static_markers(trials.pixels, trials.sigmas).any()
    assert not static_markers(np.full((2, 4, 3, 2), np.nan), np.full((2, 4, 3), np.nan)).any()
