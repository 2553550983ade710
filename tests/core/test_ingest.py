"""Stamps that cannot be right and a loop that stood still: refused, told, stopped, and nothing of them kept."""

from __future__ import annotations

import re
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import ModelUpdate, StepInputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.messages.goals import (
    Calibrate,
    Enable,
    Feature,
    FeatureTarget,
    Goal,
    IncidenceSpec,
    IncidenceTarget,
    Jog,
    JointTarget,
    Resume,
    RunGoal,
)
from stereoservo.ports.devices import CameraObservation, JointState

HOUR_NS = 3_600_000_000_000
DISPLACED = np.array([0.25, -0.2, 0.15, 0.4, -0.3, 0.5])
JOINT = "j4"
TIMEOUT_S = 0.1  # of the bench's joints
COAST_S = 0.5
WATCHDOG_S = 0.1  # of the bench's drives
GAPS_S = (0.005, 0.011, 0.02, 0.05, 0.099, 0.101, 0.15, 0.3, 0.6, 1.0, 3.0, 10.0)


def codes(outputs: Any) -> list[str]:
    return [reason.code for reason in outputs.status.reasons]


def step_of(bench: Any) -> np.ndarray:
    """Change of a command that the acceleration limit allows in one period (6,)."""
    return bench.settings.limits.acceleration_max / bench.settings.rate_hz * (1.0 + 1e-9)


def jogging(bench: Any, lease_s: float = 60.0) -> Any:
    """The bench at full speed of one joint."""
    bench.ready()
    assert bench.reply(Jog({JOINT: 1.0}, lease_s)).accepted
    assert bench.run(0.4).command[3] == pytest.approx(1.0)
    return bench


def servoing(bench: Any) -> Any:
    bench.ready()
    target = FeatureTarget(bench.features(bench.q + DISPLACED))
    assert bench.reply(RunGoal(Goal("0000abcd", target, law="cartesian3"))).accepted
    assert np.abs(bench.run(0.4).command).max() > 0.1
    return bench


def next_inputs(bench: Any) -> Any:
    """What the bench's next step would get, before it is corrupted."""
    bench.now_ns += 10_000_000
    bench.seq += 1
    joints = JointState(bench.seq, bench.now_ns, bench.q.copy(), np.zeros(6))
    return StepInputs(bench.now_ns, 10_000_000, joints, driver_active=True)


def kept(bench: Any) -> tuple[Any, ...]:
    """All that the core remembers of joint samples."""
    state = bench.core.state
    return (
        state.history.count, state.history.t_ns.tobytes(), state.history.positions.tobytes(),
        state.block.velocities.tobytes(), state.block.numbers.last_joints_ns, state.block.numbers.last_joints_seq,
        state.block.numbers.loads_ns,
    )  # fmt: skip


def kept_of_cameras(bench: Any) -> tuple[Any, ...]:
    return tuple(
        (e.last_seq, e.seen_ns.tobytes(), e.accepted_ns, e.frames, e.innovation.tobytes())
        for e in bench.core.state.cameras
    )


# -- values -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("positions", np.nan, "position of joint j4 is nan"),
        ("positions", np.inf, "position of joint j4 is inf"),
        ("positions", 1e9, "position of joint j4 is 1e+09"),
        ("velocities", np.nan, "velocity of joint j4 is nan"),
        ("efforts", np.nan, "effort of joint j4 is nan"),
        ("following_errors", np.inf, "following error of joint j4 is inf"),
    ],
)
def test_a_joint_sample_with_an_impossible_value_stops_the_arm_and_is_not_kept(
    bench: Any, field: str, value: float, told: str
) -> None:
    jogging(bench)
    before = kept(bench)
    values = bench.q.copy() if field == "positions" else np.zeros(6)
    values[3] = value
    inputs = next_inputs(bench)
    sample = msgspec.structs.replace(inputs.joints, **{field: values})
    outputs = bench.core.step(msgspec.structs.replace(inputs, joints=sample))
    assert kept(bench) == before
    (reason,) = [r for r in outputs.status.reasons if r.code == "JOINT_VALUE"]
    assert told in reason.hint
    assert bench.run(0.5).command.tobytes() == np.zeros(6).tobytes()
    assert np.isfinite(bench.core.state.block.velocities).all()
    assert bench.reply(Resume()).accepted
    assert bench.reply(Jog({JOINT: -1.0}, 60.0)).accepted
    assert bench.run(0.4).command[3] == pytest.approx(-1.0)


def test_a_sample_of_a_wrong_length_is_refused(bench: Any) -> None:
    jogging(bench)
    inputs = next_inputs(bench)
    sample = msgspec.structs.replace(inputs.joints, positions=np.zeros(5))
    outputs = bench.core.step(msgspec.structs.replace(inputs, joints=sample))
    (reason,) = [r for r in outputs.status.reasons if r.code == "JOINT_VALUE"]
    assert "shape (5,), the cell has 6 joints" in reason.hint


def test_a_joint_that_jumps_while_the_drives_are_on_stops_the_arm(bench: Any) -> None:
    jogging(bench)
    bench.zero_offset[2] = 0.3
    (reason,) = [r for r in bench.step().status.reasons if r.code == "JOINT_JUMP"]
    assert (reason.subject, reason.value) == ("j3", pytest.approx(0.3, abs=0.02))
    assert reason.threshold == pytest.approx(0.07)
    rest = bench.run(0.5).command  # None: the drives are off, for the joint is elsewhere than it was sent
    assert rest is None or not rest.any()


def test_an_encoder_that_is_set_while_the_drives_are_off_begins_a_new_history(bench: Any) -> None:
    bench.run(0.5)
    bench.zero_offset[2] = 1.5
    outputs = bench.step()
    assert bench.core.state.history.count == 1
    assert not bench.core.state.block.velocities.any()
    assert "JOINT_JUMP" not in codes(outputs)


@pytest.mark.parametrize("number", [2**62, 2**31])
def test_a_frame_with_a_wild_number_blinds_no_camera(bench: Any, number: int) -> None:
    servoing(bench)
    while not bench.pending or bench.pending[0].t_received_ns > bench.now_ns + 10_000_000:
        bench.step()
    bench.pending[0] = msgspec.structs.replace(bench.pending[0], seq=number)
    bench.step()
    frames = [estimate.frames for estimate in bench.core.state.cameras]
    bench.run(0.4)
    assert all(e.frames >= before + 9 for e, before in zip(bench.core.state.cameras, frames, strict=True))
    assert bench.ended().kind == "goal_reached"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"pixels": np.full((8, 2), np.nan)}, "marker 0 is at [nan, nan] in an image of 640x480"),
        ({"pixels": np.full((8, 2), 1e5)}, "marker 0 is at [100000.0, 100000.0]"),
        ({"covariances": np.zeros((8, 2, 2))}, "marker 0 has the covariance"),
        ({"pixels": np.zeros((7, 2))}, "8 markers have pixels (7, 2)"),
        ({"ids": np.arange(300)}, "300 markers, 256 are allowed"),
    ],
)
def test_a_frame_that_cannot_be_stops_what_works_by_images(bench: Any, change: dict[str, Any], told: str) -> None:
    servoing(bench)
    while not bench.pending or bench.pending[0].t_received_ns > bench.now_ns + 10_000_000:
        bench.step()
    assert len(bench.pending[0].ids) == 8
    bench.pending[0] = msgspec.structs.replace(bench.pending[0], **change)
    (reason,) = [r for r in bench.step().status.reasons if r.code == "CAMERA_VALUE"]
    assert told in reason.hint
    assert bench.core.state.stopped


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda m: {"marker_points": m.marker_points * np.nan},
            "marker points with numbers that are not finite",
        ),
        (
            lambda m: {"generators": m.generators[:5]},
            r"generators of shape \(5, 4, 4\), \(6, 4, 4\) is needed",
        ),
        (lambda m: {"projective_to_euclidean": np.full((4, 4), np.inf)}, "Euclidean frame with numbers"),
        (
            lambda m: {"cameras": tuple(msgspec.structs.replace(c, lens=np.zeros(3)) for c in m.cameras)},
            "a lens of",
        ),
    ],
)
def test_a_model_that_cannot_be_is_refused(bench: Any, change: Any, told: str) -> None:
    bench.ready()
    model = bench.core.state.model
    outputs = bench.step(model_update=ModelUpdate(msgspec.structs.replace(model, **change(model))))
    assert re.search(told, outputs.events[0].message)
    assert bench.core.state.model is model


# -- joints -------------------------------------------------------------------------------------------------


def test_a_jog_never_passes_its_limit_after_one_sample_of_the_future(bench: Any) -> None:
    jogging(bench)
    bench.joints_stamped_late_ns = HOUR_NS
    bench.step()
    bench.joints_stamped_late_ns = 0
    for _ in range(700):
        bench.step()
        assert bench.q[3] < bench.settings.limits.position_max[3]
    assert np.abs(bench.log[-1][1].command).max() == 0.0


@pytest.mark.parametrize(
    ("late_ns", "threshold"), [(1, 0.0), (20_000_000, 0.0), (HOUR_NS, 0.0), (-120_000_000, TIMEOUT_S)]
)
def test_a_joint_stamp_outside_the_window_stops_the_arm_and_nothing_of_it_is_kept(
    bench: Any, late_ns: int, threshold: float
) -> None:
    servoing(bench)
    if late_ns < 0:  # newer than what is known, and too old all the same
        bench.joints_on = False
        bench.run(0.18)
    before = kept(bench)
    bench.joints_on, bench.joints_stamped_late_ns = True, late_ns
    outputs = bench.step()
    assert kept(bench) == before
    aborted = next(e for e in bench.events if e.kind == "goal_aborted")
    (reason,) = aborted.reasons
    assert (reason.code, reason.level, reason.unit) == ("JOINT_STAMP", "hold", "s")
    assert reason.value == pytest.approx(-late_ns * 1e-9)
    assert reason.threshold == threshold
    assert "resume" in reason.hint
    assert codes(outputs)[-2:] == ["JOINT_STAMP", "STOPPED"]
    bench.joints_stamped_late_ns = 0
    outputs = bench.run(1.0)
    assert np.abs(outputs.command).max() == 0.0
    assert codes(outputs)[-2:] == ["JOINT_STAMP", "STOPPED"]  # latched, and still told
    assert [e.kind for e in bench.events].count("stopped") == 1
    assert not bench.reply(Jog({JOINT: 0.2}, 0.5)).accepted
    assert bench.reply(Resume()).accepted
    assert bench.reply(Jog({JOINT: 0.2}, 0.5)).accepted
    outputs = bench.run(0.2)
    assert outputs.command[3] == pytest.approx(0.2)
    assert "JOINT_STAMP" not in codes(outputs)


def test_an_old_sample_that_is_told_again_and_again_is_silence(bench: Any) -> None:
    servoing(bench)
    before = kept(bench)
    bench.joints_stamped_late_ns = -HOUR_NS
    outputs = bench.run(0.3)
    assert kept(bench) == before
    assert "JOINTS_STALE" in codes(outputs)
    assert not {"JOINT_STAMP", "STOPPED"} & set(codes(outputs))
    assert np.abs(bench.run(0.5).command).max() == 0.0


def test_a_clock_that_stays_wrong_never_lets_the_arm_move(bench: Any) -> None:
    servoing(bench)
    bench.joints_stamped_late_ns = HOUR_NS
    bench.run(0.5)
    for _ in range(5):
        bench.step(Resume())
        bench.step(Jog({JOINT: 1.0}, 5.0))
        assert np.abs(bench.run(0.1).command).max() == 0.0
    assert {"JOINT_STAMP", "JOINTS_STALE", "STOPPED"} <= set(codes(bench.log[-1][1]))


def test_a_wrong_stamp_before_the_drives_are_on_is_told_and_stops_nothing(bench: Any) -> None:
    bench.joints_stamped_late_ns = HOUR_NS
    outputs = bench.run(0.1)
    assert codes(outputs)[-1] == "JOINT_STAMP"
    assert bench.core.state.history.count == 0
    bench.joints_stamped_late_ns = 0
    bench.ready()
    assert "JOINT_STAMP" not in codes(bench.log[-1][1])
    assert bench.reply(Jog({JOINT: 0.2}, 0.5)).accepted


def test_a_sample_at_either_end_of_its_window_is_used(bench: Any) -> None:
    jogging(bench)
    bench.joints_on = False
    bench.run(0.05)
    bench.joints_on, bench.joints_stamped_late_ns = True, -round(0.05e9)
    count = bench.core.state.history.count
    assert "JOINT_STAMP" not in codes(bench.step())
    assert bench.core.state.history.count == count + 1
    bench.joints_stamped_late_ns = 0
    assert "JOINT_STAMP" not in codes(bench.step())
    assert bench.core.state.history.count == count + 2


# -- cameras ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["law", "calibration"])
def test_a_frame_of_the_future_stops_what_works_by_images_and_is_not_kept(bench: Any, source: str) -> None:
    if source == "law":
        servoing(bench)
    else:
        bench.ready()
        assert bench.reply(Calibrate("00000011")).accepted
        bench.run(0.5)
    bench.run(0.1)
    while not bench.pending:
        bench.step()
    bench.pending = [msgspec.structs.replace(o, t_shutter_ns=o.t_shutter_ns + HOUR_NS) for o in bench.pending]
    before = kept_of_cameras(bench)
    bench.cameras_on[:] = [False, False]
    event = bench.until(lambda e: e.kind in ("goal_aborted", "calibration_aborted"), 0.5)
    assert kept_of_cameras(bench) == before
    (reason,) = event.reasons
    assert (reason.code, reason.subject, reason.threshold) == ("CAMERA_STAMP", "left", 0.0)
    assert reason.value == pytest.approx(-3599.98, abs=0.02)
    bench.cameras_on[:] = [True, True]
    outputs = bench.run(1.0)
    assert np.abs(outputs.command).max() == 0.0
    assert codes(outputs)[-2:] == ["CAMERA_STAMP", "STOPPED"]
    assert bench.reply(Resume()).accepted
    assert bench.reply(RunGoal(Goal("0000abce", FeatureTarget(bench.features(bench.q + 0.3 * DISPLACED))))).accepted
    assert bench.until(lambda e: e.kind == "goal_reached", 25.0)
    assert "CAMERA_STAMP" not in codes(bench.log[-1][1])


@pytest.mark.parametrize("code", ["CAMERA_STAMP", "CAMERA_VALUE"])
@pytest.mark.parametrize("source", ["incidence", "check", "joints"])
def test_a_wrong_frame_stops_incidences_and_checks_and_is_only_told_to_a_joint_goal(
    bench: Any, source: str, code: str
) -> None:
    bench.q = bench.q + 0.1
    bench.ready()
    goal_q = bench.q + DISPLACED
    if source == "incidence":
        point = tuple(bench.projective(bench.truth.points(goal_q))[4].tolist())
        spec = IncidenceSpec("point-on-point", Feature(markers=(4,)), Feature(points=(point,)))
        assert bench.reply(bench.goal(IncidenceTarget((spec,), model_epoch=7))).accepted
    elif source == "check":
        assert bench.reply(Calibrate("00000012", check=True)).accepted
    else:
        joints = dict(zip(bench.settings.joint_names, goal_q.tolist(), strict=True))
        assert bench.reply(bench.goal(JointTarget(joints))).accepted
    speed = np.abs(bench.run(0.2).command).max()
    assert speed > 0.02
    moving = bench.core.state.source
    while not bench.pending or bench.pending[0].t_received_ns > bench.now_ns + 10_000_000:
        bench.step()
    wrong: dict[str, Any] = {"pixels": np.full((8, 2), np.nan)}
    if code == "CAMERA_STAMP":
        wrong = {"t_shutter_ns": bench.pending[0].t_shutter_ns + HOUR_NS}
    bench.pending[0] = msgspec.structs.replace(bench.pending[0], **wrong)
    outputs = bench.step()
    assert code in codes(outputs)
    if source == "joints":
        assert bench.core.state.source is moving
        assert not bench.core.state.stopped
        assert bench.ended().kind == "goal_reached"
        return
    (end,) = (e for e in outputs.events if e.kind in ("goal_aborted", "calibration_aborted"))
    assert end.reasons[0].code == code
    outputs = bench.run(1.0)  # the frames are good again
    assert np.abs(outputs.command).max() == 0.0
    assert codes(outputs)[-2:] == [code, "STOPPED"]


@pytest.mark.parametrize(("slowest_hz", "bound_s"), [(25.0, 0.15), (10.0, 0.25)])
def test_a_law_coasts_for_two_and_a_half_frames_and_015_s_even_where_the_cell_allows_none(
    benches: Any, slowest_hz: float, bound_s: float
) -> None:
    bench = benches(0)
    left, right = bench.settings.cameras
    bench.settings = msgspec.structs.replace(
        bench.settings,
        limits=msgspec.structs.replace(bench.settings.limits, coast_s=0.0),
        cameras=(left, msgspec.structs.replace(right, rate_hz=slowest_hz)),
    )
    bench.core = ServoCore(bench.settings)
    servoing(bench)
    bench.cameras_on[:] = [False, False]
    bench.run(0.04)
    shutter_ns = max(estimate.accepted_ns for estimate in bench.core.state.cameras)
    assert bench.now_ns - shutter_ns < 0.1e9
    while "FEATURES_STALE" not in codes(bench.step()):
        assert bench.now_ns - shutter_ns <= bound_s * 1e9
    assert bound_s * 1e9 <= bench.now_ns - shutter_ns <= bound_s * 1e9 + 10_000_000
    assert np.abs(bench.run(0.5).command).max() == 0.0
    for late_s, counted in ((bound_s - 0.01, 0), (bound_s + 0.01, 1)):  # how late a frame may come
        seen = CameraObservation(
            "left", bench.seq + 1000, bench.now_ns + 10_000_000 - round(late_s * 1e9), bench.now_ns, np.arange(8),
            bench.truth.pixels(bench.q)[0], np.tile(1e-4 * np.eye(2), (8, 1, 1)),
        )  # fmt: skip
        bench.pending = [seen]
        assert ("CAMERA_LATE" in codes(bench.step())) == bool(counted)
        assert bench.core.state.refused_frames[0].count == counted


def test_frames_of_the_future_are_told_and_stop_no_jog(bench: Any) -> None:
    jogging(bench)
    bench.stamped_late_ns = HOUR_NS
    outputs = bench.run(0.3)
    assert outputs.command[3] == pytest.approx(1.0)
    told = [(r.code, r.subject) for r in outputs.status.reasons]
    assert {("CAMERA_STAMP", "left"), ("CAMERA_STAMP", "right")} <= set(told)
    target = FeatureTarget(bench.features(bench.q))
    bench.step(Jog({}, 0.01))
    bench.run(1.5)
    bench.reply(RunGoal(Goal("0000abcf", target, law="cartesian3")))
    assert np.abs(bench.run(0.5).command).max() == 0.0


def test_frames_that_come_too_late_are_counted_and_the_law_coasts_on_the_others(bench: Any) -> None:
    servoing(bench)
    late = round((COAST_S + 0.2) * 1e9)

    def delay_right() -> None:
        bench.pending = [
            msgspec.structs.replace(o, t_shutter_ns=min(o.t_shutter_ns, bench.now_ns - late))
            if o.camera == "right" else o
            for o in bench.pending
        ]  # fmt: skip

    for _ in range(100):
        outputs = bench.step()
        delay_right()
    (reason,) = (r for r in outputs.status.reasons if r.code == "CAMERA_LATE")
    assert (reason.subject, reason.level, reason.threshold) == ("right", "info", COAST_S)
    assert COAST_S < reason.value <= COAST_S + 0.25
    assert bench.core.state.refused_frames[1].count >= 20
    assert bench.core.state.refused_frames[0].count == 0
    assert not bench.core.state.stopped
    assert bench.until(lambda e: e.kind in ("goal_reached", "goal_aborted"), 25.0).kind == "goal_reached"
    assert "CAMERA_LATE" not in codes(bench.run(0.2))


# -- gaps of the loop ---------------------------------------------------------------------------------------


def after_a_gap(bench: Any, gap_s: float, *commands: Any, **inputs: Any) -> Any:
    bench.now_ns += round(gap_s * 1e9) - round(1e9 / bench.settings.rate_hz)
    return bench.step(*commands, **inputs)


@pytest.mark.parametrize("measured", [False, True], ids=["nominal period", "measured period"])
@pytest.mark.parametrize("gap_s", GAPS_S)
@pytest.mark.parametrize("rest", [False, True], ids=["moving", "from rest"])
def test_first_command_after_a_gap_is_one_acceleration_step_from_what_the_drives_do(
    bench: Any, gap_s: float, rest: bool, measured: bool
) -> None:
    """Drives whose command stays out for ``WATCHDOG_S`` come to rest by themselves; until then they do the last one."""
    jogging(bench)
    if rest:  # the gap begins when the arm does
        bench.step(Jog({JOINT: 0.0}, 60.0))
        bench.run(0.5)
        bench.step(Jog({JOINT: 1.0}, 60.0))
    previous = bench.log[-1][1].command
    inputs = {"period_ns": round(gap_s * 1e9)} if measured else {}
    outputs = after_a_gap(bench, gap_s, **inputs)
    stopped = gap_s > WATCHDOG_S
    start = np.zeros(6) if stopped else previous
    assert np.all(np.abs(outputs.command - start) <= step_of(bench))
    assert bench.core.state.stopped == stopped
    if stopped:
        assert codes(outputs)[-2:] == ["LOOP_GAP", "STOPPED"]
        reason = outputs.status.reasons[-2]
        assert (reason.value, reason.threshold) == (pytest.approx(gap_s), WATCHDOG_S)
        assert np.abs(bench.run(0.5).command).max() == 0.0
        assert bench.reply(Resume()).accepted
        assert bench.reply(Jog({JOINT: 1.0}, 1.0)).accepted
        assert np.all(np.abs(bench.log[-1][1].command) <= step_of(bench))
        assert bench.run(0.4).command[3] == pytest.approx(1.0)


def test_a_gap_ends_the_goal_with_its_reason_and_is_no_fault_of_the_joints(bench: Any) -> None:
    """The drives went on for their watchdog's time and then braked: travel that nobody had commanded."""
    jogging(bench)
    bench.q = bench.q + np.eye(6)[3] * (WATCHDOG_S + 1.0 / (2 * 4.0))
    after_a_gap(bench, 0.6)
    assert bench.run(0.5).status.lifecycle == "active"
    assert bench.reply(Resume()).accepted
    target = FeatureTarget(bench.features(bench.q - 0.5 * DISPLACED))
    assert bench.reply(RunGoal(Goal("0000abcd", target, law="cartesian3"))).accepted
    bench.run(0.4)
    after_a_gap(bench, 0.6)
    aborted = [e for e in bench.events if e.kind == "goal_aborted"]
    assert [e.reasons[0].code for e in aborted] == ["LOOP_GAP"]
    assert "priority" in aborted[0].reasons[0].hint


@pytest.mark.parametrize(
    ("watchdog_s", "gap_s", "stops"),
    [(0.4, 0.35, False), (0.4, 0.45, True), (60.0, 0.45, False), (60.0, 0.55, True), (0.001, 0.015, False)],
)
def test_the_longest_gap_is_what_the_drives_bear_and_half_a_second_at_most(
    benches: Any, watchdog_s: float, gap_s: float, stops: bool
) -> None:
    bench = benches(1)
    limits = msgspec.structs.replace(bench.settings.limits, command_timeout_s=watchdog_s)
    bench.settings = msgspec.structs.replace(bench.settings, limits=limits)
    bench.core = ServoCore(bench.settings)
    jogging(bench)
    bench.q = bench.q + bench.log[-1][1].command * (gap_s - 0.01)  # drives that do the last command all the time
    after_a_gap(bench, gap_s)
    assert bench.core.state.stopped == stops
    assert bench.run(0.2).status.lifecycle == "active"


def test_a_gap_while_the_drives_are_off_or_are_being_enabled_stops_nothing(bench: Any) -> None:
    bench.run(0.1)
    after_a_gap(bench, 5.0)
    bench.step(Enable())
    after_a_gap(bench, 3.0)  # drives take their time to come up
    assert not bench.core.state.stopped
    assert bench.reply(Jog({JOINT: 0.2}, 0.5)).accepted


def test_a_clock_that_goes_backwards_stops_the_arm(bench: Any) -> None:
    jogging(bench)
    after_a_gap(bench, -1.0)
    assert codes(bench.log[-1][1])[-2:] == ["LOOP_GAP", "STOPPED"]


def test_refusals_and_gaps_are_the_same_in_a_replay(bench: Any) -> None:
    servoing(bench)
    twin = ServoCore(bench.settings, decode_state(encode_state(bench.core.state)))
    start = len(bench.log)
    bench.joints_stamped_late_ns = HOUR_NS
    bench.run(0.05)
    bench.joints_stamped_late_ns = 0
    bench.step(Resume())
    bench.stamped_late_ns = HOUR_NS
    bench.run(0.2)
    after_a_gap(bench, 0.6)
    for inputs, outputs in bench.log[start:]:
        again = twin.step(inputs)
        assert again.command.tobytes() == outputs.command.tobytes()
        assert again.status.reasons == outputs.status.reasons
    assert encode_state(twin.state) == encode_state(bench.core.state)
