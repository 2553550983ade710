"""The tag detector on whole pictures: identity, accuracy, covariances, windows, refusal."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoservo.ports.devices import DriverContext, DriverError, Prior
from stereoservo_drivers.detectors.aruco import TagDetector
from stereoservo_drivers.detectors.tag_registration import DICTIONARIES, size_of, tag_cells

from .rendering import digitise, project
from .scenes import Still, as_frame, normalised, rms
from .tag_rendering import CORNERS, TagScene, printed, tag_view

FAMILIES = {
    "36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "4x4_50": cv2.aruco.DICT_4X4_50,
}


@cache
def mirror_twins(name):
    """Tags of a dictionary that, printed mirrored, read as a tag of it: which ones, and as which."""
    cells = [tag_cells(name, tag) for tag in range(size_of(name))]
    reads = {np.rot90(c, k).tobytes(): tag for tag, c in enumerate(cells) for k in range(4)}
    mirrored = {tag: np.ascontiguousarray(c[:, ::-1]).tobytes() for tag, c in enumerate(cells)}
    return {tag: reads[key] for tag, key in mirrored.items() if key in reads}


def make_detector(**options) -> TagDetector:
    here = Path(".")
    return TagDetector(options, DriverContext(clock=Still(), cell="c", runtime_dir=here, cell_dir=here, camera="left"))


def print_of(tag, family="36h11"):
    return printed(FAMILIES[family], tag)


def random_view(rng, side=80.0, tilt=50.0, least_tilt=0.0):
    at = tuple(rng.uniform([150, 130], [490, 350]))
    return tag_view(side, rng.uniform(least_tilt, tilt), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi), at)


def prior_of(frame, tag, corners, sigma=1.0, **changes):
    values = {
        "camera": "left",
        "t_ns": frame.t_shutter_ns,
        "ids": 4 * tag + np.arange(4),
        "pixels": np.array(corners, dtype=np.float64),
        "velocities": np.zeros((4, 2)),
        "covariances": np.tile(np.eye(2) * sigma**2, (4, 1, 1)),
    }
    return Prior(**(values | changes))


def measured(rng, n, family="36h11", side=80.0, tilt=50.0, **scene):
    """Errors (k, 2) and squared normalised errors (k,) of all corners over ``n`` pictures of known tags."""
    detector = make_detector(tags=list(range(10)), dictionary=family)
    errors, squares = [], []
    for _ in range(n):
        tag, H = int(rng.integers(10)), random_view(rng, side, tilt)
        image = TagScene([(print_of(tag, family), H)], **scene).render(rng)
        observation = detector.detect(as_frame(image), None)
        assert observation.ids.tolist() == [4 * tag + c for c in range(4)]
        errors.append(observation.pixels - project(H, CORNERS))
        squares.append(normalised(errors[-1], observation.covariances))
    return np.concatenate(errors), np.concatenate(squares)


# Accuracy


@pytest.mark.parametrize(
    ("family", "side", "scene", "accuracy"),
    [
        ("36h11", 80.0, {"noise": 2.0}, 0.012),
        ("25h9", 60.0, {"noise": 2.0}, 0.012),
        ("16h5", 50.0, {"noise": 2.0, "gradient": 0.5}, 0.02),
        ("36h11", 80.0, {"noise": 5.0, "lens_blur": 1.5}, 0.05),
        ("36h11", 30.0, {"noise": 2.0}, 0.02),
        ("4x4_50", 24.0, {"noise": 2.0}, 0.02),
    ],
)
def test_corners_are_exact(family, side, scene, accuracy):
    errors, _ = measured(np.random.default_rng(1), 4, family, side, **scene)
    assert rms(errors) < accuracy
    assert np.abs(errors.mean(axis=0)).max() < 5 * accuracy / np.sqrt(len(errors))


@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_covariances_are_the_scatter(noise):
    """Squared normalised errors of one corner ~ chi2(2). Corners of one tag go together (one blur, one
    homography), so that a picture counts once: n pictures of 8 sums have a standard deviation of at most
    sqrt(2 * 8 * 8 / n) about 8, were the four corners one. Bound: four standard deviations, and 10 % for the noise
    variance and for what is not noise.
    """
    n = 20
    _, squares = measured(np.random.default_rng(2), n, noise=noise)
    total = squares.reshape(n, 4).sum(axis=1)
    assert abs(total.mean() - 8.0) < 4 * np.sqrt(128.0 / n) + 0.8


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("noise", [1.0, 2.0, 5.0, 10.0])
def test_covariances_are_the_scatter_of_a_thousand(noise):
    """As above, ten times tighter."""
    n = 1000
    _, squares = measured(np.random.default_rng(3), n, noise=noise)
    total = squares.reshape(n, 4).sum(axis=1)
    assert abs(total.mean() - 8.0) < 4 * np.sqrt(128.0 / n) + 0.8


def test_misfit_that_the_residuals_tell_is_not_stated_twice():
    """A shadow's soft edge over the tag, which no plane of light is, adds more than the floor, which stands for misfit
    that is not seen; in even light the floor is added, but for what the scatter of the residuals is beyond one by
    chance.
    """
    rng = np.random.default_rng(31)
    clean = TagScene([(print_of(2), tag_view(80, 30, 1.0, 0.4, (320, 240)))]).clean()
    shadow = 1.0 - 0.35 / (1.0 + np.exp((320.0 - np.arange(640)) / 3.0))
    bare, floored = make_detector(tags=[2], floor_px=0.0), make_detector(tags=[2], floor_px=0.02)
    for light, more in ((shadow, 0.0), (np.ones(640), 0.02**2)):
        frame = as_frame(digitise(clean * light, 2.0, rng))
        without, with_floor = (detector.detect(frame, None) for detector in (bare, floored))
        assert without.ids.tolist() == [8, 9, 10, 11]
        np.testing.assert_array_equal(without.pixels, with_floor.pixels)
        added = with_floor.covariances - without.covariances
        np.testing.assert_allclose(added, np.tile(more * np.eye(2), (4, 1, 1)), atol=0.1 * 0.02**2)


# Identity


def test_a_tag_upside_down_keeps_its_corners():
    rng = np.random.default_rng(4)
    H = random_view(rng)
    image = TagScene([(print_of(5), H)], noise=2.0).render(rng)
    observation = make_detector(tags=[5]).detect(as_frame(image[::-1, ::-1]), None)
    assert observation.ids.tolist() == [20, 21, 22, 23]
    assert np.abs(observation.pixels - ([639, 479] - project(H, CORNERS))).max() < 0.05


@pytest.mark.parametrize("family", ["36h11", "4x4_50"])
def test_mirrored_tags_are_not_seen(family):
    """Twenty tags in a picture, of those whose mirror image is no tag of the family; all of the family are expected."""
    rng = np.random.default_rng(5)
    tags = [tag for tag in range(24) if tag not in mirror_twins(family)][:20]
    detector = make_detector(tags=list(range(50)), dictionary=family)
    scene = TagScene(noise=2.0)
    for k, tag in enumerate(tags):
        at = (70.0 + 125.0 * (k % 5), 60.0 + 120.0 * (k // 5))
        scene.tags.append((print_of(tag, family), tag_view(60, 20, 1.0 * k, 0.5, at)))
    image = scene.render(rng)
    assert len(detector.detect(as_frame(image), None).ids) >= 4 * 19
    assert detector.detect(as_frame(image[:, ::-1]), None).ids.tolist() == []


def test_mirror_twins_are_those_that_a_mirror_shows():
    """The whole of the smallest family, drawn by OpenCV, mirrored and read by OpenCV alone."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate = 0.0
    reader = cv2.aruco.ArucoDetector(dictionary, parameters)
    read = {}
    for tag in range(50):
        image = np.pad(cv2.aruco.generateImageMarker(dictionary, tag, 96), 24, constant_values=255)
        _, ids, _ = reader.detectMarkers(np.ascontiguousarray(image[:, ::-1]))
        if ids is not None:
            read[tag] = int(np.ravel(ids)[0])
    assert read == mirror_twins("4x4_50")
    assert len(read) == 4
    assert mirror_twins("36h11") == mirror_twins("25h9") == mirror_twins("16h5") == {}


@pytest.mark.parametrize("family", ["16h5", "4x4_50"])
def test_a_wrong_cell_is_no_tag(family):
    """OpenCV mends a wrong cell; a tag that is not the one expected may be one cell off an expected one."""
    rng = np.random.default_rng(6)
    detector = make_detector(tags=[2], dictionary=family)
    H = tag_view(80, 30, 1.0, 0.4, (300, 240))
    for cell in [(2, 2), (3, 4), (5, 3)]:
        print_ = print_of(2, family).copy()
        assert len(detector.detect(as_frame(TagScene([(print_, H)], noise=2.0).render(rng)), None).ids) == 4
        print_[cell] = 1.0 - print_[cell]
        assert len(detector.detect(as_frame(TagScene([(print_, H)], noise=2.0).render(rng)), None).ids) == 0


def test_only_tags_of_the_cell_are_reported():
    rng = np.random.default_rng(7)
    scene = TagScene([(print_of(t), tag_view(70, 20, t, t, (130.0 + 190 * t, 240.0))) for t in range(3)])
    observation = make_detector(tags=[1, 8]).detect(as_frame(scene.render(rng)), None)
    assert observation.ids.tolist() == [4, 5, 6, 7]


def test_a_tag_seen_twice_is_told_by_its_prior_or_not_at_all():
    rng = np.random.default_rng(8)
    one, other = tag_view(80, 30, 1.0, 0.4, (180, 240)), tag_view(80, 30, 2.0, 1.4, (450, 240))
    third = tag_view(60, 10, 2.0, 1.4, (320, 100))
    scene = TagScene([(print_of(2), one), (print_of(2), other), (print_of(3), third)], noise=2.0)
    frame = as_frame(scene.render(rng))
    detector = make_detector(tags=[2, 3])
    assert detector.detect(frame, None).ids.tolist() == [12, 13, 14, 15]
    for H in (one, other):
        observation = detector.detect(frame, prior_of(frame, 2, project(H, CORNERS) + 1.0))
        assert observation.ids.tolist() == list(range(8, 16))
        assert np.abs(observation.pixels[:4] - project(H, CORNERS)).max() < 0.05
    # a prior so unsure that both stand within its window, and within its gate, decides nothing
    middle = (project(one, CORNERS) + project(other, CORNERS)) / 2
    observation = detector.detect(frame, prior_of(frame, 2, middle, sigma=60.0))
    assert observation.ids.tolist() == [12, 13, 14, 15]


def test_a_covered_tag_is_not_reported():
    rng = np.random.default_rng(9)
    H = tag_view(80, 10, 1.0, 0.0, (320, 240))
    image = TagScene([(print_of(2), H)], noise=2.0).render(rng)
    image[225:240, 310:330] = 200 - image[225:240, 310:330] // 2
    assert len(make_detector(tags=[2]).detect(as_frame(image), None).ids) == 0


# Priors


def test_priors_are_moved_to_the_frame_and_identity_is_read_anew():
    """A prior's window holds another tag: its own is reported from there alone, or from the whole image."""
    rng = np.random.default_rng(10)
    H = tag_view(60, 30, 1.0, 0.4, (200, 240))
    frame = as_frame(TagScene([(print_of(2), H)], noise=2.0).render(rng))
    detector = make_detector(tags=[2, 3])
    cold = detector.detect(frame, None)
    velocities = np.tile([480.0, -360.0], (4, 1))
    behind = {"velocities": velocities, "t_ns": frame.t_shutter_ns - 200_000_000}
    for prior in (
        prior_of(frame, 2, project(H, CORNERS) - 0.2 * velocities[0], **behind),
        prior_of(frame, 3, project(H, CORNERS)),
        prior_of(frame, 2, project(H, CORNERS) + 150.0),
        prior_of(frame, 2, project(H, CORNERS)[[1, 2, 3, 0]]),
    ):
        observation = detector.detect(frame, prior)
        assert observation.ids.tolist() == [8, 9, 10, 11]
        np.testing.assert_allclose(observation.pixels, cold.pixels, atol=0.02)


def test_a_window_is_all_that_is_searched_when_every_tag_has_a_prior():
    """The same tag elsewhere is not even looked at."""
    rng = np.random.default_rng(11)
    one, other = tag_view(60, 30, 1.0, 0.4, (160, 240)), tag_view(60, 30, 2.0, 1.4, (480, 240))
    frame = as_frame(TagScene([(print_of(2), one), (print_of(2), other)], noise=2.0).render(rng))
    observation = make_detector(tags=[2]).detect(frame, prior_of(frame, 2, project(other, CORNERS)))
    assert np.abs(observation.pixels - project(other, CORNERS)).max() < 0.05


def twelve_tags(rng):
    """A frame of tags 0 to 11, and their corners (48, 2)."""
    scene, corners = TagScene([], noise=2.0), []
    for k in range(12):
        at = (90.0 + 153 * (k % 4), 85.0 + 155 * (k // 4))
        H = tag_view(80, rng.uniform(0, 50), *rng.uniform(0, 2 * np.pi, 2), at)
        scene.tags.append((print_of(k), H))
        corners.append(project(H, CORNERS))
    return as_frame(scene.render(rng)), np.concatenate(corners)


def test_no_quadrilaterals_are_searched_where_priors_are_right_and_few_times_where_they_are_not(monkeypatch):
    """Never more searches with priors than the two of an image without them: windows are small or not used."""
    rng = np.random.default_rng(13)
    frame, corners = twelve_tags(rng)
    detector = make_detector(tags=list(range(12)))
    cold = detector.detect(frame, None)
    assert len(cold.ids) == 48
    searched, quads = [], detector._quads
    monkeypatch.setattr(detector, "_quads", lambda d, image, tags: searched.append(image.size) or quads(d, image, tags))
    for off_px, most in ((0.7, 0), (60.0, 2 * frame.image.size)):
        searched.clear()
        places = corners + rng.normal(0.0, 0.7, corners.shape) + (off_px if most else 0.0)
        prior = Prior(
            "left",
            frame.t_shutter_ns,
            np.arange(48),
            places,
            np.zeros((48, 2)),
            np.tile(np.eye(2), (48, 1, 1)),
        )
        observation = detector.detect(frame, prior)
        assert observation.ids.tolist() == list(range(48))
        np.testing.assert_allclose(observation.pixels, cold.pixels, atol=0.005)
        assert sum(searched) <= most


def test_unusable_priors_fall_back_to_the_whole_image():
    rng = np.random.default_rng(12)
    H = tag_view(60, 30, 1.0, 0.4, (200, 240))
    frame = as_frame(TagScene([(print_of(2), H)], noise=2.0).render(rng))
    detector = make_detector(tags=[2])
    expected = detector.detect(frame, None).pixels
    nan, huge, none = np.full((4, 2), np.nan), np.full((4, 2), 1e12), np.zeros((0, 2))
    for prior in (
        prior_of(frame, 2, nan),
        prior_of(frame, 2, huge),
        prior_of(frame, 2, project(H, CORNERS), covariances=np.full((4, 2, 2), np.nan)),
        prior_of(frame, 2, project(H, CORNERS), sigma=1e9),
        prior_of(frame, 90, project(H, CORNERS)),
        prior_of(frame, 2, project(H, CORNERS), t_ns=frame.t_shutter_ns - 10**9),
        Prior("left", frame.t_shutter_ns, np.zeros(0, np.int64), none, none, np.zeros((0, 2, 2))),
    ):
        np.testing.assert_array_equal(detector.detect(frame, prior).pixels, expected)


# Options


def test_marker_ids():
    detector = make_detector(tags=[1, 3], first_marker=100, markers=[{"tag": 3, "ids": [7, 8, 9, 6]}])
    assert detector.describe().marker_ids == (6, 7, 8, 9, 104, 105, 106, 107)


@pytest.mark.parametrize("refinement", ["subpixel", "apriltag", "none"])
def test_other_refinements_state_their_errors(refinement):
    """At noise 2 and blur 0.7, over tilts to 50 degrees: rms below what is stated, no bias beyond it."""
    rng = np.random.default_rng(13)
    detector = make_detector(tags=[2], refinement=refinement)
    sigma = detector.describe().systematic_px
    errors = []
    for _ in range(4):
        H = random_view(rng)
        observation = detector.detect(as_frame(TagScene([(print_of(2), H)], noise=2.0).render(rng)), None)
        np.testing.assert_allclose(observation.covariances, np.tile(sigma**2 * np.eye(2), (4, 1, 1)))
        errors.append(observation.pixels - project(H, CORNERS))
    assert rms(np.concatenate(errors)) < sigma


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "tags is missing"),
        ({"tags": []}, "one or more different ids of 36h11, 0 to 586"),
        ({"tags": [1, 1]}, "different"),
        ({"tags": [587]}, "0 to 586"),
        ({"tags": [30], "dictionary": "16h5"}, "0 to 29"),
        ({"tags": [1], "dictionary": "36h12"}, "36h11"),
        ({"tags": [1], "size": 80}, "valid: tags, dictionary"),
        ({"tags": [1], "refinement": "best"}, "pattern"),
        ({"tags": [1], "markers": [{"tag": 2, "ids": [0, 1, 2, 3]}]}, "at most once"),
        ({"tags": [1, 2], "markers": [{"tag": 2, "ids": [4, 1, 2, 3]}]}, r"\[4\] are used twice"),
        ({"tags": [1], "floor_px": -1.0}, "floor_px"),
        (
            {"tags": [1], "first_marker": 2**63 - 1},
            "first_marker = 9223372036854775807; valid: .* 0 to 1000000000",
        ),
    ],
)
def test_bad_options_are_refused_by_name(options, words):
    with pytest.raises(DriverError, match=words) as caught:
        make_detector(**options)
    assert caught.value.code == "option"


@pytest.mark.parametrize(
    ("image", "code"),
    [
        (np.zeros((480, 640, 3), np.uint8), "image_format"),
        (np.zeros((480, 640), np.float64), "image_format"),
        (None, "image_format"),
        (np.zeros((480, 641), np.uint8), "image_size"),
        (np.zeros((0, 0), np.uint8), "image_size"),
    ],
)
def test_frames_that_are_not_what_was_announced(image, code):
    detector = make_detector(tags=[1], image_size=[640, 480])
    with pytest.raises(DriverError) as caught:
        detector.detect(as_frame(image), None)
    assert caught.value.code == code


def test_every_dictionary_has_its_tags():
    for name in DICTIONARIES:
        cells = tag_cells(name, size_of(name) - 1)
        assert (cells[0] == 1).all()
        assert (cells[:, -1] == 1).all()
        assert 0 < cells[1:-1, 1:-1].mean() < 1
    with pytest.raises(IndexError, match=r"0\.\.29"):
        tag_cells("16h5", 30)
