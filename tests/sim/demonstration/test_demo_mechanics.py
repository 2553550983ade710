"""Cell files of demonstrations with mechanics: what is put into them, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereoservo.messages.cell_file import load_cell_file
from stereoservo_sim.cells import CELLS, shipped_cell_path
from stereoservo_sim.demonstration.emulated import with_mechanics
from stereoservo_sim.world.arms.arm_cell import urdf_path


@pytest.mark.parametrize("name", CELLS)
def test_every_shipped_cell_takes_mechanics_and_is_otherwise_the_same(name: str, tmp_path: Path) -> None:
    path = shipped_cell_path(name)
    before, after = load_cell_file(path), load_cell_file(with_mechanics(path, tmp_path, "serial_servo"))
    options, drives = after.joints.options, after.emulate.get("drives", {})
    stated = drives if before.emulate.get("drives") is not None else options
    assert stated.pop("mechanics") == "serial_servo"
    assert after == before


def test_stated_mechanics_are_replaced(tmp_path: Path) -> None:
    once = with_mechanics(shipped_cell_path("demo"), tmp_path, "serial_servo")
    (tmp_path / "again").mkdir()
    twice = with_mechanics(once, tmp_path / "again", "strain_wave")
    assert load_cell_file(twice).joints.options["mechanics"] == "strain_wave"
    assert twice.read_text().count("mechanics") == 1


def test_a_cell_without_options_gets_them(tmp_path: Path) -> None:
    path = tmp_path / "plain.toml"
    text = shipped_cell_path("demo").read_text()
    head, _, rest = text.partition("[joints.options]")
    path.write_text(head + rest[rest.index("# Left first") :])
    (tmp_path / "copy").mkdir()
    copy = with_mechanics(path, tmp_path / "copy", "planetary_qdd")
    assert load_cell_file(copy).joints.options == {"mechanics": "planetary_qdd"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('driver = "pybullet"            # rigid', 'driver = "canopen"  # rigid', "only simulated arms"),
        ("encoder = 1e-6", "mechanics = { j1 = { play = 0.01 } }  #", "state them as one line there"),
    ],
)
def test_what_cannot_be_changed_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "demo.toml"
    text = shipped_cell_path("demo").read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    (tmp_path / "copy").mkdir()
    with pytest.raises(ValueError, match=message):
        with_mechanics(path, tmp_path / "copy", "strain_wave")


def test_an_arm_beside_the_cell_file_is_found_from_the_copy(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(shipped_cell_path("scara").read_text().replace("scara.urdf", "mine.urdf"))
    (tmp_path / "mine.urdf").write_bytes(urdf_path("scara.urdf", tmp_path).read_bytes())
    (tmp_path / "copy").mkdir()
    copy = load_cell_file(with_mechanics(path, tmp_path / "copy", "strain_wave"))
    assert copy.joints.options["urdf"] == str(tmp_path / "mine.urdf")
    # one that is shipped is found from everywhere, and stays as it is named
    (tmp_path / "other").mkdir()
    shipped = load_cell_file(with_mechanics(shipped_cell_path("scara"), tmp_path / "other", "strain_wave"))
    assert shipped.joints.options["urdf"] == "scara.urdf"
