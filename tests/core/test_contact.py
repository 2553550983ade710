"""Contact: what stops the arm, what does not, what is learnt, and how one gets away."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core import monitor
from stereoservo.core.context import Workspace
from stereoservo.core.cycle import ModelUpdate
from stereoservo.core.estimate import workspace
from stereoservo.core.ingest import fill_sample
from stereoservo.core.monitors import collision
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import ContactSettings, CoreSettings
from stereoservo.core.state import CoreState, initial_state
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.kinematics.model import JointLoads
from stereoservo.messages.goals import Calibrate, Enable, Goal, Jog, JointTarget, Resume, RunGoal
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle
from stereoservo.ports.devices import JointState

N = 6
STEP_NS = 4_000_000
GRAVITY = np.array([0.0, 40.0, -25.0, 0.5, 1.5, 0.0])


def stated(samples: int = 5, **limits: dict[int, float]) -> ContactSettings:
    """The watch with thresholds for some joints, by number."""
    efforts, following = np.full(N, np.nan), np.full(N, np.nan)
    for array, given in ((efforts, limits.get("effort", {})), (following, limits.get("following", {}))):
        for joint, value in given.items():
            array[joint] = value
    return ContactSettings(True, efforts, following, 1.5, samples, ("N m",) * N)


def with_contact(settings: CoreSettings, watched: ContactSettings | None) -> CoreSettings:
    return msgspec.structs.replace(settings, contact=watched)


def enabled(settings: CoreSettings) -> CoreState:
    state = initial_state(settings)
    state.lifecycle = Lifecycle.ACTIVE
    return state


def contact(state: CoreState, settings: CoreSettings, room: Workspace, sample: JointState) -> Reason | None:
    """What the watch says of one sample."""
    work = room.numbers
    fill_sample(sample, room.sample)
    work.joints_ns, work.active = sample.t_ns, state.lifecycle is Lifecycle.ACTIVE
    work.tells_efforts, work.tells_following = (
        sample.efforts is not None,
        sample.following_errors is not None,
    )
    moving, beyond = monitor.account_loads(state.block.record, room.record, state.stopped)
    work.contact_watched, work.contact = moving, beyond
    return monitor.explain_contact(state, settings, room)


def fly(
    state: CoreState,
    settings: CoreSettings,
    efforts: np.ndarray | None = None,
    following: np.ndarray | None = None,
    command: float = 0.3,
    gap_ns: int = 0,
    step_ns: int = STEP_NS,
) -> list[tuple[int, Any]]:
    """Feed samples (t, n) to the watch while every joint is commanded to move, the first after a gap; the reasons."""
    room = workspace(settings, None)
    count = len(efforts if efforts is not None else following)  # type: ignore[arg-type]
    found = []
    for k in range(count):
        state.block.command[:] = np.full(N, command)
        sample = JointState(
            k, state.block.numbers.loads_ns + step_ns + (gap_ns if k == 0 else 0), np.zeros(N), np.zeros(N),
            None if efforts is None else efforts[k], None if following is None else following[k],
        )  # fmt: skip
        reason = contact(state, settings, room, sample)
        if reason is not None:
            found.append((k, reason))
    return found


@pytest.fixture
def settings(bench: Any) -> CoreSettings:
    return with_contact(bench.settings, stated(effort={1: 10.0}, following={2: 0.02}))


# -- what is no contact -------------------------------------------------------------------------------------


def test_a_stop_takes_as_many_samples_as_stated_and_not_one_less(bench: Any) -> None:
    for samples in (1, 3, 5):
        settings = with_contact(bench.settings, stated(samples, effort={1: 10.0}))
        for length in (samples - 1, samples):
            efforts = np.tile(GRAVITY, (60, 1))
            for start in (10, 25, 40):
                efforts[start : start + length, 1] += 500.0
            found = fly(enabled(settings), settings, efforts)
            if length < samples:
                assert found == []
            else:
                k, reason = found[0]
                assert k == 10 + samples - 1
                assert (reason.code, reason.subject, reason.level) == ("CONTACT_EFFORT", "j2", "hold")
                assert reason.value == pytest.approx(500.0)
                assert (reason.threshold, reason.unit) == (10.0, "N m")


def test_spikes_of_changing_sign_are_no_contact(settings: CoreSettings) -> None:
    efforts = np.tile(GRAVITY, (100, 1))
    efforts[20:, 1] += 500.0 * (-1.0) ** np.arange(80)
    assert fly(enabled(settings), settings, efforts) == []


def probability_of_a_run(p: float, length: int, samples: int) -> float:
    """That ``length`` outliers of one sign follow one another within ``samples``, each of either sign with p / 2."""
    alive = np.zeros(length)  # by the length of the run that ends here
    alive[0] = 1.0
    for _ in range(samples):
        after = np.zeros(length)
        after[0] = alive.sum() * (1.0 - p)
        if length > 1:
            after[1] = (alive[0] * p) + alive[1:].sum() * 0.5 * p
            after[2:] = alive[1:-1] * 0.5 * p
        alive = after
    return 1.0 - float(alive.sum())


def test_false_alarms_are_as_rare_as_runs_of_outliers(bench: Any) -> None:
    """Independent outliers of probability p alarm exactly where a run of them is long enough."""
    p, length, samples, runs = 0.3, 3, 25, 300
    settings = with_contact(bench.settings, stated(length, effort=dict.fromkeys(range(N), 1.0)))
    rng = np.random.default_rng(4)
    alarms = 0
    for _ in range(runs):
        outliers = rng.choice([-1.0, 0.0, 1.0], size=(samples, N), p=[p / 2, 1.0 - p, p / 2])
        outliers[0] = 0.0  # the first sample is where the mean begins
        alarms += bool(fly(enabled(settings), settings, 50.0 * outliers))
    one = probability_of_a_run(p, length, samples - 1)
    expected = 1.0 - (1.0 - one) ** N
    assert 0.3 < expected < 0.9  # else the test could not fail
    assert alarms == pytest.approx(runs * expected, abs=4.0 * np.sqrt(runs * expected * (1.0 - expected)))


def test_gravity_that_changes_with_the_posture_is_no_contact(settings: CoreSettings) -> None:
    """30 N m/s, four times the threshold within the motion."""
    efforts = np.tile(GRAVITY, (500, 1))
    efforts[:, 1] += 30.0 * 0.004 * np.arange(500)
    assert fly(enabled(settings), settings, efforts) == []


def test_drives_that_take_the_weight_are_no_contact(settings: CoreSettings) -> None:
    state = enabled(settings)
    state.lifecycle = Lifecycle.INACTIVE
    assert fly(state, settings, np.zeros((20, N)), command=0.0) == []
    state.lifecycle = Lifecycle.ACTIVE
    assert fly(state, settings, np.tile(GRAVITY, (100, 1)), command=0.0) == []
    assert fly(state, settings, np.tile(GRAVITY, (100, 1))) == []


def test_a_long_silence_of_the_drives_is_no_contact(settings: CoreSettings) -> None:
    state = enabled(settings)
    fly(state, settings, np.tile(GRAVITY, (20, 1)))
    other = np.tile(GRAVITY + 30.0, (20, 1))
    assert fly(decode_state(encode_state(state)), settings, other, gap_ns=400_000_000) != []
    assert fly(state, settings, other, gap_ns=600_000_000) == []


def test_drives_that_tell_nothing_are_not_watched(settings: CoreSettings) -> None:
    state = enabled(settings)
    sample = JointState(1, 1, np.zeros(N), np.zeros(N))
    assert contact(state, settings, workspace(settings, None), sample) is None
    assert not state.block.numbers.tells_efforts
    assert not state.block.numbers.tells_following
    lags = np.zeros((40, N))
    lags[20:, 2] = np.nan  # one that is not a number says nothing either
    assert fly(state, settings, following=lags) == []


@pytest.mark.parametrize("rate_hz", [100, 1000])
@pytest.mark.parametrize(("command", "constant_s"), [(0.0, monitor.REST_S), (0.3, monitor.MEAN_S)])
def test_the_expected_effort_follows_with_its_time_constant_at_any_rate(
    settings: CoreSettings, command: float, constant_s: float, rate_hz: int
) -> None:
    """What is left of a step after twice the time constant: a lag stepped implicitly is slower than exp(-2), by less
    than exp(dt / T): n ln(1 + dt / T) > n (dt / T - (dt / T)^2 / 2) with n = 2 T / dt.
    """
    state = enabled(settings)
    load = 5.0 * np.eye(N)[1]
    flown = {"command": command, "step_ns": 1_000_000_000 // rate_hz}
    fly(state, settings, np.zeros((20, N)), **flown)
    assert fly(state, settings, np.tile(load, (round(2.0 * constant_s * rate_hz), 1)), **flown) == []
    left = 1.0 - state.block.mean_efforts[1] / load[1]
    assert np.exp(-2.0) < left < np.exp(-2.0 + 1.0 / (constant_s * rate_hz))


# -- what is ------------------------------------------------------------------------------------------------


def test_following_error_stops_with_its_own_reason(settings: CoreSettings) -> None:
    lags = np.zeros((40, N))
    lags[10:, 2] = -0.03
    k, reason = fly(enabled(settings), settings, following=lags)[0]
    assert k == 14
    assert (reason.code, reason.subject, reason.unit) == ("CONTACT_FOLLOWING", "j3", "rad")
    assert (reason.value, reason.threshold) == (pytest.approx(0.03), 0.02)
    assert "joint j3 is 0.03 rad from its set-point, 0.02 is allowed" in reason.hint


def test_the_joint_farthest_beyond_its_threshold_is_named(bench: Any) -> None:
    settings = with_contact(bench.settings, stated(effort={1: 10.0, 4: 1.0}))
    efforts = np.tile(GRAVITY, (30, 1))
    efforts[10:] += np.array([900.0, 30.0, 900.0, 0.0, 5.0, 0.0])  # 3 times, 5 times; the others have no threshold
    assert fly(enabled(settings), settings, efforts)[0][1].subject == "j5"


def test_after_a_contact_its_load_may_go_and_may_not_grow(settings: CoreSettings) -> None:
    state = enabled(settings)
    fly(state, settings, np.tile(GRAVITY, (50, 1)))
    pressed = GRAVITY + 40.0 * np.eye(N)[1]
    assert len(fly(state, settings, np.tile(pressed, (5, 1)))) == 1
    state.stopped = True
    assert fly(state, settings, np.tile(pressed, (500, 1)), command=0.0) == []
    state.stopped = False
    harder = decode_state(encode_state(state))
    relieved = pressed + (GRAVITY - pressed) * np.linspace(0.0, 1.0, 20)[:, None]
    assert fly(state, settings, np.concatenate([relieved, np.tile(GRAVITY, (500, 1))])) == []
    assert len(fly(harder, settings, np.tile(pressed + 15.0 * np.eye(N)[1], (5, 1)))) == 1


def test_what_comes_while_the_arm_brakes_belongs_to_the_contact(settings: CoreSettings) -> None:
    state = enabled(settings)
    fly(state, settings, np.tile(GRAVITY, (50, 1)))
    pressed, braked = GRAVITY + 40.0 * np.eye(N)[1], GRAVITY + 80.0 * np.eye(N)[1]
    assert len(fly(state, settings, np.tile(pressed, (5, 1)))) == 1
    state.stopped = True
    assert fly(state, settings, np.tile(braked, (5, 1))) == []
    assert fly(state, settings, np.tile(pressed, (500, 1)), command=0.0) == []
    state.stopped = False
    harder = decode_state(encode_state(state))
    assert fly(state, settings, np.tile(braked, (50, 1))) == []
    assert len(fly(harder, settings, np.tile(braked + 15.0 * np.eye(N)[1], (5, 1)))) == 1


def test_what_a_contact_brought_is_a_contact_again_once_the_drives_were_off(settings: CoreSettings) -> None:
    state = enabled(settings)
    pressed = GRAVITY + 40.0 * np.eye(N)[1]
    fly(state, settings, np.tile(GRAVITY, (50, 1)))
    assert len(fly(state, settings, np.tile(pressed, (5, 1)))) == 1
    state.lifecycle = Lifecycle.INACTIVE
    fly(state, settings, np.tile(GRAVITY, (20, 1)), command=0.0)
    state.lifecycle = Lifecycle.ACTIVE
    assert fly(state, settings, np.tile(GRAVITY, (20, 1))) == []
    assert len(fly(state, settings, np.tile(pressed, (5, 1)))) == 1


def test_a_following_error_that_stays_after_the_time_to_leave_is_a_contact_again(
    settings: CoreSettings,
) -> None:
    state = enabled(settings)
    fly(state, settings, following=np.zeros((20, N)))
    lags = np.tile(0.03 * np.eye(N)[2], (400, 1))
    assert [k for k, _ in fly(state, settings, following=lags[:5])] == [4]
    again = [k for k, _ in fly(state, settings, following=lags)]
    assert again[0] * STEP_NS * 1e-9 == pytest.approx(monitor.LEAVE_S, abs=0.03)


# -- thresholds ---------------------------------------------------------------------------------------------

LOADS = JointLoads(
    velocities=np.array([0.5, 0.5, 0.5, 2.0, 0.5, 0.5]),
    efforts=np.diag([4.0, 8.0, 2.0, 1.0, 1.0, 0.0]) + 1.0 * np.eye(N, k=1),
    largest_efforts=np.array([4.0, 50.0, 20.0, 1.0, 1.0, 0.0]),
    following_errors=np.array([0.01, 0.01, 0.02, 0.01, 0.01, 0.0]),
)


def test_learnt_thresholds_by_hand(bench: Any) -> None:
    """Limits of 1 rad/s: joints tried at 0.5 count double. 1.5 times the sum over the movers, and 1 % of 50 N m."""
    settings = with_contact(bench.settings, stated())
    efforts, following = collision.collision_thresholds(settings, LOADS)
    assert efforts == pytest.approx(
        [
            1.5 * (8 + 2) + 0.5,
            1.5 * (16 + 2) + 0.5,
            1.5 * (4 + 1) + 0.5,
            1.5 * (1 + 2) + 0.5,
            1.5 * (2 + 2) + 0.5,
            0.5,
        ]
    )
    cycle = 1.0 / settings.rate_hz
    assert following == pytest.approx(np.array([0.03, 0.03, 0.06, 0.015, 0.03, 0.0]) + cycle)


def test_floors_are_among_joints_of_one_unit(bench: Any) -> None:
    units = ("N m", "N m", "N m", "of rated", "of rated", "of rated")
    loads = JointLoads(np.full(N, 1.0), np.zeros((N, N)), np.array([4.0, 50.0, 20.0, 0.3, 0.2, 0.0]))
    watched = msgspec.structs.replace(stated(), effort_units=units)
    efforts, _ = collision.collision_thresholds(with_contact(bench.settings, watched), loads)
    assert efforts == pytest.approx([0.5, 0.5, 0.5, 0.003, 0.003, 0.003])


def test_stated_thresholds_come_before_learnt_ones(bench: Any) -> None:
    settings = with_contact(bench.settings, stated(effort={0: 3.0}, following={5: 0.5}))
    efforts, following = collision.collision_thresholds(settings, LOADS)
    learnt = collision.collision_thresholds(with_contact(bench.settings, stated()), LOADS)
    assert efforts[0] == 3.0
    assert following[5] == 0.5
    np.testing.assert_array_equal(efforts[1:], learnt[0][1:])
    np.testing.assert_array_equal(following[:5], learnt[1][:5])


@pytest.mark.parametrize(
    "loads",
    [
        None,
        JointLoads(np.ones(N)),
        JointLoads(np.ones(N), np.zeros((N, N)), np.zeros(N), np.zeros(N)),  # drives that say 0 measure nothing
    ],
)
def test_nothing_learnt_is_no_threshold(bench: Any, loads: JointLoads | None) -> None:
    settings = with_contact(bench.settings, stated())
    efforts, following = collision.collision_thresholds(settings, loads)
    assert np.isinf(efforts).all()
    assert np.isinf(following).all()


def test_switched_off_means_off(bench: Any) -> None:
    off = msgspec.structs.replace(stated(effort={1: 10.0}), enabled=False)
    assert collision.collision_thresholds(with_contact(bench.settings, off), LOADS) is None
    assert collision.collision_thresholds(with_contact(bench.settings, None), LOADS) is None


@pytest.mark.parametrize("speed", [0.1, 3.0])
def test_efforts_are_learnt_where_one_joint_moves_alone(bench: Any, speed: float) -> None:
    """Alone: the others' speeds are at most ``ALONE`` of the fastest's."""
    for share, learnt in ((0.8, 2.0), (1.2, 0.0)):
        state = initial_state(bench.settings)
        state.block.effort_excess[:] = -2.0
        speeds = speed * np.array([0.0, share * collision.ALONE, 0.0, 1.0, 0.0, 0.0])
        collision.learn_loads("trials", state, speeds, GRAVITY, np.zeros(N))
        assert state.loads is not None
        np.testing.assert_array_equal(state.loads.efforts, learnt * np.tile(np.eye(N)[3], (N, 1)))
        np.testing.assert_array_equal(state.loads.velocities, speeds)
        np.testing.assert_array_equal(state.loads.largest_efforts, np.abs(GRAVITY))


@pytest.mark.parametrize(("former", "now"), [("1", "2"), ("2", "1")])
def test_loads_of_other_trials_are_not_these_trials_loads(bench: Any, former: str, now: str) -> None:
    state = initial_state(bench.settings)
    state.block.numbers.tells_efforts = 1
    collision.learn_loads(former, state, np.full(N, 0.9), 10.0 * GRAVITY, np.zeros(N))
    assert collision.learnt_loads(former, state) is not None
    assert collision.learnt_loads(now, state) is None
    collision.learn_loads(now, state, np.full(N, 0.5), GRAVITY, np.zeros(N))
    loads = collision.learnt_loads(now, state)
    assert loads is not None
    assert loads.velocities == pytest.approx(0.5)
    assert loads.largest_efforts == pytest.approx(np.abs(GRAVITY))


# -- in the core --------------------------------------------------------------------------------------------


def watched(bench: Any, settings: ContactSettings) -> Any:
    bench.settings = with_contact(bench.settings, settings)
    bench.core = ServoCore(bench.settings)
    return bench


def arm(wall: float = np.inf) -> Any:
    """An arm with weight and inertia whose second joint presses against something above ``wall`` [rad]."""
    last = np.zeros(N)

    def loads(bench: Any) -> tuple[np.ndarray, np.ndarray]:
        command = bench.commands[-1] if bench.commands else np.zeros(N)
        acceleration = (command - last) * bench.settings.rate_hz
        last[:] = command
        lag = 0.01 * command
        efforts = GRAVITY * np.cos(bench.q) + 1.5 * acceleration + 0.2 * acceleration.sum()
        if bench.q[1] > wall:
            efforts[1] += 1000.0 * (bench.q[1] - wall)
            lag[1] += 0.2 * (bench.q[1] - wall)
        return efforts, lag

    return loads


def goal(q: np.ndarray) -> RunGoal:
    names = [f"j{k + 1}" for k in range(N)]
    return RunGoal(Goal("0000000a", JointTarget(dict(zip(names, q.tolist(), strict=True)))))


def into_the_wall(bench: Any) -> Any:
    """A joint goal into a wall half-way; the event that ends it."""
    watched(bench, stated(3, effort={1: 12.0}))
    bench.loads = arm(wall=float(bench.q[1]) + 0.2)
    bench.ready()
    bench.step(goal(bench.q + 0.4 * np.eye(N)[1]))
    return bench.until(lambda e: e.kind == "goal_aborted", 5.0)


def test_contact_ends_the_goal_and_the_arm_stands_with_its_drives_on(bench: Any) -> None:
    event = into_the_wall(bench)
    reason = event.reasons[0]
    assert (reason.code, reason.subject, reason.threshold) == ("CONTACT_EFFORT", "j2", 12.0)
    assert reason.value > 12.0
    assert bench.events[-1].kind == "stopped"
    outputs = bench.run(1.0)
    assert not outputs.command.any()  # written: power stays on
    assert outputs.status.lifecycle == "active"
    assert [r.code for r in outputs.status.reasons][-2:] == ["CONTACT_EFFORT", "STOPPED"]
    assert outputs.status.level == "hold"
    assert outputs.status.effort_limits[1] == 12.0
    assert outputs.status.efforts is not None
    assert len([e for e in bench.events if e.kind in ("stopped", "goal_aborted")]) == 2  # told once
    refusal = bench.reply(Jog({"j2": -0.2}, 1.0))
    assert (refusal.accepted, refusal.reasons[0].code) == (False, "STOPPED")


def test_the_way_out_is_open_and_the_way_in_is_not(bench: Any) -> None:
    into_the_wall(bench)
    bench.run(0.5)
    assert bench.reply(Resume()).accepted
    at = float(bench.q[1])
    assert bench.reply(Jog({"j2": -0.2}, 0.9)).accepted
    outputs = bench.run(1.0)
    assert bench.q[1] < at - 0.1
    assert "CONTACT_EFFORT" not in [r.code for r in outputs.status.reasons]
    assert bench.reply(Jog({"j2": 0.4}, 1.0)).accepted
    bench.until(lambda e: e.kind == "stopped", 3.0)


def test_a_contact_replays_bit_for_bit_from_a_copy_of_the_state(bench: Any) -> None:
    watched(bench, stated(3, effort={1: 12.0}))
    bench.loads = arm(wall=float(bench.q[1]) + 0.2)
    bench.ready()
    bench.step(goal(bench.q + 0.4 * np.eye(N)[1]))
    bench.run(0.3)
    copy = ServoCore(bench.settings, decode_state(encode_state(bench.core.state)))
    first = len(bench.log)
    bench.until(lambda e: e.kind == "stopped", 5.0)
    for inputs, outputs in bench.log[first:]:
        again = copy.step(inputs)
        np.testing.assert_array_equal(again.command, outputs.command)
        assert [e.reasons for e in again.events] == [e.reasons for e in outputs.events]
    assert encode_state(copy.state) == encode_state(bench.core.state)


def test_trial_motions_teach_thresholds_that_bear_a_goal_and_not_a_wall(bench: Any) -> None:
    watched(bench, stated(3))
    bench.loads = arm()
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate("00000011"))
    event = bench.until(lambda e: e.kind == "calibration_finished", 120.0)
    loads = event.loads
    assert loads is not None
    assert np.all(loads.velocities > 0.4)
    # The arm's inertia: 1.7 of the joint's own acceleration, 0.2 of another's; 4 rad/s^2, worn by the mean.
    own = np.diag(loads.efforts)
    others = loads.efforts[~np.eye(N, dtype=bool)]
    assert np.all((own > 3.0) & (own < 1.7 * 4.0 * 1.5))
    assert np.all((others > 0.3) & (others < 0.3 * own.min()))
    assert loads.following_errors == pytest.approx(0.01 * loads.velocities, rel=0.1)

    bench.step(model_update=ModelUpdate(msgspec.structs.replace(bench.truth.model, loads=loads)))
    bench.run(0.1)
    assert np.isfinite(bench.run(0.1).status.effort_limits).all()
    assert bench.reply(goal(bench.q + np.array([0.5, -0.4, 0.3, 0.6, -0.5, 0.7]))).accepted
    assert bench.until(lambda e: e.id == "0000000a" and e.kind != "goal_started", 20.0).kind == "goal_reached"

    bench.loads = arm(wall=float(bench.q[1]) + 0.1)
    assert bench.reply(Jog({"j2": 0.5}, 1.0)).accepted
    stopped = bench.until(lambda e: e.kind == "stopped", 2.0)
    assert stopped.reasons[0].subject == "j2"


def test_trial_motions_without_loads_teach_none(bench: Any) -> None:
    watched(bench, stated())
    bench.run(0.1)
    bench.step(Enable())
    bench.reply(Calibrate("00000011"))
    event = bench.until(lambda e: e.kind == "calibration_finished", 120.0)
    assert event.loads is None


def test_while_thresholds_are_learnt_only_stated_ones_stop(bench: Any) -> None:
    """An arm that carries more now can be calibrated again; a stated threshold holds in trial motions, too."""
    tight = JointLoads(np.ones(N), 1e-3 * np.eye(N), np.ones(N), np.full(N, 1e-6))
    bench.truth.model = msgspec.structs.replace(bench.truth.model, loads=tight)
    watched(bench, stated(3))
    bench.loads = arm()
    bench.ready()
    bench.reply(Calibrate("00000011"))
    bench.until(lambda e: e.kind == "calibration_finished", 120.0)
    bench.core = ServoCore(with_contact(bench.settings, stated(3, following={0: 1e-3})), bench.core.state)
    bench.reply(Calibrate("00000012"))
    event = bench.until(lambda e: e.kind == "calibration_aborted", 120.0)
    assert (event.reasons[0].code, event.reasons[0].subject) == ("CONTACT_FOLLOWING", "j1")


def test_a_dry_run_is_not_watched(bench: Any) -> None:
    bench.settings = msgspec.structs.replace(bench.settings, watch_following=False)
    watched(bench, stated(3, effort={1: 12.0}))
    bench.loads = arm(wall=float(bench.q[1]) + 0.1)
    bench.ready()
    bench.step(goal(bench.q + 0.2 * np.eye(N)[1]))
    event = bench.until(lambda e: e.kind.startswith("goal_") and e.kind != "goal_started", 10.0)
    assert event.kind == "goal_reached"
    assert bench.run(0.1).status.effort_limits is None
