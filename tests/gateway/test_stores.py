"""Taught goals, models and the journal on disk."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.gateway.stores import Journal, ModelStore, TaughtStore
from stereoservo.kinematics.model import save_model
from stereoservo.runtime.cycle import Event, Sample
from stereoservo.runtime.taught import TaughtFileError
from stereoservo.runtime.warmup import _model, _settings


def taught_event(name: str) -> Event:
    sample = Sample(
        "left",
        np.array([2, 5]),
        np.array([[1.5, 2.5], [3.0, 4.0]]),
        np.zeros((2, 2, 2)),
        20,
        np.full(2, 20.0),
        np.zeros(2),
    )
    return Event(1, 1, "taught", name=name, joints=np.arange(6.0), samples=(sample,))


def test_a_taught_goal_is_there_after_a_restart_with_its_epoch(tmp_path: Path) -> None:
    store = TaughtStore(tmp_path / "taught.json")
    assert store.names == ()
    store.add(taught_event("pick"), 3, "2026")
    store.add(taught_event("park"), 4, "2026")
    again = TaughtStore(tmp_path / "taught.json")
    assert again.names == ("park", "pick")
    assert again.target("pick").set_points == {"left": {2: (1.5, 2.5), 5: (3.0, 4.0)}}
    assert again.target("pick").model_epoch == 3


def test_a_damaged_file_of_taught_goals_is_told_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "taught.json"
    path.write_text('{"schema": 1, "goals": {"a": ')
    with pytest.raises(TaughtFileError, match=r"taught\.json"):
        TaughtStore(path)
    assert path.read_text() == '{"schema": 1, "goals": {"a": '


def test_the_newest_model_that_fits_is_taken_and_the_others_are_explained(tmp_path: Path) -> None:
    store = ModelStore(tmp_path)
    assert store.newest_fitting(_settings()) == (None, [])
    assert store.next_epoch() == 1
    model = _model()
    save_model(msgspec.structs.replace(model, epoch=1), store.path(1))
    save_model(msgspec.structs.replace(model, epoch=2), store.path(2))
    other = msgspec.structs.replace(model, epoch=3, joint_names=tuple("abcdef"))
    save_model(other, store.path(3))
    store.path(12).write_text("{")
    (tmp_path / "model-000099-report.json").write_text("{}")
    found, passed = store.newest_fitting(_settings())
    assert found is not None
    assert found.epoch == 2
    assert len(passed) == 2
    assert "is not JSON" in passed[0]
    assert "is of joints a, b, c, d, e, f; the cell has j1" in passed[1]
    assert store.next_epoch() == 13


def test_a_model_of_another_camera_or_marker_does_not_fit(tmp_path: Path) -> None:
    store = ModelStore(tmp_path)
    model = _model()
    camera = msgspec.structs.replace(model.cameras[0], width=1280)
    save_model(msgspec.structs.replace(model, cameras=(camera, model.cameras[1])), store.path(1))
    save_model(msgspec.structs.replace(model, marker_ids=(0, 1, 2, 3, 4, 77)), store.path(2))
    save_model(msgspec.structs.replace(model, mount="eye_in_hand"), store.path(3))
    found, passed = store.newest_fitting(_settings())
    assert found is None
    assert "mounted eye_in_hand; the cell's are eye_to_hand" in passed.pop(0)
    assert "has markers [77]" in passed[0]
    assert "('left', 1280, 480)" in passed[1]


def test_the_journal_keeps_lines_and_gives_way_when_large(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    journal = Journal(path, limit=100)
    for k in range(30):
        journal.add(b"line %02d" % k)
    journal.close()
    old = tmp_path / "journal.1.jsonl"
    lines = old.read_bytes().split() + path.read_bytes().split()
    assert lines[-1] == b"29"
    assert path.stat().st_size <= 108
    Journal(path).close()
    assert path.exists()
