"""Lenses in the fit: at the floor with strong distortion, none where there is none, honest where left out."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from stereoservo.calibration import self_calibration, stratum_selection
from stereoservo.calibration.bundle_adjustment import solve
from stereoservo.calibration.calibration_result import intrinsics
from stereoservo.calibration.diagnosis.joint_scales import model_scales
from stereoservo.calibration.least_squares import chi2_within
from stereoservo.calibration.lens_estimation import (
    INITIAL_DISTORTIONS,
    epipolar_lenses,
    implausible_lens,
    lens_test,
    lenses_explain_more,
    required_lens_model,
    undistorted,
    undistorted_lenses,
)
from stereoservo.calibration.rig_model import LensPriors, RigModel
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.single_joint_fit import measurements
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.geometry.distortion import distort, lens_from_lines
from stereoservo.kinematics.axes import framed_model
from stereoservo.kinematics.covariance import propagate_covariance
from stereoservo.kinematics.model import ModelFileError, check_model, decode_model, encode_model
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.exact_model import exact_model

MIDDLE = np.array([319.5, 239.5])


def camera_angles(model):
    """Principal points of both cameras [px] and their vergence [°]: (5,)."""
    values, axes = [], []
    for camera in model.cameras:
        euclidean = camera.matrix @ np.linalg.inv(model.projective_to_euclidean)
        values += intrinsics(euclidean)[3:]
        # The third row of K [R | t] is the optical axis.
        axes.append(euclidean[2, :3] / np.linalg.norm(euclidean[2, :3]))
    return np.array([*values, np.degrees(np.arccos(axes[0] @ axes[1]))])


def true_angles(cell):
    axes = cell.poses[:, 2, :3]
    points = [value for K in cell.intrinsics for value in K[:2, 2]]
    return np.array([*points, np.degrees(np.arccos(axes[0] @ axes[1]))])


def wide_angle(k1):
    """Lenses of 75° across, markers all over the images: the distortion leaves no fundamental matrix."""
    K, poses = synthetic.stereo_pair()
    K[:, :2, :2] *= 420 / 800
    cell = synthetic.rx90(1.6 * synthetic.two_faces(), distance=0.75)
    return replace(cell, intrinsics=K, poses=poses).with_k1(k1)


def assert_at_the_floor(result):
    statistics = result.model.statistics
    for group in (*statistics.joints, *result.report.cameras):
        assert abs(group.rms_px - group.expected_px) < 4 * group.standard_error_px
    assert chi2_within(statistics.chi2, statistics.degrees_of_freedom)


CASES = [("rx90", 3), ("offset_wrist", 2), ("gantry_with_wrist", 1), ("wide", 2)]


def check_seeds(name, seeds):
    """Pooled chi-square of principal points and vergence against their reported covariance."""
    chi2 = freedom = 0
    for seed in seeds:
        cell = wide_angle(-0.3) if name == "wide" else getattr(synthetic, name)().with_k1(-0.3)
        # Each case its own noise: the same seed would make them repeat each other.
        rng = np.random.default_rng([seed, [case for case, _ in CASES].index(name)])
        result = fit_model(cell.trials(0.05, rng), epoch=1)
        assert result.model.stratum == "metric"
        assert result.report.lens.model == "radial_centre"
        assert result.report.lens.chi2 > 100 * result.report.lens.limit
        assert_at_the_floor(result)
        values, covariance = propagate_covariance(result.model, camera_angles)
        error = values - true_angles(cell)
        assert (np.abs(error) < 4.5 * np.sqrt(np.diag(covariance))).all(), (seed, error)
        bend = cell.lenses[:, 0] - [camera.lens[0] for camera in result.model.cameras]
        deviations = np.array([camera.lens_std[0] for camera in result.report.cameras])
        assert (np.abs(bend) < 4.5 * deviations).all()
        chi2 += float(error @ np.linalg.solve(covariance, error))
        freedom += len(error)
    print(f"{name}: {chi2:.1f} for {freedom}")
    return chi2, freedom


@pytest.mark.parametrize(("name", "seeds"), [pytest.param(*CASES[0], marks=pytest.mark.slow), *CASES[1:]])
def test_strong_distortion_is_estimated_to_its_covariance(name, seeds):
    assert chi2_within(*check_seeds(name, range(40, 40 + seeds)))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, _ in CASES])
def test_strong_distortion_over_many_seeds(name):
    assert chi2_within(*check_seeds(name, range(1000, 1030)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rx90", "wide"])
def test_strong_distortion_left_out_gives_no_model(name):
    cell = wide_angle(-0.3) if name == "wide" else synthetic.rx90().with_k1(-0.3)
    with pytest.raises(CalibrationError):
        fit_model(cell.trials(0.05, np.random.default_rng(51)), epoch=1, options=FitOptions(lens="none"))


@pytest.mark.parametrize("name", ["gantry_with_wrist", pytest.param("offset_wrist", marks=pytest.mark.slow)])
def test_distortion_that_kinematics_absorb_spoils_the_cameras_and_is_flagged(name):
    """A residual below a tenth of a pixel, principal points 60 px off by dozens of stated deviations: flagged."""
    cell = getattr(synthetic, name)().with_k1(-0.3)
    trials = cell.trials(0.05, np.random.default_rng(51))
    result = fit_model(trials, epoch=1, options=FitOptions(lens="none"))
    assert result.report.rms_px < 0.1
    assert not result.report.chi2_ok
    assert result.report.lens.model == "none"
    assert result.report.lens.chi2 > 50 * result.report.lens.limit
    values, covariance = propagate_covariance(result.model, camera_angles)
    error = np.abs(values - true_angles(cell))
    print(f"{name}: principal points off by {error[:4].max():.1f} px, vergence by {error[4]:.2f} deg")
    assert error[:4].max() > 60.0
    assert (error / np.sqrt(np.diag(covariance))).max() > 20.0


@pytest.mark.parametrize(
    ("name", "sigma", "parameters"), [("rx90", 0.05, 81), ("gantry", 0.2, 61), ("pan_tilt", 0.2, 65)]
)
def test_pinholes_stay_pinholes(name, sigma, parameters):
    result = fit_model(getattr(synthetic, name)().trials(sigma, np.random.default_rng(52)), epoch=1)
    assert result.model.statistics.parameters == parameters
    assert result.report.lens.model == "none"
    assert result.report.lens.chi2 < result.report.lens.limit
    assert result.report.lens.freedom == 2
    for camera in result.model.cameras:
        assert np.array_equal(camera.lens, [0.0, *MIDDLE, 320.0])
    assert [camera.lens for camera in result.report.cameras] == [None, None]


def test_distortion_that_only_the_metric_constraints_tell_from_kinematics(monkeypatch):
    """Too weak to show in the projective bundle, which absorbs it, but enough to spoil a metric one."""
    cell = synthetic.mixed().with_k1(-0.015)
    trials = cell.trials(0.05, np.random.default_rng(53))
    told = []
    whole = stratum_selection.select_stratum

    def watched(solution, data, options):
        told.append((solution.lenses, lens_test(solution).distorted))
        return whole(solution, data, options)

    monkeypatch.setattr("stereoservo.calibration.self_calibration.select_stratum", watched)
    result = fit_model(trials, epoch=1)
    assert told[0] == ("none", False)
    assert [lenses for lenses, _ in told] == ["none", "radial_centre"]
    assert result.report.lens.model == "radial_centre"
    assert result.model.stratum == "metric"
    assert_at_the_floor(result)


def euclidean_start(cell):
    """The cell as a metric rig with its true lenses, by the fit's own measurements at home."""
    points, directions = cell.axes(cell.home)
    twists = np.zeros((len(cell.kinds), 4, 4))
    for T, p, d in zip(twists, points, directions, strict=True):
        T[:3, :3] = [[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]]
        T[:3, 3] = -np.cross(d, p)
    left = cell.poses[0]
    cameras = np.array(
        [K @ (pose @ np.linalg.inv(left))[:3] for K, pose in zip(cell.intrinsics, cell.poses, strict=True)]
    )
    body = np.hstack([cell.body, np.ones((len(cell.body), 1))]) @ cell.flange(cell.home).T @ left.T
    return RigModel(cell.kinds, left @ twists @ np.linalg.inv(left), cameras, body, cell.lenses)


def test_score_and_wald_agree_with_the_likelihood_ratio():
    cell = synthetic.rx90().with_k1(-0.006)
    trials = cell.trials(0.05, np.random.default_rng(54))
    data = measurements(trials, trials.visible, trials.positions - cell.home)
    straight = replace(euclidean_start(cell), lenses=undistorted_lenses(trials))
    without = solve(straight, data, "metric")
    free = solve(straight, data, "metric", lenses="radial")
    gain = without.cost - free.cost
    assert gain > 30.0
    assert lens_test(without).chi2 == pytest.approx(gain, rel=0.05)
    assert lens_test(free).chi2 == pytest.approx(gain, rel=0.05)


def test_a_prior_is_a_measurement():
    """A lens held by a sharp prior stays there, and the prior's residuals count in the cost and the rows."""
    cell = synthetic.rx90().with_k1(-0.1)
    trials = cell.trials(0.05, np.random.default_rng(55))
    held = cell.lenses[:, :3] + [0.002, 0.0, 0.0]
    data = measurements(trials, trials.visible, trials.positions - cell.home)
    sharp = replace(data, lens_priors=LensPriors(held, np.tile(np.diag([1e14, 1e8, 1e8]), (2, 1, 1))))
    free = solve(euclidean_start(cell), data, "metric", lenses="radial_centre")
    fit = solve(euclidean_start(cell), sharp, "metric", lenses="radial_centre")
    assert np.abs(fit.rig.lenses[:, :3] - held).max() < 1e-4
    assert fit.rows == free.rows + 6
    assert fit.cost > free.cost + 10.0
    offset = fit.rig.lenses[:, :3] - held
    prior = float(np.einsum("ci,cij,cj->", offset, sharp.lens_priors.information, offset))
    assert fit.cost == pytest.approx(float(fit.residuals @ fit.residuals) + prior, rel=1e-12)


def test_global_search_finds_each_cameras_lens():
    cell = wide_angle(-0.3)
    cell = replace(cell, lenses=cell.lenses * [[1.0, 1, 1, 1], [0.6, 1, 1, 1]])
    trials = cell.trials(0.05, np.random.default_rng(56))
    pixels = trials.pixels.copy()
    rng = np.random.default_rng(57)
    wrong = rng.random(pixels.shape[:3]) < 0.15
    pixels[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2))
    found = epipolar_lenses(msgspec.structs.replace(trials, pixels=pixels))
    assert np.abs(found[:, 0] - cell.lenses[:, 0]).max() < 0.005
    assert np.array_equal(epipolar_lenses(wide_angle(0.0).trials(0.05, np.random.default_rng(58)))[:, 0], [0, 0])


def test_undistorted_trials_are_what_pinholes_see():
    cell = wide_angle(-0.3)
    trials = cell.trials(0.0, np.random.default_rng(0), stops=3, stated=0.1)
    ideal = undistorted(trials, cell.lenses)
    assert np.abs(ideal.pixels - replace(cell, lenses=undistorted_lenses(trials)).pixels(trials.positions)).max() < 1e-8
    # Half a pixel to all sides: the area that a raw pixel covers.
    corner = trials.pixels[0, 0, 0]
    around = np.array([undistorted_pixel(cell.lenses[0], corner + d) for d in ((1e-3, 0), (0, 1e-3), (0, 0))])
    area = abs(np.linalg.det(around[:2] - around[2])) * 1e6
    assert ideal.sigmas[0, 0, 0] == pytest.approx(0.1 * np.sqrt(area), rel=1e-4)


def undistorted_pixel(lens, raw):
    """Inverse of `distort` by fixed-point iteration."""
    ideal = np.array(raw, dtype=float)
    for _ in range(200):
        ideal += raw - distort(lens, ideal)
    return ideal


def straight_edges(lens, rng, sigma):
    ends = rng.uniform([10, 10], [630, 470], (12, 2, 2))
    along = np.linspace(0, 1, 30)[:, None]
    return [distort(lens, a + (b - a) * along) + rng.normal(0, sigma, (30, 2)) for a, b in ends]


def test_straight_lines_as_priors():
    rng = np.random.default_rng(59)
    cell = synthetic.offset_wrist().with_k1(-0.3)
    trials = cell.trials(0.05, rng)
    priors = {
        f"cam{c}": lens_from_lines(straight_edges(lens, rng, 0.05), 0.05, 640, 480)
        for c, lens in enumerate(cell.lenses)
    }
    alone, helped = fit_model(trials, epoch=1), fit_model(trials, epoch=1, lens_priors=priors)
    assert_at_the_floor(helped)
    for before, after, prior in zip(alone.report.cameras, helped.report.cameras, priors.values(), strict=True):
        assert (np.array(after.lens_std) < np.array(before.lens_std)).all()
        assert (np.array(after.lens_std) < np.sqrt(np.diag(prior.covariance))).all()
    values, covariance = propagate_covariance(helped.model, camera_angles)
    assert (np.abs(values - true_angles(cell)) < 3.5 * np.sqrt(np.diag(covariance))).all()


def test_a_prior_of_an_unknown_camera_is_refused():
    cell = synthetic.mixed()
    lines = straight_edges(cell.with_k1(-0.2).lenses[0], np.random.default_rng(60), 0.05)
    with pytest.raises(CalibrationError, match="cam7") as caught:
        fit_model(
            cell.trials(0.1, np.random.default_rng(61)),
            epoch=1,
            lens_priors={"cam7": lens_from_lines(lines, 0.05, 640, 480)},
        )
    assert caught.value.code == "bad_data"
    assert caught.value.data["unknown"] == ["cam7"]


def brown(cell, positions, k1, k2):
    """Raw pixels (c, s, m, 2) through lenses of two radial terms (OpenCV's) about the principal points."""
    exact = cell.pixels(positions)
    for K, pixels in zip(cell.intrinsics, exact, strict=True):
        x = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
        square = (x**2).sum(axis=-1, keepdims=True)
        pixels += (k1 * square + k2 * square**2) * x * K[[0, 1], [0, 1]]
    return exact


@pytest.mark.parametrize("cause", ["second radial term", "scale of a joint"])
def test_terms_that_the_lens_lacks_and_scales_of_joints_are_distinguished_by_likelihood(cause):
    cell = wide_angle(0.0)
    rng = np.random.default_rng(3)
    trials = cell.trials(0.02, rng, 9)
    positions = trials.positions.copy()
    if cause == "scale of a joint":
        positions[:, 2] = cell.home[2] + 1.01 * (positions[:, 2] - cell.home[2])
        pixels = cell.with_k1(-0.2).pixels(trials.positions)
    else:
        pixels = brown(cell, trials.positions, -0.2, 0.03)
    pixels = pixels + rng.normal(0, 0.02, pixels.shape)
    changed = msgspec.structs.replace(trials, positions=positions, pixels=pixels)
    start = cell.with_k1(-0.2)
    parts = framed_model(exact_model(start))
    rig = RigModel(start.kinds, parts.generators, parts.cameras, parts.points, parts.lenses)
    data = measurements(changed, changed.visible, positions - parts.zero)
    solution = solve(rig, data, "metric", lenses="radial_centre")
    blamed = [scale.joint for scale in model_scales(solution) if scale.wrong]
    assert 2 in blamed or cause != "scale of a joint", model_scales(solution)
    assert lenses_explain_more(solution) == (cause == "second radial term")
    assert required_lens_model(solution) == ("brown" if cause == "second radial term" else "radial_centre")


@pytest.mark.parametrize(
    ("k1", "k2", "sigma"),
    [(-0.3, 0.12, 0.05), pytest.param(-0.35, 0.15, 0.02, marks=pytest.mark.slow), (0.0, 0.0, 0.02)],
)
def test_second_radial_and_tangential_terms_are_estimated_to_their_covariance(k1, k2, sigma):
    """With a radial parameter alone such cells were refused, or their cameras were off by many deviations."""
    cell = wide_angle(0.0)
    lenses = [cell.lens_of(0, k1, k2, 1e-3, -8e-4), cell.lens_of(1, 0.95 * k1, k2, -6e-4, 1e-3)]
    cell = replace(cell, lenses=np.array(lenses))
    result = fit_model(cell.trials(sigma, np.random.default_rng(7), 9), epoch=1)
    assert result.report.lens.model == "brown"
    assert result.report.stratum == "metric"
    assert result.report.lens.chi2 > result.report.lens.limit
    assert_at_the_floor(result)
    values, covariance = propagate_covariance(result.model, camera_angles)
    assert (np.abs(values - true_angles(cell)) < 4.5 * np.sqrt(np.diag(covariance))).all()
    for lens, camera, fitted in zip(cell.lenses, result.model.cameras, result.report.cameras, strict=True):
        assert camera.lens.shape == (7,)
        assert tuple(camera.lens[4:]) == fitted.lens_terms
        assert np.abs(camera.lens[[0, 4]] - lens[[0, 4]])[0] < 4.5 * fitted.lens_std[0]
        assert np.abs(camera.lens[4] - lens[4]) < 4.5 * fitted.lens_terms_std[0]
    again = decode_model(encode_model(result.model))
    assert np.array_equal(again.cameras[1].lens, result.model.cameras[1].lens)
    assert again.covariance.lenses[0].shape == (6, 7)
    left, right = result.model.cameras
    strong = msgspec.structs.replace(left, lens=np.append(left.lens[:6], 50.0))
    short = msgspec.structs.replace(right, lens=right.lens[:4])
    for cameras, match in (((strong, right), "at most"), ((left, short), "shape")):
        wrong = msgspec.structs.replace(result.model, cameras=cameras)
        with pytest.raises(ModelFileError, match=match):
            check_model(wrong)


def test_a_radial_parameter_with_its_centre_suffices_where_it_does():
    result = fit_model(wide_angle(-0.25).trials(0.05, np.random.default_rng(8), 9), epoch=1)
    assert result.report.lens.model == "radial_centre"
    assert result.model.cameras[0].lens.shape == (4,)
    assert result.report.cameras[0].lens_terms is None


def test_a_lens_with_its_centre_outside_of_the_image_is_no_result():
    cell = synthetic.rx90().with_k1(-0.3)
    fit = fit_model(cell.trials(0.05, np.random.default_rng(2), 9), epoch=1)
    assert implausible_lens(fit) is None
    left, right = fit.report.cameras
    for wrong, key in (
        (msgspec.structs.replace(left, lens=(-0.05, -40.0, 200.0)), "centre"),
        (msgspec.structs.replace(left, intrinsics=(800.0, 0.0, 450.0, 320.0, 240.0)), "aspect"),
    ):
        report = msgspec.structs.replace(fit.report, cameras=(wrong, right))
        refused = implausible_lens(msgspec.structs.replace(fit, report=report))
        assert refused.code == "lens_implausible"
        assert key in refused.data


def test_other_lenses_are_tried_before_a_joint_is_blamed(monkeypatch):
    """A first fit that blames a joint's scale, of cameras that distort: a fit from another lens explains the data."""
    cell = wide_angle(-0.25)
    trials = cell.trials(0.05, np.random.default_rng(4), 9)
    whole = self_calibration._fit
    starts = []

    def misled(*arguments):
        bend = arguments[6] if len(arguments) > 6 else None
        starts.append(bend)
        if bend is None:
            raise CalibrationError("residual_above_floor", "a wrong basin")
        return whole(*arguments)

    blamed = CalibrationError("wrong_scale", "joint 'j1' reports 1.003 times its motion")
    monkeypatch.setattr(self_calibration, "_fit", misled)
    monkeypatch.setattr(self_calibration, "diagnose_failure", lambda *_: blamed)
    fit = fit_model(trials, epoch=1)
    assert fit.report.chi2_ok
    assert starts[:2] == [None, INITIAL_DISTORTIONS[0]]
    # Of pinholes nothing is left to a lens: the joint is blamed at once.
    starts.clear()
    with pytest.raises(CalibrationError) as error:
        fit_model(wide_angle(0.0).trials(0.05, np.random.default_rng(4), 9), epoch=1)
    assert error.value is blamed
    assert starts == [None]
