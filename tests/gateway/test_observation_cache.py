"""Where markers are now: means of what stands still, the newest of what moves, nothing of what is old."""

import numpy as np
import pytest

from stereoservo.gateway.observation_cache import FRAMES, FRESH_S, ObservationCache
from stereoservo.ports.devices import CameraObservation

PERIOD_NS = 33_000_000


def observation(k, pixels, sigma=0.1, ids=None):
    pixels = np.atleast_2d(pixels)
    ids = np.arange(len(pixels)) if ids is None else np.array(ids)
    covariances = np.tile(sigma**2 * np.eye(2), (len(pixels), 1, 1))
    return CameraObservation("left", k, k * PERIOD_NS, k * PERIOD_NS, ids, pixels.astype(float), covariances)


def test_what_stands_still_is_averaged_and_known_better():
    rng = np.random.default_rng(0)
    sights = ObservationCache({"left": 0.0, "right": 0.0})
    sent = [np.array([[10.0, 20.0]]) + 0.1 * rng.normal(size=(1, 2)) for _ in range(15)]
    for k, pixels in enumerate(sent):
        sights.add(observation(k, pixels))
    now = sights.now(15 * PERIOD_NS)
    assert now["right"] == {}
    sight = now["left"][0]
    assert sight.pixel == pytest.approx(tuple(np.mean(sent[-FRAMES:], axis=0)[0]))
    assert sight.sigma == pytest.approx(0.1 / np.sqrt(FRAMES))
    assert not sight.moves


def test_the_systematic_part_does_not_average_out():
    sights = ObservationCache({"left": 0.08})
    for k in range(FRAMES):
        sights.add(observation(k, [[5.0, 5.0]]))
    assert sights.now(FRAMES * PERIOD_NS)["left"][0].sigma == pytest.approx(
        np.sqrt((0.1**2 - 0.08**2) / FRAMES + 0.08**2)
    )


def test_what_moves_is_where_it_was_seen_last():
    sights = ObservationCache({"left": 0.0})
    for k in range(5):
        sights.add(observation(k, [[100.0 + k, 50.0], [7.0, 7.0]]))
    now = sights.now(5 * PERIOD_NS)["left"]
    assert now[0] == ((104.0, 50.0), pytest.approx(0.1), True)
    assert not now[1].moves


def test_what_moves_is_reported_of_one_moment_by_cameras_that_no_trigger_joins():
    """At 100 px/s; two pictures half a period apart made a point of it that it never was at."""
    sights, late_ns = ObservationCache({"left": 0.0, "right": 0.0}), PERIOD_NS // 2
    for k in range(5):
        one = observation(k, [[100.0 + 100e-9 * k * PERIOD_NS, 50.0]])
        stamp_ns = one.t_shutter_ns + late_ns
        other = CameraObservation(
            "right",
            k,
            stamp_ns,
            stamp_ns,
            one.ids,
            one.pixels + 100e-9 * late_ns * np.array([1.0, 0.0]),
            one.covariances,
        )
        sights.add(one)
        sights.add(other)
    now = sights.now(5 * PERIOD_NS)
    assert now["left"][0].pixel == pytest.approx((100.0 + 400e-9 * PERIOD_NS, 50.0))
    assert now["right"][0].pixel == pytest.approx(now["left"][0].pixel)
    assert now["right"][0].moves


def test_what_is_hidden_or_old_is_not_seen():
    sights = ObservationCache({"left": 0.0})
    sights.add(observation(0, [[1.0, 1.0], [2.0, 2.0]]))
    sights.add(observation(1, [[1.0, 1.0]], ids=[0]))
    assert set(sights.now(2 * PERIOD_NS)["left"]) == {0}
    assert sights.now(PERIOD_NS + int(1.001e9 * FRESH_S))["left"] == {}
