"""Console of an emulator: fault commands from standard input, replies and events on standard output."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import queue
import sys
import threading
from collections.abc import Callable
from typing import Any, Protocol

from stereoservo_sim.emulators.fault_engine import FaultCommandError

LINE_LIMIT = 4096
LINES_WAITING = 10_000


class EmulationEvent(Protocol):
    """An event at ``t_ns``: ``place`` is its location as data, ``where()`` as text."""

    @property
    def t_ns(self) -> int: ...

    @property
    def kind(self) -> str: ...

    @property
    def text(self) -> str: ...

    def place(self) -> dict[str, Any]: ...

    def where(self) -> str: ...


class OrderedServer(Protocol):
    """Protocol of an emulator's serving loop for its console. ``obey`` raises FaultCommandError."""

    on_event: Callable[[Any], None] | None

    @property
    def start_ns(self) -> int: ...

    def watch(self, descriptor: int, act: Callable[[], None]) -> None: ...

    def unwatch(self, descriptor: int) -> None: ...

    def obey(self, text: str) -> str: ...


class Printer:
    """Prints lines in its own thread, so that a slow or missing reader does not delay the emulation."""

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json
        self.lost = 0
        self._lines: queue.Queue[str | None] = queue.Queue(LINES_WAITING)
        self._thread = threading.Thread(target=self._run, name="console", daemon=True)
        self._thread.start()

    def say(self, event: str, text: str, /, **data: Any) -> None:
        """Print one line: ``text``, or with ``--json`` an object with ``event`` and ``data``."""
        line = json.dumps({"event": event, **data}) if self.as_json else text
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self.lost += 1

    def end(self) -> None:
        """Print queued lines, for a second at most."""
        self._lines.put(None)
        self._thread.join(1.0)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            try:
                sys.stdout.write(line + "\n")
                sys.stdout.flush()
            except (BrokenPipeError, ValueError):
                return


class Console:
    """Reads fault commands from ``descriptor`` in the server's loop, replies through ``printer``."""

    def __init__(self, server: OrderedServer, printer: Printer, descriptor: int = 0) -> None:
        self._server = server
        self._printer = printer
        self._descriptor = descriptor
        self._rest = b""

    def attach(self) -> None:
        """Start reading; the end of the input only ends the commands."""
        self._server.on_event = self.event
        self._server.watch(self._descriptor, self._read)

    def event(self, event: EmulationEvent) -> None:
        """Print an event. Times are [s] since the server's start."""
        seconds = (event.t_ns - self._server.start_ns) * 1e-9
        if not self._printer.as_json and event.kind == "order":
            return  # its reply reports it
        where = f"{event.where()}: " if event.where() else ""
        self._printer.say(
            event.kind,
            f"{seconds:10.4f} s  {where}{event.kind.replace('_', ' ')}{f' {event.text}' if event.text else ''}",
            t_ns=event.t_ns,
            t_s=round(seconds, 6),
            **event.place(),
            text=event.text,
        )

    def order(self, text: str) -> bool:
        """Execute a fault command and print the reply; returns whether it succeeded."""
        try:
            answer = self._server.obey(text)
        except FaultCommandError as error:
            self._printer.say("answer", f"error: {error}", ok=False, order=text, answer=str(error))
            return False
        self._printer.say("answer", answer, ok=True, order=text, answer=answer)
        return True

    def _read(self) -> None:
        chunk = os.read(self._descriptor, LINE_LIMIT)
        if not chunk:
            self._server.unwatch(self._descriptor)
            return
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        self._rest = self._rest[-LINE_LIMIT:]
        for line in lines:
            if text := line.decode(errors="replace").strip():
                self.order(text)


def begin_serving(server: OrderedServer, printer: Printer, priority: int, text: str, **data: Any) -> None:
    """Attach the console, run with the real-time ``priority`` where it is permitted, and report ``text`` as ready."""
    Console(server, printer).attach()
    with contextlib.suppress(OSError):  # may not be allowed
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    gc.freeze()  # imported objects are not scanned again
    printer.say("ready", text, t_ns=server.start_ns, pid=os.getpid(), **data)
