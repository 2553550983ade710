"""Joint angles from images of synthetic cells whose calibration is perfect, in a random projective frame."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.kinematics.joint_angles import (
    homing_displacement,
    homing_problem,
    joint_zeros,
    measured_joints,
    sensitivity,
)
from stereoservo.kinematics.joint_reprojection import (
    JointAnglesError,
    ObservedChain,
    joint_problem,
    pinhole_lenses,
    predicted_pixels,
    reconstruct_points,
)
from stereoservo_sim.world import synthetic

CELLS = {
    "rx90": synthetic.rx90,
    "7R": synthetic.seven,
    "scara": synthetic.scara,
    "3P3R": synthetic.gantry_with_wrist,
    "pan-tilt": synthetic.pan_tilt,
    "pan-tilt, bent lenses": lambda: synthetic.pan_tilt().with_k1(-0.3),
}


def limits_of(cell, wide=1.0):
    revolute = np.array([kind == "revolute" for kind in cell.kinds])
    half = np.where(revolute, np.pi, 3 * cell.ranges) * wide
    return cell.home[:, None] + half[:, None] * [-1, 1]


def apart(q, other, cell):
    revolute = np.array([kind == "revolute" for kind in cell.kinds])
    return np.where(revolute, np.mod(q - other + np.pi, 2 * np.pi) - np.pi, q - other)


@pytest.mark.parametrize("name", CELLS)
def test_projection_and_its_derivatives_are_those_of_the_cell(name, perfect_calibration):
    cell = CELLS[name]()
    seen, points = perfect_calibration(cell, 1)
    rng = np.random.default_rng(2)
    q = cell.held_out(rng, 3)
    assert np.abs(predicted_pixels(seen, q, points).swapaxes(0, 1) - cell.pixels(q)).max() < 1e-6
    H, slopes = seen.displacements(q)
    for s in range(3):
        assert np.allclose(H[s], seen.chain.displacement(q[s]))
        expected = seen.chain.point_jacobian(q[s], points @ H[s].T)
        assert np.allclose(np.einsum("njk,mk->mjn", slopes[s], points), expected)


@pytest.mark.parametrize("spread", [None, 1e-5])
@pytest.mark.parametrize("rays", [False, True])
def test_derivatives_of_the_residuals(spread, rays, perfect_calibration):
    cell = synthetic.pan_tilt().with_k1(-0.2)
    seen, points = perfect_calibration(cell, 3)
    rng = np.random.default_rng(3)
    offsets = np.array([[0.0, 0.0], [0.02, -0.05]])
    pixels = np.moveaxis(cell.pixels(cell.home + np.array([0.05, -0.04]) + offsets), 0, 1)
    pixels[1, 0, 2] = np.nan
    covariance = None if spread is None else np.tile(spread**2 * np.diag([1.0, 2, 0, 1]), (len(points), 1, 1))
    problem = joint_problem(seen, points, pixels, 0.3, offsets=offsets, point_covariance=covariance)
    assert problem.measurements == 2 * (2 * 2 * len(points) - 1)
    q, h = cell.home + 0.01 * rng.normal(size=2) + [0.05, -0.04], 1e-6
    ask = problem.linearise_rays if rays else problem.linearise
    slope = ask(q[None])[1][0]
    for j, unit in enumerate(np.eye(2)):
        ahead, behind = ask((q + h * unit)[None])[0], ask((q - h * unit)[None])[0]
        # With uncertain points the whitening moves, too: a small share of the residual.
        slack = 1e-6 if spread is None or rays else 0.03
        assert np.abs((ahead - behind)[0] / (2 * h) - slope[:, j]).max() < slack * np.abs(slope).max()


@pytest.mark.parametrize("name", [name for name in CELLS if name != "7R"])
def test_joint_angles_are_found_from_nothing(name, perfect_calibration):
    cell = CELLS[name]()
    seen, points = perfect_calibration(cell, 4)
    n = len(cell.kinds)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        q = cell.held_out(rng, 1)
        pixels = cell.pixels(q)[:, 0] + rng.normal(0, 0.2, (len(cell.poses), len(points), 2))
        problem = joint_problem(seen, points, pixels, 0.2)
        found = measured_joints(problem, limits=limits_of(cell), largest_deviation=0.5)
        # A flipped wrist or elbow explains the pixels as well; the true one is among what is told, once.
        errors = [apart(angles.q, q[0], cell) for angles in found]
        squares = [e @ np.linalg.solve(a.covariance, e) for a, e in zip(found, errors, strict=True)]
        assert sum(square < chi2.isf(1e-4, n) for square in squares) == 1
        assert found[0].cost < chi2.isf(1e-4, found[0].freedom)
        assert found[0].freedom == 2 * len(cell.poses) * len(points) - n


def test_the_self_motion_of_seven_joints_is_named(perfect_calibration):
    cell = synthetic.seven()
    seen, points = perfect_calibration(cell, 4)
    pixels = cell.pixels(cell.home[None])[:, 0]
    with pytest.raises(JointAnglesError, match="do not determine joint") as error:
        measured_joints(joint_problem(seen, points, pixels, 0.2), limits=limits_of(cell))
    assert error.value.code == "not_observable"
    assert {"j1", "j3", "j5"} <= set(error.value.data["joints"])
    # The elbow turns about the line from shoulder to wrist: the bend of the arm itself is seen.
    assert "j4" not in error.value.data["joints"]


def test_all_eight_configurations_of_a_wrist_arm_are_distinguished(perfect_calibration):
    """Shoulder, elbow and wrist, two ways each: an arm with a spherical wrist reaches a pose in eight ways."""
    cell = synthetic.rx90()
    seen, points = perfect_calibration(cell, 5)
    pixels = cell.pixels(cell.home[None])[:, 0]
    found = measured_joints(joint_problem(seen, points, pixels, 0.2), limits=limits_of(cell))
    assert len(found) == 8
    for i, angles in enumerate(found):
        assert np.abs(cell.pixels(angles.q[None])[:, 0] - pixels).max() < 1e-6
        assert all(np.abs(apart(angles.q, other.q, cell)).max() > 0.1 for other in found[:i])
    flipped = cell.home + np.array([0, 0, 0, -np.pi, -2 * cell.home[4], np.pi])
    for q in (cell.home, flipped):
        assert min(np.abs(apart(angles.q, q, cell)).max() for angles in found) < 1e-7


def test_reported_covariance_is_the_bound_and_is_reached(perfect_calibration):
    """Normalised squared errors over 200 seeds, exact and uncertain points: chi-square at 1 %."""
    cell = synthetic.pan_tilt()
    seen, points = perfect_calibration(cell, 6)
    totals = {"exact points": 0.0, "home image": 0.0}
    runs = 200
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        q = cell.held_out(rng, 1)[0]
        pixels, home = (cell.pixels(p[None])[:, 0, :2] + rng.normal(0, 0.3, (2, 2, 2)) for p in (q, cell.home))
        angles = measured_joints(joint_problem(seen, points[:2], pixels, 0.3), start=cell.home)[0]
        totals["exact points"] += (angles.q - q) @ np.linalg.solve(angles.covariance, angles.q - q)
        way = homing_displacement(homing_problem(seen, cell.home, home, pixels, 0.3), cell.home, start=cell.home)
        error = way.displacement - (cell.home - q)
        totals["home image"] += error @ np.linalg.solve(way.covariance, error)
    low, high = chi2.ppf([0.005, 0.995], 2 * runs)
    for name, total in totals.items():
        assert low < total < high, (name, total / (2 * runs))


def test_uncertain_points_give_the_covariance_of_the_joint_fit(perfect_calibration):
    """Marginalised points against free ones: the inverse of the full information matrix of joints and points."""
    cell = synthetic.pan_tilt()
    seen, points = perfect_calibration(cell, 7)
    q = cell.home + np.array([0.1, -0.05])
    images = cell.pixels(np.array([cell.home, q]))
    home, now = images[:, 0, :1], images[:, 1, :1]
    found = homing_displacement(homing_problem(seen, cell.home, home, now, 0.3), cell.home, start=cell.home)

    def both(x):
        point = points[:1] + np.array([[x[2], x[3], 0, x[4]]])
        return predicted_pixels(seen, np.array([cell.home, q + x[:2]]), point).ravel() / 0.3

    h = 1e-6
    J = np.array([(both(h * e) - both(-h * e)) / (2 * h) for e in np.eye(5)]).T
    expected = np.linalg.inv(J.T @ J)[:2, :2]
    assert np.allclose(found.covariance, expected, rtol=1e-4)
    assert np.allclose(found.displacement, cell.home - q, atol=1e-8)
    assert found.current.freedom == 2


def test_one_camera_and_one_point_may_leave_several_answers(perfect_calibration):
    """Two numbers for two joints: every solution of the two equations is told, each exact."""
    cell = synthetic.pan_tilt()
    seen, points = perfect_calibration(cell, 8)
    one = ObservedChain(seen.chain, seen.cameras[:1], seen.lenses[:1], seen.joint_names)
    q = cell.home + np.array([0.05, 0.06])
    pixels = cell.pixels(q[None])[:1, 0, :1]
    found = measured_joints(joint_problem(one, points[:1], pixels, 0.3))
    assert min(np.abs(a.q - q).max() for a in found) < 1e-6
    for angles in found:
        assert np.abs(predicted_pixels(one, angles.q[None], points[:1])[0] - pixels).max() < 1e-4
        assert angles.freedom == 0
    assert len({tuple(np.round(a.q, 4)) for a in found}) == len(found)


def test_pixels_of_something_else_are_refused(perfect_calibration):
    cell = synthetic.rx90()
    seen, points = perfect_calibration(cell, 9)
    pixels = cell.pixels(cell.home[None])[:, 0]
    mixed = np.random.default_rng(9).permutation(len(points))
    with pytest.raises(JointAnglesError, match="times the stated noise") as error:
        measured_joints(joint_problem(seen, points[mixed], pixels, 0.2))
    assert error.value.code == "no_agreement"
    assert error.value.data["sigma_factor"] > 3
    with pytest.raises(JointAnglesError) as error:
        measured_joints(joint_problem(seen, points, pixels, 0.2), limits=cell.home[:, None] + [0.5, 0.9])
    assert error.value.code in ("outside_limits", "no_agreement")


def test_questions_that_make_no_sense_are_refused(perfect_calibration):
    cell = synthetic.gantry()
    seen, points = perfect_calibration(cell, 10)
    pixels = cell.pixels(cell.home[None])[:, 0]
    problem = joint_problem(seen, points, pixels, 0.2)
    with pytest.raises(JointAnglesError, match="prismatic") as error:
        measured_joints(problem)
    assert error.value.data["joints"] == ["j1", "j2", "j3"]
    with pytest.raises(JointAnglesError, match="pairs"):
        measured_joints(problem, limits=np.array([[1.0, 0.0]] * 3))
    few = np.full_like(pixels, np.nan)
    few[0, 0] = pixels[0, 0]
    with pytest.raises(JointAnglesError, match="2 pixel coordinates for 3 joints"):
        measured_joints(joint_problem(seen, points, few, 0.2), limits=limits_of(cell))
    for wrong in (pixels[:, :3], pixels[:1]):
        with pytest.raises(JointAnglesError, match="do not fit"):
            joint_problem(seen, points, wrong, 0.2)
    with pytest.raises(JointAnglesError, match="positive"):
        joint_problem(seen, points, pixels, 0.0)
    with pytest.raises(JointAnglesError, match="no pixel"):
        joint_problem(seen, points, np.full_like(pixels, np.nan), 0.2)
    with pytest.raises(JointAnglesError, match="two cameras"):
        homing_problem(seen, cell.home, few, pixels, 0.2)
    with pytest.raises(JointAnglesError, match="names"):
        ObservedChain(seen.chain, seen.cameras, pinhole_lenses(1), seen.joint_names)


def test_encoder_zeros_are_reset_at_their_stated_deviation(perfect_calibration):
    """Offsets of a turned-on arm over 60 seeds: chi-square of the normalised errors at 1 %."""
    cell = synthetic.rx90()
    seen, points = perfect_calibration(cell, 11)
    total, runs = 0.0, 60
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        q = cell.held_out(rng, 2)
        offset = rng.uniform(-0.4, 0.4, 6)
        pixels = np.moveaxis(cell.pixels(q), 0, 1)
        pixels = pixels + rng.normal(0, 0.2, pixels.shape)
        if seed < 5:
            found = joint_zeros(seen, points, pixels, 0.2, q - offset, limits=np.array([[-0.5, 0.5]] * 6))
        else:  # the search itself is tested above; here its end counts
            problem = joint_problem(seen, points, pixels, 0.2, offsets=q - offset)
            angles = measured_joints(problem, start=offset + 0.01)[0]
            found = replace(found, offset=angles.q, covariance=angles.covariance)
        error = found.offset - offset
        total += error @ np.linalg.solve(found.covariance, error)
    low, high = chi2.ppf([0.005, 0.995], 6 * runs)
    assert low < total < high, total / (6 * runs)


def test_zeros_that_the_images_do_not_show_are_refused_by_name(perfect_calibration):
    cell = synthetic.rx90()
    # One marker on the axis of the last joint: it stands still when j6 turns.
    cell = cell.with_body([[0.0, 0.0, 0.05], [0.0, 0.0, 0.15]])
    seen, points = perfect_calibration(cell, 12)
    pixels = np.moveaxis(cell.pixels(cell.home[None]), 0, 1)
    with pytest.raises(JointAnglesError, match="j6") as error:
        joint_zeros(seen, points, pixels, 0.2, cell.home[None], limits=np.array([[-0.3, 0.3]] * 6))
    assert error.value.code == "not_observable"
    assert "j6" in error.value.data["joints"]


def test_what_another_calibration_does_to_the_angles_is_foreseen(perfect_calibration):
    cell = synthetic.pan_tilt()
    seen, _ = perfect_calibration(cell, 13)
    q = cell.home + np.array([0.08, -0.03])
    home, now = (cell.pixels(p[None])[:, 0, :3] for p in (cell.home, q))
    change = 1e-4 * np.random.default_rng(13).normal(size=seen.cameras.shape) * np.abs(seen.cameras)

    def problem(sign):
        return homing_problem(replace(seen, cameras=seen.cameras + sign * change), cell.home, home, now, 0.3)

    foreseen = sensitivity(problem(0), problem(1), problem(-1), q)
    ends = [homing_displacement(problem(sign), cell.home, start=q).current.q for sign in (1, -1)]
    assert np.allclose(0.5 * (ends[0] - ends[1]), foreseen, rtol=0.02, atol=1e-9)


def test_points_seen_anywhere_are_brought_to_the_zero(perfect_calibration):
    cell = synthetic.pan_tilt().with_k1(-0.3)
    seen, points = perfect_calibration(cell, 14)
    q = cell.home + np.array([0.1, 0.1])
    found, covariance = reconstruct_points(seen, q, cell.pixels(q[None])[:, 0], 0.1)
    assert np.allclose(found / found[:, 3:], points / points[:, 3:], atol=1e-7)
    assert (np.linalg.eigvalsh(covariance)[:, 1:] > 0).all()
