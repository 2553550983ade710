"""A recording in place of a live cell: pages receive the same messages, at the time that they have chosen."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from bisect import bisect_left, bisect_right
from collections import deque
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.client.goal_handle import TERMINAL
from stereoservo.core.cycle import Event, Status, StepInputs, StepOutputs
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.ipc_messages import ServoState, newest_stamps
from stereoservo.daemon.preview import EVERY_NS, encode_jpeg
from stereoservo.gateway.publisher import cell_info, core_event_fields, features_message
from stereoservo.messages.goals import Goal, PlanReport, RunGoal, UpdateGoal
from stereoservo.messages.recording_request import images_directory
from stereoservo.messages.servo_state import LoopStatistics, RunRecord, state_message
from stereoservo.messages.wire import CellInfo, EventMessage, PreviewInfo, encode
from stereoservo.ports.devices import CameraObservation, Frame
from stereoservo.ports.image_files import ImageFileError, ImageReader
from stereoservo.recording.replay import RecordedSpan, RecordingError, recorded_span, replay
from stereoservo.web.cell_link import Publish, picture_message
from stereoservo.web.model_view import ModelView, no_goal

TICK_S = 0.02
PUBLISH_EVERY_S = 0.2
EVENTS_SHOWN = 100


class PlaybackLink:
    """Plays the recording ``path`` to pages, from its beginning, while it is still being read.

    All pages show the same time. Raises RecordingError if it cannot be read.
    """

    recording: Literal[True] = True

    def __init__(self, path: Path, publish: Publish) -> None:
        self._path = path
        self._publish = publish
        self._span = recorded_span(path)
        if not self._span.last_ns:
            raise RecordingError(path, 0, "holds no step; is it a flight recording?")
        self.cell = path.name
        self.view = ModelView()
        self._timeline = Timeline()
        self._reader = PlaybackReader(path, self._span, self._timeline)
        self._lock = threading.Lock()
        self._at_ns = self._span.first_ns
        self._playing, self._speed = True, 1.0
        self._jumped = True
        self._ended = threading.Event()
        self._threads = (
            threading.Thread(target=self._reader.read, name="flight-read", daemon=True),
            threading.Thread(target=self._show, name="flight-show", daemon=True),
        )
        self.watched = threading.Event()
        """Set by every page that is opened: it is then sent the current messages."""

    @property
    def silent_s(self) -> float:
        """A recording is never silent: 0."""
        return 0.0

    def start(self) -> None:
        """Start reading and playing."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop both. Idempotent."""
        self._reader.ended.set()
        self._ended.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(3.0)

    def end_leases(self) -> None:
        """There are none."""

    def play(self, playing: bool, speed: float | None) -> dict[str, Any]:
        """Play, from the beginning if it is at its end, or pause."""
        with self._lock:
            self._speed = self._speed if speed is None else speed
            if playing and self._at_ns >= self._span.last_ns:
                self._at_ns, self._jumped = self._span.first_ns, True
            self._playing = playing
            return {"message": f"playing, {self._speed:g} times as fast" if playing else "paused"}

    def seek(self, seconds: float) -> dict[str, Any]:
        """Seek to a time [s] after the recording's beginning, at most to the last step read so far."""
        with self._lock:
            target_ns = self._span.first_ns + round(seconds * 1e9)
            self._at_ns = min(max(target_ns, self._span.first_ns), self._read_ns())
            self._jumped = True
            return {"message": f"at {self._seconds(self._at_ns):.2f} s"}

    def _read_ns(self) -> int:
        return max(self._timeline.read_ns, self._span.first_ns)

    def _seconds(self, t_ns: int) -> float:
        return (t_ns - self._span.first_ns) * 1e-9

    def _show(self) -> None:
        shown: dict[str, int] = {}
        published = b""
        published_at = last = time.monotonic()
        while not self._ended.wait(TICK_S):
            now = time.monotonic()
            at_ns, jumped = self._advance(now - last)
            last = now
            if self.watched.is_set():  # a page was opened
                self.watched.clear()
                jumped = True
            if jumped:
                shown.clear()
                self._publish_slot("plots", {"plots": self._timeline.plots(at_ns)})
            self._show_moment(at_ns, shown)
            state = msgspec.json.encode({"flight": self._flight(at_ns)})
            if state != published and (jumped or now - published_at >= PUBLISH_EVERY_S):
                published, published_at = state, now
                self._publish("flight", state, True)

    def _advance(self, seconds: float) -> tuple[int, bool]:
        """The current time of the playback [ns], and whether it has jumped since the last call."""
        with self._lock:
            jumped, self._jumped = self._jumped, False
            if self._playing:
                self._at_ns = min(self._at_ns + round(seconds * self._speed * 1e9), self._read_ns())
                self._playing = self._at_ns < self._span.last_ns and self._reading_or_after(self._at_ns)
            return self._at_ns, jumped

    def _reading_or_after(self, at_ns: int) -> bool:
        return self._threads[0].is_alive() or at_ns < self._read_ns()

    def _show_moment(self, at_ns: int, shown: dict[str, int]) -> None:
        """Publish what is new at ``at_ns``: the newest message of each slot, and all events up to then."""
        for slot in self._timeline.slots:
            count = self._timeline.count(slot, at_ns)
            if count == shown.get(slot, 0):
                continue
            shown[slot] = count
            if slot != "event":
                self._publish(slot, self._timeline.message(slot, count - 1), True)
        if shown.get("event", 0) != shown.get("events", -1):
            count = shown["events"] = shown.get("event", 0)
            first = max(0, count - EVENTS_SHOWN)
            events = [msgspec.Raw(self._timeline.message("event", k)) for k in range(first, count)]
            self._publish_slot("events", {"events": events})

    def _flight(self, at_ns: int) -> dict[str, Any]:
        with self._lock:
            return {
                "file": self._path.name,
                "begin": (self._span.first_ns + self._span.shift_ns) * 1e-9,
                "seconds": self._seconds(self._span.last_ns),
                "read": self._seconds(self._read_ns()),
                "reading": self._threads[0].is_alive(),
                "at": self._seconds(at_ns),
                "playing": self._playing,
                "speed": self._speed,
                "notes": self._reader.notes,
            }

    def _publish_slot(self, slot: str, tree: dict[str, Any]) -> None:
        self._publish(slot, msgspec.json.encode(tree), True)


# -- messages over time --------------------------------------------------------------------------------------
# A flight recording as the messages that pages receive from a live cell, each with its time: replayed once, and stored
# in a file without a name, so that any time of it can be shown.


STATE_EVERY_NS = 50_000_000
PLOT_NS = 60_000_000_000
"""Duration that the plots show [s]."""


class Timeline:
    """Messages by slot, in order of time. One thread writes, others read."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="stereoservo-flight-")  # noqa: SIM115
        self._lock = threading.Lock()
        self._times: dict[str, list[int]] = {}
        self._places: dict[str, list[tuple[int, int]]] = {}
        self._end = 0
        self._rows: list[tuple[float | None, ...]] = []
        self._reasons: list[tuple[float, tuple[str, ...]]] = []
        self.read_ns = 0
        """Time up to which the recording was read [ns]."""

    def add(self, slot: str, t_ns: int, data: bytes) -> None:
        """Append a message. Raises OSError on a full disk."""
        self._file.write(data)
        self._file.flush()
        with self._lock:
            self._times.setdefault(slot, []).append(t_ns)
            self._places.setdefault(slot, []).append((self._end, len(data)))
            self._end += len(data)

    def add_row(
        self,
        t_ns: int,
        error: float | None,
        late_us: float,
        velocities: list[float | None],
        codes: tuple[str, ...],
    ) -> None:
        """Append the plotted values of one state; ``codes``: of its reasons."""
        with self._lock:
            self._rows.append((t_ns * 1e-9, error, late_us, *velocities))
            self._reasons.append((t_ns * 1e-9, codes))

    @property
    def slots(self) -> tuple[str, ...]:
        """Slots that hold messages."""
        with self._lock:
            return tuple(self._times)

    def count(self, slot: str, t_ns: int) -> int:
        """Number of messages of ``slot`` up to ``t_ns``."""
        with self._lock:
            return bisect_right(self._times.get(slot, []), t_ns)

    def message(self, slot: str, number: int) -> bytes:
        """Message ``number`` of ``slot``, counted from 0."""
        with self._lock:
            begin, size = self._places[slot][number]
        return os.pread(self._file.fileno(), size, begin)

    def plots(self, t_ns: int) -> dict[str, list[Any]]:
        """Rows of the page's plots, each with its time [s], of the minute before ``t_ns``."""
        with self._lock:
            begin = bisect_left(self._rows, (t_ns - PLOT_NS) * 1e-9, key=_time_of)
            end = bisect_right(self._rows, t_ns * 1e-9, key=_time_of)
            rows, reasons = self._rows[begin:end], self._reasons[begin:end]
        return {
            "error": [row[:2] for row in rows],
            "velocity": [(row[0], *row[3:]) for row in rows],
            "loop": [(row[0], row[2]) for row in rows],
            "reasons": reasons,
        }


def _time_of(row: tuple[float | None, ...]) -> float:
    assert row[0] is not None
    return row[0]


class PlaybackReader:
    """Fills a ``timeline`` with a recording of a cell with these ``span``: replays it, and reads its pictures."""

    def __init__(self, path: Path, span: RecordedSpan, timeline: Timeline) -> None:
        self._path = path
        self._span = span
        self._models = dict(span.models)
        self._timeline = timeline
        self._run: RunRecord | None = None
        self._info: CellInfo | None = None
        self._view, self._epoch = ModelView(), 0
        self._goals: dict[str, tuple[Goal, PlanReport | None]] = {}
        self._requests: dict[int, str] = {}
        self._last_ns = self._state_ns = self._joints_ns = 0
        self._frames_ns: dict[str, int] = {}
        self._late: deque[float] = deque(maxlen=250)
        self._videos: list[_Video] = []
        self.ended = threading.Event()
        """Set by another thread to end the reading."""
        self.notes: list[str] = []
        """Remarks on the recording, for people."""

    def read(self) -> None:
        """Read the recording, to its end or to where it is damaged; `notes` then report that."""
        self._open_videos()
        try:
            result = replay(self._path, observe=self._on_step, header=self._begin)
            if result.identical is False:
                self.notes.append(
                    f"The replay differs from the recording at step {result.first_difference}: joints and markers are "
                    "those recorded, states and errors may not be."
                )
        except _EndedError:
            pass
        except (RecordingError, OSError) as error:
            self.notes.append(str(error))
        finally:
            for video in self._videos:
                video.close()

    def _open_videos(self) -> None:
        for path in sorted(images_directory(self._path).glob("*.avi")):
            try:
                self._videos.append(_Video(path))
            except ImageFileError as error:
                self.notes.append(str(error))

    def _begin(self, settings: CoreSettings) -> None:
        self._info = cell_info(settings, "", None, None, {}, str(self._path), None)
        joints = [{"name": name} for name in settings.joint_names]
        self._run = msgspec.convert(
            {
                "cell": {"cell": {"name": settings.cell}},
                "boot": "",
                "joints": {"joints": joints},
                "cameras": [{"name": camera.name, "rate_hz": camera.rate_hz} for camera in settings.cameras],
            },
            RunRecord,
        )
        self._publish_slot("info", self._span.first_ns, {"info": self._info})
        self._publish_slot("goal", self._span.first_ns, no_goal())

    def _on_step(self, inputs: StepInputs, outputs: StepOutputs) -> None:
        if self.ended.is_set():
            raise _EndedError
        now_ns, status = inputs.now_ns, outputs.status
        if self._last_ns:
            self._late.append(max(0.0, (now_ns - self._last_ns - inputs.period_ns) * 1e-3))
        self._last_ns = now_ns
        if inputs.model_update is not None:
            self._models[inputs.model_update.model.epoch] = inputs.model_update.model
        self._joints_ns, self._frames_ns = newest_stamps(inputs, self._joints_ns, self._frames_ns)
        self._on_goals(inputs, outputs)
        for event in outputs.events:
            if event.kind != "reply":
                self._publish_slot("event", now_ns, {"event": self._event(event)})
        for seen in inputs.observations:
            self._on_features(now_ns, seen)
        self._on_pictures(now_ns)
        if now_ns - self._state_ns >= STATE_EVERY_NS:
            self._state_ns = now_ns
            self._on_state(inputs, status)
        self._timeline.read_ns = now_ns

    def _on_goals(self, inputs: StepInputs, outputs: StepOutputs) -> None:
        """Goals that are sent, planned and moved, drawn from their start on."""
        goal_id = ""
        for request in inputs.requests:
            command = request.command
            if isinstance(command, RunGoal) and not command.goal.check:
                self._requests[request.request] = command.goal.id
                self._goals[command.goal.id] = (command.goal, None)
            elif isinstance(command, UpdateGoal) and command.id in self._goals:
                goal, plan = self._goals[command.id]
                self._goals[command.id] = (msgspec.structs.replace(goal, target=command.target), plan)
                goal_id = command.id
        for event in outputs.events:
            if event.kind == "reply" and event.request in self._requests:
                id_ = self._requests.pop(event.request)
                if event.accepted:
                    self._goals[id_] = (self._goals[id_][0], event.plan)
                else:
                    del self._goals[id_]
            elif event.kind == "goal_started":
                goal_id = event.id
            elif event.kind in TERMINAL:
                self._goals.pop(event.id, None)
        if outputs.status.goal == goal_id and goal_id in self._goals:
            self._publish_slot("goal", inputs.now_ns, self._view.goal(*self._goals[goal_id]))

    def _event(self, event: Event) -> EventMessage:
        t_wall = (event.t_ns + self._span.shift_ns) * 1e-9
        return EventMessage(event.seq, "", event.t_ns, t_wall, event.kind, **core_event_fields(event))

    def _on_features(self, now_ns: int, seen: CameraObservation) -> None:
        if np.isfinite(seen.pixels).all() and np.isfinite(seen.covariances).all():
            found = features_message(seen, self._span.shift_ns)
            self._publish_slot(f"features {seen.camera}", now_ns, {"features": found})

    def _on_pictures(self, now_ns: int) -> None:
        for video in list(self._videos):
            try:
                frame = video.newest(now_ns)
            except ImageFileError as error:
                self.notes.append(str(error))
                self._videos.remove(video)
                continue
            if frame is not None:
                height, width = frame.image.shape
                t_wall = (frame.t_shutter_ns + self._span.shift_ns) * 1e-9
                info = PreviewInfo(frame.camera, frame.seq, frame.t_shutter_ns, t_wall, width, height)
                data = picture_message(encode(info), encode_jpeg(frame.image))
                self._timeline.add(f"picture {frame.camera}", now_ns, data)

    def _on_state(self, inputs: StepInputs, status: Status) -> None:
        assert self._run is not None
        assert self._info is not None
        if status.model_epoch != self._epoch:
            self._epoch = status.model_epoch
            model = self._models.get(self._epoch)
            self._view = ModelView() if model is None else ModelView.of(model, self._info)
        p50, p99, worst = np.percentile(self._late, [50, 99, 100]).tolist() if self._late else (0.0, 0.0, 0.0)
        loop = LoopStatistics(1e9 / inputs.period_ns, status.step, 0, 0, p50, p99, worst, 0.0, 0.0, 0.0)
        state = ServoState(
            status, loop, inputs.driver_configured, inputs.driver_active, True, 0, (),
            joints_ns=self._joints_ns, frames_ns=self._frames_ns,
        )  # fmt: skip
        message = msgspec.structs.replace(
            state_message(self._run, "", state, now_ns=inputs.now_ns, servo_alive=True, last_event=0),
            t_wall=(status.t_ns + self._span.shift_ns) * 1e-9,
        )
        self._publish_slot("state", inputs.now_ns, {"state": message, **self._view.at(message)})
        codes = tuple(reason.code for reason in status.reasons)
        velocities = [message.velocities.get(joint.name) for joint in self._info.joints]
        self._timeline.add_row(inputs.now_ns, message.error_px, p99, velocities, codes)

    def _publish_slot(self, slot: str, t_ns: int, tree: dict[str, Any]) -> None:
        self._timeline.add(slot, t_ns, msgspec.json.encode(tree))


class _EndedError(Exception):
    """Raised to end the replay: the rest of the recording is no longer needed."""


class _Video:
    """A camera's recorded pictures, synchronized with the replay."""

    def __init__(self, path: Path) -> None:
        self._reader = ImageReader(path)
        self._next: Frame | None = self._reader.read()
        self._shown_ns = -EVERY_NS

    def newest(self, now_ns: int) -> Frame | None:
        """The newest picture up to ``now_ns`` that was not returned yet, at most at the rate of a live page."""
        found = None
        while self._next is not None and self._next.t_shutter_ns <= now_ns:
            found, self._next = self._next, self._reader.read()
        if found is None or found.t_shutter_ns - self._shown_ns < EVERY_NS:
            return None
        self._shown_ns = found.t_shutter_ns
        return found

    def close(self) -> None:
        self._reader.close()
