"""All emulated cameras of a cell: their images and streams over time, and the fault commands that change them.

Sans I/O: the same in virtual and in real time. ``take`` and ``order`` may be called by two threads.
"""

from __future__ import annotations

import heapq
import threading
from collections import deque
from collections.abc import Callable, Sequence

import msgspec

from stereoservo_sim.emulators.cameras.emulated_camera import EmulatedCamera, StreamPicture
from stereoservo_sim.emulators.cameras.fault_commands import ALL, LANGUAGE, CameraCommand
from stereoservo_sim.emulators.fault_engine import NEVER_NS, FaultCommandError, FaultEngine

EVENTS_KEPT = 10_000
RETRY_NS = 1_000_000
"""How soon a shutter is looked at again that the arm's history does not reach yet."""


class CameraEvent(msgspec.Struct, frozen=True):
    """Something that happened to a camera at ``t_ns``; ``kind``: ``order``, ``ended``, ``connected``, ``gone``."""

    t_ns: int
    kind: str
    camera: str = ""
    text: str = ""

    def place(self) -> dict[str, str]:
        """The camera, as data."""
        return {"camera": self.camera}

    def where(self) -> str:
        """The camera, as text."""
        return self.camera


class CameraEmulator:
    """Emulator of ``cameras``, by their streams. ``start_ns``: zero of the fault commands' times."""

    def __init__(self, cameras: Sequence[EmulatedCamera], start_ns: int) -> None:
        self.cameras = tuple(cameras)
        self.start_ns = start_ns
        self.stalled: set[str] = set()
        self.refused: set[str] = set()
        self.wanted: set[str] = {camera.stream for camera in cameras}
        """Streams with a client; no picture is taken for others."""
        self.on_hang_up: Callable[[str, bool], None] = lambda stream, within: None
        """Called to close a stream's connections, at once or within the next picture."""
        self._camera_lock = threading.Lock()
        self._heap_lock = threading.Lock()
        self._streams = {camera.name: camera.stream for camera in cameras}
        self._waiting: list[tuple[int, int, str, StreamPicture]] = []
        self.faults = FaultEngine(
            LANGUAGE, self, start_ns, check=self._check_names, log=self._log_fault, guard=self._camera_lock
        )
        self._news: deque[CameraEvent] = deque(maxlen=EVENTS_KEPT)
        self._count = 0

    def open(self) -> None:
        """Load the renderers and start the shutters. Raises DriverError."""
        for camera in self.cameras:
            camera.open()

    def close(self) -> None:
        """Release."""
        for camera in self.cameras:
            camera.close()

    # -- pictures ---------------------------------------------------------------------------------------------------

    def take(self, now_ns: int) -> int:
        """Take every image that is due and requested; returns when to call again [ns]."""
        due_ns = NEVER_NS
        for camera in self.cameras:
            if self._streams[camera.name] not in self.wanted:
                continue
            if camera.due_ns() <= now_ns:
                with self._camera_lock:
                    picture = camera.expose()
                    stream = self._streams[camera.name]
                if picture is not None:
                    with self._heap_lock:
                        self._count += 1
                        heapq.heappush(self._waiting, (picture.t_send_ns, self._count, stream, picture))
            due_ns = min(due_ns, max(camera.due_ns(), now_ns + RETRY_NS))
        return due_ns

    def sending_ns(self) -> int:
        """Time at which the next image is to be sent, or the next fault command to be executed."""
        with self._heap_lock:
            picture_ns = self._waiting[0][0] if self._waiting else NEVER_NS
        return min(picture_ns, self.faults.due_ns())

    def sent(self, now_ns: int) -> list[tuple[str, StreamPicture]]:
        """Images to be sent by now, oldest first, with their streams."""
        pictures = []
        with self._heap_lock:
            while self._waiting and self._waiting[0][0] <= now_ns:
                _, _, stream, picture = heapq.heappop(self._waiting)
                pictures.append((stream, picture))
        return pictures

    # -- orders -----------------------------------------------------------------------------------------------------

    def order(self, text: str, now_ns: int) -> str:
        """Execute the fault command ``text``, now or at its own time after the start; returns the reply.

        Raises FaultCommandError.
        """
        return self.faults.order(text, now_ns)

    def run_until(self, now_ns: int) -> None:
        """Execute the fault commands whose time has come, and undo those whose time has ended."""
        while self.faults.advance(now_ns):
            pass

    def _check_names(self, command: CameraCommand) -> None:
        for name in (command.camera, command.what if command.verb == "swap" else ""):
            if name:
                self.named(name)

    def _log_fault(self, t_ns: int, kind: str, command: CameraCommand, text: str) -> None:
        self.tell(t_ns, kind, command.camera, text)

    def take_news(self) -> list[CameraEvent]:
        """Events since the last call."""
        news = list(self._news)
        self._news.clear()
        return news

    def tell(self, t_ns: int, kind: str, camera: str, text: str = "") -> None:
        """Add an event."""
        self._news.append(CameraEvent(t_ns, kind, camera, text))

    def status(self) -> list[str]:
        """Status, one line a camera."""
        return [
            f"{camera.name} at {self._streams[camera.name]}: {camera.rate_hz:g} Hz, "
            f"skew {camera.view.phase_s * 1e3:g} ms, {camera.condition.words()}{self._stream_words(camera.stream)}"
            for camera in self.cameras
        ]

    def _stream_words(self, stream: str) -> str:
        marks = (("stalled", self.stalled), ("refused", self.refused))
        return "".join(f", {name}" for name, streams in marks if stream in streams)

    # -- what orders do to streams ----------------------------------------------------------------------------------

    def named(self, name: str) -> tuple[EmulatedCamera, ...]:
        """The camera of that name, or ``all``. Raises FaultCommandError, which lists the cameras."""
        if name == ALL:
            return self.cameras
        found = tuple(camera for camera in self.cameras if camera.name == name)
        if not found:
            raise FaultCommandError(
                f"no camera {name!r}; cameras: {', '.join(c.name for c in self.cameras)}, {ALL}"
            )
        return found

    def swap(self, first: EmulatedCamera, second: EmulatedCamera) -> None:
        """Exchange the images of two cameras' streams."""
        streams = self._streams
        streams[first.name], streams[second.name] = streams[second.name], streams[first.name]

    def unswap(self, camera: EmulatedCamera) -> None:
        """Undo the exchange of a camera's stream."""
        other = next(c for c in self.cameras if self._streams[c.name] == camera.stream)
        self.swap(camera, other)

    def hang_up(self, stream: str, *, within: bool = False) -> None:
        """Close the connections of a stream, at once or ``within`` the next image."""
        self.on_hang_up(stream, within)
