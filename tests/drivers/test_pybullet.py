"""The pybullet arm against the fake one, and what its process prints and loads."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.fake import FakeJointDriver
from stereoservo_drivers.pybullet import PybulletCameraDriver, PybulletJointDriver
from stereoservo_sim.world.history import TrueJointHistory

MS = 1_000_000


def drive(kind, tmp_path, profile, cycles):
    """True positions after each cycle, (cycles, 6)."""
    clock, world = VirtualClock(), TrueJointHistory.in_memory(6)
    driver = kind({}, DriverContext(clock, "t", tmp_path, tmp_path, services={"world": world}))
    driver.configure()
    driver.activate()
    for k in range(cycles):
        driver.write_velocity(profile(k))
        clock.advance_to(clock.now_ns() + 4 * MS)
        driver.read_state()
    positions = world.since(0)[2]
    driver.close()
    return positions


def test_physics_follows_the_ideal_drives_within_one_step(tmp_path):
    amplitude = np.array([0.5, -0.3, 0.4, 0.9, -0.6, 1.0])
    physical = drive(PybulletJointDriver, tmp_path, lambda k: amplitude * np.sin(k / 30), 250)
    ideal = drive(FakeJointDriver, tmp_path, lambda k: amplitude * np.sin(k / 30), 250)
    # The engine follows one millisecond behind.
    assert np.abs(physical - ideal).max() < 2e-3
    assert np.abs(ideal[-1] - ideal[0]).max() > 0.05


def test_the_arm_neither_sags_nor_drifts(tmp_path):
    positions = drive(PybulletJointDriver, tmp_path, lambda k: np.zeros(6), 500)
    assert np.abs(positions - positions[0]).max() < 1e-6


def test_two_runs_are_the_same_bit_for_bit(tmp_path):
    def profile(k):
        return 0.4 * np.sin(np.arange(6) + k / 20)

    first = drive(PybulletJointDriver, tmp_path, profile, 100)
    assert np.array_equal(first, drive(PybulletJointDriver, tmp_path, profile, 100))


def run_python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=240)


def test_nothing_is_printed(tmp_path):
    result = run_python(
        "from pathlib import Path\n"
        "from stereoservo.ports.clock import VirtualClock\n"
        "from stereoservo.ports.devices import DriverContext\n"
        "from stereoservo_drivers.pybullet import PybulletJointDriver\n"
        f"p = Path({str(tmp_path)!r})\n"
        "d = PybulletJointDriver({}, DriverContext(VirtualClock(), 't', p, p))\n"
        "d.configure(); d.activate(); d.read_state(); d.close()\n"
        "print('end')\n"
    )
    assert result.stdout == "end\n"
    assert result.stderr == ""


@pytest.mark.parametrize(
    ("module", "driver", "absent"),
    [
        (
            "stereoservo_drivers.pybullet",
            "PybulletJointDriver",
            ("cv2", "numba", "stereoservo_sim.world.rendering"),
        ),
        (
            "stereoservo_drivers.pybullet",
            "PybulletCameraDriver",
            ("pybullet", "stereoservo_sim.world.physics"),
        ),
        ("stereoservo_drivers.fake", "FakeJointDriver", ("cv2", "numba", "pybullet")),
    ],
)
def test_a_process_loads_only_what_it_needs(tmp_path, module, driver, absent):
    result = run_python(
        "import sys\n"
        "from pathlib import Path\n"
        "from stereoservo.ports.clock import VirtualClock\n"
        "from stereoservo.ports.devices import DriverContext\n"
        f"from {module} import {driver}\n"
        f"p = Path({str(tmp_path)!r})\n"
        f"d = {driver}({{}}, DriverContext(VirtualClock(), 't', p, p, 'left'))\n"
        "d.configure(); d.activate()\n"
        f"print([m for m in {absent!r} if m in sys.modules])\n"
    )
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": -1.0}, "noise"),
        ({"background": "beach"}, "beach"),
        ({"blurr": 1.0}, "did you mean 'blur'.* valid: .*blur"),
    ],
)
def test_bad_camera_options_are_refused(tmp_path, options, message):
    with pytest.raises(DriverError, match=message):
        PybulletCameraDriver(options, DriverContext(VirtualClock(), "t", tmp_path, tmp_path, "left"))
