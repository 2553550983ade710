"""Fault trials of the whole service in real time: a daemon with emulated drives, of which any process is killed or hung
while the arm moves to a goal, and what a person at the cell sees of it.

The time to rest is by the emulator's true joints. Machines are shared and stall: a trial in which the arm did not move
when the fault came, or the machine stalled, is void, counted, and tried again.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from stereoservo.client import Client, ClientError, GoalHandle, SessionError
from stereoservo.daemon.seqlock import StopSlot
from stereoservo.messages.directories import CellDirectories, cell_directories
from stereoservo.messages.discovery import DaemonError, DaemonProcess
from stereoservo.messages.wire import EventMessage, decode
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.emulated import ANY_PORT, move_to_channel
from stereoservo_sim.emulators.emulator_process import EmulatorProcess
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory

CELL = "hil-can"
SPEED_SCALE = 0.1
END = 0.85
"""[rad] Of the first joint to either side, at a tenth of its speed: the arm moves for longer than any trial lasts."""
RAMP_MS = 60.0
"""From that speed to rest, by the loop's ramp or the drives' own."""
DRIVES_MS = 120.0
"""After which drives notice a master that has gone."""
SILENCE_MS = 800.0
"""After which the servo process takes the gateway for gone."""
LEASE_MS = 250.0
"""Of a jog that nobody renews."""
STOP_MS = 50.0
COMMAND_MS = 700.0
"""From the start of `stereoservo stop`."""
WATCHED_S = 2.0
"""After the fault."""
ASKED_S = 1.0
"""After the fault `status` is asked."""
MOVING = 2e-3
"""[rad/s] Of any joint, by the truth."""
READY_S = 60.0
STILL_NS = 50_000_000
TRIES = 5
WATCH = {"heartbeat_timeout_ms": "100", "rpdo_deadline_ms": "0"}
"""The drives' own watch of their master as by default, 100 ms; the shipped cell is more patient."""
STALL_S = 0.09
"""By which a thread that only sleeps comes late on a machine that stalls, short of what the drives bear."""
TERMINAL = ("goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted")
CAMERAS = '[[camera]]\nname = "{}"\ndriver = "fake"\nmount = "eye_to_hand"\n\n'
JOGS = """
import sys, time
from stereoservo.client import Client
with Client(sys.argv[1]) as client:
    while True:
        client.jog({"j1": 0.1}, lease_s=0.25)
        time.sleep(0.08)
"""


class VoidTrialError(Exception):
    """The machine stalled, and the arm did not move when the fault came."""


class StallWatch:
    """A thread that sleeps and notes by how much it came late at most [s]; a context manager that ends it."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stall-watch", daemon=True)

    def _run(self) -> None:
        last = time.monotonic()
        while not self._ended.wait(0.01):
            now = time.monotonic()
            self.longest_s = max(self.longest_s, now - last - 0.01)
            last = now

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()


@dataclass(frozen=True)
class ServiceFault:
    """What is done to the service, and what must come of it.

    ``process``, ``signal``: of the daemon's, or ``client``, or an act of the bench's own by ``act``. ``bound_ms``: to
    rest; None where the arm goes on. ``after``: what `status` may tell a second later, the
    lifecycle or the code of its error.
    """

    name: str
    bound_ms: float | None
    after: tuple[str, ...]
    process: str = ""
    signal: signal.Signals = signal.SIGKILL
    act: Callable[[ServiceBench], int] | None = None
    jogs: bool = False


def processes_of(runtime: Path) -> dict[str, int]:
    """Live processes of a cell by what they are: ``servo``, ``gateway``, ``vision-CAMERA``, …; found by the runtime
    directory on their command lines.
    """
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            state = re.search(r"^State:\s+(\w)", (entry / "status").read_text(), re.MULTILINE)
        except OSError:
            continue
        if str(runtime) not in words or state is None or state[1] in "ZX":
            continue
        module = next((word for word in words if word.startswith("stereoservo.")), "?").rpartition(".")[2]
        name = "gateway" if module == "process" else module
        if name == "vision":
            name = f"vision-{words[words.index(str(runtime)) + 2]}"
        found[name] = int(entry.name)
    return found


@dataclass
class ServiceBench:
    """A daemon with emulated drives in a directory of its own; a context manager that ends both."""

    folder: Path
    emulator: EmulatorProcess = field(init=False)
    daemon: DaemonProcess = field(init=False)
    cell: Path = field(init=False)
    directories: CellDirectories = field(init=False)
    starts: int = 0

    def __enter__(self) -> Self:
        text = shipped_cell_path(CELL).read_text(encoding="utf-8")
        front, rest = text[: text.index("[[camera]]")], text[text.index("[servo]") :]
        text = front.replace('plant = "pybullet"', 'plant = "ideal"')
        for option, value in WATCH.items():
            text = re.sub(rf"(?m)^{option} = \d+", f"{option} = {value}", text)
        path = self.folder / f"{CELL}.toml"
        path.write_text(text + CAMERAS.format("left") + CAMERAS.format("right") + rest, encoding="utf-8")
        self.directories = cell_directories(CELL)
        (self.folder / "bus").mkdir()
        self.emulator = EmulatorProcess(path, options=("--channel", ANY_PORT), log=self.folder / "drives.log")
        self.cell = move_to_channel(path, self.folder / "bus", self.emulator.wait_ready())
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end_daemon()
        self.emulator.stop()

    def start(self) -> None:
        """Start a daemon; the one before must have ended."""
        self.starts += 1
        self.daemon = DaemonProcess(self.cell, log=self.folder / f"daemon-{self.starts}.log")
        self.daemon.wait_ready()

    def end_daemon(self) -> None:
        """End the daemon, whatever became of its processes."""
        for pid in processes_of(self.directories.runtime).values():
            _send(pid, signal.SIGCONT)
        self.daemon.stop()
        until = time.monotonic() + 10.0
        while left := processes_of(self.directories.runtime):
            if time.monotonic() > until:
                for pid in left.values():
                    _send(pid, signal.SIGKILL)
            time.sleep(0.05)

    def ready(self) -> None:
        """A daemon that lives, without fault or stop, its drives on."""
        for pid in processes_of(self.directories.runtime).values():
            _send(pid, signal.SIGCONT)
        if self.daemon.process.poll() is not None:
            self.end_daemon()
            self.start()
        until = time.monotonic() + READY_S
        while True:
            try:
                return self._operated()
            except (ClientError, SessionError):  # a gateway that is being started again
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)

    def _operated(self) -> None:
        """What an operator does to go on: reset, enable, resume, where it is needed."""
        with Client(CELL) as client:
            if client.status().lifecycle == "fault":
                client.reset()
            if client.status().lifecycle != "active":
                client.enable()
            if {reason.code for reason in client.status().reasons} & {"STOPPED", "HELD"}:
                client.resume()

    def processes(self) -> dict[str, int]:
        """The daemon's processes, with its supervisor."""
        found = processes_of(self.directories.runtime)
        if self.daemon.process.poll() is None:
            found["supervisor"] = self.daemon.process.pid
        return found

    def truth(self) -> TrueJointHistory:
        """Where the emulated arm was; to be closed."""
        return TrueJointHistory.open(self.directories.runtime / FILE_NAME)

    def status(self) -> tuple[int, dict[str, Any]]:
        """What ``stereoservo status --json`` says, and its exit code."""
        done = subprocess.run(
            [sys.executable, "-m", "stereoservo.cli.main", "status", CELL, "--json"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        return done.returncode, json.loads(done.stdout)


def _send(pid: int, how: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, how)


def _raise_stop_slot(bench: ServiceBench) -> int:
    slot = StopSlot(bench.directories.stop_slot)
    t0_ns = time.monotonic_ns()
    slot.raise_stop()
    slot.close()
    return t0_ns


def _stop_command(bench: ServiceBench) -> int:
    t0_ns = time.monotonic_ns()
    command = [sys.executable, "-m", "stereoservo.cli.main", "stop", CELL]
    subprocess.run(command, capture_output=True, check=True)
    return t0_ns


def _second_daemon(bench: ServiceBench) -> int:
    t0_ns = time.monotonic_ns()
    second = DaemonProcess(bench.cell, log=bench.folder / "second.log")
    if second.process.wait(60.0) == 0:
        raise ExperimentError("two_daemons", "a second daemon of the cell ran and ended without an error")
    return t0_ns


ACTIVE = ("active",)
ENDED = ("not_running", "servo_silent")
NO_GATEWAY = ("no_reply", "session")
FAULTS = (
    ServiceFault("stop slot raised", STOP_MS, ACTIVE, act=_raise_stop_slot),
    ServiceFault("`stereoservo stop`", COMMAND_MS, ACTIVE, act=_stop_command),
    ServiceFault("servo killed", DRIVES_MS, ENDED, "servo"),
    ServiceFault("servo hung", DRIVES_MS, ("servo_silent",), "servo", signal.SIGSTOP),
    ServiceFault("gateway killed", SILENCE_MS, NO_GATEWAY, "gateway"),
    ServiceFault("gateway hung", SILENCE_MS, NO_GATEWAY, "gateway", signal.SIGSTOP),
    ServiceFault("vision killed", None, ACTIVE, "vision-left"),
    ServiceFault("vision hung", None, ACTIVE, "vision-left", signal.SIGSTOP),
    ServiceFault("supervisor killed", DRIVES_MS, ENDED, "supervisor"),
    ServiceFault("supervisor hung", None, ACTIVE, "supervisor", signal.SIGSTOP),
    ServiceFault("client killed while it jogs", LEASE_MS, ACTIVE, "client", jogs=True),
    ServiceFault("client hung while it jogs", LEASE_MS, ACTIVE, "client", signal.SIGSTOP, jogs=True),
    ServiceFault("second daemon started", None, ACTIVE, act=_second_daemon),
)


def run_service(
    repetitions: int, tell: Callable[[dict[str, Any]], None], faults: tuple[ServiceFault, ...] = FAULTS
) -> list[dict[str, Any]]:
    """Rows of all faults, ``repetitions`` trials each; ``tell`` gets each as it comes.

    Raises ExperimentError where the drives or a daemon do not come up.
    """
    kept = {name: os.environ.get(name) for name in ("STEREOSERVO_RUNTIME_DIR", "STEREOSERVO_STATE_DIR")}
    rows = []
    with tempfile.TemporaryDirectory(prefix="ssfault") as name:
        folder = Path(name)
        os.environ["STEREOSERVO_RUNTIME_DIR"] = str(folder / "r")
        os.environ["STEREOSERVO_STATE_DIR"] = str(folder / "s")
        try:
            with ServiceBench(folder) as bench:
                for fault in faults:
                    rows.append(_row(bench, fault, repetitions))
                    tell(rows[-1])
        except (DaemonError, ClientError, SessionError) as error:
            raise ExperimentError("daemon", str(error)) from error
        finally:
            for key, value in kept.items():
                if value is None:
                    os.environ.pop(key, None)
                else:
                    os.environ[key] = value
    return rows


def _row(bench: ServiceBench, fault: ServiceFault, repetitions: int) -> dict[str, Any]:
    trials: list[dict[str, Any]] = []
    void: list[str] = []
    while len(trials) < repetitions and len(void) < TRIES:
        bench.ready()
        try:
            with StallWatch() as watch:
                trial = _trial(bench, fault)
        except VoidTrialError as error:
            void.append(str(error))
            continue
        if watch.longest_s > STALL_S:
            void.append(f"the machine stalled for {watch.longest_s * 1e3:.0f} ms")
        else:
            trials.append(trial)
    rests = [trial["rest_ms"] for trial in trials if trial["rest_ms"] is not None]
    bound = None if fault.bound_ms is None else fault.bound_ms + RAMP_MS
    return {
        "fault": fault.name,
        "bound_ms": bound,
        "rest_ms": summary(rests) if rests else None,
        "within": sum(_is_within(trial["rest_ms"], bound) for trial in trials),
        "after": sorted({trial["after"] for trial in trials}),
        "status_right": sum(_status_is_right(trial, fault) for trial in trials),
        "status_says": sorted({trial["says"] for trial in trials}),
        "terminal_events": sorted({trial["terminal"] for trial in trials}),
        "trials": len(trials),
        "void": void,
    }


def _is_within(rest_ms: float | None, bound_ms: float | None) -> bool:
    """Whether the arm rested in time, or, without a bound, went on."""
    return rest_ms is None if bound_ms is None else rest_ms is not None and rest_ms <= bound_ms


def _status_is_right(trial: dict[str, Any], fault: ServiceFault) -> bool:
    """Whether `status` a second later told what is so, with exit code 1 where that is an error."""
    return trial["after"] in fault.after and trial["code"] == (0 if trial["after"] == "active" else 1)


def _trial(bench: ServiceBench, fault: ServiceFault) -> dict[str, Any]:
    """One trial. Raises VoidTrialError."""
    history = bench.truth()
    goal: GoalHandle | None = None
    jogger: subprocess.Popen[bytes] | None = None
    client = Client(CELL)
    told_live: list[EventMessage] = []
    client.session.declare_subscriber(
        client.keys.event,
        lambda sample: told_live.append(decode(sample.payload.to_bytes(), EventMessage)),
    )
    try:
        if fault.jogs:
            jogger = subprocess.Popen([sys.executable, "-c", JOGS, CELL])
        else:
            try:
                end = -END if client.status().joints["j1"] > 0.0 else END
                goal = client.goal({"j1": end}, speed_scale=SPEED_SCALE)
            except ClientError as error:
                raise VoidTrialError(str(error)) from error
        _await_motion(history)
        start = history.count
        if fault.act is not None:
            t0 = fault.act(bench)
        else:
            processes = bench.processes()
            pid = jogger.pid if jogger is not None else processes[fault.process]
            t0 = time.monotonic_ns()
            _send(pid, fault.signal)
        time.sleep(max(0.0, ASKED_S - (time.monotonic_ns() - t0) * 1e-9))
        code, told = bench.status()
        time.sleep(max(0.0, WATCHED_S - (time.monotonic_ns() - t0) * 1e-9))
        rest_ms = _rest_ms(history, start, t0)
    finally:
        history.close()
        if jogger is not None:
            _send(jogger.pid, signal.SIGCONT)
            jogger.kill()
            jogger.wait()
        with suppress(ClientError):
            client.close()
    return {
        "rest_ms": rest_ms,
        "after": str(told["error"]["code"] if "error" in told else told["lifecycle"]),
        "code": code,
        "says": str(told["error"]["message"]) if "error" in told else _reasons(told),
        "terminal": -1 if goal is None else _terminal_events(bench, goal, fault, told_live),
    }


def _reasons(status: dict[str, Any]) -> str:
    return "; ".join(reason["hint"] for reason in status["reasons"]) or "nothing is wrong"


def _terminal_events(
    bench: ServiceBench, goal: GoalHandle, fault: ServiceFault, told_live: list[EventMessage]
) -> int:
    """How many terminal events of a goal are told in the end: to who listened, by this daemon or the next."""
    bench.ready()
    with Client(CELL) as client:
        if fault.bound_ms is None:
            with suppress(ClientError):
                client.cancel(goal.id)
        time.sleep(0.3)
        told = [*told_live, *client.events(0).events]
    return len({(event.boot, event.seq) for event in told if event.kind in TERMINAL and event.id == goal.id})


def _await_motion(history: TrueJointHistory) -> None:
    until = time.monotonic() + 10.0
    while (newest := history.newest()) is None or np.abs(newest[2]).max() < 10 * MOVING:
        if time.monotonic() > until:
            raise VoidTrialError("the arm did not move within 10 s")
        time.sleep(0.01)
    time.sleep(0.2)
    newest = history.newest()
    if newest is None or np.abs(newest[2]).max() < 10 * MOVING:
        raise VoidTrialError("the arm stopped before the fault came")


def _rest_ms(history: TrueJointHistory, start: int, t0_ns: int) -> float | None:
    """From ``t0_ns`` to the last motion [ms] within the time that is watched; None where the arm still moves then."""
    end_ns = t0_ns + round(WATCHED_S * 1e9)
    last_ns = newest_ns = t0_ns
    for index in range(start, history.count):
        sample = history.sample(index)
        if sample is None or sample[0] > end_ns:
            continue
        newest_ns = sample[0]
        if np.abs(sample[2]).max() > MOVING:
            last_ns = sample[0]
    return None if newest_ns - last_ns < STILL_NS else (last_ns - t0_ns) * 1e-6
