"""Set-points out of pictures: the mean at rest, and a refusal with its reason where there is no rest."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo.daemon.jobs.recorded_set_points import SetPointError, averaged
from stereoservo.ports.devices import CameraObservation

SIGMA = 0.02
RATE_HZ = 30.0


def observations(count: int, seed: int = 0, markers: int = 14, speed_px: float = 0.0) -> list[CameraObservation]:
    """``count`` frames of markers at rest, or all moving at ``speed_px`` [px/s], with honest noise."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(50, 400, (markers, 2))
    return [
        CameraObservation(
            "left", k, 10**9 + round(k * 1e9 / RATE_HZ), 10**9, np.arange(markers),
            places + speed_px * k / RATE_HZ + SIGMA * rng.standard_normal((markers, 2)),
            np.tile(SIGMA**2 * np.eye(2), (markers, 1, 1)),
        )
        for k in range(count)
    ]  # fmt: skip


def test_the_mean_is_as_good_as_its_sigma_says() -> None:
    """Chi-square of the means over 15 recordings: within four deviations of its 420 freedoms."""
    chi2 = 0.0
    for seed in range(15):
        found = averaged("left", observations(20, seed), 0.0, (640, 480))
        truth = np.random.default_rng(seed).uniform(50, 400, (14, 2))
        for marker, pixel in found.pixels.items():
            assert found.sigmas[marker] == pytest.approx(SIGMA / np.sqrt(20))
            chi2 += float(((np.array(pixel) - truth[marker]) ** 2).sum()) / found.sigmas[marker] ** 2
    freedoms = 15 * 14 * 2
    assert abs(chi2 - freedoms) < 4.0 * np.sqrt(2.0 * freedoms)


@pytest.mark.parametrize("speed_px", [0.5, 3.0, 300.0])
def test_markers_in_motion_are_refused(speed_px: float) -> None:
    with pytest.raises(SetPointError, match=r"moves by .* px in 0\.63 s") as caught:
        averaged("left", observations(20, speed_px=speed_px), 0.0, (640, 480))
    assert caught.value.code == "moving"


def test_a_drift_below_a_tenth_of_a_pixel_is_none() -> None:
    assert len(averaged("left", observations(20, speed_px=0.1), 0.0, (640, 480)).pixels) == 14


def test_a_frame_that_disagrees_is_refused_and_named() -> None:
    seen = observations(20)
    seen[7].pixels[3] += 2.0
    with pytest.raises(SetPointError, match=r"frame 7 of 20 has marker 3 [12]") as caught:
        averaged("left", seen, 0.0, (640, 480))
    assert caught.value.code == "disagree"


def test_markers_of_few_frames_are_left_out_and_none_at_all_is_refused() -> None:
    seen = observations(10, markers=3)
    few = [
        CameraObservation(o.camera, o.seq, o.t_shutter_ns, o.t_received_ns, o.ids[:2], o.pixels[:2], o.covariances[:2])
        for o in seen[4:]
    ]
    found = averaged("left", seen[:4] + few, 0.0, (640, 480))
    assert sorted(found.pixels) == [0, 1]
    assert found.left_out == (2,)
    assert found.frames == 10
    blind = [
        CameraObservation("left", 1, t, t, np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)))
        for t in range(1, 4)
    ]
    with pytest.raises(SetPointError, match="detector") as caught:
        averaged("left", blind, 0.0, (640, 480))
    assert caught.value.code == "no_markers"


def test_one_frame_is_its_own_mean() -> None:
    (one,) = observations(1)
    found = averaged("left", [one], 0.0, (640, 480))
    assert found.pixels[5] == tuple(one.pixels[5])
