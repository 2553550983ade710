"""The supervisor of a daemon: starts, monitors and restarts the processes of one cell (servo, vision, gateway), and
owns its lock and runtime directory.

A gateway or vision process that ends is started again after a growing pause. The servo process is never
started again: when it ends, everything stops. Children die with the supervisor, whatever kills it (the
servo process in good order).
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
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from stereoservo.daemon.cell_preparation import PlanOptions
from stereoservo.daemon.ipc_messages import (
    OBSERVATION_CAPACITY,
    OBSERVATION_LAYOUT,
    PRIOR_CAPACITY,
    PRIOR_LAYOUT,
    STATE_CAPACITY,
    STATE_LAYOUT,
    PlanError,
    RunPlan,
    load_plan,
    save_plan,
)
from stereoservo.daemon.process_control import Termination, child_environment, write_log
from stereoservo.daemon.seqlock import create_slot, create_stop_slot, repair_stop_slot
from stereoservo.daemon.vision import Reporter
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.directories import CellDirectories, cell_directories, create_directories
from stereoservo.messages.locks import FileLock, holder
from stereoservo.ports.clock import MonotonicClock

READY_TIMEOUT_S = 60.0
SERVO_END_S = 6.0
OTHERS_END_S = 4.0
FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 10.0
STEADY_S = 30.0
"""A process that lived for so long starts again after the shortest pause."""


class StartError(Exception):
    """The daemon cannot start; the text is for the operator."""


class ServoDiedError(Exception):
    """The servo process ended by itself; everything was stopped."""


@dataclass
class Child:
    """One supervised process."""

    name: str
    arguments: list[str]
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    pause_s: float = FIRST_PAUSE_S
    due: float = 0.0
    restarts: int = 0


@dataclass
class Supervisor:
    """The processes of one cell."""

    plan: RunPlan
    children: list[Child] = field(default_factory=list)

    def __post_init__(self) -> None:
        runtime = self.plan.runtime
        self.servo = Child("servo", ["stereoservo.daemon.servo", runtime, str(os.getpid())])
        self.gateway = Child("gateway", ["stereoservo.gateway.process", runtime, str(os.getpid())])
        cameras = [
            Child(
                f"vision-{camera.name}",
                ["stereoservo.daemon.vision", runtime, str(os.getpid()), camera.name],
            )
            for camera in self.plan.cameras
        ]
        self.children = [self.servo, self.gateway, *cameras]
        self._reporter = Reporter(self.plan.directories.reports_socket, "supervisor", MonotonicClock())

    def run(self, termination: Termination, on_ready: Callable[[], None]) -> None:
        """Start all processes, monitor them until terminated, stop them. Raises StartError, ServoDiedError."""
        try:
            for child in self.children:
                _start(child)
            self._await_ready(termination)
            if not termination.asked:
                on_ready()
            while not termination.asked:
                self._watch()
                time.sleep(0.05)
        finally:
            self.stop()

    def _await_ready(self, termination: Termination) -> None:
        until = time.monotonic() + READY_TIMEOUT_S
        while not (self.plan.directories.daemon.exists() and self.plan.directories.control_socket.exists()):
            if termination.asked:
                return
            for child in (self.servo, self.gateway):
                if child.process is not None and (code := child.process.poll()) is not None:
                    raise StartError(
                        f"the {child.name} process ended at its start (exit code {code}); its message "
                        f"is above"
                    )
            if time.monotonic() > until:
                raise StartError(f"the processes were not ready within {READY_TIMEOUT_S:g} s")
            time.sleep(0.02)

    def _watch(self) -> None:
        now = time.monotonic()
        for child in self.children:
            if child.process is None:
                if now >= child.due:
                    for text in restore(self.plan):
                        self._reporter.report("warning", text)
                    _start(child)
                continue
            code = child.process.poll()
            if code is None:
                continue
            how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
            if child is self.servo:
                raise ServoDiedError(f"the servo process ended {how}; everything is stopped")
            child.process = None
            child.restarts += 1
            child.pause_s = (
                FIRST_PAUSE_S if now - child.started > STEADY_S else min(2 * child.pause_s, LONGEST_PAUSE_S)
            )
            child.due = now + child.pause_s
            self._reporter.report(
                "process_ended", f"{child.name} ended {how}; starting again in {child.pause_s:g} s"
            )
        self._reporter.flush()

    def stop(self) -> None:
        """Stop the arm first, then the processes; every child is reaped."""
        _end([self.servo], SERVO_END_S)
        _end([child for child in self.children if child is not self.servo], OTHERS_END_S)


def _start(child: Child) -> None:
    child.process = subprocess.Popen(
        [sys.executable, "-m", *child.arguments],
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr,
        env=child_environment(),
        start_new_session=True,  # Ctrl-C goes to the supervisor, which ends them in order
    )
    child.started = time.monotonic()


def _end(children: list[Child], grace_s: float) -> None:
    running = [
        child.process for child in children if child.process is not None and child.process.poll() is None
    ]
    for process in running:
        process.terminate()
    until = time.monotonic() + grace_s
    for process in running:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def prepare(
    cell_path: Path, options: PlanOptions, directories: CellDirectories, termination: Termination
) -> RunPlan | None:
    """Check the cell with its drivers, compile the kernels, create the slots; None when terminated meanwhile.

    Raises StartError.
    """
    arguments = [
        str(cell_path), str(directories.runtime), str(directories.state), str(os.getpid()),
        msgspec.json.encode(options).decode(),
    ]  # fmt: skip
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "stereoservo.daemon.cell_preparation", *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors, env=child_environment(),
        )  # fmt: skip
        while process.poll() is None:
            if termination.asked:
                process.kill()
                process.wait()
                return None
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
    found = [(directories.state_slot, STATE_CAPACITY, STATE_LAYOUT)]
    for camera in plan.cameras:
        found.append((directories.observation_slot(camera.name), OBSERVATION_CAPACITY, OBSERVATION_LAYOUT))
        found.append((directories.prior_slot(camera.name), PRIOR_CAPACITY, PRIOR_LAYOUT))
    return found


def restore(plan: RunPlan) -> list[str]:
    """Write again what a child needs in the runtime directory and no longer finds there whole; returns what that was.

    Without this a damaged file would end each new child at its start, for ever.
    """
    directories = plan.directories
    told = []
    try:
        try:
            load_plan(directories.runtime)
        except PlanError as error:
            save_plan(plan)
            told.append(f"the run plan was damaged and is written again: {error}")
        if repair_stop_slot(directories.stop_slot):
            told.append(f"{directories.stop_slot}: was damaged and is marked again as the stop slot")
        for path, capacity, layout in _slots(plan):
            if create_slot(path, capacity, layout):
                told.append(f"{path}: was damaged and is laid out again")
    except OSError as error:
        told.append(f"{directories.runtime}: cannot be put in order: {error}")
    return told


def clean(directories: CellDirectories) -> None:
    """Remove the files of a run from the runtime directory, except lock files, and files that another process (an
    emulator) holds by a lock ``NAME.lock`` beside them.
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
    with FileLock(directories.daemon_lock, f"cell {cell.cell.name!r}"):
        termination = Termination(grace_s=0.0)
        clean(directories)
        try:
            plan = prepare(cell_path.absolute(), options, directories, termination)
            if plan is not None:
                write_log("run", f"cell {cell.cell.name!r} starts; runtime directory {directories.runtime}")
                Supervisor(plan).run(termination, lambda: on_ready(plan))
        finally:
            clean(directories)
        return termination.first
