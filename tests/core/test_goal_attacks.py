"""Hostile but well-formed clients: nothing accepted is lost, nothing begins that may not, no step grows long."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core import execute_goals
from stereoservo.core.goals import accept
from stereoservo.core.state import Holding
from stereoservo.messages.goals import (
    Calibrate,
    CancelGoal,
    FeatureTarget,
    Goal,
    Home,
    Jog,
    JointTarget,
    RenewGoal,
    Request,
    Resume,
    RunGoal,
    UpdateGoal,
)

DISPLACED = np.array([0.2, -0.15, 0.1, 0.3, -0.2, 0.4])
TERMINAL = {"goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted"}


def to(bench: Any, q: np.ndarray) -> FeatureTarget:
    return FeatureTarget(bench.features(q))


def of(goal_id: str, target: Any, **options: Any) -> RunGoal:
    return RunGoal(Goal(goal_id, target, **options))


def ends(bench: Any, goal_id: str) -> list[str]:
    return [e.kind for e in bench.events if e.id == goal_id and e.kind in TERMINAL]


def planning_from_queue(bench: Any, goal_id: str) -> None:
    """Bring a queued goal to where its way is being planned."""
    bench.ready()
    near, base = bench.q + 0.02 * DISPLACED, bench.q.copy()
    assert bench.reply(bench.goal(to(bench, near), gain=4.0)).accepted
    queued = of(goal_id, to(bench, base + DISPLACED), mode="queue", law="trajectory")
    assert bench.reply(queued).accepted
    for _ in range(1000):
        bench.step()
        job = bench.core.state.planning
        if job is not None and job.purpose == "queue":
            assert isinstance(bench.core.state.source, Holding)
            return
    raise AssertionError("the queued goal was never planned")


@pytest.mark.parametrize("by", ["goal", "queue", "check", "joints", "home", "calibrate"])
def test_queued_goal_amid_its_planning_is_not_lost(bench: Any, by: str) -> None:
    planning_from_queue(bench, "0000aaaa")
    target = to(bench, bench.q + 0.3 * DISPLACED)
    bench.step(
        {
            "goal": of("0000bbbb", target),
            "queue": of("0000bbbb", target, mode="queue"),
            "check": of("0000bbbb", target, check=True),
            "joints": of("0000bbbb", JointTarget({"j1": 0.3})),
            "home": Home("0000bbbb"),
            "calibrate": Calibrate("0000bbbb"),
        }[by]
    )
    assert bench.until(lambda e: e.kind == "reply" and e.id == "0000bbbb", 5.0).accepted
    if by in ("goal", "joints", "home", "calibrate"):
        assert ends(bench, "0000aaaa") == ["goal_preempted"]
        return
    bench.until(lambda e: e.kind in TERMINAL and e.id == "0000aaaa", 20.0)
    if by == "queue":
        bench.until(lambda e: e.kind in TERMINAL and e.id == "0000bbbb", 20.0)
    assert ends(bench, "0000aaaa") == ["goal_reached"]
    assert ends(bench, "0000bbbb") == (["goal_reached"] if by == "queue" else [])


def test_jog_is_refused_while_a_goal_is_planned_rather_than_done_late(bench: Any) -> None:
    bench.ready()
    bench.step(of("0000aaaa", to(bench, bench.q + DISPLACED)))
    outputs = bench.step(Jog({"j1": 0.1}))
    reply = next(e for e in outputs.events if e.kind == "reply" and e.id == "")
    assert (reply.accepted, reply.reasons[0].code, reply.reasons[0].subject) == (False, "BUSY", "0000aaaa")
    bench.step(CancelGoal("0000aaaa"))
    bench.step(of("0000bbbb", to(bench, bench.q + DISPLACED), check=True))
    assert bench.reply(Jog({"j1": 0.1})).accepted  # a check moves nothing, and keeps nobody from moving


@pytest.mark.parametrize("by", ["cancel", "stop"])
def test_what_waits_behind_a_plan_does_not_begin_after_cancel_or_stop(bench: Any, by: str) -> None:
    bench.ready()
    target = to(bench, bench.q + DISPLACED)
    bench.step(of("0000aaaa", target, check=True), of("0000bbbb", target), Home("0000cccc"))
    if by == "stop":
        bench.step(Resume(), stop=True)
    else:
        bench.step(CancelGoal("0000bbbb"), CancelGoal("0000cccc"))
    bench.run(1.0)
    answers = {e.id: (e.accepted, e.reasons[0].code) for e in bench.events if e.kind == "reply" and e.reasons}
    code = "STOPPED" if by == "stop" else "CANCELLED"
    assert answers["0000bbbb"] == answers["0000cccc"] == (False, code)
    assert np.abs(np.array(bench.commands)).max() == 0.0


def test_goal_whose_client_dies_in_the_queue_does_not_begin(bench: Any) -> None:
    bench.ready()
    base = bench.q.copy()
    assert bench.reply(of("0000aaaa", to(bench, base + DISPLACED), speed_scale=0.2)).accepted
    for goal_id in ("0000bbbb", "0000cccc"):
        assert bench.reply(of(goal_id, to(bench, base), mode="queue", lease_s=0.5)).accepted
    for _ in range(10):
        bench.run(0.2)
        assert bench.reply(RenewGoal("0000cccc")).accepted
    assert ends(bench, "0000bbbb") == ["goal_aborted"]
    event = next(e for e in bench.events if e.kind == "goal_aborted")
    assert event.reasons[0].code == "LEASE_EXPIRED"
    assert [goal.id for goal in bench.core.state.queue] == ["0000cccc"]
    assert not [e for e in bench.events if e.kind == "goal_started" and e.id == "0000bbbb"]


@pytest.mark.parametrize("by", ["time limit", "preempted", "cancelled", "preempted while it waits"])
def test_what_follows_a_handshake_that_did_not_happen_is_cancelled(bench: Any, by: str) -> None:
    """Pick, acknowledge, place: a pick that ends otherwise must not let the place begin."""
    bench.ready()
    base, there = bench.q.copy(), bench.q + 0.5 * DISPLACED
    limit = 0.3 if by == "time limit" else None
    waits = by == "preempted while it waits"
    pick = of("0000aaaa", to(bench, base if waits else there), acknowledge_s=60.0, time_limit_s=limit)
    assert bench.reply(pick).accepted
    assert bench.reply(of("0000bbbb", to(bench, base - 0.5 * DISPLACED), mode="queue")).accepted
    bench.run(1.0 if waits else 0.1)
    if by == "cancelled":
        assert bench.reply(CancelGoal("0000aaaa")).accepted
    elif by != "time limit":
        assert bench.reply(of("0000cccc", JointTarget({"j6": 0.1}))).accepted
    bench.run(2.0)
    assert ends(bench, "0000bbbb") == ["goal_cancelled"]
    assert not [e for e in bench.events if e.kind == "goal_started" and e.id == "0000bbbb"]
    assert len(ends(bench, "0000aaaa")) == 1


def test_repeated_ids_are_harmless(bench: Any) -> None:
    bench.ready()
    pick = of("0000aaaa", to(bench, bench.q), acknowledge_s=60.0)
    assert bench.reply(pick).accepted
    assert bench.ended().kind == "goal_reached"
    bench.run(0.1)
    assert bench.reply(pick).message == "already accepted"  # it was reached, and waits
    assert bench.reply(Home("0000aaaa")).reasons[0].code == "ID_IN_USE"
    assert bench.reply(Home("0000bbbb")).accepted
    assert bench.reply(Home("0000bbbb")).message == "already accepted"
    assert (ends(bench, "0000aaaa"), ends(bench, "0000bbbb")) == (["goal_reached"], [])


def test_burst_of_goals_is_read_one_a_step_and_each_is_answered(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.ready()
    read = []
    prepare = accept.prepare

    def counted(*arguments: Any) -> Any:
        read.append(bench.seq)
        return prepare(*arguments)

    monkeypatch.setattr(accept, "prepare", counted)
    monkeypatch.setattr(execute_goals, "prepare", counted)
    burst = [of(f"{k:08x}", JointTarget({"j1": 0.3 + 0.001 * k})) for k in range(50)]
    outputs = bench.step(*burst)
    bench.run(1.0)
    assert max(read.count(step) for step in set(read)) == 1
    answers = [e for e in bench.events if e.kind == "reply" and e.id in {c.goal.id for c in burst}]
    assert len(answers) == len({e.id for e in answers}) == 50
    refused = [e for e in answers if not e.accepted]
    assert len(refused) == sum(e.kind == "reply" for e in outputs.events) - 1 > 0
    assert {(e.reasons[0].code, e.reasons[0].threshold) for e in refused} == {("BUSY", 16.0)}
    accepted = [e.id for e in answers if e.accepted]
    assert [ends(bench, goal_id) for goal_id in accepted[:-1]] == [["goal_preempted"]] * (len(accepted) - 1)


def test_extreme_numbers_are_refused_when_they_are_read(bench: Any) -> None:
    """What would overflow a clock, or make the seconds of a plan infinite, is no goal."""
    target = to(bench, bench.q)
    for name, value in [
        ("acknowledge_s", 1e10), ("acknowledge_s", 1.7e308), ("time_limit_s", 1.7e308), ("gain", 5e-324),
        ("tolerance_px", 5e-324), ("blend_px", 5e-324), ("speed_scale", 5e-324), ("speed_scale", 1e-300),
    ]:  # fmt: skip
        request = Request(1, "tester", of("0000aaaa", target, **{name: value}))
        with pytest.raises(msgspec.ValidationError, match=name):
            msgspec.msgpack.decode(msgspec.msgpack.encode(request), type=Request)


def test_set_points_at_any_rate_are_worked_on_once_a_step(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.ready()
    base = bench.q.copy()
    assert bench.reply(of("0000aaaa", to(bench, base), gain=4.0)).accepted
    worked = []
    move = accept.move_goal

    def counted(command: UpdateGoal, context: Any) -> str:
        worked.append((bench.seq, command.stamp_s))
        return move(command, context)

    monkeypatch.setitem(accept._HANDLERS, UpdateGoal, accept._of_command(counted))
    for k in range(100):
        q = base + 0.2 * DISPLACED * min(1.0, k / 80.0)
        told = [UpdateGoal("0000aaaa", to(bench, q), 1.0 + 0.01 * k + 0.001 * i) for i in range(10)]
        outputs = bench.step(*told)
        assert [e.accepted for e in outputs.events if e.kind == "reply"] == [True] * 10
        assert worked[-1] == (bench.seq, told[-1].stamp_s)
    assert len(worked) == 100
    assert bench.ended(5.0).kind == "goal_reached"
    assert bench.error_px(base + 0.2 * DISPLACED) < 0.3


def test_tolerance_that_noise_never_allows_ends_at_the_time_limit_with_the_cause(benches: Any) -> None:
    bench = benches(1, noise_px=0.3).ready()
    command = of("0000aaaa", to(bench, bench.q), tolerance_px=0.001, time_limit_s=8.0)
    assert bench.reply(command).accepted
    event = bench.ended(10.0)
    assert (event.kind, [r.code for r in event.reasons][:2]) == ("goal_aborted", ["TIME_LIMIT", "STUCK"])
    assert "tolerance of 0.001 px is below what the images allow" in event.reasons[1].hint
