"""The scene of a metric model against the arm and cameras in metres behind it."""

import msgspec
import numpy as np
import pytest

from core.conftest import BASE, ROWS, link, make_truth
from stereoservo.web.model_view import Scene


@pytest.mark.parametrize("seed", range(3))
def test_axes_markers_and_cameras_are_where_they_are_in_metres(seed: int) -> None:
    truth = make_truth(seed, count=3)
    scene = Scene.of(truth.model)
    assert scene is not None
    q = BASE + np.random.default_rng(seed).uniform(-0.4, 0.4, 6)
    found = scene.at(q)
    assert np.allclose(found["markers"], truth.points(q), atol=1e-9)
    frame = np.eye(4)
    for (point, direction), (a, alpha, d), theta in zip(found["axes"], ROWS, q, strict=True):
        assert np.allclose(direction, frame[:3, 2], atol=1e-9)
        assert np.allclose(np.cross(point - frame[:3, 3], direction), 0.0, atol=1e-9), "a point of the axis"
        beside = truth.points(q).mean(axis=0) - point
        assert abs(beside @ direction) < 1e-9, "the nearest to the markers"
        frame = frame @ link(a, alpha, d, theta)
    for camera, P, name in zip(found["cameras"], truth.cameras, ("left", "right", "high"), strict=True):
        centre = np.array(camera["centre"])
        assert camera["name"] == name
        assert np.allclose(P @ np.append(centre, 1.0), 0.0, atol=1e-6)
        ahead = centre + 0.5 * np.array(camera["axis"])
        u, v, depth = P @ np.append(ahead, 1.0)
        assert np.allclose((u / depth, v / depth, depth), (320.0, 240.0, 0.5), atol=1e-6), "half a metre before it"


def test_a_projective_model_and_cameras_on_the_arm_have_no_scene() -> None:
    model = make_truth(1).model
    assert Scene.of(msgspec.structs.replace(model, stratum="projective")) is None
    assert Scene.of(make_truth(1, mount="eye_in_hand").model) is None
