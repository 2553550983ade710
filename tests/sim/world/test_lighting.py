"""Light that changes in rendered pictures: exposure, shadow, reflection, flicker, each beside what it is said to be."""

import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.pybullet import PybulletCameraDriver
from stereoservo_sim.world.lighting import Lighting
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import demo_cell

EVEN = np.full((480, 640), 100.0, np.float32)


def test_ambient_steps_and_the_exposure_that_follows_them():
    fixed = Lighting(level=0.8, steps=((1.0, 0.5), (3.0, 2.0)))
    assert [fixed.exposed(t) for t in (0.5, 1.0, 2.9, 3.0, 60.0)] == pytest.approx([0.8, 0.4, 0.4, 1.6, 1.6])
    adapting = Lighting(steps=((1.0, 0.5), (2.0, 1.0)), adapt_s=0.5)
    # the first step is forgotten by e^-2 when the second comes
    assert adapting.exposed(1.0) == pytest.approx(0.5)
    assert adapting.exposed(2.0) == pytest.approx(0.5 ** np.exp(-2.0) * 2.0)
    assert adapting.exposed(12.0) == pytest.approx(1.0)


def test_a_shadow_takes_its_share_and_crosses_the_picture():
    light = Lighting(shadow=0.6, shadow_px=100.0, soft_px=4.0, shadow_s=4.0)
    dark = [light.lit(EVEN, t) for t in (1.5, 2.5)]
    for picture in dark:
        assert picture.min() == pytest.approx(40.0, abs=0.1)
        assert picture.max() == pytest.approx(100.0, abs=0.1)
        widths = (picture < 70.0).sum(axis=1)
        assert np.abs(widths - 100).max() <= 2
    ways = [np.median(np.flatnonzero(picture[240] < 70.0)) for picture in dark]
    assert ways[1] - ways[0] == pytest.approx(0.25 * (640 + 0.35 * 480 + 200), abs=1.5)


def test_a_lamp_adds_and_bands_come_with_the_rows():
    spot = Lighting(spot=80.0, spot_px=30.0).lit(EVEN, 0.0)
    assert np.unravel_index(spot.argmax(), spot.shape) == (240, 416)
    assert spot.sum() - EVEN.sum() == pytest.approx(80.0 * 2.0 * np.pi * 30.0**2, rel=1e-3)
    rows = Lighting(flicker=0.3, readout_s=0.02).lit(EVEN, 0.004)[:, 0] / 100.0 - 1.0
    phase = 2.0 * np.pi * 100.0 * (0.004 + 0.02 * (np.arange(480) / 480 - 0.5))
    assert np.abs(rows - 0.3 * np.sin(phase)).max() < 1e-5


def test_cameras_show_it_by_the_time_since_they_were_started(tmp_path):
    cell = demo_cell()
    settings = RenderSettings(noise_grey=0.0, background="plain", lighting=Lighting(steps=((1.0, 0.25),)))
    renderer = Renderer(cell, cell.rig.cameras[0], settings)
    before, after = (renderer.render(cell.base, np.random.default_rng(0), t_s=t) for t in (0.9, 1.1))
    assert np.abs(after.astype(float) - 0.25 * before).max() <= 0.75
    context = DriverContext(VirtualClock(), "light", tmp_path, tmp_path, "left")
    with pytest.raises(DriverError, match="shadow"):
        PybulletCameraDriver({"lighting": {"shadow": 2.0}}, context)
