"""A recording in the place of a live cell: pages are sent the same messages, at the time that they have chosen."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any, Literal

import msgspec

from stereoservo.recording.replay import RecordingError, recorded_span
from stereoservo.web.cell_link import Publish
from stereoservo.web.flight_timeline import FlightReader, Timeline
from stereoservo.web.model_view import ModelView

TICK_S = 0.02
TELL_EVERY_S = 0.2
EVENTS_SHOWN = 100


class FlightLink:
    """Shows the recording ``path`` to pages, from its begin on, while it is still being read.

    All pages see the same moment. Raises RecordingError where it cannot be read.
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
        self._reader = FlightReader(path, self._span, self._timeline)
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
        """Set by every page that is opened: it is sent what there is now."""

    @property
    def silent_s(self) -> float:
        """A recording is never silent: 0."""
        return 0.0

    def start(self) -> None:
        """Begin to read and to play."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End both. Idempotent."""
        self._reader.ended.set()
        self._ended.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(3.0)

    def end_leases(self) -> None:
        """There are none."""

    def play(self, playing: bool, speed: float | None) -> dict[str, Any]:
        """Play, from the begin where it is at its end, or pause."""
        with self._lock:
            self._speed = self._speed if speed is None else speed
            if playing and self._at_ns >= self._span.last_ns:
                self._at_ns, self._jumped = self._span.first_ns, True
            self._playing = playing
            return {"message": f"playing, {self._speed:g} times as fast" if playing else "paused"}

    def seek(self, seconds: float) -> dict[str, Any]:
        """Go to a time [s] after the recording's begin; as far as it was read by now."""
        with self._lock:
            wanted = self._span.first_ns + round(seconds * 1e9)
            self._at_ns = min(max(wanted, self._span.first_ns), self._read_ns())
            self._jumped = True
            return {"message": f"at {self._seconds(self._at_ns):.2f} s"}

    def _read_ns(self) -> int:
        return max(self._timeline.read_ns, self._span.first_ns)

    def _seconds(self, t_ns: int) -> float:
        return (t_ns - self._span.first_ns) * 1e-9

    def _show(self) -> None:
        shown: dict[str, int] = {}
        told = b""
        told_at = last = time.monotonic()
        while not self._ended.wait(TICK_S):
            now = time.monotonic()
            at_ns, jumped = self._advance(now - last)
            last = now
            if self.watched.is_set():  # a page was opened
                self.watched.clear()
                jumped = True
            if jumped:
                shown.clear()
                self._tell("plots", {"plots": self._timeline.plots(at_ns)})
            self._show_moment(at_ns, shown)
            state = msgspec.json.encode({"flight": self._flight(at_ns)})
            if state != told and (jumped or now - told_at >= TELL_EVERY_S):
                told, told_at = state, now
                self._publish("flight", state, True)

    def _advance(self, seconds: float) -> tuple[int, bool]:
        """The present moment, and whether it is no continuation of the last one."""
        with self._lock:
            jumped, self._jumped = self._jumped, False
            if self._playing:
                self._at_ns = min(self._at_ns + round(seconds * self._speed * 1e9), self._read_ns())
                self._playing = self._at_ns < self._span.last_ns and self._reading_or_after(self._at_ns)
            return self._at_ns, jumped

    def _reading_or_after(self, at_ns: int) -> bool:
        return self._threads[0].is_alive() or at_ns < self._read_ns()

    def _show_moment(self, at_ns: int, shown: dict[str, int]) -> None:
        """Publish what is new at ``at_ns``: of each slot the newest message, of events all that came before."""
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
            self._tell("events", {"events": events})

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

    def _tell(self, slot: str, tree: dict[str, Any]) -> None:
        self._publish(slot, msgspec.json.encode(tree), True)
