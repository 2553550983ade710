"""Bundle: predictions against Euclidean truth in random frames, Jacobian against finite differences."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo.calibration.bundle_adjustment import jacobian, solve
from stereoservo.calibration.least_squares import RobustLoss
from stereoservo.calibration.normal_equations import (
    CHUNK,
    arrow_factor,
    by_stop,
    leverages,
    normal_equations,
    prior_rows,
    triangle_of,
)
from stereoservo.calibration.rig_model import (
    LensPriors,
    Measurements,
    RigModel,
    full_charts,
    predicted,
    residuals,
    rig_at,
)


def euclidean_rig(cell):
    """The cell's true twists at home, cameras and markers, in the left camera's frame."""
    points, directions = cell.axes(cell.home)
    twists = np.zeros((len(cell.kinds), 4, 4))
    for T, kind, p, d in zip(twists, cell.kinds, points, directions, strict=True):
        if kind == "revolute":
            T[:3, :3] = [[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]]
            T[:3, 3] = -np.cross(d, p)
        else:
            T[:3, 3] = d
    left = cell.poses[0]
    cameras = np.array(
        [K @ (pose @ np.linalg.inv(left))[:3] for K, pose in zip(cell.intrinsics, cell.poses, strict=True)]
    )
    body = np.hstack([cell.body, np.ones((len(cell.body), 1))]) @ cell.flange(cell.home).T @ left.T
    return RigModel(cell.kinds, left @ twists @ np.linalg.inv(left), cameras, body, cell.lenses)


def seen_from(rig, H):
    """The rig in the frame of ``H`` (4, 4)."""
    back = np.linalg.inv(H)
    return RigModel(rig.kinds, H @ rig.generators @ back, rig.cameras @ back, rig.points @ H.T, rig.lenses)


def measured(cell, positions, rng, sigma=0.1, lost=0.2):
    exact = cell.pixels(positions)
    keep = rng.random(exact.shape[:3]) >= lost
    camera, stop, marker = np.nonzero(keep)
    pixels = exact[keep] + rng.normal(0, sigma, (len(camera), 2))
    return Measurements(positions - cell.home, camera, stop, marker, pixels, np.full(len(camera), sigma)), exact[keep]


def random_frame(stratum, rng):
    if stratum == "metric":
        return np.eye(4)
    H = np.eye(4)
    H[3] = [*rng.normal(0, 0.15, 3), 1.0]
    if stratum == "affine":
        H[3, :3] = 0
    H[:3, :3] += rng.normal(0, 0.1, (3, 3))
    return H


@pytest.mark.parametrize("name", ["rx90", "mixed", "gantry"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=8, deadline=None)
def test_prediction_is_the_euclidean_truth_in_any_frame(arms, name, seed):
    rng = np.random.default_rng(seed)
    cell = arms[name]()
    data, exact = measured(cell, cell.held_out(rng, 5), rng)
    rig = seen_from(euclidean_rig(cell), random_frame("projective", rng))
    assert np.abs(predicted(rig, data) - exact).max() < 1e-8


@pytest.mark.parametrize("stratum", ["projective", "affine", "metric"])
@pytest.mark.parametrize(("name", "lenses"), [("rx90", "radial_centre"), ("mixed", "none"), ("mixed", "radial")])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=4, deadline=None)
def test_jacobian_is_the_derivative(arms, name, lenses, stratum, seed):
    rng = np.random.default_rng(seed)
    cell = arms[name](cameras=3) if name == "rx90" else arms[name]()
    if lenses != "none":
        cell = cell.with_k1(rng.uniform(-0.3, 0.3))
    data, _ = measured(cell, cell.held_out(rng, 3), rng, sigma=1.0)
    rig = seen_from(euclidean_rig(cell), random_frame(stratum, rng))
    charts = full_charts(rig, stratum, lenses=lenses)
    x = rng.normal(0, 0.01, charts.size)
    analytic = jacobian(rig, charts, x, data)
    for k in range(charts.size):
        h = 1e-6
        step = np.zeros(charts.size)
        step[k] = h
        numeric = (residuals(rig_at(rig, charts, x + step), data) - residuals(rig_at(rig, charts, x - step), data)) / (
            2 * h
        )
        assert np.abs(analytic[:, k] - numeric).max() < 2e-6 * max(1.0, np.abs(numeric).max())


@pytest.mark.parametrize(
    ("stratum", "parameters"),
    [("projective", 60 + 7 + 42), ("affine", 48 + 10 + 42), ("metric", 24 + 5 + 10 + 42)],
)
def test_parameters_net_of_gauge_are_all_determined(arms, stratum, parameters):
    rng = np.random.default_rng(3)
    cell = arms["rx90"]()
    data, _ = measured(cell, cell.stops(9)[0], rng)
    rig = seen_from(euclidean_rig(cell), random_frame(stratum, rng))
    fit = solve(rig, data, stratum)
    assert fit.converged
    assert fit.charts.size == parameters
    assert fit.statistics.rank == parameters


@pytest.mark.parametrize("stratum", ["projective", "metric"])
def test_blocks_and_chunks_add_up_to_the_whole_jacobian(arms, stratum):
    """Normal equations with markers eliminated, and the triangle by chunked QR, against dense algebra."""
    rng = np.random.default_rng(5)
    cell = arms["rx90"](cameras=3).with_k1(-0.2)
    data, _ = measured(cell, cell.stops(12)[0], rng)
    shuffled = rng.permutation(len(data.pixels))
    priors = LensPriors(cell.lenses[:, :3] + 0.01, np.tile(np.diag([1e4, 1.0, 0.0]), (3, 1, 1)))
    data = replace(data.select(shuffled), lens_priors=priors)
    assert len(data.pixels) > 2 * CHUNK
    rig = seen_from(euclidean_rig(cell), random_frame(stratum, rng))
    charts = full_charts(rig, stratum, lenses="radial_centre")
    dense = np.vstack(
        [
            np.column_stack([jacobian(rig, charts, np.zeros(charts.size), data), residuals(rig, data)]),
            prior_rows(rig, charts, data),
        ]
    )
    triangle = triangle_of(rig, charts, data)
    sizes = np.linalg.norm(dense, axis=0)
    assert np.abs((triangle.T @ triangle - dense.T @ dense) / np.outer(sizes, sizes)).max() < 1e-12
    J, r = dense[:, :-1] / sizes[:-1], dense[:, -1]
    equations = normal_equations(rig, charts, by_stop(data)[0], None)
    assert np.abs(equations.gradient - J.T @ r).max() < 1e-9 * np.abs(J.T @ r).max()
    step, expected = equations.step(1e-3)
    direct = np.linalg.solve(J.T @ J + 1e-3 * np.eye(charts.size), -J.T @ r)
    assert np.abs(step * sizes[:-1] - direct).max() < 1e-7 * np.abs(direct).max()
    assert expected == pytest.approx(float(r @ r - ((J @ direct + r) ** 2).sum()), rel=1e-7)
    root = np.linalg.inv(triangle[:-1, :-1])
    hat = (dense[: 2 * len(data.pixels), :-1] @ root).reshape(len(data.pixels), 2, -1)
    factor = arrow_factor(rig, charts, data)
    assert np.allclose(leverages(rig, charts, data, factor), (hat**2).sum(axis=(1, 2)), rtol=1e-6)
    # Columns beside, and columns left out: what is then left of the rest is its part across the others.
    more = np.vstack([rng.normal(size=(2 * len(data.pixels), 2)), np.zeros((len(dense) - 2 * len(data.pixels), 2))])
    other = np.column_stack([more, dense[:, -1]])
    q, _ = np.linalg.qr(dense[:, :-1] / sizes[:-1])
    across = other - q @ (q.T @ other)
    last = arrow_factor(rig, charts, data, more[: 2 * len(data.pixels)]).core[-3:, -3:]
    assert np.allclose(last.T @ last, across.T @ across, rtol=1e-9, atol=1e-9 * np.abs(across.T @ across).max())
    lenses = charts.start(2) + np.arange(9)
    kept = np.delete(dense, lenses, axis=1)
    fixed = factor.without(lenses).dense()
    scale = np.outer(np.linalg.norm(kept, axis=0), np.linalg.norm(kept, axis=0))
    assert np.abs((fixed.T @ fixed - kept.T @ kept) / scale).max() < 1e-12


def test_memory_does_not_grow_with_the_images(arms):
    """Peak of a bundle's own arrays over ten times the stops: the data's own size, no (2k, p) Jacobian."""
    cell = arms["mixed"]()
    rig = euclidean_rig(cell)
    peaks = []
    for stops in (40, 400):
        data, _ = measured(cell, cell.stops(stops)[0], np.random.default_rng(6), lost=0.0)
        tracemalloc.start()
        fit = solve(rig, data, "metric")
        assert fit.statistics.rank == fit.charts.size
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    dense = 2 * len(data.pixels) * fit.charts.size * 8
    assert peaks[1] < dense / 2
    assert peaks[1] - peaks[0] < 400 * len(data.pixels)


def test_robust_loss_shrugs_off_outliers(arms):
    rng = np.random.default_rng(4)
    cell = arms["mixed"]()
    data, exact = measured(cell, cell.stops(6)[0], rng, lost=0.0)
    wrong = rng.random(len(data.pixels)) < 0.05
    data.pixels[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2))
    rig = euclidean_rig(cell)
    plain = solve(rig, data, "metric")
    robust = solve(rig, data, "metric", loss=RobustLoss("cauchy", 2.0))
    errors = [np.sqrt(np.mean((predicted(fit.rig, data) - exact) ** 2)) for fit in (plain, robust)]
    assert errors[1] < 0.05 < errors[0]
