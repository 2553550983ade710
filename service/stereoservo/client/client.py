"""Goal client for one cell: sends goals and commands, runs calibrations and model checks, and subscribes to states,
events and features.

Every call either succeeds or raises; a missing reply counts as a refusal.
"""

from __future__ import annotations

import itertools
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Literal, TypedDict, Unpack

import msgspec
from zenoh.handlers import RingChannel

from stereoservo.client.connection import NEXT_EVENT, Connection, read_message
from stereoservo.client.errors import ClientError, DaemonLostError, FailedError, TimedOutError
from stereoservo.client.events import POLL_S, EventWatch, HeardEvents
from stereoservo.client.goal_handle import GoalHandle, Lease
from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.goals import (
    AdaptiveGain,
    Calibrate,
    Centre,
    Disable,
    Enable,
    FeatureTarget,
    Goal,
    Hold,
    Home,
    JacobianName,
    Jog,
    JointTarget,
    LawName,
    OrderAuxiliary,
    PointSource,
    ProfileName,
    Reset,
    Resume,
    StepTarget,
    Stop,
    Target,
    TaughtTarget,
    Teach,
)
from stereoservo.messages.learning import LearningState
from stereoservo.messages.wire import (
    CalibrationResult,
    CellInfo,
    EventMessage,
    FeaturesMessage,
    Record,
    Reply,
    Restore,
    RunningGoal,
    RunningGoals,
    StateMessage,
    Synthesise,
    decode,
    encode,
)

DRAIN = 32
"""Largest number of messages of one kind per poll, so that events caused by the caller do not starve the others."""
GOAL_TIMEOUT_S = 7.0
"""Time limit of a goal's reply [s]: it is planned first; the daemon gives up after five seconds."""
RESET_TIMEOUT_S = 12.0
"""Time limit of a reset [s]: drives are connected and configured again; the daemon gives up after ten seconds."""


class Client(Connection):
    """Goal client of one cell: goals, commands, calibration, and messages of its daemon.

    ``cell``: name, or the path of a cell file. ``endpoint``: a zenoh endpoint; default: the daemon of this host.
    ``tls``: directory with ``ca.pem``, ``cert.pem``, ``key.pem`` (default: ``$STEREOSERVO_TLS_DIR``).
    ``while_waiting``: called repeatedly during waits for an event; an exception that it raises ends the wait.

    Raises NotRunningError, SessionError.
    """

    def info(self) -> CellInfo:
        """Joints, cameras, laws, model and taught goals."""
        return self.fetch(self.keys.info, CellInfo)

    def running_goals(self) -> tuple[RunningGoal, ...]:
        """Accepted goals of all operators that have not ended, with set-points and plans, the oldest first."""
        return self.fetch(self.keys.goals, RunningGoals).goals

    def schema(self, name: str) -> bytes:
        """The JSON Schema of a message."""
        return self.query(self.keys.schema(name))

    def stop(self, operator: str | None = None) -> Reply:
        """Stop the arm on behalf of ``operator`` (default: this client's operator).

        Raises RefusedError if the servo process did not acknowledge the stop, NoReplyError.
        """
        stop = Stop(self.operator if operator is None else operator)
        return self.request("stop", self.keys.stop, encode(stop))

    def joints(self) -> dict[str, float]:
        """Positions of the joints by name [rad or m]. Raises ClientError if the drives do not report them."""
        state = self.status()
        if not state.joints:
            age = "" if state.joints_age_s is None else f"; the last ones are {state.joints_age_s:.1f} s old"
            raise ClientError(
                f"where the joints are is unknown: the drives tell no positions{age}. See `stereoservo status "
                f"{self.cell}`"
            )
        return state.joints

    def enable(self, timeout_s: float = 10.0) -> None:
        """Enable motion of the arm; returns once it is ACTIVE. Raises RefusedError, TimedOutError."""
        self.command("enable", Enable())
        self.wait_state(lambda state: state.lifecycle in ("active", "fault"), "active", timeout_s)
        if self.status().lifecycle == "fault":
            raise ClientError(
                "the joint driver failed while it was enabled: " + "; ".join(r.hint for r in self.status().reasons)
            )

    def disable(self) -> Reply:
        """Stop the arm and switch its drives off."""
        return self.command("disable", Disable())

    def hold(self) -> Reply:
        """Decelerate and hold; the goal is kept."""
        return self.command("hold", Hold())

    def resume(self) -> Reply:
        """Continue after hold or stop."""
        return self.command("resume", Resume())

    def reset(self, timeout_s: float = RESET_TIMEOUT_S) -> None:
        """Leave FAULT; returns once the cell is INACTIVE. Raises RefusedError, TimedOutError, ClientError (failed)."""
        number = self.events(NEXT_EVENT).next
        self.request("reset", self.keys.command("reset", self.operator), encode(Reset()), timeout_s)
        until = time.monotonic() + timeout_s
        while time.monotonic() < until:
            news = self.events(number)
            for event in news.events:
                if event.kind == "fault":
                    raise ClientError(f"the reset failed: {event.message}")
                if event.kind == "lifecycle" and event.name == "inactive":
                    self.wait_state(lambda state: state.lifecycle != "fault", "out of the fault", timeout_s)
                    return
            number = news.next
            time.sleep(0.02)
        raise TimedOutError(f"the cell is {self.status().lifecycle} {timeout_s:g} s after the reset")

    def jog(self, velocities: Mapping[str, float], lease_s: float = 0.25) -> Reply:
        """Jog: joint velocities for ``lease_s``; call again within this time to continue (dead man's switch)."""
        return self.command("jog", Jog(dict(velocities), lease_s))

    def auxiliary(self, values: Mapping[str, float]) -> Reply:
        """Command auxiliary joints [rad or m] and digital outputs (0 or 1) by name; the state reports when they are
        reached.

        Raises RefusedError.
        """
        return self.command("auxiliary", OrderAuxiliary(dict(values)))

    def record(self, on: bool = True, images: bool = False) -> Reply:
        """Start or stop a flight recording; the reply's message is its file on the daemon's host.

        ``images``: also record the camera images, in ``NAME.images`` next to it; the event ``images_recorded`` reports
        their end. Raises RefusedError.
        """
        return self.request("record", self.keys.command("record", self.operator), encode(Record(on, images)))

    def wait_state(self, wanted: Callable[[StateMessage], bool], what: str, timeout_s: float) -> StateMessage:
        """Poll the state until ``wanted`` returns True; ``what`` names it in the error. Raises TimedOutError."""
        until = time.monotonic() + timeout_s
        while True:
            state = self.status()
            if wanted(state):
                return state
            if time.monotonic() > until:
                raise TimedOutError(f"the cell is {state.lifecycle} and not {what} after {timeout_s:g} s")
            time.sleep(0.02)

    # -- goals ----------------------------------------------------------------------------------------------

    def goal(
        self,
        target: Target | str | Mapping[str, Any],
        **options: Unpack[GoalOptions],
    ) -> GoalHandle:
        """Send a goal: a target, the name of a taught goal, joint positions by name, or set-points by camera.

        ``lease_s``: 5 by default. A thread of this client renews the lease until the goal has ended or the client is
        closed: if the client dies, the arm stops. ``lease_s=None``: the goal continues without the client. Raises
        RefusedError with all problems, NoReplyError, MessageError.
        """
        options.setdefault("lease_s", 5.0)
        return self.send(self.make_goal(target, **options))

    def move(
        self,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        *,
        frame: str = "tool",
        length: str = "",
        **options: Unpack[GoalOptions],
    ) -> GoalHandle:
        """Move what the arm carries by ``x``, ``y``, ``z`` [m] along the axes of ``frame``: ``tool``, ``base``,
        ``camera:NAME`` or ``scene:A-B-C``.

        ``length``: a known length, ``markers:10,11=0.05`` say, if the cell states none. Raises as :meth:`goal`.
        """
        return self.goal(StepTarget(frame, move=(x, y, z), length=length), **options)

    def turn(
        self,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        *,
        frame: str = "tool",
        **options: Unpack[GoalOptions],
    ) -> GoalHandle:
        """Turn what the arm carries by the rotation vector ``x``, ``y``, ``z`` [rad] in the axes of ``frame``, as in
        :meth:`move`, about the middle of the markers or the option ``centre``. Raises as :meth:`goal`.
        """
        return self.goal(StepTarget(frame, turn=(x, y, z)), **options)

    @staticmethod
    def make_goal(target: Target | str | Mapping[str, Any], **options: Unpack[GoalOptions]) -> Goal:
        """A goal with a new id, for :meth:`check` and :meth:`send`. Raises MessageError for bad fields."""
        return decode(encode({"id": str(uuid.uuid4()), "target": as_target(target), **options}), Goal)

    def check(self, goal: Goal) -> Reply:
        """Plan a goal without motion: the reply's ``plan`` has path, duration and closest approaches to limits.

        Raises RefusedError.
        """
        return self.request("goal", self.goal_key, encode(msgspec.structs.replace(goal, check=True)), GOAL_TIMEOUT_S)

    def send(self, goal: Goal) -> GoalHandle:
        """Send a goal created by the caller; returns once it is planned and accepted."""
        watch = EventWatch(self)
        try:
            reply = self.request("goal", self.goal_key, encode(goal), GOAL_TIMEOUT_S)
        except BaseException:
            watch.close()
            raise
        return GoalHandle(self, goal, watch, reply)

    def home(self, speed_scale: float = 1.0, lease_s: float | None = 5.0) -> GoalHandle:
        """Move every joint to the cell's home position; the lease is renewed as for goals."""
        command = Home(str(uuid.uuid4()), speed_scale, lease_s)
        watch = EventWatch(self)
        try:
            reply = self.command("home", command)
        except BaseException:
            watch.close()
            raise
        return GoalHandle(self, Goal(command.id, JointTarget({}), lease_s=lease_s), watch, reply)

    def teach(
        self, name: str, frames: int = 20, timeout_s: float = 30.0, *, tool: tuple[int, ...] = ()
    ) -> EventMessage:
        """Store the current observations as goal ``name``; ``tool``: the markers that define it.

        Raises RefusedError, FailedError.
        """
        with EventWatch(self) as watch:
            reply = self.command("teach", Teach(name, frames, tool))
            event = watch.wait(
                lambda e: e.request == reply.request and e.kind in ("taught", "warning"),
                f"teaching {name!r}",
                timeout_s,
            )
        if event.kind != "taught":
            raise FailedError(f"teaching {name!r}", event)
        return event

    def synthesise(self, wanted: Synthesise) -> Reply:
        """Make a goal from CAD drawings; the workpiece's markers must be in view. Raises RefusedError."""
        return self.request("synthesise", self.keys.command("synthesise", self.operator), encode(wanted))

    def undo_refinement(self) -> Reply:
        """Restore the calibrated model from which the model in use was refined on-line. Raises RefusedError."""
        return self.request("undo refinement", self.keys.command("restore", self.operator), encode(Restore()))

    def calibrate(
        self,
        progress: Callable[[EventMessage], None] | None = None,
        timeout_s: float = 3600.0,
        *,
        report: bool = False,
        lease_s: float | None = 5.0,
        learning: Callable[[LearningState], None] | None = None,
    ) -> CalibrationResult:
        """Calibrate the cell. ``progress`` is called with each event of the calibration, ``learning`` with its state
        as it is published. ``report``: wait for the report, too.

        The motion has a lease that this client renews (``lease_s=None``: none): if the client dies, the motion stops.
        Raises RefusedError, FailedError (``code``: of the failed fit, or of the reason that ended the motion).
        """
        with ExitStack() as watched:
            if learning is not None:
                watched.enter_context(_watched_learning(self, learning))
            return calibrate(self, progress, timeout_s, report=report, lease_s=lease_s)

    def check_model(
        self,
        progress: Callable[[EventMessage], None] | None = None,
        timeout_s: float = 600.0,
        *,
        lease_s: float | None = 5.0,
        quick: bool = False,
    ) -> CheckReport:
        """Run a short check motion and test whether the model is still valid. Raises RefusedError, FailedError.

        ``quick``: at most three seconds of motion, around the present posture.
        """
        return check_model(self, progress, timeout_s, lease_s, quick=quick)

    def reset_zeros(
        self,
        progress: Callable[[EventMessage], None] | None = None,
        timeout_s: float = 600.0,
        *,
        lease_s: float | None = 5.0,
    ) -> ZeroReset:
        """Run a check motion; if only joint zeros have drifted, install a model with corrected zeros.

        ``progress`` is also called with the ``checked`` event. Raises RefusedError, FailedError (its event's ``name``:
        ``check_holds``, ``other_cause``, ``not_observable`` or the code of a check that failed).
        """
        return reset_zeros(self, progress, timeout_s, lease_s)

    # -- watching -------------------------------------------------------------------------------------------

    def watch(
        self, *, features: bool = False, every_s: float = 0.0
    ) -> Iterator[StateMessage | EventMessage | FeaturesMessage]:
        """Iterate over all messages of the cell, without end; raises DaemonLostError if the daemon disappears,
        InvalidReplyError.

        With ``every_s`` [s], messages are polled at this interval, and only the newest markers of each camera are
        returned: this saves processor time for displays.
        """
        kinds: list[tuple[str, type[Any], int]] = [
            (self.keys.event, EventMessage, 1024),
            (self.keys.state, StateMessage, 16),
        ]
        if features:
            kinds.append((f"{self.keys.prefix}/features/*", FeaturesMessage, 256))
        subscribers = [(self._session.declare_subscriber(key, RingChannel(size)), kind) for key, kind, size in kinds]
        last_heard_s = time.monotonic()
        try:
            while True:
                arrived = [
                    (str(sample.key_expr), sample.payload, kind)
                    for subscriber, kind in subscribers
                    for sample in itertools.islice(iter(subscriber.try_recv, None), DRAIN)
                ]
                if arrived:
                    last_heard_s = time.monotonic()
                elif time.monotonic() - last_heard_s > 2.0:
                    raise DaemonLostError(f"cell {self.cell!r} has been silent for 2 s")
                for key, payload, kind in with_newest_markers(arrived) if every_s else arrived:
                    yield read_message(key, payload.to_bytes(), kind)
                if every_s or not arrived:
                    time.sleep(every_s or POLL_S)
        finally:
            for subscriber, _ in subscribers:
                subscriber.undeclare()


def with_newest_markers(arrived: list[tuple[str, Any, type[Any]]]) -> list[tuple[str, Any, type[Any]]]:
    """Messages (key, payload, kind), the oldest first; of the marker messages only the last of each key."""
    last = {key: k for k, (key, _, _) in enumerate(arrived)}
    return [
        (key, payload, kind)
        for k, (key, payload, kind) in enumerate(arrived)
        if kind is not FeaturesMessage or last[key] == k
    ]


# -- calibration requests ------------------------------------------------------------------------------------
# Requests of a client to calibrate a cell, check its model or reset joint zeros: run the motion under a lease and
# wait for the result.


REPORT_TIMEOUT_S = 120.0


@contextmanager
def _watched_learning(connection: Connection, learning: Callable[[LearningState], None]) -> Iterator[None]:
    """Call ``learning`` with the newest progress of the calibration that is published during waits."""
    subscriber = connection.session.declare_subscriber(connection.keys.state, RingChannel(1))
    before = connection.while_waiting

    def look() -> None:
        before()
        if (sample := subscriber.try_recv()) is not None:
            state = read_message(str(sample.key_expr), sample.payload.to_bytes(), StateMessage)
            if state.learning is not None:
                learning(state.learning)

    connection.while_waiting = look
    try:
        yield
    finally:
        connection.while_waiting = before
        subscriber.undeclare()


Progress = Callable[[EventMessage], None]


def calibrate(
    connection: Connection,
    progress: Progress | None,
    timeout_s: float,
    *,
    report: bool,
    lease_s: float | None,
) -> CalibrationResult:
    """Implementation of `Client.calibrate`."""
    command = Calibrate(str(uuid.uuid4()), lease_s=lease_s)
    event = _run(connection, command, "calibrated", progress, timeout_s, report)
    if event.calibration is None:
        raise FailedError("calibration", event)
    return event.calibration


def check_model(
    connection: Connection, progress: Progress | None, timeout_s: float, lease_s: float | None, *, quick: bool
) -> CheckReport:
    """Implementation of `Client.check_model`."""
    command = Calibrate(str(uuid.uuid4()), check=True, lease_s=lease_s, quick=quick)
    event = _run(connection, command, "checked", progress, timeout_s, False)
    if event.check is None:
        raise FailedError("check", event)
    return event.check


def reset_zeros(
    connection: Connection, progress: Progress | None, timeout_s: float, lease_s: float | None
) -> ZeroReset:
    """Implementation of `Client.reset_zeros`."""
    command = Calibrate(str(uuid.uuid4()), check=True, lease_s=lease_s, reset_zeros=True)
    event = _run(connection, command, "zeros_reset", progress, timeout_s, False)
    if event.reset is None:
        raise FailedError("reset of joint zeros", event)
    return event.reset


def _run(
    connection: Connection,
    command: Calibrate,
    success: str,
    progress: Progress | None,
    timeout_s: float,
    report: bool,
) -> EventMessage:
    lease: Lease | None = None

    def hear(event: EventMessage) -> None:
        if lease is not None and event.kind in ("calibration_finished", "check_finished"):
            lease.end()
        if progress is not None:
            progress(event)

    with EventWatch(connection) as watch:
        heard = HeardEvents(watch, lambda event: event.id == command.id, hear)
        connection.command("calibrate", command)
        lease = Lease(connection, command.id, command.lease_s)
        try:
            end = heard.wait((success, "calibration_failed", "calibration_aborted"), "calibration", timeout_s)
        finally:
            lease.end()
        if report and end.kind != "calibration_aborted":
            with suppress(TimedOutError):  # the model exists; an event announces its report, if there is one
                heard.wait(("calibration_report",), "the report", REPORT_TIMEOUT_S)
    return end


# -- targets -------------------------------------------------------------------------------------------------
# Short forms of a goal's target (name, joint positions or set-points) and options, converted to messages.


class GoalOptions(TypedDict, total=False):
    """Fields of `Goal` except id and target; the cell's defaults apply to omitted ones."""

    law: LawName | None
    points: PointSource | None
    jacobian: JacobianName | None
    centre: Centre | None
    cameras: tuple[str, ...] | None
    profile: ProfileName | None
    posture: dict[str, float] | None
    gain: float | AdaptiveGain | None
    damping: float | None
    tolerance_px: float | None
    hold_frames: int | None
    speed_scale: float
    lease_s: float | None
    time_limit_s: float | None
    mode: Literal["preempt", "queue"]
    blend_px: float | None
    acknowledge_s: float | None
    follow_markers: tuple[int, ...]


def as_target(target: Target | str | Mapping[str, Any]) -> Target:
    """A target from its short form: a taught goal's name, positions by joint, or set-points by camera."""
    if isinstance(target, str):
        return TaughtTarget(target)
    if isinstance(target, Mapping):
        if all(isinstance(value, Mapping) for value in target.values()) and target:
            return FeatureTarget(
                {
                    camera: {int(marker): (float(u), float(v)) for marker, (u, v) in points.items()}
                    for camera, points in target.items()
                }
            )
        return JointTarget({str(name): float(value) for name, value in target.items()})
    return target
