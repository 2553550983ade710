"""Trials of single joints, driven once or over several distal configurations (5.5, fig. 5.16)."""

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.bundle_adjustment import generator_noise, solve
from stereoservo.calibration.diagnosis.input_corrections import solution_of
from stereoservo.calibration.fit_assessment import assess_fit
from stereoservo.calibration.initial_reconstruction import initial_reconstruction
from stereoservo.calibration.rig_model import Measurements, projective_rig
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.single_joint_fit import (
    best_single_joint,
    fit_single_joint,
    trial_stops,
    virtual_markers,
)
from stereoservo.calibration.stratum_selection import MOST_TIMES
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.geometry.displacements import exp_generator
from stereoservo_sim.world import synthetic

SIGMA = 0.1
TURNS = np.radians([-60, -20, 20, 60])


def turned_stops(cell, count, turns=TURNS):
    """Joint trials, each driven once for each position of the last joint; the last joint's own trial once."""
    positions, index = cell.stops(count)
    last = len(cell.kinds) - 1
    rows, moved = [], []
    for joint in range(last):
        for turn in turns:
            own = positions[index == joint].copy()
            own[:, last] = cell.home[last] + turn
            rows.append(own)
            moved += [joint] * len(own)
    rows.append(positions[index == last])
    moved += [last] * count
    return np.vstack(rows), np.array(moved)


@pytest.fixture(scope="module")
def turned():
    # Mounted askew: a plate at right angles to the last axis would turn in its own plane, and stay in it.
    cell = synthetic.rx90(synthetic.flat_plate() @ synthetic.rotation("y", 40)[:3, :3].T)
    trials = cell.trials(SIGMA, np.random.default_rng(1), positions=turned_stops(cell, 5))
    return cell, trials


def test_stops_are_grouped_by_what_stands_behind_the_joint(turned):
    _, trials = turned
    points = initial_reconstruction(trials)[1]
    for joint in range(5):
        stops, groups, base = trial_stops(trials, points, joint)
        assert set(groups) == {0, 1, 2, 3}
        assert set(stops[np.isin(stops, np.flatnonzero(trials.trials == joint))]) == set(
            np.flatnonzero(trials.trials == joint)
        )
        for group in range(4):
            own = trials.positions[stops[groups == group]]
            assert np.ptp(np.delete(own, joint, axis=1), axis=0).max() < 1e-12
        # The base is a configuration that was driven.
        assert np.abs(trials.positions[stops[groups == 0], 5] - base[5]).max() < 2e-3


def test_virtual_markers_of_a_plate_are_off_one_plane(turned):
    _, trials = turned
    _, points, usable = initial_reconstruction(trials)
    stops, groups, _ = trial_stops(trials, points, 0)
    sights = virtual_markers(trials, points, usable, stops, groups)
    assert sights.points.shape == (len(stops), 16, 4)
    for row, group in enumerate(groups):
        seen = np.isfinite(sights.points[row]).all(axis=1)
        assert set(np.flatnonzero(seen)) == set(range(4 * group, 4 * group + 4))
        assert np.array_equal(sights.points[row, seen], points[stops[row]])
    # One stop's four dots lie on a plane to the noise, the sixteen at one position of the joint do not.
    angles = np.round(trials.positions[stops, 0], 6)
    together = np.nanmean(sights.points[angles == angles[0]], axis=0)
    assert np.isfinite(together).all()
    flat, solid = (np.linalg.svd(rows, compute_uv=False)[3] for rows in (together[:4], together))
    assert solid > 20 * flat


def test_generator_at_the_base_predicts_its_own_trial(turned):
    _, trials = turned
    cameras, points, usable = initial_reconstruction(trials)
    for joint in (0, 3, 5):
        trial = fit_single_joint(trials, cameras, points, usable, joint)
        angles = trials.positions[trial.stops[trial.groups == 0], joint] - trial.base[joint]
        sights = trials.pixels[:, trial.stops[trial.groups == 0]]
        moved = trial.points @ exp_generator("revolute", trial.generator, angles).transpose(0, 2, 1)
        images = np.einsum("cij,smj->csmi", cameras, moved)
        error = images[..., :2] / images[..., 2:] - sights
        assert np.sqrt(np.mean(error**2)) < 2 * SIGMA


def test_a_turned_plate_makes_a_better_model_than_as_many_images_of_a_still_one(turned):
    """Sixteen virtual dots against four, in equally many images: deviations of the projective operators, which the
    thesis estimates first, and of the intrinsics.
    """
    cell, trials = turned
    rich = fit_model(trials, epoch=1)
    still = cell.trials(SIGMA, np.random.default_rng(2), stops=len(trials.positions) // 6 + 1)
    plain = fit_model(still, epoch=1)
    assert rich.model.stratum == "metric"
    assert len(trials.positions) <= len(still.positions)
    noise, of_plain = projective_noise(trials, rich), projective_noise(still, plain)
    assert (noise / of_plain).max() < 0.9
    assert np.mean(noise / of_plain) < 0.7
    assert np.median([single_noise(trials, j) / single_noise(still, j) for j in range(5)]) < 0.7
    deviations, of_still = rich.report.left_intrinsics_std, plain.report.left_intrinsics_std
    assert max(deviations[0] / of_still[0], deviations[2] / of_still[2]) < 0.85
    assert abs(rich.report.cameras[0].intrinsics[0] - cell.intrinsics[0, 0, 0]) < 4 * deviations[0]


def projective_noise(trials, result):
    """Deviations (n,) of the generators' entries in the projective bundle."""
    solution = solution_of(trials, result)
    projective = solve(projective_rig(result.model), solution.data, "projective")
    return generator_noise(projective)


def single_noise(trials, joint):
    """Deviation of the generator's entries from the joint's own trial alone (5.52)."""
    cameras, points, usable = initial_reconstruction(trials)
    stops, groups, base = trial_stops(trials, points, joint)
    sights = virtual_markers(trials, points, usable, stops, groups)
    angles = trials.positions[stops, joint] - base[joint]
    rig, _ = best_single_joint("revolute", cameras, sights, angles)
    camera, stop, marker = np.nonzero(sights.usable)
    pixels, sigmas = sights.pixels[sights.usable], sights.sigmas[sights.usable]
    data = Measurements(angles[:, None], camera, stop, marker, pixels, sigmas)
    return float(generator_noise(solve(rig, data, "projective", cameras=False))[0])


def test_a_joint_that_strays_for_one_stop_is_left_out_not_a_group():
    cell = synthetic.rx90()
    trials = cell.trials(SIGMA, np.random.default_rng(3))
    positions = trials.positions.copy()
    positions[4, 5] += 0.1
    points = initial_reconstruction(trials)[1]
    stops, groups, _ = trial_stops(msgspec.structs.replace(trials, positions=positions), points, 0)
    assert 4 not in stops
    assert set(groups) == {0}


def test_too_few_stops_say_why():
    cell = synthetic.rx90()
    trials = cell.trials(SIGMA, np.random.default_rng(4))
    positions = trials.positions.copy()
    positions[2:9, 4] += np.linspace(0.1, 0.7, 7)
    with pytest.raises(CalibrationError) as caught:
        trial_stops(msgspec.structs.replace(trials, positions=positions), initial_reconstruction(trials)[1], 0)
    assert caught.value.code == "too_few_stops"
    assert caught.value.data["strayed"] >= 5


@pytest.mark.parametrize(("name", "half", "stratum"), [("gantry", 0.003, "affine"), ("mixed", 0.009, "metric")])
def test_strokes_of_millimetres_calibrate_where_the_images_show_them(name, half, stratum):
    cell = getattr(synthetic, name)()
    ranges = np.where([kind == "prismatic" for kind in cell.kinds], half, cell.ranges)
    fit = fit_model(replace(cell, ranges=ranges).trials(0.02, np.random.default_rng(0), 9), epoch=1)
    assert fit.model.stratum == stratum
    assert fit.report.chi2_ok


@pytest.mark.parametrize("seed", [0, 2])
def test_small_turns_in_noise_calibrate_and_the_text_states_what_helps(seed):
    cell = replace(synthetic.rx90(), ranges=np.full(6, np.radians(2.5)))
    fit = fit_model(cell.trials(0.5, np.random.default_rng(seed), 9), epoch=1)
    said = assess_fit(fit.model, fit.report)
    assert said.grade == "usable"
    measure = r"known to (\d+)% only, 10% needed: larger motions, or (many more|\d+ times as many) stops or frames"
    loose = re.findall(measure, said.text)
    assert loose
    for percent, more in loose:
        ratio = float(percent) / 10.0
        if ratio > MOST_TIMES:
            assert more == "many more"
        else:
            assert abs(float(more.split()[0]) - (ratio**2 + 0.5)) <= 0.5 + 0.1 * ratio + 0.0025
    assert "more stops (calibration.stops) or frames at each (calibration.frames) do the same" in said.text


@pytest.mark.parametrize("understated", [1.0, 3.0])
def test_a_joint_that_stands_shows_no_motion_whatever_the_detector_states_of_its_noise(understated):
    cell = synthetic.rx90()
    positions, moved = cell.stops(9)
    still = positions.copy()
    still[moved == 2, 2] = cell.home[2]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        trials = cell.trials(SIGMA, rng, 9)
        pixels = cell.pixels(still) + rng.normal(0, understated * SIGMA, trials.pixels.shape)
        points = np.ones((*trials.pixels.shape[1:3], 4))
        with pytest.raises(CalibrationError, match="more frames at each stop") as error:
            trial_stops(msgspec.structs.replace(trials, pixels=pixels), points, 2)
        assert error.value.code == "joint_without_effect"
        assert error.value.data["motion_sigmas"] < 0.85 * error.value.data["minimum"]
