"""Calibrate and check through a real daemon: report, verdict, history, leases, damaged model files."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from stereoservo.cli import main as cli
from stereoservo.client import Client, EventWatch
from stereoservo.daemon.jobs.check_job import load_checks
from stereoservo.gateway.persistence import ModelStore
from stereoservo.kinematics.model import load_model, save_model
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.goals import Calibrate

from .conftest import CELL, at_rest, eventually

pytestmark = pytest.mark.process


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, Any]]:
    def run_it(*arguments: str) -> tuple[int, Any]:
        capfd.readouterr()
        code = cli.invoke([*arguments, "--json"])
        out, run_it.said = capfd.readouterr()  # type: ignore[attr-defined]
        return code, json.loads(out)

    return run_it


def test_check_report_and_damaged_models(
    kept_state: None,
    calibrated: Path,
    start: Callable[..., DaemonProcess],
    directories: CellDirectories,
    run: Callable[..., tuple[int, Any]],
    tmp_path: Path,
) -> None:
    damaged = directories.models / "model-000090.json"
    damaged.write_text("{")
    code, result = run("doctor", str(calibrated))
    assert code == 0, result
    line = next(check for check in result["checks"] if check["name"] == "model")
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
        lines = [line for line in run.said.splitlines() if line.startswith("calibrating: ")]  # type: ignore[attr-defined]
        motions = [line.split(",")[0].removeprefix("calibrating: ") for line in lines]
        expected = [*(f"joint {k} of 6" for k in range(1, 7)), "all joints at once", "fitting the model"]
        assert list(dict.fromkeys(motions))[-8:] == expected
        assert client.status().learning is None
        assert result["epoch"] == 91
        assert result["covariance_ok"]
        # Of exact joints one in a hundred fits looks as if they had errors, and is no more than usable.
        assert result["grade"] in ("good", "usable"), result
        assert result["verdict"].startswith(f"{result['grade']}: ")
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


def test_trial_motions_that_end_early_say_the_code_of_their_reason(
    calibrated: Path, start: Callable[..., DaemonProcess], run: Callable[..., tuple[int, Any]], tmp_path: Path
) -> None:
    """More markers are wanted at a stop than the body has."""
    text = calibrated.read_text()
    assert text.count("[calibration]\n") == 1
    path = tmp_path / calibrated.name
    path.write_text(text.replace("[calibration]\n", "[calibration]\nmin_markers = 90\n"))
    start(path)
    code, result = run("calibrate", CELL)
    assert (code, result["error"]["code"]) == (1, "not_enabled")
    with Client(CELL) as client:
        assert client.status().lifecycle == "inactive"
    code, result = run("calibrate", CELL, "--enable")
    assert (code, result["error"]["code"]) == (1, "MARKERS_NOT_SEEN")
    (reason,) = result["error"]["reasons"]
    assert reason["threshold"] == 90
    code, result = run("calibrate", CELL, "--trials", "any.npz")
    assert (code, result["error"]["code"]) == (1, "daemon_running")


def test_joint_zeros_are_reset_by_a_check(
    kept_state: None,
    calibrated: Path,
    start: Callable[..., DaemonProcess],
    directories: CellDirectories,
    run: Callable[..., tuple[int, Any]],
) -> None:
    """A model whose zero of j3 is off stands for an encoder that is."""
    store = ModelStore(directories.models)
    good = load_model(store.path(store.epochs()[-1]))
    zero = good.zero.copy()
    zero[2] += 0.01
    off = msgspec.structs.replace(good, epoch=80, zero=zero)
    save_model(off, store.path(80))
    start(calibrated)
    unattended = ("calibrate", CELL, "--check", "--unattended")
    with Client(CELL) as client:
        code, result = run(*unattended)
        assert (code, result["error"]["code"]) == (1, "not_idle")
        assert client.status().lifecycle == "inactive"
        client.enable()
        code, result = run(*unattended)
        assert (code, result["status"], result["holds"]) == (1, "recalibrate", False)
        code, result = run("calibrate", CELL, "--check", "--reset-zeros")
        assert code == 0
        (joint,) = result["reset"]["joints"]
        assert joint["joint"] == "j3"
        assert abs(joint["drift"] - 0.01) < 5 * joint["deviation"]
        assert result["check"]["status"] == "recalibrate"
        assert result["reset"]["epoch"] == client.status().model_epoch == 81
        cured = load_model(Path(result["reset"]["model"]))
        assert cured.epoch == 81
        assert "j3 by +0.57" in cured.source
        assert cured.zero[2] == pytest.approx(good.zero[2], abs=5 * joint["deviation"])
        # Nothing is left to be reset.
        code, result = run("calibrate", CELL, "--check", "--reset-zeros")
        assert (code, result["error"]["code"]) == (1, "check_holds")
        assert result["error"]["check"]["status"] == "holds"
        assert client.status().model_epoch == 81
        code, result = run(*unattended)
        assert (code, result["holds"]) == (0, True)
        assert store.epochs()[-1] == 81
