"""Goals and commands from queries to the core and back, with stand-ins for zenoh and the servo process."""

import msgspec
import pytest

from stereoservo.core.cycle import Event
from stereoservo.daemon.kernel_compilation import example_settings
from stereoservo.gateway import intake as intake_module
from stereoservo.gateway.goal_transfer import TransferredGoal
from stereoservo.gateway.intake import Intake
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.validation import GoalContext
from stereoservo.messages.goals import (
    AcknowledgeGoal,
    Centre,
    Command,
    DisplacementTarget,
    FeatureTarget,
    Goal,
    Hold,
    IncidenceTarget,
    JointTarget,
    MetricFrame,
    PlanReport,
    RenewGoal,
    RunGoal,
    StepTarget,
    TaughtTarget,
    Teach,
    UpdateGoal,
)
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.wire import Reply, encode

ID = "12345678-aaaa"
KEYS = KeySpace("demo")
EYE = tuple(float(i % 5 == 0) for i in range(16))
POINTS = {"left": {0: (10.0, 10.0), 1: (20.0, 10.0), 2: (20.0, 20.0)}}


class Bytes:
    def __init__(self, data: bytes) -> None:
        self.data = data

    def to_bytes(self) -> bytes:
        return self.data


class Message:
    """A query or a sample."""

    def __init__(self, key: str, payload: bytes | None) -> None:
        self.key_expr = key
        self.payload = None if payload is None else Bytes(payload)
        self.dropped = False

    def drop(self) -> None:
        self.dropped = True


class StubLink:
    def __init__(self) -> None:
        self.asked: list[tuple[Command, str]] = []
        self.up = True

    def send_command(self, command: Command, operator: str) -> int | None:
        if not self.up:
            return None
        self.asked.append((command, operator))
        return len(self.asked)


class StubReplies:
    def __init__(self) -> None:
        self.sent: list[tuple[Message, Reply]] = []

    def reply(self, query: Message, payload: bytes) -> None:
        self.sent.append((query, msgspec.json.decode(payload, type=Reply)))


class StubTeaching:
    """Resolves ``pick``; any goal relative to a workpiece has moved too far."""

    def __init__(self) -> None:
        self.expected: list[tuple[int, tuple[int, ...]]] = []

    def resolve(self, target: TaughtTarget) -> TransferredGoal:
        if target.relative_to is not None:
            raise TransferError("marker 12 is 8.3 px off")
        return TransferredGoal(FeatureTarget(POINTS, 7), "known to 0.1 px")

    def resolve_incidence(
        self, target: IncidenceTarget, follow: tuple[int, ...]
    ) -> tuple[IncidenceTarget, dict[str, dict[int, tuple[float, float]]]]:
        return target, {}

    def resolve_step(self, step: StepTarget, centre: Centre | None) -> TransferredGoal:
        frame = MetricFrame(step.frame, EYE, True, (0.0, 0.0, 0.0), True)
        return TransferredGoal(DisplacementTarget(EYE, 7, frame=frame), "scaled by markers of 0, 1, 0.05 m")

    def expect(self, request: int, tool: tuple[int, ...]) -> None:
        self.expected.append((request, tool))


class Bench:
    def __init__(self) -> None:
        self.link, self.replies, self.teaching = StubLink(), StubReplies(), StubTeaching()
        self.published: list[bytes] = []
        self.log = EventLog("boot", self.published.append)
        self.intake = Intake(
            KEYS,
            self.link,
            self.replies,
            self.log,
            lambda: GoalContext(example_settings(), ("pick",), None),
            self.teaching,
            "boot",
        )  # type: ignore[arg-type]

    def goal(self, goal: Goal, operator: str = "anna") -> Message:
        query = Message(KEYS.goal(operator), encode(goal))
        self.intake.goal_query(query)
        return query

    def answer(self, request: int, accepted: bool, message: str = "", plan: PlanReport | None = None) -> None:
        self.intake.on_core_reply(
            Event(9, 9, "reply", request=request, accepted=accepted, message=message, id=ID, plan=plan)
        )

    def kinds(self) -> list[str]:
        return [event.kind for event in self.log.since(1).events]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_goal_is_answered_when_the_core_has_answered(bench: Bench) -> None:
    query = bench.goal(Goal(ID, JointTarget({"j1": 0.1})))
    assert bench.replies.sent == []
    bench.answer(1, True, "accepted")
    ((asked, reply),) = bench.replies.sent
    assert asked is query
    assert (reply.accepted, reply.request, reply.id) == (True, 1, ID)
    assert bench.kinds() == ["goal_accepted"]


def test_a_goal_that_cannot_be_never_reaches_the_core(bench: Bench) -> None:
    bench.goal(Goal(ID, JointTarget({"j9": 0.1})))
    assert bench.link.asked == []
    reply = bench.replies.sent[0][1]
    assert not reply.accepted
    assert "no joint 'j9'" in reply.problems[0]


def test_a_retry_is_harmless_and_a_renewal_when_there_is_a_lease(bench: Bench) -> None:
    goal = Goal(ID, JointTarget({"j1": 0.1}))
    bench.goal(goal)
    bench.answer(1, True)
    bench.goal(goal)
    assert len(bench.link.asked) == 1
    assert [reply.accepted for _, reply in bench.replies.sent] == [True, True]
    bench.goal(msgspec.structs.replace(goal, lease_s=1.0))
    assert bench.link.asked[1][0] == RenewGoal(ID)


def test_a_refused_goal_may_be_sent_again(bench: Bench) -> None:
    goal = Goal(ID, JointTarget({"j1": 0.1}))
    bench.goal(goal)
    bench.answer(1, False, "enable first")
    bench.goal(goal)
    assert len(bench.link.asked) == 2


def test_a_taught_goal_reaches_the_core_as_set_points_with_its_epoch(bench: Bench) -> None:
    bench.goal(Goal(ID, TaughtTarget("pick"), law="stereo"))
    command = bench.link.asked[0][0]
    assert isinstance(command, RunGoal)
    assert command.goal.target == FeatureTarget(POINTS, 7)
    assert command.goal.law == "stereo"
    bench.answer(1, True, "accepted")
    assert bench.replies.sent[0][1].message == "accepted; known to 0.1 px"


def test_a_taught_goal_that_cannot_be_carried_over_is_refused_with_the_reason(bench: Bench) -> None:
    bench.goal(Goal(ID, TaughtTarget("pick", "workpiece")))
    assert bench.link.asked == []
    reply = bench.replies.sent[0][1]
    assert reply.problems == ("target: marker 12 is 8.3 px off",)
    assert reply.id == ID


def test_a_plan_is_handed_on_and_not_kept_for_retries(bench: Bench) -> None:
    goal = Goal(ID, JointTarget({"j1": 0.1}))
    plan = PlanReport("joints", "straight", 2.5, (), (0.0, 1.0), {"j1": (0.0, 0.1)}, {})
    bench.goal(goal)
    bench.answer(1, True, "accepted", plan)
    bench.goal(goal)
    assert [reply.plan for _, reply in bench.replies.sent] == [plan, None]


def test_goals_that_run_are_reported_with_set_points_and_plan_until_they_end(bench: Bench) -> None:
    plan = PlanReport("stereo", "straight", 2.5, (), (0.0, 1.0), {"j1": (0.0, 0.1)}, {})
    bench.goal(Goal(ID, TaughtTarget("pick")), "bob")
    assert bench.intake.running().goals == (), "it is not accepted yet"
    bench.answer(1, True, "accepted", plan)
    (running,) = bench.intake.running().goals
    assert (running.goal.id, running.operator, running.plan) == (ID, "bob", plan)
    assert running.goal.target == FeatureTarget(POINTS, 7), "what the taught goal was resolved to"
    moved = FeatureTarget({"left": {k: (u + 1.0, v) for k, (u, v) in POINTS["left"].items()}})
    bench.intake.goal_sample(Message(KEYS.goal("bob"), encode(UpdateGoal(ID, moved))))
    bench.answer(2, True)
    assert bench.intake.running().goals[0].goal.target == moved
    bench.intake.on_core_event(Event(10, 10, "goal_started", id=ID))
    assert bench.intake.running().goals
    bench.intake.on_core_event(Event(11, 11, "goal_reached", id=ID))
    assert bench.intake.running().goals == ()


def test_goals_have_time_to_be_planned_and_commands_have_not(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(intake_module.time, "monotonic", lambda: now)
    bench.goal(Goal(ID, JointTarget({"j1": 0.1})))
    bench.intake.command_query(Message(KEYS.command("hold", "bob"), None))
    now += intake_module.REPLY_TIMEOUT_S + 0.01
    bench.intake.expire()
    ((_, reply),) = bench.replies.sent
    assert "within 1 s" in reply.message
    now += intake_module.PLANNED_REPLY_TIMEOUT_S
    bench.intake.expire()
    assert "within 5 s" in bench.replies.sent[1][1].message


def test_streamed_set_points_and_acknowledgements_are_put_on_the_goals_key(bench: Bench) -> None:
    update = UpdateGoal(ID, FeatureTarget(POINTS), 12.5)
    bench.intake.goal_sample(Message(KEYS.goal("anna"), encode(update)))
    bench.intake.goal_sample(Message(KEYS.goal("anna"), encode(AcknowledgeGoal(ID))))
    assert bench.link.asked == [(update, "anna"), (AcknowledgeGoal(ID), "anna")]
    assert bench.kinds() == []


def test_a_stream_that_is_refused_is_reported_once_a_second(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(intake_module.time, "monotonic", lambda: now)
    wrong = encode(UpdateGoal(ID, FeatureTarget({"middle": POINTS["left"]})))
    late = encode(UpdateGoal(ID, FeatureTarget(POINTS)))
    for k in range(200):
        now = 100.0 + 0.005 * k
        bench.intake.goal_sample(Message(KEYS.goal("anna"), wrong if k % 2 else late))
        if not k % 2:
            bench.answer(len(bench.link.asked), False, "the goal has ended")
    assert bench.kinds() == ["goal_refused"]
    now = 101.5
    bench.intake.goal_sample(Message(KEYS.goal("anna"), wrong))
    assert bench.kinds() == ["goal_refused"] * 2
    assert "no camera 'middle'" in bench.log.since(2).events[0].message


def test_the_tool_of_a_taught_goal_is_remembered_with_its_request(bench: Bench) -> None:
    bench.intake.command_query(Message(KEYS.command("teach", "bob"), encode(Teach("pick", 5, (0, 1, 2)))))
    assert bench.teaching.expected == [(1, (0, 1, 2))]


def test_a_put_goal_is_reported_by_an_event_when_it_is_refused(bench: Bench) -> None:
    bench.intake.goal_sample(Message(KEYS.goal("anna"), b'{"id": "x"}'))
    bench.intake.goal_sample(Message("stereoservo/v1/demo/goal/**", encode(Goal(ID, JointTarget({"j1": 0.1})))))
    assert bench.kinds() == ["goal_refused", "goal_refused"]
    assert bench.link.asked == []
    bench.intake.goal_sample(Message(KEYS.goal("anna"), encode(RenewGoal(ID))))
    assert bench.link.asked == [(RenewGoal(ID), "anna")]


def test_commands_carry_their_operator(bench: Bench) -> None:
    bench.intake.command_query(Message(KEYS.command("hold", "bob"), None))
    assert bench.link.asked == [(Hold(), "bob")]
    bench.answer(1, True)
    assert bench.replies.sent[0][1].accepted


def test_bad_commands_are_refused_with_the_place(bench: Bench) -> None:
    bench.intake.command_query(Message(KEYS.command("jog", "bob"), b'{"velocities": {"j1": NaN}}'))
    bench.intake.command_query(Message("stereoservo/v1/demo/command/fly/bob", b""))
    bench.intake.command_query(Message(KEYS.command("jog", "bob"), b'{"velocities": {"j1": 99}}'))
    texts = [" ".join(reply.problems) for _, reply in bench.replies.sent]
    assert "NaN is not a JSON number" in texts[0]
    assert "there are: stop, enable" in texts[1]
    assert "-1 to 1 is valid" in texts[2]
    assert bench.link.asked == []


@pytest.mark.parametrize("payload", [b'{"id":5,"x":"\xff"}', b'{"id":' + b"[" * 60_000])
def test_bytes_that_no_decoder_takes_are_refused_like_any_others(bench: Bench, payload: bytes) -> None:
    bench.intake.goal_query(Message(KEYS.goal("anna"), payload))
    bench.intake.goal_sample(Message(KEYS.goal("anna"), payload))
    bench.intake.command_query(Message(KEYS.command("jog", "bob"), payload))
    assert [reply.message for _, reply in bench.replies.sent] == ["the message is not valid"] * 2
    assert bench.kinds() == ["goal_refused"]
    assert bench.intake.boundary.refusals.count == 3


def test_an_error_that_no_check_foresees_is_a_refusal(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.teaching, "resolve", lambda target: {}[target.name])
    bench.goal(Goal(ID, TaughtTarget("pick")))
    assert bench.replies.sent[0][1].problems == ("KeyError: 'pick'",)
    bench.intake.goal_sample(Message(KEYS.goal("anna"), encode(Goal(ID, TaughtTarget("pick")))))
    assert bench.kinds() == ["goal_refused"]
    assert bench.link.asked == []


def test_a_look_around_with_a_wildcard_commands_nothing(bench: Bench) -> None:
    for key in ("stereoservo/v1/demo/**", "stereoservo/v1/demo/command/*/bob"):
        query = Message(key, b"")
        bench.intake.command_query(query)
        bench.intake.goal_query(query)
        assert query.dropped
    assert (bench.link.asked, bench.replies.sent, bench.kinds()) == ([], [], [])


def test_an_unanswered_request_is_answered_at_its_deadline_and_a_late_answer_is_dropped(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(intake_module.time, "monotonic", lambda: now)
    bench.intake.command_query(Message(KEYS.command("hold", "bob"), None))
    bench.intake.expire()
    assert bench.replies.sent == []
    now += intake_module.REPLY_TIMEOUT_S + 0.01
    bench.intake.expire()
    assert "did not answer" in bench.replies.sent[0][1].message
    bench.answer(1, True)
    assert len(bench.replies.sent) == 1


def test_a_servo_process_that_is_gone_means_refused(bench: Bench) -> None:
    bench.link.up = False
    bench.goal(Goal(ID, JointTarget({"j1": 0.1})))
    assert "does not take requests" in bench.replies.sent[0][1].message


def test_the_event_log_numbers_without_gaps_and_pages() -> None:
    log = EventLog("boot", lambda payload: None)
    for k in range(700):
        log.add("warning", message=str(k))
    first = log.since(1)
    assert (first.first, first.next, len(first.events)) == (1, 301, 300)
    rest = log.since(first.next)
    last = log.since(rest.next)
    assert last.next == 701
    assert [e.seq for e in (*first.events, *rest.events, *last.events)] == list(range(1, 701))
    assert log.since(10**6) == log.since(701)
    assert log.since(701).events == ()
    assert log.since(701).next == 701


def test_a_flood_of_refused_puts_is_a_few_events_with_the_number_of_the_rest(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(intake_module.time, "monotonic", lambda: now)
    for k in range(8000):
        now = 100.0 + 0.001 * k
        bench.intake.goal_sample(Message(KEYS.goal("mallory"), b'{"id": "\xff'))
    assert 10 <= len(bench.kinds()) <= 20
    messages = [event.message for event in bench.log.since(1).events]
    assert "are not reported" not in messages[9]
    assert "refusals before it are not reported" in messages[-1]
    assert bench.intake.boundary.refusals.count == 8000
    now += 60.0
    bench.intake.goal_sample(Message(KEYS.goal("anna"), b"{"))
    assert len(bench.kinds()) == len(messages) + 1


def test_a_step_goes_to_the_core_in_its_frame_and_is_listed_as_set_points_that_former_clients_read(
    bench: Bench,
) -> None:
    bench.goal(Goal(ID, StepTarget("base", (0.0, 0.0, 0.02))))
    ((command, _),) = bench.link.asked
    assert isinstance(command, RunGoal)
    assert command.goal.target.frame.name == "base"  # type: ignore[union-attr]
    pixels = {"left": {0: ((10.0, 10.0), (12.0, 11.0)), 1: ()}}
    bench.answer(1, True, "accepted", PlanReport("cartesian3", "straight", 1.0, (), (0.0, 1.0), {}, pixels))
    assert bench.replies.sent[0][1].message == "accepted; scaled by markers of 0, 1, 0.05 m"
    (running,) = bench.intake.running().goals
    assert running.goal.target == FeatureTarget({"left": {0: (12.0, 11.0)}}, 7)
