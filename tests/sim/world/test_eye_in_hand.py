"""The simulated cell with its cameras on the arm: geometry against OpenCV, its cell file's promises, its images."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles.lenses import with_lenses
from stereoservo.messages.cell_file import check_joints, load_cell_file
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.world.arms.arm_goals import goals_of
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.robots import flange_pose
from stereoservo_sim.world.simulated_cell import HAND_GOALS, demo_cell, hand_cell, simulated_cell

CELL = hand_cell()
FILE = load_cell_file(shipped_cell_path("eye_in_hand"))
SIXTY = np.deg2rad(60.0)


def body_in_flange(q: np.ndarray) -> np.ndarray:
    assert CELL.stand is not None
    return np.linalg.inv(flange_pose(CELL.robot, q)) @ CELL.stand


@pytest.mark.parametrize("k1", [0.0, -0.15])
def test_pixels_are_opencvs_of_the_body_seen_from_the_flange(k1: float) -> None:
    cell = with_lenses(CELL, {"left": k1, "right": k1})
    for q in (cell.base, *HAND_GOALS.values()):
        pose = body_in_flange(q)
        points = cell.body.marker_points @ pose[:3, :3].T + pose[:3, 3]
        for camera in cell.rig.cameras:
            flange_to_camera = camera.world_to_camera
            rotation, _ = cv2.Rodrigues(flange_to_camera[:3, :3])
            expected, _ = cv2.projectPoints(
                points, rotation, flange_to_camera[:3, 3], camera.K, np.array([k1, 0, 0, 0.0])
            )
            np.testing.assert_allclose(cell.truth_pixels(q)[camera.name], expected[:, 0], atol=1e-9)
        frame = cell.rig.world_to_rig
        np.testing.assert_allclose(cell.marker_positions_rig(q), points @ frame[:3, :3].T + frame[:3, 3], atol=1e-12)


def test_the_body_stands_and_the_cameras_move() -> None:
    moved = CELL.base + 0.1
    np.testing.assert_array_equal(CELL.marker_positions(CELL.base), CELL.marker_positions(moved))
    left = CELL.rig.camera("left")
    shift = CELL.in_world(left, moved).centre - CELL.in_world(left, CELL.base).centre
    assert np.linalg.norm(shift) > 0.05
    standing = demo_cell().rig.camera("left")
    assert demo_cell().in_world(standing, moved) is standing


def test_mount_chooses_the_cell() -> None:
    assert simulated_cell("eye_in_hand") is CELL
    assert simulated_cell("eye_to_hand") is demo_cell()
    assert goals_of(hand_cell()).keys() == goals_of(demo_cell()).keys()


def test_cell_file_fits_the_arm() -> None:
    check_joints(FILE, CELL.robot.joint_names)
    assert {camera.mount for camera in FILE.camera} == {"eye_in_hand"}
    assert FILE.calibration is not None
    assert [FILE.calibration.base[name] for name in CELL.robot.joint_names] == CELL.base.tolist()


def displacement(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    middle = CELL.body.marker_points.mean(axis=0)
    return turn, [middle @ pose[:3, :3].T + pose[:3, 3] for pose in (start, end)]


@pytest.mark.parametrize(("start", "end"), list(itertools.combinations(["base", *HAND_GOALS], 2)))
def test_goals_are_seen_at_the_ends_and_on_the_way(start: str, end: str) -> None:
    poses = {"base": CELL.base, **HAND_GOALS}
    q0, q1 = poses[start], poses[end]
    first = body_in_flange(q0)
    turn, centres = displacement(first, body_in_flange(q1))
    middle = CELL.body.marker_points.mean(axis=0)
    for s in np.linspace(0, 1, 15):
        straight = np.eye(4)
        straight[:3, :3] = Rotation.from_rotvec(s * turn).as_matrix() @ first[:3, :3]
        straight[:3, 3] = (1 - s) * centres[0] + s * centres[1] - straight[:3, :3] @ middle
        for camera in CELL.rig.cameras:  # in the flange's frame, as the straight line is
            assert CELL.turned_to(straight, camera, max_incidence=SIXTY).all()
            assert CELL.visible(q0 + s * (q1 - q0), camera, max_incidence=SIXTY).all()


def test_goals_are_as_far_as_documented() -> None:
    expected = {"near": (33, 0.18), "roll": (180, 0.14), "far": (82, 0.39)}
    for name, q in HAND_GOALS.items():
        for limit, value in zip(FILE.safety.limit, q, strict=True):
            assert limit.min + 0.1 < value < limit.max - 0.1
        turn, centres = displacement(body_in_flange(CELL.base), body_in_flange(q))
        assert np.rad2deg(np.linalg.norm(turn)) == pytest.approx(expected[name][0], abs=1)
        assert np.linalg.norm(centres[1] - centres[0]) == pytest.approx(expected[name][1], abs=0.01)


@pytest.mark.parametrize("background", ["arm", "pybullet"])
def test_images_show_the_dots_where_they_are(background: str) -> None:
    settings = RenderSettings(noise_grey=0.0, background=background)
    for camera in CELL.rig.cameras:
        renderer = Renderer(CELL, camera, settings)
        for q in (CELL.base, *HAND_GOALS.values()):
            image = renderer.render(q, np.random.default_rng(0))
            at = np.round(CELL.truth_pixels(q)[camera.name]).astype(int)
            assert (image[at[:, 1], at[:, 0]] > 140).all()


def test_the_room_moves_past_carried_cameras_and_is_drawn_seldom() -> None:
    renderer = Renderer(CELL, CELL.rig.cameras[0], RenderSettings(noise_grey=0.0, background="arm"))
    rng = np.random.default_rng(0)
    first = renderer.render(CELL.base, rng)
    turned = CELL.base + np.array([0.15, 0, 0, 0, 0, 0.4])
    frames = [renderer.render(turned, rng) for _ in range(20)]
    corner = (slice(380, 480), slice(0, 200))
    assert np.array_equal(frames[0][corner], first[corner])
    assert not np.array_equal(frames[-1][corner], first[corner])
