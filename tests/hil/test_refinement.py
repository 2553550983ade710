"""On-line refinement in a running daemon: a coarse model becomes better by the goals that run, goals that were taught
stay good, and the calibrated model comes back by one command.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.cli import main as cli
from stereoservo.client import Client
from stereoservo.daemon.taught_goals import load_taught, refined_goal, save_taught
from stereoservo.kinematics.covariance import covariance_axes, displaced_model, predicted_pixels
from stereoservo.kinematics.model import CellModel, load_model, save_model
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.recording.replay import replay
from stereoservo_sim.world.simulated_cell import demo_cell
from stereoservo_sim.world.workpiece import Moved, MovedFile

from .conftest import CELL, at_rest, eventually, recover

pytestmark = pytest.mark.process
COARSER = 4.0
SEED = 5


def refining(calibrated: Path) -> Path:
    """The cell file, with refinement."""
    path = calibrated.with_name("refining.toml")
    path.write_text(calibrated.read_text().replace("[calibration]\n", "[calibration]\nrefine = true\n"))
    return path


def coarse(directories: CellDirectories) -> CellModel:
    """The cell's calibrated model, made coarser by so many times its deviations, saved with its taught goals."""
    path = max(directories.models.glob("model-??????.json"))
    model, rng = load_model(path), np.random.default_rng(SEED)
    assert model.covariance is not None
    axes = COARSER * covariance_axes(model)
    wide = msgspec.structs.replace(model.covariance, covariance=axes @ axes.T)
    found = msgspec.structs.replace(
        displaced_model(model, axes @ rng.standard_normal(axes.shape[1])), epoch=model.epoch + 1,
        statistics=model.statistics, covariance=wide,
    )  # fmt: skip
    save_model(found, directories.models / f"model-{found.epoch:06d}.json")
    goals = load_taught(directories.taught)
    save_taught(directories.taught, {name: refined_goal(goal, model, found) for name, goal in goals.items()})
    return found


def off(model: CellModel, positions: np.ndarray) -> float:
    """Rms distance [px] of predicted markers from the truth, a coordinate."""
    world = demo_cell()
    predicted = predicted_pixels(model, positions)
    rows = [world.body.ids.tolist().index(marker) for marker in model.marker_ids]
    true = np.array([list(world.truth_pixels(q).values()) for q in positions])[:, :, rows]
    return float(np.sqrt(np.mean((predicted - true.transpose(1, 0, 2, 3)) ** 2)))


def test_goals_refine_the_model_and_one_command_undoes_it(
    kept_state: None, calibrated: Path, directories: CellDirectories, start: Callable[..., DaemonProcess],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    base = coarse(directories)
    start(refining(calibrated))
    rng = np.random.default_rng(SEED)
    with Client(CELL) as client:
        recover(client)
        assert client.status().model_epoch == base.epoch
        client.record()
        first = client.events(1 << 60).next
        home = dict(client.status().joints)

        def told() -> list[str]:
            refined = [e for e in client.events(first).events if e.kind == "refined"]
            assert all(e.accepted for e in refined), [e.message for e in refined]
            return [e.message for e in refined]

        for _ in range(40):
            away = {name: q + float(rng.uniform(-0.12, 0.12)) for name, q in home.items()}
            client.goal(away).reached(60.0)
            time.sleep(0.5)  # some frames at rest
            if told():
                break
        eventually("the model is refined", told, 60.0)
        assert f"refined from epoch {base.epoch}" in told()[0]
        epoch = client.status().model_epoch
        refined = load_model(directories.models / f"model-{epoch:06d}.json")
        assert (refined.refined_from, client.status().health.verdict) == (base.epoch, "ok")
        positions = demo_cell().base + rng.uniform(-0.12, 0.12, (40, len(home)))
        assert off(refined, positions) < 0.7 * off(base, positions)
        assert client.goal("park").wait(60.0).outcome == "reached"
        eventually("the arm rests", lambda: at_rest(client))
        capsys.readouterr()
        assert cli.invoke(["calibrate", CELL, "--undo-refinement", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["accepted"]
        eventually("the calibrated model is back", lambda: client.status().model_epoch == epoch + 1)
        back = load_model(directories.models / f"model-{epoch + 1:06d}.json")
        assert (back.generators == base.generators).all()
        assert client.goal("park").wait(60.0).outcome == "reached"
        flight = Path(client.record(False).message.split(": ")[0])
        assert replay(flight).identical is True  # with both models in it
        assert cli.invoke(["calibrate", CELL, "--undo-refinement"]) != 0
        assert "nothing to undo" in capsys.readouterr().err


def test_a_bumped_camera_is_named_and_nothing_is_learnt_of_it(
    kept_state: None, calibrated: Path, directories: CellDirectories, start: Callable[..., DaemonProcess]
) -> None:
    start(refining(calibrated))
    rng = np.random.default_rng(SEED)
    bumps = MovedFile(directories.runtime, "simulated-camera-left.json")
    with Client(CELL) as client:
        recover(client)
        epoch, first = client.status().model_epoch, client.events(1 << 60).next
        home = dict(client.status().joints)
        for _ in range(4):
            client.goal({name: q + float(rng.uniform(-0.12, 0.12)) for name, q in home.items()}).reached(60.0)
            time.sleep(0.5)
        try:
            bumps.write(Moved((0.03, 0.0, 0.0), (0.0, 5.0, 0.0)))
            eventually(
                "the camera is found anew",
                lambda: client.status().health.verdict == "ok" and client.status().model_epoch > epoch,
            )
        finally:
            bumps.path.unlink()
        events = client.events(first).events
        assert "camera_moved" in [e.name for e in events if e.kind == "health"]
        told = [(e.accepted, e.name) for e in events if e.kind == "refined"]
        assert told == [(False, "watch")], [e.message for e in events]
        found = load_model(max(directories.models.glob("model-??????.json")))
        assert found.refined_from == 0
