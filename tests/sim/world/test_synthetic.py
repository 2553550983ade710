"""The cells of numbers against OpenCV, and that their trials stay in view."""

import cv2
import numpy as np
import pytest

from stereoservo_sim.world import synthetic

MAKERS = (
    synthetic.rx90, synthetic.offset_wrist, synthetic.seven, synthetic.gantry, synthetic.gantry_with_wrist,
    synthetic.scara, synthetic.mixed, synthetic.parallel, synthetic.pan_tilt,
)  # fmt: skip


@pytest.mark.parametrize("maker", MAKERS)
def test_trials_stay_in_view(maker):
    cell = maker()
    positions, trials = cell.stops(9)
    assert cell.in_view(positions).mean() > 0.98
    assert np.bincount(trials).tolist() == [9] * len(cell.kinds)


def test_pixels_are_those_of_opencv():
    cell = synthetic.rx90().with_k1(-0.3)
    q = cell.home + 0.1
    pixels = cell.pixels(q[None])
    for K, pose, seen in zip(cell.intrinsics, cell.poses, pixels[:, 0], strict=True):
        body = np.hstack([cell.body, np.ones((14, 1))])
        points = np.ascontiguousarray((body @ (pose @ cell.flange(q)).T)[:, :3])
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([-0.3, 0, 0, 0.0]))
        # OpenCV's lens is round in normalised coordinates, ours in pixels: alike to fx/fy = 1.006.
        assert np.abs(seen - expected[:, 0]).max() < 0.1
    one = synthetic.rx90()
    plain = cell.with_k1(0.0).pixels(q[None])
    np.testing.assert_allclose(plain, one.pixels(q[None]))
    assert np.abs(plain - pixels).max() > 5.0


def test_cameras_on_the_head_turn_the_scene_the_other_way():
    cell = synthetic.pan_tilt()
    still, panned = cell.markers(np.array([[0.0, 0.0], [0.1, 0.0]]))
    to_flange = np.linalg.inv(cell.flange(np.array([0.1, 0.0]))) @ cell.flange(np.zeros(2))
    np.testing.assert_allclose(panned, still @ to_flange.T, atol=1e-12)
    assert cell.trials(0.1, np.random.default_rng(0)).cameras[0].mount == "eye_in_hand"
