"""Goals with damping (thesis 9.3): how fast an error decays, drives that are late, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from core.test_moving_target import MARKERS, largest_px, slide
from stereoservo.control.pd import GAIN_MARGIN, largest_gain
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.messages.goals import (
    AdaptiveGain,
    Feature,
    FeatureTarget,
    Goal,
    IncidenceSpec,
    IncidenceTarget,
    RunGoal,
)

WAY = np.array([0.02, -0.02, 0.02, 0.03, -0.02, 0.03])


def rate_of_decay(bench: Any, command: RunGoal, joints: np.ndarray) -> float:
    """At which the joints come nearer to those of the goal [1/s]."""
    assert bench.reply(command).accepted
    bench.run(0.5)
    first = np.linalg.norm(bench.q - joints)
    bench.run(0.5)
    return float(np.log(first / np.linalg.norm(bench.q - joints)) / 0.5)


@pytest.mark.parametrize("law", ["stereo", "cartesian3"])
def test_an_error_decays_at_the_gain_over_one_and_the_damping(benches: Any, law: str) -> None:
    rates = {}
    for damping in (None, 0.5):
        bench = benches(3).ready()
        joints = bench.q + WAY
        goal = bench.goal(FeatureTarget(bench.features(joints)), law=law, gain=2.0, damping=damping)
        rates[damping] = rate_of_decay(bench, goal, joints)
    assert rates[None] == pytest.approx(2.0, rel=0.05)
    assert rates[0.5] == pytest.approx(2.0 / 1.5, rel=0.05)


def test_a_damped_goal_is_told_its_longer_time_and_is_reached(benches: Any) -> None:
    bench = benches(3).ready()
    target = FeatureTarget(bench.features(bench.q + WAY))
    plain, damped = (
        bench.reply(bench.goal(target, law="stereo", damping=damping, check=True)).plan.seconds
        for damping in (None, 0.4)
    )
    assert damped == pytest.approx(1.4 * plain)
    assert bench.reply(bench.goal(target, law="trajectory", damping=0.4)).accepted
    assert bench.ended().kind == "goal_reached"


def overshoot(bench: Any, gain: float, damping: float | None) -> float:
    """How far the third joint goes beyond its place, over its way."""
    start, joints = bench.q.copy(), bench.q + WAY
    target = FeatureTarget(bench.features(joints))
    assert bench.reply(bench.goal(target, law="stereo", gain=gain, damping=damping)).accepted
    farthest = 0.0
    for _ in range(200):
        bench.step()
        farthest = max(farthest, (bench.q[2] - joints[2]) / (joints - start)[2])
    return float(farthest)


def test_late_drives_overshoot_less_with_damping(benches: Any) -> None:
    """0.1 s late at a gain of 6/s; beside the closed loop of one joint, in steps of the core."""
    found, predicted = {}, {}
    for damping in (0.0, 0.4):
        bench = benches(3).ready()
        bench.delay_s = 0.1
        found[damping] = overshoot(bench, 6.0, damping)
        x, speeds, filtered, far = 1.0, [0.0] * 11, 0.0, 0.0
        for _ in range(200):
            filtered += 0.5 * (speeds[-11] - filtered)  # the core's filter: 10 ms, steps of 10 ms
            speeds.append(-6.0 * x - damping * filtered)
            x += 0.01 * speeds[-11]
            far = max(far, -x)
        predicted[damping] = far
    print(found, predicted)
    for damping, far in predicted.items():
        assert found[damping] == pytest.approx(far, abs=0.05)
    assert found[0.4] < 0.4 * found[0.0]


def test_what_late_drives_make_unstable_is_refused_with_the_gain_that_is_not(benches: Any) -> None:
    bench = benches(3).ready()
    bench.core.state.block.delay_s[2] = 0.2
    target = FeatureTarget(bench.features(bench.q + WAY))
    most = largest_gain(0.7, 0.2 + 0.01 + 0.01) / GAIN_MARGIN
    for gain in (1.01 * most, AdaptiveGain(1.01 * most, 0.5)):
        refused = bench.reply(bench.goal(target, law="stereo", gain=gain, damping=0.7))
        assert not refused.accepted
        (reason,) = refused.reasons
        assert (reason.code, reason.subject) == ("DAMPING_UNSTABLE", "j3")
        assert reason.threshold == pytest.approx(most)
    assert bench.reply(bench.goal(target, law="stereo", gain=0.99 * most, damping=0.7)).accepted


def test_an_incidence_is_damped_too(benches: Any) -> None:
    seconds = {}
    for damping in (None, 0.5):
        bench = benches(3).ready()
        corners = bench.projective(bench.truth.points(bench.q + WAY)[:3])
        fixed = Feature(points=tuple(map(tuple, corners.tolist())))
        spec = IncidenceSpec("point-on-plane", Feature(markers=(4,)), fixed)
        goal = bench.goal(IncidenceTarget((spec,), model_epoch=7), gain=2.0, damping=damping, hold_frames=1)
        assert bench.reply(goal).accepted
        begun_ns = bench.now_ns
        assert bench.ended().kind == "goal_reached"
        seconds[damping] = (bench.now_ns - begun_ns) * 1e-9
    assert seconds[0.5] == pytest.approx(1.5 * seconds[None], rel=0.1)


def test_a_target_that_moves_is_followed_with_damping(benches: Any) -> None:
    """What is fed forward is not damped: before a target at a constant speed nothing lags."""
    bench = benches(0, noise_px=0.1, mount="eye_in_hand").ready()
    wanted = bench.truth.pixels(bench.q)
    slide(bench, lambda t: 1e-6 * np.ones(3) * min(t, 1.0))
    goal = Goal(
        "00000001", FeatureTarget(bench.features(bench.q)), law="stereo", gain=2.0, damping=0.5, tolerance_px=0.1,
        time_limit_s=60.0, follow_markers=MARKERS,
    )  # fmt: skip
    assert bench.reply(RunGoal(goal)).accepted
    bench.run(0.4)
    slide(bench, lambda t: 0.03 * t * np.array([0.0, 1.0, 0.0]))
    bench.run(2.0)
    again = decode_state(encode_state(bench.core.state))
    assert again.source.damping == 0.5
    bench.core = ServoCore(bench.settings, again)
    assert largest_px(bench, wanted, 1.0) < 1.5
