"""The dot detector on the simulated cell's own pictures: room, arm, occlusion, blur, noise."""

import numpy as np
import pytest

from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import demo_cell

from .scenes import as_frame, make_detector, normalised, rms

CELL = demo_cell()


def poses(rng, n, reach=0.35):
    """Joint angles (n, 6) about the demo's base [rad]."""
    return CELL.base + rng.uniform(-reach, reach, (n, len(CELL.base)))


def looks(rng, n, settings):
    """(image, truth (14, 2), visible (14,)) of both cameras at n poses."""
    renderers = {camera.name: Renderer(CELL, camera, settings) for camera in CELL.rig.cameras}
    for q in poses(rng, n):
        truth = CELL.truth_pixels(q)
        for name, renderer in renderers.items():
            yield as_frame(renderer.render(q, rng)), truth[name]


@pytest.mark.parametrize(("noise", "accuracy"), [(0.0, 0.003), (2.0, 0.012)])
def test_dots_of_the_simulated_cell(noise, accuracy):
    rng = np.random.default_rng(1)
    detector = make_detector(floor_px=0.0015)
    errors, squares, found = [], [], 0
    for frame, truth in looks(rng, 25, RenderSettings(noise_grey=noise)):
        observation = detector.detect(frame, None)
        error = observation.pixels - truth[observation.ids]
        assert (np.hypot(*error.T) < 0.3).all()
        errors.append(error)
        squares.append(normalised(error, observation.covariances))
        found += len(observation.ids)
    assert found > 25 * 7
    assert rms(np.concatenate(errors)) < accuracy
    if noise:
        squares = np.concatenate(squares)
        # the simulation draws one noise field and shifts it: half the dots may share their noise with another frame
        assert abs(squares.mean() / 2 - 1) < 5 * np.sqrt(2 / len(squares)) + 0.05
