"""Compilation that goes on is told, and waited for: who starts a daemon gives up on one that compiles nothing more."""

import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from stereoservo.cli.status import with_progress
from stereoservo.daemon import kernel_compilation
from stereoservo.daemon.supervisor import ProgressLines
from stereoservo.messages import compilation_progress, discovery
from stereoservo.messages.compilation_progress import (
    CompilationProgress,
    ProgressTimeout,
    progress_path,
    read_progress,
)
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import LoopInfo, StateMessage
from stereoservo.numerics import compilation
from stereoservo.numerics.compilation import KERNELS, kernel


@kernel
def _twice(x):
    return x + x


def _tell(runtime: Path, done: int, part: str = "rest", daemon: int = 7) -> None:
    one = CompilationProgress(part, daemon, done, 380)
    progress_path(runtime, part).write_bytes(msgspec.json.encode(one))


def test_a_process_tells_each_kernel_that_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listeners = []
    with monkeypatch.context() as patched:
        patched.setattr(compilation.event, "register", lambda kind, listener: listeners.append(listener))
        kernel_compilation.report_progress(tmp_path, "first", 7, 380)
    (listener,) = listeners
    with compilation.event.install_listener("numba:compile", listener):
        dispatcher = KERNELS[__name__, "_twice"]
        dispatcher._cache.disable()
        assert read_progress(tmp_path) == ()
        dispatcher.compile((compilation.types.float64,))
    (one,) = read_progress(tmp_path, 7)
    assert (one.part, one.total) == ("first", 380)
    assert one.done == sum(len(one.overloads) for one in KERNELS.values())
    assert f"{one.done} of about " in one.text
    assert read_progress(tmp_path, 8) == ()
    progress_path(tmp_path, "rest").write_bytes(b"{")
    assert read_progress(tmp_path) == (one,)


def test_a_wait_lasts_as_long_as_there_is_news(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    wait = ProgressTimeout(10.0)
    for second in range(100):
        now[0] = float(second)
        assert not wait.is_over(second // 9)
    now[0] = 120.0
    assert wait.is_over(99 // 9)


def test_a_daemon_is_waited_for_while_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery, "runtime_root", lambda: tmp_path)
    monkeypatch.setattr(discovery, "REPORT_EVERY_S", 0.0)
    daemon = object.__new__(discovery.DaemonProcess)
    daemon.process, daemon._log = (
        subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE),
        None,
    )
    runtime = tmp_path / "cell"
    runtime.mkdir()
    told: list[str] = []
    compiled, done, now = 60, 0, 0.0

    def sleep(seconds: float) -> None:
        nonlocal done, now
        now += seconds
        if done < compiled:
            done += 1
            _tell(runtime, done, daemon=daemon.process.pid)

    clock = SimpleNamespace(monotonic=lambda: now, sleep=sleep)
    monkeypatch.setattr(discovery, "time", clock)
    monkeypatch.setattr(compilation_progress, "time", clock)
    with daemon, pytest.raises(discovery.DaemonError, match="compiled no kernel either"):
        daemon.wait_ready(1.5, told.append)  # of three seconds that the compilation takes
    assert now == pytest.approx(compiled * 0.05 + 1.5, abs=0.11)
    assert told[-1] == f"compiling kernels: rest {compiled} of about 380 kernels"


def test_status_and_log_say_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("stereoservo.daemon.supervisor.REPORT_EVERY_S", 0.0)
    lines = ProgressLines()
    for done in (3, 3, 90):
        _tell(tmp_path, done)
        lines.check(tmp_path)
    told = capfd.readouterr().err.splitlines()
    assert [line.split("(")[-1] for line in told] == [
        "rest: 3 of about 380 kernels)",
        "rest: 90 of about 380 kernels)",
    ]
    reasons = Reason("COMPILING", "info", hint="ask again"), Reason("HELD", "hold")
    loop = LoopInfo(250.0, 0, 0, 0, {}, {})
    state = StateMessage(
        0, 0, "active", "none", 0, "hold", "", "", "info", reasons, "cell", "boot", 0.0, {}, {}, {}, None, (), {},
        {}, loop
    )  # fmt: skip
    found = with_progress(state, CellDirectories("cell", tmp_path, tmp_path)).reasons
    assert found[0].hint == "90 of about 380 kernels are compiled. ask again"
    assert found[1] == state.reasons[1]
