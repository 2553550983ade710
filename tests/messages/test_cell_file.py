"""Bad cell files are refused with the key, the value and what would have been valid; the file keeps its bytes."""

from __future__ import annotations

import re
import textwrap
import tomllib
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest

from stereoservo.core.settings import CoreSettings, core_settings
from stereoservo.messages.cell_file import CellFileError, RecordingSection, check_cell, load_cell_file
from stereoservo.ports.devices import CameraDescription, JointDriverDescription, JointSpec

GOOD = """
schema = 1
[cell]
name = "test"
[joints]
driver = "fake"
[[camera]]
name = "left"
driver = "fake"
[safety]
[[safety.limit]]
joint = "j1"
min = -1.0
max = 1.0
velocity = 0.5
acceleration = 2.0
[calibration]
base = { j1 = 0.1 }
range = { j1 = 0.3 }
"""
DRIVE = JointDriverDescription("fake", (JointSpec("j1", "revolute", -2.0, 2.0, 1.0, 4.0),), 250.0, "clock", 0.1, 100.0)
CAMERA = CameraDescription("fake", "left", 640, 480, 30.0, "observations", 100.0, (0, 1, 2, 3))


def settings(tmp_path: Path, text: str) -> CoreSettings:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    try:
        return core_settings(load_cell_file(path), DRIVE, (CAMERA,))
    finally:
        assert path.read_text() == text


def test_good_cell_file_loads(tmp_path: Path) -> None:
    settings(tmp_path, GOOD)


def test_a_range_may_be_left_out_and_a_spread_stays_inside_the_limits(tmp_path: Path) -> None:
    planned = settings(tmp_path, GOOD.replace("range = { j1 = 0.3 }", "")).trials
    assert planned is not None
    assert np.isnan(planned.range).all()
    assert planned.spread_joint == -1
    spread = settings(tmp_path, GOOD.replace("range =", 'spread = { joint = "j1", positions = 3 }\nrange =')).trials
    assert spread is not None
    assert spread.spread_offsets == pytest.approx([-0.3, 0.0, 0.3])
    alone = settings(tmp_path, GOOD.replace("range = { j1 = 0.3 }", 'spread = { joint = "j1" }')).trials
    assert alone is not None
    assert alone.spread_offsets == pytest.approx([-0.6, -0.2, 0.2, 0.6])


def test_contact_is_watched_by_default_and_thresholds_stand_in_joint_order(tmp_path: Path) -> None:
    plain = settings(tmp_path, GOOD).contact
    assert plain is not None
    assert (plain.enabled, plain.factor, plain.samples, plain.effort_units) == (True, 2.0, 5, ("N m",))
    assert np.isnan(plain.efforts).all()
    assert np.isnan(plain.following_errors).all()
    section = "[safety.contact]\neffort = { j1 = 12 }\nfactor = 3\nsamples = 3\nenabled = false\n[calibration]"
    given = settings(tmp_path, GOOD.replace("[calibration]", section)).contact
    assert given is not None
    assert (given.enabled, given.factor, given.samples) == (False, 3.0, 3)
    assert given.efforts.tolist() == [12.0]


def test_the_flight_rings_defaults_are_those_of_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs/safety.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^    \[recording\]\n(?:    .*\n?)+", page, re.MULTILINE)
    stated = tomllib.loads(textwrap.dedent(block))["recording"]
    assert stated == msgspec.structs.asdict(RecordingSection())
    assert stated == {"ring_minutes": 10, "ring_mib": 512, "reserve_mib": 2048, "kept_faults": 4}


CASES = {
    "unknown key": ("velocity = 0.5", "velocity = 0.5\nspeed = 1.0", ["speed", "acceleration"]),
    "unknown section": ("[calibration]", "[extra]\na = 1\n[calibration]", ["extra", "zenoh"]),
    "other schema": ("schema = 1", "schema = 2", ["schema", "2", "1"]),
    "wrong type": ("velocity = 0.5", 'velocity = "fast"', ["velocity", "fast"]),
    "negative": ("velocity = 0.5", "velocity = -0.5", ["velocity", "-0.5"]),
    "infinite": ("velocity = 0.5", "velocity = inf", ["velocity", "inf", "finite"]),
    "not a number": ("j1 = 0.1", "j1 = nan", ["calibration.base.j1", "nan"]),
    "huge": ("acceleration = 2.0", "acceleration = 1e300", ["acceleration", "1e+300"]),
    "huge integer": (
        "schema = 1",
        "schema = 1\n[servo]\nhold_frames = 100000000000000000000000000",
        ["hold_frames"],
    ),
    "swapped limits": ("min = -1.0", "min = 3.0", ["j1", "3.0"]),
    "degrees": ("max = 1.0", "max = 160.0", ["j1", "160", "rad"]),
    "base outside": ("j1 = 0.1", "j1 = 1.5", ["calibration.base.j1", "1.5", "0.99"]),
    "range too large": ("j1 = 0.3", "j1 = 30.0", ["calibration.range.j1", "30"]),
    "other joint": ("j1 = 0.1", "j7 = 0.1", ["j7", "j1"]),
    "joint without limits": ('joint = "j1"', 'joint = "j2"', ["j1", "j2"]),
    "camera twice": ("[safety]", '[[camera]]\nname = "left"\ndriver = "fake"\n[safety]', ["left", "twice"]),
    "mixed mounts": (
        "[safety]",
        '[[camera]]\nname = "hand"\ndriver = "fake"\nmount = "eye_in_hand"\n[safety]',
        ["camera.mount", "'left' is eye_to_hand", "'hand' is eye_in_hand", "mounted alike"],
    ),
    "empty keep-out": (
        "[calibration]",
        '[[safety.keep_out]]\nname = "a"\nranges = {}\n[calibration]',
        ["a", "bounds"],
    ),
    "reversed keep-out": (
        "[calibration]",
        '[[safety.keep_out]]\nname = "a"\nranges = { j1 = [0.5, -0.5] }\n[calibration]',
        ["0.5", "below"],
    ),
    "unknown law": ("schema = 1", 'schema = 1\n[servo]\nlaw = "magic"', ["magic", "valid: ", "cartesian3"]),
    "unknown reanchor": (
        "schema = 1",
        'schema = 1\n[servo]\nreanchor = "maybe"',
        ["reanchor", "'maybe'", "valid: auto, off"],
    ),
    "unknown mount": (
        'name = "left"',
        'name = "left"\nmount = "wall"',
        ["camera[0].mount", "'wall'", "eye_in_hand, eye_to_hand"],
    ),
    "spread of nothing": (
        "range = { j1 = 0.3 }",
        'spread = { joint = "j7" }',
        ["calibration.spread.joint", "j7", "joints with limits: j1"],
    ),
    "spread over limits": (
        "range = { j1 = 0.3 }",
        'spread = { joint = "j1", range = 1.5 }',
        ["calibration.spread.range", "1.5", "0.889"],
    ),
    "spread at one place": (
        "range = { j1 = 0.3 }",
        'spread = { joint = "j1", positions = 1 }',
        ["calibration.spread.positions", "2"],
    ),
    "known length without metres": (
        "range = { j1 = 0.3 }",
        'known_length = "markers:10,11"',
        ["calibration.known_length", "'markers:10,11'", "WHAT:OF=METRES", "markers:10,11=0.05"],
    ),
    "known length of no length": (
        "range = { j1 = 0.3 }",
        'known_length = "a:j2=-1e-3"',
        ["calibration.known_length", "'a:j2=-1e-3'"],
    ),
    "known length between cameras that are not there": (
        "range = { j1 = 0.3 }",
        'known_length = "baseline:left,top=0.2"',
        ["calibration.known_length", "two cameras of left"],
    ),
    "unknown key of spread": (
        "range = { j1 = 0.3 }",
        'spread = { joint = "j1", count = 3 }',
        ["calibration.spread", "count", "positions"],
    ),
    "contact of an unknown joint": (
        "[calibration]",
        "[safety.contact]\neffort = { j7 = 12.0 }\n[calibration]",
        ["safety.contact.effort", "j7", "joints with limits: j1"],
    ),
    "negative contact threshold": (
        "[calibration]",
        "[safety.contact]\nfollowing = { j1 = -0.02 }\n[calibration]",
        ["safety.contact.following.j1", "-0.02", "above 0"],
    ),
    "contact threshold of nothing": (
        "[calibration]",
        "[safety.contact]\neffort = { j1 = 0 }\n[calibration]",
        ["safety.contact.effort.j1", "0", "above 0"],
    ),
    "contact factor below what was learnt": (
        "[calibration]",
        "[safety.contact]\nfactor = 0.5\n[calibration]",
        ["safety.contact.factor", "0.5", ">= 1"],
    ),
    "unknown key of contact": (
        "[calibration]",
        "[safety.contact]\nforce = { j1 = 1.0 }\n[calibration]",
        ["safety.contact", "force", "effort", "following", "samples"],
    ),
    "not TOML": ("schema = 1", "schema = = 1", ["TOML"]),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_cell_file_is_refused(tmp_path: Path, name: str) -> None:
    old, new, words = CASES[name]
    assert old in GOOD
    with pytest.raises(CellFileError) as caught:
        settings(tmp_path, GOOD.replace(old, new, 1))
    for word in words:
        assert word in str(caught.value)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CellFileError, match="cannot be read"):
        load_cell_file(tmp_path / "missing.toml")
    with pytest.raises(CellFileError, match="cannot be read"):
        load_cell_file(tmp_path)
    (tmp_path / "binary.toml").write_bytes(bytes(range(256)))
    with pytest.raises(CellFileError, match="TOML"):
        load_cell_file(tmp_path / "binary.toml")
    (tmp_path / "deep.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(CellFileError):
        load_cell_file(tmp_path / "deep.toml")


@pytest.mark.parametrize(("key", "lacks"), [("effort", "efforts"), ("following", "following_errors")])
def test_thresholds_for_what_the_drives_do_not_tell_are_refused(
    tmp_path: Path, key: str, lacks: Literal["efforts", "following_errors"]
) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(f"{GOOD}\n[safety.contact]\n{key} = {{ j1 = 0.5 }}\n")
    cell = load_cell_file(path)
    core_settings(cell, DRIVE, (CAMERA,))
    with pytest.raises(CellFileError, match=f"safety.contact.{key}: states thresholds, and driver 'fake'"):
        core_settings(cell, msgspec.structs.replace(DRIVE, lacks=(lacks,)), (CAMERA,))


@pytest.mark.parametrize(
    ("static", "told"),
    [
        ("[9]", r"no camera's detector reports marker\(s\) 9; reported: 0, 1, 2, 3"),
        ("[0, 1]", "leaves 2 of the 4 markers that the detectors report to the body .* calibration needs 3"),
    ],
)
def test_static_markers_are_known_ones_and_leave_a_body(tmp_path: Path, static: str, told: str) -> None:
    good = GOOD.replace("[calibration]\n", "[calibration]\nmin_markers = 3\n")
    assert good != GOOD
    assert settings(tmp_path, f"{good}\n[scene]\nstatic = [3]\n").scene_ids == (3,)
    with pytest.raises(CellFileError, match=f"scene.static: {told}"):
        settings(tmp_path, f"{good}\n[scene]\nstatic = {static}\n")


@pytest.mark.parametrize(
    "data", [b"", b"\xff", b"a = " + b"[" * 60_000, b"a = " + b"9" * 60_000, b"a = 2026-99-99", b"\0" * 100]
)
def test_whatever_a_cell_file_holds_it_is_refused_by_name(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "cell.toml"
    path.write_bytes(data)
    with pytest.raises(CellFileError, match=r"cell\.toml: "):
        load_cell_file(path)


def test_a_cell_has_limits_of_size(tmp_path: Path) -> None:
    more = "".join(f'[[camera]]\nname = "c{k}"\ndriver = "fake"\n' for k in range(8))
    with pytest.raises(CellFileError, match=r"camera: 9 cameras; a cell has at most 8"):
        settings(tmp_path, GOOD.replace("[safety]\n", f"{more}[safety]\n"))
    path = tmp_path / "cell.toml"
    path.write_text(GOOD)
    cell = load_cell_file(path)
    many = msgspec.structs.replace(CAMERA, marker_ids=tuple(range(257)))
    with pytest.raises(CellFileError, match="the detectors report 257 different markers; a cell has at most 256"):
        core_settings(cell, DRIVE, (many,))
    core_settings(cell, DRIVE, (msgspec.structs.replace(many, marker_ids=many.marker_ids[:-1]),))
    thirteen = msgspec.structs.replace(DRIVE, joints=DRIVE.joints * 13)
    with pytest.raises(CellFileError, match="driver 'fake' has 13 joints; a cell has at most 12"):
        core_settings(cell, thirteen, (CAMERA,))


def test_a_value_that_is_refused_is_reported_without_a_password() -> None:
    tree = {
        "schema": 1, "cell": {"name": "x"}, "joints": {"driver": "fake"}, "camera": [{"name": "a", "driver": "fake"}],
        "safety": {}, "zenoh": {"endpoints": "tls/operator:Tulpe@router:7447"},
    }  # fmt: skip
    with pytest.raises(CellFileError, match=r"zenoh.endpoints.*got '\*\*\*@router:7447'"):
        check_cell(tree)
