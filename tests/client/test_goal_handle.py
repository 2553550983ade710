"""A client's handle of a goal: how far it is, streaming, acknowledging; with a stand-in for the session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from stereoservo.client import Client, ClientError, GoalHandle, GoalProgress
from stereoservo.messages.goals import AdaptiveGain, Centre, FeatureTarget, Goal, JointTarget, StepTarget, TaughtTarget
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import EventMessage, LoopInfo, MessageError, Reply, StateMessage, decode, encode

ID = "12345678-aaaa"
TARGET = FeatureTarget({"left": {0: (1.0, 2.0)}})
SLOW = Reason("JOINT_LIMIT", "slow", "j3", 1.9, 2.0, "rad", "joint j3 is near its limit")


def state(goal: str) -> StateMessage:
    return StateMessage(
        cell="demo", boot="b", t_ns=1, step=0, t_wall=1.0, lifecycle="active", model="valid", model_epoch=1,
        source="law", goal=goal, law="stereo", level="slow", reasons=(SLOW,), joints={}, velocities={}, command={},
        error_px=3.5,
        task_error=(), innovation_px={}, visible={}, loop=LoopInfo(250.0, 1, 0, 0, {}, {}), progress=0.25,
        seconds_left=4.0,
    )  # fmt: skip


class StubWatch:
    def __init__(self) -> None:
        self.events: list[EventMessage] = []
        self.closed = False

    def poll(self) -> list[EventMessage]:
        found, self.events = self.events, []
        return found

    def wait(self, wanted: Callable[[EventMessage], bool], what: str, timeout_s: float) -> EventMessage:
        return next(event for event in self.poll() if wanted(event))

    def close(self) -> None:
        self.closed = True


class StubClient:
    def __init__(self) -> None:
        self.goal = ID
        self.updates: list[tuple[str, Any, float | None]] = []
        self.acknowledged: list[str] = []

    def status(self) -> StateMessage:
        return state(self.goal)

    def update(self, goal_id: str, target: Any, stamp_s: float | None) -> None:
        self.updates.append((goal_id, target, stamp_s))

    def acknowledge(self, goal_id: str) -> None:
        self.acknowledged.append(goal_id)


@pytest.fixture
def parts() -> tuple[GoalHandle, Any, Any]:
    client, watch = StubClient(), StubWatch()
    made: Any = GoalHandle
    return made(client, Goal(ID, TARGET), watch, Reply(True, "accepted")), client, watch


def test_progress_is_that_of_the_goal_while_it_is_active(parts: tuple[GoalHandle, Any, Any]) -> None:
    handle, client, _ = parts
    assert handle.progress() == GoalProgress(True, 0.25, 4.0, 3.5, (SLOW,))
    client.goal = "another"
    assert handle.progress() == GoalProgress(False, None, None, None, ())


def test_a_stream_puts_what_comes_until_the_goal_ends(parts: tuple[GoalHandle, Any, Any]) -> None:
    handle, client, watch = parts
    assert handle.stream((0.01 * k, TARGET) for k in range(5)) == 5
    assert client.updates == [(ID, TARGET, 0.01 * k) for k in range(5)]

    def ends_at_the_third() -> Any:
        for k in range(9):
            if k == 3:
                watch.events.append(EventMessage(1, "b", 0, 0.0, "goal_aborted", "time is up", id=ID))
            yield None, TARGET

    assert handle.stream(ends_at_the_third()) == 3
    assert handle.ended
    assert watch.closed
    assert handle.wait().outcome == "aborted"
    assert handle.stream([(None, TARGET)]) == 0


def test_a_goal_that_a_fault_ended_tells_the_fault(parts: tuple[GoalHandle, Any, Any]) -> None:
    handle, _, watch = parts
    reasons = (
        Reason("NOT_ACTIVE", "hold", hint="the cell became fault"),
        Reason("X", "fault", hint="no TPDO1 of node 4"),
    )
    watch.events.append(EventMessage(1, "b", 0, 0.0, "goal_aborted", "the cell became fault", id=ID, reasons=reasons))
    handle.stream([(None, TARGET)])
    with pytest.raises(ClientError, match="was aborted: the cell became fault: no TPDO1 of node 4"):
        handle.reached()


def test_whoever_waits_hears_the_events_of_that_goal_alone(parts: tuple[GoalHandle, Any, Any]) -> None:
    handle, _, watch = parts
    kinds = (("held", ID), ("held", "another"), ("resumed", ID), ("goal_reached", ID), ("held", ID))
    watch.events = [EventMessage(k, "b", 0, 0.0, kind, id=goal) for k, (kind, goal) in enumerate(kinds)]
    heard: list[str] = []
    assert handle.wait(progress=lambda event: heard.append(event.kind)).outcome == "reached"
    assert heard == ["held", "resumed", "goal_reached"]


def test_a_handle_acknowledges_its_goal(parts: tuple[GoalHandle, Any, Any]) -> None:
    handle, client, _ = parts
    handle.acknowledge()
    assert client.acknowledged == [ID]


def test_goals_are_made_from_shorthands_and_strictly() -> None:
    assert Client.make_goal("pick").target == TaughtTarget("pick")
    assert Client.make_goal({"j1": 0.5}).target == JointTarget({"j1": 0.5})
    assert Client.make_goal({"left": {"0": (1, 2)}}).target == TARGET
    goal = Client.make_goal(
        TARGET, law="cartesian3", centre=Centre((0,)), gain=AdaptiveGain(4, 1), damping=0.3, blend_px=3.0
    )
    assert (goal.law, goal.centre, goal.gain, goal.damping, goal.blend_px) == (
        "cartesian3",
        Centre((0,)),
        AdaptiveGain(4, 1),
        0.3,
        3.0,
    )
    assert goal.id != Client.make_goal(TARGET).id
    assert Client.make_goal(TARGET, law="pbvs").law == "pbvs"  # the daemon knows which laws are installed
    with pytest.raises(MessageError, match="unknown field `hurry`"):
        Client.make_goal(TARGET, hurry=True)  # type: ignore[call-arg]
    assert msgspec.json.encode(goal)


def test_steps_are_goals_in_metres_and_radians() -> None:
    sent: list[tuple[Any, dict[str, Any]]] = []

    class Sender(Client):
        def __init__(self) -> None: ...

        def goal(self, target: Any, **options: Any) -> Any:
            sent.append((target, options))

    Sender().move(z=0.02, frame="base", length="markers:0,1=0.05", law="trajectory")
    Sender().turn(x=0.1)
    assert sent == [
        (StepTarget("base", (0.0, 0.0, 0.02), length="markers:0,1=0.05"), {"law": "trajectory"}),
        (StepTarget("tool", turn=(0.1, 0.0, 0.0)), {}),
    ]
    for step, _ in sent:
        goal = Client.make_goal(step)
        assert decode(encode(goal), Goal) == goal
