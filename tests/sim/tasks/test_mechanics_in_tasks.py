"""Alignment tasks of an arm that is not perfect."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.tasks.arms import PLATE_ON_FLANGE, RX90_HOME, SerialArm, mechanics_of, rx90_cell
from stereoservo_sim.tasks.calibrations import calibrate


def driven(name):
    arm = SerialArm(rx90_cell(), RX90_HOME, mechanics_of(name))
    start = arm.pose
    for k in range(100):
        arm.move(np.full(6, 0.05 if k < 50 else 0.0), 0.04)
    return arm, start


def test_without_mechanics_the_readings_are_the_joints():
    arm, _ = driven(None)
    assert np.allclose(arm.joints, RX90_HOME + 0.1)
    assert np.array_equal(arm.pose, rx90_cell().flange(arm.joints) @ PLATE_ON_FLANGE)


@pytest.mark.parametrize("name", ["strain_wave", "planetary_qdd", "serial_servo"])
def test_the_plate_is_where_the_links_are_and_not_the_readings(name):
    arm, start = driven(name)
    cell = rx90_cell()
    assert np.allclose(start, cell.flange(RX90_HOME) @ PLATE_ON_FLANGE, atol=1e-12)
    seen = cell.flange(arm.joints) @ PLATE_ON_FLANGE
    off = np.linalg.norm((arm.pose - seen)[:3, 3])
    assert 2e-5 < off < 0.02
    assert np.allclose(arm.joints, RX90_HOME + 0.1, atol=0.06)


def test_the_trial_motions_of_servos_that_give_way_give_a_model():
    """Other joints stray by 2° in a joint's trial: that body, base or cameras had moved was told."""
    facts = calibrate("rx90", "self", 0.1, 0, "serial_servo").facts
    assert facts["stratum"] == "metric"
