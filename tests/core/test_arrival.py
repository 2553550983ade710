"""Arrival at joint positions: tolerances from the encoder's step, and commands that do not hunt."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import core_settings
from stereoservo.core.sources.joint_move import approach_velocity, arrived
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.goals import JointTarget
from stereoservo.ports.devices import CameraDescription, JointDriverDescription, JointSpec

from .conftest import BASE, NAMES, make_settings

STEP = 2.0 * np.pi / 4096


def with_steps(*steps):
    return msgspec.structs.replace(make_settings(), resolution=steps)


def test_tolerance_is_the_finest_or_three_quarters_of_a_step():
    assert np.array_equal(make_settings().arrival, np.full(6, 5e-4))
    settings = with_steps(0.0, 1e-6, STEP, 0.01, 6e-4, 0.0)
    assert np.allclose(settings.arrival, [5e-4, 5e-4, 0.75 * STEP, 0.0075, 5e-4, 5e-4])


@pytest.mark.parametrize("resolution", [(), (0.0,) * 6, (1e-6,) * 6])
def test_fine_encoders_are_commanded_as_before(resolution):
    plain, settings = make_settings(), msgspec.structs.replace(make_settings(), resolution=resolution)
    rng = np.random.default_rng(2)
    for scale in (1.0, 1e-2, 1e-4, 1e-7, 0.0):
        q, target = rng.normal(size=6), rng.normal(size=6)
        target = q + scale * (target - q)
        distance = target - q
        length = np.maximum(np.abs(distance), 1e-12)
        speed = np.minimum(1.0 * 0.5, np.sqrt(2.0 * 0.6 * 4.0 * length))
        expected = distance * min(float((speed / length).min()), 15.0)
        assert np.array_equal(approach_velocity(q, target, settings, 0.5), expected)
        assert arrived(q, target, settings) == arrived(q, target, plain) == (np.abs(distance).max() < 5e-4)


def test_a_coarse_joint_stays_where_it_has_arrived_while_the_others_go_on():
    settings = with_steps(0.0, 0.0, STEP, 0.0, 0.0, 0.0)
    q = np.zeros(6)
    target = np.full(6, 0.7 * STEP)
    velocity = approach_velocity(q, target, settings, 1.0)
    assert velocity[2] == 0.0
    assert (np.delete(velocity, 2) > 0.0).all()
    assert not arrived(q, target, settings)
    assert arrived(q, np.array([0.0, 0.0, 0.7 * STEP, 0.0, 0.0, 0.0]), settings)
    target[2] = 0.8 * STEP
    assert approach_velocity(q, target, settings, 1.0)[2] > 0.0


@pytest.mark.parametrize("step", [STEP, 0.01])
def test_some_reading_near_any_target_has_arrived(step):
    settings = with_steps(*(step,) * 6)
    for target in np.random.default_rng(5).uniform(-1.0, 1.0, (200, 6)):
        assert arrived(np.round(target / step) * step, target, settings)


def test_a_resolution_is_zero_or_above():
    for wrong in (-1e-3, np.nan, np.inf):
        with pytest.raises(ValueError, match="joint 'a': encoder resolution"):
            JointSpec("a", "revolute", -1.0, 1.0, 1.0, 1.0, wrong)


def test_settings_take_the_step_that_the_driver_describes():
    cell = check_cell(
        {
            "schema": 1,
            "cell": {"name": "c"},
            "joints": {"driver": "fake"},
            "camera": [{"name": "left", "driver": "fake"}, {"name": "right", "driver": "fake"}],
            "safety": {"limit": [{"joint": "a", "min": -1, "max": 1, "velocity": 1, "acceleration": 1}]},
        }
    )
    joints = JointDriverDescription(
        "x", (JointSpec("a", "revolute", -1.0, 1.0, 1.0, 1.0, STEP),), 100.0, "clock", 0.1, 1000.0
    )
    cameras = tuple(
        CameraDescription("x", name, 640, 480, 30.0, "observations", 1000.0, (1, 2, 3, 4)) for name in ("left", "right")
    )
    assert core_settings(cell, joints, cameras).resolution == (STEP,)


def test_a_joint_that_does_not_arrive_is_told_with_its_tolerance_and_where_that_comes_from(bench):
    settings = msgspec.structs.replace(bench.settings, resolution=(STEP,) * 6, watch_following=False)
    bench.settings, bench.core = settings, ServoCore(settings)
    bench.ready()
    bench.frozen_joint = 2
    target = JointTarget(dict(zip(NAMES, (BASE + 0.1).tolist(), strict=True)))
    bench.reply(bench.goal(target, time_limit_s=2.0))
    end = bench.ended()
    assert end.reasons[0].subject == "j3"
    assert f"tolerance {0.75 * STEP:.4g}, 0.75 of its encoder's step of {STEP:.4g}" in end.reasons[0].hint
