"""Errors of the joints that are likely, not proven: tests at their level, deviations that contain them, a verdict that
says so, and parameters that stay."""

import numpy as np
import pytest
from scipy.stats import binom
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.bundle_adjustment import jacobian, with_joint_error_covariance
from stereoservo.calibration.diagnosis.input_corrections import solution_of
from stereoservo.calibration.fit_assessment import assess_fit
from stereoservo.calibration.joint_noise import joint_columns
from stereoservo.calibration.rig_model import JointNoise
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.variance_components import (
    LIKELY,
    SHOWN,
    likely_errors,
    point_optimal_weights,
    readings,
    reduced_rows,
    score_tests,
    weighted_chi2_tail,
)
from stereoservo_sim.experiments.random_rigs import WELL, judged_mechanics
from stereoservo_sim.world import synthetic


@pytest.fixture(scope="module")
def bundle():
    """A small bundle of a perfect arm, converged."""
    trials = synthetic.rx90(synthetic.two_faces()[::3]).trials(0.05, np.random.default_rng(1), 5)
    return solution_of(trials, fit_model(trials, epoch=1))


@pytest.fixture(scope="module")
def rows(bundle):
    return reduced_rows(bundle, readings(bundle.data.offsets))


@pytest.mark.parametrize("freedom", [1, 4, 40])
def test_the_tail_of_equal_weights_is_that_of_chi_square(freedom):
    for probability in (0.9, 0.5, 0.1, 1e-2, 1e-4, 1e-8):
        value = 3.0 * float(chi2_distribution.isf(probability, freedom))
        # The saddlepoint's relative error is largest for one freedom.
        tail = weighted_chi2_tail(value, np.full(freedom, 3.0))
        assert tail == pytest.approx(probability, rel=0.11 / freedom)


def test_the_tail_of_unequal_weights_is_that_of_draws():
    weights = np.array([1.0, 0.5, 0.1, 0.01, 0.0])
    draws = (np.random.default_rng(0).standard_normal((200_000, 5)) ** 2) @ weights
    for value in (0.2, weights.sum(), 3.0, 6.0):
        assert weighted_chi2_tail(value, weights) == pytest.approx(float((draws > value).mean()), rel=0.05)
    assert weighted_chi2_tail(0.0, weights) == 1.0
    assert weighted_chi2_tail(1.0, np.zeros(3)) == 1.0


def test_weights_are_made_for_the_variance_that_they_show():
    """As many errors as a trial has: a few that move much, many that move little. The plain score follows the few,
    and misses errors of the many.
    """
    sizes = np.repeat([10.0, 1.0], [6, 48])
    weights = point_optimal_weights(sizes)
    v = weights / (sizes * (1.0 - weights))
    assert v == pytest.approx(v[0])
    assert v[0] * (weights @ sizes) == pytest.approx(SHOWN * np.sqrt(2.0 * weights @ weights), rel=0.01)
    squares = np.random.default_rng(5).standard_normal((20_000, 54)) ** 2
    power = []
    for chosen in (weights, sizes):
        limit = np.quantile(squares @ chosen, 0.995)
        power.append(float(((squares * np.repeat([1.0, 2.0], [6, 48])) @ chosen > limit).mean()))
    assert power[0] > power[1] + 0.1


def drawn(rows, rng, deviations):
    """The rows with pixels drawn anew, and errors of the joints with these deviations (18,)."""
    columns, component = rows.columns()
    errors = rng.standard_normal(len(component)) * deviations[component]
    pixels = np.linalg.cholesky(rows.pixels) @ rng.standard_normal(len(rows.y))
    return rows._replace(
        y=pixels + columns @ errors,
        squares=float(rng.chisquare(rows.freedom)),
    )


def test_exact_readings_have_likely_errors_no_oftener_than_stated(rows):
    rng, draws = np.random.default_rng(2), 100
    found = [score_tests(drawn(rows, rng, np.zeros(18))) for _ in range(draws)]
    alike = np.array([tests.alike for tests in found])
    likely = sum(tests.chance <= LIKELY for tests in found)
    assert likely <= binom.isf(1e-4, draws, LIKELY)
    for kind in range(3):
        count = int((alike[:, kind] < 0.1).sum())
        assert binom.isf(1 - 1e-4, draws, 0.1) <= count <= binom.isf(1e-4, draws, 0.1)


@pytest.mark.parametrize("kind", [0, 1, 2], ids=["random", "repeatable", "posture"])
def test_errors_that_pixels_bury_are_likely(rows, kind):
    """Errors of a part of the pixels' noise at every stop: all joints alike, which no single joint shows."""
    deviations = np.zeros(18)
    deviations[6 * kind : 6 * kind + 6] = (1.2e-4, 1.2e-4, 2e-3)[kind]
    rng = np.random.default_rng(3)
    found = [score_tests(drawn(rows, rng, deviations)) for _ in range(60)]
    assert sum(tests.chance <= LIKELY for tests in found) >= 48
    assert np.median([tests.alike.argmin() == kind for tests in found]) == 1.0


def test_exact_parameters_scatter_by_the_errors_of_the_joints(bundle):
    """The covariance of ordinary least squares under both noises, against dense matrices."""
    s, n = bundle.data.offsets.shape
    shared = np.where(bundle.data.offsets == 0.0, np.arange(n), -1)
    features = readings(bundle.data.offsets).features
    own, common, giving = 1e-4, 2e-4, np.array([3e-4] * (n - 1) + [0.0])
    noise = JointNoise(np.full((s, n), own), shared, np.full(n, common), features, giving)
    D, stop = joint_columns(bundle.rig, bundle.data), bundle.data.stop.repeat(2)
    V = np.eye(len(D))
    for j in range(n):
        same = stop[:, None] == stop
        both = (shared[stop, j] >= 0)[:, None] & (shared[stop, j] >= 0)
        course = features[stop] @ features[stop].T
        V += np.outer(D[:, j], D[:, j]) * (own**2 * same + common**2 * both + giving[j] ** 2 * course)
    X = jacobian(bundle.rig, bundle.charts, np.zeros(bundle.charts.size), bundle.data)
    pseudo = np.linalg.pinv(X / bundle.statistics.sizes) / bundle.statistics.sizes[:, None]
    expected = pseudo @ V @ pseudo.T
    found = with_joint_error_covariance(bundle, noise).statistics.covariance
    scale = np.sqrt(np.diag(expected))
    assert np.allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-5)
    assert np.trace(found / np.outer(scale, scale)) > 1.2 * np.trace(
        bundle.statistics.covariance / np.outer(scale, scale)
    )


@pytest.mark.parametrize(
    "seed", [10, *(pytest.param(k, marks=pytest.mark.slow) for k in (13, 25, 30, 33, 38, 64, 70, 109))]
)
def test_ellipses_hold_where_errors_are_likely(seed):
    """Ripple, sag and coupling that pixels bury: all were called good, with 49 to 84 % inside the 95 % ellipses, from
    single joints at equal steps or with eight stops of all.
    """
    verdict = judged_mechanics(seed)
    assert verdict.usable
    assert verdict.inside > WELL


def test_likely_errors_leave_the_parameters_and_are_reported():
    """A perfect arm that looks like one with errors, once in hundreds: its model is the one of exact readings."""
    cell, rng = synthetic.rx90(), np.random.default_rng(17)
    positions, index = cell.stops(6)
    free = cell.held_out(rng, 20)
    both = (np.vstack([positions, free]), np.append(index, np.full(20, -1)))
    result = fit_model(cell.trials(0.1, rng, positions=both), epoch=1)
    said = assess_fit(result.model, result.report)
    assert 0.0 < result.report.exact_joints_chance <= LIKELY
    assert said.grade == "usable"
    assert said.reasons[0].startswith("joint readings are likely to have errors")
    assert "Joint readings may have errors, as standard deviations" in said.text
    assert result.model.joint_accuracy is not None
    assert result.model.statistics.chi2 == pytest.approx(result.report.chi2)


def test_nothing_is_likely_of_a_perfect_arm(rows):
    assert likely_errors(rows) == (None, 0.0)
