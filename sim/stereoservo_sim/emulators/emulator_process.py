"""``stereoservo emulate`` as a child process."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from stereoservo_sim.emulators.fault_engine import FaultCommandError


class EmulatorError(Exception):
    """The emulator did not start, or ended; carries its output."""

    def __init__(self, message: str, code: int | None, output: str) -> None:
        super().__init__(message)
        self.code = code
        self.output = output


class EmulatorProcess:
    """An emulator of a cell's drives or cameras as a child process; a context manager that ends it.

    ``cell``: a cell file, or the name of a shipped cell. ``what``: ``drives`` or ``cameras``. ``options``: further ones
    of the command. ``log``: file for its stderr (default: inherited). ``events``: those reported so far, oldest first,
    times in ``t_ns``. It ends with this process; start it from a thread that lives at least as long.
    """

    def __init__(
        self,
        cell: Path | str,
        *,
        what: str = "drives",
        options: tuple[str, ...] = (),
        log: Path | None = None,
        environment: dict[str, str] | None = None,
    ) -> None:
        self.channel = ""
        self._what = f"emulated {what}"
        self.events: list[dict[str, Any]] = []
        self._log = log
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        self._ready = threading.Event()
        command = [
            sys.executable, "-m", "stereoservo.cli.main", "emulate", what, str(cell), "--json",
            "--parent", str(os.getpid()), *options,
        ]  # fmt: skip
        stream = log.open("wb") if log is not None else None
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stream,
                text=True,
                env={**os.environ, **(environment or {})},
            )
        finally:
            if stream is not None:
                stream.close()
        self._reader = threading.Thread(target=self._read, name="emulator-events", daemon=True)
        self._reader.start()

    def wait_ready(self, timeout_s: float = 120.0) -> str:
        """Wait until it is ready; returns its channel. Raises EmulatorError with its output."""
        until = time.monotonic() + timeout_s
        while not self._ready.wait(0.05):
            code = self.process.poll()
            if code is not None:
                self._reader.join(1.0)
                raise EmulatorError(f"the {self._what} ended (exit code {code}): {self.output()}", code, self.output())
            if time.monotonic() > until:
                raise EmulatorError(f"no {self._what} within {timeout_s:g} s", None, self.output())
        return self.channel

    def order(self, text: str, timeout_s: float = 10.0) -> str:
        """Send a fault command (`help` lists them); returns the reply. Raises FaultCommandError, EmulatorError."""
        if self.process.stdin is None or self.process.poll() is not None:
            raise EmulatorError(f"the {self._what} have ended", self.process.poll(), self.output())
        self.process.stdin.write(text.replace("\n", " ") + "\n")
        self.process.stdin.flush()
        try:
            answer = self._answers.get(timeout=timeout_s)
        except queue.Empty:
            raise EmulatorError(f"{text!r}: no answer within {timeout_s:g} s", None, self.output()) from None
        if not answer["ok"]:
            raise FaultCommandError(answer["answer"])
        return str(answer["answer"])

    def output(self) -> str:
        """Its log so far, and its error, if any."""
        logged = self._log.read_text(errors="replace").strip() if self._log is not None else ""
        errors = [str(event["error"]) for event in self.events if "error" in event]
        return "\n".join([part for part in (logged, *errors) if part])

    def stop(self, how: signal.Signals = signal.SIGTERM, timeout_s: float = 10.0) -> int:
        """Terminate it (drives without power, arm at rest); returns its exit code. Idempotent."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        self._reader.join(5.0)
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None and not stream.closed:
                stream.close()
        return code

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            try:
                event = json.loads(line)
            except json.JSONDecodeError:
                event = {"event": "text", "text": line.rstrip()}
            self.events.append(event)
            kind = event.get("event")
            if kind == "ready":
                self.channel = event["channel"]
                self._ready.set()
            elif kind == "answer":
                self._answers.put(event)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
