"""The fits' core against SciPy's least squares, closed forms and statistics over seeds."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from stereoservo.calibration.least_squares import (
    DenseFit,
    Limits,
    NormalEquations,
    RobustLoss,
    deviation_of,
    estimate_beside,
    minimise,
    numeric_jacobian,
    with_rows,
)

TRUE = np.array([1.3, 0.7, -0.4])


def decay(rng, *, outliers=0, loss=None, prior=None):
    """A fit of ``a exp(-b t) + c`` to 60 noisy values, and its residuals as a function."""
    t = np.linspace(0.0, 4.0, 60)
    values = TRUE[0] * np.exp(-TRUE[1] * t) + TRUE[2] + rng.normal(0.0, 0.02, 60)
    values[rng.permutation(60)[:outliers]] += 1.0

    def residuals(x):
        return ((x[0] * np.exp(-x[1] * t) + x[2] - values) / 0.02)[:, None]

    def slopes(x):
        e = np.exp(-x[1] * t)
        return np.stack([e, -x[0] * t * e, np.ones_like(t)], axis=1)[:, None] / 0.02

    return DenseFit(residuals, slopes, np.add, loss, prior), residuals


@pytest.mark.parametrize("loss", [None, RobustLoss("cauchy", 3.0), RobustLoss("soft_l1", 2.0)])
@pytest.mark.parametrize("seed", range(4))
def test_a_fit_ends_where_scipys_does(seed, loss):
    rng = np.random.default_rng(seed)
    fit, residuals = decay(rng, outliers=6 if loss else 0, loss=loss)
    start = TRUE + rng.normal(0.0, 0.3, 3)
    found = minimise(fit, start)
    kind = "linear" if loss is None else loss.kind
    scale = 1.0 if loss is None else loss.scale
    expected = least_squares(lambda x: residuals(x).ravel(), TRUE, loss=kind, f_scale=scale, xtol=1e-14)
    assert found.converged
    assert found.cost == pytest.approx(2.0 * expected.cost, rel=1e-7)
    np.testing.assert_allclose(found.state, expected.x, atol=1e-4)


def test_numeric_jacobians_are_the_analytic_ones():
    fit, residuals = decay(np.random.default_rng(1))
    numeric = numeric_jacobian(residuals, np.add, 3, 1e-7)(TRUE)
    np.testing.assert_allclose(numeric, fit.jacobian(TRUE), atol=1e-4)


def test_an_impossible_start_is_no_fit_and_a_step_into_the_impossible_is_not_taken():
    def residuals(x):
        return np.where(x > 0.0, np.log(np.abs(x)) - 1.0, np.nan)[:, None]

    fit = DenseFit(residuals, lambda x: (1.0 / x)[:, None, None], np.add)
    assert minimise(fit, np.array([-1.0])).cost == np.inf
    found = minimise(fit, np.array([30.0]))
    assert found.converged
    np.testing.assert_allclose(found.state, np.e, rtol=1e-6)


def test_a_prior_is_not_weighed_down_and_holds_what_the_data_leave_open():
    known = np.array([0.0, 0.0, 10.0])
    fit, _ = decay(
        np.random.default_rng(2), loss=RobustLoss("cauchy", 3.0),
        prior=lambda x: np.column_stack([np.eye(3), x - known])[2:] / 1e-6,
    )  # fmt: skip
    assert minimise(fit, TRUE).state[2] == pytest.approx(10.0, abs=1e-3)
    open_one = DenseFit(
        lambda x: (x[:1] + x[1:] - 1.0)[:, None], lambda x: np.ones((1, 1, 2)), np.add,
        prior=lambda x: np.column_stack([np.eye(2), x]),
    )  # fmt: skip
    np.testing.assert_allclose(minimise(open_one, np.array([3.0, 7.0])).state, 1.0 / 3.0, atol=1e-8)
    assert open_one.statistics(np.zeros(2)).rank == 2


def test_the_covariance_of_a_fit_is_the_scatter_over_seeds():
    """Squared errors in the stated covariance, and costs, are chi-square."""
    errors = costs = 0.0
    for seed in range(60):
        fit, _ = decay(np.random.default_rng(seed))
        found = minimise(fit, TRUE)
        determined = fit.statistics(found.state)
        off = found.state - TRUE
        errors += off @ np.linalg.solve(determined.covariance / determined.noise, off)
        costs += determined.cost
        assert (determined.rank, determined.freedom) == (3, 57)
    assert chi2.ppf(0.001, 180) < errors < chi2.ppf(0.999, 180)
    assert chi2.ppf(0.001, 60 * 57) < costs < chi2.ppf(0.999, 60 * 57)


def test_open_directions_are_counted():
    rows = np.random.default_rng(3).normal(size=(20, 4))
    rows[:, 3] = 1e6 * (rows[:, 0] - rows[:, 1])
    fit = DenseFit(lambda x: (rows @ x)[:, None], lambda x: rows[:, None], np.add)
    assert fit.statistics(np.zeros(4)).rank == 3


def test_points_are_eliminated_as_if_they_were_not():
    """The damped step by blocks is that of the whole matrix, and predicts what a quadratic cost loses."""
    rng = np.random.default_rng(4)
    m, q, p = 5, 3, 4
    rows = np.zeros((m * 8, p + m * q + 1))
    rows[:, :p], rows[:, -1] = rng.normal(size=(m * 8, p)), rng.normal(size=m * 8)
    for i in range(m):
        rows[8 * i : 8 * i + 8, p + q * i : p + q * i + q] = rng.normal(size=(8, q))
    whole = rows.T @ rows
    core = np.append(np.arange(p), -1)
    points = p + np.arange(m * q).reshape(m, q)
    cost = float(whole[-1, -1])
    equations = NormalEquations(
        whole[np.ix_(core, core)],
        np.array([whole[np.ix_(one, core)] for one in points]),
        np.array([whole[np.ix_(one, one)] for one in points]),
        np.ones(p + m * q),
        cost,
    )
    for damping in (1e-12, 0.3):
        x, expected = equations.step(damping)
        dense = -np.linalg.solve(whole[:-1, :-1] + damping * np.eye(p + m * q), whole[:-1, -1])
        np.testing.assert_allclose(x, dense, atol=1e-10)
        assert cost - ((rows[:, :-1] @ x + rows[:, -1]) ** 2).sum() == pytest.approx(expected, rel=1e-9)


def test_parameters_beside_a_fit_are_those_of_the_larger_fit():
    rng = np.random.default_rng(5)
    rows, beside, error = rng.normal(size=(40, 3)), rng.normal(size=(40, 2)), rng.normal(size=40)
    triangle = np.linalg.qr(np.column_stack([rows, beside, error]), mode="r")
    found = estimate_beside(triangle[3:, 3:])
    both = np.hstack([rows, beside])
    x, left = np.linalg.lstsq(both, -error, rcond=None)[:2]
    np.testing.assert_allclose(found.x, x[3:], atol=1e-12)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(both.T @ both)[3:, 3:], atol=1e-12)
    without = np.linalg.lstsq(rows, -error, rcond=None)[1]
    assert found.gain == pytest.approx(float(without[0] - left[0]))


def test_a_fit_ends_after_its_evaluations():
    fit, _ = decay(np.random.default_rng(6))
    found = minimise(fit, TRUE + 1.0, Limits(evaluations=3))
    assert (found.evaluations, found.converged) == (3, False)


def test_what_a_motion_would_tell_is_what_it_tells():
    rng = np.random.default_rng(7)
    rows, more, slope = rng.normal(size=(30, 4)), rng.normal(size=(10, 4)), rng.normal(size=4)
    known = np.linalg.qr(rows, mode="r")
    for found, all_rows in ((known, rows), (with_rows(known, more), np.vstack([rows, more]))):
        expected = np.sqrt(slope @ np.linalg.inv(all_rows.T @ all_rows) @ slope)
        assert deviation_of(found, slope) == pytest.approx(expected)
