"""Static points: found among the trials' sights, triangulated into the model, checked where they are read."""

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.static_points import with_static_points
from stereoservo.calibration.trial_data import (
    CalibrationError,
    StaticObservations,
    decode_trials,
    encode_trials,
    static_observations,
)
from stereoservo.geometry.cameras import project
from stereoservo.kinematics.model import ModelFileError, decode_model, encode_model
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import rx90

SIGMA = 0.1


def stops(rng, moving=(), hidden=()):
    """Pixels (2, 12, 4, 2) and sigmas of four static markers, some of which move or are covered at times."""
    pixels = rng.uniform(100, 500, (2, 1, 4, 2)) + rng.normal(0, SIGMA, (2, 12, 4, 2))
    for k in moving:
        pixels[0, 6:, k] += 3.0
    for k in hidden:
        pixels[1, ::2, k] = np.nan
    return pixels, np.full((2, 12, 4), SIGMA)


def test_static_markers_are_averaged_and_those_that_moved_named():
    rng = np.random.default_rng(0)
    pixels, sigmas = stops(rng, moving=(2,), hidden=(1,))
    pixels[0, 3, 0] += 20.0  # half covered once: no motion
    static, moved = static_observations((5, 6, 7, 8), pixels, sigmas)
    assert moved == (7,)
    assert static.ids == (5, 6, 8)
    assert static.pixels == pytest.approx(np.nanmedian(pixels, axis=1)[:, [0, 1, 3]])
    assert static.sigmas == pytest.approx(np.full((2, 3), SIGMA))


def test_where_none_is_seen_there_is_no_scene():
    assert static_observations((), np.zeros((2, 3, 0, 2)), np.zeros((2, 3, 0))) == (None, ())
    assert static_observations((1,), np.full((2, 3, 1, 2), np.nan), np.full((2, 3, 1), np.nan)) == (None, ())


def seen_scene(model, rng, count=5):
    """Points (k, 4) of height 1 about the markers, and what the model's cameras show of them."""
    middle = model.marker_points.mean(axis=0)
    spread = model.marker_points.std(axis=0).max()
    points = middle + 2.0 * spread * rng.normal(size=(count, 4))
    points = points / (points @ model.plane_at_infinity)[:, None]
    pixels = np.array([project(camera.matrix, points) for camera in model.cameras])
    return points, pixels


def test_points_are_found_with_their_covariance():
    """Errors over the covariance, three freedoms a point: chi-square of 20 trials of 5 points."""
    model = exact_model(rx90())
    points, pixels = seen_scene(model, np.random.default_rng(1))
    chart = np.linalg.svd(model.plane_at_infinity[None])[2][1:]
    total = 0.0
    for seed in range(20):
        noisy = pixels + np.random.default_rng(seed).normal(0, SIGMA, pixels.shape)
        found, notes = with_static_points(
            model, StaticObservations((50, 51, 52, 53, 54), noisy, np.full((2, 5), SIGMA))
        )
        assert notes == ()
        for point, truth, covariance in zip(found.scene_points, points, found.scene_covariances, strict=True):
            error = chart @ (point - truth)
            total += error @ np.linalg.solve(chart @ covariance @ chart.T, error)
    assert 220 < total < 395  # chi-square of 300 freedoms, 1e-3 and 1e-4 to the sides
    assert decode_model(encode_model(found)).scene_covariances == pytest.approx(found.scene_covariances)


def test_points_that_cannot_be_had_are_named():
    model = exact_model(rx90())
    _, pixels = seen_scene(model, np.random.default_rng(1), 3)
    pixels[1, 0] = np.nan
    pixels[1, 1, 1] += 30.0
    found, notes = with_static_points(model, StaticObservations((50, 51, 52), pixels, np.full((2, 3), SIGMA)))
    assert found.scene_ids == (52,)
    assert [
        "50" in notes[0],
        "two are needed" in notes[0],
        "51" in notes[1],
        "belong together" in notes[1],
    ] == [True] * 4
    riding = msgspec.structs.replace(model, mount="eye_in_hand")
    assert with_static_points(riding, StaticObservations((52,), pixels[:, 2:], np.full((2, 1), SIGMA)))[0] is riding


def test_trials_carry_static_sights_through_files_and_refuse_bad_ones():
    trials = rx90().trials(SIGMA, np.random.default_rng(0), 3)
    static = StaticObservations((50, 51), np.full((2, 2, 2), 7.0), np.full((2, 2), SIGMA))
    again = decode_trials(encode_trials(msgspec.structs.replace(trials, static=static)))
    assert again.static.ids == (50, 51)
    assert (again.static.pixels == static.pixels).all()
    assert decode_trials(encode_trials(trials)).static is None
    for bad in (
        StaticObservations((50, 50), static.pixels, static.sigmas),
        StaticObservations((trials.marker_ids[0], 51), static.pixels, static.sigmas),
        StaticObservations((50,), static.pixels, static.sigmas),
        StaticObservations((50, 51), static.pixels, -static.sigmas),
    ):
        with pytest.raises(CalibrationError) as caught:
            encode_trials(msgspec.structs.replace(trials, static=bad))
        assert (caught.value.code, caught.value.data["key"]) == ("bad_data", "static")


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("scene_ids", {"scene_ids": (50, 50)}),
        ("scene_ids", {"scene_ids": (10, 51)}),
        ("scene_points", {"scene_points": np.zeros((3, 4))}),
        ("scene_points", {"scene_points": np.full((2, 4), np.nan)}),
        ("scene_points[0]", {"scene_points": np.ones((2, 4))}),
        ("scene_covariances", {"scene_covariances": np.zeros((2, 3, 3))}),
        ("scene_covariances[0]", {"scene_covariances": np.stack([-np.eye(4)] * 2)}),
        ("scene_ids", {"mount": "eye_in_hand"}),
    ],
)
def test_a_model_with_a_wrong_scene_is_refused(key, change):
    model = exact_model(rx90())
    points, _ = seen_scene(model, np.random.default_rng(1), 2)
    good = msgspec.structs.replace(
        model, scene_ids=(50, 51), scene_points=points, scene_covariances=np.stack([np.eye(4)] * 2)
    )
    encode_model(good)
    with pytest.raises(ModelFileError) as caught:
        encode_model(msgspec.structs.replace(good, **change))
    assert caught.value.key == key
