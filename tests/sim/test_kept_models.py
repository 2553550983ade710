"""The store of learnt models: same inputs and same code, same model; and when it must not be used."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stereoservo.cli.main import invoke
from stereoservo.kinematics.model import CellModel, encode_model
from stereoservo.numerics.kernel_cache import file_hash
from stereoservo_sim import kept_models
from stereoservo_sim.kept_models import code_hash, kept_model, model_of_trials, relearning
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import rx90


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a store of its own, empty at first."""
    monkeypatch.setenv(kept_models.CACHE_VARIABLE, str(tmp_path))
    return tmp_path / "models"


class Learning:
    """Something that learns a model, and counts how often."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> CellModel:
        self.times += 1
        return exact_model(rx90())


def test_the_same_trials_are_fitted_once_and_give_the_same_model_to_the_bit(folder: Path) -> None:
    cell = rx90()
    trials, others = (cell.trials(0.1, np.random.default_rng(seed), 5) for seed in (0, 1))
    first, again = model_of_trials(trials), model_of_trials(trials)
    assert (first.found, again.found) == (False, True)
    assert again.path == first.path
    assert encode_model(again.model) == encode_model(first.model)
    assert again.facts["learnt"] == first.facts["learnt"] == again.model.created != ""
    assert model_of_trials(others).found is False
    assert len(list(folder.glob("*.json"))) == 2
    with relearning():
        assert model_of_trials(trials).found is False
    with relearning(False):
        assert model_of_trials(trials).found is True


def test_inputs_differ_by_their_last_bit_shape_and_type(folder: Path) -> None:
    learn = Learning()
    array = np.array([[1.0, 2.0]])
    kinds = (array, np.nextafter(array, 3.0), array[0], array.astype(np.float32), np.float64(1.0), 1.0, -array * 0.0)
    for given in kinds:
        assert not kept_model(("arm", given), learn).found
    assert learn.times == len(kinds)
    for given in kinds:
        assert kept_model(("arm", given), learn).found
    with pytest.raises(TypeError, match="cannot have object"):
        kept_model(object(), learn)


def test_a_damaged_file_is_learnt_again(folder: Path) -> None:
    learn = Learning()
    path = kept_model("arm", learn).path
    assert path is not None
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b'"epoch": 1', b'"epoch": 2'))
    assert not kept_model("arm", learn).found
    path.write_bytes(whole[:100])
    assert not kept_model("arm", learn).found
    assert kept_model("arm", learn).found
    assert learn.times == 3


def test_those_that_were_not_used_for_longest_make_room(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learn = Learning()
    paths = [kept_model(name, learn).path for name in "abc"]
    for age, path in enumerate(paths):
        assert path is not None
        os.utime(path, (1e9 + age, 1e9 + age))
    assert kept_model("a", learn).found  # used now
    size = paths[0].stat().st_size if paths[0] else 0
    monkeypatch.setattr(kept_models, "LIMIT_BYTES", 3 * size + size // 2)
    kept_model("d", learn)
    assert [kept_model(name, learn).found for name in "acd"] == [True, True, True]
    assert not kept_model("b", learn).found
    monkeypatch.setattr(kept_models, "LIMIT_BYTES", 1)
    assert kept_model("e", learn).path in set(folder.glob("*.json"))
    assert len(list(folder.glob("*.json"))) == 1


def test_without_a_folder_to_write_to_every_call_learns_and_the_cause_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(kept_models.CACHE_VARIABLE, str(tmp_path / "file"))
    learn = Learning()
    for _ in range(2):
        kept = kept_model("arm", learn)
        assert (kept.found, kept.path) == (False, None)
    assert learn.times == 2
    assert capsys.readouterr().err.count("Not a directory; STEREOSERVO_CACHE_DIR sets a directory") == 1


def test_an_edit_of_the_code_is_another_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = tmp_path / "edited_package" / "inner" / "part.py"
    module.parent.mkdir(parents=True)
    (tmp_path / "edited_package" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    hashes = []
    for text in ("STOPS = 5\n", "STOPS = 6\n", "STOPS = 5\n"):
        module.write_text(text)
        code_hash.cache_clear()
        file_hash.cache_clear()
        hashes.append(code_hash(("edited_package",)))
    assert hashes[0] == hashes[2] != hashes[1]
    assert code_hash(kept_models.FIT) != code_hash(kept_models.WHOLE)


PROCESS = """
import sys, time
from stereoservo_sim.kept_models import kept_model
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import rx90

def learn():
    with open(sys.argv[1], "a") as file:
        file.write("learnt\\n")
    time.sleep(1.0)
    return exact_model(rx90())

kept_model("arm", learn)
"""


def test_processes_that_need_one_model_at_once_learn_it_once(folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    running = [subprocess.Popen([sys.executable, "-c", PROCESS, str(log)]) for _ in range(2)]
    assert [process.wait(300) for process in running] == [0, 0]
    assert log.read_text() == "learnt\n"


def test_simulate_learns_once_tells_when_and_gives_the_same_results(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def simulate(*options: str) -> str:
        assert invoke(["simulate", "--draw", "1", "--jobs", "1", *options]) == 0
        return capsys.readouterr().out

    first, again, anew = (json.loads(simulate("--json", *more)) for more in ((), (), ("--learn",)))
    assert [answer["calibration"]["model"]["kept"] for answer in (first, again, anew)] == [False, True, False]
    assert first["tasks"] == again["tasks"] == anew["tasks"]
    assert first["calibration"]["rms_px"] == again["calibration"]["rms_px"] == anew["calibration"]["rms_px"]
    learnt = anew["calibration"]["model"]["learnt"]
    assert f"model learnt {learnt}, kept in {folder}" in simulate()
