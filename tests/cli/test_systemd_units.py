"""The units in deploy/systemd parse, and the command lines in them are ones that this program takes."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from configparser import ConfigParser
from pathlib import Path

import pytest

from stereoservo.cli import main as cli

UNITS = Path(__file__).parents[2] / "deploy" / "systemd"
PROGRAM = "/opt/stereoservo/bin/stereoservo"


def unit(name: str) -> ConfigParser:
    """Sections and keys of a unit; of keys that stand several times the last."""
    found = ConfigParser(strict=False, interpolation=None)
    found.optionxform = str  # type: ignore[assignment,method-assign]
    found.read_string((UNITS / name).read_text())
    return found


@pytest.mark.parametrize("service", ["stereoservo@.service", "stereoservo-check@.service"])
def test_the_command_of_a_service_is_known(service: str, capfd: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(unit(service)["Service"]["ExecStart"])
    assert words[0] == PROGRAM
    assert "%i" in " ".join(words)
    assert cli.invoke([words[1], "--help"]) == 0
    told = capfd.readouterr().out
    for word in words[2:]:
        if word.startswith("--"):
            assert word in told


def test_the_weekly_check_moves_no_arm_that_was_shut_down_and_makes_up_for_no_missed_one() -> None:
    check, timer = unit("stereoservo-check@.service"), unit("stereoservo-check@.timer")
    assert check["Unit"]["Requisite"] == "stereoservo@%i.service"
    assert check["Service"]["Type"] == "oneshot"
    assert "--unattended" in check["Service"]["ExecStart"].split()
    assert timer["Timer"]["OnCalendar"]
    assert timer["Timer"]["Persistent"] == "false"
    assert timer["Install"]["WantedBy"] == "timers.target"
    daemon = unit("stereoservo@.service")
    assert check["Service"]["User"] == daemon["Service"]["User"]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_takes_the_units(tmp_path: Path) -> None:
    names = [path.name for path in UNITS.iterdir()]
    for name in names:
        text = (UNITS / name).read_text().replace(PROGRAM, str(shutil.which("true")))
        (tmp_path / name).write_text(text)
    found = subprocess.run(
        ["systemd-analyze", "verify", *(str(tmp_path / name.replace("@.", "@cell.")) for name in names)],
        env={**os.environ, "SYSTEMD_UNIT_PATH": f"{tmp_path}:"}, capture_output=True, text=True, timeout=240,
        check=False,
    )  # fmt: skip
    mine = [line for line in found.stderr.splitlines() if "stereoservo" in line]
    assert found.returncode == 0, found.stderr
    assert not mine
