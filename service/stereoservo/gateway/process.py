"""The gateway process: connects zenoh clients with the servo process, and stores models, taught goals and recordings.

The arm waits for nothing here; if the gateway is silent, the arm holds. ``python -m stereoservo.gateway.process
RUNTIME_DIRECTORY PARENT_PID``.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import zenoh
from zenoh.handlers import RingChannel

from stereoservo.client.session import SessionError, close_session, open_session
from stereoservo.control.law_registry import LAWS
from stereoservo.core.cycle import Event
from stereoservo.daemon.channels.reports import ReportIntake
from stereoservo.daemon.heartbeat import (
    GATEWAY_HANG_S,
    REQUEST_S,
    SUPERVISOR_HANG_S,
    VISION_HANG_S,
    HeartbeatReader,
    HeartbeatWriter,
)
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_LAYOUT,
    PlanError,
    Report,
    RunPlan,
    ServoState,
    decode_observation,
    load_plan,
)
from stereoservo.daemon.process_control import Termination, die_with_parent, write_log
from stereoservo.daemon.seqlock import SlotError, SlotReader
from stereoservo.gateway.calibration_jobs import CalibrationJobs
from stereoservo.gateway.intake import Intake, StopThread, payload_of
from stereoservo.gateway.model_updates import RefinementJobs, RelocalizationJobs
from stereoservo.gateway.observation_cache import ObservationCache
from stereoservo.gateway.persistence import HandledEvents, Journal, ModelStore, OpenGoalRecord, TaughtStore
from stereoservo.gateway.publisher import (
    SILENT,
    EventLog,
    OperatorNotes,
    Previews,
    Publishers,
    ReplyThread,
    cell_info,
    features_message,
)
from stereoservo.gateway.recordings import CannotRecordError, Recordings
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.gateway.teaching import TaughtGoalRegistry
from stereoservo.gateway.validation import GoalContext
from stereoservo.gateway.zenoh_config import (
    endpoint_of,
    gateway_config,
    prepare_runtime,
    split_listeners,
    stop_config,
)
from stereoservo.kinematics.model import CellModel, encode_model
from stereoservo.messages.decoding import RecordBoundary
from stereoservo.messages.directories import CellDirectories, DirectoryError
from stereoservo.messages.discovery import DaemonInfo
from stereoservo.messages.files import write_atomically
from stereoservo.messages.keys import VERBS, KeySpace
from stereoservo.messages.learning import LearningState
from stereoservo.messages.reasons import Level, Reason
from stereoservo.messages.run_record import read_run
from stereoservo.messages.servo_state import silence_limit_s, state_message
from stereoservo.messages.status import Halt
from stereoservo.messages.wire import (
    CellInfo,
    EventMessage,
    MessageError,
    Record,
    Reply,
    Restore,
    StateMessage,
    Synthesise,
    decode,
    encode,
    schema,
)
from stereoservo.ports.devices import CameraDescription

STATE_EVERY_S = 0.05
STEPS_EVERY_S = 0.05
"""Interval of reading step records [s]: their ring holds several seconds, and a batch costs less than single reads."""
IDLE_S = 0.003
"""Sleep between passes without news [s]."""
REST_S = 0.006
"""The same if no client and no event has been active for ``REST_AFTER_S``; a stop has its own thread."""
REST_AFTER_S = 1.0
FINAL_PASSES = 100
LAST_EVENTS_S = 3.0
"""Time to wait for the last events of a servo process whose supervisor was killed: it stops the arm before it ends."""
DRAIN = 32
ANNOUNCE_RETRY_S = 1.0
EXIT_SETUP = 3
ONCE = frozenset({"taught", "calibration_finished", "check_finished", "reanchor", "camera_adjusted", "fault"})
"""Events of the core whose effects must not happen twice."""
SUPERVISOR_SILENT = (
    f"the supervisor has given no sign of life for {SUPERVISOR_HANG_S:g} s: it hangs or was stopped (Ctrl-Z, SIGSTOP). "
    "The arm and every stop work as before, but a process that hangs is not killed and one that ends is not started "
    "again: let it go on (`kill -CONT` its process), or stop the arm, end the daemon and run the cell again"
)
GATEWAY_VERBS = ("record", "synthesise", "restore")
"""Commands that the gateway executes itself."""


class Gateway:
    """State of the gateway process; ``run_once`` is one pass of its loop."""

    def __init__(self, plan: RunPlan) -> None:
        self.plan = plan
        self.settings = plan.settings()
        directories = plan.directories
        self.boot = f"{plan.boot}-{os.getpid()}"
        cell_dir = Path(plan.cell_path).parent
        self._models = ModelStore(directories.models)
        self._journal = Journal(directories.journal)
        self.keys = KeySpace(plan.cell.cell.name)
        cameras = tuple(camera.name for camera in plan.cameras)
        local, network = split_listeners(gateway_config(plan.cell, cell_dir, directories.zenoh_socket))
        self._session = open_session(local)
        self._network = None if network is None else open_session(network)
        self.endpoint = endpoint_of(plan.cell, directories.zenoh_socket)
        self._repeated = False
        self._publishers = Publishers(self._session, self.keys, cameras)
        self.goals = OpenGoalRecord(directories, plan.boot)
        self.log = EventLog(self.boot, self._publish_event, self._observe_event)
        self._notes = OperatorNotes(self.log, plan.joints.notes)
        self._servo = ServoConnection(directories)
        self._replies = ReplyThread()
        known_length = "" if plan.cell.calibration is None else plan.cell.calibration.known_length
        self._calibration = CalibrationJobs(
            self.settings,
            self._models,
            self._servo,
            self.log,
            directories.checks,
            known_length,
            directories.runtime,
        )
        self._relocalization = RelocalizationJobs(
            self._models, self._servo, self.log, lambda: self._calibration.model, self._use_model
        )
        self._marker_cache = ObservationCache({camera.name: camera.systematic_px for camera in self.settings.cameras})
        taught = TaughtStore(directories.taught, self._models.of_epoch, self._notes.set_note)
        self._teaching = TaughtGoalRegistry(
            taught, self._marker_cache, lambda: self._calibration.model, self.log, known_length
        )
        self._intake = Intake(self.keys, self._servo, self._replies, self.log, self._context, self._teaching, self.boot)
        self._refinement = RefinementJobs(
            self.settings, plan.cell.calibration is not None and plan.cell.calibration.refine, self._models,
            self._servo, self.log, self._calibration, self._relocalization, taught, self._intake.running,
        )  # fmt: skip
        self._reports = ReportIntake(directories.reports_socket)
        slots = [directories.observation_slot(name) for name in cameras]
        log = partial(write_log, "gateway")
        self._observations = [(SlotReader(slot, OBSERVATION_LAYOUT), RecordBoundary(slot.name, log)) for slot in slots]
        self._previews = Previews(self._publishers.previews, directories)
        self._preview_boundary = RecordBoundary("preview pictures", log)
        self._declare()
        self._stop = StopThread(stop_config(plan.cell, cell_dir, directories.zenoh_socket), self.keys, plan, self.boot)
        self._state = CellState(plan, self.boot, self._servo)
        self._state_sent = self._steps_recorded = 0.0
        self._recordings = Recordings(plan, self.log, self._notes.set_note)
        self._servo.records = self._recordings.wants_steps
        self._handled = HandledEvents(directories.runtime / "handled.slot", self._notes.set_note)
        self._greeted = False
        self._announce_due_s: float | None = 0.0
        self._heartbeat = HeartbeatWriter(directories.heartbeat_slot("gateway"))
        self._supervisor = HeartbeatReader(directories.heartbeat_slot("supervisor"))
        self.goals.end_earlier(self.log)
        run = read_run(directories)
        if run is not None and run.boot == plan.boot and run.previous:
            self._notes.set_note("run before", f"the run before this one ended: {run.previous}")

    def _declare(self) -> None:
        session, keys = self._session, self.keys
        self._goal_puts = session.declare_subscriber(keys.any_goal, RingChannel(64))
        self._goal_queries = session.declare_queryable(keys.any_goal, RingChannel(64))
        self._command_queries = [
            session.declare_queryable(keys.any_command(verb), RingChannel(32))
            for verb in VERBS
            if verb not in ("enable", *GATEWAY_VERBS)
        ]
        self._gateway_queries = [
            session.declare_queryable(keys.any_command(verb), RingChannel(32)) for verb in GATEWAY_VERBS
        ]
        self._any_command_queries = session.declare_queryable(keys.any_command_at_all, RingChannel(32))
        self._event_queries = session.declare_queryable(keys.event, RingChannel(32))
        self._state_queries = session.declare_queryable(keys.state, RingChannel(32))
        self._info_queries = session.declare_queryable(keys.info, RingChannel(32))
        self._schema_queries = session.declare_queryable(keys.any_schema, RingChannel(32))
        self._model_queries = session.declare_queryable(keys.model, RingChannel(32))
        self._running_queries = session.declare_queryable(keys.goals, RingChannel(32))
        self._sources: tuple[tuple[Any, Callable[[Any], None]], ...] = (
            (self._goal_puts, self._intake.goal_sample),
            (self._goal_queries, self._intake.goal_query),
            *((queryable, self._intake.command_query) for queryable in self._command_queries),
            *((queryable, partial(self._answer, work=self._gateway_command)) for queryable in self._gateway_queries),
            (self._event_queries, partial(self._answer, work=self._events_from, key=self.keys.event)),
            (self._state_queries, partial(self._answer, work=self._newest_state, key=self.keys.state)),
            (
                self._info_queries,
                partial(self._answer, work=lambda _: encode(self.info()), key=self.keys.info),
            ),
            (self._schema_queries, partial(self._answer, work=self._schema)),
            (self._any_command_queries, self._answer_wrong_key),
            (self._model_queries, partial(self._answer, work=self._model, key=self.keys.model)),
            (
                self._running_queries,
                partial(self._answer, work=lambda _: encode(self._intake.running()), key=self.keys.goals),
            ),
        )
        self._alive = session.liveliness().declare_token(keys.alive)

    def _publish_event(self, payload: bytes) -> None:
        if not self._repeated:
            self._journal.add(payload)
        self._publishers.event.put(payload)

    def _observe_event(self, message: EventMessage) -> None:
        self.goals.observe(message, repeated=self._repeated)

    def _use_model(self, model: CellModel) -> None:
        """Use ``model``, made for moved cameras, now that the core has applied it."""
        self._calibration.model = model

    def _context(self) -> GoalContext:
        model = self._calibration.model
        markers = None if model is None else model.marker_ids
        return GoalContext(self.settings, self._teaching.names, markers, self.plan.joints.auxiliary)

    # -- the loop -------------------------------------------------------------------------------------------

    def run_once(self) -> bool:
        """Run one pass; returns whether there was anything to do."""
        self._servo.poll_connection()
        if self._servo.connected and self._state.newest is not None and not self._greeted:
            self._greeted = True
            self._calibration.load(self._state.newest.status.model_epoch)
            self._refinement.complete_replacement()
        events = self._servo.events()
        if events:  # a client that receives an event finds no older state
            self._read_state()
        for event in events:
            self._on_core_event(event)
        self._intake.expire()  # after the answers that arrived while this process was suspended
        busy = self._queries() or bool(events)
        self._publish_features()
        with self._preview_boundary:
            self._previews.poll()
        self._publish_state()
        self._reports.poll(self._on_report)
        if time.monotonic() - self._steps_recorded >= STEPS_EVERY_S:
            self._record_steps()
        self._recordings.poll()
        self.goals.poll()
        self._calibration.poll()
        self._relocalization.poll()
        self._refinement.poll()
        self._announce()
        if self._announce_due_s is None:
            self._heartbeat.beat(GATEWAY_HANG_S)
        return busy

    def _record_steps(self, limit: int = 512) -> None:
        self._steps_recorded = time.monotonic()
        for item in self._servo.steps(limit):
            self._recordings.take(item)
        if self._recordings.refused:  # the next request to record starts a new one
            self._recordings.refused = False
            self._servo.records = self._recordings.wants_steps

    def _queries(self) -> bool:
        busy = False
        for source, take in self._sources:
            for _ in range(DRAIN):
                item = source.try_recv()
                if item is None:
                    break
                if not busy and self._announce_due_s is None:
                    self._heartbeat.beat(REQUEST_S)
                busy = True
                take(item)
        if busy and self._announce_due_s is None:
            self._heartbeat.beat(GATEWAY_HANG_S)  # a hang from here on is no request's
        while self._stop.enables:
            self._intake.command_query(self._stop.enables.popleft())
        return busy

    def _answer_wrong_key(self, query: Any) -> None:
        """Refuse ``query`` with the list of commands if its key matches none; else the matching command replies."""
        asked = str(query.key_expr)
        if "*" in asked or asked == self.keys.stop or self.keys.is_command(asked):
            query.drop()
        else:
            self._answer(query, self._gateway_command)

    def _answer(self, query: Any, work: Callable[[Any], bytes], key: str = "") -> None:
        """Reply to ``query`` with the result of ``work``, on ``key`` (default: the query's own key, if concrete)."""
        asked = str(query.key_expr)
        if not key and "*" in asked:
            query.drop()
            return
        self._intake.boundary.take(
            asked,
            lambda: self._replies.reply(query, work(query), key),
            lambda refusal: self._replies.reply(query, encode(refusal), key),
        )

    def _gateway_command(self, query: Any) -> bytes:
        payload = payload_of(query) or b"{}"
        verb, _ = self.keys.command_of(str(query.key_expr))
        if verb == "record":
            return encode(self._record(decode(payload, Record)))
        if verb == "restore":
            decode(payload, Restore)
            return encode(Reply(True, self._refinement.restore(), boot=self.boot))
        return encode(Reply(True, self._teaching.synthesise(decode(payload, Synthesise)), boot=self.boot))

    def _record(self, request: Record) -> Reply:
        try:
            if request.on and request.images:
                self._recordings.want_images()
        except CannotRecordError as error:
            return Reply(False, "there are no images to record", problems=(str(error),), boot=self.boot)
        self._record_steps()  # earlier ones belong to the recording so far
        if not request.on:
            text = self._recordings.stop()
            self._servo.records = self._recordings.wants_steps
            return Reply(True, text, boot=self.boot)
        if self._recordings.running:
            return Reply(True, f"recording into {self._recordings.path}", boot=self.boot)
        self._recordings.request()
        self._servo.restart_steps()
        self._servo.records = True
        return Reply(True, "recording begins; its event names the file", boot=self.boot)

    def _events_from(self, query: Any) -> bytes:
        given = str(query.parameters)
        number = dict(part.split("=", 1) for part in given.split(";") if "=" in part).get("from", "1")
        if not (number.isascii() and number.isdigit() and len(number) < 20):
            raise MessageError(f"from={number[:40]}: a number is valid, 1 to {self.log.last + 1}")
        return encode(self.log.since(int(number)))

    def _newest_state(self, query: Any) -> bytes:
        state = self._newest_message()
        if state is None:
            return encode(Reply(False, "the servo process has shown no state yet", boot=self.boot))
        return encode(state)

    def _schema(self, query: Any) -> bytes:
        return schema(self.keys.schema_of(str(query.key_expr)), tuple(LAWS))

    def _model(self, query: Any) -> bytes:
        model = self._calibration.model
        if model is None:
            return encode(Reply(False, "there is no model; `calibrate` makes one", boot=self.boot))
        return encode_model(msgspec.structs.replace(model, covariance=None, loads=None))

    def info(self) -> CellInfo:
        """Description of the cell, as served on ``info``."""
        model = self._calibration.model
        return cell_info(
            self.settings,
            self.boot,
            model,
            None if model is None else self._models.path(model.epoch),
            self._teaching.goals,
            self._recordings.path if self._recordings.running else "",
            self.plan,
        )

    # -- events of the core --------------------------------------------------------------------------------

    def _on_core_event(self, event: Event) -> None:
        if event.kind == "reply":
            self._intake.on_core_reply(event)
        missed = self._handled.missed_before(event)
        if missed:
            text = f"{missed} events of the servo process are lost: no gateway took them while they were kept"
            self.log.add("warning", message=text, origin="gateway")
        if event.kind in SILENT:
            self._handled.mark(event, acted=False)
            return
        self._intake.on_core_event(event)
        # A restarted gateway receives the servo process's events again.
        fresh = not self._handled.is_acted_on(event)
        self._repeated = self._handled.is_journaled(event)
        operator = self._stop.stopped_by(event.t_ns) if event.kind == "stopped" else ""
        self._state.on_event(event, operator, repeated=self._repeated)
        if event.kind != "taught" or not fresh or self._teaching.taught(event):
            self.log.add_core(event, operator=operator)
        self._repeated = False
        if event.kind == "fault" and fresh:
            self._recordings.keep_ring(event.t_ns)
        self._calibration.on_core_event(event, fresh=fresh)
        self._relocalization.on_core_event(event, fresh=fresh)
        self._handled.mark(event, acted=event.kind in ONCE)

    # -- telling --------------------------------------------------------------------------------------------

    def _publish_features(self) -> None:
        for reader, boundary in self._observations:
            data = reader.poll()
            if data is None:
                continue
            with boundary:
                observation = decode_observation(data)
                publisher = self._publishers.features[observation.camera]
                self._marker_cache.add(observation)
                self._refinement.add_frame(observation)
                if publisher.matching_status.matching:
                    publisher.put(encode(features_message(observation)))

    def _read_state(self) -> None:
        state = self._state.read()
        if state is not None:
            self._calibration.on_model_applied(state.status.model_epoch)
            self._relocalization.on_model_applied(state.status.model_epoch)
            self._refinement.on_state(state.status)

    def _newest_message(self) -> StateMessage | None:
        """The current state; None before the first one."""
        self._read_state()
        self._collect_notes()
        return self._state.message(
            last_event=self.log.last,
            notes=(*self._calibration.notes, *self._notes.texts),
            refused_messages=self._intake.boundary.refusals.count + self._stop.refused,
            refinement=self._refinement.state(),
            learning=self._calibration.learning.state(),
        )

    def _collect_notes(self) -> None:
        """Update the notes on omitted messages and lines."""
        self._notes.set_note("journal", self._journal.note)
        self._notes.set_note("servo process", self._servo.note)
        self._notes.set_note("reports", self._reports.note)
        beat = self._supervisor.newest()
        self._notes.set_note("supervisor", SUPERVISOR_SILENT if beat is not None and beat.silent_s(0.0) else "")
        for k, (_, boundary) in enumerate(self._observations):
            self._notes.set_note(f"observations {k}", boundary.note)

    def _publish_state(self) -> None:
        now = time.monotonic()
        if now - self._state_sent < STATE_EVERY_S:
            return
        self._state_sent = now
        state = self._newest_message()
        if state is not None and self._publishers.state.matching_status.matching:
            self._publishers.state.put(encode(state))

    def _on_report(self, report: Report) -> None:
        if report.images is not None:
            self._recordings.images.add_report(report.images)
        self.log.add(report.kind, t_ns=report.t_ns, message=report.message, name=report.origin, origin=report.origin)

    # -- life -----------------------------------------------------------------------------------------------

    def _announce(self) -> None:
        """Announce the daemon in ``daemon.json``, once the servo process accepts requests."""
        now = time.monotonic()
        if not self._greeted or self._announce_due_s is None or now < self._announce_due_s:
            return
        plan = self.plan
        info = DaemonInfo(
            cell=plan.cell.cell.name,
            endpoint=self.endpoint,
            boot=self.boot,
            pid=os.getppid(),
            cell_path=plan.cell_path,
            dry_run=plan.dry_run,
            commissioning=plan.commissioning,
        )
        try:
            write_atomically(plan.directories.daemon, encode(info))
        except OSError as error:
            self._announce_due_s = now + ANNOUNCE_RETRY_S
            self._notes.set_note(
                "announcement", f"{plan.directories.daemon}: {error.strerror}; clients cannot find the daemon"
            )
        else:
            self._announce_due_s = None
            self._notes.set_note("announcement", "")

    def close(self) -> None:
        """Finish the recording, cancel the fit, close the sessions within a time limit."""
        self._calibration.close()
        self._relocalization.cancel()
        self._refinement.cancel()
        self._record_steps(100_000)
        self._recordings.close()
        with suppress(zenoh.ZError):  # this message is a courtesy, not required
            if not self._servo.connected:  # otherwise the next gateway continues
                self.goals.end_current(self.log)
            self.log.add("daemon_ends", message="the daemon ends", origin="gateway")
        self._replies.close()
        self._stop.close()
        declared = [
            self._alive,
            self._goal_puts,
            self._goal_queries,
            *self._command_queries,
            *self._gateway_queries,
            self._any_command_queries,
            self._event_queries,
            self._state_queries,
            self._info_queries,
            self._schema_queries,
            self._model_queries,
            *self._publishers.all,
        ]
        if self._network is not None:
            close_session(self._network, [])
        close_session(self._session, declared)
        self._servo.close()
        self._state.close()
        self._previews.close()
        self._reports.close()
        self._journal.close()
        self._handled.close()
        self._heartbeat.close()
        self._supervisor.close()

    @property
    def reply_pending(self) -> bool:
        """Whether the servo process, which ends as well, must still report how a goal ended."""
        return self._servo.connected and self.goals.any_of_this_run


def run(plan: RunPlan, parent: int, termination: Termination) -> None:
    """Run until terminated; ``parent``: the supervisor."""
    gateway = Gateway(plan)
    try:
        busy_s = time.monotonic()
        while not termination.asked:
            if gateway.run_once():
                busy_s = time.monotonic()
            else:
                time.sleep(IDLE_S if time.monotonic() - busy_s < REST_AFTER_S else REST_S)
        # The last events of the servo process, above all that it stopped, are still published.
        for _ in range(FINAL_PASSES):
            if not gateway.run_once():
                break
        until = time.monotonic() + LAST_EVENTS_S
        while os.getppid() != parent and gateway.reply_pending and time.monotonic() < until:
            gateway.run_once()
            time.sleep(IDLE_S)
    finally:
        gateway.close()


def main() -> int:
    """Entry of the process."""
    runtime, parent = Path(sys.argv[1]), int(sys.argv[2])
    die_with_parent(parent, signal.SIGTERM)
    termination = Termination(grace_s=8.0)
    prepare_runtime()
    try:
        plan = load_plan(runtime)
        if plan.laws:
            LAWS.adopt(plan.laws, plan.law_errors)
        run(plan, parent, termination)
    except (DirectoryError, OSError, PlanError, SessionError, SlotError) as error:
        write_log("gateway", str(error))
        return EXIT_SETUP
    return 0


# -- the state of the cell -----------------------------------------------------------------------------------
# The state of the cell as published: the servo process's own state, completed by what the gateway adds: whether the
# servo process is alive, why a camera is silent, and who stopped the arm.


SERVO_STALE_S = 0.5
CAMERA_SILENT = "CAMERA_SILENT"


class CellState:
    """The newest state of a cell, and its message. Raises SlotError."""

    def __init__(self, plan: RunPlan, boot: str, servo: ServoConnection) -> None:
        self._plan = plan
        self._boot = boot
        self._servo = servo
        self._heard_s = 0.0
        self._cameras = CameraWatch(plan.directories, plan.cameras)
        self._halt = _Halts()
        self.newest: ServoState | None = None

    def read(self) -> ServoState | None:
        """The servo process's state, None unless it is new."""
        state = self._servo.state()
        if state is not None:
            self._heard_s = time.monotonic()
            self.newest = state
        return state

    def on_event(self, event: Event, operator: str, *, repeated: bool) -> None:
        """Record who stops or holds the arm. ``operator``: sender of a stop, if known; ``repeated``: sent to an earlier
        gateway, too.
        """
        self._halt.take(event, operator, repeated=repeated)

    def message(self, learning: LearningState | None = None, **fields: Any) -> StateMessage | None:
        """The current state in the clients' format, with the progress of a calibration and the further arguments
        ``fields`` of `state_message`; None before the first state.
        """
        if self.newest is None:
            return None
        servo_alive = time.monotonic() - self._heard_s <= SERVO_STALE_S
        alive = servo_alive or self._servo.announced_silence()
        state = state_message(
            self._plan, self._boot, self.newest, now_ns=time.monotonic_ns(), servo_alive=alive, **fields
        )
        silent = self._cameras.reasons(state) if servo_alive else ()  # a silent servo process receives no frames
        halted = any(reason.code in ("STOPPED", "HELD") for reason in state.reasons)
        return msgspec.structs.replace(
            state,
            reasons=(*state.reasons, *silent),
            level="slow" if state.level == "ok" and any(r.level == "slow" for r in silent) else state.level,
            halt=self._halt.now if halted else None,
            learning=learning,
        )

    def close(self) -> None:
        """Release the slots. Idempotent."""
        self._cameras.close()


class _Halts:
    """Operator who stopped or held the arm, from the core's events."""

    def __init__(self) -> None:
        self.now: Halt | None = None
        self._stopped = False

    def take(self, event: Event, operator: str, *, repeated: bool) -> None:
        if event.kind == "resumed" or (event.kind == "lifecycle" and event.name == "active"):
            self.now, self._stopped = None, False
        elif event.kind == "stopped":
            self._stopped = True
            self._set(event, _stop_text(event, operator, repeated))
        elif event.kind == "held" and not self._stopped:
            self._set(event, event.message)

    def _set(self, event: Event, text: str) -> None:
        self.now = Halt(text, time.time() - (time.monotonic_ns() - event.t_ns) * 1e-9)


def _stop_text(event: Event, operator: str, repeated: bool) -> str:
    codes = [reason.code for reason in event.reasons if reason.code != "STOPPED"]
    if codes:
        return f"stopped for {', '.join(codes)}"
    if operator:
        return f"stopped by {operator}"
    return "stopped" if repeated else "stopped on the cell's host"


class CameraWatch:
    """Finds the cameras that deliver no frames, and the reasons, from the heartbeats of their processes. Raises
    SlotError.
    """

    def __init__(self, directories: CellDirectories, cameras: Sequence[CameraDescription]) -> None:
        self._cameras = {
            camera.name: (
                HeartbeatReader(directories.heartbeat_slot(f"vision-{camera.name}")),
                silence_limit_s(camera.rate_hz),
            )
            for camera in cameras
        }

    def reasons(self, state: StateMessage) -> tuple[Reason, ...]:
        """A reason for each camera that is silent, or whose process has ended."""
        found = []
        for name, (heartbeat, limit_s) in self._cameras.items():
            age_s = state.camera_age_s.get(name)
            lives = heartbeat.process_lives()
            if not lives or age_s is None or age_s > limit_s:
                level, hint = _why_silent(heartbeat, lives, age_s)
                found.append(Reason(CAMERA_SILENT, level, name, age_s, limit_s, "s", hint))
        return tuple(found)

    def close(self) -> None:
        """Release the slots. Idempotent."""
        for heartbeat, _ in self._cameras.values():
            heartbeat.close()


def _why_silent(heartbeat: HeartbeatReader, lives: bool, age_s: float | None) -> tuple[Level, str]:
    """Level and hint of the reason for a camera whose newest frame has this age [s]; None: no frame so far."""
    beat = heartbeat.newest()
    if not lives:
        if beat is None:
            return "info", "its process is being started"
        return (
            "slow",
            "its process has ended; the supervisor starts it again, and the daemon's log says how it ended",
        )
    silent_s = 0.0 if beat is None else beat.silent_s(VISION_HANG_S)
    if silent_s:
        return "slow", (
            f"its process hangs: no sign of life for {silent_s:.1f} s. After {VISION_HANG_S:g} s the supervisor kills "
            "it and starts it again"
        )
    if age_s is None:
        return "info", "it is being opened and has delivered no frame yet"
    return "slow", (
        f"its newest usable frame is {age_s:.1f} s old, though its process lives: look at the camera's cable and "
        "power; the daemon opens it again by itself"
    )


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # a hung client may still block a zenoh thread
