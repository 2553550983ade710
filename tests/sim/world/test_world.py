"""The simulated cell: cameras against closed forms, and what its cell file promises about visibility."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.messages.cell_file import check_joints, load_cell_file
from stereoservo_sim.cells import demo_cell_path
from stereoservo_sim.world.camera_rig import project
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, demo_cell

CELL = demo_cell()
FILE = load_cell_file(demo_cell_path())
SIXTY = np.deg2rad(60.0)


def test_projection_agrees_with_opencv():
    points = CELL.marker_positions(CELL.base)
    for camera in CELL.rig.cameras:
        rotation, _ = cv2.Rodrigues(camera.world_to_camera[:3, :3])
        expected, _ = cv2.projectPoints(points, rotation, camera.world_to_camera[:3, 3], camera.K, None)
        assert np.allclose(CELL.truth_pixels(CELL.base)[camera.name], expected[:, 0], atol=1e-9)


def test_rig_has_its_baseline_and_vergence():
    left, right = CELL.rig.cameras
    assert np.isclose(np.linalg.norm(right.centre - left.centre), 0.20)
    axes = [camera.world_to_camera[2, :3] for camera in (left, right)]
    assert np.isclose(np.rad2deg(np.arccos(axes[0] @ axes[1])), 20.0)
    towards = right.centre - left.centre
    assert axes[0] @ towards > 0 > axes[1] @ towards  # turned inwards
    rotation = CELL.rig.world_to_rig[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3))
    assert np.isclose(np.linalg.det(rotation), 1)


def test_body_stands_between_one_and_two_metres_from_the_cameras():
    for camera in CELL.rig.cameras:
        _, depths = project(camera.P, CELL.marker_positions(CELL.base))
        assert np.all((depths > 1.0) & (depths < 2.0))


def test_metric_positions_are_the_world_seen_from_the_rig():
    q = DEMO_GOALS["far"]
    world, rig = CELL.marker_positions(q), CELL.marker_positions_rig(q)
    assert np.allclose(
        np.linalg.norm(world[:, None] - world[None], axis=2), np.linalg.norm(rig[:, None] - rig[None], axis=2)
    )
    # A pinhole in the rig frame, written out: the left camera stands at x = -0.1, turned by +10 degrees.
    c, s = np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10))
    shifted = rig + np.array([0.1, 0, 0])
    x, z = c * shifted[:, 0] - s * shifted[:, 2], s * shifted[:, 0] + c * shifted[:, 2]
    expected = np.stack([800 * x / z + 320, 800 * shifted[:, 1] / z + 240], axis=1)
    assert np.allclose(CELL.truth_pixels(q)["left"], expected, atol=1e-9)


def test_cell_file_fits_the_arm():
    check_joints(FILE, CELL.robot.joint_names)
    for limit, joint in zip(FILE.safety.limit, CELL.robot.joints, strict=True):
        assert joint.position_min < limit.min < limit.max < joint.position_max
        assert limit.velocity <= joint.velocity_max
        assert limit.acceleration <= joint.acceleration_max
    assert [FILE.calibration.base[name] for name in CELL.robot.joint_names] == CELL.base.tolist()


def test_base_is_away_from_singularities():
    """The Jacobian of the flange, by finite differences, is well conditioned there."""
    h = 1e-6
    columns = []
    here = CELL.flange(CELL.base)
    for j in range(6):
        q = CELL.base.copy()
        q[j] += h
        there = CELL.flange(q)
        turn = Rotation.from_matrix(there[:3, :3] @ here[:3, :3].T).as_rotvec()
        columns.append(np.concatenate([(there[:3, 3] - here[:3, 3]) / h, turn / h]))
    values = np.linalg.svd(np.array(columns).T, compute_uv=False)
    assert values[0] / values[-1] < 30


def displacement(start, end):
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    middle = CELL.body.marker_points.mean(axis=0)
    centres = [middle @ pose[:3, :3].T + pose[:3, 3] for pose in (start, end)]
    return turn, centres


@pytest.mark.parametrize(("start", "end"), list(itertools.combinations(["base", *DEMO_GOALS], 2)))
def test_goals_are_seen_at_the_ends_and_on_the_way(start, end):
    poses = {"base": CELL.base, **DEMO_GOALS}
    q0, q1 = poses[start], poses[end]
    flange0 = CELL.flange(q0)
    turn, centres = displacement(flange0, CELL.flange(q1))
    middle = CELL.body.marker_points.mean(axis=0)
    for s in np.linspace(0, 1, 15):
        straight = np.eye(4)
        straight[:3, :3] = Rotation.from_rotvec(s * turn).as_matrix() @ flange0[:3, :3]
        straight[:3, 3] = (1 - s) * centres[0] + s * centres[1] - straight[:3, :3] @ middle
        for camera in CELL.rig.cameras:
            assert CELL.turned_to(straight, camera, max_incidence=SIXTY).all()
            assert CELL.visible(q0 + s * (q1 - q0), camera, max_incidence=SIXTY).all()


def test_goals_lie_inside_the_limits_and_are_as_far_as_documented():
    expected = {"near": (29, 0.12), "roll": (180, 0.14), "far": (94, 0.37)}
    line_of_sight = CELL.rig.world_to_rig[2, :3]
    for name, q in DEMO_GOALS.items():
        for limit, value in zip(FILE.safety.limit, q, strict=True):
            assert limit.min + 0.1 < value < limit.max - 0.1
        turn, centres = displacement(CELL.flange(CELL.base), CELL.flange(q))
        degrees, metres = expected[name]
        assert np.rad2deg(np.linalg.norm(turn)) == pytest.approx(degrees, abs=1)
        assert np.linalg.norm(centres[1] - centres[0]) == pytest.approx(metres, abs=0.01)
        if name == "roll":
            assert abs(turn @ line_of_sight) > 0.99 * np.linalg.norm(turn)


def test_a_face_turned_away_is_not_seen():
    pose = CELL.flange(CELL.base)
    back = pose.copy()
    back[:3, :3] = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    for camera in CELL.rig.cameras:
        assert CELL.turned_to(pose, camera).all()
        assert not CELL.turned_to(back, camera).any()


def test_markers_outside_the_image_are_not_seen():
    left = CELL.rig.camera("left")
    pose = CELL.flange(CELL.base)
    aside = pose.copy()
    aside[:3, 3] += 2.0 * left.world_to_camera[0, :3]
    assert not CELL.turned_to(aside, left).any()
    with pytest.raises(KeyError, match="cameras: left, right"):
        CELL.rig.camera("middle")


def test_the_arm_hides_what_is_behind_it():
    """Marker by marker against the distance of densely sampled links from densely sampled lines of sight."""
    from stereoservo_sim.world.robots import shape_segments

    rng = np.random.default_rng(4)
    low = np.array([j.position_min for j in CELL.robot.joints])
    high = np.array([j.position_max for j in CELL.robot.joints])
    fractions = np.linspace(0, 1, 150)
    hidden_cases = 0
    for q in rng.uniform(low, high, (150, 6)):
        camera = CELL.rig.cameras[0]
        points = CELL.marker_positions(q)
        ends, radii = shape_segments(CELL.robot, q)
        turned = CELL.turned_to(CELL.flange(q), camera)
        seen = CELL.visible(q, camera)
        assert not np.any(seen & ~turned)
        for i in np.flatnonzero(turned)[:2]:
            start = points[i] + 0.02 * (camera.centre - points[i])
            ray = start + fractions[:, None] * (camera.centre - start)
            clearances = [
                np.linalg.norm(ray[:, None] - (a + fractions[:, None] * (b - a))[None], axis=2).min() - radius
                for (a, b), radius in zip(ends, radii, strict=True)
            ]
            if abs(min(clearances)) > 0.01:
                assert seen[i] == (min(clearances) > 0)
                hidden_cases += min(clearances) < 0
    assert hidden_cases > 0
