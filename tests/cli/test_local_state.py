"""``status`` on the cell's own host: it needs no gateway to say that something is wrong."""

from __future__ import annotations

import json
import re
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest

from stereoservo.cli import main as cli
from stereoservo.daemon.heartbeat import (
    DRIVER_CALL_S,
    HEARTBEAT_BYTES,
    HEARTBEAT_LAYOUT,
    SERVO_HANG_S,
)
from stereoservo.daemon.seqlock import SlotWriter
from stereoservo.messages.directories import CellDirectories, cell_directories, create_directories
from stereoservo.messages.discovery import DaemonInfo
from stereoservo.messages.locks import FileLock
from stereoservo.messages.run_record import begin_run, end_run
from stereoservo.messages.wire import encode


@pytest.fixture
def directories() -> CellDirectories:
    found = cell_directories("demo")
    create_directories(found)
    return found


@pytest.fixture
def daemon(directories: CellDirectories) -> Iterator[CellDirectories]:
    """A daemon that seems to run, and whose gateway does not answer."""
    endpoint = f"unixsock-stream/{directories.zenoh_socket}"
    directories.daemon.write_bytes(encode(DaemonInfo("demo", endpoint, "boot", 1, "demo.toml")))
    with FileLock(directories.daemon_lock, "demo"):
        yield directories


def beat(directories: CellDirectories, age_s: float, limit_s: float = SERVO_HANG_S, of: str = "servo") -> None:
    """A process's newest heartbeat."""
    with SlotWriter(directories.heartbeat_slot(of), HEARTBEAT_BYTES, HEARTBEAT_LAYOUT) as slot:
        slot.write(struct.pack("=qd", time.monotonic_ns() - round(age_s * 1e9), limit_s))


def status(capfd: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    code = cli.invoke(["status", "demo", "--json"])
    out, _ = capfd.readouterr()
    return code, json.loads(out)["error"]


def test_a_servo_process_that_is_silent_is_an_error(daemon: CellDirectories, capfd: pytest.CaptureFixture[str]) -> None:
    beat(daemon, 40.0)
    code, error = status(capfd)
    assert (code, error["code"]) == (1, "servo_silent")
    assert re.search(r"the servo process has given no sign of life for 4\d\.\d s, since", error["message"])
    assert "emergency stop" in error["message"]


def test_a_gateway_that_does_not_answer_is_told_from_a_servo_process_that_is_silent(
    daemon: CellDirectories, capfd: pytest.CaptureFixture[str]
) -> None:
    beat(daemon, 10.0, DRIVER_CALL_S)  # it said that it configures its drives
    code, error = status(capfd)
    assert (code, error["code"]) == (1, "session")
    assert "the gateway does not answer" in error["message"]


def test_a_gateway_that_hangs_is_not_waited_for(
    daemon: CellDirectories, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(*_: object, **__: object) -> None:
        raise AssertionError("the gateway is asked")

    monkeypatch.setattr("stereoservo.cli.status.Client", asked)
    beat(daemon, 0.0, DRIVER_CALL_S)
    beat(daemon, 40.0, of="gateway")
    code, error = status(capfd)
    assert (code, error["code"]) == (1, "no_reply")
    assert re.search(r"the gateway has given no sign of life for 4\d\.\d s, since", error["message"])
    assert "`stereoservo stop` works" in error["message"]


def test_a_daemon_that_died_leaves_its_cause(directories: CellDirectories, capfd: pytest.CaptureFixture[str]) -> None:
    begin_run(directories, "a", 7)
    assert "(process 7) was killed (signal 9)" in status(capfd)[1]["message"]
    end_run(directories, "the servo process hung: no sign of life", "See its log")
    code, error = status(capfd)
    assert (code, error["code"]) == (1, "not_running")
    assert "Its last run ended at 20" in error["message"]
    assert "the servo process hung: no sign of life. See its log. Start it" in error["message"]


def test_a_daemon_that_starts_is_told_from_none(
    directories: CellDirectories, capfd: pytest.CaptureFixture[str]
) -> None:
    with FileLock(directories.daemon_lock, "demo"):
        code, error = status(capfd)
    assert (code, error["code"]) == (1, "not_running")
    assert "has the cell and takes no requests" in error["message"]
