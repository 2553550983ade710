"""The page server's link to the daemon, a goal client: a thread that receives what the cell publishes, and the commands
of pages.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Literal

import msgspec
import numpy as np
from zenoh import ZError
from zenoh.handlers import RingChannel

from stereoservo.client import Client, ClientError, EventWatch, NoReplyError, RefusedError, SessionError
from stereoservo.client.client import GOAL_TIMEOUT_S
from stereoservo.client.connection import read_message
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.model import ModelFileError, decode_model
from stereoservo.messages.discovery import NotRunningError
from stereoservo.messages.goals import Calibrate, FeatureTarget, Goal, TaughtTarget, UpdateGoal
from stereoservo.messages.wire import CellInfo, EventMessage, FeaturesMessage, Reply, StateMessage, encode
from stereoservo.numerics.arrays import FloatArray
from stereoservo.web.model_view import ModelView
from stereoservo.web.rights import LEASE_S, Leases

POLL_S = 0.004
RECONNECT_S = 0.25
"""Delay before another session is tried [s]; well below `LEASE_S`, so that a goal survives a failed session."""
SILENT_S = 2.0
INFO_EVERY_S = 0.5
CLOSING_S = 6.0
"""Time limit of closing [s]: 2 s for an unanswered query, 2 s for a session that hangs while it is closed."""
Publish = Callable[[str, bytes, bool], None]


class LinkDownError(Exception):
    """No daemon can be commanded now; the text has the reason."""


class CellLink:
    """Receives what a cell publishes, and commands it.

    ``publish(slot, message, keep)``: called with messages for all pages: JSON text or, for pictures, bytes. Only the
    newest message of a slot counts, unless the slot is empty; ``keep``: new pages receive it, too.
    ``log``: called with a line on every motion that was aborted or failed, with all its reasons.

    Raises NotRunningError, SessionError, ClientError if the cell cannot be reached at the start.
    """

    recording: Literal[False] = False

    def __init__(
        self,
        cell: str,
        endpoint: str | None,
        operator: str,
        publish: Publish,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._log = log
        self._connect: Callable[[], Client] = partial(Client, cell, endpoint=endpoint, operator=operator)
        self._publish = publish
        self._client: Client | None = self._connect()
        self.cell = self._client.cell
        self.info: CellInfo = self._client.info()
        self.view = ModelView()
        self._epoch = -1
        self._seen: dict[str, FeaturesMessage] = {}
        self._state: StateMessage | None = None
        self._heard_s = time.monotonic()
        self._goal = ""
        self._leases = Leases(lambda: self._client)
        self._why = ""
        self.watched = threading.Event()
        """Set while a page is open: pictures are subscribed to only then."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="cell-link", daemon=True)

    def start(self) -> None:
        """Start publishing."""
        self._thread.start()
        self._leases.start()

    def close(self) -> None:
        """End the thread and the session. Idempotent."""
        self._leases.close()
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(CLOSING_S)
        elif self._client is not None:  # never started
            self._client.close()

    @property
    def silent_s(self) -> float:
        """Time since the cell's newest state [s]."""
        return time.monotonic() - self._heard_s

    # -- reading ----------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._ended.is_set():
            try:
                if self._client is None:
                    self._client = self._connect()
                self._read(self._client)
            except (ClientError, NotRunningError, SessionError, OSError) as error:
                self._why = str(error)
            except Exception as error:  # whatever a cell sends: the pages are informed, and the link restarts
                self._why = f"what the cell sends cannot be read: {type(error).__name__}: {error}"
            self._publish_slot("link", {"up": False, "why": self._why})
            client, self._client = self._client, None
            if client is not None:
                closing = threading.Thread(target=client.close, name="cell-link-close", daemon=True)
                closing.start()  # of a session that hangs: takes seconds, longer than a lease
                if self._ended.is_set():
                    closing.join()
            self._ended.wait(RECONNECT_S)

    def _read(self, client: Client) -> None:
        """Publish what ``client`` receives, until the daemon ends. Raises ClientError."""
        self._epoch, self._goal = -1, ""
        self._publish_info(client)
        self._publish_slot("link", {"up": True, "why": ""})
        prefix = client.keys.prefix
        states = client.session.declare_subscriber(client.keys.state, RingChannel(4))
        features = client.session.declare_subscriber(f"{prefix}/features/*", RingChannel(32))
        pictures: Any = None
        last_message_s = info_due = time.monotonic()
        stale = False
        with EventWatch(client) as watch:
            while not self._ended.wait(POLL_S):
                now = time.monotonic()
                while (sample := states.try_recv()) is not None:
                    last_message_s = now
                    self._on_state(client, sample.payload.to_bytes())
                while (sample := features.try_recv()) is not None:
                    self._on_features(sample.payload.to_bytes())
                for event in watch.poll():
                    self._on_event(event)
                    stale = True
                if stale and now > info_due:
                    stale, info_due = False, now + INFO_EVERY_S
                    self._publish_info(client)
                if self.watched.is_set() != (pictures is not None):
                    if pictures is None:
                        pictures = client.session.declare_subscriber(f"{prefix}/preview/*", RingChannel(8))
                    else:
                        pictures.undeclare()
                        pictures = None
                while pictures is not None and (sample := pictures.try_recv()) is not None:
                    self._on_picture(sample)
                if now - last_message_s > SILENT_S:
                    raise ClientError(f"cell {self.cell!r} has been silent for {SILENT_S:g} s")

    def _on_state(self, client: Client, data: bytes) -> None:
        state = read_message("state", data, StateMessage)
        self._state, self._heard_s = state, time.monotonic()
        if state.model_epoch != self._epoch:
            self._load_model(client, state.model_epoch)
        refinement = "" if state.refinement is None else state.refinement.text
        message = {"state": msgspec.Raw(data), "refinement": refinement, **self.view.at(state)}
        self._publish_slot("state", message, keep=True)
        if state.goal != self._goal:
            self._publish_goal(client, state.goal)

    def _load_model(self, client: Client, epoch: int) -> None:
        self._epoch = epoch
        self.view = ModelView()
        if epoch == 0:
            return
        try:
            model = decode_model(client.query(client.keys.model))
        except NoReplyError:
            raise  # requested again over another session
        except (ClientError, ModelFileError) as error:
            self._publish_slot("", {"notice": f"the model cannot be shown: {error}", "t_wall": time.time()})
            return
        self.view = ModelView.of(model, self.info)

    def _on_features(self, data: bytes) -> None:
        found = read_message("features", data, FeaturesMessage)
        self._seen[found.camera] = found
        self._publish_slot(f"features {found.camera}", {"features": msgspec.Raw(data)})

    def _on_event(self, event: EventMessage) -> None:
        self._leases.on_event(event)
        if event.kind.endswith(("_aborted", "_failed")):
            at = time.strftime("%H:%M:%S", time.localtime(event.t_wall))
            self._log(f"{at} {event.kind} {event.id}: {why(event)}")
        self._publish_slot("", {"event": event})

    def _publish_goal(self, client: Client, goal: str) -> None:
        """Publish the drawing data of a ``goal`` that has started, whoever sent it."""
        self._goal = goal
        try:
            running = client.running_goals() if goal else ()
        except ClientError as error:  # e.g. of an older daemon
            self._publish_slot("", {"notice": f"goal {goal} cannot be drawn: {error}", "t_wall": time.time()})
            return
        for one in running:
            if one.goal.id == goal:
                self._publish_slot("goal", self.view.goal(one.goal, one.plan), keep=True)

    def _on_picture(self, sample: Any) -> None:
        if sample.attachment is None:  # not a picture of a camera process
            return
        camera = str(sample.key_expr).rpartition("/")[2]
        data = picture_message(sample.attachment.to_bytes(), sample.payload.to_bytes())
        self._publish(f"picture {camera}", data, False)

    def _publish_info(self, client: Client) -> None:
        self.info = client.info()
        self._publish_slot("info", {"info": self.info}, keep=True)

    def _publish_slot(self, slot: str, tree: dict[str, Any], keep: bool = False) -> None:
        self._publish(slot, msgspec.json.encode(tree), keep or slot == "link")

    # -- commands ---------------------------------------------------------------------------------------------

    @property
    def client(self) -> Client:
        """The connected client. Raises LinkDownError."""
        client = self._client
        if client is None:
            raise LinkDownError(self._why or "the daemon is not there")
        return client

    def joints(self) -> FloatArray:
        """Joint positions (n,) of the newest state. Raises LinkDownError."""
        if self._state is None:
            raise LinkDownError("the cell has shown no state yet")
        if not self._state.joints:
            raise LinkDownError("where the joints are is unknown: the drives tell no positions")
        return np.array(list(self._state.joints.values()))

    def dragged_goal(self, joints: FloatArray) -> Goal:
        """The goal with the set-points of the posture ``joints`` (n,), of the markers that are visible now.

        Raises LinkDownError, GeometryError.
        """
        model = self.view.model
        if model is None:
            raise LinkDownError("there is no model; calibrate first")
        set_points: dict[str, dict[int, tuple[float, float]]] = {}
        for camera, pixels in zip(model.model.cameras, model.pixels(joints), strict=True):
            seen = self._seen[camera.name].ids if camera.name in self._seen else ()
            inside = (
                np.isfinite(pixels).all(axis=1)
                & (pixels > 0).all(axis=1)
                & (pixels < [camera.width - 1, camera.height - 1]).all(axis=1)
            )
            found = {
                marker: (float(u), float(v))
                for marker, (u, v), visible in zip(model.model.marker_ids, pixels, inside, strict=True)
                if visible and marker in seen
            }
            if len(found) < 3:
                raise GeometryError(
                    "too_few",
                    f"camera {camera.name} would show {len(found)} of the markers that it sees now; three are needed: "
                    "drag less far",
                )
            set_points[camera.name] = found
        target = FeatureTarget(set_points, model.model.epoch)
        return Client.make_goal(target, lease_s=LEASE_S)

    def taught_goal(self, name: str) -> Goal:
        """The goal that was taught as ``name``."""
        return Client.make_goal(TaughtTarget(name), lease_s=LEASE_S)

    def send(self, goal: Goal) -> Reply:
        """Send a goal, and renew its lease until it ends or `end_leases`. Raises ClientError, LinkDownError."""
        client = self.client
        with self._leases.held(goal.id):
            return client.request("goal", client.goal_key, encode(goal), GOAL_TIMEOUT_S)

    def update(self, command: UpdateGoal) -> None:
        """Move the set-points of a goal. Raises LinkDownError, MessageError."""
        self.client.update(command.id, command.target, command.stamp_s)

    def calibrate(self, check: bool) -> Reply:
        """Start a calibration, or a check motion; events report its progress. Raises ClientError, LinkDownError."""
        client = self.client
        command = Calibrate(Client.make_goal(TaughtTarget("x")).id, check=check, lease_s=LEASE_S)
        with self._leases.held(command.id):
            return client.command("calibrate", command)

    def stop(self, operator: str) -> Reply:
        """Stop the arm in the name of ``operator``; over a separate session if the link's is down, closed or
        unresponsive.

        Raises ClientError, NotRunningError, SessionError.
        """
        client = self._client
        if client is not None:
            with suppress(NoReplyError, ZError):
                return client.stop(operator)
        with self._connect() as fresh:
            return fresh.stop(operator)

    def cancel(self) -> Reply:
        """Cancel the active goal. Raises ClientError, LinkDownError."""
        goal = "" if self._state is None else self._state.goal
        if not goal:
            raise LinkDownError("no goal is active")
        return self.client.cancel(goal)

    def end_leases(self) -> None:
        """Stop renewing leases: motions started by the page end within `LEASE_S`."""
        self._leases.end()


def why(event: EventMessage) -> str:
    """Text on an event's reasons: its message, and their codes, values and hints."""
    found = [event.message] if event.message else []
    for reason in event.reasons:
        value = "" if reason.value is None else f" {reason.value:.4g}"
        limit = "" if reason.threshold is None else f", limit {reason.threshold:.4g}"
        subject = f" {reason.subject}" if reason.subject else ""
        hint = "" if reason.hint in found else f": {reason.hint}"
        found.append(f"{reason.code}{subject}{f' ({value.strip()}{limit} {reason.unit})' if value else ''}{hint}")
    return "; ".join(found) or "the daemon gave no reason, which is a fault of it"


def picture_message(header: bytes, jpeg: bytes) -> bytes:
    """A picture in the pages' format: the size of the header (4 bytes, little-endian), the header, a JPEG."""
    return struct.pack("<I", len(header)) + bytes(header) + jpeg


def refusal(error: Exception) -> dict[str, Any]:
    """A failure as a page shows it, with text, problems and reasons."""
    found: dict[str, Any] = {"ok": False, "message": str(error)}
    if isinstance(error, RefusedError):
        found["reply"] = error.reply
    return found
