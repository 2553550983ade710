"""Calibrate and check through a real daemon: report, verdict, history, leases, damaged model files."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from stereoservo.cli import main as cli
from stereoservo.gateway.client import Client
from stereoservo.gateway.following import EventWatch
from stereoservo.runtime.check_history import load_checks
from stereoservo.runtime.commands import Calibrate
from stereoservo.runtime.daemon import DaemonProcess
from stereoservo.runtime.directories import CellDirectories

from .conftest import CELL, at_rest, eventually

pytestmark = pytest.mark.process


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, Any]]:
    def run_it(*arguments: str) -> tuple[int, Any]:
        capfd.readouterr()
        code = cli.invoke([*arguments, "--json"])
        return code, json.loads(capfd.readouterr().out)

    return run_it


def test_check_report_and_damaged_models(
    calibrated: Path,
    start: Callable[..., DaemonProcess],
    directories: CellDirectories,
    run: Callable[..., tuple[int, Any]],
    tmp_path: Path,
) -> None:
    damaged = directories.models / "model-000090.json"
    damaged.write_text("{")
    code, result = run("doctor", str(calibrated))
    line = next(check for check in result["checks"] if check["name"] == "model")
    assert code == 0
    assert line["ok"] is None
    assert "epoch" in line["message"]
    assert str(damaged) in line["message"]
    start(calibrated)
    with Client(CELL) as client:
        client.enable()
        (note,) = client.status().notes
        assert str(damaged) in note
        assert "is not JSON" in note
        assert "is used instead" in note
        # A client that dies: its lease runs out, the arm rests.
        goal = str(uuid.uuid4())
        with EventWatch(client) as watch:
            client.command("calibrate", Calibrate(goal, lease_s=0.5))
            end = watch.wait(lambda e: e.id == goal and e.kind == "calibration_aborted", "the end", 20.0)
        assert end.reasons[0].code == "LEASE_EXPIRED"
        eventually("the arm rests", lambda: at_rest(client))
        code, check = run("calibrate", CELL, "--check")
        assert code == 0
        assert check["holds"]
        assert check["status"] == "holds"
        assert check["message"].startswith("model holds")
        assert set(check["per_joint"]) == set(client.status().joints)
        assert len(check["history"]) == len(load_checks(directories.checks)[0]) == 1
        code, result = run("calibrate", CELL)
        assert code == 0
        assert result["epoch"] == 91
        assert result["covariance_ok"]
        assert result["grade"] == "good"
        assert result["verdict"].startswith("good: residual")
        assert "Calibration: model epoch 91" in Path(result["report"]).read_text()
        assert Path(result["trials"]).exists()
        assert client.status().notes == ()
        events = [event for event in client.events().events if event.id == goal or event.kind == "calibrated"]
        assert result["verdict"] in events[-1].message
    # The stored trials give the same model again, without the daemon.
    again = tmp_path / "again.json"
    code, second = run("calibrate", str(calibrated), "--trials", result["trials"], "--output", str(again))
    assert code == 0
    assert second["rms_px"] == pytest.approx(result["rms_px"], rel=1e-9)
    assert Path(second["report"]).parent == tmp_path / "again-report"
    for path in directories.models.glob("model-00009?*"):
        if path.is_file():
            path.unlink()
