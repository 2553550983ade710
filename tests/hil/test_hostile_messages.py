"""Hostile bytes on every key that the gateway takes: each is refused, and every process lives on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from stereoservo.client import Client
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.goals import JointTarget
from stereoservo.messages.keys import VERBS
from stereoservo.messages.wire import ENCODING, Reply, decode

from .conftest import CELL, eventually, processes

pytestmark = pytest.mark.process

MODEL_FREE_GOAL = b'{"id": "00000000", "target": {"kind": "joints", "positions": {"j1": %s}}}'
PAYLOADS = {
    "not UTF-8 behind a misfit": b'{"id":5,"x":"\xff"}',
    "not UTF-8": b'{"id":"\xff"}',
    "a command that is not UTF-8": b'{"command":"update","id":5,"x":"\xff"}',
    "nested behind a misfit": b'{"id":' + b"[" * 60_000,
    "nested objects": b'{"id":' + b'{"a":' * 12_000,
    "half a surrogate": b'{"id":"\\ud800"}',
    "many digits": b'{"id":' + b"9" * 60_000 + b"}",
    "a long word": b'{"id":"' + b"\x1b" * 60_000 + b'"}',
    "too long": b" " * 100_000,
    "zeros": b"\0" * 16,
    "a huge position": MODEL_FREE_GOAL % b"1e308",
    "no number": MODEL_FREE_GOAL % b"NaN",
}
PARAMETERS = ["\x00", "=" * 1000, ";;;=;", "a" * 60_000, "1;from=\ud7ff", "%ff", "1e9", "9" * 5000]


@pytest.fixture(scope="module")
def daemon(cell_file: Path, directories: CellDirectories, roots: Path) -> Iterator[DaemonProcess]:
    """A daemon whose log can be read."""
    with DaemonProcess(cell_file, log=roots / "hostile.log") as daemon:
        daemon.wait_ready()
        yield daemon
    eventually("no process is left", lambda: not processes(directories))


@pytest.mark.parametrize("payload", PAYLOADS.values(), ids=PAYLOADS)
def test_no_payload_ends_a_process(daemon: DaemonProcess, directories: CellDirectories, payload: bytes) -> None:
    before = processes(directories)
    with Client(CELL, operator="mallory") as client:
        boot = client.status().boot
        taken = [verb for verb in VERBS if verb not in ("enable", "reset")]
        for key in (client.keys.goal("mallory"), *(client.keys.command(verb, "mallory") for verb in taken)):
            reply = decode(client.query(key, payload, 10.0), Reply)
            assert not reply.accepted, key
            assert reply.problems, key
            client.session.put(key, payload, encoding=ENCODING)
        for key in (client.keys.event, client.keys.info, client.keys.state, client.keys.schema("goal")):
            assert client.query(key, payload)
        assert decode(client.query(client.keys.stop, payload), Reply).accepted
        client.session.put(client.keys.stop, payload, encoding=ENCODING)
        assert client.status().boot == boot
    assert processes(directories) == before


@pytest.mark.parametrize("number", PARAMETERS, ids=lambda number: ascii(number[:8]))
def test_no_parameter_ends_a_process(daemon: DaemonProcess, directories: CellDirectories, number: str) -> None:
    before = processes(directories)
    with Client(CELL) as client:
        for key in (
            client.keys.event,
            client.keys.state,
            client.keys.goal("mallory"),
            client.keys.schema("no"),
        ):
            assert client.query(f"{key}?from={number}")
        assert client.status().servo_alive
    assert processes(directories) == before


@pytest.mark.parametrize(
    "tail", ["goal/a b", "goal/\x1b[2J", "goal/é", "command/jog/\n", "schema/\x00", "command/record/ü"]
)
def test_no_key_ends_a_process(daemon: DaemonProcess, directories: CellDirectories, tail: str) -> None:
    before = processes(directories)
    with Client(CELL) as client:
        reply = decode(client.query(f"{client.keys.prefix}/{tail}", b"{}"), Reply)
        assert not reply.accepted
        client.session.put(f"{client.keys.prefix}/{tail}", b"{}")
        assert client.status().servo_alive
    assert processes(directories) == before


def test_afterwards_a_goal_is_servoed_and_the_log_is_short(daemon: DaemonProcess, roots: Path) -> None:
    with Client(CELL, operator="anna") as client:
        client.resume()
        client.enable()
        away = client.status().joints["j1"] + 0.05
        assert client.goal(JointTarget({"j1": away})).reached(60.0).outcome == "reached"
    lines = [line for line in (roots / "hostile.log").read_text().splitlines() if "refused a message" in line]
    assert 1 <= len(lines) < 60
    assert all(line.isprintable() and len(line) < 3000 for line in lines)
