"""The covariance that a fit reports: efficient, honest, in the model's own frame, for anyone to propagate."""

import json

import msgspec
import numpy as np
import pytest
from scipy.stats import binom
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.calibration_result import intrinsics
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import (
    NoCovarianceError,
    covariance_axes,
    displaced_model,
    propagate_covariance,
    standard_deviations,
)
from stereoservo.kinematics.model import ModelFileError, check_model, decode_model, encode_model
from stereoservo_sim.world import synthetic

ARMS = ("rx90", "offset_wrist", "seven", "gantry_with_wrist", "scara", "gantry", "pan_tilt")
SIGMAS = (0.01, 0.05, 0.2, 1.0)


def raw_pixels(model, positions):
    """Raw pixels (c, s, m, 2) that a model predicts, by the reference chain."""
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, tip_first=model.tip_first)
    points = np.array([model.marker_points @ chain.displacement(q).T for q in positions])
    images = [points @ camera.matrix.T for camera in model.cameras]
    return np.array(
        [
            distort(camera.lens, seen[..., :2] / seen[..., 2:])
            for camera, seen in zip(model.cameras, images, strict=True)
        ]
    )


def normalised_square(model, function, truth):
    """Squared error of gauge-free quantities against their reported covariance, and its freedoms."""
    values, covariance = propagate_covariance(model, function)
    scale = np.sqrt(np.diag(covariance))
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    known = eigenvalues > 1e-9 * eigenvalues[-1]
    errors = vectors[:, known].T @ ((values - truth) / scale)
    return float((errors**2 / eigenvalues[known]).sum()), int(known.sum())


def standardised(group):
    return (group.rms_px - group.expected_px) / group.standard_error_px


def assess(name, sigma, seed):
    """One fit: squared errors of predicted pixels at its own stops, all parameters' worth of them, and rms errors."""
    cell = getattr(synthetic, name)()
    trials = cell.trials(sigma, np.random.default_rng(seed))
    result = fit_model(trials, epoch=1)
    model = result.model
    stops = trials.positions
    root = covariance_axes(model)
    values = raw_pixels(model, stops).ravel()
    slopes = np.empty((len(values), root.shape[1]))
    for k, axis in enumerate(root.T):
        ahead, behind = (raw_pixels(displaced_model(model, step * axis), stops) for step in (0.01, -0.01))
        slopes[:, k] = ((ahead - behind) / 0.02).ravel()
    error = values - cell.pixels(stops).ravel()
    # In these coordinates the reported covariance is the identity.
    x = np.linalg.lstsq(slopes, error, rcond=1e-10)[0]
    statistics = model.statistics
    total = statistics.rms_px / (sigma * np.sqrt(1 - statistics.parameters / statistics.measurements)) - 1
    joints = [standardised(joint) for joint in statistics.joints]
    return {
        "squares": float(x @ x),
        "freedom": statistics.parameters,
        "bound": float((error / sigma) @ (error / sigma)),
        "total": total * np.sqrt(2 * statistics.degrees_of_freedom),
        "joints": joints,
        "cameras": [standardised(camera) for camera in result.report.cameras],
        "lens": result.report.lens.model,
        "stratum": model.stratum,
    }


def assert_efficient(found, share=0.01):
    """Pooled: squared errors by the reported covariance and by the Cramer-Rao bound; residuals at the floor."""
    freedom = sum(fit["freedom"] for fit in found)
    low, high = chi2_distribution.ppf([share / 2, 1 - share / 2], freedom)
    for key in ("squares", "bound"):
        total = sum(fit[key] for fit in found)
        print(f"{key}: {total / freedom:.4f} of {freedom} freedoms, {low / freedom:.4f} to {high / freedom:.4f}")
        assert low < total < high, (key, total / freedom)
    for key in ("total", "joints", "cameras"):
        z = np.concatenate([np.atleast_1d(fit[key]) for fit in found])
        largest = chi2_distribution.isf(0.001 / len(z), 1) ** 0.5
        beyond = int((np.abs(z) > 3).sum())
        print(f"{key}: mean {z.mean():.3f}, deviation {z.std():.3f}, {beyond} of {len(z)} beyond 3")
        assert np.abs(z).max() < largest
        assert abs(z.mean()) < 4 / np.sqrt(len(z))
        # Within three standard errors, but for the 0.27 % of many that chance puts outside.
        assert binom.sf(beyond - 1, len(z), 0.0027) > 0.001


@pytest.mark.parametrize("arms", [ARMS[::2], pytest.param(ARMS, marks=pytest.mark.slow)], ids=["four", "all"])
def test_estimates_are_efficient_and_state_it(arms):
    assert_efficient([assess(name, SIGMAS[k % 4], 300 + k) for k, name in enumerate(arms)], share=0.001)


@pytest.mark.slow
def test_estimates_are_efficient_over_200_seeds():
    found = [assess(ARMS[k % 7], SIGMAS[(k // 7) % 4], 5000 + k) for k in range(200)]
    for name, group in [(name, found[k::7]) for k, name in enumerate(ARMS)]:
        ratio = sum(fit["squares"] for fit in group) / sum(fit["freedom"] for fit in group)
        lenses = sum(fit["lens"] != "none" for fit in group)
        print(f"{name}: {ratio:.4f}, lenses in {lenses} of {len(group)}, {sorted({f['stratum'] for f in group})}")
    assert_efficient(found)


def axis_cosines(model):
    twists = model.projective_to_euclidean @ model.generators @ np.linalg.inv(model.projective_to_euclidean)
    axes = np.stack([twists[:, 2, 1], twists[:, 0, 2], twists[:, 1, 0]], axis=1)[1:]
    return np.array([axes[0] @ axes[1], axes[1] @ axes[2]])


def metric_quantities(model):
    """Intrinsics of the right camera, cosines between axes and a ratio of lengths: no frame, no scale."""
    right = intrinsics(model.cameras[1].matrix @ np.linalg.inv(model.projective_to_euclidean))
    points = model.marker_points @ model.projective_to_euclidean.T
    points = points[:, :3] / points[:, 3:]
    ratio = np.linalg.norm(points[1] - points[0]) / np.linalg.norm(points[9] - points[0])
    return np.array([*right, *axis_cosines(model), ratio])


@pytest.mark.parametrize("fits", [15, pytest.param(30, marks=pytest.mark.slow)])
def test_propagated_is_the_sample_covariance(fits):
    """Fits of one cell: the spread of metric quantities is the one each fit reports."""
    cell = synthetic.mixed()
    values, reported = [], []
    for seed in range(fits):
        model = fit_model(cell.trials(0.1, np.random.default_rng(700 + seed), stops=6), epoch=1).model
        found, covariance = propagate_covariance(model, metric_quantities)
        assert np.allclose(standard_deviations(model, metric_quantities) ** 2, np.diag(covariance))
        values.append(found)
        reported.append(covariance)
    spread, mean = np.cov(np.array(values).T), np.mean(reported, axis=0)
    # A sample variance of n fits has a relative deviation of sqrt(2 / (n - 1)): 26 % of thirty.
    assert np.diag(spread) == pytest.approx(np.diag(mean), rel=3.8 * np.sqrt(2 / (fits - 1)))
    whitened = np.linalg.solve(np.linalg.cholesky(mean), (np.array(values) - np.mean(values, axis=0)).T)
    total, freedom = float((whitened**2).sum()), (fits - 1) * len(mean)
    low, high = chi2_distribution.ppf([0.0005, 0.9995], freedom)
    assert low < total < high


@pytest.fixture(scope="module")
def fitted():
    cell = synthetic.gantry_with_wrist().with_k1(-0.2)
    return fit_model(cell.trials(0.1, np.random.default_rng(701)), epoch=1).model


@pytest.fixture(scope="module")
def carried():
    return fit_model(synthetic.pan_tilt().trials(0.1, np.random.default_rng(702)), epoch=1).model


def test_displaced_models_are_models(fitted):
    rng = np.random.default_rng(703)
    axes = covariance_axes(fitted)
    assert np.allclose(axes @ axes.T, fitted.covariance.covariance, rtol=1e-6)
    moved = displaced_model(fitted, axes @ rng.normal(size=axes.shape[1]))
    check_model(moved)
    assert moved.covariance is None
    assert np.abs(moved.generators - fitted.generators).max() > 1e-7
    assert np.abs(moved.cameras[1].lens - fitted.cameras[1].lens)[:3].min() > 0
    same = displaced_model(fitted, np.zeros(axes.shape[0]))
    assert np.allclose(raw_pixels(same, [fitted.zero]), raw_pixels(fitted, [fitted.zero]), atol=1e-9)
    with pytest.raises(ValueError, match="shape"):
        displaced_model(fitted, np.zeros(3))


def test_covariance_of_cameras_on_the_tip_follows_the_joints(carried):
    """Blocks belong to the joints as the model counts them: predictions there have the noise that is reported."""
    cell = synthetic.pan_tilt()
    held_out = cell.held_out(np.random.default_rng(704), 3)
    square = freedom = 0
    for seed in range(5):
        model = fit_model(cell.trials(0.1, np.random.default_rng(710 + seed)), epoch=1).model
        z, r = normalised_square(
            model,
            lambda m: raw_pixels(m, held_out)[:, :, ::6].ravel(),
            cell.pixels(held_out)[:, :, ::6].ravel(),
        )
        square, freedom = square + z, freedom + r
    low, high = chi2_distribution.ppf([0.0005, 0.9995], freedom)
    assert low < square < high
    assert [len(basis) for basis in carried.covariance.generators] == [4, 4]


def test_covariance_survives_the_file(fitted, carried):
    for model in (fitted, carried):
        again = decode_model(encode_model(model)).covariance
        assert again.covariance.tobytes() == model.covariance.covariance.tobytes()
        for one, two in zip(again.parts, model.covariance.parts, strict=True):
            assert [basis.shape for basis in one] == [basis.shape for basis in two]
            assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    joint = decode_model(encode_model(fitted)).statistics.joints[0]
    assert joint.expected_px == fitted.statistics.joints[0].expected_px


def broken(model, **fields):
    return msgspec.structs.replace(model, covariance=msgspec.structs.replace(model.covariance, **fields))


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        (lambda c: {"covariance": c.covariance[:-1, :-1]}, "covariance.covariance", "is needed"),
        (lambda c: {"covariance": c.covariance * np.nan}, "covariance.covariance", "finite"),
        (lambda c: {"covariance": -c.covariance}, "covariance.covariance", "variance"),
        (
            lambda c: {"covariance": c.covariance * np.triu(np.ones_like(c.covariance))},
            "covariance.covariance",
            "symmetric",
        ),
        (
            # Correlations five times too large, with the opposite sign.
            lambda c: {"covariance": 6 * np.diag(np.diag(c.covariance)) - 5 * c.covariance},
            "covariance.covariance",
            "eigenvalue",
        ),
        (lambda c: {"generators": c.generators[:-1]}, "covariance.generators", "has 5 entries"),
        (
            lambda c: {"markers": (c.markers[0][:, :3], *c.markers[1:])},
            "covariance.markers[0]",
            r"\(p, 4\)",
        ),
        (
            lambda c: {"cameras": (np.full_like(c.cameras[0], np.inf), *c.cameras[1:])},
            "covariance.cameras[0]",
            "finite",
        ),
    ],
)  # fmt: skip
def test_a_covariance_that_does_not_fit_is_refused(fitted, change, key, words):
    with pytest.raises(ModelFileError, match=words) as caught:
        check_model(broken(fitted, **change(fitted.covariance)))
    assert caught.value.key == key


def test_files_without_covariance_are_read_and_state_it(fitted):
    tree = json.loads(encode_model(fitted))
    del tree["covariance"]
    for joint in tree["statistics"]["joints"]:
        del joint["expected_px"], joint["standard_error_px"]
    model = decode_model(json.dumps(tree).encode())
    assert model.covariance is None
    assert standard_deviations(model, axis_cosines) is None
    with pytest.raises(NoCovarianceError):
        propagate_covariance(model, axis_cosines)
