"""The pybullet backdrop shows the arm where it is, and is refreshed seldom."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.world.camera_rig import project
from stereoservo_sim.world.rendering import REFRESH_FRAMES, PybulletBackdrop
from stereoservo_sim.world.robots import shape_segments
from stereoservo_sim.world.simulated_cell import demo_cell

CELL = demo_cell()


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("view", ["left", "right"])
def test_links_stand_where_the_kinematics_put_them(seed: int, view: str) -> None:
    camera = CELL.rig.camera(view)
    q = CELL.base + np.random.default_rng(seed).uniform(-0.2, 0.2, 6)
    image = PybulletBackdrop(CELL, camera).image(q)
    floor = np.median(image[-100:])
    ends, _ = shape_segments(CELL.robot, q)
    seen = 0
    for segment in ends:
        pixels, depths = project(camera.P, segment.mean(axis=0, keepdims=True))
        (u, v), depth = pixels[0], depths[0]
        if 10 < u < camera.width - 10 and 10 < v < camera.height - 10 and depth > 0:
            seen += 1
            assert image[round(v), round(u)] > floor + 15
    assert seen >= 3


def test_backdrop_is_kept_until_the_arm_has_moved_and_time_has_passed() -> None:
    backdrop = PybulletBackdrop(CELL, CELL.rig.cameras[0])
    first = backdrop.image(CELL.base)
    moved = CELL.base + 0.3
    for _ in range(REFRESH_FRAMES - 1):
        assert backdrop.image(moved) is first
    assert backdrop.image(moved) is not first
    second = backdrop.image(moved)
    for _ in range(2 * REFRESH_FRAMES):
        assert backdrop.image(moved + 0.01) is second
