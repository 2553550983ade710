"""The page's server: static files and one WebSocket, over which pages receive what the cell publishes and send
requests, as far as their rights allow. `docs/web.md` has the messages.
"""

from __future__ import annotations

import asyncio
import itertools
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import msgspec
import numpy as np
from msgspec import Meta
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from stereoservo.client import ClientError, SessionError
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.messages.discovery import NotRunningError
from stereoservo.messages.goals import Goal, GoalId, Name, StreamedTarget, UpdateGoal
from stereoservo.messages.wire import MessageError, Reply, decode
from stereoservo.numerics.arrays import FloatArray
from stereoservo.web.cell_link import CellLink, LinkDownError, Publish, refusal
from stereoservo.web.model_view import ModelView, drag_answer
from stereoservo.web.rights import LEASE_S, ArmHolder, RightsError, allowed_hosts, check_host, check_origin

FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/drawing.js": ("drawing.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
}
FOLDER = Path(__file__).parent / "page"
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
MAX_PAGES = 16
MAX_REQUEST_BYTES = 1 << 14
MAX_WAITING = 512
TICK_S = 0.2
"""Interval of messages to pages that the server is alive, with the time since the cell's last state [s]."""
MAX_IN_PROGRESS, MAX_STOPS = 8, 32
"""Largest numbers of concurrent requests of a page, and of stops, which do not wait for the requests."""
EVENTS_KEPT = 100
CLOSING_S = 2.0
PING_S, SILENT_S = 2.0, 3.0
"""Interval of pings to a page, and time limit of its answers [s]: a page without an answer is closed; if it holds the
arm, the arm stops. A browser on a busy computer is late by tenths of a second; closing a page in error costs a goal.
"""
EXPECTED = (
    ClientError,
    GeometryError,
    LinkDownError,
    MessageError,
    NotRunningError,
    RightsError,
    SessionError,
)


class RecordedLink(Protocol):
    """Interface of a recording in place of a cell, `web.playback.PlaybackLink`: this module does not depend on
    recordings.
    """

    recording: Literal[True]
    cell: str
    view: ModelView
    watched: threading.Event

    @property
    def silent_s(self) -> float:
        """A recording is never silent: 0."""

    def start(self) -> None:
        """Start publishing."""

    def close(self) -> None:
        """Stop. Idempotent."""

    def end_leases(self) -> None:
        """There are none."""

    def play(self, playing: bool, speed: float | None) -> dict[str, Any]:
        """Play or pause."""

    def seek(self, seconds: float) -> dict[str, Any]:
        """Seek to a time [s] after the recording's beginning."""


class Page:
    """One open page: its queue of messages, and the goal being made in it; ``name``: sender of its stops."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.newest: dict[str, bytes] = {}
        self.waiting: deque[bytes] = deque(maxlen=MAX_WAITING)
        self.wake = asyncio.Event()
        self.base: FloatArray | None = None
        self.draft: FloatArray | None = None
        self.checked: Goal | None = None
        self.changes = 0
        """Number of drags and checks so far: a checked goal is sent only if none came in between."""
        self._in_progress = 0

    @contextmanager
    def in_progress(self, what: str) -> Iterator[None]:
        """Context manager of a request in progress. Raises RightsError if too many are."""
        if self._in_progress >= MAX_IN_PROGRESS:
            raise RightsError(
                f"{what}: {self._in_progress} requests of this page are in progress, {MAX_IN_PROGRESS} are allowed: "
                "wait for one of them; stop goes before all"
            )
        self._in_progress += 1
        try:
            yield
        finally:
            self._in_progress -= 1

    def put(self, slot: str, data: bytes) -> None:
        """Queue a message that replaces an older one of the same slot."""
        if slot:
            self.newest[slot] = data
        else:
            self.waiting.append(data)
        self.wake.set()

    def append_message(self, tree: Any) -> None:
        """Queue a message that is not replaced."""
        self.put("", msgspec.json.encode(tree))


class PageServer:
    """Serves pages of one cell. ``make_link`` makes the link to it, given the function that publishes to the pages.

    ``operator``: the name under which one page may command the arm; None: none may. ``announce``: called with each new
    token of that operator. Raises what ``make_link`` does.
    """

    def __init__(
        self,
        make_link: Callable[[Publish], CellLink | RecordedLink],
        operator: str | None,
        announce: Callable[[str], None],
    ) -> None:
        self.holder = ArmHolder(operator, announce)
        self._pages: set[Page] = set()
        self._numbers = itertools.count(1)
        self._kept: dict[str, bytes] = {}
        self._events: deque[bytes] = deque(maxlen=EVENTS_KEPT)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._work = ThreadPoolExecutor(4, thread_name_prefix="page-command")
        self._stops = ThreadPoolExecutor(4, thread_name_prefix="page-stop")
        self._hosts: frozenset[str] = frozenset()
        self._port = 0
        self._secure = False
        self.link = make_link(self._publish)

    async def start(self, address: str, port: int, tls: ssl.SSLContext | None = None, names: Sequence[str] = ()) -> int:
        """Listen on a port (0: any free one); returns it. ``names``: further names of this server. Raises OSError."""
        self._loop = asyncio.get_running_loop()
        self._secure = tls is not None
        self._server: Server = await serve(
            self._session,
            address,
            port,
            ssl=tls,
            process_request=self._static,
            max_size=MAX_REQUEST_BYTES,
            open_timeout=5.0,
            close_timeout=1.0,
            ping_interval=PING_S,
            ping_timeout=SILENT_S,
            compression=None,
            server_header=None,
        )
        found: int = self._server.sockets[0].getsockname()[1]
        self._hosts, self._port = allowed_hosts(address, found, names), found
        self.link.start()
        self._ticks = asyncio.create_task(self._tick())
        return found

    async def close(self) -> None:
        """Close all pages, end their goals' leases, disconnect from the daemon. Idempotent."""
        self._ticks.cancel()
        self._server.close()
        with suppress(TimeoutError):  # an open connection must not keep the server running
            await asyncio.wait_for(self._server.wait_closed(), CLOSING_S)
        await asyncio.to_thread(self.link.close)
        self._work.shutdown(wait=False, cancel_futures=True)
        self._stops.shutdown(wait=False)

    # -- HTTP ---------------------------------------------------------------------------------------------------

    def _static(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page's files; None accepts a WebSocket."""
        hosts = request.headers.get_all("Host")
        host = hosts[0] if len(hosts) == 1 else None
        try:
            check_host(host, self._hosts, connection.local_address[0].removeprefix("::ffff:"), self._port)
            if request.path == "/socket":
                origins = request.headers.get_all("Origin")
                if len(origins) > 1:
                    raise RightsError("more than one Origin")
                check_origin(origins[0] if origins else None, host, self._secure)
        except RightsError as error:
            return _response(HTTPStatus.FORBIDDEN, f"{error}\n".encode())
        if request.path == "/socket":
            if len(self._pages) >= MAX_PAGES:
                text = f"{MAX_PAGES} pages are open; close one\n"
                return _response(HTTPStatus.SERVICE_UNAVAILABLE, text.encode())
            return None
        if request.path not in FILES:
            return _response(HTTPStatus.NOT_FOUND, f"there are: {', '.join(FILES)}, /socket\n".encode())
        name, kind = FILES[request.path]
        return _response(HTTPStatus.OK, (FOLDER / name).read_bytes(), kind)

    # -- WebSocket ----------------------------------------------------------------------------------------------

    def _publish(self, slot: str, data: bytes, keep: bool) -> None:
        """Publish a message; called by the link's thread."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._broadcast, slot, data, keep)

    def _broadcast(self, slot: str, data: bytes, keep: bool) -> None:
        if keep:
            self._kept[slot] = data
        elif not slot:
            self._events.append(data)
        for page in self._pages:
            page.put(slot, data)

    async def _tick(self) -> None:
        while True:
            tick = {"t_wall": time.time(), "silent_s": round(self.link.silent_s, 3)}
            self._broadcast("tick", msgspec.json.encode({"tick": tick}), False)
            await asyncio.sleep(TICK_S)

    async def _session(self, connection: ServerConnection) -> None:
        page = Page(f"viewer {next(self._numbers)}")
        self._pages.add(page)
        self.link.watched.set()
        self._send_rights(page)
        page.waiting.extend(self._events)
        for slot, data in self._kept.items():
            page.put(slot, data)
        sender = asyncio.create_task(_send(connection, page))
        tasks: set[asyncio.Task[None]] = set()
        try:
            async for message in connection:
                task = asyncio.create_task(self._answer(page, message))
                tasks.add(task)
                task.add_done_callback(tasks.discard)
                if len(tasks) > MAX_IN_PROGRESS + MAX_STOPS:
                    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            self._pages.discard(page)
            if self.holder.release(page):
                self.link.end_leases()
                self._send_rights_to_all()
                self._broadcast("", _holder_closed(connection), False)
            if not self._pages:
                self.link.watched.clear()

    def _send_rights(self, page: Page) -> None:
        operator = self.holder.operator
        page.append_message(
            {
                "rights": {
                    "operator": operator,
                    "holds": self.holder.holds(page),
                    "taken": self.holder.taken,
                    "cell": self.link.cell,
                    "name": page.name,
                }
            }
        )

    def _send_rights_to_all(self) -> None:
        for page in self._pages:
            self._send_rights(page)

    async def _answer(self, page: Page, message: str | bytes) -> None:
        """Execute a page's request, as far as it is allowed, and send the page the result."""
        n = 0
        try:
            data = message.encode() if isinstance(message, str) else message
            n = number_of(data)
            request = decode_request(data)
            if self.link.recording is True:
                answer = {"ok": True} | _playback(self.link, request)
                page.append_message({"answer": {"n": n, **answer}})
                return
            if not isinstance(request, OPEN):
                self.holder.require(page, str(request.__struct_config__.tag))
            if isinstance(request, Stop):
                answer = {"ok": True} | await self._run(self._stops, page, request)
            else:
                with page.in_progress(str(request.__struct_config__.tag)):
                    answer = {"ok": True} | await self._run(self._work, page, request)
        except EXPECTED as error:
            answer = refusal(error)
        except Exception as error:  # sent to the page; the next request is answered as usual
            answer = {"ok": False, "message": f"the page's server failed: {type(error).__name__}: {error}"}
        self._release_page(page)
        page.append_message({"answer": {"n": n, **answer}})

    async def _run(self, pool: ThreadPoolExecutor, page: Page, request: PageRequest) -> dict[str, Any]:
        assert self._loop is not None
        return await self._loop.run_in_executor(pool, self._do, page, request)

    def _release_page(self, page: Page) -> None:
        """End what a page has started, when it was closed or has released the arm."""
        if page not in self._pages:
            self.holder.release(page)
        if not self.holder.taken:  # otherwise the leases belong to another page now
            self.link.end_leases()

    def _do(self, page: Page, request: PageRequest) -> dict[str, Any]:
        """Execute an allowed request, in a thread. Raises the errors in `EXPECTED`."""
        link = self._cell_link
        match request:
            case Stop():
                operator = self.holder.operator
                return _reply_fields(link.stop(operator if operator and self.holder.holds(page) else page.name))
            case Take():
                self.holder.take(page, request.token)
                self._rights_changed()
                return {"message": f"this page holds the arm as {self.holder.operator}"}
            case Release():
                if self.holder.release(page):
                    link.end_leases()
                self._rights_changed()
                return {"message": "this page does not hold the arm"}
            case Enable():
                link.client.enable()
                return {"message": "enabled: the arm may move"}
            case Disable():
                return _reply_fields(link.client.disable())
            case Hold():
                return _reply_fields(link.client.hold())
            case Resume():
                return _reply_fields(link.client.resume())
            case Reset():
                link.client.reset()
                return {"message": "the fault is cleared; enable switches on"}
            case Teach():
                return {"message": link.client.teach(request.name).message}
            case Calibrate():
                return _reply_fields(link.calibrate(request.check))
            case Cancel():
                return _reply_fields(link.cancel())
            case Drag():
                return self._drag(page, request)
            case Check():
                return self._check(page, request)
            case Go():
                return self._go(page)
            case Send():
                return self._send_goal(msgspec.structs.replace(request.goal, lease_s=LEASE_S, check=False))
            case Update():
                link.update(UpdateGoal(request.id, request.target, request.stamp_s))
                return {"message": "moved"}
            case Play() | Seek():
                raise RightsError("a live cell is shown, which has no past: `stereoservo web --flight FILE` plays one")

    @property
    def _cell_link(self) -> CellLink:
        """The link to the cell, if no recording is shown."""
        assert self.link.recording is False
        return self.link

    def _rights_changed(self) -> None:
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._send_rights_to_all)

    def _drag(self, page: Page, request: Drag) -> dict[str, Any]:
        model = self._cell_link.view.model
        if model is None:
            raise LinkDownError("there is no model of the arm yet: calibrate first")
        if not request.draft or page.draft is None:
            page.draft = None
            page.base = self._cell_link.joints() if page.base is None else page.base
        base = page.base if page.draft is None else page.draft
        assert base is not None
        found = model.dragged(base, request.camera, request.shift, request.turn, request.nearer)
        page.changes += 1
        page.checked = None
        if request.done:
            page.draft, page.base = found.joints, None
        return drag_answer(model, found.joints, request.camera, found.left_px)

    def _check(self, page: Page, request: Check) -> dict[str, Any]:
        page.changes += 1
        page.checked, change = None, page.changes
        link = self._cell_link
        if request.goal is not None:
            goal = msgspec.structs.replace(request.goal, lease_s=LEASE_S)
        elif request.name is not None:
            goal = link.taught_goal(request.name)
        elif page.draft is not None:
            goal = link.dragged_goal(np.array(page.draft))
        else:
            raise LinkDownError("nothing was dragged yet: drag the outline of the body in a picture")
        reply = link.client.check(goal)
        if page.changes == change:
            page.checked = goal
        return _reply_fields(reply) | {"plan": reply.plan}

    def _go(self, page: Page) -> dict[str, Any]:
        goal = page.checked
        if goal is None:
            raise LinkDownError("check the goal first: its path is shown before anything moves")
        found = self._send_goal(goal)
        page.checked = page.draft = page.base = None
        return found

    def _send_goal(self, goal: Goal) -> dict[str, Any]:
        reply = self._cell_link.send(goal)
        return _reply_fields(reply) | {"id": goal.id}


async def _send(connection: ServerConnection, page: Page) -> None:
    """Send the queued messages of a page, the newest of each slot, and more only after its pong: it has read them.

    Otherwise the messages that a slow page has not read would fill the buffers of the sockets, with megabytes of
    pictures: the page would show old data, and answer too late to pings, which ends its goal. Instead it misses
    pictures; and, of messages without a slot, those more than `MAX_WAITING` messages old.
    """
    try:
        while True:
            await page.wake.wait()
            page.wake.clear()
            while page.waiting:
                await connection.send(page.waiting.popleft(), text=True)
            newest, page.newest = page.newest, {}
            for slot, data in newest.items():
                await connection.send(data, text=not slot.startswith("picture "))
            await (await connection.ping())
    except ConnectionClosed:
        return


def _playback(link: RecordedLink, request: PageRequest) -> dict[str, Any]:
    """Execute a page's request on a recording. Raises RightsError for requests to an arm."""
    match request:
        case Play():
            return link.play(request.playing, request.speed)
        case Seek():
            return link.seek(request.at)
    verb = request.__struct_config__.tag
    raise RightsError(
        f"{verb}: a recording is shown, and nothing can be commanded here; play and seek are valid. An arm is stopped "
        "by `stereoservo stop CELL`, or on the page of its cell"
    )


def _holder_closed(connection: ServerConnection) -> bytes:
    """Notice to pages that the one that held the arm is closed."""
    lost = connection.close_code == CloseCode.ABNORMAL_CLOSURE
    how = f"lost its connection, or did not answer for {SILENT_S:g} s" if lost else "was closed"
    return msgspec.json.encode(
        {"notice": f"The page that held the arm {how}: what it had started stops.", "t_wall": time.time()}
    )


def _reply_fields(reply: Reply) -> dict[str, Any]:
    return {"message": reply.message or "done"}


def _response(status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "Connection": "close",
        }
    )
    return Response(status.value, status.phrase, headers, body)


# -- what pages may ask --------------------------------------------------------------------------------------
# Requests of a page to the server, as strict structs: one JSON object per WebSocket message, with ``do`` and a number
# ``n`` that the answer repeats.


Number = Annotated[int, Meta(ge=0, le=2**53)]
Offset = Annotated[float, Meta(ge=-1e5, le=1e5)]


class Stop(msgspec.Struct, frozen=True, tag="stop", tag_field="do", forbid_unknown_fields=True):
    """Stop the arm. Every page may."""

    n: Number = 0


class Take(msgspec.Struct, frozen=True, tag="take", tag_field="do", forbid_unknown_fields=True):
    """Hold the arm, with the one-time token of the terminal."""

    token: Annotated[str, Meta(max_length=200)]
    n: Number = 0


class Release(msgspec.Struct, frozen=True, tag="release", tag_field="do", forbid_unknown_fields=True):
    """Release the arm."""

    n: Number = 0


class Enable(msgspec.Struct, frozen=True, tag="enable", tag_field="do", forbid_unknown_fields=True):
    """Let the arm move."""

    n: Number = 0


class Disable(msgspec.Struct, frozen=True, tag="disable", tag_field="do", forbid_unknown_fields=True):
    """Stop the arm and switch its drives off."""

    n: Number = 0


class Hold(msgspec.Struct, frozen=True, tag="hold", tag_field="do", forbid_unknown_fields=True):
    """Decelerate and hold; the goal is kept."""

    n: Number = 0


class Resume(msgspec.Struct, frozen=True, tag="resume", tag_field="do", forbid_unknown_fields=True):
    """Continue after hold or stop."""

    n: Number = 0


class Reset(msgspec.Struct, frozen=True, tag="reset", tag_field="do", forbid_unknown_fields=True):
    """Leave a fault that no longer has a cause."""

    n: Number = 0


class Teach(msgspec.Struct, frozen=True, tag="teach", tag_field="do", forbid_unknown_fields=True):
    """Store the current view of the cameras as goal ``name``."""

    name: Name
    n: Number = 0


class Calibrate(msgspec.Struct, frozen=True, tag="calibrate", tag_field="do", forbid_unknown_fields=True):
    """Run the trial motions and fit a model; ``check``: the short check motion instead."""

    check: bool = False
    n: Number = 0


class Drag(msgspec.Struct, frozen=True, tag="drag", tag_field="do", forbid_unknown_fields=True):
    """Move the outline of the marker body in the picture of ``camera`` by ``shift`` [px] and ``turn`` [rad]; ``nearer``
    multiplies its depth.

    It starts at the end of the last drag (``draft``) or at the arm's pose. ``done``: the next drag continues from here.
    Nothing moves.
    """

    camera: Name
    shift: tuple[Offset, Offset]
    turn: Annotated[float, Meta(ge=-7.0, le=7.0)] = 0.0
    nearer: Annotated[float, Meta(ge=0.5, le=2.0)] = 1.0
    draft: bool = False
    done: bool = False
    n: Number = 0


class Check(msgspec.Struct, frozen=True, tag="check", tag_field="do", forbid_unknown_fields=True):
    """Plan the taught goal ``name``, or ``goal``, or without either the dragged goal. Nothing moves."""

    name: Name | None = None
    goal: Goal | None = None
    n: Number = 0


class Go(msgspec.Struct, frozen=True, tag="go", tag_field="do", forbid_unknown_fields=True):
    """Send the goal that was checked last."""

    n: Number = 0


class Send(msgspec.Struct, frozen=True, tag="send", tag_field="do", forbid_unknown_fields=True):
    """Send ``goal``, of any kind; the server renews its lease while the page is open."""

    goal: Goal
    n: Number = 0


class Update(msgspec.Struct, frozen=True, tag="update", tag_field="do", forbid_unknown_fields=True):
    """Move the set-points of the goal ``id``; ``stamp_s``: their time by the page's clock."""

    id: GoalId
    target: StreamedTarget
    stamp_s: float | None = None
    n: Number = 0


class Cancel(msgspec.Struct, frozen=True, tag="cancel", tag_field="do", forbid_unknown_fields=True):
    """Cancel the active goal."""

    n: Number = 0


class Play(msgspec.Struct, frozen=True, tag="play", tag_field="do", forbid_unknown_fields=True):
    """Of a recording: play it, ``speed`` times as fast, or pause."""

    playing: bool = True
    speed: Annotated[float, Meta(ge=0.05, le=50.0)] | None = None
    n: Number = 0


class Seek(msgspec.Struct, frozen=True, tag="seek", tag_field="do", forbid_unknown_fields=True):
    """Of a recording: seek to ``at`` [s] after its beginning."""

    at: Annotated[float, Meta(ge=0.0, le=1e7)]
    n: Number = 0


PageRequest = (
    Stop
    | Take
    | Release
    | Enable
    | Disable
    | Hold
    | Resume
    | Reset
    | Teach
    | Calibrate
    | Drag
    | Check
    | Go
    | Send
    | Update
    | Cancel
    | Play
    | Seek
)
OPEN = (Stop, Take, Release)
"""Requests allowed to a page that does not hold the arm."""
PLAYBACK = (Play, Seek)
"""Requests allowed only for a recording."""


class _Numbered(msgspec.Struct):
    n: Number = 0


def decode_request(data: bytes) -> PageRequest:
    """A page's request, decoded. Raises MessageError for any invalid bytes."""
    kind: type[PageRequest] = PageRequest  # type: ignore[assignment]
    return decode(data, kind)


def number_of(data: bytes) -> int:
    """The number of an invalid request, which its answer repeats; 0 if it has none."""
    try:
        return msgspec.json.decode(data, type=_Numbered).n
    except Exception:  # bytes of any kind
        return 0
