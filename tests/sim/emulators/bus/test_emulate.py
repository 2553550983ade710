"""``stereoservo emulate drives`` as a process, and its command line."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import tempfile
from pathlib import Path

import pytest

from stereoservo.cli import main as cli
from stereoservo.messages.directories import cell_directories
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.emulators.emulator_process import EmulatorError, EmulatorProcess
from stereoservo_sim.emulators.fault_engine import FaultCommandError
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory

CELL = "emulated-test"


@pytest.fixture
def cell_file(monkeypatch):
    """The CAN cell under a name of its own with a light plant, in directories of its own."""
    root = Path(tempfile.mkdtemp(prefix="ssemu", dir="/tmp"))
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(root / "r"))
    monkeypatch.setenv("STEREOSERVO_STATE_DIR", str(root / "s"))
    text = shipped_cell_path("hil-can").read_text()
    text = re.sub(r'(?m)^name = "hil-can"$', f'name = "{CELL}"', text)
    text = re.sub(r'(?m)^plant = "pybullet"', 'plant = "ideal"', text)
    assert CELL in text
    assert 'plant = "ideal"' in text
    path = root / "cell.toml"
    path.write_text(text)
    yield path
    shutil.rmtree(root)


FREE = ("--channel", "socket://127.0.0.1:0")


@pytest.mark.process
def test_drives_in_a_process_take_orders_and_frames_and_end_at_rest(cell_file):
    with EmulatorProcess(cell_file, options=(*FREE, "--order", "silence 2 @ 0s")) as drives:
        channel = drives.wait_ready()
        host, port = channel.removeprefix("socket://").split(":")
        assert "silenced" in drives.order("status").splitlines()[1]
        assert drives.order("speak 2") == "node 2: speaks"
        with pytest.raises(FaultCommandError, match="nodes: 1, 2, 3, 4, 5, 6"):
            drives.order("silence 77")
        with pytest.raises(FaultCommandError, match="usage: fault"):
            drives.order("fault three")
        with socket.create_connection((host, int(port)), timeout=20.0) as client:
            client.sendall(b"S8\rO\rt0002" + b"8100\r")  # NMT: all to reset node; they boot
            heard = b""
            while b"t7061" not in heard:
                chunk = client.recv(4096)
                assert chunk
                heard += chunk
            drives.order("fault 3 0x3210")
            while b"t0838" not in heard:
                chunk = client.recv(4096)
                assert chunk
                heard += chunk
        assert heard[heard.index(b"t0838") + 5 :][:4] == b"1032"
        truth = TrueJointHistory.open(cell_directories(CELL).runtime / FILE_NAME)
        assert truth.newest() is not None
        assert drives.stop() == 0
        assert drives.stop() == 0
    kinds = [event["event"] for event in drives.events]
    assert kinds[0] == "ready"
    assert kinds[-1] == "end"
    states = [event["text"] for event in drives.events if event["event"] == "state" and event["node"] == 3]
    assert any("0x3210" in text for text in states)
    with pytest.raises(EmulatorError, match="have ended"):
        drives.order("status")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((host, int(port)), timeout=20.0)


@pytest.mark.process
def test_clients_that_vanish_with_answers_under_way_do_not_end_the_drives(cell_file):
    with EmulatorProcess(cell_file, options=FREE) as drives:
        host, port = drives.wait_ready().removeprefix("socket://").split(":")
        for _ in range(8):
            with socket.create_connection((host, int(port)), timeout=20.0) as client:
                client.sendall(b"O\r")
                assert client.recv(1) in (b"\r", b"")  # turned away while the last one is being dropped
                client.sendall(b"t00028100\r" * 20)  # each one boots six drives
        assert "node 6" in drives.order("status")
        assert drives.stop() == 0


@pytest.mark.process
def test_over_a_pty_and_killed_by_a_signal(cell_file):
    with EmulatorProcess(cell_file, options=("--channel", "pty", "--bit-time")) as drives:
        channel = drives.wait_ready()
        assert channel.startswith("/dev/pts/")
        ready = next(event for event in drives.events if event["event"] == "ready")
        assert ready["bit_time"] is True
        assert ready["nodes"] == [1, 2, 3, 4, 5, 6]
        assert drives.stop(signal.SIGINT) == 0


@pytest.mark.process
def test_what_fails_at_the_start_is_told(cell_file):
    taken = socket.create_server(("127.0.0.1", 0))
    with (
        taken,
        EmulatorProcess(cell_file, options=("--channel", f"socket://127.0.0.1:{taken.getsockname()[1]}")) as drives,
    ):
        with pytest.raises(EmulatorError, match="cannot listen on") as refused:
            drives.wait_ready()
        assert refused.value.code == 1


def refused(capsys, *arguments):
    """The error object of a command line that fails."""
    assert cli.invoke(["emulate", *arguments, "--json"]) != 0
    return json.loads(capsys.readouterr().out)["error"]["message"]


@pytest.fixture
def kept_signals():
    """The command takes SIGTERM and SIGINT; the tests want them back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_command_lines_that_cannot_be(capsys, cell_file, kept_signals):
    assert "there is: drives, cameras" in refused(capsys, "robots", str(cell_file))
    assert "hil-can" in refused(capsys, "drives", "nowhere")
    assert "drives are emulated for 'canopen'" in refused(capsys, "drives", "demo")
    assert "nodes: 1, 2, 3" in refused(capsys, "drives", str(cell_file), *FREE, "--order", "silence 9")
    assert "usage: late" in refused(capsys, "drives", str(cell_file), *FREE, "--order", "late 2 x")
    assert "on this host only" in refused(capsys, "drives", str(cell_file), "--channel", "socket://10.0.0.1:5400")
    text = cell_file.read_text()
    cell_file.write_text(text.replace('protocol = "cia402"', 'protocol = "cia403"'))
    assert "cia403" in refused(capsys, "drives", str(cell_file), *FREE)
    cell_file.write_text(text.replace('channel = "socket://127.0.0.1:5400"', 'channel = "/dev/ttyACM0"'))
    assert "--channel pty" in refused(capsys, "drives", str(cell_file))
