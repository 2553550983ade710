"""``calibrate --trials`` and ``--lines``: stored trials fitted again, without a daemon."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereoservo.calibration.trial_data import save_trials
from stereoservo.cli import main as cli
from stereoservo.cli.calibrate import stored_trials
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.model import load_model
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.locks import FileLock
from stereoservo_sim.world.synthetic import SyntheticCell, rx90

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
    assert "at its next start" in result["use"]
    assert result["lines"] is None
    assert Path(result["figures"]) == model.with_name("model-000001-report.json")
    assert "sigma_factor" in json.loads(Path(result["figures"]).read_text())
    assert run("bench", "--trials", str(tmp_path / "t.npz"))[1]["epoch"] == 2


def test_while_a_daemon_runs_no_model_is_put_beside_its_own(run: Run, tmp_path: Path) -> None:
    trials = stored(tmp_path / "t.npz", rx90())
    directories = cell_directories("bench")
    directories.models.mkdir(parents=True)
    directories.daemon_lock.parent.mkdir(parents=True)
    lock = FileLock(directories.daemon_lock, "bench")
    try:
        code, result = run("bench", "--trials", trials)
        error = result["error"]
        assert (code, error["code"], error["pid"]) == (1, "daemon_running", os.getpid())
        assert "--output FILE.json" in error["message"]
        assert "stop the daemon" in error["message"]
        beside = directories.models / "model-000007.json"
        code, result = run("bench", "--trials", trials, "--output", str(beside))
        assert (code, result["error"]["code"]) == (1, "output")
        code, result = run("bench", "--trials", trials, "--output", str(tmp_path / "m.json"))
        assert code == 0
        assert "no daemon takes this model" in result["use"]
        assert list(directories.models.iterdir()) == []
    finally:
        lock.release()
    assert run("bench", "--trials", trials)[0] == 0


def test_the_seconds_of_the_fit_are_measured(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trials = stored(tmp_path / "t.npz", rx90())
    clock = iter([100.0, 101.25])
    monkeypatch.setattr(stored_trials, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    assert run("bench", "--trials", trials)[1]["seconds"] == 1.25


def test_text_for_people_names_files_lines_and_use(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    cell = rx90().with_k1(-0.3)
    trials = stored(tmp_path / "t.npz", cell)
    (tmp_path / "lines.csv").write_text("camera,line,u,v\n" + straight_lines(cell, 1))
    arguments = ["bench", "--trials", trials, "--lines", str(tmp_path / "lines.csv")]
    assert cli.invoke(["calibrate", *arguments]) == 0
    out = capfd.readouterr().out
    assert f"{tmp_path / 'lines.csv'} (noise 0.3 px), cam1: 0, 1, 2" in out
    assert "model-000001-report/index.html" in out
    assert "model-000001-report.json" in out
    assert "at its next start" in out


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
    assert run("bench", "--quick")[1]["error"]["code"] == "argument"
    assert run("bench", "--check", "--quick", "--reset-zeros")[1]["error"]["code"] == "argument"


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
    names = [str(line) for line in range(12)]
    cameras = {"cam0": names, "cam1": names}
    assert result["lines"] == {"file": str(lines), "sigma_px": 0.1, "cameras": cameras}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("left,line,u,v\n", "lacks columns camera; it has left, line, u, v"),
        ("camera,line,u,v\ncam7,1,2,3\n", "no camera 'cam7'; cameras: cam0, cam1"),
        ("camera,line,u,v\ncam0,1,2,x\n", "line 2: u and v are numbers"),
        ("camera,line,u,v\ncam0,1,2,3,4\n", "line 2: 'cam0,1,2,3,4': 5 cells, 4 are needed"),
        ("camera,line,u,v\ncam0,1,nan,3\n", "line 2: pixel (nan, 3) is outside the image of 640x480 px"),
        ("camera,line,u,v\ncam0,1,1e20,3\n", "line 2: pixel (1e+20, 3) is outside the image of 640x480 px"),
        (
            "camera,line,u,v\ncam0,1,2,3\n",
            "lines of camera 'cam0' ('1', counted from 0): line 0 has 1 pixels",
        ),
        ("camera,line,u,v\n", "holds no row below its header"),
        ("camera\xff", "lacks columns camera, line, u, v"),
    ],
)
def test_bad_lines_are_named(run: Run, tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "lines.csv").write_text(text, encoding="latin-1")
    trials = stored(tmp_path / "t.npz", rx90())
    code, result = run("bench", "--trials", trials, "--lines", str(tmp_path / "lines.csv"))
    assert (code, result["error"]["code"]) == (1, "lines")
    assert said in result["error"]["message"]


@pytest.mark.parametrize("sigma", ["0", "nan", "inf"])
def test_noise_of_lines_that_is_none(run: Run, tmp_path: Path, sigma: str) -> None:
    (tmp_path / "lines.csv").write_text("camera,line,u,v\n")
    given = ("--lines", str(tmp_path / "lines.csv"), "--lines-sigma", sigma)
    code, result = run("bench", "--trials", stored(tmp_path / "t.npz", rx90()), *given)
    assert (code, result["error"]["code"]) == (1, "lines")
    assert "a positive finite number is needed" in result["error"]["message"]


def test_output_that_cannot_be_written_is_named_before_the_fit(run: Run, tmp_path: Path) -> None:
    trials = stored(tmp_path / "t.npz", rx90())
    (tmp_path / "file").write_text("kept")
    os.mkfifo(tmp_path / "pipe")
    before = sorted(path.name for path in tmp_path.iterdir())
    for where in ("no/such/m.json", "file/m.json", ".", "pipe"):
        code, result = run("bench", "--trials", trials, "--output", str(tmp_path / where))
        assert (code, result["error"]["code"]) == (1, "output")
        assert str(tmp_path) in result["error"]["message"]
    assert (tmp_path / "pipe").is_fifo()
    assert (tmp_path / "file").read_text() == "kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == before
