"""`bench detectors`: how finds are judged, and, where the photographs are here, what the product's detectors find."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoservo_drivers.detectors.tag_registration import tag_cells
from stereoservo_sim.benchmarks import features
from stereoservo_sim.benchmarks.photographs import (
    board_rows,
    corner_rows,
    dot_rows,
    finders,
    franka_rows,
    judged,
    photographs,
    reads,
)

ROOT = Path(os.environ.get("STEREOSERVO_DATA", Path(__file__).parents[4] / "shared" / "data"))
HERE = photographs(ROOT)


def test_finds_are_judged_by_their_cells_their_ids_and_their_places():
    image, corners = features.tag_picture(np.random.default_rng(5))
    truth = corners.reshape(12, 4, 2)
    assert all(reads(image, truth[k], tag_cells("36h11", k)) for k in range(12))
    assert not any(reads(image, truth[k], tag_cells("36h11", (k + 1) % 12)) for k in range(12))
    methods, _ = finders("36h11")
    assert {"aruco (stereoservo)", "cv2.aruco"} <= set(methods)
    finds = {name: [find(image)] for name, find in methods.items()}
    finds["wrong"] = [[(0, truth[1]), (1, truth[1] + 9.0), (400, truth[2]), (3, truth[3])]]
    places = [{k: truth[k] for k in range(12)}]
    right, false, shown = judged([image], finds, "36h11", [frozenset(range(12))], places)
    assert shown == 12
    assert len(right["aruco (stereoservo)"][0]) == 12
    assert false["aruco (stereoservo)"] == 0
    assert (len(right["wrong"][0]), false["wrong"]) == (1, 3)


def test_plates_drawn_into_pictures_are_found_where_they_were_drawn(tmp_path):
    rng = np.random.default_rng(6)
    for k in range(6):
        coarse = cv2.resize(
            rng.uniform(20, 220, (12, 16)).astype(np.float32), (640, 480), interpolation=cv2.INTER_CUBIC
        )
        cv2.imwrite(str(tmp_path / f"{k}.png"), coarse)
    rows = {row.detector: row for row in dot_rows(sorted(tmp_path.iterdir()), 1, 0) if row.shown}
    ours, peer = rows["dots (stereoservo)"], rows["cv2.findCirclesGrid"]
    assert ours.found >= 0.8 * ours.shown
    assert ours.false == 0
    assert ours.rms_px < 0.05
    assert peer.found > 0  # the peer's grid is drawn and counted as it should be
    assert peer.rms_px < 0.3


def test_what_is_not_here_is_told(tmp_path):
    shown = photographs(tmp_path)
    assert any("STEREOSERVO_DATA" in reason for reason in shown.missing)
    assert shown.franka == shown.webots == ()


@pytest.mark.skipif(not HERE.franka, reason="no fairo_franka/set_a in ../shared/data or $STEREOSERVO_DATA")
def test_tags_on_real_photographs_are_found_as_often_as_by_all_peers_together():
    rows, _ = franka_rows(HERE.franka, 1)
    ours, *peers = rows
    print(*rows, sep="\n")
    assert ours.found == ours.shown  # every tag that any of them found
    assert ours.false == 0
    assert all(ours.rms_px < peer.rms_px for peer in peers)


@pytest.mark.skipif(not HERE.franka, reason="no fairo_franka/set_a in ../shared/data or $STEREOSERVO_DATA")
def test_corners_that_stand_still_repeat_on_real_photographs():
    ours, flow = corner_rows(HERE.franka[::3], 1)
    assert ours.found > 0.95 * ours.shown
    assert ours.false < 0.01 * ours.shown
    assert ours.rms_px < flow.rms_px


@pytest.mark.skipif(not HERE.boards, reason="no left01.jpg: Debian's package opencv-doc has it")
def test_chessboards_on_real_photographs():
    ours, plain, _ = board_rows(HERE.boards[:13], 1)
    assert ours.found >= 12
    assert ours.rms_px < plain.rms_px
