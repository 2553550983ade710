"""An arm whose joints' zeros are wrong goes home by the pictures, and tells by what each is off: a running daemon."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.cli import main as cli
from stereoservo.client import Client
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo_sim.demonstration.truth import TruthLog
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.simulated_cell import demo_cell

from .conftest import cell_of_fakes, eventually, recover

pytestmark = pytest.mark.process

NAME = "homing"
WRONG = np.array([0.06, -0.04, 0.05, -0.2, 0.1, 0.3])
"""By which the joints stand beyond what they read [rad]."""
NOISE_PX = 0.1


def wrong_cell(folder: Path) -> Path:
    """The demo's cell with fakes, and a model of before its encoders lost their zeros."""
    model = exact_simulated_model(demo_cell(), 0)
    lost = msgspec.structs.replace(model, zero=model.zero + WRONG)
    return cell_of_fakes(folder, "demo", NAME, NOISE_PX, lost)


def told(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> Any:
    capsys.readouterr()
    assert cli.invoke([*arguments, "--json"]) == code, capsys.readouterr().out
    return json.loads(capsys.readouterr().out)


def test_the_arm_goes_home_by_the_pictures(roots: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world, directories = demo_cell(), cell_directories(NAME)
    with DaemonProcess(wrong_cell(roots), log=roots / "homing.log") as daemon:
        daemon.wait_ready()
        truth = TruthLog.of_directory(directories.runtime)
        with Client(NAME) as client:
            recover(client)
            eventually("the model is in use", lambda: client.status().model_epoch, 120.0)
            before = client.status().joints
            looked = told(capsys, "home", NAME, "--by-vision", "--check")
            assert looked["home"] is False
            assert client.status().joints == pytest.approx(before, abs=1e-4)
            found = told(capsys, "home", NAME, "--by-vision")
            time.sleep(0.5)
            reads = np.array(list(client.status().joints.values()))
            assert client.goal({"j1": 0.85, "j5": -0.6}).wait(60.0).outcome == "reached"
            unseen = told(capsys, "home", NAME, "--by-vision", code=1)
            assert "no camera sees a marker of the body" in unseen["error"]["message"]
        truth.end()
    assert found["home"] is True
    assert found["looks"] >= 2  # one alone shows all postures that bring the body there
    assert found["alternatives"] == 0
    off = np.array([row["zero_off_by"] for row in found["joints"]])
    deviations = np.array([row["deviation"] for row in found["joints"]])
    print(f"errors {np.round(off + WRONG, 5)}, deviations {np.round(deviations, 5)}, {found['error_px']:.2f} px")
    assert (np.abs(off + WRONG) <= 5.0 * deviations).all()
    assert deviations.max() < 5e-3
    seen, wanted = world.truth_pixels(reads), world.truth_pixels(world.base - WRONG)
    assert max(np.abs(seen[name] - wanted[name]).max() for name in seen) < 1.0
