"""Messages that the gateway publishes (state, features, cell info, numbered events), and the thread that sends
replies.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

import stereoservo
from stereoservo.control.law_registry import LAWS
from stereoservo.core.cycle import Event
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.preview import PreviewPicture, PreviewRequest
from stereoservo.daemon.taught_goals import TaughtGoal
from stereoservo.gateway.boundary import LimitedLog
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.wire import (
    ENCODING,
    CameraInfo,
    CellInfo,
    EventList,
    EventMessage,
    FeaturesMessage,
    JointInfo,
    MessageError,
    ModelInfo,
    PreviewInfo,
    TaughtInfo,
    encode,
)
from stereoservo.ports.devices import CameraObservation

KEPT_EVENTS = 2_000
"""Number of stored events, for clients that reconnect. Each is stored as bytes: a tenth of the size of objects."""
EVENTS_A_REPLY = 300
PREVIEW_ASK_S = 0.25
SILENT = frozenset({"reply"})
"""Core events that are answers, not news."""


class ReplyThread:
    """Thread that sends replies, so that a hung client cannot block the gateway."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[Any, str, bytes] | None] = queue.SimpleQueue()
        self._unsent = LimitedLog()
        self._thread = threading.Thread(target=self._work, name="replies", daemon=True)
        self._thread.start()

    def reply(self, query: Any, payload: bytes, key: str = "") -> None:
        """Queue a reply to ``query`` on ``key`` (default: the query's own, which must then be concrete) and drop the
        query.
        """
        self._queue.put((query, key or str(query.key_expr), payload))

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            query, key, payload = item
            try:
                with query:
                    query.reply(key, payload, encoding=ENCODING)
            except Exception as error:  # a query that fails to accept its reply must not block the others
                self._unsent.add(f"a reply on {key!r} could not be sent: {type(error).__name__}: {error}")

    def close(self) -> None:
        """Send queued replies for at most one second, and end."""
        self._queue.put(None)
        self._thread.join(1.0)


class EventLog:
    """Numbers the events of a boot, stores the last ones, publishes each, and then passes it to the observer."""

    def __init__(
        self,
        boot: str,
        publish: Callable[[bytes], None],
        observe: Callable[[EventMessage], None] = lambda message: None,
    ) -> None:
        self._boot = boot
        self._publish = publish
        self._observe = observe
        self._kept: deque[bytes] = deque(maxlen=KEPT_EVENTS)
        self.last = 0

    def add(self, kind: str, *, t_ns: int | None = None, **fields: Any) -> EventMessage:
        """Publish an event of the gateway, or of another process."""
        now_ns = time.monotonic_ns()
        stamp = now_ns if t_ns is None else t_ns
        message = EventMessage(
            seq=self.last + 1,
            boot=self._boot,
            t_ns=stamp,
            t_wall=time.time() - (now_ns - stamp) * 1e-9,
            kind=kind,
            **fields,
        )
        encoded = encode(message)  # a number that is not finite raises here; the event is not published
        self.last = message.seq
        self._kept.append(encoded)
        self._publish(encoded)
        self._observe(message)
        return message

    def add_core(self, event: Event, kind: str = "", operator: str = "") -> EventMessage:
        """Publish an event of the core."""
        return self.add(kind or event.kind, t_ns=event.t_ns, operator=operator, **core_event_fields(event))

    def since(self, number: int) -> EventList:
        """Events from ``number`` on, as many as fit into one reply."""
        first = self.last + 1 - len(self._kept)
        begin = min(max(number, first), self.last + 1)
        offset = begin - first
        asked = range(offset, min(offset + EVENTS_A_REPLY, len(self._kept)))
        some = tuple(msgspec.json.decode(self._kept[i], type=EventMessage) for i in asked)
        return EventList(self._boot, first, begin + len(some), some)


def core_event_fields(event: Event) -> dict[str, Any]:
    """Fields of a core's event that are published to clients, besides its kind and time."""
    return {
        "message": event.message,
        "id": event.id,
        "request": event.request,
        "accepted": event.accepted,
        "reasons": event.reasons,
        "name": event.name,
        "error_px": event.error_px,
        "progress": event.progress,
    }


class OperatorNotes:
    """Notes for the cell's keeper, one per topic, shown in the state; a new one is also reported by one event.

    ``standing``: notes of the whole run.
    """

    def __init__(self, log: EventLog, permanent: tuple[str, ...] = ()) -> None:
        self._log = log
        self._texts: dict[str, str] = {}
        for text in permanent:
            self.set_note(text, text)

    @property
    def texts(self) -> tuple[str, ...]:
        """The notes, oldest topic first."""
        return tuple(self._texts.values())

    def set_note(self, topic: str, text: str) -> None:
        """Set the note on ``topic``; an empty text removes it."""
        known = topic in self._texts
        if text:
            self._texts[topic] = text
        else:
            self._texts.pop(topic, None)
        if text and not known:
            self._log.add("warning", message=text, origin="gateway")


def features_message(observation: CameraObservation, shift_ns: int | None = None) -> FeaturesMessage:
    """An observation in the clients' format; ``shift_ns``: wall clock minus its clock (None: this host's current one).

    Raises MessageError for numbers that are not finite.
    """
    if not (np.isfinite(observation.pixels).all() and np.isfinite(observation.covariances).all()):
        raise MessageError(f"camera {observation.camera}: frame {observation.seq} holds numbers that are not finite")
    if shift_ns is None:
        shift_ns = time.time_ns() - time.monotonic_ns()
    sigmas = np.sqrt(0.5 * np.trace(observation.covariances, axis1=1, axis2=2))
    return FeaturesMessage(
        camera=observation.camera,
        seq=observation.seq,
        t_shutter_ns=observation.t_shutter_ns,
        t_received_ns=observation.t_received_ns,
        t_wall=(observation.t_shutter_ns + shift_ns) * 1e-9,
        ids=tuple(observation.ids.tolist()),
        pixels=tuple((u, v) for u, v in observation.pixels.tolist()),
        sigmas=tuple(sigmas.tolist()),
    )


class Previews:
    """Publishes pictures of the cameras, and requests them only while somebody subscribes."""

    def __init__(self, publishers: dict[str, Any], directories: CellDirectories) -> None:
        self._publishers = publishers
        self._requests = {name: PreviewRequest(directories, name) for name in publishers}
        self._wanted: frozenset[str] = frozenset()
        self._asked = 0.0

    def poll(self) -> None:
        """Publish the available pictures. Raises the exceptions of a decoder."""
        now = time.monotonic()
        if now - self._asked > PREVIEW_ASK_S:
            self._asked = now
            self._wanted = frozenset(
                name for name, publisher in self._publishers.items() if publisher.matching_status.matching
            )
            for name in self._wanted:
                self._requests[name].ask()
        for name in self._wanted:
            picture = self._requests[name].poll()
            if picture is not None:
                self._publishers[name].put(picture.jpeg, attachment=encode(preview_info(picture)))

    def close(self) -> None:
        """Release the slots. Idempotent."""
        for request in self._requests.values():
            request.close()


def preview_info(picture: PreviewPicture) -> PreviewInfo:
    """Content of a picture, in the clients' format."""
    age_s = (time.monotonic_ns() - picture.t_shutter_ns) * 1e-9
    return PreviewInfo(
        picture.camera, picture.seq, picture.t_shutter_ns, time.time() - age_s, picture.width, picture.height
    )


class Publishers:
    """The zenoh publishers, one per key."""

    def __init__(self, session: Any, keys: KeySpace, cameras: tuple[str, ...]) -> None:
        drop = zenoh.CongestionControl.DROP
        self.state = session.declare_publisher(keys.state, encoding=ENCODING, congestion_control=drop)
        self.event = session.declare_publisher(keys.event, encoding=ENCODING, congestion_control=drop)
        self.features = {
            name: session.declare_publisher(keys.features(name), encoding=ENCODING, congestion_control=drop)
            for name in cameras
        }
        self.previews = {
            name: session.declare_publisher(
                keys.preview(name),
                encoding="image/jpeg",
                congestion_control=drop,
                priority=zenoh.Priority.DATA_LOW,
            )
            for name in cameras
        }

    @property
    def all(self) -> list[Any]:
        """All publishers, for undeclaring."""
        return [self.state, self.event, *self.features.values(), *self.previews.values()]


def cell_info(
    settings: CoreSettings,
    boot: str,
    model: CellModel | None,
    model_path: Path | None,
    taught: dict[str, TaughtGoal],
    recording: str,
    plan: RunPlan | None,
) -> CellInfo:
    """Description of the cell (joints, cameras, laws, model, taught goals) and of its run, with a ``plan``."""
    limits = settings.limits
    return CellInfo(
        cell=settings.cell,
        version=stereoservo.__version__,
        boot=boot,
        joints=tuple(
            JointInfo(
                name,
                kind,
                float(limits.position_min[i]),
                float(limits.position_max[i]),
                float(limits.velocity_max[i]),
            )
            for i, (name, kind) in enumerate(zip(settings.joint_names, settings.joint_kinds, strict=True))
        ),
        cameras=tuple(
            CameraInfo(camera.name, camera.width, camera.height, camera.rate_hz, camera.mount, camera.marker_ids)
            for camera in settings.cameras
        ),
        laws=tuple(LAWS),
        law=settings.law,
        tolerance_px=settings.tolerance_px,
        model=None
        if model is None
        else ModelInfo(
            model.epoch,
            model.stratum,
            model.marker_ids,
            model.created,
            None if model.statistics is None else model.statistics.rms_px,
            str(model_path),
        ),
        taught=tuple(
            TaughtInfo(
                name,
                goal.target.model_epoch or 0,
                goal.created,
                tuple(sorted({marker for seen in goal.others.values() for marker in seen} - set(goal.tool))),
                goal.tool,
            )
            for name, goal in sorted(taught.items())
        ),
        can_calibrate=settings.trials is not None,
        can_home=settings.home is not None,
        dry_run=plan is not None and plan.dry_run,
        commissioning=plan is not None and plan.commissioning,
        recording=recording,
        auxiliary=() if plan is None else plan.joints.auxiliary,
    )
