"""The watch on joints that do not go where they are sent: drives and encoders as simple as they can be stated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.context import Workspace
from stereoservo.core.estimate import workspace
from stereoservo.core.monitor import account_following, explain_following
from stereoservo.core.monitors.following import PLAY, SILENCE_S
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state import CoreState, initial_state
from stereoservo.messages.goals import Calibrate, Enable, FeatureTarget, Jog, JointTarget, Reset
from stereoservo.messages.reasons import Reason

RATE_HZ = 250.0
DT_S = 1.0 / RATE_HZ
Encoder = Callable[[np.ndarray], np.ndarray]


def following_error(
    state: CoreState, settings: Any, room: Workspace, q: np.ndarray, dt_s: float = DT_S,
    sent: np.ndarray | None = None,
) -> Reason | None:  # fmt: skip
    """What the watch says of one step, ``dt_s`` after the last, with the joints read at ``q``."""
    room.q[:], room.numbers.elapsed_s, room.numbers.has_sent = q, dt_s, sent is not None
    if sent is not None:
        room.sent[:] = sent
    room.numbers.following = account_following(state.block.record, room.record)
    return explain_following(state, settings, room)


def watched(
    settings: Any, commands: np.ndarray, readings: np.ndarray, every: int = 1, state: CoreState | None = None,
    sent_share: float | None = None,
) -> tuple[Reason | None, int]:  # fmt: skip
    """What the watch says of joint 1, sent ``commands`` (k,) [rad/s] and read as ``readings`` (k,) in every so many
    steps, and when. ``state``: what it remembers. ``sent_share``: of the commands, that the driver says it has sent.
    """
    state = initial_state(settings) if state is None else state
    room = workspace(settings, None)
    for k, command in enumerate(commands):
        q = np.zeros(len(settings.joint_names))
        q[0] = readings[k - k % every]
        state.block.numbers.last_joints_ns = 1 + k - k % every
        sent = None if sent_share is None else sent_share * state.block.command
        reason = following_error(state, settings, room, q, DT_S, sent)
        if reason is not None:
            return reason, k
        state.block.command[:] = np.zeros_like(q)
        state.block.command[0] = command
    return None, len(commands)


def travelled(commands: np.ndarray) -> np.ndarray:
    """Where an exact drive stands when it has just got each command (k,) [rad]."""
    return np.concatenate([[0.0], np.cumsum(commands[:-1] * DT_S)])


@pytest.mark.parametrize("speed", [0.015, 0.03, 0.1, 0.14, 0.16, 0.3, 1.0])
def test_an_arm_whose_encoder_stands_still_goes_less_than_0_17_rad_at_any_speed(bench, speed):
    commands = np.full(round(20.0 * RATE_HZ), speed)
    reason, k = watched(bench.settings, commands, np.zeros(len(commands)))
    assert reason is not None
    assert (reason.code, reason.subject) == ("JOINT_NOT_FOLLOWING", bench.settings.joint_names[0])
    assert "check its encoder, brake and drive" in reason.hint
    slowed = speed / (speed - 0.01)  # what friction may hold back is not counted
    bound = PLAY["revolute"] * slowed if speed < 0.3 else 0.17 * bench.settings.limits.velocity_max[0]
    assert k * DT_S * speed <= bound + 0.2 * speed * (speed < 0.3)


def delayed(commands: np.ndarray, delay_s: float) -> np.ndarray:
    steps = round(delay_s * RATE_HZ)
    return travelled(np.concatenate([np.zeros(steps), commands[: len(commands) - steps]]))


def setting_out(speed: float, seconds: float, acceleration: float = 4.0) -> np.ndarray:
    """At rest for half a second, then up to a speed, and on."""
    t = np.arange(round((0.5 + seconds) * RATE_HZ)) * DT_S - 0.5
    return np.clip(acceleration * t, 0.0, speed)


def with_play(positions: np.ndarray, play: float) -> np.ndarray:
    """Positions of a joint that its motor takes along where it stands ``play`` off to either side."""
    joint = np.zeros(len(positions))
    for k in range(1, len(positions)):
        joint[k] = np.clip(joint[k - 1], positions[k] - play, positions[k] + play)
    return joint


def to_and_fro(speed: float, seconds: float) -> np.ndarray:
    t = np.arange(round(60.0 * RATE_HZ)) * DT_S
    return speed * np.where((t // seconds) % 2 == 0.0, 1.0, -1.0)


def short_moves(speed: float, seconds: float) -> np.ndarray:
    t = np.arange(round(60.0 * RATE_HZ)) * DT_S
    return speed * (t % 1.0 < seconds) * np.where(t % 2.0 < 1.0, 1.0, -1.0)


HEALTHY = {
    "friction holds it at 10 mrad/s for a minute": lambda: (np.full(15000, 0.01), np.zeros(15000)),
    "play of 3 degrees, to and fro": lambda: (c := to_and_fro(0.1, 2.0), with_play(travelled(c), 0.026)),
    "an encoder of 12 bits, slow": lambda: (
        c := to_and_fro(0.012, 5.0),
        np.floor(travelled(c) / 1.5e-3) * 1.5e-3,
    ),
    "delay of 0.13 s, jerky": lambda: (c := short_moves(0.9, 0.1), delayed(c, 0.13)),
    "a gain error of 5 per cent": lambda: (c := to_and_fro(1.0, 3.0), 0.95 * travelled(c)),
    "moved in the dead band of an encoder": lambda: (c := short_moves(0.02, 0.02), np.zeros(len(c))),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_drive_is_not_blamed(bench, name):
    commands, readings = HEALTHY[name]()
    assert watched(bench.settings, commands, readings) == (None, len(commands))


@pytest.mark.parametrize("every", [1, 4])
def test_a_gain_error_is_forgotten_however_often_the_drive_tells(bench, every):
    """10 per cent at 1 rad/s for a second leave 0.1 rad missing, for ever as well; 0.15 are a fault."""
    commands = np.full(round(12.0 * RATE_HZ), 1.0)
    assert watched(bench.settings, commands, 0.9 * travelled(commands), every) == (None, len(commands))


@pytest.mark.parametrize("noise", [0.0, 4e-4])
def test_a_reading_that_only_flickers_stands_still(bench, noise):
    rng = np.random.default_rng(5)
    commands = np.full(5000, 0.05)
    reason, k = watched(bench.settings, commands, rng.uniform(-noise, noise, len(commands)))
    assert reason is not None
    assert k * DT_S * 0.05 < 0.09


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_a_command_that_the_driver_has_scaled_down_lacks_nothing_of_what_was_sent(bench, share):
    commands = np.full(1000, 0.8)
    readings = travelled(share * commands)
    assert watched(bench.settings, commands, readings)[0] is not None
    assert watched(bench.settings, commands, readings, sent_share=share) == (None, len(commands))


def test_a_joint_that_is_blocked_is_found_by_what_was_sent(bench):
    commands = np.full(1000, 0.8)
    stands = np.minimum(travelled(0.4 * commands), 0.1)
    reason, at = watched(bench.settings, commands, stands, sent_share=0.4)
    assert reason is not None
    assert reason.value <= 0.4 * 0.8 * at * DT_S - 0.1 + 1e-9  # no more than it was sent, less what it went


def on_a_rail(settings: Any) -> Any:
    return msgspec.structs.replace(settings, joint_kinds=("prismatic", *settings.joint_kinds[1:]))


@pytest.mark.parametrize("speed", [0.0015, 0.005, 0.1])
def test_a_rail_whose_encoder_stands_still_goes_a_few_millimetres_at_low_speed(bench, speed):
    commands = np.full(round(12.0 * RATE_HZ), speed)
    reason, k = watched(on_a_rail(bench.settings), commands, np.zeros(len(commands)))
    assert reason is not None
    assert (reason.code, reason.threshold, reason.unit) == ("JOINT_NOT_FOLLOWING", PLAY["prismatic"], "m")
    assert k * DT_S * (speed - 0.001) <= PLAY["prismatic"] + speed * SILENCE_S


def test_a_healthy_rail_is_not_blamed(bench):
    settings = on_a_rail(bench.settings)
    commands = np.full(round(8.0 * RATE_HZ), 0.001)  # friction holds it
    assert watched(settings, commands, np.zeros(len(commands))) == (None, len(commands))
    commands *= 5.0
    steps_of_a_millimetre = np.floor(travelled(commands) / 1e-3) * 1e-3
    assert watched(settings, commands, steps_of_a_millimetre) == (None, len(commands))


def test_without_new_samples_nothing_is_concluded(bench):
    state, room, q = initial_state(bench.settings), workspace(bench.settings, None), np.zeros(6)
    state.block.numbers.last_joints_ns = 1
    for _ in range(100):  # 0.4 s at 1 rad/s
        assert following_error(state, bench.settings, room, q, DT_S) is None
        state.block.command[:] = np.eye(6)[0]
    q[0] = 99 * DT_S
    state.block.numbers.last_joints_ns = 2
    state.block.command[:] = np.zeros(6)
    assert following_error(state, bench.settings, room, q, DT_S) is None
    assert np.abs(state.block.missing_travel).max() < 1e-9


def test_what_was_missing_before_a_long_gap_is_forgotten(bench):
    state, room, q = initial_state(bench.settings), workspace(bench.settings, None), np.zeros(6)
    state.block.missing_travel[0] = 0.14
    for k, dt_s in enumerate((DT_S, 3.0)):
        state.block.numbers.last_joints_ns = 1 + k
        assert following_error(state, bench.settings, room, q, dt_s) is None
    assert not state.block.missing_travel.any()


def test_a_slow_jog_with_an_encoder_that_stands_still_ends_in_a_fault(bench: Any) -> None:
    bench.run(0.1)
    bench.step(Enable())
    bench.run(0.3)
    bench.frozen_joint = 2
    start = bench.q.copy()
    assert bench.reply(Jog({bench.settings.joint_names[2]: 0.05}, 60.0)).accepted
    event = bench.until(lambda e: e.kind == "fault", 10.0)
    assert (event.reasons[0].code, event.reasons[0].subject) == ("JOINT_NOT_FOLLOWING", "j3")
    assert "stood still for" in event.reasons[0].hint
    bench.run(0.5)
    assert np.abs(bench.q - start).max() < 0.09


def test_a_reset_begins_anew(bench: Any) -> None:
    """Commands were lost for less than a silence lasts: what they sent is not counted on top of the next goal's."""
    bench.run(0.1)
    bench.step(Enable())
    bench.run(0.3)
    name = bench.settings.joint_names[2]
    assert bench.reply(Jog({name: 1.0}, 2.0)).accepted
    bench.run(0.6)
    bench.dead_speed = 10.0  # nothing moves, whatever is sent
    event = bench.until(lambda e: e.kind == "fault", 0.5)
    assert "lacks" in event.reasons[0].hint
    bench.dead_speed = 0.0
    bench.run(0.3)
    bench.step(Reset())
    bench.run(0.1)
    bench.step(Enable())
    bench.run(0.3)
    start = bench.q.copy()
    assert bench.reply(Jog({name: 0.015}, 2.0)).accepted
    outputs = bench.run(1.0)
    assert outputs.status.lifecycle == "active"
    assert bench.q[2] - start[2] > 0.012


@pytest.mark.parametrize("speed", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("delay_s", [0.1, 0.15, 0.2])
@pytest.mark.parametrize("friction", [0.0, 0.01])
def test_the_delay_of_a_drive_is_measured_where_it_sets_out(bench, speed, delay_s, friction):
    settings = at_the_rate_of_these_tests(bench.settings)
    state, commands = initial_state(settings), setting_out(speed, 2.0)
    readings = delayed(commands - np.clip(commands, -friction, friction), delay_s)
    assert watched(settings, commands, readings, state=state) == (None, len(commands))
    assert abs(state.block.delays.delay_s[0] - delay_s) < 0.02
    assert not state.block.delays.delay_s[1:].any()


def at_the_rate_of_these_tests(settings: Any) -> Any:
    return msgspec.structs.replace(settings, rate_hz=RATE_HZ)


@pytest.mark.parametrize("speed", [0.3, 1.0])
@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.2])
def test_a_late_joint_that_is_blocked_on_its_way_is_found_as_fast_as_a_prompt_one(bench, speed, delay_s):
    settings = at_the_rate_of_these_tests(bench.settings)
    commands, blocked = setting_out(speed, 3.0), round(1.5 * RATE_HZ)
    readings = delayed(commands, delay_s)
    readings[blocked:] = readings[blocked]
    reason, k = watched(settings, commands, readings)
    assert reason is not None
    assert reason.code == "JOINT_NOT_FOLLOWING"
    assert (k - blocked) * DT_S <= (0.175 if speed == 1.0 else 0.26)


def test_play_before_an_encoder_is_no_delay(bench):
    """Known from two motions to the same side; what a motion to the other side takes up is not taken for one."""
    settings = at_the_rate_of_these_tests(bench.settings)
    state, rest = initial_state(settings), np.zeros(round(0.5 * RATE_HZ))
    pulse = np.concatenate([setting_out(0.2, 0.5), rest])
    commands = np.concatenate([pulse, pulse, pulse, -pulse, pulse, -pulse, pulse])
    assert watched(settings, commands, with_play(travelled(commands), 0.015), state=state)[0] is None
    assert state.block.delays.delay_s[0] == 0.0


@pytest.mark.parametrize("known_s", [0.1, 0.2])
def test_a_delay_that_is_too_long_hides_no_blocked_joint(bench, known_s):
    """A joint whose play was taken for a delay: in a steady motion it is ahead of it, and is prompt from there on."""
    settings = at_the_rate_of_these_tests(bench.settings)
    state = initial_state(settings)
    state.block.delays.samples[:, 0] = state.block.delays.delay_s[0] = known_s
    commands, blocked = setting_out(1.0, 2.0), round(1.25 * RATE_HZ)
    readings = travelled(commands)
    readings[blocked:] = readings[blocked]
    reason, k = watched(settings, commands, readings, state=state)
    assert reason is not None
    assert (k - blocked) * DT_S <= 0.175


def test_a_drive_that_has_become_faster_is_not_blamed(bench):
    settings = at_the_rate_of_these_tests(bench.settings)
    state = initial_state(settings)
    slow = setting_out(1.0, 1.0)
    assert watched(settings, slow, delayed(slow, 0.2), state=state)[0] is None
    assert state.block.delays.delay_s[0] == pytest.approx(0.2, abs=0.01)
    steady = np.full(round(2.0 * RATE_HZ), 1.0)
    began = delayed(slow, 0.2)[-1]
    assert watched(settings, steady, began + travelled(steady), state=state)[0] is None


def test_a_drive_that_is_later_than_a_quarter_of_a_second_does_not_follow(bench):
    settings = at_the_rate_of_these_tests(bench.settings)
    commands = setting_out(1.0, 1.0)
    reason, _ = watched(settings, commands, delayed(commands, 0.3))
    assert reason is not None
    assert reason.code == "JOINT_NOT_FOLLOWING"


@pytest.mark.parametrize("by", ["joints", "images"])
@pytest.mark.parametrize("delay_s", [0.1, 0.2])
def test_goals_are_reached_by_late_drives_and_not_overshot(bench: Any, by: str, delay_s: float) -> None:
    bench.ready()
    bench.delay_s = delay_s
    start, target = bench.q.copy(), bench.q + np.array([0.3, -0.25, 0.2, 0.3, -0.2, 0.35])
    joints = JointTarget(dict(zip(bench.settings.joint_names, target.tolist(), strict=True)))
    wanted = joints if by == "joints" else FeatureTarget(bench.features(target))
    assert bench.reply(bench.goal(wanted)).accepted
    farthest, since = 0.0, len(bench.events)
    while not [e for e in bench.events[since:] if e.kind in ("goal_reached", "goal_aborted", "fault")]:
        bench.step()
        beyond = (bench.q - target) * np.sign(target - start)
        farthest = max(farthest, float(beyond.max()))
    assert bench.events[-1].kind == "goal_reached"
    bench.run(0.5)
    assert farthest < 0.01 * 0.35 or by == "images"
    assert bench.error_px(target) < 2.0 * bench.settings.tolerance_px


def test_trial_motions_are_made_by_late_drives(bench: Any) -> None:
    trials = msgspec.structs.replace(bench.settings.trials, stops=4, frames=1)
    bench.settings = msgspec.structs.replace(bench.settings, trials=trials)
    bench.core = ServoCore(bench.settings)
    bench.ready()
    bench.delay_s = 0.2
    assert bench.reply(Calibrate("00000001")).accepted
    ended = bench.until(lambda e: e.kind in ("calibration_finished", "calibration_aborted", "fault"), 200.0)
    assert ended.kind == "calibration_finished", ended
    delays = bench.core.state.block.delays.delay_s
    np.testing.assert_allclose(delays, 0.2, atol=0.02)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_late_drives_stop_before_the_margin_of_a_limit(bench: Any, side: float) -> None:
    limits = bench.settings.limits
    bound = bench.q[5] + 0.8 * side
    low, high = limits.position_min.copy(), limits.position_max.copy()
    (high if side > 0.0 else low)[5] = bound
    bench.settings = msgspec.structs.replace(
        bench.settings, limits=msgspec.structs.replace(limits, position_min=low, position_max=high)
    )
    bench.core = ServoCore(bench.settings)
    bench.ready()
    bench.delay_s = 0.2
    farthest = -1.0
    for _ in range(300):
        bench.step(Jog({"j6": side}, 0.5))
        farthest = max(farthest, side * (bench.q[5] - bound))
    assert abs(farthest + limits.position_margin) < 1e-3
    for _ in range(150):  # and back
        bench.step(Jog({"j6": -side}, 0.5))
    assert side * (bench.q[5] - bound) < -0.5
