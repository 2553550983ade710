"""HTTP server of the emulated cameras' streams on loopback, in real time: one loop for all clients, one rendering
thread.
"""

from __future__ import annotations

import contextlib
import html
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

from stereoservo.messages.cell_file import CellFile
from stereoservo.messages.directories import cell_directories
from stereoservo.ports.clock import MonotonicClock
from stereoservo_sim.emulators.cameras.camera_emulator import NEVER_NS, CameraEmulator, CameraEvent
from stereoservo_sim.emulators.cameras.emulated_camera import EmulatedCamera, StreamPicture
from stereoservo_sim.emulators.cameras.stream_settings import CamerasSettings, cameras_of_cell, port_of
from stereoservo_sim.emulators.console import Printer, begin_serving
from stereoservo_sim.emulators.fault_engine import EmulationError

SEND_BUFFER = 1 << 17
"""[bytes] The kernel's send buffer of a stream for a client that does not read: one or two images."""
REQUEST_NS = 5_000_000_000
LONGEST_WAIT_S = 0.2
LATEST_NS = 10_000_000
"""Lateness at which an image is dropped: real cameras stay punctual while this computer is busy."""
BACKLOG = 16


class _Client:
    """A client's connection. ``stream``: set once it has requested one; ``once``: for one image of it."""

    def __init__(self, link: socket.socket, now_ns: int) -> None:
        self.link = link
        self.opened_ns = now_ns
        self.asked = bytearray()
        self.stream = ""
        self.once = False
        self.waiting = memoryview(b"")
        self.hold = 0  # bytes of the queue that a stalled stream withholds
        self.cut = False  # ends in the middle of its next image
        self.last = False  # closed when the queue is empty
        self.seq = -1


class CameraServer:
    """Serves ``emulator`` at ``http://127.0.0.1:port`` (0: a free one), in the thread that calls ``run``.

    ``on_event`` is called with every event, in that thread. Raises EmulationError if the port is taken.
    """

    def __init__(self, emulator: CameraEmulator, *, cell: str = "", port: int = 0, connections: int = 32) -> None:
        self.emulator = emulator
        self.on_event: Callable[[CameraEvent], None] | None = None
        self.pictures = 0
        self.withheld = 0
        self.late_ns = 0
        self._cell = cell
        self._connections = connections
        self._clients: list[_Client] = []
        self._newest: dict[str, StreamPicture] = {}
        self._watched: dict[int, Callable[[], None]] = {}
        self._selector = selectors.DefaultSelector()
        self._ended = threading.Event()
        self._look = threading.Event()
        self._failure: BaseException | None = None
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        try:
            self._listener = socket.create_server(("127.0.0.1", port), backlog=BACKLOG)
        except OSError as error:
            os.close(self._wake_read)
            os.close(self._wake_write)
            raise EmulationError(
                f"cannot listen on 127.0.0.1:{port}: {error.strerror}; another port, or 0 for a free one, would do"
            ) from error
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._selector.register(self._wake_read, selectors.EVENT_READ, self._woken)
        emulator.on_close_connections = self._close_connections
        emulator.wanted.clear()

    @property
    def url(self) -> str:
        """URL of the streams."""
        return f"http://127.0.0.1:{self._listener.getsockname()[1]}"

    @property
    def start_ns(self) -> int:
        """Zero of the fault commands' times."""
        return self.emulator.start_ns

    @property
    def streams(self) -> dict[str, str]:
        """Paths of the streams by camera name."""
        return {camera.name: camera.stream for camera in self.emulator.cameras}

    def watch(self, descriptor: int, act: Callable[[], None]) -> None:
        """Call ``act`` in the serving loop whenever ``descriptor`` is readable."""
        try:
            self._selector.register(descriptor, selectors.EVENT_READ, act)
        except PermissionError:  # a regular file is always readable: read it to its end at once
            self._watched[descriptor] = act

    def unwatch(self, descriptor: int) -> None:
        """Stop watching a descriptor."""
        if self._watched.pop(descriptor, None) is None:
            self._selector.unregister(descriptor)

    def obey(self, text: str) -> str:
        """Execute a fault command, from the serving thread itself. Raises FaultCommandError."""
        answer = self.emulator.order(text, time.monotonic_ns())
        self._look.set()
        return f"{answer}\n{self.words()}" if text.split()[:1] == ["status"] else answer

    def words(self) -> str:
        """The statistics as text."""
        return (
            f"{len(self._clients)} connections; {self.pictures} pictures sent, {self.withheld} withheld since this "
            f"computer was busy (at most {self.late_ns * 1e-6:.1f} ms after their time)"
        )

    def run(self, ended: Callable[[], bool]) -> None:
        """Serve until ``ended``; then close all. Rendering errors are raised here."""
        darkroom = threading.Thread(target=self._render, name="darkroom", daemon=True)
        darkroom.start()
        try:
            while not ended() and self._failure is None:
                self._turn()
        finally:
            self._ended.set()
            self._look.set()
            darkroom.join()
            for client in list(self._clients):
                self._close(client)
            self._selector.close()
            self._listener.close()
            os.close(self._wake_read)
            os.close(self._wake_write)
            self.emulator.close()
        if self._failure is not None:
            raise self._failure

    # -- rendering ----------------------------------------------------------------------------------------------------

    def _render(self) -> None:
        try:
            while not self._ended.is_set():
                before_ns = self.emulator.sending_ns()
                due_ns = self.emulator.take(time.monotonic_ns())
                if self.emulator.sending_ns() != before_ns:
                    self._wake()
                wait_s = LONGEST_WAIT_S if due_ns == NEVER_NS else (due_ns - time.monotonic_ns()) * 1e-9
                if wait_s > 0 and self._look.wait(min(wait_s, LONGEST_WAIT_S)):
                    self._look.clear()
        except BaseException as error:  # raised by run()
            self._failure = error
            self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake_write, b"\0")

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_read, 4096)

    # -- the loop -----------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        until_ns = self.emulator.sending_ns()
        wait_s = min(max((until_ns - time.monotonic_ns()) * 1e-9, 0.0), LONGEST_WAIT_S)
        for key, events in self._selector.select(0.0 if self._watched else wait_s):
            if isinstance(key.data, _Client):
                self._serve(key.data, events)
            else:
                key.data()
        for act in list(self._watched.values()):
            act()
        now_ns = time.monotonic_ns()
        self.emulator.run_until(now_ns)
        for stream, picture in self.emulator.sent(now_ns):
            late_ns = now_ns - picture.t_send_ns
            self.late_ns = max(self.late_ns, late_ns)
            if late_ns > LATEST_NS:
                self.withheld += 1
                continue
            self._newest[stream] = picture
            self.pictures += 1
        for client in list(self._clients):
            if not client.stream and not client.last and now_ns - client.opened_ns > REQUEST_NS:
                self._close(client)
            else:
                self._feed(client)
        self._pass_events()

    def _pass_events(self) -> None:
        for event in self.emulator.take_events():
            if self.on_event is not None:
                self.on_event(event)

    def _accept(self) -> None:
        try:
            link, _ = self._listener.accept()
        except OSError:  # disconnected again
            return
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        client = _Client(link, time.monotonic_ns())
        self._clients.append(client)
        self._selector.register(link, selectors.EVENT_READ, client)
        if len(self._clients) > self._connections:
            self._refuse(client, "503 Service Unavailable", f"{self._connections} connections are the most")

    def _serve(self, client: _Client, events: int) -> None:
        if events & selectors.EVENT_READ and not self._hear(client):
            self._close(client)
        elif events & selectors.EVENT_WRITE:
            self._feed(client)

    def _hear(self, client: _Client) -> bool:
        """Read from a client; False if it has disconnected."""
        try:
            data = client.link.recv(4096)
        except BlockingIOError:
            return True
        except OSError:
            return False
        if not data:
            return False
        if client.stream or client.last:
            return True  # content after the request is ignored
        client.asked += data
        try:
            request = parse_request(bytes(client.asked))
            if request is not None:
                self._answer(client, request)
        except BadRequestError as error:
            self._refuse(client, error.status, str(error))
        return True

    def _answer(self, client: _Client, request: HttpRequest) -> None:
        """Respond to a request. Raises BadRequestError."""
        streams = list(self.streams.values())
        stream = next((s for s in streams if request.path in (s, still_path(s))), None)
        if stream is None and request.path != "/":
            raise BadRequestError("404 Not Found", f"no {request.path[:80]} here")
        if stream in self.emulator.refused:
            raise BadRequestError("503 Service Unavailable", f"{request.path} is refused by order")
        if stream is None or request.head:
            page = index(self._cell, streams)
            self._say(client, page if not request.head else page.partition(b"\r\n\r\n")[0] + b"\r\n\r\n")
            return
        client.stream, client.once = stream, request.path != stream
        client.asked.clear()
        if client.once:
            self._newest.pop(stream, None)  # an image from now on, not the last one requested before
        else:
            client.waiting = memoryview(stream_head())
        self._say_event("connected", stream)
        self._wanted()

    def _refuse(self, client: _Client, status: str, message: str) -> None:
        error = BadRequestError(status, message)
        self._say(client, failure(error, list(self.streams.values())))

    def _say(self, client: _Client, data: bytes) -> None:
        """Send a response, then close."""
        client.waiting, client.last = memoryview(data), True
        self._feed(client)

    def _feed(self, client: _Client) -> None:
        """Send queued data; once there are none, start with the newest image."""
        if not client.waiting and client.stream and not client.last:
            self._next(client)
        stalled = client.stream in self.emulator.stalled
        allowed = len(client.waiting) - (client.hold if stalled else 0)
        if allowed > 0:
            try:
                sent = client.link.send(client.waiting[:allowed])
            except BlockingIOError:
                sent = 0
            except OSError:
                self._close(client)
                return
            client.waiting = client.waiting[sent:]
        if client.last and not client.waiting:
            self._close(client)
            return
        blocked = bool(client.waiting) and not stalled
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if blocked else 0)
        if self._selector.get_key(client.link).events != wanted:
            self._selector.modify(client.link, wanted, client)

    def _next(self, client: _Client) -> None:
        picture = self._newest.get(client.stream)
        if picture is None or picture.seq == client.seq:
            return
        client.seq = picture.seq
        data = still(picture) if client.once else part(picture)
        client.hold = len(data) // 2
        if client.cut:
            data = data[: len(data) // 2]
        client.last = client.cut or client.once
        client.waiting = memoryview(data)

    def _close_connections(self, stream: str, within: bool) -> None:
        for client in [client for client in self._clients if client.stream == stream]:
            if within:
                client.cut = True
            else:
                self._close(client)

    def _close(self, client: _Client) -> None:
        if client not in self._clients:
            return
        self._clients.remove(client)
        self._selector.unregister(client.link)
        client.link.close()
        if client.stream:
            self._say_event("gone", client.stream)
            self._wanted()

    def _say_event(self, kind: str, stream: str) -> None:
        name = next(camera.name for camera in self.emulator.cameras if camera.stream == stream)
        self.emulator.tell(time.monotonic_ns(), kind, name)

    def _wanted(self) -> None:
        self.emulator.wanted = {client.stream for client in self._clients if client.stream}
        for stream in list(self._newest):
            if stream not in self.emulator.wanted:
                del self._newest[stream]
        self._look.set()


# -- pages ---------------------------------------------------------------------------------------------------
# HTTP requests and responses of the server of emulated cameras.


BOUNDARY = "picture"
REQUEST_LIMIT = 8192


class BadRequestError(Exception):
    """An invalid request, or one of an unknown resource."""

    def __init__(self, status: str, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class HttpRequest:
    """A parsed request; ``head``: without the content."""

    path: str
    head: bool = False


def parse_request(data: bytes) -> HttpRequest | None:
    """The request at the start of ``data``; None while it is incomplete. Raises BadRequestError."""
    if b"\r\n\r\n" not in data and b"\n\n" not in data:
        if len(data) > REQUEST_LIMIT:
            raise BadRequestError("431 Request Header Fields Too Large", f"more than {REQUEST_LIMIT} bytes")
        return None
    line = data.splitlines()[0].decode("latin-1") if data.strip() else ""
    words = line.split()
    if len(words) != 3 or not words[2].startswith("HTTP/"):
        raise BadRequestError("400 Bad Request", f"{line[:80]!r} is no request")
    if words[0] not in ("GET", "HEAD"):
        raise BadRequestError("405 Method Not Allowed", f"{words[0][:20]} is not understood; GET and HEAD are")
    return HttpRequest(words[1].partition("?")[0], words[0] == "HEAD")


def answer(status: str, kind: str, body: bytes, *, head: bool = False) -> bytes:
    """A complete response."""
    lines = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
        "Cache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    return lines.encode() + (b"" if head else body)


def failure(error: BadRequestError, streams: Sequence[str]) -> bytes:
    """Error response, which lists the streams."""
    text = f"{error}\nstreams: {', '.join(streams)}\n"
    return answer(error.status, "text/plain; charset=utf-8", text.encode())


def still(picture: StreamPicture) -> bytes:
    """Response with one image, ``/NAME.jpg``."""
    return answer("200 OK", "image/jpeg", picture.data)


def stream_head() -> bytes:
    """Head of a stream's response, and its first boundary."""
    return (
        "HTTP/1.1 200 OK\r\n"
        f"Content-Type: multipart/x-mixed-replace; boundary={BOUNDARY}\r\n"
        "Cache-Control: no-store\r\nConnection: close\r\n\r\n"
        f"--{BOUNDARY}\r\n"
    ).encode()


def part(picture: StreamPicture) -> bytes:
    """One image of a stream, ended by the next boundary, so that a client need not wait for it."""
    head = (
        f"Content-Type: image/jpeg\r\nContent-Length: {len(picture.data)}\r\nX-Sequence: {picture.seq}\r\n"
        f"X-Timestamp: {picture.t_shutter_ns // 10**9}.{picture.t_shutter_ns % 10**9:09d}\r\n\r\n"
    )
    return head.encode() + picture.data + f"\r\n--{BOUNDARY}\r\n".encode()


def index(cell: str, streams: Sequence[str]) -> bytes:
    """HTML index page of the streams."""
    title = f"Emulated cameras of {html.escape(cell)}"
    figures = "".join(
        f'<figure><img src="{html.escape(s)}" alt="{html.escape(s)}"><figcaption><a href="{html.escape(s)}">'
        f'{html.escape(s)}</a> <a href="{html.escape(still_path(s))}">one picture</a></figcaption></figure>'
        for s in streams
    )
    style = "body{font-family:sans-serif}figure{display:inline-block;margin:.5em}img{max-width:45vw}"
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>{style}</style>"
        f"<h1>{title}</h1>{figures}"
    )
    return answer("200 OK", "text/html; charset=utf-8", page.encode())


def still_path(stream: str) -> str:
    """Path of the single image of a stream."""
    return f"{stream.removesuffix('.mjpg')}.jpg"


# -- served, with a console ----------------------------------------------------------------------------------
# Lifetime of a cell's emulated cameras, as run by ``stereoservo emulate cameras``.


PRIORITY = 3
"""SCHED_FIFO priority, if allowed: below the servo process and emulated drives; real cameras use no processor."""


def make_camera_emulator(
    cell: CellFile, settings: CamerasSettings, runtime_dir: Path, cell_dir: Path = Path()
) -> CameraEmulator:
    """The cameras of ``settings``, mounted as those of the cell, before its arm; ``cell_dir``: folder of the cell file.

    Raises DriverError.
    """
    clock = MonotonicClock()
    cameras = [
        EmulatedCamera(
            stream,
            settings,
            clock=clock,
            mount=cell.camera[0].mount,
            runtime_dir=runtime_dir,
            cell_dir=cell_dir,
            arm=cell.arm_options,
        )
        for stream in settings.camera
    ]
    return CameraEmulator(cameras, time.monotonic_ns())


def serve_cameras(
    cell: CellFile,
    cell_dir: Path,
    *,
    channel: str | None,
    orders: Sequence[str],
    as_json: bool,
    ended: Callable[[], bool],
) -> None:
    """Serve until ``ended``; ``cell_dir``: folder of the cell file. Raises EmulationError, DriverError,
    FaultCommandError.
    """
    settings = cameras_of_cell(cell)
    port = settings.port if channel is None else port_of(channel)
    cv2.setNumThreads(1)  # on small images its threads only wait for each other
    emulator = make_camera_emulator(cell, settings, cell_directories(cell.cell.name).runtime, cell_dir)
    for text in orders:
        emulator.order(text, emulator.start_ns)
    server = CameraServer(emulator, cell=cell.cell.name, port=port, connections=settings.connections)
    emulator.open()
    printer = Printer(as_json)
    begin_serving(
        server,
        printer,
        PRIORITY,
        f"listening on {server.url}: {', '.join(server.streams.values())}",
        channel=server.url,
        streams={name: server.url + path for name, path in server.streams.items()},
    )
    try:
        server.run(ended)
    finally:
        printer.say("end", server.words(), pictures=server.pictures, withheld=server.withheld, late_ns=server.late_ns)
        printer.end()
