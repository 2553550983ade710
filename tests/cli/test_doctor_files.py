"""``doctor FILE``: kinds by content, what is in them, what is odd, and damaged ones of each kind."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from corrupted import corrupted_copies
from drivers.video.conftest import HEIGHT, WIDTH, MjpegServer
from lerobot_sets import Episode, write
from stereoservo.cli.doctor.command import KINDS, examine_place, kind_of
from stereoservo.cli.main import invoke
from stereoservo.cli.output import is_known_error
from stereoservo.daemon.kernel_compilation import example_model
from stereoservo.kinematics.model import encode_model
from stereoservo_drivers.canopen import eds_files

ROOT = Path(__file__).parents[2]
FLIGHT = ROOT / "tests/recordings/flight-1.mcap"
SHIPPED_EDS = Path(eds_files.__file__).with_name("drive402.eds")
SCARA = ROOT / "sim/stereoservo_sim/world/arms/scara.urdf"

Doctor = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def doctor(capsys: pytest.CaptureFixture[str]) -> Doctor:
    def run(*arguments: object) -> tuple[int, dict[str, Any]]:
        capsys.readouterr()
        code = invoke(["doctor", *map(str, arguments), "--json"])
        answer = json.loads(capsys.readouterr().out)
        return code, answer["error"] if code else answer

    return run


def told(answer: dict[str, Any]) -> str:
    return "\n".join(f"{check['name']}: {check['message']}" for check in answer["checks"])


def small_set(folder: Path, kind: str = "video") -> Path:
    """A LeRobot set of one episode of 5 frames."""
    k = np.arange(5)
    shown = np.broadcast_to((40 * k + 20).astype(np.uint8)[None, :, None, None], (2, 5, 48, 64)).copy()
    return write(folder, "v2.1", [Episode(np.column_stack([0.01 * k, -0.02 * k]), shown, np.zeros((2, 5, 0, 2)))], kind)


def small_folder(folder: Path) -> Path:
    """Joints and pixels of markers, as tables."""
    folder.mkdir()
    (folder / "joints.csv").write_text("t,elbow[deg]\n" + "".join(f"{k},{10 * k}\n" for k in range(30)))
    (folder / "cameras.csv").write_text("camera,width,height\nleft,640,480\n")
    (folder / "markers.csv").write_text("camera,t,marker,u,v\nleft,0,7,10,20\nleft,1,7,11,20\nleft,2,,,\n")
    return folder


def model_file(folder: Path) -> Path:
    path = folder / "model.json"
    path.write_bytes(encode_model(example_model()))
    return path


def copied(path: Path, to: Path) -> Path:
    return Path(shutil.copyfile(path, to))


@pytest.mark.parametrize(
    ("made", "kind", "contents"),
    [
        (lambda f: copied(SHIPPED_EDS, f / "drive.txt"), "EDS or DCF", "objects: 70 objects, 4 RPDOs, 4 TPDOs"),
        (lambda f: copied(SCARA, f / "arm.xml"), "URDF", "lift: prismatic, 0 to 0.3 m, up to 0.4 m/s"),
        (lambda f: copied(FLIGHT, f / "flight"), "flight recording", "60 steps in 0.6 s, 100.0 Hz (loop of 100 Hz)"),
        (model_file, "model", "joints j1, j2, j3, j4, j5, j6"),
        (lambda f: small_set(f / "set"), "LeRobot data set", "camera up: video, 48x64x3: 5 of 5 pictures"),
        (lambda f: small_set(f / "set", "image"), "LeRobot data set", "camera up: image, 48x64x3: 5 of 5 pictures"),
        (lambda f: small_folder(f / "run"), "folder of joints or poses and pictures or markers",
         "camera left: 640x480, markers in 2 of 3 pictures"),
    ],
)  # fmt: skip
def test_a_kind_is_found_by_its_content(
    made: Callable[[Path], Path], kind: str, contents: str, tmp_path: Path, doctor: Doctor
) -> None:
    code, answer = doctor(made(tmp_path))
    assert (code, answer["kind"]) == (0, kind)
    assert contents in told(answer)
    assert all(check["ok"] is not False for check in answer["checks"])


def test_what_is_odd_is_told_with_its_line_and_the_file_is_used(tmp_path: Path, doctor: Doctor) -> None:
    path = tmp_path / "drive.eds"
    text = SHIPPED_EDS.read_text()
    path.write_bytes(text.replace("[1000]", "a stray line\n[1000]").encode("utf-16"))
    line = text[: text.index("[1000]")].count("\n") + 1
    code, answer = doctor(path)
    assert code == 0
    assert f"line {line}: 'a stray line': neither a header nor KEY=VALUE: skipped" in told(answer)
    path = tmp_path / "cut.mcap"
    path.write_bytes(FLIGHT.read_bytes()[:-2000])
    code, answer = doctor(path)
    (end,) = (check for check in answer["checks"] if check["name"] == "end")
    assert (code, end["ok"]) == (0, None)
    assert "steps before that are good" in end["message"]
    folder = small_set(tmp_path / "set")
    (folder / "videos/chunk-000/observation.images.up/episode_000000.mp4").unlink()
    code, answer = doctor(folder)
    assert code == 0
    assert "lost: episode 0, frames 0 to 4, camera up: " in told(answer)
    assert "camera side: video, 48x64x3: 5 of 5 pictures" in told(answer)


def test_odd_lines_of_a_cell_file_are_told(tmp_path: Path, doctor: Doctor) -> None:
    path = tmp_path / "cell.txt"
    assert invoke(["init", str(tmp_path / "cell.toml")]) == 0
    text = (tmp_path / "cell.toml").read_text()
    path.write_text(text.replace("gain = 1.5", "gain = 1,5"))
    line = text[: text.index("gain = 1.5")].count("\n") + 1
    code, answer = doctor(path, "--seconds", "0")
    assert (code, answer["kind"]) == (0, "cell file")
    assert f"cell file: cell.txt: line {line}: 'gain': a decimal comma: read as a point" in told(answer)
    path.write_text(text.replace("gain = 1.5", "gain = 1.000,5"))
    code, answer = doctor(path, "--seconds", "0")
    assert (code, answer["code"]) == (1, "cell_file")
    assert f"line {line}: 'gain': " in answer["message"]
    assert f"line {line}: 'gain': " in told(answer)


@pytest.mark.parametrize("data", [b"", b"\x7fELF\x02\x01", b"Dear all,\n", bytes(100), b'{"a": 1}', b"<html></html>"])
def test_a_file_of_no_kind_is_refused_with_the_kinds_that_are_read(data: bytes, tmp_path: Path, doctor: Doctor) -> None:
    path = tmp_path / "any"
    path.write_bytes(data)
    code, error = doctor(path)
    assert (code, error["code"]) == (1, "unknown_kind")
    assert repr(data[:24]) in error["message"]
    assert all(kind.name in error["message"] for kind in KINDS)


def test_what_is_not_there_or_is_no_file_is_refused(tmp_path: Path, doctor: Doctor) -> None:
    assert doctor(tmp_path / "drive.eds")[1]["code"] == "file"
    assert doctor("/dev/zero")[1]["code"] == "file"
    assert doctor("nowhere")[0] == 2


def test_a_stream_is_observed(doctor: Doctor) -> None:
    server = MjpegServer()
    try:
        code, answer = doctor(server.url.replace("//", "//ann:hunter2@"), "--seconds", "0.3")
    finally:
        server.close()
    assert (code, answer["kind"]) == (0, "URL of a stream or snapshot")
    assert f"{WIDTH}x{HEIGHT} px" in told(answer)
    assert "pictures in 0.3 s" in told(answer)
    assert "hunter2" not in json.dumps(answer)


def damaged(path: Path, count: int) -> Iterator[None]:
    """Damages a file in place, again and again; every fifth one is cut instead."""
    whole = path.read_bytes()
    for k, data in enumerate(corrupted_copies(whole, count, 4)):
        path.write_bytes(whole[: len(whole) * (k % 97) // 97] if k % 5 == 0 else data)
        yield
    path.write_bytes(whole)


@pytest.mark.parametrize(
    ("made", "parts", "count"),
    [
        (lambda f: copied(SHIPPED_EDS, f / "drive.eds"), ["."], 10),
        (lambda f: copied(FLIGHT, f / "flight.mcap"), ["."], 60),
        (model_file, ["."], 60),
        (lambda f: small_set(f / "set"), ["meta/info.json", "data/chunk-000/episode_000000.parquet",
         "videos/chunk-000/observation.images.up/episode_000000.mp4"], 50),
        (lambda f: small_set(f / "set", "image"), ["data/chunk-000/episode_000000.parquet"], 50),
        (lambda f: small_folder(f / "run"), ["joints.csv", "markers.csv"], 60),
    ],
    ids=["eds", "flight", "model", "videos", "images", "folder"],
)  # fmt: skip
def test_of_damaged_files_only_known_refusals_escape(
    made: Callable[[Path], Path], parts: list[str], count: int, tmp_path: Path
) -> None:
    """The seed of each is ``count``."""
    path = made(tmp_path)
    refused = []
    for part in parts:
        for _ in damaged(path / part if part != "." else path, count):
            try:
                kind, place = kind_of(str(path), 0.0)
                if kind.described is not None:
                    list(examine_place(kind, place))
            except Exception as error:  # of any type: looked at below
                refused.append(error)
    assert refused
    assert [error for error in refused if not is_known_error(error) or str(tmp_path) not in str(error)] == []
    assert all(finding.ok is not False for finding in examine_place(*kind_of(str(path), 0.0)))
