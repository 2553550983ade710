"""A daemon with emulated drives for fault trials of the whole service, and the acts that inject faults.

An act returns the time [ns] from which the arm's time to rest counts. Resources that last for a trial (processes,
sockets, obstructing files) are in the bench's ``lasting`` stack.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import msgspec

from stereoservo.client import Client, ClientError, SessionError
from stereoservo.daemon.heartbeat import HeartbeatReader
from stereoservo.daemon.seqlock import StopSlot
from stereoservo.kinematics.model import encode_model
from stereoservo.messages.directories import RUNTIME_VARIABLE, STATE_VARIABLE, CellDirectories, cell_directories
from stereoservo.messages.discovery import DaemonError, DaemonInfo, DaemonProcess
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.emulated import ANY_PORT, move_to_channel
from stereoservo_sim.emulators.emulator_process import EmulatorProcess
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory
from stereoservo_sim.world.simulated_cell import demo_cell

T = TypeVar("T")
CELL = "hil-can"
RATE_HZ = 250.0
"""Rate of its servo loop."""
SPEED_SCALE = 0.1
END = 0.85
"""Goal of the first joint to either side [rad]: at a tenth of its speed the motion lasts longer than any trial."""
READY_S = 60.0
START_TRIES = 3
"""Attempts to start a daemon, since a loaded machine may not start it in time."""
WATCH = {"heartbeat_timeout_ms": "100", "rpdo_deadline_ms": "0"}
"""The drives' monitoring of their master as by default, 100 ms; the shipped cell is more tolerant."""
CAMERAS = '[[camera]]\nname = "{}"\ndriver = "fake"\nmount = "eye_to_hand"\n\n'
LEAST_PRIORITY = 19
"""Priority of a second daemon: whether it is refused is tested, not the effect of its start on the first one's loops.
"""
SOCKETS = 200
PUTS = 20_000
LITTLE_MEMORY = 64 << 20
"""Limit of the address space [bytes], less than the gateway uses."""
BEGINS_S = 0.4
"""Time from the first hostile socket or message to the start of timing."""
CONNECTS = """
import os, socket, sys, time
os.nice(19)
def connected():
    one = socket.socket()
    one.setblocking(False)
    one.connect_ex(("127.0.0.1", int(sys.argv[1])))
    return one
def ended(one):
    try:
        return one.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
held = [connected() for _ in range(int(sys.argv[2]))]
print("begins", flush=True)
while True:
    for k, one in enumerate(held):
        if ended(one):
            one.close()
            held[k] = connected()
    time.sleep(0.02)
"""
"""Keeps idle TCP sockets open, and reopens one that the listener closes. At least priority, since a remote peer takes
no CPU time of this machine.
"""
PUTS_REFUSED = """
import sys, time
from stereoservo.client import Client
with Client(sys.argv[1], operator="mallory") as client:
    print("begins", flush=True)
    for k in range(int(sys.argv[2])):
        client.session.put(client.keys.command("jog", "mallory"), b'{"velocities": %d' % k)
    time.sleep(60.0)
"""


class VoidTrialError(Exception):
    """The machine stalled, or the arm did not move when the fault came."""


def processes_of(runtime: Path) -> dict[str, int]:
    """Live processes of a cell by role: ``servo``, ``gateway``, ``vision-CAMERA``, …; found by the runtime directory on
    their command lines.
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


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@dataclass
class ServiceBench:
    """A daemon with emulated drives in a directory of its own; a context manager that ends both."""

    folder: Path
    lasting: ExitStack = field(default_factory=ExitStack)
    mounts: ExitStack = field(default_factory=ExitStack)
    """Unmounts the file system of the state directory, once the daemon has ended."""
    goals: list[str] = field(default_factory=list)
    """Goals of a trial; each must have one end."""
    port: int = field(default_factory=_free_port)
    """Port of the daemon's TCP endpoint."""
    emulator: EmulatorProcess = field(init=False)
    daemon: DaemonProcess = field(init=False)
    cell: Path = field(init=False)
    directories: CellDirectories = field(init=False)
    starts: int = 0

    def __enter__(self) -> Self:
        # Compilation beside the loop would affect its times.
        subprocess.run([sys.executable, "-m", "stereoservo.cli.main", "warmup"], stdout=sys.stderr, check=True)
        text = shipped_cell_path(CELL).read_text(encoding="utf-8")
        text += "\n[recording]\nreserve_mib = 0\n"  # small disks are filled to the last byte
        front, rest = text[: text.index("[[camera]]")], text[text.index("[servo]") :]
        text = front.replace('plant = "pybullet"', 'plant = "ideal"')
        rest = rest.replace('mode = "router"', f'mode = "router"\nendpoints = ["tcp/127.0.0.1:{self.port}"]')
        for option, value in WATCH.items():
            text = re.sub(rf"(?m)^{option} = \d+", f"{option} = {value}", text)
        path = self.folder / f"{CELL}.toml"
        path.write_text(text + CAMERAS.format("left") + CAMERAS.format("right") + rest, encoding="utf-8")
        self.directories = cell_directories(CELL)
        (self.folder / "bus").mkdir()
        self.emulator = EmulatorProcess(path, options=("--channel", ANY_PORT), log=self.folder / "drives.log")
        with ExitStack() as failed:
            failed.callback(self.emulator.stop)
            self.cell = move_to_channel(path, self.folder / "bus", self.emulator.wait_ready())
            failed.callback(self.end_daemon)
            self.start()
            failed.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self.mounts, self.lasting:
            self.lasting.close()
            self.end_daemon()
            self.emulator.stop()

    def start(self) -> None:
        """Start a daemon; the previous one must have ended. Raises DaemonError."""
        for tries_left in reversed(range(START_TRIES)):
            self.starts += 1
            self.daemon = DaemonProcess(self.cell, log=self.folder / f"daemon-{self.starts}.log")
            try:
                self.daemon.wait_ready()
                return
            except DaemonError as error:
                if not tries_left or "not ready within" not in error.output:
                    raise

    def end_daemon(self) -> None:
        """End the daemon, whatever the state of its processes."""
        for pid in self.processes().values():
            send(pid, signal.SIGCONT)
        self.daemon.stop()
        until = time.monotonic() + 10.0
        while left := processes_of(self.directories.runtime):
            if time.monotonic() > until:
                for pid in left.values():
                    send(pid, signal.SIGKILL)
            time.sleep(0.05)

    def ready(self) -> None:
        """Restore a live daemon without fault or stop, its drives on."""
        for pid in self.processes().values():
            send(pid, signal.SIGCONT)
        if self.daemon.process.poll() is not None:
            self.end_daemon()
            self.start()
        self.query(_operated)

    def query(self, ask: Callable[[Client], T]) -> T:
        """The answer of a daemon whose gateway may be restarting. Raises ClientError, SessionError."""
        until = time.monotonic() + READY_S
        while True:
            try:
                with Client(CELL) as client:
                    return ask(client)
            except (ClientError, SessionError):
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)

    def query_ready(self, ask: Callable[[Client], T]) -> T:
        """The answer of a cell that is made ready first, again if a stalled machine stopped it since."""

        def operated(client: Client) -> T:
            _operated(client)
            return ask(client)

        self.ready()
        return self.query(operated)

    def delete_state(self) -> None:
        """Remove the models and taught goals of a trial, and the disk they are on."""
        self.mounts.close()
        for path in (*self.directories.models.glob("*"), *self.directories.state.glob("taught.json*")):
            path.unlink()

    def start_lasting(self, program: str, *arguments: str) -> None:
        """Start a Python program that lasts for the trial, and wait until it has begun."""
        child = subprocess.Popen([sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE)
        self.lasting.callback(_end, child)
        assert child.stdout is not None
        if not child.stdout.readline():
            raise ExperimentError("hostile", "a hostile program ended at its start")

    def processes(self) -> dict[str, int]:
        """The daemon's processes, with its supervisor."""
        found = processes_of(self.directories.runtime)
        if self.daemon.process.poll() is None:
            found["supervisor"] = self.daemon.process.pid
        return found

    def await_process(self, name: str) -> None:
        """Wait until a process of the daemon, which may be restarting, is alive and responds.

        Raises VoidTrialError.
        """
        until = time.monotonic() + READY_S
        seen_ns = 0
        with closing(HeartbeatReader(self.directories.heartbeat_slot(name))) as reader:
            while not seen_ns or (beat := reader.newest()) is None or beat.t_ns < seen_ns:
                if time.monotonic() > until:
                    raise VoidTrialError(f"there was no {name} process within {READY_S:g} s")
                if not seen_ns and name in self.processes():
                    seen_ns = time.monotonic_ns()
                time.sleep(0.01)

    def truth(self) -> TrueJointHistory:
        """The emulated arm's true motion; to be closed."""
        return TrueJointHistory.open(self.directories.runtime / FILE_NAME)

    def status(self) -> tuple[int, dict[str, Any]]:
        """The output of ``stereoservo status --json``, and its exit code."""
        done = subprocess.run(
            [sys.executable, "-m", "stereoservo.cli.main", "status", CELL, "--json"],
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, json.loads(done.stdout)


@contextmanager
def running_bench() -> Iterator[ServiceBench]:
    """A running daemon with its own directories, also those of clients that are started inside.

    Raises ExperimentError for errors of a daemon or a client.
    """
    with tempfile.TemporaryDirectory(prefix="ssbench") as name:
        folder = Path(name)
        with environment(directories_in(folder)):
            try:
                with ServiceBench(folder) as bench:
                    yield bench
            except (DaemonError, ClientError, SessionError) as error:
                raise ExperimentError("daemon", str(error)) from error


@contextmanager
def running_daemon(
    path: Path, folder: Path, options: tuple[str, ...] = (), environ: dict[str, str] | None = None, code: str = "daemon"
) -> Iterator[DaemonInfo]:
    """The running daemon of a cell file, with its directories in ``folder``; ``environ``: for its processes.

    Raises ExperimentError ``code`` for errors of a daemon or a client.
    """
    log = folder / "daemon.log"
    with environment(directories_in(folder)):
        try:
            with DaemonProcess(path, options=options, log=log, environment=environ) as daemon:
                yield daemon.wait_ready()
        except (ClientError, DaemonError) as error:
            raise ExperimentError(code, f"{error}; {log.read_text()[-2000:]}") from error


def directories_in(folder: Path) -> dict[str, str]:
    """Variables that put a cell's directories into ``folder``."""
    return {RUNTIME_VARIABLE: str(folder / "r"), STATE_VARIABLE: str(folder / "s")}


@contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
    """Context manager: environment variables of this process and of those it starts."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def send(pid: int, how: signal.Signals) -> None:
    """Send a signal to a process, if it lives."""
    with suppress(ProcessLookupError):
        os.kill(pid, how)


def _operated(client: Client) -> None:
    """An operator's actions to continue: reset, enable, resume, as needed."""
    if client.status().lifecycle == "fault":
        client.reset()
    if client.status().lifecycle != "active":
        client.enable()
    if {reason.code for reason in client.status().reasons} & {"STOPPED", "HELD"}:
        client.resume()


def _end(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.wait()
    if child.stdout is not None:
        child.stdout.close()


# -- acts -----------------------------------------------------------------------------------------------------


def raise_stop_slot(bench: ServiceBench) -> int:
    """Set the stop flag in shared memory."""
    slot = StopSlot(bench.directories.stop_slot)
    t0_ns = time.monotonic_ns()
    slot.raise_stop()
    slot.close()
    return t0_ns


def stop_command(bench: ServiceBench) -> int:
    """Run ``stereoservo stop``; the time is its start."""
    t0_ns = time.monotonic_ns()
    command = [sys.executable, "-m", "stereoservo.cli.main", "stop", CELL]
    subprocess.run(command, capture_output=True, check=True)
    return t0_ns


def second_daemon(bench: ServiceBench) -> int:
    """Start a second daemon of the cell; the time is that of its refusal."""
    _refused(bench, bench.cell, {})
    return time.monotonic_ns()


def second_daemon_elsewhere(bench: ServiceBench) -> int:
    """Start a second daemon of the same drives with other directories and endpoints; the time is its refusal."""
    folder = bench.folder / "other"
    folder.mkdir(exist_ok=True)
    cell = folder / bench.cell.name
    cell.write_text(re.sub(r"(?m)^endpoints = .*$", "", bench.cell.read_text(encoding="utf-8")))
    directories = {f"STEREOSERVO_{name}_DIR": str(folder / name[0].lower()) for name in ("RUNTIME", "STATE")}
    _refused(bench, cell, directories)
    return time.monotonic_ns()


def _refused(bench: ServiceBench, cell: Path, environment: dict[str, str]) -> None:
    """Start a daemon that must end by itself because of a lock. Raises ExperimentError, VoidTrialError."""
    log = bench.folder / "second.log"
    with DaemonProcess(cell, log=log, environment=environment) as second:
        os.setpriority(os.PRIO_PROCESS, second.process.pid, LEAST_PRIORITY)
        try:
            code = second.process.wait(READY_S)
        except subprocess.TimeoutExpired as error:
            raise VoidTrialError(f"a second daemon did not end within {READY_S:g} s") from error
        if code == 0 or "already in use" not in second.output():
            raise ExperimentError("two_daemons", f"a second daemon was not refused: {second.output()}")


def damaged(spoil: Callable[[CellDirectories], None]) -> Callable[[ServiceBench], int]:
    """Kill the gateway, and damage its files."""

    def act(bench: ServiceBench) -> int:
        gateway = bench.processes()["gateway"]
        t0_ns = time.monotonic_ns()
        send(gateway, signal.SIGSTOP)
        spoil(bench.directories)
        send(gateway, signal.SIGKILL)
        return t0_ns

    return act


def spoil_taught(directories: CellDirectories) -> None:
    """Truncate ``taught.json``."""
    directories.taught.write_bytes(b'{"goals": {"park": {"set_poi')


def spoil_model(directories: CellDirectories) -> None:
    """Flip a byte of the newest of two models."""
    directories.models.mkdir(exist_ok=True)
    good = exact_simulated_model(demo_cell(), 0)
    (directories.models / f"model-{good.epoch:06d}.json").write_bytes(encode_model(good))
    data = bytearray(encode_model(msgspec.structs.replace(good, epoch=good.epoch + 1)))
    data[len(data) // 2] ^= 0x10
    (directories.models / f"model-{good.epoch + 1:06d}.json").write_bytes(bytes(data))


def spoil_handled(directories: CellDirectories) -> None:
    """Fill the slot of the handled events with ones."""
    slot = directories.runtime / "handled.slot"
    with slot.open("r+b") as file:
        file.write(b"\xff" * slot.stat().st_size)


def idle_sockets(bench: ServiceBench) -> int:
    """Exhaust the listener with idle TCP sockets."""
    t0_ns = time.monotonic_ns()
    bench.start_lasting(CONNECTS, str(bench.port), str(SOCKETS))
    return t0_ns


def refused_puts(bench: ServiceBench) -> int:
    """Flood with invalid commands."""
    t0_ns = time.monotonic_ns()
    bench.start_lasting(PUTS_REFUSED, CELL, str(PUTS))
    return t0_ns


def during(first: Callable[[ServiceBench], int], then: Callable[[ServiceBench], int]) -> Callable[[ServiceBench], int]:
    """An act during another; the time is that of the second."""

    def act(bench: ServiceBench) -> int:
        first(bench)
        time.sleep(BEGINS_S)
        return then(bench)

    return act


def stop_by_open_session(bench: ServiceBench) -> int:
    """A client that connected by TCP before the listener was exhausted requests the stop."""
    with Client(CELL, endpoint=f"tcp/127.0.0.1:{bench.port}") as client:
        idle_sockets(bench)
        time.sleep(BEGINS_S)
        t0_ns = time.monotonic_ns()
        client.stop()
    return t0_ns


def second_client(bench: ServiceBench) -> int:
    """Another client's goal preempts the first, in the same direction."""
    client = bench.lasting.enter_context(Client(CELL))
    end = 0.95 * END if client.status().command["j1"] > 0.0 else -0.95 * END
    t0_ns = time.monotonic_ns()
    bench.goals.append(client.goal({"j1": end}, speed_scale=SPEED_SCALE).id)
    return t0_ns


def memory_exhausted(bench: ServiceBench) -> int:
    """Deny the gateway further memory, and send large messages."""
    gateway = bench.processes()["gateway"]
    hard = resource.prlimit(gateway, resource.RLIMIT_AS)[1]

    def free() -> None:
        with suppress(ProcessLookupError):
            resource.prlimit(gateway, resource.RLIMIT_AS, (hard, hard))

    bench.lasting.callback(free)
    with Client(CELL, operator="mallory") as client:
        t0_ns = time.monotonic_ns()
        resource.prlimit(gateway, resource.RLIMIT_AS, (LITTLE_MEMORY, hard))
        for _ in range(40):
            client.session.put(client.keys.command("jog", "mallory"), b" " * 200_000)
    return t0_ns
