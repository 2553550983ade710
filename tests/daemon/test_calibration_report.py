"""The fit's files: model, figures, report and verdict, of a success and of a failure."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.fit_assessment import REMEDIES, assess_failure, assess_fit
from stereoservo.calibration.trial_data import CalibrationError, TrialData, load_trials, save_trials
from stereoservo.core.sources.calibration import combined_offsets
from stereoservo.daemon.jobs.calibration_report import floors, residuals_of, write_report
from stereoservo.daemon.jobs.fit_job import fit_trials, report_fit
from stereoservo.kinematics.denavit_hartenberg import denavit_hartenberg
from stereoservo.kinematics.model import CellModel, FitStatistics, JointStatistics, load_model
from stereoservo.messages.known_length import known_length_of
from stereoservo_sim.world.synthetic import RX90_ROWS, SyntheticCell, parallel, rx90

SIGMA = 0.05


def trials(cell: SyntheticCell, seed: int = 1, noise: float = SIGMA) -> TrialData:
    single, joint = cell.stops(9)
    together = [cell.home + combined_offsets(k, -cell.ranges, cell.ranges) for k in range(8)]
    stops = np.vstack([single, together]), np.append(joint, np.full(8, -1))
    return cell.trials(noise, np.random.default_rng(seed), positions=stops, stated=SIGMA)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrialData, object, object]:
    folder = tmp_path_factory.mktemp("fitted")
    data = trials(rx90())
    data.pixels[0, 3, 5] += 7.0  # one wrong match
    save_trials(data, folder / "trials-000001.npz")
    result, said = fit_trials(data, folder / "model-000001.json", 1)
    report_fit(data, folder / "trials-000001.npz", folder / "model-000001.json", result, said)
    return folder, data, result, said


def test_a_page_shows_tracks_histograms_floors_and_what_was_left_out(fitted: tuple) -> None:
    folder, data, _result, said = fitted
    page = (folder / "model-000001-report" / "index.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert not re.search(r'(src|href)="(?!data:)', page), "the page needs other files"
    assert said.text in page.replace("&#x27;", "'").replace("&quot;", '"')
    assert said.grade == "good"
    for name in data.joint_names:
        assert f"<td>{name}</td>" in page
    assert "<td>cam0</td><td>3</td><td>15</td>" in page  # the wrong match, by camera, stop and marker id
    assert "trials-000001.npz" in page


def test_a_known_length_gives_the_arms_dimensions_in_metres(fitted: tuple, tmp_path: Path) -> None:
    _folder, data, result, said = fitted
    a_2, d_4 = RX90_ROWS[1][0], RX90_ROWS[3][2]
    for known, words in {
        f"a:j2={a_2}": [f">{1e3 * a_2:g}<", "metres of a slide"],
        "markers:10,99=0.05": ["Not determined", "2 of 10, 11"],
    }.items():
        page = write_report(
            tmp_path / "known", data, said, model=result.model, report=result.report, known_length=known
        ).read_text()
        for word in (f"Denavit-Hartenberg parameters, by {known}", *words):
            assert word in page, word
    elbow = denavit_hartenberg(result.model, known_length_of(f"a:j2={a_2}"))[3]
    assert elbow.d_std is not None
    assert abs(abs(elbow.d) - d_4) < 4.0 * elbow.d_std < 0.02, (elbow.d, elbow.d_std)


def test_residuals_are_those_of_the_fit(fitted: tuple) -> None:
    _, data, result, _ = fitted
    rest = residuals_of(result.model, data, result.report)
    kept = ~rest.left_out
    assert np.sqrt((rest.pixels[kept] ** 2).mean()) == pytest.approx(result.model.statistics.rms_px, rel=1e-6)
    assert rest.left_out.sum() == result.model.statistics.outliers == 1
    statistics = result.model.statistics
    floor = floors(result.model, rest)
    own = np.array([joint.rms_px for joint in statistics.joints])
    pixels = 2 * 9 * 2 * 14
    assert np.abs(own / floor - 1).max() < 4 / np.sqrt(2 * pixels)


def test_a_failed_fit_has_a_report_with_its_cause_and_its_cure(tmp_path: Path) -> None:
    data = trials(rx90())
    still = msgspec.structs.replace(data, positions=data.positions.copy())
    still.positions[data.trials == 2] = still.positions[0]
    save_trials(still, tmp_path / "trials.npz")
    code = subprocess.run(
        [sys.executable, "-m", "stereoservo.daemon.jobs.fit_job", tmp_path / "trials.npz",
         tmp_path / "model-000004.json", "--epoch", "4"],
        capture_output=True, check=False,
    )  # fmt: skip
    lines = [msgspec.json.decode(line) for line in code.stdout.splitlines()]
    assert code.returncode == 1, code.stderr
    error = next(line["error"] for line in lines if "error" in line)
    assert error["code"] in ("joint_did_not_move", "encoder_frozen")
    page = Path(lines[-1]["report"]).read_text()
    assert "Calibration failed" in page
    assert REMEDIES[error["code"]] in page.replace("&#x27;", "'")
    assert "j3" in page
    assert not (tmp_path / "model-000004.json").exists()


def test_a_report_replaces_an_older_one_whole_and_leaves_nothing_else(fitted: tuple, tmp_path: Path) -> None:
    _, data, result, said = fitted
    folder = tmp_path / "model-000001-report"
    folder.mkdir()
    (folder / "old.html").write_text("old")
    write_report(folder, data, said, model=result.model, report=result.report)
    assert [path.name for path in tmp_path.iterdir()] == ["model-000001-report"]
    assert [path.name for path in folder.iterdir()] == ["index.html"]


def test_a_report_that_cannot_be_written_leaves_model_and_folder_as_they_were(
    fitted: tuple, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, data, result, said = fitted
    folder = tmp_path / "model-000001-report"

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_report(folder, data, said, model=result.model, report=result.report)
    assert list(tmp_path.iterdir()) == []


def test_model_and_trials_are_there_before_the_report(fitted: tuple) -> None:
    folder, data, result, _ = fitted
    statistics = load_model(folder / "model-000001.json").statistics
    assert (statistics.chi2, statistics.joints) == (
        result.model.statistics.chi2,
        result.model.statistics.joints,
    )
    assert np.array_equal(load_trials(folder / "trials-000001.npz").positions, data.positions)


def changed(model: CellModel, **statistics: object) -> CellModel:
    assert model.statistics is not None
    return msgspec.structs.replace(model, statistics=msgspec.structs.replace(model.statistics, **statistics))


def test_verdict_tells_more_noise_than_stated(fitted: tuple) -> None:
    result = fitted[2]
    report = msgspec.structs.replace(result.report, sigma_factor=1.4)
    joints = tuple(
        msgspec.structs.replace(joint, rms_px=joint.rms_px * (3.0 if joint.name == "j2" else 1.0))
        for joint in result.model.statistics.joints
    )
    said = assess_fit(changed(result.model, chi2_ok=False, joints=joints), report)
    assert said.grade == "usable"
    assert "1.40 times the stated noise: lens, play, or positions" in said.text
    assert "joint j2 is worst" in said.text


def test_verdict_names_the_joint_that_moved_too_little(fitted: tuple) -> None:
    result = fitted[2]
    joints = tuple(
        JointStatistics(j.name, j.rms_px, j.stops, np.radians(4.0) if j.name == "j3" else j.range)
        for j in result.model.statistics.joints
    )
    said = assess_fit(changed(result.model, joints=joints), result.report, depth_deviation=0.09)
    assert said.grade == "usable"
    assert "depths are known to 9% only; joint j3 moved 4.0° only" in said.text
    assert "Raise calibration.range.j3." in said.text
    # Deviations fall with the root of what is measured: (0.09 / 0.05)² rounded up.
    assert "more stops (calibration.stops) or frames" in said.text
    assert "4 times as many" in said.text


def test_verdict_says_what_a_stratum_means(tmp_path: Path) -> None:
    result, said = fit_trials(trials(parallel()), tmp_path / "model.json", 1)
    assert result.model.stratum != "metric"
    assert said.grade == "usable"
    assert f"identify the {result.model.stratum} stratum only" in said.text
    assert "image laws and goals shown to the cell work" in said.text


def test_verdict_of_a_failure_names_cause_and_cure() -> None:
    said = assess_failure("too_few_markers", "two cameras see 3 markers")
    assert said.grade == "not usable"
    assert "two cameras see 3 markers. What to do: show more markers" in said.text


def test_every_code_has_a_cure_and_stands_in_the_page_for_integrators() -> None:
    root = Path(__file__).parents[2]
    codes = set()
    for path in (root / "service").rglob("*.py"):
        codes |= set(re.findall(r'(?:CalibrationError|Hypothesis)\(\s*"([a-z_]+)"', path.read_text()))
    assert len(codes) >= 12
    assert codes <= set(REMEDIES), codes - set(REMEDIES)
    page = (root / "docs" / "calibration.md").read_text()
    assert [code for code in sorted(set(REMEDIES)) if f"`{code}`" not in page] == []


def test_statistics_are_needed_for_a_verdict(fitted: tuple) -> None:
    model = msgspec.structs.replace(fitted[2].model, statistics=None)
    assert assess_fit(model, fitted[2].report).grade == "usable"
    assert isinstance(fitted[2].model.statistics, FitStatistics)
    with pytest.raises(CalibrationError):
        residuals_of(msgspec.structs.replace(fitted[2].model, joint_names=tuple("abcdef")), fitted[1], fitted[2].report)
