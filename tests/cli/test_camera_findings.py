"""What is said of cameras, against pictures and views of known truth."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from stereoservo.cli.doctor.camera_findings import (
    CameraRecord,
    contrast_and_blur,
    examine_record,
    examine_skew,
    mean_observations,
    near_border,
)
from stereoservo.cli.doctor.cameras import examine_views, reprojection_rms
from stereoservo.geometry.cameras import project_many
from stereoservo.kinematics.model import CameraModel
from stereoservo.ports.devices import (
    CameraDescription,
    CameraObservation,
    CameraStatistics,
    ExaminationFinding,
    Frame,
)
from stereoservo_sim.world.synthetic import rotation

RATE = 30.0
LEFT = np.array([[900.0, 0, 320, 0], [0, 900, 240, 0], [0, 0, 1, 1.0]])
RIGHT = np.array([[860.0, 40, 330, -180], [-20, 900, 250, 10], [0.1, 0.02, 1, 1.05]])


def description(name: str, ids: tuple[int, ...] = tuple(range(14))) -> CameraDescription:
    return CameraDescription("x", name, 640, 480, RATE, "frames", 1000.0, ids)


def observation(
    name: str,
    seq: int,
    pixels: np.ndarray,
    *,
    phase_ms: float = 0.0,
    latency_ms: float = 40.0,
    sigma: float = 0.05,
) -> CameraObservation:
    shutter = round(seq * 1e9 / RATE + phase_ms * 1e6)
    ids = np.arange(len(pixels), dtype=np.int64)
    covariances = np.broadcast_to(sigma**2 * np.eye(2), (len(pixels), 2, 2)).copy()
    return CameraObservation(name, seq, shutter, shutter + round(latency_ms * 1e6), ids, pixels, covariances)


def record(name: str, pixels: np.ndarray, *, seed: int = 1, frames: int = 60, phase_ms: float = 0.0) -> CameraRecord:
    rng = np.random.default_rng(seed)
    seen = [observation(name, k, pixels + rng.normal(0, 0.05, pixels.shape), phase_ms=phase_ms) for k in range(frames)]
    return CameraRecord(description(name), seen)


def named(findings: list[ExaminationFinding], name: str) -> ExaminationFinding:
    return next(finding for finding in findings if finding.name == name)


def points(seed: int = 7, n: int = 14) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-0.2, 0.2, (n, 3)), np.ones((n, 1))], axis=1)


def test_a_good_camera_has_good_findings() -> None:
    left = record("left", project_many(LEFT[None], points())[0])
    found = list(examine_record(left, min_markers=7))
    assert all(finding.ok for finding in found)
    assert "30.0 Hz of 30" in named(found, "left rate").message
    assert named(found, "left latency").message.startswith("40.0 ms")
    assert "14 of 14" in named(found, "left markers").message


def test_rate_is_that_of_the_source_where_the_driver_counts() -> None:
    left = record("left", project_many(LEFT[None], points())[0])
    left.statistics = CameraStatistics(frames=20, dropped=10, settings={"exposure": (10.0, 25.0)})
    left.watched_s = 2.0
    found = named(list(examine_record(left, 7)), "left rate")
    assert found.ok is None
    assert "10.0 Hz of 30" in found.message
    assert "10 dropped" in found.message
    assert "exposure asked 10, is 25" in found.message
    assert "rate_hz = 10" in found.remedy


def test_frames_that_this_computer_left_out_are_no_fault_of_the_camera() -> None:
    left = record("left", project_many(LEFT[None], points())[0])
    left.seen[:] = left.seen[::3]  # every third was looked at: the numbers of the others are missing
    found = named(list(examine_record(left, 7)), "left rate")
    assert found.ok is None
    assert "10.0 Hz of 30" in found.message
    assert found.remedy.startswith("the camera delivers 30 Hz, this computer keeps up with 10.0")


def test_no_frame_an_error_no_marker_and_a_mirrored_plate_are_told_apart() -> None:
    silent = CameraRecord(description("left"))
    (finding,) = examine_record(silent, 7)
    assert finding.ok is False
    assert "0 frames" in finding.message
    broken = CameraRecord(description("left"), error="/dev/video0: no such device")
    assert [f.message for f in examine_record(broken, 7)] == ["/dev/video0: no such device"]
    empty = record("left", np.zeros((0, 2)))
    assert "none of 14" in named(list(examine_record(empty, 7)), "left markers").message
    empty.flipped = 14
    mirrored = named(list(examine_record(empty, 7)), "left markers")
    assert mirrored.ok is False
    assert "14 in the mirror image" in mirrored.message
    assert "mirrored" in mirrored.remedy


def test_too_few_markers_fail_and_say_in_how_many_frames() -> None:
    left = record("left", project_many(LEFT[None], points())[0], frames=10)
    left.seen[:5] = [observation("left", k, np.zeros((2, 2))) for k in range(5)]
    found = named(list(examine_record(left, 7)), "left markers")
    assert found.ok is False
    assert "enough in 50 % of the frames" in found.message


@pytest.mark.parametrize("blur", [0.7, 1.5, 3.0])
def test_blur_of_an_edge_is_that_of_the_gaussian(blur: float) -> None:
    fine = np.zeros((480, 640))
    fine[:, 320:] = 150.0
    image = np.rint(cv2.GaussianBlur(fine, (0, 0), blur) + 40).astype(np.uint8)
    found = contrast_and_blur(image, np.array([319.5, 240.0]))
    assert found is not None
    assert found[0] == pytest.approx(150.0, abs=2)
    assert found[1] == pytest.approx(blur, rel=0.25)  # the grid widens sharp edges
    assert found[2] == 0.0
    assert contrast_and_blur(image, np.array([3.0, 240.0])) is None


def test_flat_and_white_pictures_are_told() -> None:
    pixels = np.array([[100.0, 100.0], [200.0, 200.0]])
    left = record("left", pixels)
    grey = np.full((480, 640), 90, np.uint8)
    grey[:, ::2] += 10
    left.frame = Frame("left", 59, 0, 0, grey)
    assert named(list(examine_record(left, 2)), "left contrast").ok is None
    white = np.full((480, 640), 255, np.uint8)
    white[:, ::4] = 30
    left.frame = Frame("left", 59, 0, 0, white)
    assert "shorter exposure" in named(list(examine_record(left, 2)), "left exposure").remedy


def test_skew_is_told_with_its_sign() -> None:
    pixels = project_many(LEFT[None], points())[0]
    left, right = record("left", pixels, phase_ms=15.0), record("right", pixels)
    (finding,) = examine_skew([left, right])
    assert finding.ok
    assert finding.message.startswith("+15.0 ms")


def test_the_mean_keeps_markers_of_most_frames() -> None:
    pixels = project_many(LEFT[None], points())[0]
    left = record("left", pixels, frames=200)
    left.seen[0] = observation("left", 0, np.vstack([pixels, [[1.0, 1.0]]]))
    ids, mean, sigma = mean_observations(left)
    assert ids.tolist() == list(range(14))
    assert np.abs(mean - pixels).max() < 5 * 0.05 / np.sqrt(200)
    assert sigma == pytest.approx(0.05)


def test_markers_at_the_border_are_named() -> None:
    left = record("left", np.array([[5.0, 100.0], [300.0, 300.0], [300.0, 475.0]]))
    finding = near_border(left)
    assert finding is not None
    assert "[0, 2]" in finding.message
    assert near_border(record("left", np.array([[300.0, 300.0]]))) is None


def views(seed: int = 3) -> tuple[CameraRecord, CameraRecord]:
    pixels = project_many(np.array([LEFT, RIGHT]), points())
    return record("left", pixels[0], seed=seed), record("right", pixels[1], seed=seed + 1)


def test_views_without_a_model_agree_or_name_the_marker_that_does_not() -> None:
    left, right = views()
    (finding,) = examine_views([left, right], None)
    assert finding.ok, finding
    for k, seen in enumerate(right.seen):
        moved = seen.pixels.copy()
        moved[4, 1] += 30.0
        right.seen[k] = observation("right", seen.seq, moved)
    (finding,) = examine_views([left, right], None)
    assert finding.ok is False
    assert "[4]" in finding.message


@pytest.mark.parametrize("modelled", [False, True])
def test_views_of_markers_in_motion_are_not_compared(modelled: bool) -> None:
    """An episode is played back: means over time of a moving body are of no one place, and markers were said to be
    mistaken for others.
    """
    cameras = (CameraModel("left", LEFT, 640, 480), CameraModel("right", RIGHT, 640, 480))
    model = SimpleNamespace(cameras=cameras) if modelled else None
    records = views()
    for k in range(60):
        turned = points()
        turned[:, :3] = turned[:, :3] @ rotation("y", 1.0 * k)[:3, :3].T @ rotation("z", 0.5 * k)[:3, :3].T
        for one, P in zip(records, (LEFT, RIGHT), strict=True):
            one.seen[k] = observation(one.description.name, k, project_many(P[None], turned)[0])
    (finding,) = examine_views(records, model)
    assert finding.ok is None
    assert "move" in finding.message
    assert "px" in finding.message


def test_views_by_the_models_cameras() -> None:
    cameras = (CameraModel("left", LEFT, 640, 480), CameraModel("right", RIGHT, 640, 480))
    pixels = project_many(np.array([LEFT, RIGHT]), points())
    rng = np.random.default_rng(5)
    rms = [reprojection_rms(cameras, pixels + rng.normal(0, 0.2, pixels.shape)) for _ in range(200)]
    # 56 coordinates less 42 of the points: the mean of the squares is the variance, its error that of 2800 freedoms.
    assert np.mean(np.square(rms)) == pytest.approx(0.04, rel=4 * np.sqrt(2 / (200 * 14)))
    assert reprojection_rms(cameras[::-1], pixels) > 5.0
    bumped = pixels + np.array([[[0.0, 0.0]], [[6.0, 9.0]]])
    assert reprojection_rms(cameras, bumped) > 2.0
