"""Settings of the whole suite."""

import ast
import functools
import os
import resource
import socket
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import pytest
from hypothesis import settings
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

import machine_stalls

# Before numpy is loaded: on two shared cores the threads of OpenBLAS only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# No deadline: the machines that run this are shared and stall, and kernels compile on first use.
settings.register_profile("stereoservo", deadline=None)
settings.load_profile("stereoservo")

FAST = ("control", "core", "geometry", "kinematics", "messages", "planning")
"""Folders whose tests have the marker `fast`, slow ones aside."""
NOT_FAST = {
    "control/test_cartesian2.py",
    "control/test_pd.py",
    "control/test_sight.py",
    "core/test_allocations.py",
    "core/test_corrupted_inputs.py",
    "core/test_goal_attacks.py",
    "core/test_goal_kinds.py",
    "core/test_goal_life.py",
    "core/test_mobile.py",
    "core/test_reanchoring.py",
    "core/test_recording.py",
    "core/test_trials.py",
    "geometry/test_alignment.py",
    "geometry/test_distortion_lines.py",
    "geometry/test_incidences.py",
    "geometry/test_moved_cameras.py",
    "geometry/test_rotations.py",
    "geometry/test_translations.py",
    "kinematics/inverse/test_families.py",
    "kinematics/inverse/test_recognition.py",
    "kinematics/test_denavit_hartenberg.py",
    "kinematics/test_gauge_free.py",
    "kinematics/test_generality.py",
    "kinematics/test_joint_angles.py",
    "messages/test_locks.py",  # starts processes
}
"""What of them takes seconds a test: marker `fast` is for less than a minute in all."""


def is_fast(path: Path) -> bool:
    """Whether the tests of a file have the marker `fast`."""
    try:
        name = path.relative_to(Path(__file__).parent)
    except ValueError:
        return False
    return name.parts[0] in FAST and name.as_posix() not in NOT_FAST


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With ``-m fast`` no other test file is even imported."""
    other = collection_path.name.startswith("test_") and collection_path.is_file() and not is_fast(collection_path)
    return True if other and config.option.markexpr == "fast" else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the fast ones before ``-m`` chooses. A test that failed runs again, three times at most, where the machine
    stalled while it ran, or where it is in real time, and may have waited for another test's processor.
    """
    for item in items:
        if is_fast(item.path) and item.get_closest_marker("slow") is None:
            item.add_marker("fast")
        if item.config.getoption("--hil") is None:
            live = in_real_time(item)
            condition = True if live else partial(machine_stalled, item)
            delay_s = REST_S if live else 0.0
            item.add_marker(pytest.mark.flaky(reruns=RERUNS, reruns_delay=delay_s, condition=condition))


def in_real_time(item: pytest.Item) -> bool:
    """Whether a test is of real processes, or a driver's contract in real time."""
    suite = item.cls if isinstance(item, pytest.Function) else None
    return item.get_closest_marker("process") is not None or bool(getattr(suite, "real_time", False))


class LiveTestsInTurn(LoadFileScheduling):
    """Tests of real processes run one after another on one worker: two live cells at once are more than two cores
    carry, and then either is stopped for the other's sake. The others of their files need not wait for them.
    """

    def _split_scope(self, nodeid: str) -> str:
        file, *names = nodeid.split("::")
        live = live_names(self.config.rootpath / file)
        return "live" if live & {"", *(name.partition("[")[0] for name in names)} else file


@functools.cache
def live_names(file: Path) -> frozenset[str]:
    """Names of the functions and classes of a file with the marker `process`, and '' if the whole file has it."""
    found = set()
    tree = ast.parse(file.read_text("utf-8"))
    for owner in ast.walk(tree):
        marks: list[ast.expr] = list(getattr(owner, "decorator_list", ()))
        if isinstance(owner, ast.Module | ast.ClassDef):
            marks += [
                assigned.value
                for assigned in owner.body
                if isinstance(assigned, ast.Assign) and ast.unparse(assigned.targets[0]) == "pytestmark"
            ]
        if any("pytest.mark.process" in ast.unparse(mark) for mark in marks):
            found.add(getattr(owner, "name", ""))
    return frozenset(found)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LiveTestsInTurn:
    """Which worker runs which test."""
    return LiveTestsInTurn(config, log)


STALLS = "STEREOSERVO_TESTS_STALLS"
"""Environment variable of the file of this machine's stalls, for the workers of pytest-xdist."""
RERUNS = 3
REST_S = 5.0
"""[s] Before a test in real time runs again."""
STARTED_NS = pytest.StashKey[int]()


def pytest_configure(config: pytest.Config) -> None:
    """One process watches for stalls of the machine, for all workers; and one folder keeps the models that any of them
    has learnt: none of the user's are read, and each is learnt once a run.
    """
    if hasattr(config, "workerinput"):
        return
    folder = tempfile.TemporaryDirectory(prefix="ssrun")
    os.environ[STALLS] = str(Path(folder.name) / "stalls")
    os.environ["STEREOSERVO_CACHE_DIR"] = str(Path(folder.name) / "cache")
    watch = subprocess.Popen([sys.executable, machine_stalls.__file__, os.environ[STALLS]], stdin=subprocess.PIPE)

    def end() -> None:
        watch.communicate(timeout=10.0)
        folder.cleanup()

    config.add_cleanup(end)


def pytest_sessionstart(session: pytest.Session) -> None:
    """A worker asks the first process before each test how often it has run, by two small packets on a socket: without
    this option the second waits for an acknowledgement of the first, which comes 40 ms later.
    """
    if hasattr(session.config, "workerinput"):
        session.config.failures_db.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What the machine did to the tests."""
    number, longest_s, sum_s = machine_stalls.summary(Path(os.environ[STALLS]))
    terminalreporter.write_line(
        f"the machine stood still {number} times, {longest_s:.2f} s at most, {sum_s:.1f} s in all"
    )


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[STARTED_NS] = time.monotonic_ns()
    give_way(not in_real_time(item))


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """A test that leaves its worker with a real-time priority starves everything that runs after it: it fails."""
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    if policy != SCHEDULING:
        os.sched_setscheduler(0, SCHEDULING, os.sched_param(0))
        raise RuntimeError(f"{item.nodeid} or its fixtures left scheduling policy {policy} behind")


SCHEDULING = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
NICENESS = os.getpriority(os.PRIO_PROCESS, 0)
MAY_RETURN = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_NICE)[0] >= 20 - NICENESS
"""Whether this account may take back a priority that it has given away."""


def give_way(yields: bool) -> None:
    """Set this worker's priority for its next test: what is in real time keeps it, computations can wait."""
    if MAY_RETURN:
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS + 10 * yields)


def machine_stalled(item: pytest.Item) -> bool:
    """Whether the machine stalled since a test's last start."""
    return machine_stalls.longest_stall(Path(os.environ[STALLS]), item.stash[STARTED_NS]) > 0.0


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--hil CELL.toml``: tests/hil/test_can.py runs on the hardware of that cell, which then MOVES. docs/can.md."""
    parser.addoption(
        "--hil", metavar="CELL.toml", default=None,
        help="run tests/hil/test_can.py on the real cell of this file instead of emulated drives: the arm moves",
    )  # fmt: skip
