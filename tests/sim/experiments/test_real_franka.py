"""``reproduce real-franka``: on rendered sets of known truth, on the real set, and on bad input."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from stereoservo_sim.commands.reproduce import reproduce
from stereoservo_sim.experiments.catalogue import EXPERIMENTS
from stereoservo_sim.experiments.hand_eye_data import (
    find_tags,
    register_tag,
    tag_cells,
)

WIDTH, HEIGHT = 480, 360
HAND_TAG = 17
SIDE_MM = 45.0
QUAD = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]]) * SIDE_MM / 2000

app = typer.Typer()
app.command()(reproduce)


def run(*arguments: str):
    """Exit code and the one JSON object."""
    answer = CliRunner().invoke(app, [*arguments, "--json"])
    lines = answer.stdout.splitlines()
    assert len(lines) == 1, answer.output
    return answer.exit_code, json.loads(lines[0])


def look_at(centre, target, focal, size=(WIDTH, HEIGHT)):
    """A camera (3, 4) with square pixels at ``centre``, its axis through ``target``, base z upwards."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return K @ np.hstack([R, -(R @ centre)[:, None]])


def render(quad, tag, rng, blur=0.6, noise=1.5, scale=8):
    """An image with one printed tag at ``quad`` (4, 2) [px]: supersampled, integer = pixel centre, blurred,
    noisy."""
    cell = 16
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    print_ = np.pad(
        cv2.aruco.generateImageMarker(dictionary, tag, 6 * cell).astype(np.float32), cell, constant_values=255
    )
    corners = np.array([[1, 1], [7, 1], [7, 7], [1, 7]]) * cell - 0.5  # of the print: edges between its pixels
    fine = (quad + 0.5) * scale - 0.5
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), fine.astype(np.float32))
    size = (WIDTH * scale, HEIGHT * scale)
    paper = cv2.warpPerspective(print_ / 255 * 190 + 35, H, size, flags=cv2.INTER_LINEAR, borderValue=-1.0)
    paper[paper < 30] = 110.0
    image = cv2.resize(paper, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), blur)
    return np.clip(image + rng.normal(0, noise, image.shape), 0, 255).round().astype(np.uint8)


@pytest.fixture(scope="module")
def truth():
    """Two cameras, fourteen poses, the tag's corners in the hand."""
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (14, 1, 1))
    for i, pose in enumerate(poses):
        down = Rotation.from_euler("zyx", [40 * (i % 5 - 2), 12 * (i % 3 - 1), 180 - 55 + 9 * (i % 4)], degrees=True)
        pose[:3, :3] = down.as_matrix()
        pose[:3, 3] = np.array([0.45, 0.0, 0.35]) + rng.uniform(-0.1, 0.1, 3)
    tilted = Rotation.from_euler("x", 20, degrees=True).apply(QUAD * [1, -1, 1])
    corners = tilted + np.array([0.03, -0.02, 0.06])
    target = np.array([0.45, 0.05, 0.33])
    cameras = np.stack(
        [
            look_at(np.array([0.30, 0.75, 0.65]), target, 640.0),
            look_at(np.array([0.70, 0.70, 0.55]), target, 560.0),
        ]
    )
    return poses, corners, cameras


def pixels_of(truth, pose, camera):
    """Exact corners (4, 2) [px]."""
    poses, corners, cameras = truth
    points = corners @ poses[pose][:3, :3].T + poses[pose][:3, 3]
    m = np.column_stack([points, np.ones(4)]) @ cameras[camera].T
    return m[:, :2] / m[:, 2:]


@pytest.fixture(scope="module")
def rendered(truth, tmp_path_factory):
    """A set on disk in the same layout: tag 17, cameras 0 and 3, no table tags, PNG."""
    directory = tmp_path_factory.mktemp("set")
    rng = np.random.default_rng(1)
    poses = truth[0]
    lines = ["# index,x,y,z,qx,qy,qz,qw (end effector in robot base)"]
    for i, pose in enumerate(poses):
        q = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(",".join([str(i + 1), *(f"{v:.9f}" for v in (*pose[:3, 3], *q))]))
        for camera, number in enumerate((0, 3)):
            image = render(pixels_of(truth, i, camera), HAND_TAG, rng)
            cv2.imwrite(str(directory / f"pose{i + 1:02d}_cam{number}.png"), image)
    (directory / "ee_poses.csv").write_text("\n".join(lines) + "\n")
    return directory


def test_another_set_with_another_tag_and_no_table_tags_meets_its_truth(rendered, tmp_path):
    code, answer = run(
        "real-franka", "--data", str(rendered), "--hand-tag", str(HAND_TAG), "--plot", str(tmp_path / "plots"),
        "--few-sets", "1",
    )  # fmt: skip
    assert code == 0
    assert "error" not in answer
    assert answer["images"]["with_hand_tag"] >= 24
    assert answer["images"]["registered"] == answer["images"]["with_hand_tag"]
    assert answer["median_px"] < 0.1
    assert answer["rms_px"] < 0.2
    assert answer["uncertainty"]["holds"]
    assert answer["tag_side_mm"] == pytest.approx(SIDE_MM, abs=0.2)
    assert answer["tag_sides_mm"] == pytest.approx([SIDE_MM] * 4, abs=0.4)
    assert answer["fit"]["tag_offset_m"] == pytest.approx([0.03, -0.02, 0.06], abs=2e-3)
    assert answer["table_flatness_mm"] is None
    assert "seen" in answer["table_flatness_reason"]
    assert {row["camera"] for row in answer["rows"]} == {"cam0", "cam3"}
    assert {row["fold"] for row in answer["rows"]} == {0, 1, 2, 3, 4}
    assert all(pose % 5 == row["fold"] for row in answer["rows"] for pose in row["poses"])
    assert [Path(path).stat().st_size > 10_000 for path in answer["plots"]] == [True] * 3


def test_registration_is_exact_where_subpixel_corners_are_not(truth):
    rng = np.random.default_rng(2)
    errors, opencv = [], []
    for pose in range(0, 14, 2):
        exact = pixels_of(truth, pose, 0)
        image = render(exact, HAND_TAG, rng)
        start = find_tags(image)[HAND_TAG]
        view = register_tag(image, start, tag_cells(HAND_TAG))
        assert view.registered
        errors.append(view.corners - exact)
        opencv.append(start - exact)
    assert np.sqrt(np.mean(np.square(errors))) < 0.06
    assert np.sqrt(np.mean(np.square(errors))) < 0.4 * np.sqrt(np.mean(np.square(opencv)))


def copy_set(source, target, images=True):
    target.mkdir()
    for path in source.iterdir():
        if images or path.suffix == ".csv":
            shutil.copy(path, target / path.name)
    return target


def edit_line(directory, line, text):
    lines = (directory / "ee_poses.csv").read_text().splitlines()
    lines[line - 1] = text
    (directory / "ee_poses.csv").write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("text", "column"),
    [
        ("3,0.1,0.2,abc,0,0,0,1", "z"),
        ("3,0.1,nan,0.3,0,0,0,1", "y"),
        ("3,0.1,0.2,0.3,0,0,0", "qw"),
        ("3,0.1,0.2,0.3,0,0,0,1,5", "#9"),
        ("3,0.1,0.2,0.3,0,0,0.5,0.5", "qx..qw"),
        ("3.5,0.1,0.2,0.3,0,0,0,1", "index"),
        ("-3,0.1,0.2,0.3,0,0,0,1", "index"),
        ("1,0.1,0.2,0.3,0,0,0,1", "index"),
    ],
)
def test_a_malformed_table_is_named_with_line_and_column(rendered, tmp_path, text, column):
    directory = copy_set(rendered, tmp_path / "set")
    edit_line(directory, 4, text)
    code, answer = run("real-franka", "--data", str(directory), "--hand-tag", str(HAND_TAG))
    assert code == 1
    assert answer["error"]["code"] == "csv"
    assert (answer["error"]["line"], answer["error"]["column"]) == (4, column)
    assert f"line 4, column {column}" in answer["error"]["message"]


def test_missing_folder_table_and_images_are_told_apart(rendered, tmp_path):
    assert run("real-franka")[1]["error"]["code"] == "option"
    code, answer = run("real-franka", "--data", str(tmp_path / "absent"))
    assert (code, answer["error"]["code"]) == (1, "data_missing")
    assert str(tmp_path / "absent") in answer["error"]["message"]
    bare = copy_set(rendered, tmp_path / "bare", images=False)
    assert run("real-franka", "--data", str(bare))[1]["error"]["code"] == "no_images"
    copy = copy_set(rendered, tmp_path / "copy")
    (copy / "ee_poses.csv").unlink()
    answer = run("real-franka", "--data", str(copy))[1]
    assert answer["error"]["code"] == "data_missing"
    assert "ee_poses.csv" in answer["error"]["message"]


def test_an_unreadable_image_and_one_of_another_size_are_named(rendered, tmp_path):
    directory = copy_set(rendered, tmp_path / "set")
    (directory / "pose02_cam0.png").write_bytes(b"no image")
    answer = run("real-franka", "--data", str(directory), "--hand-tag", str(HAND_TAG))[1]
    assert answer["error"]["code"] == "image"
    assert "pose02_cam0.png" in answer["error"]["message"]
    cv2.imwrite(str(directory / "pose02_cam0.png"), np.zeros((20, 30), dtype=np.uint8))
    answer = run("real-franka", "--data", str(directory), "--hand-tag", str(HAND_TAG))[1]
    assert answer["error"]["code"] == "image_size"
    assert "30x20" in answer["error"]["message"]


def test_an_image_without_a_pose_is_named(rendered, tmp_path):
    directory = copy_set(rendered, tmp_path / "set")
    shutil.copy(directory / "pose02_cam0.png", directory / "pose77_cam0.png")
    answer = run("real-franka", "--data", str(directory), "--hand-tag", str(HAND_TAG))[1]
    assert answer["error"]["code"] == "pose_missing"
    assert answer["error"]["index"] == 77


def test_a_tag_that_is_never_seen_or_not_in_the_dictionary_is_named(rendered):
    answer = run("real-franka", "--data", str(rendered), "--hand-tag", "30")[1]
    assert answer["error"]["code"] == "tag_not_seen"
    assert answer["error"]["images"] == 28
    answer = run("real-franka", "--data", str(rendered), "--hand-tag", "50")[1]
    assert answer["error"]["code"] == "tag_id"
    assert "0..49" in answer["error"]["message"]


def test_too_few_poses_are_counted(rendered, tmp_path):
    directory = copy_set(rendered, tmp_path / "set")
    for path in directory.glob("pose*_cam*.png"):
        if int(path.name[4:6]) > 5:
            path.unlink()
    code, answer = run("real-franka", "--data", str(directory), "--hand-tag", str(HAND_TAG))
    assert code == 1
    assert answer["error"]["code"] == "too_few_poses"
    assert answer["error"]["needed"] == 6


def test_an_arm_that_did_not_move_is_refused(rendered, tmp_path):
    directory = copy_set(rendered, tmp_path / "set")
    lines = [f"{i},0.4,0.0,0.3,1,0,0,0" for i in range(1, 15)]
    (directory / "ee_poses.csv").write_text("\n".join(lines))
    code, answer = run("real-franka", "--data", str(directory), "--hand-tag", str(HAND_TAG))
    assert (code, answer["error"]["code"]) == (1, "joint_did_not_move")


def test_a_tag_that_does_not_follow_the_hand_is_refused(rendered, tmp_path):
    directory = copy_set(rendered, tmp_path / "set")
    for path in directory.glob("pose*_cam*.png"):
        if path.name[:6] != "pose01":
            shutil.copy(directory / f"pose01_{path.name[7:]}", path)
    code, answer = run("real-franka", "--data", str(directory), "--hand-tag", str(HAND_TAG))
    assert (code, answer["error"]["code"]) == (1, "tag_stands_still")
    assert answer["error"]["tag"] == HAND_TAG


def test_an_unknown_experiment_lists_the_known_ones():
    code, answer = run("no-such-thing")
    assert code == 1
    assert answer["error"]["known"] == sorted(EXPERIMENTS)
    assert "real-franka" in answer["error"]["message"]


def real_set():
    """The recorded set, where it lies beside the repository or below ``$STEREOSERVO_DATA``."""
    roots = [Path(__file__).resolve().parents[3] / ".." / "shared" / "data"]
    if "STEREOSERVO_DATA" in os.environ:
        roots.insert(0, Path(os.environ["STEREOSERVO_DATA"]))
    for root in roots:
        if (root / "fairo_franka" / "set_a").is_dir():
            return root / "fairo_franka" / "set_a"
    return None


@pytest.mark.skipif(real_set() is None, reason="no fairo_franka/set_a in ../shared/data or $STEREOSERVO_DATA")
def test_held_out_poses_of_the_real_arm_are_predicted_better_than_the_reference():
    code, answer = run("real-franka", "--data", str(real_set()))
    assert code == 0
    assert answer["images"]["by_camera"] == {"cam0": 12, "cam1": 15, "cam2": 20}
    assert answer["corners"] == 4 * 47
    assert answer["not_predicted"] == 0
    assert answer["median_px"] <= 0.26
    assert answer["rms_px"] <= 0.43
    told = answer["uncertainty"]
    assert told["interval"][0] <= told["inside"] <= told["interval"][1]
    assert told["beyond_4_sigmas"] == 0
    assert told["median_px"] <= 0.4  # held by being right, not by being wide
    few = answer["few_poses"]
    assert (few["poses"], few["sets"]) == (12, 10)
    assert few["refused"] <= 2
    assert few["corners"] > 600
    assert few["beyond_4_sigmas"] <= 2  # of so many corners, exp(-8) each: more by chance in 1 of 490 cases
    assert all("not_identifiable" in row["refused"] for row in few["rows"] if "refused" in row)
    assert [len(one["cameras"]) for one in answer["triangulation"]] == [2, 2, 2, 3]
    assert all(one["rms_mm"] <= 0.8 for one in answer["triangulation"])
    assert answer["tag_side_mm"] == pytest.approx(40.0, abs=0.3)
    assert answer["table_flatness_mm"] <= 0.48
    without = answer["variants"]["cv2 subpixel corners, no lens"]
    assert without["median_px"] <= 0.66  # the reference's own method reproduces the reference
    assert without["rms_px"] <= 0.87
