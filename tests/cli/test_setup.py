"""`stereoservo setup`: what pictures tell of a plate's motion, the dialogue, what a computer has, cell files."""

from __future__ import annotations

import ctypes
import io
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest
import typer

from stereoservo.cli import main as cli
from stereoservo.cli.doctor.camera_findings import CameraRecord
from stereoservo.cli.doctor.cameras import same_camera_twice
from stereoservo.cli.doctor.plate_motion import examine_sides, judge_turn, turn_between
from stereoservo.cli.output import CommandError, shipped_or_path
from stereoservo.cli.setup.command import (
    chosen_cameras,
    chosen_order,
    chosen_ranges,
    eye_finding,
    interview,
    joint_position,
)
from stereoservo.cli.setup.dialogue import Dialogue
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.ports.devices import CameraDescription, CameraObservation, DriverError
from stereoservo.ports.discovery import BusScan, FoundCamera, FoundDrive, JointChoice
from stereoservo_drivers.canopen.nodes import found_buses, proposed_options, stated_limits
from stereoservo_drivers.video.driver import VideoCameraDriver, found_cameras, modes_told, usual_rate
from stereoservo_sim.world.simulated_cell import SimulatedCell, demo_cell

SIGMA_PX = 0.05
FRAMES = 24
JOG = math.radians(0.45)

Look = Callable[..., list[CameraRecord]]


@pytest.fixture(scope="module")
def world() -> SimulatedCell:
    return demo_cell()


@pytest.fixture
def look(world: SimulatedCell) -> Look:
    """What the simulated cell's cameras see at joint positions, with the noise of a middling detector."""
    rng = np.random.default_rng(3)

    def at(q: np.ndarray, names: tuple[str, str] = ("left", "right")) -> list[CameraRecord]:
        records = []
        for name, view in zip(names, ("left", "right"), strict=True):
            seen = world.visible(q, world.rig.camera(view))
            ids, pixels = world.body.ids[seen], world.truth_pixels(q)[view][seen]
            record = CameraRecord(CameraDescription("video", name, 640, 480, 30.0, "frames", 1.0))
            C = np.repeat(SIGMA_PX**2 * np.eye(2)[None], len(ids), axis=0)
            for k in range(FRAMES):
                noisy = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
                record.seen.append(CameraObservation(name, k, k, k, ids, noisy, C))
            records.append(record)
        return records

    return at


def test_pictures_tell_by_how_much_a_joint_turned_before_anything_is_calibrated(
    world: SimulatedCell, look: Look
) -> None:
    """Of 0.45 degrees of any joint, within four of the stated deviations; wrong ratios are named, true ones pass."""
    for joint in range(6):
        step = np.zeros(6)
        step[joint] = JOG
        turn = turn_between(look(world.base), look(world.base + step))
        assert turn is not None
        assert abs(turn.angle - JOG) < 4.0 * turn.sigma + 0.02 * JOG
        assert judge_turn("j", JOG, turn).ok is True
        for factor in (0.5, 2.0):
            finding = judge_turn("j", JOG / factor, turn)
            assert finding.ok is False
            assert "gear_ratio" in finding.remedy
    standing = turn_between(look(world.base), look(world.base))
    assert "stands still" in judge_turn("j", JOG, standing).message


def test_which_camera_stands_on_which_side_is_told_by_one_look(world: SimulatedCell, look: Look) -> None:
    right = examine_sides(look(world.base))
    assert right is not None
    assert right.ok is True
    swapped = examine_sides(look(world.base, ("right", "left"))[::-1])
    assert swapped is not None
    assert swapped.ok is False
    assert "swapped" in swapped.message
    assert examine_sides(look(world.base, ("near", "far"))) is None


def test_one_camera_given_twice_is_told_by_its_pictures(world: SimulatedCell, look: Look) -> None:
    one, other = look(world.base)
    assert same_camera_twice([one, other]) is None
    again = look(world.base)[0]
    again.description = msgspec.structs.replace(again.description, name="right")
    finding = same_camera_twice([one, again])
    assert finding is not None
    assert finding.ok is False


@pytest.mark.parametrize(
    ("answer", "ok", "words"),
    [(("j1", "+"), True, "it is the joint"), (("j1", "-"), False, "inverted"), (("j2", "+"), False, "swapped"),
     (("", ""), None, "nobody saw")],
)  # fmt: skip
def test_what_a_person_saw_is_held_against_what_was_asked_for(
    answer: tuple[str, str], ok: bool | None, words: str
) -> None:
    finding = eye_finding("j1", JOG, answer)
    assert finding.ok is ok
    assert words in finding.message


def test_a_scripted_dialogue_takes_answers_and_defaults_and_refuses_what_is_not_valid() -> None:
    out = io.StringIO()
    with Dialogue(out, {"a": "2", "b": "x"}) as dialogue:
        assert dialogue.ask("a", "How many", None, int) == 2
        assert dialogue.ask("c", "How many", "5", int) == 5
        with pytest.raises(CommandError, match="answer b = 'x'"):
            dialogue.ask("b", "How many", None, int)
        with pytest.raises(CommandError, match="have no 'd', and it has no default"):
            dialogue.ask("d", "How many", None, int)
        assert dialogue.asked == {"a": "2", "c": "5"}
    assert "How many [5]: 5" in out.getvalue()


class Terminal(io.StringIO):
    """A person who types."""

    def isatty(self) -> bool:
        return True


def test_on_a_terminal_what_is_not_valid_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", Terminal("many\n7\n\n"))
    out = io.StringIO()
    with Dialogue(out, {"a": "2"}) as dialogue:
        assert dialogue.ask("a", "How many", None, int) == 2  # by the answers
        assert dialogue.ask("b", "How many", None, int) == 7  # what they lack is asked
        assert dialogue.ask("c", "How many", "5", int) == 5
        with pytest.raises(CommandError, match="the terminal was closed"):
            dialogue.ask("d", "How many", None, int)
    assert "invalid literal" in out.getvalue()


# -- what a computer has -------------------------------------------------------------------------------------------


class FakeCamera:
    """A V4L2 device as videodev2.h has its structures: two formats, each of two sizes of two rates."""

    SIZES = ((640, 480), (1920, 1200))
    RATES = ((1, 30), (1, 15))

    def __init__(self, capabilities: int) -> None:
        self.capabilities = capabilities

    def __call__(self, request: int, data: ctypes.Structure) -> None:
        kind, number = request & 0xFF, struct.unpack_from("I", data, 0)[0]
        assert len(bytes(data)) == request >> 16 & 0x3FFF
        if kind == 0:
            struct.pack_into("I", data, 88, self.capabilities)
        elif kind == 2:
            self._there(number < 2)
            struct.pack_into("4s", data, 44, (b"YUYV", b"MJPG")[number])
        elif kind == 74:
            self._there(number < 2)
            struct.pack_into("III", data, 8, 1, *self.SIZES[number])
        else:
            assert kind == 75
            assert struct.unpack_from("II", data, 8) in self.SIZES
            self._there(number < 2)
            struct.pack_into("III", data, 16, 1, *self.RATES[number])

    @staticmethod
    def _there(is_there: bool) -> None:
        if not is_there:
            raise OSError(22, "Invalid argument")


def test_modes_of_a_video_device_come_with_the_best_first() -> None:
    modes = modes_told(FakeCamera(1))
    assert modes is not None
    assert modes[0] == (640, 480, 30.0)  # the other is larger than helps
    assert set(modes) == {(w, h, rate) for w, h in FakeCamera.SIZES for rate in (30.0, 15.0)}
    assert modes_told(FakeCamera(0x00800000)) is None  # the node of a camera's metadata


def test_cameras_are_found_by_the_kernels_files_under_the_name_that_stays(tmp_path: Path) -> None:
    kernel, devices, links = tmp_path / "class", tmp_path / "dev", tmp_path / "by-id"
    for folder in (kernel, devices, links):
        folder.mkdir()
    for number, name in ((10, "Grabber"), (2, "UVC Camera"), (3, "UVC Camera")):
        (kernel / f"video{number}").mkdir()
        (kernel / f"video{number}" / "name").write_text(f"{name}\n")
        (devices / f"video{number}").touch()
    (links / "usb-Maker_UVC_Camera_0042-video-index0").symlink_to(devices / "video2")
    found = found_cameras(kernel, links, devices, lambda path: None if path.name == "video3" else ((640, 480, 30.0),))
    assert [camera.name for camera in found] == [
        f"UVC Camera ({devices / 'video2'})", f"Grabber ({devices / 'video10'})"
    ]  # fmt: skip
    assert found[0].options["source"] == str(links / "usb-Maker_UVC_Camera_0042-video-index0")
    assert found[1].options["source"] == str(devices / "video10")


@dataclass
class Port:
    device: str
    description: str
    vid: int | None


def test_adapters_are_those_that_python_can_detects_and_usb_serial_ports() -> None:
    buses = found_buses(
        lambda: [
            {"interface": "virtual", "channel": "x"},
            {"interface": "socketcan", "channel": "can0"},
            {"interface": "serial", "channel": "/dev/ttyS0"},
        ],
        lambda: [Port("/dev/ttyS0", "ttyS0", None), Port("/dev/ttyACM0", "CANable", 0x16D0)],
    )
    assert [bus.options for bus in buses] == [
        {"interface": "socketcan", "channel": "can0"},
        {"interface": "stereoservo_slcan", "channel": "/dev/ttyACM0"},
    ]


def test_limits_of_a_drive_that_are_as_wide_as_its_counter_are_none() -> None:
    assert stated_limits(-(2**31), 2**31 - 1) is None
    assert stated_limits(0, 0) is None
    assert stated_limits(None, 5) is None
    assert stated_limits(-1000, 2**31 - 1) == (-1000, 2**31 - 1)


def test_a_measured_rate_is_the_usual_one_next_to_it() -> None:
    assert [usual_rate(rate) for rate in (29.7, 30.5, 14.9, 37.8)] == [30.0, 30.0, 15.0, 37.0]


# -- answers, and the file made of them ----------------------------------------------------------------------------


def drive(address: int, limits: tuple[int, int] | None = None) -> FoundDrive:
    return FoundDrive(address, f"node {address}", {"vendor_id": 7, "serial_number": address}, limits, 65536 * 5)


def joint(address: int, limits: tuple[int, int] | None = None) -> JointChoice:
    return JointChoice(f"j{address}", drive(address, limits), "revolute", 65536.0, 100.0, None, -1.0, 1.0, 0.5)


def test_addresses_of_cameras_are_taken_whole_and_told_without_passwords(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sources = ["http://me:Tul,pe #7@cam/a", "rtsp://10.0.0.1/b?user=me&pwd=Tulpe"]
    chosen = chosen_cameras(f"{sources[0]} , {sources[1]}", ())
    assert [camera.options["source"] for camera in chosen] == sources
    assert "pe" not in repr([camera.name for camera in chosen])
    with pytest.raises(ValueError, match="valid: an address") as caught:
        chosen_cameras("me:Tulpe@cam/a", ())
    assert "Tulpe" not in str(caught.value)

    def nobody(options: object) -> None:
        raise DriverError("refused", "nobody listens")

    monkeypatch.setattr(VideoCameraDriver, "probe_camera", staticmethod(nobody))
    monkeypatch.setattr(VideoCameraDriver, "find_cameras", staticmethod(tuple))
    out = io.StringIO()
    with (
        pytest.raises(CommandError) as failed,
        Dialogue(out, {"plate": "yes", "cameras": " ".join(sources)}) as dialogue,
    ):
        interview(tmp_path / "mine.toml", dialogue, {})
    assert str(failed.value) == "camera 'left': nobody listens"
    assert "http://***@cam/a rtsp://10.0.0.1/b?***" in out.getvalue()
    assert "pe #7" not in out.getvalue() + str(failed.value)
    assert dialogue.asked["cameras"] == " ".join(sources)


def test_answers_that_cannot_be_are_refused_with_what_can() -> None:
    two = (FoundCamera("a", {"source": "/dev/video0"}), FoundCamera("b", {"source": "/dev/video2"}))
    assert [camera.name for camera in chosen_cameras("1, 0", two)] == ["b", "a"]
    for text, why in (("0", "a cell needs two"), ("0 0", "given twice"), ("0 7", "valid: 0 to 1")):
        with pytest.raises(ValueError, match=why):
            chosen_cameras(text, two)
    drives = {1: drive(1), 2: drive(2)}
    assert [(d.address, slide) for d, slide in chosen_order("2 1p", drives)] == [(2, False), (1, True)]
    with pytest.raises(ValueError, match="nodes that answer: 1, 2"):
        chosen_order("1 3", drives)
    limited = joint(1, (-65536 * 25, 65536 * 25))
    assert joint_position(limited) == pytest.approx(math.radians(18.0))
    assert chosen_ranges("-80:80", [limited]) == [(pytest.approx(math.radians(-80)), pytest.approx(math.radians(80)))]
    for text, why in (
        ("-100:80", "beyond the drive's own"),
        ("-80:20", "stands at 18.0"),
        ("80:-80", "must be below"),
    ):
        with pytest.raises(ValueError, match=why):
            chosen_ranges(text, [limited])


def test_proposed_options_are_those_of_the_driver_at_a_rate_that_the_bus_carries() -> None:
    bus = {"interface": "virtual", "channel": "x", "bitrate": 500_000}
    joints = [joint(k) for k in range(1, 7)]
    options = proposed_options(BusScan(bus, tuple(j.drive for j in joints)), joints)
    assert options["rate_hz"] == 150.0  # 164 Hz is what six drives leave of 500 kbit/s at 70 %
    assert [table["serial_number"] for table in options["joint"]] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("name", ["hil-can", "hil-video", "demo"])
def test_a_shipped_cell_is_copied_by_its_name(name: str, tmp_path: Path) -> None:
    copy = tmp_path / "mine.toml"
    assert cli.invoke(["init", str(copy), "--from", name]) == 0
    assert load_cell_file(copy).cell.name == "mine"
    assert cli.invoke(["init", str(tmp_path / "b.toml"), "--from", "nowhere"]) != 0


def test_a_cell_that_is_run_is_a_file_or_a_shipped_one() -> None:
    assert shipped_or_path("demo").name == "demo.toml"
    assert shipped_or_path("nowhere.toml") == Path("nowhere.toml")
    with pytest.raises(typer.BadParameter, match="hil-can"):
        shipped_or_path("nowhere")


def test_setup_without_a_terminal_or_answers_says_so(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.invoke(["setup", str(tmp_path / "mine.toml"), "--json"]) == 1
    assert "--answers" in capfd.readouterr().out
