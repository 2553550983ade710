"""The detector of natural features on textured bodies of known geometry: ids, accuracy, drift, recovery."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoservo.ports.devices import DriverContext, DriverError, Frame, Prior
from stereoservo_drivers.contracts import DetectorContract
from stereoservo_drivers.detectors.corners import CornerDetector
from stereoservo_drivers.detectors.landmark_learning import LearningSettings, learn_landmarks
from stereoservo_drivers.detectors.landmarks import KINDS, encode_landmarks

from .scenes import Still
from .textured import Face, Scene, box, pose, rotation, stereo, texture

TOOL = KINDS.index("tool")
WALL = pose(rotation(y=12), (0, 0, 1.4))
HOME = pose(rotation(25, -35, 5), (0, 0, 0.95))


class Cell:
    """A textured box before a textured wall, two cameras, and landmarks learnt there."""

    def __init__(self, directory: Path) -> None:
        rng = np.random.default_rng(3)
        self.cameras = stereo()
        self.scene = Scene([box(rng, (0.3, 0.25, 0.15), side=160), [wall(rng)]])
        after = pose(rotation(25, -35, 25), (0.03, 0.02, 0.95))
        before, moved = (
            {name: [self.scene.render(c, [T, WALL], rng, 2.0)] for name, c in self.cameras.items()}
            for T in (HOME, after)
        )
        self.landmarks, self.report = learn_landmarks(before, moved, LearningSettings(tilts=0, most=80))
        self.directory = directory
        (directory / "landmarks.npz").write_bytes(encode_landmarks(self.landmarks))
        self.tool = self.landmarks.kinds == TOOL

    def context(self, camera: str = "left") -> DriverContext:
        return DriverContext(
            clock=Still(), cell="c", runtime_dir=self.directory, cell_dir=self.directory, camera=camera
        )

    def detector(self, **options) -> CornerDetector:
        return CornerDetector({"landmarks": "landmarks.npz", **options}, self.context())

    def image(self, tool, rng, noise=2.0, scene=None, **light):
        return (scene or self.scene).render(self.cameras["left"], [tool, WALL], rng, noise, **light)

    def truth(self, tool) -> np.ndarray:
        """Where the landmarks are (m, 2) in the left image, hidden or not."""
        reference = self.landmarks.camera("left").pixels
        return self.scene.follow(self.cameras["left"], reference, [HOME, WALL], [tool, WALL])

    def rows(self, observation) -> np.ndarray:
        return np.searchsorted(self.landmarks.ids, observation.ids)


def wall(rng) -> Face:
    return Face(texture(rng, 360), np.array([-0.9, -0.7, 0]), np.array([1.8, 0, 0]), np.array([0, 1.4, 0]))


def frame(seq, image) -> Frame:
    t_ns = 1_000_000_000 + 33_000_000 * seq
    return Frame("left", seq, t_ns, t_ns + 4_000_000, image)


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Cell:
    return Cell(tmp_path_factory.mktemp("corners"))


class TestCornerDetector(DetectorContract):
    accuracy_px = 0.2
    least_markers = 30

    @pytest.fixture(autouse=True)
    def _cell(self, cell):
        self.cell = cell

    def make_context(self, tmp_path):
        return replace(super().make_context(tmp_path), cell_dir=self.cell.directory)

    def make_detector(self, context):
        return CornerDetector({"landmarks": "landmarks.npz"}, context)

    def frame(self, image, seq=7):
        # Pictures of other sizes are refused: the contract's come at the size of the reference.
        height, width = self.cell.landmarks.camera("left").picture.shape
        return super().frame(np.ascontiguousarray(image[:height, :width]), seq)

    def make_scene(self):
        rng = np.random.default_rng(11)
        tool = pose(rotation(20, -30, 20), (0.02, -0.03, 1.0))
        ids, truth = self.cell.landmarks.ids.tolist(), self.cell.truth(tool).tolist()
        return self.cell.image(tool, rng), {marker: tuple(pixel) for marker, pixel in zip(ids, truth, strict=True)}


def motion(k: int) -> np.ndarray:
    """The tool after ``k`` frames: it sways, turns by 25° and comes nearer and goes."""
    a = 2 * np.pi * k / 100
    turn = rotation(25 + 12 * np.sin(a), -35 + 10 * np.sin(a / 2), 5 + 25 * np.sin(a / 3))
    return pose(turn, (0.08 * np.sin(a), 0.06 * np.sin(1.3 * a), 0.95 + 0.1 * np.sin(0.7 * a)))


def run_track(cell, frames, noise, seed=7):
    """Distances of the tool's landmarks from the truth, frame by frame [px]; Mahalanobis squares; the median
    distance of a chain of flow alone; and distances in the last frame alone, of a new detector.
    """
    rng = np.random.default_rng(seed)
    detector, anchored, squares, chained = cell.detector(), [], [], []
    before = points = alive = None
    for k in range(frames):
        image, truth = cell.image(motion(k), rng, noise), cell.truth(motion(k))
        observation = detector.detect(frame(k, image), None)
        rows = cell.rows(observation)
        errors = (observation.pixels - truth[rows])[cell.tool[rows]]
        covariances = observation.covariances[cell.tool[rows]]
        anchored.append(np.linalg.norm(errors, axis=1))
        squares.append(np.einsum("ki,ki->k", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]))
        if before is None:
            points = truth[cell.tool].astype(np.float32).reshape(-1, 1, 2)
            alive = np.ones(len(points), bool)
        else:
            points, found, _ = cv2.calcOpticalFlowPyrLK(before, image, points, None, winSize=(21, 21))
            alive &= found.ravel() == 1
        before = image
        chained.append(float(np.median(np.linalg.norm(points.reshape(-1, 2) - truth[cell.tool], axis=1)[alive])))
    again = cell.detector().detect(frame(0, image), None)
    rows = cell.rows(again)
    fresh = np.linalg.norm((again.pixels - truth[rows])[cell.tool[rows]], axis=1)
    return anchored, np.concatenate(squares), chained, fresh


def check_drift(cell, frames, noise):
    anchored, squares, chained, fresh = run_track(cell, frames, noise)
    late = np.concatenate(anchored[-frames // 4 :])
    assert min(len(found) for found in anchored) >= 0.7 * cell.tool.sum()
    assert np.sqrt(np.mean(late**2)) <= 0.08
    assert max(np.concatenate(anchored)) <= 1.0
    # What a detector that has seen nothing before says of the last frame: history leaves no trace.
    assert np.median(anchored[-1]) <= 1.2 * np.median(fresh)
    # Two degrees of freedom each; errors of one landmark hang together over frames: within a factor.
    assert 0.4 <= squares.mean() / 2 <= 2.5
    assert chained[-1] > 5 * np.median(late)
    return chained


def test_an_anchored_track_does_not_drift_where_flow_alone_does(cell):
    chained = check_drift(cell, 40, 2.0)
    assert chained[-1] > 1.5 * chained[5]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
def test_three_hundred_frames_do_not_drift(cell, noise):
    check_drift(cell, 300, noise)


def scattered(rng) -> np.ndarray:
    turn = rotation(*rng.uniform(-30, 30, 2), rng.uniform(-180, 180)) @ rotation(25, -35, 5)
    return pose(turn, (rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.7, 1.3)))


def acquire(cell, count, seed):
    """Acquisitions of the tool anywhere before walls never seen; every seventh without it: found, reported, wrong."""
    rng = np.random.default_rng(seed)
    detector = cell.detector()
    found = reported = wrong = 0
    for k in range(count):
        absent = k % 7 == 6
        tool = pose(t=(0.0, 0.0, -5.0)) if absent else scattered(rng)
        scene = Scene([cell.scene.bodies[0], [wall(rng)]])
        image = cell.image(tool, rng, rng.choice([0.0, 2.0, 5.0]), scene, gain=rng.uniform(0.7, 1.1))
        observation = detector.detect(frame(count - k, image), None)  # backwards: no track
        rows = cell.rows(observation)
        of_tool = rows[cell.tool[rows]]
        found += len(of_tool) > 0
        reported += len(rows)
        wrong += len(rows) - len(of_tool)  # none of the learnt wall is there
        if absent:
            wrong += len(of_tool)
        elif len(of_tool):
            errors = np.linalg.norm(observation.pixels[cell.tool[rows]] - cell.truth(tool)[of_tool], axis=1)
            wrong += int((errors > 2.0).sum())
    return found, reported, wrong


def test_acquisition_among_unknown_texture_reports_no_wrong_id(cell):
    found, reported, wrong = acquire(cell, 21, 5)
    assert wrong == 0
    assert found >= 8
    assert reported >= 100


@pytest.mark.slow
def test_two_thousand_acquisitions_report_no_wrong_id(cell):
    found, _, wrong = acquire(cell, 2000, 6)
    assert wrong == 0
    assert found >= 900


def test_light_that_changes_moves_nothing(cell):
    rng = np.random.default_rng(1)
    detector, seen = cell.detector(), []
    for k, light in enumerate([{}, {"gain": 0.6}, {"gain": 1.2, "offset": -20.0}]):
        observation = detector.detect(frame(k, cell.image(motion(k), rng, **light)), None)
        rows = cell.rows(observation)
        assert np.linalg.norm(observation.pixels - cell.truth(motion(k))[rows], axis=1).max() < 0.5
        seen.append(len(rows))
    assert min(seen) >= 0.7 * seen[0]  # less contrast, the same noise


def test_a_prior_leads_to_the_landmarks_at_once_and_needs_no_keypoints(cell, monkeypatch):
    def never(*_arguments, **_options):
        raise AssertionError("searched the whole image")

    detector = cell.detector()
    monkeypatch.setattr("stereoservo_drivers.detectors.corners.search_by_keypoints", never)
    rng = np.random.default_rng(2)
    tool = pose(rotation(15, -25, 40), (0.05, 0.03, 1.0))
    given, truth = frame(3, cell.image(tool, rng)), cell.truth(tool)
    k, lead_s = len(truth), 0.02
    velocities = np.tile([300.0, -200.0], (k, 1))
    prior = Prior(
        "left",
        given.t_shutter_ns - int(lead_s * 1e9),
        cell.landmarks.ids,
        truth - lead_s * velocities + rng.normal(0, 1.0, truth.shape),
        velocities,
        np.tile(np.eye(2), (k, 1, 1)),
    )
    observation = detector.detect(given, prior)
    rows = cell.rows(observation)
    assert cell.tool[rows].sum() >= 0.7 * cell.tool.sum()
    assert np.linalg.norm(observation.pixels - truth[rows], axis=1).max() < 0.5


def test_what_was_hidden_comes_back_and_is_not_reported_meanwhile(cell):
    rng = np.random.default_rng(4)
    detector = cell.detector()
    truth = cell.truth(HOME)
    middle = np.median(truth[cell.tool], axis=0)
    covered = np.abs(truth - middle).max(axis=1) < 20.0
    counts = []
    for k in range(8):
        image = cell.image(HOME, rng)
        if k in (1, 2):
            u, v = np.rint(middle).astype(int)
            image[v - 32 : v + 33, u - 32 : u + 33] = 130
        rows = cell.rows(detector.detect(frame(k, image), None))
        counts.append(int(covered[rows].sum()))
    assert counts[0] > 3
    assert counts[-1] >= 0.7 * counts[0]
    assert counts[1] == counts[2] == 0


def test_the_same_series_gives_the_same_bits(cell):
    rng = np.random.default_rng(8)
    images = [cell.image(motion(k), rng) for k in range(4)]
    series = []
    for _ in range(2):
        detector = cell.detector()
        series.append([detector.detect(frame(k, image), None) for k, image in enumerate(images)])
    for first, second in zip(*series, strict=True):
        assert np.array_equal(first.ids, second.ids)
        assert np.array_equal(first.pixels, second.pixels)
        assert np.array_equal(first.covariances, second.covariances)


def test_frames_out_of_order_or_after_a_gap_are_acquired_anew(cell):
    rng = np.random.default_rng(9)
    detector = cell.detector()
    far = pose(rotation(25, -35, 60), (-0.1, 0.05, 1.0))
    first = detector.detect(frame(50, cell.image(HOME, rng)), None)
    for seq in (3, 500):  # back, and 16 s ahead
        observation = detector.detect(frame(seq, cell.image(far, rng)), None)
        rows = cell.rows(observation)
        assert np.linalg.norm(observation.pixels - cell.truth(far)[rows], axis=1).max() < 0.5
    assert len(first.ids) > 0


@pytest.mark.parametrize(
    ("image", "code"),
    [
        (np.zeros((240, 320, 3), np.uint8), "image_format"),
        (np.zeros((240, 320)), "image_format"),
        (np.zeros((480, 640), np.uint8), "image_size"),
    ],
)
def test_frames_unlike_the_reference_are_refused(cell, image, code):
    with pytest.raises(DriverError) as caught:
        cell.detector().detect(frame(0, image), None)
    assert caught.value.code == code


def test_turned_over_and_cut_images_give_nothing_wrong(cell):
    rng = np.random.default_rng(10)
    image = cell.image(HOME, rng)
    truth = cell.truth(HOME)
    for k, shown in enumerate((image[::-1, ::-1].copy(), image[:, ::-1].copy())):
        observation = cell.detector().detect(frame(k, shown), None)
        rows = cell.rows(observation)
        if k == 0:  # upside down: the landmarks are there, turned
            expected = np.array([319.0, 239.0]) - truth[rows]
            assert np.linalg.norm(observation.pixels - expected, axis=1).max(initial=0.0) < 1.0
        else:  # a mirror shows none of them
            assert len(rows) == 0


@pytest.mark.parametrize(
    ("options", "code", "word"),
    [
        ({}, "option", "landmarks"),
        ({"landmarks": "none.npz"}, "landmarks", "learn-corners"),
        ({"landmarks": "landmarks.npz", "windw": 3}, "option", "window"),
        ({"landmarks": "landmarks.npz", "window": 2}, "option", "window"),
        ({"landmarks": "landmarks.npz", "min_landmarks": 99}, "landmarks", "min_landmarks"),
    ],
)
def test_options_that_do_not_fit_are_told(cell, options, code, word):
    with pytest.raises(DriverError) as caught:
        CornerDetector(options, cell.context())
    assert caught.value.code == code
    assert word in str(caught.value)


def test_a_camera_without_landmarks_is_told_which_there_are(cell):
    with pytest.raises(DriverError, match=r"'third'.*'left', 'right'") as caught:
        CornerDetector({"landmarks": "landmarks.npz"}, cell.context("third"))
    assert caught.value.code == "landmarks"
