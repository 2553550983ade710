"""Joint zeros reset by a check, over seeds: at their stated deviation, with the covariance that the model then states,
and refused where a reset would not cure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.change.model_check import (
    check_model_holds,
    examine_model,
    make_check_report,
    reset_zeros,
)
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.kinematics.covariance import covariance_axes, displaced_model, propagate_covariance
from stereoservo.kinematics.joint_angles import joint_zeros
from stereoservo.kinematics.joint_reprojection import observed_chain, predicted_pixels
from stereoservo.kinematics.model import CellModel, load_model, save_model
from stereoservo.messages.check_report import ZeroReset
from stereoservo_sim.world.synthetic import SyntheticCell, pan_tilt, rx90

SIGMA = 0.05
TAIL = 1e-3


@cache
def truth(make: Callable[[], SyntheticCell]) -> CellModel:
    """A model of the cell, taken for the truth about it; its covariance says how well another would know it."""
    return fit_model(make().trials(SIGMA, np.random.default_rng(0)), epoch=4).model


def stops_of(cell: SyntheticCell) -> np.ndarray:
    """What the check motion visits: see `core.sources.check`."""
    n = len(cell.kinds)
    steps = 0.5 * np.asarray(cell.ranges) * (np.eye(n) - np.roll(np.eye(n), 1, axis=1))
    return np.vstack([cell.home, cell.home + steps])


def calibrated(exact: CellModel, rng: np.random.Generator) -> CellModel:
    """A model that is off from ``exact`` as its covariance says."""
    axes = covariance_axes(exact)
    found = displaced_model(exact, axes @ rng.standard_normal(axes.shape[1]))
    return msgspec.structs.replace(found, covariance=exact.covariance)


def seen(exact: CellModel, stops: np.ndarray, drift: np.ndarray, rng: np.random.Generator) -> TrialData:
    """A check of the cell that ``exact`` is the truth about, its encoders off by ``drift``."""
    pixels = np.moveaxis(predicted_pixels(observed_chain(exact), stops + drift, exact.marker_points), 1, 0)
    cell = pan_tilt() if exact.tip_first else rx90()
    frame = cell.trials(SIGMA, rng, positions=(stops, np.full(len(stops), -1)))
    return msgspec.structs.replace(
        frame, marker_ids=exact.marker_ids, pixels=pixels + rng.normal(0, SIGMA, pixels.shape),
        sigmas=np.full(pixels.shape[:3], SIGMA),
    )  # fmt: skip


def reset(model: CellModel, data: TrialData) -> tuple[CellModel, ZeroReset]:
    examined = examine_model(model, data)
    return reset_zeros(examined, make_check_report(examined), epoch=5)


def test_one_drifted_zero_is_cured_to_the_noise_floor(tmp_path: Path) -> None:
    cell = rx90()
    model, rng = truth(rx90), np.random.default_rng(1)
    drift = np.array([0, 0, 0.01, 0, 0, 0])
    stops = stops_of(cell)
    data = seen(model, stops, drift, rng)
    cured, told = reset(model, data)
    assert [joint.joint for joint in told.joints] == ["j3"]
    assert told.sigmas_before > 30
    assert told.sigmas_after == pytest.approx(1.0, abs=4 / np.sqrt(2 * 2 * data.visible.sum()))
    assert (cured.epoch, told.from_epoch) == (5, 4)
    assert np.flatnonzero(cured.zero != model.zero).tolist() == [2]
    assert "zeros reset by a check" in cured.source
    assert "j3 by +0.57" in cured.source
    assert "±" in cured.source
    again = check_model_holds(cured, seen(model, stops, drift, rng))
    assert again.status == "holds", again.message
    # Predictions elsewhere, without noise: what is left is the drift's deviation.
    q = cell.held_out(rng, 20)
    exact = predicted_pixels(observed_chain(model), q + drift, model.marker_points)
    left = predicted_pixels(observed_chain(cured), q, cured.marker_points) - exact
    assert np.sqrt(np.mean(left**2)) < SIGMA / 2
    save_model(cured, tmp_path / "m.json")
    assert np.array_equal(load_model(tmp_path / "m.json").zero, cured.zero)


def test_the_zeros_of_all_joints_lost_by_far_are_found_from_nothing() -> None:
    model, rng = truth(rx90), np.random.default_rng(2)
    drift = np.array([0.5, -0.4, 0.3, 0.6, 0.4, -0.5])
    data = seen(model, stops_of(rx90()), drift, rng)
    _, told = reset(model, data)
    assert [joint.joint for joint in told.joints] == list(model.joint_names)
    for joint, true in zip(told.joints, drift, strict=True):
        assert joint.drift == pytest.approx(true, abs=5 * joint.deviation)
        assert joint.zero_after == pytest.approx(joint.zero_before - joint.drift, abs=1e-12)
    assert told.sigmas_after < 1.3
    # The other program for it takes the model for exact: it must agree within what the model leaves open.
    images = np.moveaxis(data.pixels, 0, 1)
    alone = joint_zeros(observed_chain(model), model.marker_points, images[:2], SIGMA, data.positions[:2])
    assert np.abs(alone.offset - [joint.drift for joint in told.joints]).max() < 3e-3


def test_a_wrist_that_is_turned_over_does_not_stand_in_for_lost_zeros() -> None:
    """The stops that are searched show j4 and j6 turned by half a turn, j5 to its other side, just as well, and that is
    nearer to the readings: the others tell."""
    model, drift = truth(rx90), np.array([0.3, -0.2, 0.2, 2.3, -1.0, 2.2])
    for seed in (33, 35, 36):  # the wrist turned over fits the searched stops better by chance
        data = seen(model, stops_of(rx90()), drift, np.random.default_rng(seed))
        _, told = reset(model, data)
        found = {joint.joint: (joint.drift, joint.deviation) for joint in told.joints}
        assert list(found) == list(model.joint_names), seed
        for (zero, deviation), true in zip(found.values(), drift, strict=True):
            assert zero == pytest.approx(true, abs=5 * deviation), seed


@pytest.mark.parametrize("make", [rx90, pan_tilt])
@pytest.mark.parametrize("seeds", [10, pytest.param(25, marks=pytest.mark.slow)])
def test_drifts_and_predictions_have_their_stated_covariance(make: Callable[[], SyntheticCell], seeds: int) -> None:
    """Models that are off as they say, zeros that drift: normalised squared errors over seeds, at 0.1 %."""
    exact, cell = truth(make), make()
    stops, n = stops_of(cell), len(cell.kinds)
    zeros, pixels = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(100 + seed)
        drift = np.zeros(n)
        which = rng.choice(n, min(2, n), replace=False)
        drift[which] = rng.choice([-1, 1], len(which)) * rng.uniform(0.005, 0.05, len(which))
        model = calibrated(exact, rng)
        cured, told = reset(model, seen(exact, stops, drift, rng))
        assert {joint.joint for joint in told.joints} == {exact.joint_names[j] for j in which}
        one = told.joints[0]
        zeros.append((one.drift - drift[exact.joint_names.index(one.joint)]) / one.deviation)
        q = cell.home[None] + rng.uniform(-0.5, 0.5, (1, n)) * np.asarray(cell.ranges)

        def pixel(one: CellModel, q: np.ndarray = q) -> np.ndarray:
            return predicted_pixels(observed_chain(one), q, one.marker_points[:1])[0, 0, 0]

        found, covariance = propagate_covariance(cured, pixel)
        error = found - pixel(exact, q + drift)
        pixels.append(error @ np.linalg.solve(covariance, error))
    low, high = chi2.ppf([TAIL / 2, 1 - TAIL / 2], len(zeros))
    assert low < np.square(zeros).sum() < high, np.square(zeros).mean()
    low, high = chi2.ppf([TAIL / 2, 1 - TAIL / 2], 2 * len(pixels))
    assert low < np.sum(pixels) < high, np.mean(pixels) / 2


def refused(model: CellModel, data: TrialData) -> CalibrationError:
    with pytest.raises(CalibrationError) as caught:
        reset(model, data)
    return caught.value


def test_what_a_reset_does_not_cure_is_refused_with_the_reason() -> None:
    model, cell, rng = truth(rx90), rx90(), np.random.default_rng(3)
    stops = stops_of(cell)
    free = (stops, np.full(len(stops), -1))
    none = np.zeros(6)
    assert refused(model, seen(model, stops, none, rng)).code == "check_holds"
    poses = cell.poses.copy()
    poses[1][:3, 3] += 0.003
    moved = refused(model, replace(cell, poses=poses).trials(SIGMA, rng, positions=free))
    assert moved.code == "other_cause"
    assert "camera cam1 moved" in str(moved)
    noisy = seen(model, stops, none, rng)
    noisy = msgspec.structs.replace(noisy, pixels=noisy.pixels + rng.normal(0, 0.15, noisy.pixels.shape))
    assert refused(model, noisy).code == "other_cause"


def test_a_joint_that_the_stops_do_not_tell_from_another_is_refused() -> None:
    """With the wrist stretched out at every stop the axes of j4 and j6 are one line."""
    model, cell, rng = truth(rx90), rx90(), np.random.default_rng(4)
    stops = stops_of(cell)
    stops[:, 4] = 0.0
    drift = np.array([0, 0, 0, 0.02, 0, 0])
    found = refused(model, seen(model, stops, drift, rng))
    assert found.code == "not_observable"
    assert sorted(found.data["joints"]) == ["j4", "j6"]


def test_a_model_without_covariance_states_that_the_zeros_uncertainty_is_not_carried() -> None:
    bare = msgspec.structs.replace(truth(rx90), covariance=None)
    cured, _ = reset(bare, seen(bare, stops_of(rx90()), 0.01 * np.eye(6)[1], np.random.default_rng(5)))
    assert cured.covariance is None
    assert "not carried" in cured.source
