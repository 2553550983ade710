"""``[emulate.cameras]``: what is valid, and the copy of a cell file that looks at emulated cameras."""

from __future__ import annotations

import json
import tomllib
import urllib.request

import pytest

from stereoservo.cli import main as cli
from stereoservo.messages.cell_file import load_cell_file
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.emulated import move_to_server
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.emulators.cameras.stream_settings import cameras_of_cell, port_of
from stereoservo_sim.emulators.emulator_process import EmulatorError, EmulatorProcess
from stereoservo_sim.emulators.fault_engine import EmulationError, FaultCommandError

CELL = shipped_cell_path("hil-video")


def changed(tmp_path, old, new):
    """The shipped cell with one text replaced."""
    text = CELL.read_text()
    assert text.count(old) == 1, old
    path = tmp_path / "cell.toml"
    path.write_text(text.replace(old, new))
    return load_cell_file(path)


def test_the_shipped_cell_is_unsynchronised_and_told_its_latency():
    cell = load_cell_file(CELL)
    left, right = cameras_of_cell(cell).camera
    assert (left.stream, right.stream) == ("/left.mjpg", "/right.mjpg")
    assert right.skew_ms - left.skew_ms == 15.0
    for stream, camera in zip((left, right), cell.camera, strict=True):
        assert stream.latency_ms == pytest.approx(camera.options["latency_s"] * 1e3)
        assert stream.rate_hz == camera.options["rate_hz"]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("port = 5480 ", "port = 70000 ", "port = 70000"),
        ("skew_ms = 15.0", "skew = 15.0", "no option 'skew'; did you mean 'skew_ms'?"),
        ("quality = 95 ", "quality = 0 ", "quality = 0"),
        ('camera]]\nname = "right"\nrate', 'camera]]\nname = "left"\nrate', "name 'left' is used twice"),
        ("skew_ms = 15.0", 'skew_ms = 15.0\npath = "/left.mjpg"', "path '/left.mjpg' is used twice"),
        ("skew_ms = 15.0", 'path = "left"', 'path = "left"; valid: a text in quotes that matches ^(/[A-Za-z'),
        ("[emulate.cameras]\n", '[emulate.cameras]\nhost = "0.0.0.0"\n', "host ="),
    ],
)  # fmt: skip
def test_what_cannot_be_emulated_is_told(tmp_path, old, new, told):
    with pytest.raises(EmulationError) as refused:
        cameras_of_cell(changed(tmp_path, old, new))
    assert told in str(refused.value)


def test_a_cell_without_emulated_cameras_and_channels_elsewhere():
    with pytest.raises(EmulationError, match="hil-video"):
        cameras_of_cell(load_cell_file(shipped_cell_path("hil-can")))
    assert port_of("http://127.0.0.1:5480") == 5480
    for channel in ("http://10.0.0.1:80", "http://127.0.0.1:x", "http://127.0.0.1:70000", "pty"):
        with pytest.raises(EmulationError, match="on this host only"):
            port_of(channel)


def test_only_the_sources_differ_in_the_copy(tmp_path):
    copy = move_to_server(CELL, tmp_path, "http://127.0.0.1:7001")
    before, after = tomllib.loads(CELL.read_text()), tomllib.loads(copy.read_text())
    for side, old, new in zip(("left", "right"), before["camera"], after["camera"], strict=True):
        assert new["options"].pop("source") == f"http://127.0.0.1:7001/{side}.mjpg"
        assert old["options"].pop("source") == f"http://127.0.0.1:5480/{side}.mjpg"
    assert after == before
    with pytest.raises(ValueError, match="needs cameras with source"):
        move_to_server(shipped_cell_path("demo"), tmp_path, "http://127.0.0.1:7001")


def test_the_truth_of_video_cameras_is_what_is_emulated_at_their_address(tmp_path):
    cell = changed(tmp_path, "skew_ms = 15.0", "skew_ms = 15.0\nk1 = -0.1")
    assert [camera.k1 for camera in true_cell(cell).rig.cameras] == [0.0, -0.1]
    with pytest.raises(ValueError, match=r"shows '/middle\.mjpg', which is not emulated; streams: /left\.mjpg"):
        true_cell(changed(tmp_path, "5480/left.mjpg", "5480/middle.mjpg"))


@pytest.mark.process
def test_cameras_in_a_process_take_orders_and_end(tmp_path, monkeypatch):
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path))
    options = ("--channel", "http://127.0.0.1:0", "--order", "black left @ 0s")
    with EmulatorProcess(CELL, what="cameras", options=options, log=tmp_path / "log") as cameras:
        url = cameras.wait_ready()
        with urllib.request.urlopen(f"{url}/left.jpg", timeout=60.0) as answer:
            assert len(answer.read()) < 20_000  # nothing in it
        assert "black" in cameras.order("status")
        with pytest.raises(FaultCommandError, match="cameras: left, right, all"):
            cameras.order("freeze middle")
        assert cameras.stop() == 0
    ready, *_, end = cameras.events
    assert ready["streams"] == {"left": f"{url}/left.mjpg", "right": f"{url}/right.mjpg"}
    assert end["event"] == "end"
    assert end["pictures"] >= 1
    with pytest.raises(EmulatorError, match="the emulated cameras have ended"):
        cameras.order("status")


def test_command_lines_that_cannot_be(capsys):
    def refused(*arguments):
        assert cli.invoke(["emulate", "cameras", *arguments, "--json"]) != 0
        return json.loads(capsys.readouterr().out)["error"]["message"]

    assert "hil-video" in refused("demo")
    assert "cameras have no bus" in refused("hil-video", "--bit-time")
    assert "usage: loss" in refused("hil-video", "--channel", "http://127.0.0.1:0", "--order", "loss left 2")
    assert "on this host only" in refused("hil-video", "--channel", "socket://127.0.0.1:0")
