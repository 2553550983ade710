"""Bad input ends in a diagnosis that names the cause, or in a model that predicts truly; never in a plausible lie."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.rig_model import expected_pixels, projective_rig
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo_sim.experiments.robot import thesis_cell, trial_motions
from stereoservo_sim.world import synthetic
from stereoservo_sim.world.synthetic import FIRST_MARKER, flat_plate, placed, translation, two_faces

SIGMA = 0.1


def changed(data, /, **fields):
    return msgspec.structs.replace(data, **fields)


def with_sights(trials, pixels):
    return changed(trials, pixels=pixels)


def refusal(trials):
    """The error of a fit that must not succeed."""
    with pytest.raises(CalibrationError) as caught:
        fit_model(trials, epoch=1)
    assert str(caught.value) == caught.value.message
    return caught.value


def error_rms(model, cell, positions):
    """Rms error [px] of predictions, in ideal circumstances a fraction of the noise."""
    kept = [i - FIRST_MARKER for i in model.marker_ids]
    expected = expected_pixels(projective_rig(model), positions - model.zero)
    return float(np.sqrt(np.mean((expected - cell.pixels(positions)[:, :, kept]) ** 2)))


def assert_true(result, cell, rng, sigma=SIGMA):
    assert error_rms(result.model, cell, cell.held_out(rng, 30)) < 0.6 * sigma


def arm(name, body=None):
    maker = getattr(synthetic, name)
    return maker() if body is None else maker(body)


ARMS = [
    ("rx90", 0),
    pytest.param("offset_wrist", 1, marks=pytest.mark.slow),
    pytest.param("seven", 2, marks=pytest.mark.slow),
]


def cell_and_trials(name, seed, stops=9, body=None):
    cell = arm(name, body)
    rng = np.random.default_rng(1000 + seed)
    return cell, cell.trials(SIGMA, rng, stops), rng


@pytest.mark.parametrize("seed", range(2))
def test_collinear_markers(seed):
    rng = np.random.default_rng(seed)
    body = np.outer(np.linspace(-0.06, 0.06, 5), [0.8, 0.6, 0.1]) + np.array([0.01, 0.0, 0.05])
    error = refusal(arm("rx90", body).trials(SIGMA, rng))
    assert error.code == "markers_collinear"
    assert "line" in error.message


def test_one_marker():
    error = refusal(arm("rx90", two_faces()[:1]).trials(SIGMA, np.random.default_rng(1)))
    assert error.code == "too_few_markers"
    assert error.data["markers"] == 1


def test_a_plate_of_four_dots_works():
    for name, seed in (("rx90", 0), ("offset_wrist", 1)):
        cell, trials, rng = cell_and_trials(name, seed, body=flat_plate())
        assert_true(fit_model(trials, epoch=1), cell, rng, sigma=2 * SIGMA)


@pytest.mark.parametrize(("name", "seed"), ARMS)
@pytest.mark.parametrize("body", [None, "plate"])
def test_ids_exchanged_throughout(name, seed, body):
    """With two cameras, an exchange in one is the same in the other under other names."""
    cell, trials, rng = cell_and_trials(name, seed, body=flat_plate() if body else None)
    a, b = sorted(rng.choice(len(cell.body), 2, replace=False))
    pixels = trials.pixels.copy()
    pixels[1][:, [a, b]] = pixels[1][:, [b, a]]
    error = refusal(with_sights(trials, pixels))
    assert error.code == "markers_exchanged", error.message
    assert error.data["markers"] == [FIRST_MARKER + a, FIRST_MARKER + b]
    assert "cam1" in error.message


@pytest.mark.parametrize(("name", "seed"), ARMS)
def test_ids_exchanged_at_some_stops(name, seed):
    cell, trials, rng = cell_and_trials(name, seed)
    a, b = sorted(rng.choice(len(cell.body), 2, replace=False))
    stops = np.sort(rng.choice(len(trials.positions), 12, replace=False))
    pixels = trials.pixels.copy()
    pixels[1, stops, a], pixels[1, stops, b] = trials.pixels[1, stops, b], trials.pixels[1, stops, a]
    result = fit_model(with_sights(trials, pixels), epoch=1)
    notes = " ".join(result.report.notes)
    assert f"markers {FIRST_MARKER + a} and {FIRST_MARKER + b} are exchanged in camera 'cam1'" in notes
    assert_true(result, cell, rng)


@pytest.mark.parametrize(("name", "seed"), ARMS)
@pytest.mark.parametrize("share", [0.1, 0.4])
def test_views_exchanged_at_some_stops(name, seed, share):
    cell, trials, rng = cell_and_trials(name, seed)
    count = int(share * len(trials.positions))
    stops = np.sort(rng.choice(len(trials.positions), count, replace=False))
    pixels = trials.pixels.copy()
    pixels[:, stops] = pixels[::-1, stops]
    if share > 0.3:
        error = refusal(with_sights(trials, pixels))
        assert error.code == "views_exchanged", error.message
        assert error.data["stops"] == stops.tolist()
        return
    result = fit_model(with_sights(trials, pixels), epoch=1)
    assert any("images of two cameras are exchanged at stop" in note for note in result.report.notes)
    assert_true(result, cell, rng)


def test_views_exchanged_throughout_are_a_naming():
    cell, trials, _ = cell_and_trials("rx90", 3)
    result = fit_model(with_sights(trials, trials.pixels[::-1]), epoch=1)
    swapped = expected_pixels(projective_rig(result.model), trials.positions - result.model.zero)
    assert np.sqrt(np.mean((swapped[::-1] - cell.pixels(trials.positions)) ** 2)) < 0.6 * SIGMA


@pytest.mark.parametrize(("name", "seed"), ARMS)
def test_thirty_percent_of_outliers(name, seed):
    cell, trials, rng = cell_and_trials(name, seed)
    pixels = trials.pixels.copy()
    wrong = rng.random(pixels.shape[:3]) < 0.3
    pixels[wrong] = rng.uniform([0, 0], [640, 480], (int(wrong.sum()), 2))
    result = fit_model(with_sights(trials, pixels), epoch=1)
    assert result.model.statistics.outliers == pytest.approx(wrong.sum(), abs=6)
    assert_true(result, cell, rng, sigma=1.5 * SIGMA)


def test_outliers_without_end_are_refused():
    _, trials, rng = cell_and_trials("rx90", 4)
    pixels = trials.pixels.copy()
    wrong = rng.random(pixels.shape[:3]) < 0.7
    pixels[wrong] = rng.uniform([0, 0], [640, 480], (int(wrong.sum()), 2))
    refusal(with_sights(trials, pixels))


@pytest.mark.parametrize(("name", "seed"), ARMS)
def test_frozen_encoder(name, seed):
    cell, trials, rng = cell_and_trials(name, seed)
    joint = int(rng.integers(len(cell.kinds)))
    own = np.flatnonzero(trials.trials == joint)
    for frozen in (own, own[4:]):
        positions = trials.positions.copy()
        positions[frozen, joint] = positions[frozen[0], joint]
        error = refusal(changed(trials, positions=positions))
        assert error.code == "encoder_frozen"
        assert error.data["joint"] == trials.joint_names[joint]
        assert error.data["stops"] == frozen.tolist()


@pytest.mark.parametrize("reports", [True, False])
def test_joint_that_does_not_move(reports):
    cell, trials, rng = cell_and_trials("rx90", 5)
    positions = trials.positions.copy()
    positions[trials.trials == 2, 2] = cell.home[2]
    pixels = cell.pixels(positions) + rng.normal(0, SIGMA, trials.pixels.shape)
    error = refusal(changed(trials, pixels=pixels, positions=trials.positions if reports else positions))
    assert error.code == ("joint_without_effect" if reports else "joint_did_not_move")
    assert error.data["joint"] == "j3"


@pytest.mark.parametrize(
    ("name", "factors"),
    [
        pytest.param("rx90", {1: 0.9}, marks=pytest.mark.slow),
        pytest.param("rx90", {3: 2.0}, marks=pytest.mark.slow),
        ("offset_wrist", {0: np.degrees(1.0), 4: np.degrees(1.0)}),
        pytest.param("seven", {5: 0.5}, marks=pytest.mark.slow),
        pytest.param("rx90", dict.fromkeys(range(6), 1.1), marks=pytest.mark.slow),
    ],
)
def test_wrong_revolute_scale(name, factors):
    _, trials, _ = cell_and_trials(name, 6, stops=11)
    positions = trials.positions.copy()
    for joint, factor in factors.items():
        positions[:, joint] *= factor
    error = refusal(changed(trials, positions=positions))
    assert error.code == "wrong_scale", error.message
    assert set(error.data["joints"]) == {trials.joint_names[j] for j in factors}
    for joint, factor in factors.items():
        found = error.data["joints"][trials.joint_names[joint]]
        assert abs(found["factor"] - factor) < 4.5 * found["deviation"], (found, factor)
        assert found["deviation"] < 0.02 * factor
        assert ("degrees" in error.message) == (factor > 50)


def test_sign_and_common_prismatic_scale_are_absorbed():
    cell, trials, rng = cell_and_trials("mixed", 7)
    positions = trials.positions * [2.0, -1.0, 1.0, 1.0]
    result = fit_model(changed(trials, positions=positions), epoch=1)
    held_out = cell.held_out(rng, 30)
    expected = expected_pixels(projective_rig(result.model), held_out * [2.0, -1.0, 1.0, 1.0] - result.model.zero)
    assert np.sqrt(np.mean((expected - cell.pixels(held_out)) ** 2)) < 0.6 * SIGMA


def test_prismatic_scales_that_disagree_are_reported():
    _, trials, _ = cell_and_trials("gantry_with_wrist", 8)
    honest = fit_model(trials, epoch=1)
    assert honest.model.stratum == "metric"
    assert not any("reports" in note for note in honest.report.notes)
    positions = trials.positions.copy()
    positions[:, 1] *= 1.1
    result = fit_model(changed(trials, positions=positions), epoch=1)
    told = [note for note in result.report.notes if "joint 'j2' reports" in note]
    assert len(told) == 1
    assert not any("joint 'j3' reports" in note for note in result.report.notes)
    stated, deviation = (float(part) for part in told[0].split("reports ")[1].split(" times")[0].split(" ± "))
    assert abs(stated - 1.1) < 5 * deviation


@pytest.mark.parametrize("stratum", ["scara", "parallel"])
def test_parallel_axes_work(stratum):
    cell, trials, rng = cell_and_trials(stratum, 9)
    result = fit_model(trials, epoch=1)
    assert result.model.stratum == {"scara": "affine", "parallel": "projective"}[stratum]
    assert_true(result, cell, rng)


def test_pure_translation_along_the_optical_axis_works():
    """One prismatic joint, towards the left camera."""
    cell = placed(
        ("prismatic",),
        (np.eye(4),),
        two_faces(),
        np.zeros(1),
        [0.2],
        synthetic.rotation("x", 165),
        distance=1.2,
    )
    to_left = np.linalg.inv(cell.poses[0])
    base = cell.base.copy()
    base[:3, :3] = to_left[:3, :3]  # the joint's z is the left camera's
    flange = np.linalg.inv(base) @ cell.base
    flange[:3, 3] = 0.0
    cell = replace(cell, base=base, links=(flange,))
    rng = np.random.default_rng(10)
    result = fit_model(cell.trials(SIGMA, rng, 15), epoch=1)
    assert_true(result, cell, rng)


@pytest.mark.parametrize("baseline", [0.0, 2e-4])
@pytest.mark.parametrize("body", [None, "plate"])
def test_no_baseline(baseline, body):
    K, poses = synthetic.stereo_pair()
    poses = np.array([synthetic.rotation("y", -4), synthetic.rotation("y", 4) @ translation(-baseline, 0, 0)])
    cell = replace(arm("rx90", flat_plate() if body else None), intrinsics=K, poses=poses, ranges=np.full(6, 0.15))
    error = refusal(cell.trials(SIGMA, np.random.default_rng(11)))
    assert error.code == "no_baseline", error.message
    assert error.data["parallax_sigmas"] < 5


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_two_robots_left_and_right(seed):
    one, other = arm("rx90"), arm("offset_wrist")
    rng = np.random.default_rng(20 + seed)
    trials = one.trials(SIGMA, rng)
    pixels = trials.pixels.copy()
    scaled = other.home + (trials.positions - one.home) * 0.8
    pixels[1] = other.pixels(scaled)[1] + rng.normal(0, SIGMA, pixels[1].shape)
    error = refusal(with_sights(trials, pixels))
    assert error.code == "views_unrelated", error.message


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_half_of_the_trials_from_another_arm(seed):
    one, other = arm("rx90"), arm("offset_wrist")
    # At the same place, with the same body at home, the second half of one arm is as good as the other's.
    other = replace(other, base=translation(0.02, -0.01, 0.05) @ other.base)
    rng = np.random.default_rng(30 + seed)
    trials = one.trials(SIGMA, rng, 9 + seed)
    late = trials.trials >= 3
    pixels = trials.pixels.copy()
    foreign = other.pixels(other.home + (trials.positions - one.home)) + rng.normal(0, SIGMA, pixels.shape)
    pixels[:, late] = foreign[:, late]
    error = refusal(with_sights(trials, pixels))
    assert error.code == "moved_together", error.message
    assert error.data["stop"] == int(np.argmax(late))


@pytest.mark.parametrize(("name", "seed"), ARMS)
@pytest.mark.parametrize("body", [None, "plate"])
def test_marker_that_slips(name, seed, body):
    cell, trials, rng = cell_and_trials(name, seed, body=flat_plate() if body else None)
    marker, stop = int(rng.integers(len(cell.body))), int(rng.integers(6, len(trials.positions) - 6))
    slipped = cell.body.copy()
    slipped[marker] += [0.006, -0.004, 0.0]
    shift = cell.with_body(slipped).pixels(trials.positions) - cell.pixels(trials.positions)
    pixels = trials.pixels.copy()
    pixels[:, stop:] += shift[:, stop:]
    error = refusal(with_sights(trials, pixels))
    assert error.code == "marker_slipped", error.message
    assert error.data["marker"] == FIRST_MARKER + marker
    assert error.data["stop"] == stop


@pytest.mark.parametrize(("name", "seed"), ARMS)
@pytest.mark.parametrize("body", [None, "plate"])
def test_camera_that_is_bumped(name, seed, body):
    cell, trials, rng = cell_and_trials(name, seed, body=flat_plate() if body else None)
    camera, stop = int(rng.integers(2)), int(rng.integers(4, len(trials.positions) - 4))
    poses = cell.poses.copy()
    poses[camera] = synthetic.rotation("y", 0.6) @ synthetic.rotation("x", -0.4) @ poses[camera]
    pixels = trials.pixels.copy()
    bumped = replace(cell, poses=poses).pixels(trials.positions) - cell.pixels(trials.positions)
    pixels[:, stop:] += bumped[:, stop:]
    error = refusal(with_sights(trials, pixels))
    assert error.code == "camera_moved", error.message
    assert error.data["camera"] == f"cam{camera}"
    assert error.data["stop"] == stop


def test_trials_of_exchanged_joints():
    _, trials, _ = cell_and_trials("rx90", 12)
    mixed = trials.trials.copy()
    mixed[trials.trials == 1], mixed[trials.trials == 4] = 4, 1
    error = refusal(changed(trials, trials=mixed))
    assert error.code == "joints_exchanged"
    assert error.data["joint"] == "j2"
    assert error.data["moving"] == "j5"


@pytest.mark.parametrize(("a", "b"), [(1, 2), pytest.param(0, 4, marks=pytest.mark.slow)])
def test_joint_order_is_found_by_free_poses(a, b):
    cell = arm("rx90")
    rng = np.random.default_rng(13)
    positions, index = cell.stops(7)
    both = (np.vstack([positions, cell.held_out(rng, 15)]), np.append(index, np.full(15, -1)))
    trials = cell.trials(SIGMA, rng, positions=both)
    order = np.arange(6)
    order[[a, b]] = b, a
    wrong = changed(
        trials,
        positions=trials.positions[:, order],
        trials=np.where(trials.trials >= 0, np.argsort(order)[trials.trials], -1),
    )
    error = refusal(wrong)
    assert error.code == "joint_order", error.message
    assert set(error.data["joints"]) == {f"j{a + 1}", f"j{b + 1}"}


def test_joint_order_that_the_trials_leave_open_is_stated_to_be_open():
    _, trials, _ = cell_and_trials("mixed", 14)
    assert any("order of the joints" in text for text in fit_model(trials, epoch=1).report.untested)


@pytest.mark.parametrize(("name", "seed"), ARMS)
def test_a_stop_reported_late_is_an_outlier_with_a_name(name, seed):
    cell, trials, rng = cell_and_trials(name, seed, stops=11)
    stop = 11 * int(rng.integers(1, 5)) + 5
    positions = trials.positions.copy()
    positions[stop] = positions[stop - 1]
    result = fit_model(changed(trials, positions=positions), epoch=1)
    told = [note for note in result.report.notes if note.startswith(f"stop {stop} does not fit")]
    assert len(told) == 1
    joint = int(trials.trials[stop])
    near = float(told[0].split("near ")[1].split(" ±")[0])
    assert near == pytest.approx(trials.positions[stop, joint], abs=0.01)
    assert_true(result, cell, rng)


@pytest.mark.parametrize(("joint", "kind"), [(0, "revolute"), pytest.param(2, "prismatic", marks=pytest.mark.slow)])
def test_wrong_kind_is_named(joint, kind):
    _, trials, _ = cell_and_trials("mixed", 15)
    kinds = (*trials.joint_kinds[:joint], kind, *trials.joint_kinds[joint + 1 :])
    error = refusal(changed(trials, joint_kinds=kinds))
    assert error.code == "joint_kind", error.message
    assert error.data == {"joint": f"j{joint + 1}", "kind": trials.joint_kinds[joint]}


@pytest.mark.parametrize("sigma", [0.0, 0.02])
def test_noise_far_below_what_is_stated_is_no_step(sigma):
    cell = thesis_cell()
    trials = cell.trials(sigma, np.random.default_rng(7), positions=trial_motions(cell), stated=0.05)
    result = fit_model(trials, epoch=1)
    assert result.model.stratum == "metric"
    assert error_rms(result.model, cell, cell.held_out(np.random.default_rng(8), 20)) < max(sigma, 1e-6)


@pytest.mark.parametrize(
    ("understated", "bend"), [pytest.param(10.0, 0.0, marks=pytest.mark.slow), (5.0, 0.0), (10.0, -0.3)]
)
def test_understated_noise_is_named_with_the_noise(understated, bend):
    cell, rng = synthetic.rx90().with_k1(bend), np.random.default_rng(3)
    error = refusal(cell.trials(0.05, rng, stated=0.05 / understated))
    assert error.code == "noise_understated"
    assert error.data["factor"] == pytest.approx(understated, rel=0.15)


def test_noise_of_one_camera_understated_is_reported_by_camera():
    cell, rng = synthetic.rx90(), np.random.default_rng(4)
    trials = cell.trials(0.05, rng)
    sigmas = trials.sigmas * np.array([1.0, 0.1])[:, None, None]
    error = refusal(changed(trials, sigmas=sigmas))
    assert error.code == "noise_understated"
    assert error.data["cameras"]["cam1"] > 5.0 * error.data["cameras"]["cam0"]


@pytest.mark.parametrize("shift", [1.0, 8.0])
def test_camera_that_is_bumped_is_not_taken_for_noise(shift):
    trials = synthetic.rx90().trials(0.05, np.random.default_rng(5), stated=0.005)
    pixels = trials.pixels.copy()
    pixels[1, 30:] += shift
    assert refusal(with_sights(trials, pixels)).code == "camera_moved"


@pytest.mark.slow  # in the suite: two joints in degrees, test_wrong_revolute_scale
@pytest.mark.parametrize("factor", [float(np.degrees(1.0)), 1000.0])
def test_all_joints_in_another_unit(factor):
    trials = synthetic.rx90().trials(SIGMA, np.random.default_rng(7))
    error = refusal(changed(trials, positions=factor * trials.positions))
    assert error.code == "wrong_scale"
    for told in error.data["joints"].values():
        assert told["factor"] == pytest.approx(factor, abs=5.0 * told["deviation"])


def test_two_copies_of_one_image_have_no_baseline():
    trials = synthetic.rx90().trials(SIGMA, np.random.default_rng(7))
    assert refusal(with_sights(trials, np.repeat(trials.pixels[:1], 2, axis=0))).code == "no_baseline"


def test_few_pixels_left_are_no_wrong_kind():
    rng = np.random.default_rng(1)
    trials = synthetic.rx90().trials(SIGMA, np.random.default_rng(7))
    pixels = trials.pixels.copy()
    pixels[rng.random(pixels.shape[:3]) < 0.6] = np.nan
    error = refusal(with_sights(trials, pixels))
    assert error.code == "too_few_markers"
    assert error.data["markers"] < error.data["minimum"]


def test_images_of_one_camera_late_by_a_stop():
    trials = synthetic.rx90().trials(SIGMA, np.random.default_rng(7))
    pixels = trials.pixels.copy()
    pixels[1] = np.roll(pixels[1], 1, axis=0)
    error = refusal(with_sights(trials, pixels))
    assert error.code in ("views_unrelated", "views_degenerate")
    assert "late" in error.message or "at another time than the images" in error.message


def test_no_stop_of_any_trial():
    trials = synthetic.rx90().trials(SIGMA, np.random.default_rng(7))
    assert refusal(changed(trials, trials=np.full_like(trials.trials, -1))).code == "too_few_markers"
