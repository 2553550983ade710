"""Drives whose friction holds them against small velocities: goals are reached all the same, and nothing hunts."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.command import MOST
from stereoservo.core.servo_core import ServoCore
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.messages.goals import FeatureTarget, JointTarget

STEP = 2.0 * np.pi / 4096.0
WAY = 0.4 * np.array([0.18, -0.15, 0.2, 0.3, -0.25, 0.35])


def true_error(bench: Any, q: np.ndarray) -> float:
    """Farthest a marker is [px], without noise, from where it is with the joints at ``q``."""
    return float(np.abs(bench.truth.pixels(bench.q) - bench.truth.pixels(q)).max())


def with_settings(bench: Any, **changed: Any) -> None:
    bench.settings = msgspec.structs.replace(bench.settings, **changed)
    bench.core = ServoCore(bench.settings)
    bench.ready()


@pytest.mark.parametrize("law", ["stereo", "image", "cartesian3"])
@pytest.mark.parametrize("dead_speed", [0.002, 0.005, 0.01])
def test_a_goal_by_images_is_reached_against_friction(bench: Any, law: str, dead_speed: float) -> None:
    bench.ready()
    bench.dead_speed, bench.noise_px = dead_speed, 0.02
    target = bench.q + WAY
    assert bench.reply(bench.goal(FeatureTarget(bench.features(target)), law=law)).accepted
    assert bench.ended().kind == "goal_reached"
    bench.run(0.3)
    assert true_error(bench, target) < 2.0 * bench.settings.tolerance_px


def test_a_joint_goal_is_reached_against_friction(bench: Any) -> None:
    bench.ready()
    bench.dead_speed = 0.01
    target = bench.q + 0.2
    joints = dict(zip(bench.settings.joint_names, target.tolist(), strict=True))
    assert bench.reply(bench.goal(JointTarget(joints))).accepted
    assert bench.ended().kind == "goal_reached"
    assert np.abs(bench.q - target).max() < 2.0 * bench.settings.arrival.max()


@pytest.mark.parametrize("resolution", [0.0, 1e-5, STEP])
def test_a_drive_without_friction_is_not_pushed(bench: Any, resolution: float) -> None:
    with_settings(bench, resolution=(resolution,) * 6)
    bench.resolution, bench.noise_px = resolution, 0.05
    assert bench.reply(bench.goal(FeatureTarget(bench.features(bench.q + WAY)), time_limit_s=15.0)).accepted
    most = 0.0
    for _ in range(round(15.0 * bench.settings.rate_hz)):
        bench.step()
        if bench.core.state.friction_of:
            most = max(most, float(np.abs(bench.core.state.block.friction).max()))
    assert most <= (0.1 if resolution < STEP else 0.4) * MOST["revolute"]


@pytest.mark.parametrize("resolution", [0.0, STEP])
def test_nothing_hunts_while_a_goal_is_held_against_friction(bench: Any, resolution: float) -> None:
    with_settings(bench, resolution=(resolution,) * 6, hold_frames=1000)
    bench.resolution, bench.dead_speed, bench.noise_px = resolution, 0.01, 0.05
    target = bench.q + WAY
    assert bench.reply(bench.goal(FeatureTarget(bench.features(target)), law="stereo", time_limit_s=60.0)).accepted
    bench.run(14.0)
    stood = []
    for _ in range(6):
        bench.run(0.5)
        stood.append(bench.q.copy())
    assert bench.core.state.friction_of != ""
    assert np.ptp(stood, axis=0).max() < 3e-4
    one_step = max(true_error(bench, bench.q + resolution * joint) for joint in np.eye(6))
    assert true_error(bench, target) < 2.0 * bench.settings.tolerance_px + one_step


@pytest.mark.parametrize(
    ("resolution", "stated", "added"), [(STEP, True, False), (STEP, False, True), (1e-5, True, True)]
)
def test_play_before_a_coarse_encoder_is_not_taken_for_friction(
    bench: Any, resolution: float, stated: bool, added: bool
) -> None:
    """A joint that stands, whatever it is sent; the demo with `--mechanics serial_servo` hunted to its time limit."""
    accuracy = JointAccuracy(np.full(6, 0.01), *(np.zeros(6),) * 3)
    bench.truth.model = msgspec.structs.replace(bench.truth.model, joint_accuracy=accuracy if stated else None)
    with_settings(bench, watch_following=False, resolution=(resolution,) * 6)
    bench.resolution, bench.frozen_joint, bench.dead_speed = resolution, 2, 1.0
    assert bench.reply(bench.goal(FeatureTarget(bench.features(bench.q + 0.02 * WAY)), time_limit_s=4.0)).accepted
    bench.run(3.0)
    assert bool(bench.core.state.block.friction.any()) is added


def test_what_is_added_is_bounded_and_forgotten_with_the_goal(bench: Any) -> None:
    with_settings(bench, watch_following=False)
    bench.frozen_joint, bench.dead_speed = 2, 1.0  # nothing moves, whatever is sent
    assert bench.reply(bench.goal(FeatureTarget(bench.features(bench.q + 0.02 * WAY)), time_limit_s=4.0)).accepted
    bench.run(3.0)
    most = MOST["revolute"]
    assert 0.9 * most < np.abs(bench.core.state.block.friction).max() <= most
    bench.ended()
    bench.run(0.1)
    assert bench.core.state.friction_of == ""
    assert np.abs(bench.core.state.block.command).max() == 0.0
