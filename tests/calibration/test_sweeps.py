"""Means along sweeps against the exact pixels of a simulated arm, and delays of stamps against those that were made."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.sweeps import Leg, leg_means, sweep_timing
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.random_cells import random_case
from stereoservo_sim.world.synthetic import SyntheticCell

SIGMA = 0.05
RATE_HZ, JOINTS_HZ = 30.0, 250.0
SPEED, ACCELERATION = 0.5, 3.0


def course(t: FloatArray, length: float) -> FloatArray:
    """Position at times ``t`` [s] on a trapezoid of speed from 0 to ``length``, at rest before and after."""
    ramp = SPEED / ACCELERATION
    end = length / SPEED + ramp
    up = 0.5 * ACCELERATION * np.clip(t, 0.0, ramp) ** 2
    steady = SPEED * np.clip(t - ramp, 0.0, end - 2.0 * ramp)
    last = np.clip(t - end + ramp, 0.0, ramp)
    return up + steady + SPEED * last - 0.5 * ACCELERATION * last**2


def legs_of(cell: SyntheticCell, rng: np.random.Generator, delays: FloatArray, play: float = 0.0) -> list[Leg]:
    """There and back of every joint: the first camera's frames from 4 ms on, those of each further one 7 ms later.
    ``play`` [rad]: the links follow half of it behind the readings, in the direction of motion.
    """
    legs: list[Leg] = []
    begin = 0.0
    for joint, reach in enumerate((0.5 * cell.ranges).tolist()):
        for there in (True, False):
            seconds = reach / SPEED + SPEED / ACCELERATION
            times = begin + np.arange(-0.3, seconds + 0.3, 1.0 / JOINTS_HZ)
            far = course(times - begin, reach)
            positions = np.tile(cell.home, (len(times), 1))
            positions[:, joint] += far if there else reach - far
            stamps, pixels = [], []
            for c, delay in enumerate(delays.tolist()):
                stamped = begin + np.arange(0.004 + 0.007 * c, seconds, 1.0 / RATE_HZ)
                links = np.array([np.interp(stamped + delay, times, q) for q in positions.T]).T
                links[:, joint] -= 0.5 * play * (1.0 if there else -1.0)
                exact = cell.pixels(links)[c]
                stamps.append(stamped)
                pixels.append(exact + rng.normal(0.0, SIGMA, exact.shape))
            variances = tuple(np.full(p.shape[:2], SIGMA**2) for p in pixels)
            legs.append(
                Leg(
                    joint,
                    begin,
                    begin + seconds,
                    times,
                    positions,
                    tuple(stamps),
                    tuple(pixels),
                    variances,
                    np.zeros(len(cell.home)),
                )
            )
            begin += seconds
    return legs


@pytest.mark.parametrize("seed", range(4))
def test_means_have_the_noise_of_as_many_frames_at_rest(seed: int) -> None:
    cell = random_case(seed).cell
    delays = np.array([-0.03, 0.012])
    legs = legs_of(cell, np.random.default_rng([seed, 1]), delays)
    square, count, frames, effective = 0.0, 0, 0, 0.0
    for leg in legs:
        means = leg_means(leg, delays, 4)
        if means is None:  # a short leg
            assert len(leg.times[0]) < 16
            continue
        exact = cell.pixels(means.positions)
        seen = np.isfinite(means.pixels).all(axis=-1)
        square += float((((means.pixels - exact) ** 2).sum(axis=-1) * means.counts / SIGMA**2)[seen].sum())
        count += 2 * int(seen.sum())
        frames += int(means.frames.sum()) * cell.pixels(cell.home[None]).shape[2]
        effective += float(means.counts[seen].sum())
        freedom = means.freedom.sum()
        assert chi2.cdf(2.0 * (means.scatter * means.freedom).sum() / SIGMA**2, 2.0 * freedom) == pytest.approx(
            0.5, abs=0.4999
        )
    print(f"seed {seed}: chi2 {square:.0f} of {count}, {effective:.0f} frames' worth of {frames}")
    assert square < count + 6.0 * np.sqrt(2.0 * count)
    assert effective > 0.6 * frames


@pytest.mark.parametrize("play", [0.0, 0.003])
@pytest.mark.parametrize("seed", range(4))
def test_delays_are_found_with_their_deviation(seed: int, play: float) -> None:
    cell = random_case(seed).cell
    delays = np.random.default_rng([seed, 2]).uniform(-0.08, 0.08, 2)
    found = sweep_timing(legs_of(cell, np.random.default_rng([seed, 3]), delays, play), 2)
    errors = np.concatenate([found.delays - delays, found.play - play])
    print(f"seed {seed}, play {play}: errors {1e6 * errors}, deviations {1e6 * found.deviations} [us, urad]")
    used = np.abs(errors) < 5.0 * found.deviations + 2e-5
    assert (used | (found.play[np.arange(8) - 2] == 0.0)).all() if play else used.all()
    assert (found.deviations[:2] < 1e-3).all()
    assert ((found.play > 0.0) == (play > 0.0)).mean() > 0.6


def test_wrong_detections_do_not_enter_means() -> None:
    cell = random_case(0).cell
    leg = legs_of(cell, np.random.default_rng(5), np.zeros(2))[1]
    spoilt = leg.pixels[0].copy()
    spoilt[6, 1] += 30.0
    clean = leg_means(leg, np.zeros(2), 4)
    found = leg_means(msgspec.structs.replace(leg, pixels=(spoilt, leg.pixels[1])), np.zeros(2), 4)
    assert clean is not None
    assert found is not None
    assert np.nanmax(np.abs(found.pixels - clean.pixels)) < 6.0 * SIGMA


def test_a_leg_without_motion_or_with_few_frames_has_no_means() -> None:
    cell = random_case(0).cell
    leg = legs_of(cell, np.random.default_rng(6), np.zeros(2))[0]
    still = msgspec.structs.replace(leg, positions=np.tile(cell.home, (len(leg.joint_times), 1)))
    assert leg_means(still, np.zeros(2), 4) is None
    few = msgspec.structs.replace(
        leg, times=tuple(t[:5] for t in leg.times), pixels=tuple(p[:5] for p in leg.pixels),
        variances=tuple(v[:5] for v in leg.variances),
    )  # fmt: skip
    assert leg_means(few, np.zeros(2), 4) is None
    found = sweep_timing([few], 2)
    assert (found.delays == 0.0).all()
    assert np.isinf(found.deviations).all()
