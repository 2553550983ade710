"""Planning in slices, queue, hand-over, acknowledgement, streams, and what is told on the way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import ContactSettings
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.messages.goals import (
    AcknowledgeGoal,
    CancelGoal,
    ExtendLeases,
    FeatureTarget,
    Hold,
    Home,
    JointTarget,
    PointTarget,
    Resume,
    UpdateGoal,
)
from stereoservo.recording.flight_recorder import FlightRecorder
from stereoservo.recording.replay import replay
from stereoservo.recording.step_layout import encode_step
from stereoservo.recording.step_records import fingerprint

DISPLACED = np.array([0.2, -0.15, 0.1, 0.3, -0.2, 0.4])


def features(bench: Any, q: np.ndarray) -> FeatureTarget:
    return FeatureTarget(bench.features(q))


def kinds(bench: Any, goal_id: str) -> list[str]:
    return [e.kind for e in bench.events if e.id == goal_id and e.kind != "reply"]


def codes(bench: Any) -> set[str]:
    return {reason.code for reason in bench.log[-1][1].status.reasons}


# -- planning -------------------------------------------------------------------------------------------------


def test_check_tells_the_way_and_nothing_moves(bench: Any) -> None:
    bench.ready()
    goal_q = bench.q + DISPLACED
    reply = bench.reply(bench.goal(features(bench, goal_q), law="trajectory", check=True))
    plan = reply.plan
    assert reply.accepted
    assert bench.core.state.source.__class__.__name__ == "Holding"
    assert np.abs(np.array(bench.commands)).max() == 0.0
    assert (plan.shares[0], plan.shares[-1]) == (0.0, 1.0)
    ends = np.array([plan.joints[name][-1] for name in bench.settings.joint_names])
    np.testing.assert_allclose(ends, goal_q, atol=2e-3)
    exact = bench.features(goal_q)
    for camera, markers in plan.pixels.items():
        for marker, way in markers.items():
            np.testing.assert_allclose(way[-1], exact[camera][marker], atol=0.5)
    speeds = np.abs(goal_q - bench.q) / bench.settings.limits.velocity_max
    assert speeds.max() < plan.seconds < 10.0 * speeds.max()
    assert {approach.code for approach in plan.approaches} >= {"JOINT_LIMIT", "FIELD_OF_VIEW"}


def test_reply_waits_for_the_plan_while_the_arm_goes_on(bench: Any) -> None:
    bench.ready()
    base = bench.q.copy()
    assert bench.reply(bench.goal(features(bench, base + DISPLACED))).accepted
    bench.run(0.3)
    first = bench.log[-1][1].status.goal
    outputs = bench.step(bench.goal(features(bench, base - 0.5 * DISPLACED), law="trajectory"))
    assert not [e for e in outputs.events if e.kind == "reply"]
    assert (outputs.status.goal, "PLANNING" in codes(bench)) == (first, True)
    assert np.abs(outputs.command).max() > 0.0
    bench.until(lambda e: e.kind == "reply", 2.0)
    assert kinds(bench, first)[-1] == "goal_preempted"
    # It has moved meanwhile: law trajectory brakes, plans from there, and arrives all the same.
    assert bench.ended().kind == "goal_reached"


def test_requests_are_answered_in_order_while_a_goal_is_planned(bench: Any) -> None:
    bench.ready()
    first = bench.goal(features(bench, bench.q + DISPLACED))
    second = bench.goal(features(bench, bench.q))
    second = msgspec.structs.replace(second, goal=msgspec.structs.replace(second.goal, id="0000beef"))
    bench.step(first, second, Home("0000cafe"))
    bench.until(lambda e: e.kind == "reply" and e.id == "0000cafe", 2.0)
    replies = [(e.id, e.accepted) for e in bench.events if e.kind == "reply" and e.id]
    assert replies == [(first.goal.id, True), ("0000beef", True), ("0000cafe", True)]


@pytest.mark.parametrize("by", ["cancel", "hold", "stop"])
def test_what_ends_a_goal_ends_its_planning_at_once(bench: Any, by: str) -> None:
    bench.ready()
    command = bench.goal(features(bench, bench.q + DISPLACED))
    bench.step(command)
    if by == "stop":
        bench.step(stop=True)
    else:
        assert bench.reply(CancelGoal(command.goal.id) if by == "cancel" else Hold()).accepted
    bench.run(0.5)
    replies = [e for e in bench.events if e.kind == "reply" and e.id == command.goal.id and e.reasons]
    assert replies[0].accepted is False
    assert replies[0].reasons[0].code == {"cancel": "CANCELLED", "hold": "HELD", "stop": "STOPPED"}[by]
    assert kinds(bench, command.goal.id) == []
    assert np.abs(np.array(bench.commands)).max() == 0.0


def test_planning_in_the_middle_replays_bit_for_bit(benches: Any, tmp_path: Path) -> None:
    bench = benches(3, noise_px=0.1).ready()
    command = bench.goal(features(bench, bench.q + DISPLACED), law="trajectory", acknowledge_s=5.0)
    path = tmp_path / "flight.mcap"
    with FlightRecorder(path, bench.settings, fingerprint()) as recorder:
        for k in range(300):
            if k in (0, 8):  # 8: amid planning
                recorder.checkpoint(bench.core.state.step + 1, encode_state(bench.core.state), bench.now_ns)
                assert (bench.core.state.planning is not None) == (k == 8)
            outputs = bench.step(*([command] if k == 5 else []))
            recorder.step(encode_step(bench.log[-1][0], outputs), bench.log[-1][0].now_ns)
    result = replay(path)
    assert (result.identical, result.steps, result.checkpoints) == (True, 300, 2)


def test_state_amid_planning_streaming_and_queue_survives_serialisation(bench: Any) -> None:
    bench.ready()
    q = bench.q.copy()
    command = bench.goal(features(bench, q + DISPLACED), blend_px=30.0)
    assert bench.reply(command).accepted
    assert bench.reply(bench.goal(features(bench, q), mode="queue")).accepted
    bench.step(UpdateGoal(command.goal.id, features(bench, q + 1.02 * DISPLACED)))
    bench.step(bench.goal(features(bench, q - 0.5 * DISPLACED), check=True), Home("0000cafe"))
    state = bench.core.state
    assert (state.planning is not None, len(state.waiting), len(state.queue)) == (True, 1, 1)
    assert state.source.stream is not None
    twin = ServoCore(bench.settings, decode_state(encode_state(bench.core.state)))
    start = len(bench.log)
    bench.run(1.0)
    for inputs, outputs in bench.log[start:]:
        assert twin.step(inputs).command.tobytes() == outputs.command.tobytes()
    assert encode_state(twin.state) == encode_state(bench.core.state)


def test_joint_goal_through_a_keep_out_is_refused_with_the_place(benches: Any) -> None:
    bench = benches(1)
    box = np.full((1, 6, 2), (-np.inf, np.inf))
    box[0, 0] = (0.4, 0.6)
    limits = msgspec.structs.replace(bench.settings.limits, keep_outs=box, keep_out_names=("post",))
    bench.settings = msgspec.structs.replace(bench.settings, limits=limits)
    bench.core = ServoCore(bench.settings)
    bench.ready()
    reply = bench.reply(bench.goal(JointTarget({"j1": 1.1})))
    assert (reply.accepted, reply.reasons[0].code, reply.reasons[0].subject) == (False, "KEEP_OUT", "post")
    assert reply.reasons[0].value == pytest.approx((0.4 - 0.01 - 0.1) / 1.0)
    assert bench.reply(bench.goal(JointTarget({"j1": 0.3}), check=True)).plan.way == "straight in joint space"


# -- queue ----------------------------------------------------------------------------------------------------


def speed_at(bench: Any, goal_id: str, kind: str) -> float:
    """Joint speed [rad/s] around an event of a goal: the least of the ten steps about it."""
    k = next(i for i, (_, out) in enumerate(bench.log) for e in out.events if e.id == goal_id and e.kind == kind)
    return min(float(np.abs(out.command).max()) for _, out in bench.log[k - 5 : k + 5])


@pytest.mark.parametrize("blend_px", [40.0, None])
def test_blended_goals_hand_over_without_stopping(bench: Any, blend_px: float | None) -> None:
    bench.ready()
    q = bench.q.copy()
    first = bench.goal(features(bench, q + DISPLACED), blend_px=blend_px)
    assert bench.reply(first).accepted
    second = bench.goal(features(bench, q + DISPLACED * [2, 1, 1, 1, 1, 1]), mode="queue")
    assert bench.reply(second).accepted
    bench.until(lambda e: e.kind == "goal_reached" and e.id == second.goal.id, 30.0)
    assert kinds(bench, first.goal.id) == ["goal_started", "goal_reached"]
    assert kinds(bench, second.goal.id) == ["goal_started", "goal_reached"]
    speed = speed_at(bench, first.goal.id, "goal_reached")
    if blend_px is None:
        assert speed < 1e-3
    else:
        # 40 px are made in joint motion at the law's gain: far above what a stop would leave.
        assert speed > 0.03


def test_reached_goal_waits_for_its_acknowledgement(bench: Any) -> None:
    bench.ready()
    q = bench.q.copy()
    first = bench.goal(features(bench, q + 0.3 * DISPLACED), acknowledge_s=3.0, gain=4.0)
    assert bench.reply(first).accepted
    second = bench.goal(features(bench, q), mode="queue", gain=4.0)
    assert bench.reply(second).accepted
    assert bench.reply(AcknowledgeGoal(first.goal.id)).reasons[0].code == "NOT_AWAITED"
    assert bench.ended().id == first.goal.id
    outputs = bench.run(1.0)
    assert (outputs.status.source, outputs.status.goal) == ("acknowledge", first.goal.id)
    assert kinds(bench, second.goal.id) == []
    assert bench.reply(AcknowledgeGoal(first.goal.id)).accepted
    assert kinds(bench, first.goal.id) == ["goal_started", "goal_reached", "goal_acknowledged"]
    assert bench.ended().id == second.goal.id
    assert bench.error_px(q) < 0.3


def test_goal_that_nobody_acknowledges_ends_the_queue(bench: Any) -> None:
    bench.ready()
    first = bench.goal(features(bench, bench.q), acknowledge_s=0.5)
    assert bench.reply(first).accepted
    second = bench.goal(features(bench, bench.q + DISPLACED), mode="queue")
    assert bench.reply(second).accepted
    event = bench.until(lambda e: e.id == second.goal.id and e.kind.startswith("goal_"), 5.0)
    assert (event.kind, event.reasons[0].code) == ("goal_cancelled", "NOT_ACKNOWLEDGED")
    assert np.abs(bench.run(0.5).command).max() == 0.0


def test_queue_waits_in_hold(bench: Any) -> None:
    bench.ready()
    q = bench.q.copy()
    first, second = (
        bench.goal(features(bench, q)),
        bench.goal(features(bench, q + 0.3 * DISPLACED), mode="queue"),
    )
    assert bench.reply(first).accepted
    assert bench.reply(bench.goal(second.goal.target, mode="queue", gain=4.0)).accepted
    assert bench.ended().id == first.goal.id
    assert bench.reply(Hold()).accepted
    bench.run(1.0)
    assert not [e for e in bench.events if e.kind == "goal_aborted"]
    assert bench.reply(Resume()).accepted
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(q + 0.3 * DISPLACED) < 0.3


# -- streams --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["cartesian3", "stereo"])
def test_moving_target_is_followed_closely(benches: Any, law: str) -> None:
    """Without feed-forward the lag is speed/gain; with it what is left is the target's acceleration over gain²."""
    bench = benches(2).ready()
    base, gain, omega, reach = bench.q.copy(), 2.0, 1.0, 0.3
    direction = DISPLACED / np.abs(DISPLACED).max()
    command = bench.goal(features(bench, base), law=law, gain=gain)
    assert bench.reply(command).accepted
    worst, speeds, before, start = 0.0, [], None, bench.now_ns
    for k in range(500):
        t = (bench.now_ns - start) * 1e-9
        q = base + reach * 0.5 * (1.0 - np.cos(omega * t)) * direction
        updates = []
        if k % 3 == 0:  # 33 Hz
            told = q
            updates = [UpdateGoal(command.goal.id, features(bench, q), stamp_s=100.0 + t)]
        bench.step(*updates)
        now = bench.truth.pixels(q)
        if before is not None:
            speeds.append(np.linalg.norm(now - before, axis=-1).max() * bench.settings.rate_hz)
        before = now
        if k > 150:
            worst = max(worst, float(np.linalg.norm(bench.truth.pixels(bench.q) - now, axis=-1).max()))
    assert max(speeds) > 50.0
    lag = max(speeds) / gain
    # acceleration/gain² = speed·omega/gain², and two periods of the loop at full speed
    assert worst < lag * omega / gain + 2.0 * max(speeds) / bench.settings.rate_hz
    assert not [e for e in bench.events if e.kind == "goal_reached"]
    assert not [e for e in bench.events if e.kind == "reply" and not e.accepted]
    assert bench.ended(5.0).kind == "goal_reached"  # the stream is silent: the target stands
    assert bench.error_px(told) < 0.15


def test_moved_target_that_cannot_be_is_refused_and_the_old_one_kept(bench: Any) -> None:
    bench.ready()
    base = bench.q.copy()
    goal_q = base + 0.3 * DISPLACED
    command = bench.goal(features(bench, goal_q), gain=3.0)
    assert bench.reply(command).accepted
    first = bench.goal(features(bench, base)).goal.id
    swapped = bench.features(goal_q)
    swapped["left"] = {**swapped["left"], 4: swapped["left"][5], 5: swapped["left"][4]}

    def code(target: Any, goal_id: str = command.goal.id, stamp_s: float | None = None) -> str:
        reply = bench.reply(UpdateGoal(goal_id, target, stamp_s))
        return "" if reply.accepted else reply.reasons[0].code

    assert code(features(bench, goal_q), stamp_s=5.0) == ""
    assert code(features(bench, goal_q), stamp_s=5.0) == "STAMP_NOT_LATER"
    assert code(features(bench, goal_q), stamp_s=float("nan")) == "STAMP_NOT_LATER"
    assert code(features(bench, base - DISPLACED), stamp_s=6.0) == "TARGET_JUMP"
    assert code(FeatureTarget(swapped), stamp_s=6.0) == "NOT_RIGID"
    assert code(FeatureTarget({"left": {0: (1.0, 1.0)}}), stamp_s=6.0) in ("TOO_FEW_MARKERS", "TARGET_JUMP")
    assert code(PointTarget({0: (0.0, 0.0, 0.0, 0.0)}, 7), stamp_s=6.0) == "POINT_AT_INFINITY"
    assert code(features(bench, goal_q), goal_id=first) == "NO_SUCH_GOAL"
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.3


def test_stream_renews_the_lease(bench: Any) -> None:
    bench.ready()
    goal_q = bench.q + DISPLACED
    command = bench.goal(features(bench, goal_q), lease_s=0.5)
    assert bench.reply(command).accepted
    for _ in range(10):
        bench.run(0.2)
        bench.step(UpdateGoal(command.goal.id, features(bench, goal_q)))
    assert not [e for e in bench.events if e.kind == "goal_aborted"]
    assert bench.ended(2.0).reasons[0].code == "LEASE_EXPIRED"


def test_time_in_which_nobody_hears_the_clients_is_none_of_a_lease(bench: Any) -> None:
    bench.ready()
    target = features(bench, bench.q + DISPLACED)
    first = bench.goal(target, lease_s=0.5, speed_scale=0.1)
    second = bench.goal(target, lease_s=0.5, mode="queue")
    assert bench.reply(first).accepted
    assert bench.reply(second).accepted
    before = len(bench.events)
    for _ in range(10):
        bench.step(ExtendLeases(0.2))
        bench.run(0.2)
    assert {"goal_aborted", "reply"} & {e.kind for e in bench.events[before:]} == set()  # nobody asked: no reply
    bench.run(1.0)
    ends = {e.id: e.reasons[0].code for e in bench.events if e.kind == "goal_aborted"}
    assert ends == {first.goal.id: "LEASE_EXPIRED", second.goal.id: "LEASE_EXPIRED"}


def test_time_in_which_nobody_hears_the_clients_counts_for_no_acknowledgement(bench: Any) -> None:
    bench.ready()
    first = bench.goal(features(bench, bench.q), acknowledge_s=0.5)
    assert bench.reply(first).accepted
    assert bench.ended().kind == "goal_reached"
    for _ in range(10):
        bench.step(ExtendLeases(0.2))
        bench.run(0.2)
    assert bench.reply(AcknowledgeGoal(first.goal.id)).accepted


# -- drop-outs, hold, and what is told ------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["stereo", "cartesian2", "trajectory"])
def test_camera_that_drops_out_for_two_seconds_changes_nothing(benches: Any, law: str) -> None:
    bench = benches(4).ready()
    goal_q = bench.q + 0.8 * DISPLACED
    # Slow enough for the goal to be far when the camera comes back.
    assert bench.reply(bench.goal(features(bench, goal_q), law=law, speed_scale=0.15)).accepted
    bench.run(0.2)
    bench.cameras_on[1] = False
    bench.run(2.0)
    assert bench.log[-1][1].status.error_px > 1.0
    bench.cameras_on[1] = True
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.3


def test_trajectory_waits_in_hold_and_goes_on(bench: Any) -> None:
    bench.ready()
    goal_q = bench.q + DISPLACED
    assert bench.reply(bench.goal(features(bench, goal_q), law="trajectory")).accepted
    bench.run(0.5)
    assert bench.reply(Hold()).accepted
    assert np.abs(bench.run(1.0).command).max() == 0.0
    assert 0.0 < bench.log[-1][1].status.progress < 1.0
    assert bench.reply(Resume()).accepted
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.3


def test_progress_runs_to_its_end(bench: Any) -> None:
    bench.ready()
    for target, law in (
        (features(bench, bench.q + DISPLACED), "cartesian3"),
        (JointTarget({"j1": 0.8}), None),
    ):
        assert bench.reply(bench.goal(target, law=law)).accepted
        since = len(bench.log)
        bench.ended()
        told = [
            (o.status.progress, o.status.seconds_left) for _, o in bench.log[since:] if o.status.progress is not None
        ]
        shares, left = np.array(told).T
        assert shares[0] < 0.1
        assert shares[-1] > 0.95
        assert np.all(np.diff(shares) > -0.05)
        whole = (bench.log[-1][0].now_ns - bench.log[since][0].now_ns) * 1e-9
        assert left[0] == pytest.approx(whole, rel=0.4)


def test_law_that_does_not_get_on_says_why(bench: Any) -> None:
    """A tolerance that no image reaches: after a while the status says so, with the noise."""
    bench.ready()
    goal_q = bench.q + 0.2 * DISPLACED
    reply = bench.reply(bench.goal(features(bench, goal_q), tolerance_px=1e-4, time_limit_s=60.0))
    assert reply.accepted
    bench.noise_px = 0.3
    bench.run(12.0)
    stuck = next(r for r in bench.log[-1][1].status.reasons if r.code == "STUCK")
    assert "tolerance" in stuck.hint
    assert stuck.value == pytest.approx(bench.log[-1][1].status.error_px, abs=1.0)
    assert stuck.threshold == 1e-4


def test_joint_near_its_limit_and_few_markers_are_told(benches: Any) -> None:
    bench = benches(1)
    limits = bench.settings.limits
    narrow = limits.position_max.copy()
    narrow[5] = bench.q[5] + 0.45
    bench.settings = msgspec.structs.replace(
        bench.settings, limits=msgspec.structs.replace(limits, position_max=narrow)
    )
    bench.core = ServoCore(bench.settings)
    bench.ready()
    assert bench.reply(bench.goal(features(bench, bench.q + DISPLACED), gain=3.0)).accepted
    told: set[tuple[str, str]] = set()
    bench.marker_mask[3:] = False
    for _ in range(300):
        told |= {(r.code, r.subject) for r in bench.step().status.reasons}
    assert ("NEAR_LIMIT", "j6") in told
    assert ("FEW_MARKERS", "") in told


def test_law_hands_over_to_the_face_that_is_seen(bench: Any) -> None:
    bench.ready()
    goal_q = bench.q + DISPLACED
    command = bench.goal(features(bench, goal_q))
    assert bench.reply(command).accepted
    bench.run(0.3)
    before = set(bench.core.state.source.choice.triple.tolist())
    bench.marker_mask[list(before)] = False
    event = bench.until(lambda e: e.kind == "goal_face", 2.0)
    assert event.id == command.goal.id
    chosen = {int(i) for i in event.name.split(", ")}
    assert len(chosen) == 3
    assert not chosen & before
    assert bench.ended().kind == "goal_reached"
    assert bench.error_px(goal_q) < 0.3


@pytest.mark.parametrize("by", ["stop", "contact"])
def test_stop_and_contact_end_the_queue_with_the_goal(bench: Any, by: str) -> None:
    if by == "contact":
        bench.settings = msgspec.structs.replace(
            bench.settings,
            watch_following=True,
            contact=ContactSettings(True, np.full(6, 5.0), np.full(6, np.nan), 2.0, 5, ("N m",) * 6),
        )
        bench.core = ServoCore(bench.settings)
        bench.loads = lambda b: (np.full(6, 50.0 if pressed else 0.0), np.zeros(6))
    pressed = False
    bench.ready()
    first = bench.goal(features(bench, bench.q + DISPLACED))
    assert bench.reply(first).accepted
    second = bench.goal(features(bench, bench.q - DISPLACED), mode="queue")
    assert bench.reply(second).accepted
    bench.run(0.5)
    assert np.abs(bench.commands[-1]).max() > 0.0
    pressed = True
    if by == "stop":
        bench.step(stop=True)
    bench.run(1.0)
    assert kinds(bench, first.goal.id)[-1] == "goal_aborted"
    assert [kind for kind in kinds(bench, second.goal.id) if kind.startswith("goal_")] == ["goal_cancelled"]
    pressed = False
    bench.step(Resume())
    begun = len(bench.commands)
    bench.run(1.0)
    assert not np.any(bench.commands[begun:])


def test_a_plan_keeps_time_where_the_loop_misses_cycles(bench: Any) -> None:
    """The arm goes on with the last velocity meanwhile; where the plan does not know, it runs ahead, past the end."""
    bench.ready()
    start, goal_q = bench.q.copy(), bench.q + DISPLACED
    assert bench.reply(bench.goal(features(bench, goal_q), law="trajectory", gain=1.0)).accepted
    whole = np.linalg.norm(goal_q - start)
    period_ns = round(1e9 / bench.settings.rate_hz)
    farthest, ended = 0.0, len(bench.events)
    while not any(event.kind == "goal_reached" for event in bench.events[ended:]):
        assert bench.seq < 6000
        bench.step()
        if bench.seq % 4 == 1:  # a fifth of the cycles
            bench.now_ns += period_ns
            bench._drive(bench.commands[-1] * period_ns * 1e-9)
        farthest = max(farthest, float((bench.q - start) @ (goal_q - start)) / whole**2)
    assert farthest < 1.01
