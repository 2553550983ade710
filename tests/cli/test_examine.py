"""The verb ``examine``: folders of tables and of real pictures, flights, and what it says of files that are wrong."""

from __future__ import annotations

import csv
import json
import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.calibration.known_arm import free_arm
from stereoservo.cli.examine import read_folder
from stereoservo.cli.main import invoke
from stereoservo_sim.experiments.examined_recordings import examined_case

BUMPED = 5
"""Seed of a case whose camera cam1 is moved before its frame 386."""


def write_table(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def write_folder(folder: Path, views: RecordedViews) -> None:
    """A recording in the format of docs/recordings.md, joints in degrees."""
    names = [f"{name}[deg]" for name in views.joint_names]
    joints = np.degrees(views.positions)
    write_table(
        folder / "joints.csv",
        ["t", *names],
        [[t, *q] for t, q in zip(views.joint_times, joints, strict=True)],
    )
    write_table(
        folder / "cameras.csv",
        ["camera", "width", "height"],
        [[c.name, c.width, c.height] for c in views.cameras],
    )
    rows = []
    for k in range(len(views.camera)):
        name = views.cameras[views.camera[k]].name
        seen = np.flatnonzero(views.seen[k])
        rows += [[name, views.times[k], views.marker_ids[i], *views.pixels[k, i], views.sigmas[k, i]] for i in seen]
        if not len(seen):
            rows.append([name, views.times[k], "", "", "", ""])
    write_table(folder / "markers.csv", ["camera", "t", "marker", "u", "v", "sigma"], rows)


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = invoke(["examine", *arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_a_folder_of_tables_is_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    views = examined_case(BUMPED).views
    write_folder(tmp_path, views)
    read = read_folder(tmp_path)
    assert np.nanmax(np.abs(read.pixels - views.pixels)) < 1e-9
    assert np.abs(read.positions - views.positions).max() < 1e-12
    code, report = told(capsys, str(tmp_path))
    assert code == 0  # a cause is no failure
    (cause,) = report["causes"]
    assert (cause["kind"], cause["subject"]) == ("camera_moved", "cam1")
    assert abs(cause["onset"]["frame"] - 386) <= 2
    assert cause["effect_px"] == pytest.approx(3.97, rel=0.1)
    assert report["rms_px"] == pytest.approx(0.333, rel=0.05)
    assert report["before_px"] > 2.0 * report["rms_px"]


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda folder: (folder / "joints.csv").unlink(), "one of joints.csv and poses.csv"),
        (lambda folder: (folder / "cameras.csv").unlink(), "cameras.csv"),
        (
            lambda folder: (folder / "joints.csv").write_text("t,j1[turns]\n0,1\n"),
            "units are rad, deg, m, mm",
        ),
        (lambda folder: (folder / "joints.csv").write_text("t,j1\n0,1\n1,nan\n"), "line 3, column j1"),
        (
            lambda folder: (folder / "markers.csv").write_text("camera,t,marker,u,v\nup,0,1,2,3\n"),
            "one of left",
        ),
        (
            lambda folder: (folder / "markers.csv").write_text("camera,index,marker,u,v\nleft,0,1,2,3\n"),
            "no column 't'",
        ),
        (
            lambda folder: (folder / "markers.csv").write_text("camera,t,u,v\nleft,0,1,2\n"),
            "lacks columns marker",
        ),
        (
            lambda folder: (folder / "markers.csv").write_text("camera,t,marker,u,v\nleft,0,1e30,2,3\n"),
            "line 2, column marker: '1e30'; needed: a whole number from 0",
        ),
        (
            lambda folder: (folder / "markers.csv").write_text("camera,t,marker,u,v\nleft,0,1,2\n"),
            "line 2: 'left,0,1,2': 4 cells, 5 are needed",
        ),
        (
            lambda folder: (folder / "cameras.csv").write_text("camera,width,height\nleft,0,480\n"),
            "line 2, column width: '0'",
        ),
    ],
)
def test_a_wrong_folder_is_refused_with_what_would_be_right(
    damage: Any, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "joints.csv").write_text("t,j1\n0,1\n1,2\n")
    (tmp_path / "cameras.csv").write_text("camera,width,height\nleft,640,480\n")
    (tmp_path / "markers.csv").write_text("camera,t,marker,u,v\nleft,0,1,2,3\n")
    damage(tmp_path)
    code, answer = told(capsys, str(tmp_path))
    assert code == 1
    assert answer["error"]["code"] == "dataset"
    assert named in answer["error"]["message"]


def test_what_is_no_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, str(tmp_path / "nothing"))[1]["error"]["code"] == "dataset"
    (tmp_path / "flight.mcap").write_bytes(b"no recording")
    assert told(capsys, str(tmp_path / "flight.mcap"))[0] == 1


def test_a_flight_without_trial_motions_is_judged_by_the_model_in_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    flight = Path(__file__).parents[1] / "recordings" / "flight-1.mcap"
    code, report = told(capsys, str(flight))
    assert code == 0
    assert report["learnt_from"] is None
    assert report["stratum"] == "metric"
    assert report["causes"] == []
    assert 0.05 < report["rms_px"] < 0.2


def folder_of_pictures(folder: Path) -> np.ndarray:
    """Pictures of a chessboard from a hand, numbered from 1, its poses (n, 4, 4) by rotation vectors and millimetres
    with decimal commas, as a spreadsheet leaves them, and the board.
    """
    rng = np.random.default_rng(7)
    squares = np.kron(np.indices((7, 8)).sum(axis=0) % 2, np.ones((40, 40))) * 255
    sheet = np.pad(squares, 40, constant_values=255).astype(np.uint8)
    K, views = np.array([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]]), 8
    rigid = np.tile(np.eye(4), (views + 2, 1, 1))
    turns = rng.uniform(-0.4, 0.4, (views + 2, 3)) + np.concatenate([np.zeros((views, 3)), [[0, 0, 2], [3, 0, 0]]])
    rigid[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    rigid[:, :3, 3] = rng.uniform(-0.02, 0.02, (views + 2, 3)) + np.array(
        [[-0.05, -0.04, 0.45]] * views + [[0.0, 0.0, 0.1], [0.6, 0.0, 0.0]]
    )
    board, (hand, base) = rigid[:views], rigid[views:]
    to_metres = np.array([[0.00057, 0.0, -0.05], [0.0, 0.00057, -0.05], [0.0, 0.0, 1.0]])
    for k, one in enumerate(board, 1):
        homography = K @ one[:3, [0, 1, 3]] @ to_metres
        cv2.imwrite(str(folder / f"view{k}.png"), cv2.warpPerspective(sheet, homography, (640, 480), borderValue=255))
    poses: np.ndarray = base @ np.linalg.inv(board) @ np.linalg.inv(hand)
    values = np.hstack([1e3 * poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()])
    rows = [";".join([str(k), *(f"{value:.6f}" for value in row)]).replace(".", ",") for k, row in enumerate(values)]
    (folder / "positionen.csv").write_text("\n".join(["Größe in mm", *rows]), encoding="utf-16")
    (folder / "board.json").write_text('{"type": "chessboard", "rows": 6, "cols": 7, "square_m": 0.0228}')
    return poses


def test_pictures_and_poses_in_a_convention_that_nobody_states_are_read(tmp_path: Path) -> None:
    poses = folder_of_pictures(tmp_path)
    views = read_folder(tmp_path)
    assert np.abs(views.positions - free_arm(poses)[0]).max() < 1e-5
    assert len(views.times) == len(poses)
    assert views.seen.all()
    notes = "; ".join(views.notes)
    assert "rotation-vector rad position-first" in notes
    assert "lengths are in mm" in notes
    assert "poses from 0 and pictures from 1" in notes


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda folder: (folder / "positionen.csv").unlink(), "none holds poses"),
        (lambda folder: (folder / "board.json").unlink(), "detector.toml"),
        (lambda folder: (folder / "board.json").write_text('{"type": "circles"}'), "chessboard, charuco"),
        (lambda folder: shutil.copy(folder / "positionen.csv", folder / "others.csv"), "give --poses FILE"),
    ],
)
def test_pictures_that_cannot_be_read_with_poses_are_refused_with_what_is_needed(
    damage: Any, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder_of_pictures(tmp_path)
    damage(tmp_path)
    code, answer = told(capsys, str(tmp_path))
    assert code == 1
    assert named in answer["error"]["message"]


def real_set() -> Path | None:
    """The recorded set, where it lies beside the repository or below ``$STEREOSERVO_DATA``."""
    roots = [Path(__file__).resolve().parents[2] / ".." / "shared" / "data"]
    if "STEREOSERVO_DATA" in os.environ:
        roots.insert(0, Path(os.environ["STEREOSERVO_DATA"]))
    folders = [root / "fairo_franka" / "set_a" for root in roots]
    return next((folder for folder in folders if folder.is_dir()), None)


@pytest.mark.skipif(real_set() is None, reason="no fairo_franka/set_a in ../shared/data or $STEREOSERVO_DATA")
@pytest.mark.parametrize("moved_from", [None, 12])
def test_real_pictures_of_an_arm_whose_poses_are_known(
    moved_from: int | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A Franka arm before three cameras; of the last one the pictures from some pose on are shifted by (-4, 3) px."""
    source = real_set()
    assert source is not None
    poses = (source / "ee_poses.csv").read_text().splitlines()[1:]
    (tmp_path / "poses.csv").write_text("\n".join(["index,x,y,z,qx,qy,qz,qw", *poses]))
    (tmp_path / "detector.toml").write_text('detector = "aruco"\n[options]\ntags = [9]\ndictionary = "4x4_50"\n')
    rows = []
    for path in sorted(source.glob("pose*.jpg")):
        pose, camera = path.stem.split("_")
        number, target = int(pose.removeprefix("pose")), tmp_path / f"{path.stem}.png"
        if moved_from is not None and camera == "cam2" and number >= moved_from:
            cv2.imwrite(str(target), np.roll(cv2.imread(str(path)), (3, -4), axis=(0, 1)))
        else:
            target = tmp_path / path.name
            shutil.copy(path, target)
        rows.append([camera, number, target.name])
    write_table(tmp_path / "frames.csv", ["camera", "index", "file"], rows)
    code, report = told(capsys, str(tmp_path))
    assert code == 0
    if moved_from is None:
        assert report["causes"] == []
        assert report["rms_px"] < 0.3
        return
    (cause,) = report["causes"]
    assert (cause["kind"], cause["subject"], cause["onset"]["frame"]) == ("camera_moved", "cam2", moved_from)
    assert cause["effect_px"] == pytest.approx(5.0, abs=0.6)


def test_tables_that_a_spreadsheet_saved_are_those_that_were_meant(tmp_path: Path) -> None:
    """Semicolons, decimal commas, blank lines, code page 1252, and a last line that is cut."""
    plain, odd = tmp_path / "plain", tmp_path / "odd"
    for folder in (plain, odd):
        folder.mkdir()
        (folder / "cameras.csv").write_text("camera,width,height\nleft,640,480\n")
    joints = "t,höhe[deg]\n0.5,1.25\n1.5,-2\n2.5,3e-1\n"
    markers = "camera,t,marker,u,v\nleft,0.5,1,2.5,3\nleft,1.5,1,2.75,3\n"
    (plain / "joints.csv").write_text(joints)
    (plain / "markers.csv").write_text(markers)
    in_german = (text.replace(",", ";").replace(".", ",").replace("\n", "\r\n\r\n") for text in (joints, markers))
    for name, text in zip(("joints.csv", "markers.csv"), in_german, strict=True):
        (odd / name).write_bytes(f"{text}left;2".encode("cp1252") if name == "markers.csv" else text.encode("cp1252"))
    meant, read = read_folder(plain), read_folder(odd)
    assert read.joint_names == meant.joint_names == ("höhe",)
    for name in ("joint_times", "positions", "times", "pixels"):
        assert np.array_equal(getattr(read, name), getattr(meant, name))
