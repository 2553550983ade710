"""The gateway process: connects zenoh clients with the servo process, and keeps models, taught goals and recordings.

Nothing that the arm waits for runs here; its silence means hold. ``python -m stereoservo.gateway.process
RUNTIME_DIRECTORY PARENT_PID``.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
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
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_LAYOUT,
    PlanError,
    RunPlan,
    load_plan,
    observation_decoder,
    report_decoder,
)
from stereoservo.daemon.process_control import Termination, die_with_parent, write_log
from stereoservo.daemon.seqlock import SlotError, SlotReader
from stereoservo.daemon.seqpacket import ChannelServer
from stereoservo.daemon.taught_goals import TaughtFileError
from stereoservo.gateway.calibration_jobs import CalibrationJobs
from stereoservo.gateway.intake import Intake, payload_of
from stereoservo.gateway.observation_cache import ObservationCache
from stereoservo.gateway.persistence import Journal, ModelStore, TaughtStore
from stereoservo.gateway.publisher import (
    SILENT,
    EventLog,
    Publishers,
    ReplyThread,
    cell_info,
    features_message,
    state_message,
)
from stereoservo.gateway.recordings import CannotRecordError, Recordings
from stereoservo.gateway.relocalization_jobs import RelocalizationJobs
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.gateway.stop_thread import StopThread
from stereoservo.gateway.teaching import TaughtGoalRegistry
from stereoservo.gateway.validation import GoalContext
from stereoservo.gateway.zenoh_config import endpoint_of, gateway_config, stop_config
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.directories import DirectoryError
from stereoservo.messages.discovery import DaemonInfo
from stereoservo.messages.keys import VERBS, KeySpace
from stereoservo.messages.wire import (
    CellInfo,
    MessageError,
    Record,
    Reply,
    StateMessage,
    Synthesise,
    decode,
    encode,
    schema,
)

STATE_EVERY_S = 0.05
IDLE_S = 0.003
FINAL_PASSES = 100
SERVO_STALE_S = 0.5
DRAIN = 32
EXIT_SETUP = 3
HANDLED_ONCE = ("taught", "calibration_finished", "check_finished", "reanchor", "camera_adjusted", "fault")
"""Events of the core on which the gateway acts."""
GATEWAY_VERBS = ("record", "synthesise")
"""Commands that the gateway carries out itself."""


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
        self._session = open_session(gateway_config(plan.cell, cell_dir, directories.zenoh_socket))
        self.endpoint = endpoint_of(plan.cell, directories.zenoh_socket)
        self._publishers = Publishers(self._session, self.keys, cameras)
        self.log = EventLog(self.boot, self._publish_event)
        self._servo = ServoConnection(directories)
        self._replies = ReplyThread()
        self._calibration = CalibrationJobs(
            self.settings, self._models, self._servo, self.log, directories.checks
        )
        self._relocalization = RelocalizationJobs(
            self._models, self._servo, self.log, lambda: self._calibration.model, self._use_model
        )
        self._marker_cache = ObservationCache(
            {camera.name: camera.systematic_px for camera in self.settings.cameras}
        )
        self._teaching = TaughtGoalRegistry(
            TaughtStore(directories.taught, self._models.of_epoch),
            self._marker_cache,
            lambda: self._calibration.model,
            self.log,
        )
        self._intake = Intake(
            self.keys, self._servo, self._replies, self.log, self._context, self._teaching, self.boot
        )
        self._reports = ChannelServer(directories.reports_socket)
        self._observations = [
            SlotReader(directories.observation_slot(name), OBSERVATION_LAYOUT) for name in cameras
        ]
        self._declare()
        self._stop = StopThread(
            stop_config(plan.cell, cell_dir, directories.zenoh_socket), self.keys, plan, self.boot
        )
        self._state: StateMessage | None = None
        self._state_heard = 0.0
        self._state_sent = 0.0
        self._recordings = Recordings(plan, self.log)
        self._servo.records = self._recordings.wants_steps
        self._handled_path = directories.runtime / "handled"
        self._handled = int(self._handled_path.read_text()) if self._handled_path.exists() else 0
        self._greeted = False
        self._announced = False

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
        self._event_queries = session.declare_queryable(keys.event, RingChannel(32))
        self._state_queries = session.declare_queryable(keys.state, RingChannel(32))
        self._info_queries = session.declare_queryable(keys.info, RingChannel(32))
        self._schema_queries = session.declare_queryable(keys.any_schema, RingChannel(32))
        self._alive = session.liveliness().declare_token(keys.alive)

    def _publish_event(self, payload: bytes) -> None:
        self._journal.add(payload)
        self._publishers.event.put(payload)

    def _use_model(self, model: CellModel) -> None:
        """Use ``model``, made for moved cameras, now that the core has applied it."""
        self._calibration.model = model

    def _context(self) -> GoalContext:
        model = self._calibration.model
        markers = None if model is None else model.marker_ids
        return GoalContext(self.settings, self._teaching.names, markers)

    # -- the loop -------------------------------------------------------------------------------------------

    def run_once(self) -> bool:
        """Run one pass; returns whether there was anything to do."""
        self._servo.poll_connection()
        if self._servo.connected and self._state is not None and not self._greeted:
            self._greeted = True
            self._calibration.load(self._state.model_epoch)
        events = self._servo.events()
        self._read_state()
        for event in events:
            self._core_event(event)
        busy = self._queries() or bool(events)
        self._intake.expire()
        self._publish_features()
        self._publish_state()
        self._read_reports()
        for item in self._servo.steps():
            self._recordings.take(item)
        self._recordings.poll()
        self._calibration.poll()
        self._relocalization.poll()
        if not self._announced and self._greeted:
            self._announced = True
            self._announce()
        return busy

    def _queries(self) -> bool:
        busy = False
        sources: tuple[tuple[Any, Callable[[Any], None]], ...] = (
            (self._goal_puts, self._intake.goal_sample),
            (self._goal_queries, self._intake.goal_query),
            *((queryable, self._intake.command_query) for queryable in self._command_queries),
            *(
                (queryable, partial(self._answer, work=self._gateway_command))
                for queryable in self._gateway_queries
            ),
            (self._event_queries, partial(self._answer, work=self._events_from, key=self.keys.event)),
            (self._state_queries, partial(self._answer, work=self._newest_state, key=self.keys.state)),
            (
                self._info_queries,
                partial(self._answer, work=lambda _: encode(self.info()), key=self.keys.info),
            ),
            (self._schema_queries, partial(self._answer, work=self._schema)),
        )
        for source, take in sources:
            for _ in range(DRAIN):
                item = source.try_recv()
                if item is None:
                    break
                busy = True
                take(item)
        while self._stop.enables:
            self._intake.command_query(self._stop.enables.popleft())
        return busy

    def _answer(self, query: Any, work: Callable[[Any], bytes], key: str = "") -> None:
        """Reply to ``query`` with the result of ``work``, on ``key`` (default: the query's own, where it is
        concrete).
        """
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
        return encode(Reply(True, self._teaching.synthesise(decode(payload, Synthesise)), boot=self.boot))

    def _record(self, request: Record) -> Reply:
        try:
            if request.on and request.images:
                self._recordings.want_images()
        except CannotRecordError as error:
            return Reply(False, "there are no images to record", problems=(str(error),), boot=self.boot)
        if not request.on:
            steps = self._recordings.stop()
            self._servo.records = self._recordings.wants_steps
            return Reply(True, f"{self._recordings.path}: {steps} steps", boot=self.boot)
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
        if self._state is None:
            return encode(Reply(False, "the servo process has shown no state yet", boot=self.boot))
        return encode(self._state)

    def _schema(self, query: Any) -> bytes:
        return schema(self.keys.schema_of(str(query.key_expr)), tuple(LAWS))

    def info(self) -> CellInfo:
        """Description of the cell, as served on ``info``."""
        model = self._calibration.model
        return cell_info(
            self.plan,
            self.settings,
            self.boot,
            model,
            None if model is None else self._models.path(model.epoch),
            self._teaching.goals,
            self._recordings.path if self._recordings.running else "",
        )

    # -- events of the core --------------------------------------------------------------------------------

    def _core_event(self, event: Event) -> None:
        if event.kind == "reply":
            self._intake.core_reply(event)
        if event.kind in SILENT:
            return
        fresh = event.seq > self._handled
        if event.kind == "taught" and fresh:
            self._teaching.taught(event)
        if event.kind == "fault" and fresh:
            self._recordings.keep_ring(event.t_ns)
        self.log.add_core(event)
        self._calibration.core_event(event, fresh=fresh)
        self._relocalization.core_event(event, fresh=fresh)
        if event.kind in HANDLED_ONCE:
            # A restarted gateway is sent the servo process's events again and must not do these twice.
            self._handled = max(self._handled, event.seq)
            self._handled_path.write_text(str(self._handled))

    # -- telling --------------------------------------------------------------------------------------------

    def _publish_features(self) -> None:
        for reader in self._observations:
            data = reader.poll()
            if data is None:
                continue
            observation = observation_decoder.decode(data)
            self._marker_cache.add(observation)
            try:
                payload = encode(features_message(observation))
            except MessageError as error:
                write_log("gateway", str(error))
                continue
            self._publishers.features[observation.camera].put(payload)

    def _read_state(self) -> None:
        now = time.monotonic()
        state = self._servo.state()
        if state is not None:
            self._state_heard = now
            self._state = state_message(
                self.plan,
                self.boot,
                state,
                servo_alive=True,
                last_event=self.log.last,
                notes=self._calibration.notes,
            )
        elif self._state is not None and self._state.servo_alive and now - self._state_heard > SERVO_STALE_S:
            self._state = msgspec.structs.replace(self._state, servo_alive=False)

    def _publish_state(self) -> None:
        now = time.monotonic()
        if self._state is None or now - self._state_sent < STATE_EVERY_S:
            return
        self._state_sent = now
        self._publishers.state.put(encode(self._state))

    def _read_reports(self) -> None:
        self._reports.accept()
        for peer in self._reports.peers:
            for data in peer.receive():
                report = report_decoder.decode(data)
                if report.images is not None:
                    self._recordings.images.add_report(report.images)
                self.log.add(
                    report.kind,
                    t_ns=report.t_ns,
                    message=report.message,
                    name=report.origin,
                    origin=report.origin,
                )

    # -- life -----------------------------------------------------------------------------------------------

    def _announce(self) -> None:
        """Announce the daemon in ``daemon.json``, once the servo process accepts requests."""
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
        path = plan.directories.daemon
        temporary = path.with_suffix(".new")
        temporary.write_bytes(encode(info))
        temporary.replace(path)

    def close(self) -> None:
        """Finish the recording, cancel the fit, close the sessions within a time limit."""
        self._calibration.cancel()
        self._relocalization.cancel()
        for item in self._servo.steps(100_000):
            self._recordings.take(item)
        self._recordings.close()
        with suppress(zenoh.ZError):  # telling is good manners, not needed
            self.log.add("daemon_ends", message="the daemon ends", origin="gateway")
        self._replies.close()
        self._stop.close()
        declared = [
            self._alive,
            self._goal_puts,
            self._goal_queries,
            *self._command_queries,
            *self._gateway_queries,
            self._event_queries,
            self._state_queries,
            self._info_queries,
            self._schema_queries,
            *self._publishers.all,
        ]
        close_session(self._session, declared)
        self._servo.close()
        self._reports.close()
        self._journal.close()


def run(plan: RunPlan, termination: Termination) -> None:
    """Run until terminated."""
    gateway = Gateway(plan)
    try:
        while not termination.asked:
            if not gateway.run_once():
                time.sleep(IDLE_S)
        for _ in range(
            FINAL_PASSES
        ):  # the last events of the servo process, above all that it stopped, are still published
            if not gateway.run_once():
                break
    finally:
        gateway.close()


def main() -> int:
    """Entry of the process."""
    runtime, parent = Path(sys.argv[1]), int(sys.argv[2])
    die_with_parent(parent, signal.SIGTERM)
    termination = Termination(grace_s=8.0)
    try:
        run(load_plan(runtime), termination)
    except (DirectoryError, OSError, PlanError, SessionError, SlotError, TaughtFileError) as error:
        write_log("gateway", str(error))
        return EXIT_SETUP
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # a hung client may still hold a zenoh thread
