"""What deploy/can sets up is what the channel asks for."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from stereoservo_drivers.can.channel import RECEIVE_BUFFER

FILES = Path(__file__).parents[3] / "deploy" / "can"
UNIT = FILES / "stereoservo-can@.service"


def test_the_unit_sets_the_interface_up_and_never_restarts_it_silently():
    lines = [line for line in UNIT.read_text().splitlines() if line.startswith("ExecStart=")]
    commands = [shlex.split(line.partition("=")[2].lstrip("-")) for line in lines]
    assert all(command[:4] == ["/usr/sbin/ip", "link", "set", "%i"] for command in commands)
    assert [command[4:] for command in commands] == [
        ["down"],
        ["txqueuelen", "${TXQUEUELEN}"],
        ["type", "can", "bitrate", "${BITRATE}", "restart-ms", "0"],
        ["up"],
    ]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_takes_the_unit(tmp_path):
    copy = tmp_path / "stereoservo-can@can0.service"
    copy.write_text(UNIT.read_text().replace("/usr/sbin/ip", str(shutil.which("true"))))
    found = subprocess.run(
        ["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, timeout=240, check=False
    )
    assert "stereoservo-can@" not in found.stderr, found.stderr
    assert found.returncode == 0, found.stderr


def test_udev_rules_are_matches_then_assignments():
    word = re.compile(r'[A-Z_]+(\{[\w$.]+\})?(==|!=|\+=|=)"[^"]*"')
    rules = [
        line for line in (FILES / "70-stereoservo-can.rules").read_text().splitlines() if line[:1] not in ("#", "")
    ]
    assert len(rules) == 5
    for rule in rules:
        words = re.split(r",\s*", rule)
        assert all(word.fullmatch(one) for one in words), rule
        operators = [word.fullmatch(one)[2] for one in words]
        assert operators == sorted(operators, key=lambda one: one != "=="), rule


def test_the_receive_buffer_is_allowed():
    text = (FILES / "90-stereoservo-can.conf").read_text()
    assert f"net.core.rmem_max = {RECEIVE_BUFFER}" in text
