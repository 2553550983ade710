"""Means along sweeps against the exact pixels of a simulated arm, and delays of stamps against those that were made."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.sweeps import Leg, SweepTiming, leg_means, stamp_scatter, sweep_timing
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


def at(when: FloatArray, times: FloatArray, positions: FloatArray) -> FloatArray:
    return np.array([np.interp(when, times, q) for q in positions.T]).T


def legs_of(
    cell: SyntheticCell,
    rng: np.random.Generator,
    delays: FloatArray,
    play: float = 0.0,
    row_s: float = 0.0,
    jitter_s: float = 0.0,
) -> list[Leg]:
    """There and back of every joint: the first camera's frames from 4 ms on, those of each further one 7 ms later.
    ``play`` [rad]: the links rest until the readings have gone so far in their new direction. ``row_s``: of a rolling
    shutter. ``jitter_s``: deviation of each frame's stamp.
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
                links = positions.copy()
                side = 1.0 if there else -1.0
                taken = np.minimum(np.abs(positions[:, joint] - positions[0, joint]), play)
                links[:, joint] += side * (0.5 * play - taken)
                shutter = stamped + delay + rng.normal(0.0, jitter_s, len(stamped))

                def images(
                    at: FloatArray, links: FloatArray = links, times: FloatArray = times, c: int = c
                ) -> FloatArray:
                    return cell.pixels(np.array([np.interp(at, times, q) for q in links.T]).T)[c]

                exact = images(shutter)
                if row_s:
                    late = row_s * (exact[..., 1] - 0.5 * cell.height)
                    exact = np.stack([images(shutter + late[:, m])[:, m] for m in range(late.shape[1])], axis=1)
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
                    (cell.height,) * len(delays),
                )
            )
            begin += seconds
    return legs


def timing_of(delays: FloatArray, row_s: float = 0.0) -> SweepTiming:
    return SweepTiming(delays, np.full(len(delays), row_s), np.zeros(6), np.zeros(0))


@pytest.mark.parametrize("seed", range(4))
def test_means_have_the_noise_of_as_many_frames_at_rest(seed: int) -> None:
    cell = random_case(seed).cell
    delays = np.array([-0.03, 0.012])
    legs = legs_of(cell, np.random.default_rng([seed, 1]), delays)
    square, count, frames, effective = 0.0, 0, 0, 0.0
    for leg in legs:
        means = leg_means(leg, timing_of(delays), 4)
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


@pytest.mark.parametrize(("play", "row_s"), [(0.0, 0.0), (0.003, 0.0), (0.0, 4e-5), (0.003, 4e-5)])
@pytest.mark.parametrize("seed", range(4))
def test_timing_is_found_with_its_deviation(seed: int, play: float, row_s: float) -> None:
    cell = random_case(seed).cell
    delays = np.random.default_rng([seed, 2]).uniform(-0.08, 0.08, 2)
    found = sweep_timing(legs_of(cell, np.random.default_rng([seed, 3]), delays, play, row_s), 2)
    errors = np.concatenate([found.delays - delays, found.rows - row_s, found.play - play])
    print(f"seed {seed}, play {play}: errors {1e6 * errors}, deviations {1e6 * found.deviations} [us, urad]")
    used = np.abs(errors) < 5.0 * found.deviations + 2e-5
    unknown = np.concatenate([np.zeros(4, dtype=bool), (found.play == 0.0) & (play > 0.0)])  # of joints seen too little
    assert (used | unknown).all()
    assert ((found.rows > 0.0) == (row_s > 0.0)).all()
    assert (found.deviations[:2] < 1e-3).all()
    assert ((found.play > 0.0) == (play > 0.0)).mean() > 0.6


def test_wrong_detections_do_not_enter_means() -> None:
    cell = random_case(0).cell
    leg = legs_of(cell, np.random.default_rng(5), np.zeros(2))[1]
    spoilt = leg.pixels[0].copy()
    spoilt[6, 1] += 30.0
    clean = leg_means(leg, timing_of(np.zeros(2)), 4)
    found = leg_means(msgspec.structs.replace(leg, pixels=(spoilt, leg.pixels[1])), timing_of(np.zeros(2)), 4)
    assert clean is not None
    assert found is not None
    assert np.nanmax(np.abs(found.pixels - clean.pixels)) < 6.0 * SIGMA


def test_a_leg_without_motion_or_with_few_frames_has_no_means() -> None:
    cell = random_case(0).cell
    leg = legs_of(cell, np.random.default_rng(6), np.zeros(2))[0]
    still = msgspec.structs.replace(leg, positions=np.tile(cell.home, (len(leg.joint_times), 1)))
    assert leg_means(still, timing_of(np.zeros(2)), 4) is None
    few = msgspec.structs.replace(
        leg, times=tuple(t[:5] for t in leg.times), pixels=tuple(p[:5] for p in leg.pixels),
        variances=tuple(v[:5] for v in leg.variances),
    )  # fmt: skip
    assert leg_means(few, timing_of(np.zeros(2)), 4) is None
    found = sweep_timing([few], 2)
    assert (found.delays == 0.0).all()
    assert np.isinf(found.deviations).all()


@pytest.mark.parametrize("jitter_s", [0.0, 2e-4, 1e-3])
def test_scatter_of_stamps_is_found_beside_noise_delays_and_accelerations(jitter_s: float) -> None:
    """Its expectation is the mean of ``(jitter · speed)² / variance`` over markers; that of exact stamps is 0."""
    found, expected, count = 0.0, 0.0, 0
    for seed in range(6):
        cell = random_case(seed).cell
        delays = np.array([0.03, 0.012])
        for leg in legs_of(cell, np.random.default_rng([seed, 9]), delays, jitter_s=jitter_s):
            for camera in range(2):
                scatter, frames = stamp_scatter(
                    leg.times[camera], leg.pixels[camera], leg.joint_times, leg.positions[:, leg.trial]
                )
                q = at(leg.times[camera] + delays[camera], leg.joint_times, leg.positions)
                ahead = at(leg.times[camera] + delays[camera] + 1e-3, leg.joint_times, leg.positions)
                speeds = (cell.pixels(ahead)[camera] - cell.pixels(q)[camera]) / 1e-3
                found += frames * scatter
                expected += frames * float(np.median((speeds**2).sum(axis=-1), axis=0).mean()) * (jitter_s / SIGMA) ** 2
                count += frames
    print(f"jitter {1e3 * jitter_s} ms: {found / count:.3f}, expected {expected / count:.3f}, {count} frames")
    if jitter_s:
        assert 0.5 < found / expected < 2.0
    else:
        # Each leg's excess is cut at 0: half of it remains of its deviation 1.66 √(2 / n), over 6 markers or more.
        assert found / count < 0.5 * 1.66 * np.sqrt(2.0 / 5.0) / 6.0
