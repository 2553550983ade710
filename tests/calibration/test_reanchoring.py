"""Re-anchored cameras against Euclidean truth: accuracy and its bound, outliers, rigs, strata, what is refused."""

from dataclasses import dataclass, replace

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.calibration.relocalized_model import RestObservations, RestPose, relocalize
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import (
    CalibrationError,
    StaticObservations,
    decode_trials,
    encode_trials,
)
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import decode_model, encode_model
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import flat_plate, gantry, rx90

SIGMA = 0.1
SCENE_IDS = tuple(range(100, 106))


@dataclass(frozen=True)
class Seen:
    camera: str
    ids: np.ndarray
    pixels: np.ndarray
    covariances: np.ndarray


def bumped(cell, cameras, degrees, way, rng, together=False):
    """The cell with cameras turned and shifted, each by its own axes or all as one rig."""
    x = rng.normal(size=3)
    x *= np.radians(degrees) / np.linalg.norm(x)
    K = np.array([(0, -x[2], x[1]), (x[2], 0, -x[0]), (-x[1], x[0], 0)])
    angle = np.linalg.norm(x)
    D = np.eye(4)
    D[:3, :3] += np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K
    shift = rng.normal(size=3)
    D[:3, 3] = way * shift / np.linalg.norm(shift)
    poses = cell.poses.copy()
    for c in cameras:
        poses[c] = poses[c] @ np.linalg.inv(poses[0]) @ D @ poses[0] if together else D @ poses[c]
    return replace(cell, poses=poses)


def sights(cell, joints, rng, *, change=None, scene=None, stated=None, sigma=SIGMA):
    """What a cell's cameras see at joints (s, n); ``change(camera, ids, pixels)`` tampers with it."""
    exact = cell.pixels(joints)
    noisy = exact + rng.normal(0, sigma, exact.shape)
    poses = []
    for s, q in enumerate(joints if stated is None else stated):
        seen = []
        for c in range(len(exact)):
            ids, pixels = np.array(cell.marker_ids), noisy[c, s]
            if scene is not None:
                ids = np.append(ids, SCENE_IDS)
                pixels = np.vstack([pixels, images(cell, scene)[c] + rng.normal(0, sigma, (len(scene), 2))])
            if change is not None:
                ids, pixels = change(c, ids.copy(), pixels.copy())
            seen.append(Seen(f"cam{c}", ids, pixels, np.tile(SIGMA**2 * np.eye(2), (len(ids), 1, 1))))
        poses.append(RestPose(q, tuple(seen)))
    return RestObservations(tuple(poses))


def images(cell, points):
    """Pixels (c, k, 2) of points (k, 4) that stand."""
    matrices = np.array([K @ T[:3] for K, T in zip(cell.intrinsics, cell.poses, strict=True)])
    homogeneous = np.einsum("cij,kj->cki", matrices, points)
    return homogeneous[..., :2] / homogeneous[..., 2:]


def standing(cell, rng):
    """Points (6, 4) that stand about where the arm's markers are."""
    middle = cell.markers(cell.home[None])[0].mean(axis=0)[:3]
    return np.hstack([middle + rng.uniform(-0.25, 0.25, (6, 3)), np.ones((6, 1))])


def in_random_frame(model, rng):
    """The same model in another projective frame: nothing that is seen changes."""
    frame = np.eye(4) + 0.05 * rng.normal(size=(4, 4))
    back = np.linalg.inv(frame)
    plane = model.plane_at_infinity @ back
    points = model.marker_points @ frame.T
    upgrade = model.projective_to_euclidean
    return msgspec.structs.replace(
        model,
        generators=frame @ model.generators @ back,
        cameras=tuple(msgspec.structs.replace(camera, matrix=camera.matrix @ back) for camera in model.cameras),
        marker_points=points / (points @ plane)[:, None],
        plane_at_infinity=plane,
        projective_to_euclidean=None if upgrade is None else upgrade @ back,
    )


def errors(model, cell, c, joints):
    """Predicted less true pixels (k, 2) of camera ``c``, of markers within its image."""
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
    points = np.array([model.marker_points @ chain.displacement(q).T for q in joints]).reshape(-1, 4)
    homogeneous = points @ model.cameras[c].matrix.T
    true = cell.pixels(joints)[c].reshape(-1, 2)
    inside = ((true > 0) & (true < (cell.width, cell.height))).all(axis=1)
    return (homogeneous[:, :2] / homogeneous[:, 2:] - true)[inside]


def refusal(*args, **options):
    with pytest.raises(CalibrationError) as caught:
        relocalize(*args, epoch=2, **options)
    return caught.value


@pytest.mark.parametrize(("degrees", "way"), [(5.0, 0.03), (20.0, 0.1)])
def test_a_bumped_camera_is_as_good_as_its_pixels_allow(degrees, way):
    """Squared errors over their stated deviations average to one; chi-square is chi-square."""
    total = freedom = 0.0
    worst = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        cell = rx90()
        model = in_random_frame(exact_model(cell), rng)
        moved = bumped(cell, [1], degrees, way, rng)
        found = relocalize(
            model, sights(moved, cell.held_out(rng, 3, 0.5), rng), ("cam1",), epoch=2,
            workspace=cell.held_out(rng, 20),
        )  # fmt: skip
        encode_model(found.model)
        total, freedom = total + found.chi2, freedom + found.degrees_of_freedom
        assert found.cameras["cam1"].how == "moved"
        assert found.cameras["cam1"].turned_deg == pytest.approx(degrees, abs=0.3)
        assert found.outliers == ()
        worst.append(np.abs(errors(found.model, moved, 1, cell.held_out(rng, 20))).max() / found.predicted_px)
        assert (found.model.cameras[0].matrix == model.cameras[0].matrix).all()
        assert (found.model.generators == model.generators).all()
    assert chi2.isf(0.9999, freedom) < total < chi2.isf(0.0001, freedom)
    assert np.median(worst) < 3.0


def test_the_covariance_of_a_displacement_is_the_bound_of_cramer_and_rao():
    """Errors at one pixel over many seeds: their variance is the stated one, chi-square of 60 at 1e-4 a side."""
    cell = rx90()
    model = exact_model(cell)
    moved = bumped(cell, [1], 5.0, 0.03, np.random.default_rng(0))
    joints = cell.held_out(np.random.default_rng(1), 2, 0.5)
    there = cell.held_out(np.random.default_rng(4), 1, 0.5)
    squares = []
    for seed in range(30):
        rng = np.random.default_rng(100 + seed)
        found = relocalize(model, sights(moved, joints, rng), ("cam1",), epoch=2, workspace=there, limit_px=9.0)
        squares.append((errors(found.model, moved, 1, there)[0] ** 2).sum())
        stated = found.predicted_px
    # predicted_px is the largest over axes, markers and configurations: an upper bound of this one's deviation.
    assert np.sum(squares) <= stated**2 * chi2.isf(1e-4, 60)


def test_a_calibrated_model_states_what_it_and_the_new_pixels_leave_open():
    """With noise in the calibration, too: deviations stated by the new covariance cover the errors; static points help,
    and add their share to chi-square."""
    rng = np.random.default_rng(3)
    cell = rx90()
    scene = standing(cell, rng)
    pixels = images(cell, scene) + rng.normal(0, SIGMA, (2, 6, 2))
    trials = msgspec.structs.replace(
        cell.trials(SIGMA, rng), static=StaticObservations(SCENE_IDS, pixels, np.full((2, 6), SIGMA))
    )
    result = fit_model(decode_trials(encode_trials(trials)), epoch=1)
    model = decode_model(encode_model(result.model))
    assert model.scene_ids == SCENE_IDS
    assert not set(SCENE_IDS) & set(model.marker_ids)
    euclidean = model.scene_points @ model.projective_to_euclidean.T
    euclidean = euclidean[:, :3] / euclidean[:, 3:]
    way, true = (np.linalg.norm(x[1:] - x[0], axis=1) for x in (euclidean, scene[:, :3]))
    assert way / way[0] == pytest.approx(true / true[0], abs=0.01)

    moved = bumped(cell, [1], 5.0, 0.03, rng)
    joints = cell.held_out(rng, 2, 0.3)
    without = relocalize(model, sights(moved, joints, rng), ("cam1",), epoch=2)
    with_scene = relocalize(model, sights(moved, joints, rng, scene=scene), ("cam1",), epoch=2)
    for found in (without, with_scene):
        again = decode_model(encode_model(found.model))
        assert again.covariance is not None
        assert found.chi2 < chi2.isf(1e-4, found.degrees_of_freedom)
        error = errors(found.model, moved, 1, cell.held_out(rng, 40))
        assert np.abs(error).max() < 4.5 * found.predicted_px
    assert with_scene.degrees_of_freedom == without.degrees_of_freedom + 12
    # The re-anchored model can be re-anchored again.
    twice = bumped(moved, [1], 4.0, 0.02, rng)
    found = relocalize(with_scene.model, sights(twice, joints, rng, scene=scene), ("cam1",), epoch=3)
    assert np.abs(errors(found.model, twice, 1, joints)).max() < 4.5 * found.predicted_px


def test_static_points_alone_anchor_a_camera():
    rng = np.random.default_rng(5)
    cell = rx90()
    scene = standing(cell, rng)
    model = exact_model(cell)
    to_frame = np.linalg.inv(model.projective_to_euclidean) @ cell.poses[0]
    points = scene @ to_frame.T
    model = msgspec.structs.replace(
        model,
        scene_ids=SCENE_IDS,
        scene_points=points / (points @ model.plane_at_infinity)[:, None],
        scene_covariances=np.zeros((6, 4, 4)),
    )
    moved = bumped(cell, [0], 10.0, 0.05, rng)

    def only_scene(camera, ids, pixels):
        return ids[-6:], pixels[-6:]

    here = sights(moved, cell.home[None], rng, scene=scene, change=only_scene)
    found = relocalize(model, here, ("cam0",), epoch=2)
    assert found.degrees_of_freedom == 6
    assert np.abs(errors(found.model, moved, 0, cell.home[None])).max() < 1.0


@pytest.mark.parametrize("poses", [1, 3])
def test_slipped_markers_and_wrong_ids_are_named_and_left_out(poses):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        cell = rx90()
        moved = bumped(cell, [1], 20.0, 0.1, rng)

        def change(camera, ids, pixels):
            pixels[2] += 15.0
            ids[[5, 11]] = ids[[11, 5]]
            return ids, pixels

        joints = cell.held_out(rng, poses, 0.5)
        found = relocalize(
            exact_model(cell), sights(moved, joints, rng, change=change), ("cam1",), epoch=2, limit_px=9.0
        )
        assert {outlier.id for outlier in found.outliers} == {cell.marker_ids[k] for k in (2, 5, 11)}
        assert np.abs(errors(found.model, moved, 1, joints)).max() < 1.0


def test_a_rig_that_moved_rigidly_and_cameras_that_moved_each():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        cell = rx90()
        joints, workspace = cell.held_out(rng, 2, 0.5), cell.held_out(rng, 10)
        rig = bumped(cell, [1, 0], 5.0, 0.03, rng, together=True)
        one = relocalize(
            exact_model(cell), sights(rig, joints, rng), ("cam0", "cam1"), rigid_rig=True, epoch=2,
            workspace=workspace,
        )  # fmt: skip
        assert one.cameras["cam0"].how == "moved_with_rig"
        both = bumped(bumped(cell, [0], 5.0, 0.03, rng), [1], 8.0, 0.02, rng)
        each = relocalize(exact_model(cell), sights(both, joints, rng), ("cam0", "cam1"), epoch=2, workspace=workspace)
        for found, truth in ((one, rig), (each, both)):
            for c in (0, 1):
                assert np.abs(errors(found.model, truth, c, workspace)).max() < 5.0 * found.predicted_px
        assert one.degrees_of_freedom == each.degrees_of_freedom + 6


@pytest.mark.parametrize("stratum", ["affine", "projective"])
def test_without_a_metric_a_camera_is_resected_from_several_poses(stratum):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        cell = rx90()
        model = in_random_frame(exact_model(cell, stratum=stratum), rng)
        moved = bumped(cell, [1], 5.0, 0.03, rng)
        joints = cell.held_out(rng, 4, 0.5)
        found = relocalize(model, sights(moved, joints, rng), ("cam1",), epoch=2, workspace=joints, limit_px=2.0)
        assert found.cameras["cam1"].how == "resected"
        assert np.abs(errors(found.model, moved, 1, joints)).max() < 5.0 * found.predicted_px
        rig = bumped(cell, [1, 0], 5.0, 0.03, rng, together=True)
        found = relocalize(
            model, sights(rig, joints, rng), ("cam0", "cam1"), rigid_rig=True, epoch=2, workspace=joints,
            limit_px=5.0,
        )  # fmt: skip
        for c in (0, 1):
            assert np.abs(errors(found.model, rig, c, joints)).max() < 5.0 * found.predicted_px


def test_a_changed_focal_length_is_stated():
    rng = np.random.default_rng(0)
    cell = rx90()
    moved = bumped(cell, [1], 5.0, 0.03, rng)
    intrinsics = moved.intrinsics.copy()
    intrinsics[1, :2, :2] *= 1.05
    zoomed = replace(moved, intrinsics=intrinsics)
    joints = cell.held_out(rng, 4, 0.5)
    found = relocalize(exact_model(cell), sights(zoomed, joints, rng), ("cam1",), epoch=2, workspace=joints)
    assert found.cameras["cam1"].how == "moved_and_refocused"
    assert "focal length" in found.cameras["cam1"].text
    assert np.abs(errors(found.model, zoomed, 1, joints)).max() < 5.0 * found.predicted_px


def test_prismatic_joints_tell_the_way_in_metres():
    rng = np.random.default_rng(2)
    cell = gantry()
    moved = bumped(cell, [1], 5.0, 0.03, rng)
    joints = cell.held_out(rng, 2, 0.5)
    found = relocalize(exact_model(cell), sights(moved, joints, rng), ("cam1",), epoch=2, workspace=joints)
    before, after = (-pose[:3, :3].T @ pose[:3, 3] for pose in (cell.poses[1], moved.poses[1]))
    assert found.cameras["cam1"].shifted_m == pytest.approx(np.linalg.norm(after - before), abs=0.005)


def test_what_cannot_be_re_anchored_is_refused_with_what_is_missing():
    rng = np.random.default_rng(1)
    cell = rx90()
    model = exact_model(cell)
    moved = bumped(cell, [1], 5.0, 0.03, rng)
    joints = cell.held_out(rng, 1, 0.5)

    def first(count):
        return lambda camera, ids, pixels: (ids[:count], pixels[:count])

    few = refusal(model, sights(moved, joints, rng, change=first(3)), ("cam1",))
    assert (few.code, few.data["points"], few.data["minimum"]) == ("too_few_points", 3, 4)
    none = refusal(model, RestObservations(()), ("cam1",))
    assert (none.code, none.data["points"]) == ("too_few_points", 0)
    vague = refusal(model, sights(moved, joints, rng, change=first(4)), ("cam1",), workspace=cell.held_out(rng, 20))
    assert vague.code == "too_uncertain"
    assert vague.data["predicted_px"] > vague.data["limit_px"] == 1.0
    assert "other poses" in vague.message
    flat = rx90(flat_plate())
    alike = refusal(exact_model(flat, stratum="projective"), sights(flat, joints, rng), ("cam1",), workspace=joints)
    assert alike.code == "too_few_points"
    resected = refusal(
        exact_model(cell, stratum="projective"),
        sights(moved, joints, rng, change=first(7)),
        ("cam1",),
        workspace=cell.held_out(rng, 20),
    )
    assert resected.code in ("points_coplanar", "too_uncertain")
    wrong = np.radians(20.0) * np.eye(6)[2]
    drifted = sights(moved, cell.held_out(rng, 4, 0.5), rng)
    drifted = RestObservations(
        tuple(RestPose(pose.joints + wrong * k, pose.samples) for k, pose in enumerate(drifted.poses))
    )
    unexplained = refusal(model, drifted, ("cam1",))
    assert unexplained.code == "not_explained"
    for names in (("cam7",), (), ("cam1", "cam1")):
        assert refusal(model, RestObservations(()), names).code == "bad_data"
    assert refusal(model, RestObservations((RestPose(np.zeros(2), ()),)), ("cam1",)).code == "bad_data"
    torn = Seen("cam1", np.arange(3), np.zeros((2, 2)), np.zeros((3, 2, 2)))
    assert refusal(model, RestObservations((RestPose(cell.home, (torn,)),)), ("cam1",)).code == "bad_data"
