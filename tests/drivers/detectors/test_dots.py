"""The dot detector on whole pictures: identification, tracking, covariances, refusal."""

import numpy as np
import pytest

from stereoservo.ports.devices import DriverError, Prior
from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_drivers.detectors.dots import _Seen

from .rendering import Scene, circle, digitise
from .scenes import IDS, as_frame, make_detector, normalised, random_shot, rms

GROSS = 0.5
"""Distance [px] beyond which a reported dot counts as another one."""


@pytest.fixture(scope="module")
def detector():
    return make_detector()


def wrong(shot, observation):
    return int((np.hypot(*shot.errors(observation).T) > GROSS).sum())


def cover(image, pixels):
    """The image with black squares over these dots."""
    covered = image.copy()
    for u, v in np.round(pixels).astype(int):
        covered[v - 14 : v + 15, u - 14 : u + 15] = 30
    return covered


# Acquisition


def identify(detector, seed, n, least_found, **settings):
    """No wrong id in n pictures and at least this part of the dots found."""
    rng = np.random.default_rng(seed)
    found = 0
    for _ in range(n):
        shot = random_shot(rng, **settings)
        observation = detector.detect(shot.frame, None)
        assert wrong(shot, observation) == 0
        found += len(observation.ids)
    assert found >= least_found * 14 * n


@pytest.mark.parametrize(
    ("seed", "n", "least_found", "settings"),
    [
        (1, 40, 0.99, {"noise": 2.0}),
        (2, 40, 0.97, {"noise": 2.0, "clutter": 9}),
        (3, 25, 0.95, {"noise": 5.0, "clutter": 4, "tilt": 70.0, "distance": (0.8, 1.5)}),
        (4, 15, 0.97, {"noise": 3.0, "lens_blur": 1.5, "gradient": 0.5}),
        (5, 15, 0.97, {"noise": 2.0, "wall": 200.0, "gradient": 0.5}),
        # clutter that runs into dots hides them, but makes no others of them
        (6, 40, 0.3, {"noise": 2.0, "clutter": 12, "clear_of_dots": False}),
    ],
)
def test_acquisition_gives_no_wrong_id(detector, seed, n, least_found, settings):
    identify(detector, seed, n, least_found, **settings)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("clutter", [0, 9, 20])
@pytest.mark.parametrize("clear", [True, False])
def test_acquisition_gives_no_wrong_id_in_a_thousand(detector, clutter, clear):
    identify(detector, 7, 1000, 0.0, noise=2.0, clutter=clutter, clear_of_dots=clear, tilt=70.0)


@pytest.mark.parametrize(("seed", "disturbed", "count"), [(51, 10, 13), (72, 4, 11), (202, 8, 12)])
def test_a_dot_that_clutter_runs_into_is_left_out(detector, seed, disturbed, count):
    """Its light tells that it may be off by more than a dot may lie from its face: 0.7 to 1.6 px in these pictures. The
    face's other dots stay, and are held against each other as if it were not there.
    """
    rng = np.random.default_rng(seed)
    shot = random_shot(rng, noise=2.0, clutter=20, clear_of_dots=False, tilt=70.0)
    for prior in (None, shot.prior((0.4, -0.4))):
        observation = detector.detect(shot.frame, prior)
        assert disturbed not in observation.ids
        assert len(observation.ids) >= count - 1
        assert np.abs(shot.errors(observation)).max() < 0.1


def test_clutter_alone_is_no_face(detector):
    rng = np.random.default_rng(8)
    for _ in range(30):
        dots = [circle(*rng.uniform((40, 40), (600, 440)), rng.uniform(4, 9)) for _ in range(30)]
        observation = detector.detect(as_frame(Scene(clutter=dots, noise=2.0).render(rng)), None)
        assert len(observation.ids) == 0


@pytest.mark.parametrize("hidden", range(7))
def test_one_hidden_dot_is_left_out_and_the_others_keep_their_ids(detector, hidden):
    rng = np.random.default_rng(20 + hidden)
    for _ in range(4):
        shot = random_shot(rng, clutter=3, distance=(0.8, 1.3), tilt=45.0)
        image = shot.scene.clean()
        v, u = np.mgrid[:480, :640]
        for dot in (hidden, 7 + hidden):
            image[np.hypot(u - shot.truth[dot, 0], v - shot.truth[dot, 1]) < 14] = 30.0
        observation = detector.detect(as_frame(digitise(image, 2.0, rng)), None)
        assert wrong(shot, observation) == 0
        assert set(observation.ids.tolist()) == set(IDS.tolist()) - {hidden, 7 + hidden}


@pytest.mark.parametrize("hidden", [(0, 5), (2, 4), (5, 6), (1, 2, 3)])
def test_a_face_with_fewer_than_six_dots_is_not_acquired(detector, hidden):
    rng = np.random.default_rng(30)
    shot = random_shot(rng, distance=(0.8, 1.3), tilt=45.0, noise=2.0)
    frame = as_frame(cover(shot.frame.image, shot.truth[list(hidden)]))
    assert detector.detect(frame, None).ids.tolist() == list(range(7, 14))


def test_mirrored_and_negative_pictures_show_nothing(detector):
    rng = np.random.default_rng(9)
    for _ in range(10):
        image = random_shot(rng, clutter=4, noise=2.0).frame.image
        for other in (image[:, ::-1], image[::-1], 255 - image):
            assert len(detector.detect(as_frame(other), None).ids) == 0


def test_upside_down_is_as_good_as_upright(detector):
    shot = random_shot(np.random.default_rng(10), noise=1.0)
    observation = detector.detect(as_frame(shot.frame.image[::-1, ::-1]), None)
    assert observation.ids.tolist() == IDS.tolist()
    assert np.abs(observation.pixels - ([639, 479] - shot.truth)).max() < 0.05


def test_dark_dots(detector):
    shot = random_shot(np.random.default_rng(11), noise=1.0)
    dark = make_detector(polarity="dark")
    negative = as_frame(255 - shot.frame.image)
    for prior in (None, shot.prior()):
        expected, found = detector.detect(shot.frame, prior), dark.detect(negative, prior)
        assert found.ids.tolist() == expected.ids.tolist() == IDS.tolist()
        np.testing.assert_allclose(found.pixels, expected.pixels, atol=1e-9)


# Tracking


@pytest.mark.parametrize(
    ("settings", "accuracy"),
    [
        ({"lens_blur": 0.0}, 0.003),
        ({"lens_blur": 0.7}, 0.002),
        ({"lens_blur": 0.0, "blur": 0.7}, 0.002),
        ({"noise": 3.0}, 0.012),
        ({"noise": 3.0, "lens_blur": 1.5}, 0.018),
        ({"noise": 3.0, "gradient": 0.5}, 0.018),
    ],
)
def test_tracking_accuracy(detector, settings, accuracy):
    """Against the projected centres of the dots: the shift of an ellipse's centre counts as an error."""
    rng = np.random.default_rng(12)
    errors = []
    for _ in range(12):
        shot = random_shot(rng, **settings)
        observation = detector.detect(shot.frame, shot.prior(rng.normal(0, 1, 2)))
        assert wrong(shot, observation) == 0
        errors.append(shot.errors(observation))
    assert sum(map(len, errors)) >= 0.98 * 12 * 14
    assert rms(np.concatenate(errors)) < accuracy


def test_near_faces_need_their_shift(detector):
    """At 0.35 m an 8 mm dot's ellipse lies up to a third of a pixel beside its centre."""
    rng = np.random.default_rng(13)
    worst = 0.0
    for _ in range(5):
        shot = random_shot(rng, distance=(0.45, 0.5), tilt=55.0, noise=1.0)
        observation = detector.detect(shot.frame, None)
        assert len(observation.ids) >= 7
        worst = max(worst, np.abs(shot.errors(observation)).max())
    assert worst < 0.03


@pytest.mark.parametrize("noise", [1.0, 3.0, 8.0])
@pytest.mark.parametrize("tracking", [True, False])
def test_covariances_are_the_scatter(detector, noise, tracking):
    """The sum of squared normalised errors of k dots ~ chi2(2 k): mean 2 k, standard deviation sqrt(4 k).

    One noise estimate serves all dots of a picture (relative standard deviation 4 % for 14 rings of about
    100 pixels); the bound is five standard deviations and 5 % for what is not noise.
    """
    rng = np.random.default_rng(14)
    squares = []
    for _ in range(25):
        shot = random_shot(rng, noise=noise, distance=(0.8, 1.8))
        observation = detector.detect(shot.frame, shot.prior((0.5, -0.5)) if tracking else None)
        squares.append(normalised(shot.errors(observation), observation.covariances))
    squares = np.concatenate(squares)
    k = len(squares)
    assert k > 0.97 * 25 * 14
    assert abs(squares.sum() / (2 * k) - 1) < 5 / np.sqrt(k) + 0.05
    # and the tail: no more than a thousandth beyond 16 in the mean, five standard deviations above that
    assert (squares > 16).sum() <= k * np.exp(-8) + 5 * np.sqrt(k * np.exp(-8)) + 1


def test_tracking_and_acquisition_measure_the_same(detector):
    shot = random_shot(np.random.default_rng(15), noise=2.0)
    cold, tracked = detector.detect(shot.frame, None), detector.detect(shot.frame, shot.prior((1.5, -1.0)))
    assert cold.ids.tolist() == tracked.ids.tolist() == IDS.tolist()
    np.testing.assert_allclose(tracked.pixels, cold.pixels, atol=2e-3)


def test_priors_are_moved_to_the_frame(detector):
    """At 600 px/s and 40 ms the prior is 24 px behind. Two dots of each face are hidden, so that only a
    track can be found.
    """
    shot = random_shot(np.random.default_rng(16), noise=2.0, distance=(0.8, 1.3), tilt=45.0)
    frame = as_frame(cover(shot.frame.image, shot.truth[[5, 6, 12, 13]]))
    velocities = np.tile([480.0, -360.0], (14, 1))
    behind = {"velocities": velocities, "t_ns": shot.frame.t_shutter_ns - 40_000_000}
    found = detector.detect(frame, shot.prior(-0.04 * velocities[0], **behind))
    assert found.ids.tolist() == [0, 1, 2, 3, 4, 7, 8, 9, 10, 11]
    assert wrong(shot, found) == 0
    assert len(detector.detect(frame, shot.prior(-0.04 * velocities[0])).ids) == 0


@pytest.mark.parametrize("age_s", [-1.0, 0.3, 100.0])
def test_stale_priors_are_not_used(detector, age_s):
    shot = random_shot(np.random.default_rng(17), noise=2.0)
    prior = shot.prior((40.0, 3.0), t_ns=shot.frame.t_shutter_ns - int(age_s * 1e9))
    # the search near the prior sums the same pixels in another order, in single precision
    np.testing.assert_allclose(
        detector.detect(shot.frame, prior).pixels,
        detector.detect(shot.frame, None).pixels,
        rtol=0.0,
        atol=1e-5,
    )


@pytest.mark.parametrize("seed", range(12))
def test_wrong_priors_give_no_wrong_dot(detector, seed):
    """Shifted onto neighbours, permuted, shuffled between faces, mirrored: whatever is reported is right."""
    rng = np.random.default_rng(seed)
    shot = random_shot(rng, noise=2.0, clutter=9)
    spacing = np.linalg.norm(shot.truth[0] - shot.truth[4])
    pixels = [
        shot.truth + rng.uniform(-1, 1, 2) * spacing,
        shot.truth[rng.permutation(14)],
        np.roll(shot.truth, 7, axis=0),
        [640, 0] + shot.truth * [-1, 1],
        shot.truth + rng.normal(0, 8, (14, 2)),
        rng.uniform(0, 480, (14, 2)),
    ]
    for guess in pixels:
        observation = detector.detect(shot.frame, shot.prior(pixels=np.ascontiguousarray(guess), sigma=4.0))
        assert wrong(shot, observation) == 0


def test_unusable_priors_fall_back_to_acquisition(detector):
    shot = random_shot(np.random.default_rng(18), noise=2.0)
    expected = detector.detect(shot.frame, None).pixels
    nan, huge = np.full((14, 2), np.nan), np.full((14, 2), 1e12)
    priors = [
        shot.prior(pixels=nan),
        shot.prior(pixels=huge),
        shot.prior(velocities=nan),
        shot.prior(covariances=np.full((14, 2, 2), np.nan)),
        shot.prior(sigma=1e9),
        shot.prior(ids=IDS + 100),
        Prior("left", shot.frame.t_shutter_ns, IDS[:0], nan[:0], nan[:0], np.zeros((0, 2, 2))),
    ]
    for prior in priors:
        np.testing.assert_array_equal(detector.detect(shot.frame, prior).pixels, expected)


def test_a_lost_track_is_found_again_in_the_same_call(detector):
    shot = random_shot(np.random.default_rng(19), noise=2.0)
    observation = detector.detect(shot.frame, shot.prior((60.0, -45.0)))
    assert observation.ids.tolist() == IDS.tolist()
    assert wrong(shot, observation) == 0


@pytest.mark.parametrize("seed", range(8))
def test_partly_hidden_dots_are_not_reported(detector, seed):
    """An arm's edge across a face: what is reported is whole, within a few hundredths of a pixel."""
    rng = np.random.default_rng(40 + seed)
    shot = random_shot(rng, distance=(0.8, 1.3), tilt=45.0)
    v, u = np.mgrid[:480, :640]
    image = shot.scene.clean()
    for f in range(2):
        angle = rng.uniform(0, 2 * np.pi)
        through = shot.truth[7 * f + rng.integers(7)] + rng.uniform(-6, 6, 2)
        side = (u - through[0]) * np.cos(angle) + (v - through[1]) * np.sin(angle)
        image[(side > 0) & (side < 30)] = rng.choice([10.0, 60.0, 120.0])
    for prior in (None, shot.prior((0.5, 0.5))):
        observation = detector.detect(as_frame(digitise(image, 2.0, rng)), prior)
        assert (np.abs(shot.errors(observation)) < 0.12).all()


def test_four_dots_of_a_face_go_with_the_prior_three_do_not(detector):
    rng = np.random.default_rng(21)
    shot = random_shot(rng, distance=(0.8, 1.3), tilt=45.0, noise=2.0)
    for hidden, expected in (((1, 5, 6), [0, 2, 3, 4]), ((1, 3, 5, 6), [])):
        frame = as_frame(cover(shot.frame.image, shot.truth[list(hidden)]))
        observation = detector.detect(frame, shot.prior((0.4, 0.4)))
        assert observation.ids.tolist() == expected + list(range(7, 14))
        assert wrong(shot, observation) == 0


def test_the_prior_gate_is_a_probability(detector):
    """2 px off at 0.2 px has a chi-square of 100; the same at 1 px of 4, of which 0.86 of good dots stay below."""
    shot = random_shot(np.random.default_rng(22), noise=2.0)
    tight, loose = (
        make_detector(gate_probability=0.8, min_dots=1),
        make_detector(gate_probability=0.9, min_dots=1),
    )
    prior, sure = shot.prior((2.0, 0.0), sigma=1.0), shot.prior((2.0, 0.0), sigma=0.2)
    seen = _Seen.of(14)
    assert detector._track(shot.frame.image, sure, 0.0, seen) == 14
    assert loose._track(shot.frame.image, sure, 0.0, seen) == 0
    assert loose._track(shot.frame.image, prior, 0.0, seen) == 14
    assert tight._track(shot.frame.image, prior, 0.0, seen) == 0
    # what is refused is looked for anew, in the picture
    assert tight.detect(shot.frame, prior).ids.tolist() == IDS.tolist()


def test_read_only_and_strided_images(detector):
    shot = random_shot(np.random.default_rng(23), noise=2.0)
    expected = detector.detect(shot.frame, None).pixels
    frozen = shot.frame.image.copy()
    frozen.setflags(write=False)
    wide = np.repeat(shot.frame.image, 2, axis=1)[:, ::2]
    for image in (frozen, wide):
        np.testing.assert_array_equal(detector.detect(as_frame(image), None).pixels, expected)
        np.testing.assert_allclose(detector.detect(as_frame(image), shot.prior()).pixels, expected, atol=2e-3)


# The boundary


@pytest.mark.parametrize(
    ("image", "code"),
    [
        (np.zeros((480, 640, 3), np.uint8), "image_format"),
        (np.zeros((480, 640), np.float64), "image_format"),
        (None, "image_format"),
        (np.zeros((480, 641), np.uint8), "image_size"),
        (np.zeros((0, 0), np.uint8), "image_size"),
        (np.zeros((8, 8), np.uint8), "image_size"),
    ],
)
def test_frames_that_are_not_what_was_announced(image, code):
    detector = make_detector(image_size=(640, 480))
    with pytest.raises(DriverError) as caught:
        detector.detect(as_frame(image), None)
    assert caught.value.code == code
    assert "640x480" in str(caught.value) or "uint8" in str(caught.value)


def test_the_first_frame_sets_the_size():
    detector = make_detector()
    detector.detect(as_frame(np.zeros((240, 320), np.uint8)), None)
    with pytest.raises(DriverError, match="640x480 px; expected 320x240"):
        detector.detect(as_frame(np.zeros((480, 640), np.uint8)), None)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"min_contrast": 1}, "min_contrast"),
        ({"threshold": 3}, "known options"),
        ({"faces": []}, "at least one face"),
        ({"polarity": "blue"}, "polarity"),
        ({"acquire_dots": 5}, "acquire_dots"),
    ],
)
def test_bad_options_are_refused_by_name(options, words):
    with pytest.raises(DriverError, match=words) as caught:
        make_detector(**options)
    assert caught.value.code == "option"


def face_options(face, ids=None, positions=None):
    places = face.positions if positions is None else positions
    return {
        "name": face.name,
        "ids": list(ids or face.ids),
        "positions": places.tolist(),
        "radius": face.radius,
    }


def test_faces_of_ones_own():
    """Other ids for the same faces; a face that is not asked for is not reported."""
    shot = random_shot(np.random.default_rng(24), noise=2.0)
    detector = make_detector(faces=[face_options(DEFAULT_BODY[1], ids=[30, 21, 22, 23, 24, 25, 26])])
    assert detector.describe().marker_ids == (21, 22, 23, 24, 25, 26, 30)
    observation = detector.detect(shot.frame, None)
    assert observation.ids.tolist() == [21, 22, 23, 24, 25, 26, 30]
    np.testing.assert_allclose(observation.pixels[-1], shot.truth[7], atol=0.05)


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        ([face_options(DEFAULT_BODY[0]), face_options(DEFAULT_BODY[0])], "used twice"),
        ([face_options(DEFAULT_BODY[0], ids=[1, 2, 3])], "7 ids"),
        ([face_options(DEFAULT_BODY[0], positions=DEFAULT_BODY[0].positions * [-1, 1])], "clockwise"),
    ],
)
def test_bad_faces_are_refused(faces, words):
    with pytest.raises(DriverError, match=words):
        make_detector(faces=faces)
