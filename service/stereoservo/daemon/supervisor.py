"""The supervisor of a daemon: starts, monitors and restarts the processes of one cell (servo, vision, gateway, and the
plant of a simulated cell), and owns its lock and runtime directory.

A gateway, vision or plant process that ends is restarted after a growing pause. The servo process is never restarted:
when it ends, everything stops. A process that hangs (its heartbeat is late) is killed and treated as ended. Children
die with the supervisor in all cases (the servo process with an orderly shutdown).
"""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NoReturn

import msgspec

from stereoservo.daemon import record_ring
from stereoservo.daemon.channels.reports import Reporter
from stereoservo.daemon.heartbeat import (
    HEARTBEAT_BYTES,
    HEARTBEAT_LAYOUT,
    SUPERVISOR_HANG_S,
    HangWatch,
    HeartbeatWriter,
)
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_CAPACITY,
    OBSERVATION_LAYOUT,
    PRIOR_CAPACITY,
    PRIOR_LAYOUT,
    STATE_CAPACITY,
    PlanError,
    PlanOptions,
    RunPlan,
    load_plan,
    save_plan,
)
from stereoservo.daemon.plant_driver import PLANT_CAPACITY, PLANT_ORDERS_LAYOUT, PLANT_STATE_LAYOUT
from stereoservo.daemon.preview import PICTURE_CAPACITY, PICTURE_LAYOUT, REQUEST_BYTES, REQUEST_LAYOUT
from stereoservo.daemon.process_control import Termination, child_environment, write_log
from stereoservo.daemon.seqlock import create_slot, create_stop_slot, repair_stop_slot
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.compilation_progress import ProgressTimeout, read_progress
from stereoservo.messages.directories import CellDirectories, cell_directories, create_directories
from stereoservo.messages.locks import FileLock, holder
from stereoservo.messages.run_record import begin_run, end_run, run_is_up
from stereoservo.messages.servo_state import STATE_LAYOUT
from stereoservo.ports.clock import MonotonicClock

READY_TIMEOUT_S = 300.0
"""Time limit for the processes to be ready after the last compilation of a kernel for them [s]."""
REPORT_EVERY_S = 10.0
"""Interval of progress lines in the log while kernels are compiled [s]."""
SERVO_END_S = 6.0
OTHERS_END_S = 4.0
FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 10.0
WATCH_EVERY_S = 0.05
LATE_S = 0.25
"""Delay of the supervisor's check [s] above which it was itself stalled: the silence of a process does not count
then.
"""
AFTER_SERVO = (
    "The drives stop by themselves without its commands. See what it logged last, and `stereoservo doctor` on the "
    "drives, before you run the cell again"
)
STEADY_S = 30.0
"""Lifetime of a process [s] after which it is restarted with the shortest pause."""


class StartError(Exception):
    """The daemon cannot start; the message is for the operator."""


class ServoDiedError(Exception):
    """The servo process ended or hung, see ``cause``; everything was stopped."""

    def __init__(self, cause: str) -> None:
        super().__init__(f"{cause}. {AFTER_SERVO}")
        self.cause = cause


@dataclass
class Child:
    """One supervised process. ``hung``: description of the hang for which it was killed."""

    name: str
    arguments: list[str]
    watch: HangWatch
    hung: str = ""
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    pause_s: float = FIRST_PAUSE_S
    due: float = 0.0
    restarts: int = 0


class Compilation:
    """The niced process that compiles the missing kernels at a first start, while all others run."""

    def __init__(self, runtime: Path) -> None:
        self._runtime = runtime
        self._process: subprocess.Popen[bytes] | None = None
        self._due: float | None = 0.0

    def check(self, now: float) -> str:
        """Start it if it is due; returns how it failed, once, else ''."""
        if self._process is None:
            if self._due is not None and now >= self._due:
                arguments = [str(os.getpid()), "beside", str(self._runtime)]
                self._process = _spawn(["stereoservo.daemon.kernel_compilation", *arguments])
            return ""
        code = self._process.poll()
        if code is None:
            return ""
        self._process = None
        self._due = None if code == 0 else now + LONGEST_PAUSE_S
        return "" if code == 0 else f"{_how(code)}; starting again in {LONGEST_PAUSE_S:g} s"

    def end(self) -> None:
        """Idempotent."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


@dataclass
class Supervisor:
    """The processes of one cell."""

    plan: RunPlan
    compilation: Compilation | None = None
    children: list[Child] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.servo = self._child("servo", "stereoservo.daemon.servo")
        self.gateway = self._child("gateway", "stereoservo.gateway.process")
        cameras = [
            self._child(f"vision-{camera.name}", "stereoservo.daemon.vision", camera.name)
            for camera in self.plan.cameras
        ]
        self.plant = [self._child("plant", "stereoservo.daemon.plant")] if self.plan.joints.simulated else []
        self.children = [*self.plant, self.servo, self.gateway, *cameras]
        self._reporter = Reporter(self.plan.directories.reports_socket, "supervisor", MonotonicClock())
        self._looked_s = 0.0

    def _child(self, name: str, module: str, *arguments: str) -> Child:
        watch = HangWatch(self.plan.directories.heartbeat_slot(name))
        return Child(name, [module, self.plan.runtime, str(os.getpid()), *arguments], watch)

    def run(self, termination: Termination, on_ready: Callable[[], None]) -> None:
        """Start all processes, monitor them until terminated, stop them. Raises StartError, ServoDiedError."""
        try:
            for child in self.children:
                _start(child)
            self._await_ready(termination)
            if not termination.asked:
                record_run(partial(run_is_up, self.plan.directories))
                on_ready()
            with closing(HeartbeatWriter(self.plan.directories.heartbeat_slot("supervisor"))) as heartbeat:
                while not termination.asked:
                    heartbeat.beat(SUPERVISOR_HANG_S)
                    self.check(time.monotonic())
                    time.sleep(WATCH_EVERY_S)
        except ServoDiedError as error:
            # Before the gateway ends, which reports it.
            record_run(partial(end_run, self.plan.directories, error.cause, AFTER_SERVO))
            raise
        finally:
            self.stop()

    def _await_ready(self, termination: Termination) -> None:
        wait = ProgressTimeout(READY_TIMEOUT_S)
        while not (self.plan.directories.daemon.exists() and self.plan.directories.control_socket.exists()):
            if termination.asked:
                return
            for child in (*self.plant, self.servo, self.gateway):
                if child.process is not None and (code := child.process.poll()) is not None:
                    raise StartError(
                        f"the {child.name} process ended at its start (exit code {code}); its message is above"
                    )
            if wait.is_over(read_progress(self.plan.directories.runtime)):
                raise StartError(
                    f"the processes were not ready within {READY_TIMEOUT_S:g} s, in which no kernel was compiled either"
                )
            time.sleep(0.02)

    def check(self, now: float) -> None:
        """Start the processes that are due, and handle those that have ended or hang. Raises ServoDiedError."""
        late = now - self._looked_s > LATE_S
        self._looked_s = now
        for child in self.children:
            if child.process is None:
                if now >= child.due:
                    for text in restore(self.plan):
                        self._reporter.report("warning", text)
                    _start(child)
                continue
            hung = child.watch.check(now, late=late)
            if hung and not child.hung:
                child.hung = f"hung: {hung}; it was killed"
                child.process.kill()
                if child is self.servo:
                    self._servo_ended(child.hung)
            code = child.process.poll()
            if code is not None:
                self._ended(child, child.hung or _how(code), now)
        if self.compilation is not None and (how := self.compilation.check(now)):
            self._reporter.report("process_ended", f"the compilation of kernels {how}")
        self._reporter.flush()

    def _ended(self, child: Child, how: str, now: float) -> None:
        """Handle the end of a process: it is restarted after a pause, unless it is the servo process."""
        if child is self.servo:
            self._servo_ended(how)
        kind = "process_hung" if child.hung else "process_ended"
        child.process = None
        child.hung = ""
        child.restarts += 1
        child.pause_s = FIRST_PAUSE_S if now - child.started > STEADY_S else min(2 * child.pause_s, LONGEST_PAUSE_S)
        child.due = now + child.pause_s
        self._reporter.report(kind, f"{child.name} {how}; starting again in {child.pause_s:g} s")

    def _servo_ended(self, how: str) -> NoReturn:
        message = f"the servo process {how}; everything is stopped"
        self._reporter.report("process_hung" if self.servo.hung else "process_ended", message)
        raise ServoDiedError(message)

    def stop(self) -> None:
        """Stop the arm first, then the processes; every child is reaped."""
        _end([self.servo], SERVO_END_S)
        _end([child for child in self.children if child is not self.servo], OTHERS_END_S)


def _how(code: int) -> str:
    """How a process ended, by its exit code."""
    if code >= 0:
        return f"ended with exit code {code}"
    return f"ended by signal {signal.Signals(-code).name} (signal {-code})"


def _start(child: Child) -> None:
    child.watch.begin()
    child.process = _spawn(child.arguments)
    child.started = time.monotonic()


def _spawn(arguments: list[str]) -> subprocess.Popen[bytes]:
    """A Python process of a module with its arguments."""
    return subprocess.Popen(
        [sys.executable, "-m", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr,
        env=child_environment(),
        start_new_session=True,  # Ctrl-C goes to the supervisor, which ends its children in order
    )


def _end(children: list[Child], grace_s: float) -> None:
    running = [child.process for child in children if child.process is not None and child.process.poll() is None]
    for process in running:
        process.terminate()
    until = time.monotonic() + grace_s
    for process in running:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class ProgressLines:
    """Log lines on the number of compiled kernels."""

    def __init__(self) -> None:
        self._due_s = time.monotonic() + REPORT_EVERY_S
        self._said = ""

    def check(self, runtime: Path) -> None:
        """Log the progress, if it is time and there is progress."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + REPORT_EVERY_S
        words = ", ".join(f"{one.part}: {one.text}" for one in read_progress(runtime))
        if words != self._said:
            self._said = words
            write_log("run", f"compiling kernels for this computer, once ({words})")


def prepare(
    cell_path: Path, options: PlanOptions, directories: CellDirectories, termination: Termination
) -> RunPlan | None:
    """Check the cell with its drivers, compile the first kernels, create the slots; None when terminated meanwhile.

    Raises StartError.
    """
    arguments = [
        str(cell_path),
        str(directories.runtime),
        str(directories.state),
        str(os.getpid()),
        msgspec.json.encode(options).decode(),
    ]
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "stereoservo.daemon.cell_preparation", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env=child_environment(),
        )
        progress = ProgressLines()
        while process.poll() is None:
            if termination.asked:
                process.kill()
                process.wait()
                return None
            progress.check(directories.runtime)
            time.sleep(0.02)
        errors.seek(0)
        text = errors.read().decode(errors="replace").strip()
    if process.returncode != 0:
        raise StartError(text or f"checking the cell ended with exit code {process.returncode}")
    plan = load_plan(directories.runtime)
    create_stop_slot(directories.stop_slot)
    for path, capacity, layout in _slots(plan):
        create_slot(path, capacity, layout)
    return plan


def _slots(plan: RunPlan) -> list[tuple[Path, int, str]]:
    """Path, capacity and layout of all slots of a cell."""
    directories = plan.directories
    found = [
        (directories.state_slot, STATE_CAPACITY, STATE_LAYOUT),
        (directories.steps_ring, record_ring.CAPACITY, record_ring.LAYOUT),
    ]
    if plan.joints.simulated:
        found.append((directories.plant_state_slot, PLANT_CAPACITY, PLANT_STATE_LAYOUT))
        found.append((directories.plant_orders_slot, PLANT_CAPACITY, PLANT_ORDERS_LAYOUT))
        found.append((directories.heartbeat_slot("plant"), HEARTBEAT_BYTES, HEARTBEAT_LAYOUT))
    for name in ("servo", "gateway", "supervisor", *(f"vision-{camera.name}" for camera in plan.cameras)):
        found.append((directories.heartbeat_slot(name), HEARTBEAT_BYTES, HEARTBEAT_LAYOUT))
    for camera in plan.cameras:
        found.append((directories.observation_slot(camera.name), OBSERVATION_CAPACITY, OBSERVATION_LAYOUT))
        found.append((directories.prior_slot(camera.name), PRIOR_CAPACITY, PRIOR_LAYOUT))
        found.append((directories.preview_slot(camera.name), PICTURE_CAPACITY, PICTURE_LAYOUT))
        found.append((directories.preview_request_slot(camera.name), REQUEST_BYTES, REQUEST_LAYOUT))
    return found


def restore(plan: RunPlan) -> list[str]:
    """Rewrite damaged or missing files that children need in the runtime directory; returns messages on these.

    Otherwise a damaged file would end every new child at its start, forever.
    """
    directories = plan.directories
    messages = []
    try:
        try:
            load_plan(directories.runtime)
        except PlanError as error:
            save_plan(plan)
            messages.append(f"the run plan was damaged and is written again: {error}")
        if repair_stop_slot(directories.stop_slot):
            messages.append(f"{directories.stop_slot}: was damaged and is marked again as the stop slot")
        for path, capacity, layout in _slots(plan):
            if create_slot(path, capacity, layout):
                messages.append(f"{path}: was damaged and is laid out again")
    except OSError as error:
        messages.append(f"{directories.runtime}: cannot be put in order: {error}")
    return messages


def record_run(write: Callable[[], None]) -> None:
    """Write the record of this run by ``write``; an error of the disk does not stop the daemon."""
    try:
        write()
    except OSError as error:
        write_log("supervisor", f"the record of this run: {error}")


def clean(directories: CellDirectories) -> None:
    """Remove the files of a run from the runtime directory, except lock files, and files for which another process (an
    emulator) holds a lock ``NAME.lock`` in the same directory.
    """
    if not directories.runtime.is_dir():
        return
    for path in directories.runtime.iterdir():
        held = holder(path.with_name(f"{path.name}.lock")) is not None
        if path.suffix != ".lock" and not path.is_dir() and not held:
            path.unlink(missing_ok=True)


def run_cell(
    cell_path: Path,
    *,
    seed: int = 0,
    dry_run: bool = False,
    commissioning: bool = False,
    record: str = "",
    on_ready: Callable[[RunPlan], None] = lambda plan: None,
) -> int:
    """Run the daemon of a cell until SIGTERM or SIGINT; returns the signal that ended it.

    Raises CellFileError, DirectoryError, AlreadyRunningError, StartError, ServoDiedError, each after
    everything stopped.
    """
    cell = load_cell_file(cell_path)
    directories = cell_directories(cell.cell.name)
    create_directories(directories)
    options = PlanOptions(secrets.token_hex(4), seed, dry_run, commissioning, record)
    what = f"cell {cell.cell.name!r}"
    with FileLock(directories.daemon_lock, what), FileLock(directories.state_lock, what):
        termination = Termination(grace_s=0.0)
        clean(directories)
        record_run(partial(begin_run, directories, options.boot, os.getpid()))
        compilation = Compilation(directories.runtime)
        try:
            compilation.check(0.0)  # during the preparation and, niced, during operation
            plan = prepare(cell_path.absolute(), options, directories, termination)
            if plan is not None:
                write_log("run", f"cell {cell.cell.name!r} starts; runtime directory {directories.runtime}")
                Supervisor(plan, compilation).run(termination, lambda: on_ready(plan))
            asked = signal.Signals(termination.first).name
            record_run(partial(end_run, directories, f"somebody asked for it ({asked})", in_order=True))
        except Exception as error:
            record_run(partial(end_run, directories, str(error)))
            raise
        finally:
            compilation.end()
            clean(directories)
        return termination.first
