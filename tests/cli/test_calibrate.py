"""``calibrate --trials`` and ``--lines``: stored trials fitted again, without a daemon."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.cli import main as cli
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.calibration.trials import save_trials
from stereoservo.kinematics.model import load_model
from stereoservo_sim.synthetic import SyntheticCell, rx90

SIGMA = 0.05
Run = Callable[..., tuple[int, Any]]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    def run_it(*arguments: str) -> tuple[int, Any]:
        code = cli.invoke(["calibrate", *arguments, "--json"])
        out = capfd.readouterr().out
        assert out.count("\n") == 1, out
        return code, json.loads(out)

    return run_it


def stored(path: Path, cell: SyntheticCell) -> str:
    save_trials(cell.trials(SIGMA, np.random.default_rng(3)), path)
    return str(path)


def test_stored_trials_give_a_model_with_its_epoch_and_report(run: Run, tmp_path: Path) -> None:
    code, result = run("bench", "--trials", stored(tmp_path / "t.npz", rx90()))
    assert code == 0
    assert {"rms_px", "per_joint_px", "covariance_ok", "model", "verdict", "report"} <= set(result)
    model = Path(result["model"])
    assert model == tmp_path / "state" / "bench" / "models" / "model-000001.json"
    assert load_model(model).epoch == result["epoch"] == 1
    assert Path(result["report"]).is_file()
    assert result["rms_px"] == pytest.approx(SIGMA, rel=0.05)
    assert run("bench", "--trials", str(tmp_path / "t.npz"))[1]["epoch"] == 2


def test_trials_that_cannot_be_fitted_end_with_code_cause_and_report(run: Run, tmp_path: Path) -> None:
    data = rx90().trials(SIGMA, np.random.default_rng(3))
    data.pixels[1] = np.nan
    save_trials(data, tmp_path / "t.npz")
    code, result = run("bench", "--trials", str(tmp_path / "t.npz"), "--output", str(tmp_path / "m.json"))
    assert code == 1
    assert result["error"]["code"] == "too_few_markers"
    assert "Calibration failed" in Path(result["error"]["report"]).read_text()
    assert not (tmp_path / "m.json").exists()


def test_files_that_are_none_are_named(run: Run, tmp_path: Path) -> None:
    code, result = run("bench", "--trials", str(tmp_path / "none.npz"))
    assert (code, result["error"]["code"]) == (1, "bad_data")
    assert "none.npz" in result["error"]["message"]
    assert run("bench", "--lines", "x.csv")[1]["error"]["code"] == "argument"
    assert run("bench", "--check", "--trials", "x.npz")[1]["error"]["code"] == "argument"
    assert run("bench", "--reset-zeros")[1]["error"]["code"] == "argument"
    assert run("bench", "--unattended")[1]["error"]["code"] == "argument"


def straight_lines(cell: SyntheticCell, camera: int) -> str:
    """Rows of pixels along 12 straight lines as the camera shows them."""
    rng = np.random.default_rng(camera)
    rows = []
    for line in range(12):
        ends = rng.uniform((20, 20), (620, 460), (2, 2))
        ideal = ends[0] + np.linspace(0, 1, 20)[:, None] * (ends[1] - ends[0])
        for u, v in distort(cell.lenses[camera], ideal) + rng.normal(0, 0.1, ideal.shape):
            rows.append(f"cam{camera},{line},{u:.4f},{v:.4f}")
    return "\n".join(rows) + "\n"


def test_straight_lines_hold_the_lens(run: Run, tmp_path: Path) -> None:
    cell = rx90().with_k1(-0.3)
    trials = stored(tmp_path / "t.npz", cell)
    lines = tmp_path / "lines.csv"
    lines.write_text("camera,line,u,v\n" + straight_lines(cell, 0) + straight_lines(cell, 1))
    code, result = run(
        "bench",
        "--trials",
        trials,
        "--lines",
        str(lines),
        "--lines-sigma",
        "0.1",
        "--output",
        str(tmp_path / "m.json"),
    )
    assert code == 0, result
    model = load_model(tmp_path / "m.json")
    for camera, lens in zip(model.cameras, cell.lenses, strict=True):
        assert camera.lens[0] == pytest.approx(lens[0], abs=0.003)
    assert result["covariance_ok"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("left,line,u,v\n", "camera,line,u,v is needed"),
        ("camera,line,u,v\ncam7,1,2,3\n", "no camera 'cam7'; cameras: cam0, cam1"),
        ("camera,line,u,v\ncam0,1,2,x\n", "row 2: u and v are numbers"),
    ],
)
def test_bad_lines_are_named(run: Run, tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "lines.csv").write_text(text)
    trials = stored(tmp_path / "t.npz", rx90())
    code, result = run("bench", "--trials", trials, "--lines", str(tmp_path / "lines.csv"))
    assert (code, result["error"]["code"]) == (1, "lines")
    assert said in result["error"]["message"]
