"""Denavit-Hartenberg rows read out of models, against arms that are known."""

from itertools import combinations

import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.kinematics.denavit_hartenberg import COLUMNS, ReadOutError, denavit_hartenberg
from stereoservo.messages.known_length import KnownLength
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

METRIC_ARMS = (
    synthetic.rx90, synthetic.offset_wrist, synthetic.seven, synthetic.gantry_with_wrist, synthetic.mixed,
    synthetic.pan_tilt,
)  # fmt: skip


def baseline(cell):
    centres = [np.linalg.inv(pose)[:3, 3] for pose in cell.poses]
    return KnownLength("baseline", ("cam0", "cam1"), float(np.linalg.norm(centres[0] - centres[1])))


def numbers(rows):
    return np.array([[getattr(row, column) for column in COLUMNS] for row in rows])


def lines_of_rows(rows, q):
    """Points and directions of the joint axes at ``q``, by multiplying the rows out."""
    T, points, directions = np.eye(4), [], []
    for row, value in zip(rows, q, strict=True):
        points.append(T[:3, 3])
        directions.append(T[:3, 2])
        theta, d = (value + row.theta, row.d) if row.kind == "revolute" else (row.theta, row.scale * value + row.d)
        T = T @ synthetic.rotation("z", np.degrees(theta)) @ synthetic.translation(row.a, 0, d)
        T = T @ synthetic.rotation("x", np.degrees(row.alpha)) @ synthetic.rotation("y", np.degrees(row.beta))
    return np.array(points), np.array(directions)


def invariants(kinds, points, directions):
    """Cosines of all pairs of axes, and the moments of those that have a place: rigid, but no mirror's."""
    pairs = list(combinations(range(len(kinds)), 2))
    cosines = [directions[i] @ directions[j] for i, j in pairs]
    moments = [
        (points[j] - points[i]) @ np.cross(directions[i], directions[j])
        for i, j in pairs
        if kinds[i] == kinds[j] == "revolute"
    ]
    return np.array(cosines + moments)


def assert_rows_are_the_arm(cell, rows, rng):
    for q in cell.home + rng.uniform(-1, 1, (4, len(cell.kinds))):
        np.testing.assert_allclose(
            invariants(cell.kinds, *lines_of_rows(rows, q)), invariants(cell.kinds, *cell.axes(q)), atol=1e-9
        )


def assert_zero_does_not_matter(cell, rows, rng):
    elsewhere = cell.home + rng.uniform(-0.5, 0.5, len(cell.home))
    again = numbers(denavit_hartenberg(exact_model(cell, zero=elsewhere), baseline(cell)))
    difference = again - numbers(rows)
    difference[:, [1, 2, 4]] = np.remainder(difference[:, [1, 2, 4]] + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0, atol=1e-8)


@pytest.mark.parametrize("maker", METRIC_ARMS)
def test_rows_of_exact_models_are_the_arm(maker):
    rng = np.random.default_rng(1)
    cell = maker()
    rows = denavit_hartenberg(exact_model(cell), baseline(cell))
    assert_rows_are_the_arm(cell, rows, rng)
    assert_zero_does_not_matter(cell, rows, rng)


@pytest.mark.parametrize("seed", range(12))
def test_rows_of_random_chains(seed):
    """Skew, meeting and parallel axes, revolute and prismatic, in any order."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 7))
    kinds = (*rng.choice(["revolute", "revolute", "prismatic"], n - 2), "revolute", "revolute")
    links = [
        synthetic.dh_link(
            rng.choice([0, 0.2, rng.uniform(0.1, 0.5)]),
            rng.choice([0, 90, -90, rng.uniform(-170, 170)]),
            rng.choice([0, rng.uniform(-0.3, 0.3)]),
        )
        @ synthetic.rotation("z", rng.uniform(-180, 180))
        for _ in range(n)
    ]
    # Two directions at least, and the last axis apart: else no arm could be metric.
    links[-2] = synthetic.dh_link(0.15, 70, 0.1)
    cell = synthetic.placed(
        kinds, tuple(links), synthetic.two_faces(), rng.uniform(-0.3, 0.3, n), np.full(n, 0.1), np.eye(4)
    )
    rows = denavit_hartenberg(exact_model(cell), baseline(cell))
    assert_rows_are_the_arm(cell, rows, rng)
    assert_zero_does_not_matter(cell, rows, rng)


@pytest.mark.parametrize(
    ("maker", "table"),
    [
        (synthetic.rx90, synthetic.RX90_ROWS),
        (synthetic.offset_wrist, synthetic.OFFSET_ROWS),
        (synthetic.seven, synthetic.SEVEN_ROWS),
    ],
)
def test_rows_are_those_of_the_data_sheet(maker, table):
    """Up to the sense of axes; the offsets of parallel axes come in one sum."""
    cell = maker()
    rows = denavit_hartenberg(exact_model(cell), baseline(cell))
    a, alpha, d = np.array(table, dtype=np.float64).T
    parallel = np.array([row.link == "parallel" for row in rows])
    for j in np.flatnonzero(parallel):
        d[j + 1] += d[j]
        d[j] = 0.0
    found = numbers(rows)
    inner = slice(0, len(rows) - 1)
    np.testing.assert_allclose(np.abs(found[inner, 0]), np.abs(a[inner]), atol=1e-9)
    np.testing.assert_allclose(np.degrees(np.abs(found[inner, 1])), np.abs(alpha[inner]), atol=1e-7)
    np.testing.assert_allclose(np.abs(found[1:-1, 3]), np.abs(d[1:-1]), atol=1e-9)
    assert rows[0].chosen == ("beta", "d", "theta")
    assert rows[-1].chosen == COLUMNS
    assert [row.link == "parallel" for row in rows] == [
        0 < j < len(rows) - 1 and alpha[j] == 0 for j in range(len(rows))
    ]


@pytest.mark.parametrize(
    "known",
    [
        KnownLength("a", ("j2",), 0.2),
        KnownLength("d", ("j3",), 0.1),
        KnownLength("prismatic", ("j1",), 1.0),
        KnownLength("markers", (10, 14), 0.0),
        KnownLength("baseline", ("cam1", "cam0"), 0.0),
    ],
    ids=lambda known: known.what,
)
def test_any_one_known_length_sets_the_scale(known):
    cell = synthetic.mixed()
    metres = {
        "markers": float(np.linalg.norm(cell.body[0] - cell.body[4])),
        "baseline": baseline(cell).metres,
    }.get(known.what, known.metres)
    rows = denavit_hartenberg(exact_model(cell), KnownLength(known.what, known.of, metres))
    expected = denavit_hartenberg(exact_model(cell), baseline(cell))
    np.testing.assert_allclose(numbers(rows), numbers(expected), atol=1e-12)
    assert rows[0].scale == pytest.approx(1.0)
    assert all(row.a_std is None for row in rows)  # exact models carry no covariance
    double = denavit_hartenberg(exact_model(cell), KnownLength(known.what, known.of, 2 * metres))
    np.testing.assert_allclose(numbers(double)[:, [0, 3]], 2 * numbers(expected)[:, [0, 3]], atol=1e-12)
    np.testing.assert_allclose(numbers(double)[:, [1, 2, 4]], numbers(expected)[:, [1, 2, 4]], atol=1e-12)


def test_what_gives_no_rows_is_refused():
    cell = synthetic.rx90()
    model = exact_model(cell)
    for known, code, told in (
        (KnownLength("a", ("j9",), 0.4), "unknown_name", "j1, j2"),
        (KnownLength("prismatic", ("j1",), 0.4), "unknown_name", "none"),
        (KnownLength("markers", (10, 99), 0.4), "unknown_name", "10, 11"),
        (KnownLength("baseline", ("cam0", "cam0"), 0.4), "unknown_name", "cam0, cam1"),
        (KnownLength("a", ("j2",), 0.0), "length", "positive"),
        (KnownLength("a", ("j2",), float("nan")), "length", "positive"),
        (KnownLength("a", ("j6",), 0.4), "length", "zero"),
    ):
        with pytest.raises(ReadOutError, match=told) as caught:
            denavit_hartenberg(model, known)
        assert caught.value.code == code
    with pytest.raises(ReadOutError, match="'affine'") as caught:
        denavit_hartenberg(exact_model(cell, stratum="affine"), baseline(cell))
    assert caught.value.code == "stratum"


@pytest.mark.parametrize("maker", [synthetic.mixed, synthetic.rx90])
def test_errors_over_seeds_are_as_large_as_stated(maker):
    """Squared errors over the stated variances, entry by entry: chi-square over the seeds."""
    cell, seeds = maker(), 8
    known = KnownLength("markers", (10, 17), float(np.linalg.norm(cell.body[0] - cell.body[7])))
    squares = []
    for seed in range(seeds):
        model = fit_model(cell.trials(0.1, np.random.default_rng([seed, 7])), epoch=1).model
        rows = denavit_hartenberg(model, known)
        errors = numbers(rows) - numbers(denavit_hartenberg(exact_model(cell), known))
        errors[:, [1, 4]] = np.remainder(errors[:, [1, 4]] + np.pi, 2 * np.pi) - np.pi
        stds = np.array([[getattr(row, f"{column}_std") for column in COLUMNS] for row in rows])
        measured = np.array([[column not in row.chosen for column in COLUMNS] for row in rows])
        assert (stds[~measured] == 0).all()
        np.testing.assert_allclose(errors[~measured], 0, atol=1e-9)
        squares.append((errors[measured] / stds[measured]) ** 2)
        # Beyond 4.5 sigmas: seven in a million.
        assert squares[-1].max() < 4.5**2
    single = np.sum(squares, axis=0)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], seeds)
    assert (single > low).all()
    assert (single < high).all()
