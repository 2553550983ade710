"""Self-calibration from trial motions: at the noise floor, efficient, honest about what it cannot know."""

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.least_squares import chi2_within
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import check_model
from stereoservo_sim.world import synthetic


def changed(data, /, **fields):
    return msgspec.structs.replace(data, **fields)


def model_pixels(model, positions):
    """Pixels (c, s, m, 2) that a model predicts, by the reference chain."""
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, tip_first=model.tip_first)
    points = np.array([model.marker_points @ chain.partial_displacements(q)[-1].T for q in positions])
    images = np.einsum("cij,smj->csmi", np.array([camera.matrix for camera in model.cameras]), points)
    return images[..., :2] / images[..., 2:]


def error_rms(model, cell, positions):
    kept = [i - 10 for i in model.marker_ids]
    return np.sqrt(np.mean((model_pixels(model, positions) - cell.pixels(positions)[:, :, kept]) ** 2))


def assert_at_the_floor(result, sigma):
    """The residual rms is sigma sqrt(1 - p/n) within three standard errors."""
    statistics = result.model.statistics
    n, p = statistics.measurements, statistics.parameters
    floor = sigma * np.sqrt(1 - p / n)
    assert abs(statistics.rms_px - floor) < 3 * floor / np.sqrt(2 * (n - p))
    assert statistics.chi2_ok
    assert statistics.degrees_of_freedom == n - p


@pytest.mark.parametrize("sigma", [0.01, 0.1, 1.0])
def test_six_revolute_joints_at_the_noise_floor(arms, sigma):
    rng = np.random.default_rng(11)
    cell = arms["rx90"]()
    stages = []
    result = fit_model(cell.trials(sigma, rng), epoch=7, created="today", progress=lambda name, f: stages.append(f))
    model, report = result.model, result.report
    assert model.stratum == "metric"
    assert model.statistics.parameters == 81
    assert_at_the_floor(result, sigma)
    assert model.statistics.outliers == 0
    assert error_rms(model, cell, cell.held_out(rng, 40)) < 0.35 * sigma
    assert model.epoch == 7
    assert model.created == "today"
    assert stages == sorted(stages)
    assert stages[-1] == 1.0
    # Intrinsics within four of their own standard deviations.
    fx, skew, fy, u0, v0 = report.cameras[0].intrinsics
    off = np.abs(np.array([fx - 800, skew, fy - 795, u0 - 322, v0 - 238.5]))
    assert (off < 4 * np.array(report.left_intrinsics_std)).all()


def test_model_in_the_canonical_frame(arms):
    rng = np.random.default_rng(12)
    cell = arms["rx90"]()
    trials = cell.trials(0.02, rng)
    model = fit_model(trials, epoch=1).model
    check_model(model)
    normaliser = np.array([[1 / 320, 0, -319.5 / 320], [0, 1 / 320, -239.5 / 320], [0, 0, 1]])
    assert np.allclose(model.cameras[0].matrix, np.hstack([np.linalg.inv(normaliser), np.zeros((3, 1))]), atol=1e-9)
    assert np.allclose(model.marker_points @ model.plane_at_infinity, 1.0, atol=1e-12)
    assert (model.marker_points[:, 2] > 0).all()
    assert all((model.marker_points @ camera.matrix[2] > 0).all() for camera in model.cameras)
    # All joints leave the plane at infinity fixed.
    assert np.abs(model.plane_at_infinity @ model.generators).max() < 1e-10
    # Up to one scale, the Euclidean frame of the model is the left camera's.
    points = model.marker_points @ model.projective_to_euclidean.T
    points = points[:, :3] / points[:, 3:]
    body = np.hstack([cell.body, np.ones((14, 1))]) @ (cell.poses[0] @ cell.flange(model.zero)).T
    scale = np.linalg.norm(body[:, :3]) / np.linalg.norm(points)
    assert np.abs(points * scale - body[:, :3]).max() < 2e-3
    twists = model.projective_to_euclidean @ model.generators @ np.linalg.inv(model.projective_to_euclidean)
    _, directions = cell.axes(model.zero)
    axes = np.stack([twists[:, 2, 1], twists[:, 0, 2], twists[:, 1, 0]], axis=1)
    cosines = np.einsum("ni,ni->n", axes, directions @ cell.poses[0][:3, :3].T)
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 0.15


def test_estimates_reach_the_cramer_rao_bound(arms, plate):
    """Noise-free reprojection of the estimates, in sigmas: chi-square with as many freedoms as parameters."""
    sigma, total, freedom, residual, rest = 0.1, 0.0, 0, 0.0, 0
    for seed in range(8):
        cell = arms["rx90"](plate)
        trials = cell.trials(sigma, np.random.default_rng(100 + seed))
        model = fit_model(trials, epoch=1).model
        exact = cell.pixels(trials.positions)
        total += float((((model_pixels(model, trials.positions) - exact) / sigma) ** 2).sum())
        freedom += model.statistics.parameters
        residual += model.statistics.chi2
        rest += model.statistics.degrees_of_freedom
    assert chi2_within(total, freedom), (total, freedom)
    assert chi2_within(residual, rest), (residual, rest)


def test_prediction_uncertainty_is_the_error(arms):
    """The stated deviation of predicted pixels against the true error, over all stops and markers."""
    cell = arms["mixed"]()
    stated, true = [], []
    for seed in range(6):
        trials = cell.trials(0.1, np.random.default_rng(200 + seed))
        result = fit_model(trials, epoch=1)
        stated.append(result.report.prediction_rms_px)
        true.append(error_rms(result.model, cell, trials.positions))
    # 6 x 72 parameters: the mean square has a relative standard deviation of sqrt(2/432) = 7 %.
    assert np.mean(np.square(true)) / np.mean(np.square(stated)) == pytest.approx(1.0, abs=0.25)


def test_flat_plate_of_four_markers(arms, plate):
    """The last joint turns the plate in its own plane: only the metric bundle determines its axis."""
    rng = np.random.default_rng(13)
    cell = arms["rx90"](plate)
    result = fit_model(cell.trials(0.1, rng), epoch=1)
    assert result.model.stratum == "metric"
    assert result.model.statistics.parameters == 51
    assert_at_the_floor(result, 0.1)
    assert error_rms(result.model, cell, cell.held_out(rng, 40)) < 0.06


@pytest.mark.parametrize(
    ("name", "stratum"),
    [("mixed", "metric"), ("gantry", "affine"), ("scara", "affine"), ("parallel", "projective")],
)
def test_stratum_is_what_the_joints_can_tell(arms, name, stratum):
    rng = np.random.default_rng(14)
    cell = arms[name]()
    result = fit_model(cell.trials(0.1, rng), epoch=1)
    model = result.model
    assert model.stratum == stratum
    assert (model.projective_to_euclidean is not None) == (stratum == "metric")
    assert bool(result.report.notes) == (stratum in ("affine", "projective") and name != "gantry")
    assert_at_the_floor(result, 0.1)
    assert error_rms(model, cell, cell.held_out(rng, 40)) < 0.05
    # Heights are kept along orbits: exactly where the plane is identified, to the noise elsewhere.
    drift = np.abs(model.plane_at_infinity @ model.generators @ model.marker_points.T).max()
    assert drift < (1e-9 if stratum != "projective" else 0.02)


def test_three_cameras(arms):
    rng = np.random.default_rng(15)
    cell = arms["rx90"](cameras=3)
    result = fit_model(cell.trials(0.1, rng, stops=6), epoch=1)
    assert result.model.statistics.parameters == 81 + 11
    assert_at_the_floor(result, 0.1)
    assert error_rms(result.model, cell, cell.held_out(rng, 20)) < 0.04


def carrying_the_cameras(cell):
    """The same arm with the rig on its flange before markers that stand still."""
    return synthetic.placed(
        cell.kinds,
        cell.links,
        2.0 * synthetic.two_faces(),
        cell.home,
        0.4 * cell.ranges,
        synthetic.rotation("x", 160) @ synthetic.rotation("y", 20),
        distance=1.6,
        mount="eye_in_hand",
    )


@pytest.mark.parametrize("name", ["pan_tilt", "rx90"])
def test_cameras_on_the_tip(arms, name):
    """The model counts its joints from the base and predicts through the chain with the tip first."""
    rng = np.random.default_rng(24)
    cell = arms[name]() if name == "pan_tilt" else carrying_the_cameras(arms[name]())
    positions, index = cell.stops(9)
    free = cell.held_out(rng, 6)
    trials = cell.trials(0.1, rng, positions=(np.vstack([positions, free]), np.append(index, [-1] * 6)))
    result = fit_model(trials, epoch=1)
    model = result.model
    assert model.mount == "eye_in_hand"
    assert model.stratum == "metric"
    assert model.joint_names == cell.joint_names
    assert [joint.name for joint in model.statistics.joints] == list(cell.joint_names)
    assert [joint.range for joint in model.statistics.joints] == pytest.approx(2 * cell.ranges)
    assert np.array_equal(model.zero, np.median(trials.positions, axis=0))
    assert_at_the_floor(result, 0.1)
    held_out = cell.held_out(rng, 40)
    assert error_rms(model, cell, held_out) < 0.05
    blind = msgspec.structs.replace(model, mount="eye_to_hand")
    assert error_rms(blind, cell, held_out) > 0.15  # the order of the factors does matter


def test_mixed_mounts_are_refused(arms):
    trials = arms["rx90"]().trials(0.1, np.random.default_rng(25), stops=4)
    left, right = trials.cameras
    mixed = (left, msgspec.structs.replace(right, mount="eye_in_hand"))
    with pytest.raises(CalibrationError, match="each on their own") as caught:
        fit_model(changed(trials, cameras=mixed), epoch=1)
    assert caught.value.code == "mixed_mounts"
    assert caught.value.data["mounts"] == {"cam0": "eye_to_hand", "cam1": "eye_in_hand"}


def test_missing_pixels_and_outliers(arms):
    rng = np.random.default_rng(16)
    cell = arms["rx90"]()
    trials = cell.trials(0.1, rng)
    pixels = trials.pixels.copy()
    wrong = rng.random(pixels.shape[:3]) < 0.08
    pixels[wrong] += rng.choice([-1, 1], (int(wrong.sum()), 2)) * rng.uniform(5, 40, (int(wrong.sum()), 2))
    # Two markers mixed up in both cameras at once: epipolar geometry cannot see it where they are.
    pixels[:, 30, [2, 5]] = pixels[:, 30, [5, 2]]
    wrong[:, 30, [2, 5]] = True
    missing = rng.random(pixels.shape[:3]) < 0.2
    pixels[missing] = np.nan
    result = fit_model(changed(trials, pixels=pixels), epoch=1)
    expected = {(f"cam{c}", int(s), 10 + int(m)) for c, s, m in np.argwhere(wrong & ~missing)}
    assert {(o.camera, o.stop, o.marker) for o in result.report.outliers} == expected
    assert_at_the_floor(result, 0.1)
    assert error_rms(result.model, cell, cell.held_out(rng, 40)) < 0.05


def test_free_poses_take_part(arms):
    rng = np.random.default_rng(17)
    cell = arms["rx90"]()
    positions, index = cell.stops(6)
    free = cell.held_out(rng, 20)
    both = (np.vstack([positions, free]), np.append(index, np.full(20, -1)))
    with_free = fit_model(cell.trials(0.1, rng, positions=both), epoch=1)
    without = fit_model(cell.trials(0.1, rng, positions=(positions, index)), epoch=1)
    assert_at_the_floor(with_free, 0.1)
    held_out = cell.held_out(rng, 60)
    assert error_rms(with_free.model, cell, held_out) < error_rms(without.model, cell, held_out)


def test_trials_from_different_bases(arms):
    """Each joint's trial elsewhere: operators are brought to one zero through (5.21)."""
    rng = np.random.default_rng(18)
    cell = arms["rx90"]()
    positions, index = cell.stops(7)
    shifts = rng.uniform(-0.3, 0.3, (6, 6)) * cell.ranges
    for j in range(6):
        shifts[j, j] = 0.0
    result = fit_model(cell.trials(0.1, rng, positions=(positions + shifts[index], index)), epoch=1)
    assert_at_the_floor(result, 0.1)
    assert error_rms(result.model, cell, cell.held_out(rng, 40)) < 0.04


def test_misjudged_sigmas_are_reported(arms):
    rng = np.random.default_rng(19)
    cell = arms["mixed"]()
    trials = cell.trials(0.1, rng)
    for stated, factor in ((0.05, 2.0), (0.2, 0.5)):
        result = fit_model(changed(trials, sigmas=np.full_like(trials.sigmas, stated)), epoch=1)
        assert result.report.sigma_factor == pytest.approx(factor, rel=0.06)
        assert not result.report.chi2_ok
        assert result.model.stratum == "metric"
    with pytest.raises(CalibrationError) as caught:
        fit_model(changed(trials, sigmas=np.full_like(trials.sigmas, 0.02)), epoch=1)
    assert caught.value.code == "noise_understated"
    assert caught.value.data["factor"] == pytest.approx(5.0, rel=0.06)
    assert caught.value.data["sigma_factor"] == pytest.approx(5.0, rel=0.06)
    assert set(caught.value.data["joints"]) == set(trials.joint_names)
    lenient = fit_model(
        changed(trials, sigmas=np.full_like(trials.sigmas, 0.02)),
        epoch=1,
        options=FitOptions(max_sigma_factor=8),
    )
    assert not lenient.report.chi2_ok


def stuck(cell, trials, joint, rng):
    """Pixels of trials in which ``joint`` stayed at home, whatever was reported."""
    positions = trials.positions.copy()
    positions[trials.trials == joint] = cell.home
    return cell.pixels(positions) + rng.normal(0, 0.1, trials.pixels.shape)


def damaged(case, cell, trials, rng):
    pixels, positions = trials.pixels.copy(), trials.positions.copy()
    s = np.arange(len(positions))
    if case == "joint_did_not_move":
        positions[trials.trials == 3] = cell.home
        return changed(trials, positions=positions, pixels=stuck(cell, trials, 3, rng)), {
            "joint": "j4",
            "range": 0.0,
        }
    if case == "joint_without_effect":
        pixels = stuck(cell, trials, 0, rng)
        pixels[0, 3, 4] += 300  # one wrong pixel is no motion
        return changed(trials, pixels=pixels), {"joint": "j1"}
    if case == "too_few_stops":
        pixels[:, np.flatnonzero(trials.trials == 4)[2:]] = np.nan
        return changed(trials, pixels=pixels), {"joint": "j5", "minimum": 4}
    if case == "no trial":
        return changed(trials, trials=np.where(trials.trials == 2, -1, trials.trials)), {
            "joint": "j3",
            "stops": 0,
        }
    if case == "blind camera":
        pixels[1] = np.nan
        return changed(trials, pixels=pixels), {"matches": 0}
    if case == "two markers":
        pixels[:, :, 2:] = np.nan
        return changed(trials, pixels=pixels), {"markers": 2, "minimum": 3}
    if case == "one view twice":
        pixels[1] = pixels[0] + rng.normal(0, 0.1, pixels[0].shape)
        return changed(trials, pixels=pixels), {}
    if case == "noise":
        return changed(trials, pixels=rng.uniform(0, 480, pixels.shape)), {}
    if case == "camera bumped":
        pixels[1, s > 30] += [25.0, 12.0]
        return changed(trials, pixels=pixels), {}
    if case == "wrong positions":
        positions[trials.trials == 1, 4] += 0.05
        return changed(trials, positions=positions), {}
    assert case == "wrong kind"
    return changed(trials, joint_kinds=("revolute",) * 5 + ("prismatic",)), {"joint": "j6"}


@pytest.mark.parametrize(
    ("case", "codes"),
    [
        ("joint_did_not_move", {"joint_did_not_move"}),
        ("joint_without_effect", {"joint_without_effect"}),
        ("too_few_stops", {"too_few_stops"}),
        ("no trial", {"too_few_stops"}),
        ("blind camera", {"too_few_markers"}),
        ("two markers", {"too_few_markers"}),
        ("one view twice", {"no_baseline"}),
        ("noise", {"views_unrelated", "views_degenerate"}),
        ("camera bumped", {"camera_moved"}),
        ("wrong positions", {"too_many_outliers", "residual_above_floor", "no_convergence"}),
        ("wrong kind", {"joint_kind", "too_many_outliers", "residual_above_floor"}),
    ],
)  # fmt: skip
def test_bad_trials_are_refused_with_the_cause(arms, case, codes):
    rng = np.random.default_rng(20)
    cell = arms["rx90"]()
    trials, data = damaged(case, cell, cell.trials(0.1, rng, stops=7), rng)
    with pytest.raises(CalibrationError) as caught:
        fit_model(trials, epoch=1)
    error = caught.value
    assert error.code in codes, str(error)
    assert str(error) == error.message
    for key, value in data.items():
        assert error.data[key] == value
    if "joint" in data:
        assert repr(data["joint"]) in str(error)


def test_points_of_one_plane_are_refused(arms, plate):
    """Three parallel axes and a flat target normal to them: the whole scene is one plane."""
    cell = arms["parallel"](plate)
    with pytest.raises(CalibrationError, match="plane") as caught:
        fit_model(cell.trials(0.1, np.random.default_rng(21)), epoch=1)
    assert caught.value.code == "views_degenerate"


def test_axis_that_a_flat_target_cannot_show_is_refused(arms, plate):
    """Parallel axes with a lift: affine at most. The last joint turns the plate in its plane: its axis
    stays open.
    """
    cell = arms["scara"](plate)
    with pytest.raises(CalibrationError) as caught:
        fit_model(cell.trials(0.1, np.random.default_rng(23)), epoch=1)
    assert caught.value.code == "not_identifiable"


def test_lens_distortion_is_not_passed_off_as_a_good_fit(arms):
    rng = np.random.default_rng(22)
    cell = arms["rx90"]()
    trials = cell.trials(0.05, rng)
    rays = (trials.pixels - [320, 240]) / 800
    bent = trials.pixels + 800 * rays * (-0.03) * (rays**2).sum(axis=-1, keepdims=True)
    result = fit_model(changed(trials, pixels=bent), epoch=1, options=FitOptions(lens="none"))
    assert not result.report.chi2_ok
    assert any("lens distortion" in note for note in result.report.notes)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rx90", "plate", "mixed"])
@pytest.mark.parametrize("sigma", [0.01, 0.1, 0.5])
def test_many_seeds_pooled(arms, plate, name, sigma):
    """60 seeds: pooled chi-square of residuals and estimates, and the rate of chi2_ok (99.9 %)."""
    residual = estimate = rest = freedom = ok = 0
    for seed in range(60):
        cell = arms["rx90"](plate) if name == "plate" else arms[name]()
        trials = cell.trials(sigma, np.random.default_rng(1000 + seed))
        result = fit_model(trials, epoch=1)
        assert result.model.stratum == "metric", (seed, result.report.notes)
        statistics = result.model.statistics
        ok += statistics.chi2_ok
        residual += statistics.chi2
        rest += statistics.degrees_of_freedom
        error = (model_pixels(result.model, trials.positions) - cell.pixels(trials.positions)) / sigma
        estimate += float((error**2).sum())
        freedom += statistics.parameters
    print(f"{name} {sigma}: residual {residual / rest:.4f}, estimate {estimate / freedom:.4f}, ok {ok}/60")
    assert ok >= 59
    assert chi2_within(residual, rest)
    assert chi2.sf(estimate, freedom) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gantry", "scara", "parallel"])
@pytest.mark.parametrize("sigma", [0.01, 0.1, 1.0])
def test_no_stratum_is_claimed_that_is_not_there(arms, name, sigma):
    claimed = []
    for seed in range(30):
        cell = arms[name]()
        result = fit_model(cell.trials(sigma, np.random.default_rng(2000 + seed)), epoch=1)
        assert result.report.chi2_ok
        claimed.append(result.model.stratum)
    assert set(claimed) <= {"projective"} | ({"affine"} if name != "parallel" else set())
