"""Taught goals, models and the journal on disk."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import Event, Sample
from stereoservo.daemon.kernel_compilation import example_model, example_settings
from stereoservo.daemon.taught_goals import TaughtFileError, taught_goal
from stereoservo.gateway.persistence import Journal, ModelStore, TaughtStore
from stereoservo.kinematics.model import save_model
from stereoservo.messages.goals import FeatureTarget


def taught_event(name: str) -> Event:
    sample = Sample(
        "left",
        np.array([2, 5, 77]),
        np.array([[1.5, 2.5], [3.0, 4.0], [9.0, 9.0]]),
        np.tile(0.01 * np.eye(2), (3, 1, 1)),
        20,
        np.full(3, 20.0),
        np.zeros(3),
    )
    return Event(1, 1, "taught", name=name, joints=np.arange(6.0), samples=(sample,))


def test_a_taught_goal_is_there_after_a_restart_with_its_epoch(tmp_path: Path) -> None:
    store = TaughtStore(tmp_path / "taught.json")
    assert store.names == ()
    model = msgspec.structs.replace(example_model(), epoch=3)
    store.add("pick", taught_goal(taught_event("pick"), model, "2026"))
    store.add("park", taught_goal(taught_event("park"), model, "2026", tool=(2, 5, 77)))
    again = TaughtStore(tmp_path / "taught.json")
    assert again.names == ("park", "pick")
    assert again.goals == store.goals
    pick = again.goals["pick"]
    assert pick.target == FeatureTarget({"left": {2: (1.5, 2.5), 5: (3.0, 4.0)}}, 3)
    assert pick.others == {"left": {77: (9.0, 9.0)}}  # of no body: it stands on the workpiece
    assert pick.sigmas == {"left": {2: 0.1, 5: 0.1, 77: 0.1}}
    assert again.goals["park"].tool == (2, 5, 77)
    assert pick.model is not None
    assert np.array_equal(np.reshape(pick.model.cameras[0].matrix, (3, 4)), model.cameras[0].matrix)


OLD = """{"schema": 1, "goals": {"pick": {"target": {"kind": "features", "set_points":
{"left": {"2": [1.5, 2.5], "77": [9.0, 9.0]}}, "model_epoch": 3}, "joints": [0.5], "created": "2025"}}}"""


def test_a_file_of_schema_1_gains_what_the_model_of_its_epoch_knows(tmp_path: Path) -> None:
    path = tmp_path / "taught.json"
    path.write_text(OLD)
    models = ModelStore(tmp_path)
    gone = TaughtStore(path, models.of_epoch).goals["pick"]
    assert gone.model is None
    assert gone.target.set_points == {"left": {2: (1.5, 2.5), 77: (9.0, 9.0)}}
    save_model(msgspec.structs.replace(example_model(), epoch=3), models.path(3))
    store = TaughtStore(path, models.of_epoch)
    pick = store.goals["pick"]
    assert pick.model is not None
    assert pick.target.set_points == {"left": {2: (1.5, 2.5)}}
    assert pick.others == {"left": {77: (9.0, 9.0)}}
    assert (pick.joints, pick.created) == ((0.5,), "2025")
    store.add("pick", pick)
    assert msgspec.json.decode(path.read_bytes())["schema"] == 2
    assert TaughtStore(path).goals["pick"] == pick


def test_a_file_of_taught_goals_with_a_cut_matrix_names_it(tmp_path: Path) -> None:
    path = tmp_path / "taught.json"
    store = TaughtStore(path)
    store.add("pick", taught_goal(taught_event("pick"), example_model(), ""))
    tree = msgspec.json.decode(path.read_bytes())
    tree["goals"]["pick"]["model"]["cameras"][1]["matrix"].pop()
    path.write_bytes(msgspec.json.encode(tree))
    with pytest.raises(TaughtFileError, match=r"goals\.pick\.model: right\.matrix has 11 numbers; 12 are needed"):
        TaughtStore(path)
    path.write_text('{"schema": 9, "goals": {}}')
    with pytest.raises(TaughtFileError, match="schema 9; this program reads 1 and 2"):
        TaughtStore(path)


def test_a_damaged_file_of_taught_goals_is_reported_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "taught.json"
    path.write_text('{"schema": 1, "goals": {"a": ')
    with pytest.raises(TaughtFileError, match=r"taught\.json"):
        TaughtStore(path)
    assert path.read_text() == '{"schema": 1, "goals": {"a": '


def test_the_newest_model_that_fits_is_taken_and_the_others_are_explained(tmp_path: Path) -> None:
    store = ModelStore(tmp_path)
    assert store.newest_fitting(example_settings()) == (None, [])
    assert store.next_epoch() == 1
    model = example_model()
    save_model(msgspec.structs.replace(model, epoch=1), store.path(1))
    save_model(msgspec.structs.replace(model, epoch=2), store.path(2))
    other = msgspec.structs.replace(model, epoch=3, joint_names=tuple("abcdef"))
    save_model(other, store.path(3))
    store.path(12).write_text("{")
    (tmp_path / "model-000099-report.json").write_text("{}")
    found, passed = store.newest_fitting(example_settings())
    assert found is not None
    assert found.epoch == 2
    assert len(passed) == 2
    assert "is not JSON" in passed[0]
    assert "is of joints a, b, c, d, e, f; the cell has j1" in passed[1]
    assert store.next_epoch() == 13


def test_a_model_of_another_camera_or_marker_does_not_fit(tmp_path: Path) -> None:
    store = ModelStore(tmp_path)
    model = example_model()
    camera = msgspec.structs.replace(model.cameras[0], width=1280)
    save_model(msgspec.structs.replace(model, cameras=(camera, model.cameras[1])), store.path(1))
    save_model(msgspec.structs.replace(model, marker_ids=(0, 1, 2, 3, 4, 77)), store.path(2))
    save_model(msgspec.structs.replace(model, mount="eye_in_hand"), store.path(3))
    found, passed = store.newest_fitting(example_settings())
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
