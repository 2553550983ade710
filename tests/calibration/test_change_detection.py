"""What explains innovations: Euclidean cells, in random projective frames, in which one thing has changed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from oracles.change_detection import Measurement, explain
from stereoservo.calibration.change.change_detection import KINDS, diagnose
from stereoservo.calibration.change.hypothesis_test import UNCLEAR, alarm_thresholds, chi2_quantile, chi2_tail
from stereoservo.kinematics.composition import displacement_basis
from stereoservo.kinematics.kernels import chain_forward, project_points, transform_points
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import flat_plate, gantry, rx90, seven

SIGMA = 0.1
CLEAR = 150.0
"""Chi-square of a change that is missed less than once in 10 000: its estimate is noncentral, the thresholds are 50."""
STATIC = np.array(
    [(-0.3, -0.2, 0.1, 1), (0.3, 0.2, 0.2, 1), (-0.2, 0.25, -0.1, 1), (0.25, -0.25, 0, 1), (0, 0.3, 0.3, 1)]
)


def turned(axis, degrees):
    """Rotation (3, 3) about a random unit vector (3,)."""
    x = np.radians(degrees) * axis / np.linalg.norm(axis)
    K = np.array([(0, -x[2], x[1]), (x[2], 0, -x[0]), (-x[1], x[0], 0)])
    angle = np.linalg.norm(x) or 1.0
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K


def bumped(cell, cameras, degrees, way, rng):
    """The cell with cameras turned and shifted, each by its own axes."""
    D = np.eye(4)
    D[:3, :3] = turned(rng.normal(size=3), degrees)
    shift = rng.normal(size=3)
    D[:3, 3] = way * shift / np.linalg.norm(shift)
    poses = cell.poses.copy()
    for c in cameras:
        poses[c] = D @ poses[c]
    return replace(cell, poses=poses)


def moment(cell, rng, *, stratum="metric", seen_cell=None, drift=None, static=False, sigma=SIGMA):
    """What `diagnose` takes, in a random projective frame: the cell as known, and ``seen_cell`` at drifted joints."""
    model = exact_model(cell, stratum=stratum)
    frame = np.eye(4) + 0.05 * rng.normal(size=(4, 4))
    back = np.linalg.inv(frame)
    q = cell.held_out(rng, 1, 0.7)[0]
    kinds = np.array([kind == "prismatic" for kind in model.joint_kinds], dtype=np.uint8)
    generators = np.ascontiguousarray(frame @ model.generators @ back)
    H, operators = chain_forward(generators, kinds, model.zero, q, model.tip_first)
    X = transform_points(H, np.ascontiguousarray(model.marker_points @ frame.T))
    Ps = np.array([camera.matrix @ back for camera in model.cameras])
    known = project_points(Ps, X)[0]
    true_cell = cell if seen_cell is None else seen_cell
    observed = true_cell.pixels((q if drift is None else q + drift)[None])[:, 0]
    twists = None
    if stratum == "metric":
        twists = displacement_basis(model.projective_to_euclidean @ back, X)
    given = [
        Ps,
        X,
        observed + rng.normal(0, sigma, observed.shape) - known,
        np.full(known.shape[:2], 1 / SIGMA),
    ]
    extra = ()
    if static:
        middle = cell.markers(cell.home[None])[0].mean(axis=0)[:3]
        world = STATIC + np.append(middle, 0.0)
        left = np.linalg.inv(cell.poses[0])
        to_frame = frame @ np.linalg.inv(model.projective_to_euclidean) @ np.linalg.inv(left)
        points = np.ascontiguousarray(world @ to_frame.T)
        expected = project_points(Ps, points)[0]
        truth = np.array([K @ T[:3] for K, T in zip(true_cell.intrinsics, true_cell.poses, strict=True)])
        images = np.einsum("cij,pj->cpi", truth, world)
        shown = images[..., :2] / images[..., 2:] + rng.normal(0, sigma, expected.shape)
        extra = (points, shown - expected, np.full(expected.shape[:2], 1 / SIGMA))
    return given, operators, twists, extra


def thresholds(cell, least_px=0.0, rate=30.0):
    """One false alarm an hour at ``rate`` [Hz]."""
    return alarm_thresholds(
        false_alarms_per_hour=1.0,
        decisions_per_hour=3600.0 * rate,
        cameras=len(cell.poses),
        markers=len(cell.body),
        joints=len(cell.kinds),
        least_px=least_px,
    )


def told(cell, seed, limits=None, mask=None, **what):
    rng = np.random.default_rng(seed)
    given, operators, twists, extra = moment(cell, rng, **what)
    if mask is not None:
        given[3] = given[3] * mask
    return diagnose(*given, operators, twists, limits or thresholds(cell), *extra)


@pytest.mark.parametrize("freedom", range(1, 9))
def test_tails_of_chi_square_are_scipys(freedom):
    for x in (0.1, 3.0, 30.0, 80.0):
        assert chi2_tail(x, freedom) == pytest.approx(chi2.sf(x, freedom), rel=1e-9)
    assert chi2_quantile(1e-7, freedom) == pytest.approx(chi2.isf(1e-7, freedom), rel=1e-9)


def test_noise_raises_no_more_alarms_than_stated():
    """At a chance of 2 % a decision, the alarms of 200 are binomial."""
    cell = rx90()
    limits = alarm_thresholds(false_alarms_per_hour=72.0, decisions_per_hour=3600.0, cameras=2, markers=14, joints=6)
    alarms = sum(told(cell, seed, limits).kind != "nothing" for seed in range(200))
    assert alarms <= binom.isf(1e-4, 200, 0.02)


def test_noise_twice_as_large_as_stated_is_no_cause_but_reported():
    kinds = [told(rx90(), seed, sigma=2 * SIGMA).kind for seed in range(40)]
    assert set(kinds) == {"unexplained"}


@pytest.mark.parametrize("stratum", ["metric", "projective"])
@pytest.mark.parametrize(("degrees", "way"), [(5.0, 0.03), (0.2, 0.0), (20.0, 0.1)])
def test_a_bumped_camera_is_named_at_the_first_frame(stratum, degrees, way):
    cell = rx90()
    for seed in range(30):
        rng = np.random.default_rng(1000 + seed)
        camera = seed % 2
        seen = bumped(cell, [camera], degrees, way, rng)
        found = told(cell, seed, seen_cell=seen, stratum=stratum)
        if _signal(cell, seed, seen) < CLEAR:
            assert degrees == 0.2  # about the optical axis, with the markers in the middle of the image
            continue
        assert (found.kind, found.cause.index, found.runner_up) == ("camera", camera, None)
        if stratum == "metric" and way == 0.0:
            assert np.degrees(found.cause.amount) == pytest.approx(degrees, abs=0.5)
        assert found.cause.effect_px > 0.2


def test_a_slipped_marker_is_named():
    """By two millimetres in any direction (one frame at 0.1 px); along the rays it hardly shows."""
    cell = rx90()
    named = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        marker = int(rng.integers(14))
        body = cell.body.copy()
        way = rng.normal(size=3)
        body[marker] += 0.002 * way / np.linalg.norm(way)
        found = told(cell, seed, seen_cell=cell.with_body(body))
        if _signal(cell, seed, cell.with_body(body)) >= CLEAR:
            assert (found.kind, found.cause.index, found.runner_up) == ("marker", marker, None)
            named += 1
    assert named >= 20


def _signal(cell, seed, seen_cell):
    """Chi-square of the change itself."""
    (_, _, innovation, weights), *_ = moment(cell, np.random.default_rng(seed), seen_cell=seen_cell, sigma=0.0)
    return float(((weights[..., None] * innovation) ** 2).sum())


@pytest.mark.parametrize("make", [rx90, seven])
def test_the_drifted_zero_of_a_joint_is_named(make):
    """0.3 degrees: of 100 seeds that tell joints apart at all, 99."""
    cell = make()
    right = distinguishable = 0
    for seed in range(100):
        joint = seed % len(cell.kinds)
        drift = np.radians(0.3) * np.eye(len(cell.kinds))[joint]
        found = told(cell, seed, drift=drift)
        assert found.kind in ("joint", "nothing") or found.runner_up is not None
        if found.runner_up is not None or found.kind == "nothing":
            continue  # parallel axes, or a motion below the noise
        distinguishable += 1
        right += found.cause.index == joint
        assert abs(found.cause.amount) == pytest.approx(np.radians(0.3), rel=0.5)
    assert distinguishable >= 80
    assert right >= 0.99 * distinguishable


def test_one_pose_does_not_tell_a_displaced_rig_from_a_displaced_arm_but_static_points_do():
    cell = rx90()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        # The same displacement of the rig: both cameras about the first one's frame.
        D = bumped(cell, [0], 3.0, 0.02, rng).poses[0] @ np.linalg.inv(cell.poses[0])
        T = np.linalg.inv(cell.poses[0]) @ D @ cell.poses[0]
        rig = replace(cell, poses=cell.poses @ T)
        blind = told(cell, seed, seen_cell=rig)
        assert {blind.kind, blind.runner_up.kind} == {"cameras", "joints"}
        assert told(cell, seed, seen_cell=rig, static=True).kind == "cameras"
        pushed = told(cell, seed, drift=np.radians(rng.normal(0, 1.0, 6)), static=True)
        assert pushed.kind in ("joints", "joint")


def test_a_camera_whose_static_points_stand_has_not_moved():
    """One camera: a displaced body and a moved camera look alike, unless something stands."""
    cell = rx90()
    mask = np.array([1.0, 0.0])[:, None]
    only_left = replace(cell, poses=cell.poses[:1], intrinsics=cell.intrinsics[:1], lenses=cell.lenses[:1])
    for seed in range(20):
        rng = np.random.default_rng(seed)
        drift = np.radians(rng.normal(0, 1.0, 6))
        alike = told(only_left, seed, drift=drift)
        assert {alike.kind, alike.runner_up.kind} == {"camera", "joints"}
        assert told(only_left, seed, drift=drift, static=True).kind == "joints"
        moved = bumped(only_left, [0], 5.0, 0.03, rng)
        assert told(only_left, seed, seen_cell=moved, static=True).kind == "camera"
    assert told(cell, 1, seen_cell=bumped(cell, [0], 5.0, 0.03, np.random.default_rng(1)), mask=mask).kind in (
        "camera",
        "joints",
    )


def test_few_markers_show_a_shift_of_the_image():
    cell = rx90()
    mask = np.zeros((2, 14))
    mask[0, :6], mask[1, 2:5] = 1.0, 1.0
    for seed in range(20):
        found = told(cell, seed, mask=mask, seen_cell=bumped(cell, [1], 5.0, 0.0, np.random.default_rng(seed)))
        assert found.kind in ("camera", "unexplained")
        assert (found.cause.kind, found.cause.index, found.cause.size) == ("camera", 1, 2)


def test_nothing_seen_is_nothing_reported():
    found = told(rx90(), 0, mask=np.zeros((2, 14)))
    assert (found.kind, found.measurements, found.chi2) == ("nothing", 0, 0.0)


def test_small_changes_are_left_alone_where_that_is_wanted():
    cell = rx90()
    bump = bumped(cell, [1], 0.5, 0.0, np.random.default_rng(0))
    assert told(cell, 0, thresholds(cell, least_px=0.3), seen_cell=bump).kind == "camera"
    assert told(cell, 0, thresholds(cell, least_px=30.0), seen_cell=bump).kind == "nothing"


def test_thresholds_refuse_rates_that_are_none():
    with pytest.raises(ValueError, match="0 false alarms"):
        alarm_thresholds(false_alarms_per_hour=0.0, decisions_per_hour=1.0, cameras=1, markers=1, joints=1)


@pytest.mark.parametrize("stratum", ["metric", "projective"])
@pytest.mark.parametrize("make", [rx90, gantry, lambda: rx90(flat_plate())])
def test_the_kernel_computes_what_the_reference_says(make, stratum):
    cell = make()
    limits = thresholds(cell)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        n = len(cell.kinds)
        changes = (
            {},
            {"seen_cell": bumped(cell, [1], 5.0, 0.03, rng)},
            {"drift": np.where(np.arange(n) == seed % n, 0.01, 0.0)},
            {"seen_cell": cell.with_body(cell.body + np.eye(len(cell.body))[0][:, None] * 0.003)},
        )
        for k, change in enumerate(changes):
            mask = (np.random.default_rng(seed + 50).random((2, len(cell.body))) > 0.15 * k).astype(float)
            given, operators, twists, extra = moment(
                cell, np.random.default_rng(seed), stratum=stratum, static=stratum == "metric", **change
            )
            given[3] = given[3] * mask
            kernel = diagnose(*given, operators, twists, limits, *extra)
            Ps, X, innovations, weights = given
            markers = len(X)
            if extra:
                X = np.concatenate([X, extra[0]])
                innovations = np.concatenate([innovations, extra[1]], axis=1)
                weights = np.concatenate([weights, extra[2]], axis=1)
            pixels = project_points(Ps, np.ascontiguousarray(X))[0]
            reference = explain(
                Measurement(Ps, X, markers, pixels, pixels + innovations, weights, operators, twists), limits
            )
            assert kernel.kind == KINDS[reference.kind]
            assert kernel.chi2 == pytest.approx(reference.chi2[0], rel=1e-10)
            for cause, h in ((kernel.cause, reference.best), (kernel.runner_up, reference.runner_up)):
                assert (cause is None) == (h < 1)
                if cause is not None:
                    assert cause.size == reference.sizes[h]
                    assert cause.chi2 == pytest.approx(reference.chi2[h], rel=1e-10, abs=1e-10 * kernel.chi2)
                    assert cause.effect_px == pytest.approx(reference.effects[h], rel=1e-7)


def test_two_causes_are_reported_as_rivals_only_below_the_stated_odds():
    assert pytest.approx(2.0 * np.log(100.0), abs=0.02) == UNCLEAR
