"""Model files: every bit comes back, nothing half written, refusals that name the field."""

import json
import os

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereoservo.kinematics.model import (
    MODEL_SCHEMA,
    CameraModel,
    CellModel,
    FitStatistics,
    JointLoads,
    JointStatistics,
    MarkerGroup,
    ModelFileError,
    ShutterOffset,
    check_model,
    decode_model,
    encode_model,
    load_model,
    save_model,
)
from stereoservo.messages.files import write_atomically

SCENE = (901, 902, 903, 904)
GROUP = MarkerGroup((0, 1, 2), (0, 1, 2, 4), 1, 0, 0.1 + 0.2)
GROUP_OUTSIDE = MarkerGroup((0, 1, 5), (0, 1, 5), 1, 0, 0.3)
GROUP_TWICE = MarkerGroup((0, 1, 1), (0, 1, 2), 1, 0, 0.3)
GROUP_OF_OTHERS = MarkerGroup((0, 1, 3), (0, 1, 2, 4), 1, 0, 0.3)
OF_NO_CAMERA = (ShutterOffset("high", 0.0, 0.0),)
HOLED = np.where(np.arange(32).reshape(2, 4, 4) == 27, np.nan, 1.0)


def make_model(seed=0, **fields):
    rng = np.random.default_rng(seed)
    plane = rng.normal(0, 0.3, 4) + np.eye(4)[3]
    points = rng.normal(0, 0.2, (5, 4)) + np.array([0.0, 0.0, 1.0, 1.0])
    upgrade = np.vstack([rng.normal(size=(3, 4)), plane])
    twists = np.zeros((2, 4, 4))
    axis = rng.normal(size=3)
    twists[0, :3, :3] = np.cross(np.eye(3), axis / np.linalg.norm(axis))
    twists[0, :3, 3] = -twists[0, :3, :3] @ rng.normal(size=3)
    twists[1, :3, 3] = rng.normal(size=3)
    model = CellModel(
        schema=MODEL_SCHEMA,
        epoch=4,
        joint_names=("shoulder", "slide"),
        joint_kinds=("revolute", "prismatic"),
        zero=rng.normal(size=2),
        generators=np.linalg.inv(upgrade) @ twists @ upgrade,
        cameras=(
            CameraModel("left", rng.normal(size=(3, 4)), 640, 480),
            CameraModel("right", rng.normal(size=(3, 4)), 800, 600, np.array([-0.1, 398.0, 301.0, 400.0])),
        ),
        marker_ids=(3, 1, 4, 15, 9),
        marker_points=points / (points @ plane)[:, None],
        plane_at_infinity=plane,
        stratum="metric",
        projective_to_euclidean=upgrade,
        statistics=FitStatistics(
            0.1, 1000.5, 990, True, 1071, 81, 3, (JointStatistics("shoulder", 0.1 / 3, 9, 0.5),), 450
        ),
        created="2001-07-01T00:00:00Z",
        source="trial motions",
    )
    return msgspec.structs.replace(model, **fields)


def same(one, two):
    for field in msgspec.structs.fields(CellModel):
        a, b = getattr(one, field.name), getattr(two, field.name)
        if isinstance(a, np.ndarray):
            assert a.tobytes() == b.tobytes(), field.name
            assert a.shape == b.shape
        elif field.name == "cameras":
            for x, y in zip(a, b, strict=True):
                assert x.matrix.tobytes() == y.matrix.tobytes()
                assert x.lens.tobytes() == y.lens.tobytes()
                assert (x.name, x.width, x.height) == (y.name, y.width, y.height)
        elif field.name == "statistics" and a is not None:
            assert msgspec.structs.asdict(a) == msgspec.structs.asdict(b)
        else:
            assert a == b, field.name


@given(
    seed=st.integers(0, 2**32 - 1),
    zero=hnp.arrays(np.float64, 2, elements=st.floats(allow_nan=False, allow_infinity=False)),
)
@settings(max_examples=40, deadline=None)
def test_round_trip_keeps_every_bit(seed, zero):
    model = make_model(seed, zero=zero)
    same(decode_model(encode_model(model)), model)


def test_file_round_trip(tmp_path):
    path = tmp_path / "model.json"
    offsets = (ShutterOffset("right", -0.1 / 3, 1e-4 / 3),)
    model = make_model(1, stratum="affine", projective_to_euclidean=None, statistics=None, shutter_offsets=offsets)
    save_model(model, path)
    same(load_model(path), model)
    assert json.loads(path.read_text())["generators"][0][0] == model.generators[0, 0].tolist()
    assert [p.name for p in tmp_path.iterdir()] == ["model.json"]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "model.json"
    save_model(make_model(1), path)
    old = path.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_model(make_model(2), path)
    monkeypatch.undo()
    with pytest.raises(ModelFileError):
        save_model(make_model(2, epoch=-1), path)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["model.json"]


@pytest.mark.parametrize(
    ("key", "words", "fields"),
    [
        ("schema", f"is 9; this version reads {MODEL_SCHEMA}", {"schema": 9}),
        ("epoch", "-1", {"epoch": -1}),
        ("joint_kinds", "has 1 entries", {"joint_kinds": ("revolute",)}),
        ("joint_names", "'a' stands twice", {"joint_names": ("a", "a")}),
        ("joint_names", "empty", {"joint_names": ()}),
        ("marker_ids", "empty", {"marker_ids": ()}),
        ("cameras", "empty", {"cameras": ()}),
        ("joint_names", "has 13 entries; a cell has at most 12", {"joint_names": tuple("abcdefghijklm")}),
        ("marker_ids", "has 257 entries; a cell has at most 256", {"marker_ids": tuple(range(257))}),
        ("marker_ids", "at most 252 markers beside 4 static", {"marker_ids": tuple(range(253)), "scene_ids": SCENE}),
        ("cameras", "has 9 entries; a cell has at most 8", {"cameras": (CameraModel("left", np.eye(3, 4), 4, 4),) * 9}),
        ("marker_groups[1]", "three of them different", {"marker_groups": (GROUP, GROUP_OUTSIDE)}),
        ("marker_groups[0]", "three of them different", {"marker_groups": (GROUP_TWICE,)}),
        ("marker_groups[0]", "three of them different", {"marker_groups": (GROUP_OF_OTHERS,)}),
        ("zero", r"shape \(3,\); \(2,\) is needed", {"zero": np.zeros(3)}),
        ("generators", r"entry \(1, 2, 3\) is nan", {"generators": HOLED}),
        ("marker_points", r"shape \(4, 4\)", {"marker_points": np.ones((4, 4))}),
        ("generators[0]", "'shoulder' is revolute", {"generators": np.ones((2, 4, 4))}),
        ("marker_points[0]", "marker 3", {"marker_points": np.ones((5, 4)) * 9}),
        ("projective_to_euclidean", "missing", {"projective_to_euclidean": None}),
        ("projective_to_euclidean", "given", {"stratum": "affine"}),
        ("projective_to_euclidean", r"shape \(3, 3\)", {"projective_to_euclidean": np.eye(3)}),
        ("cameras[0]", "0x480", {"cameras": (CameraModel("left", np.ones((3, 4)), 0, 480),)}),
        ("shutter_offsets[0]", "'high'; once each of left, right", {"shutter_offsets": OF_NO_CAMERA}),
        ("shutter_offsets[1]", "once each", {"shutter_offsets": (ShutterOffset("left", 0.0, 0.0),) * 2}),
        ("shutter_offsets[0]", "is nan s", {"shutter_offsets": (ShutterOffset("left", np.nan, 0.0),)}),
        ("shutter_offsets[0]", "up to 1 s is taken", {"shutter_offsets": (ShutterOffset("left", 0.0, 2.0),)}),
        ("cameras[0].matrix", r"shape \(4, 4\)", {"cameras": (CameraModel("left", np.eye(4), 640, 480),)}),
    ],
)  # fmt: skip
def test_refuses_what_does_not_fit(key, words, fields):
    with pytest.raises(ModelFileError, match=words) as caught:
        check_model(make_model(0, **fields), "cell.json")
    assert caught.value.key == key
    assert caught.value.path == "cell.json"
    assert str(caught.value).startswith("cell.json: ")


def test_prismatic_generator_must_be_nilpotent():
    model = make_model(0)
    generators = model.generators.copy()
    generators[1] += 1e-3 * np.eye(4)
    with pytest.raises(ModelFileError, match=r"generators\[1\].*'slide' is prismatic"):
        check_model(msgspec.structs.replace(model, generators=generators))


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        (lambda t: t.update(schema=3), "schema", "is 3"),
        (lambda t: t.pop("schema"), "schema", "is None"),
        (lambda t: t.pop("zero"), "", "zero"),
        (lambda t: t.update(epoch="four"), "epoch", "int"),
        (lambda t: t.update(zero="0 0"), "zero", "list"),
        (lambda t: t.update(zero=[0.0, None]), "zero", "finite"),
        (lambda t: t.update(zero=[[0.0], [0.0, 1.0]]), "zero", "inhomogeneous"),
        (lambda t: t.update(stratum="conformal"), "stratum", "conformal"),
        (lambda t: t["cameras"][1].pop("matrix"), "cameras[1]", "matrix"),
    ],
)
def test_refuses_tampered_files(tmp_path, change, key, words):
    tree = json.loads(encode_model(make_model(0)))
    change(tree)
    path = tmp_path / "model.json"
    path.write_text(json.dumps(tree))
    with pytest.raises(ModelFileError, match=words) as caught:
        load_model(path)
    assert caught.value.key.startswith(key)
    assert caught.value.path == str(path)


@pytest.mark.parametrize("data", [b"", b"{", b"[1]", b"\xff\xfe"])
def test_refuses_what_is_no_json_object(data):
    with pytest.raises(ModelFileError):
        decode_model(data)


def test_states_that_a_file_is_missing(tmp_path):
    with pytest.raises(ModelFileError, match="cannot be read: No such file"):
        load_model(tmp_path / "model.json")


def test_coplanar_groups_come_back_and_a_file_without_them_is_read():
    model = make_model(3, marker_groups=(GROUP,))
    assert decode_model(encode_model(model)).marker_groups == (GROUP,)
    tree = json.loads(encode_model(model))
    del tree["marker_groups"]
    assert decode_model(json.dumps(tree).encode()).marker_groups is None


def test_a_newer_reader_tolerates_new_fields():
    """Readers of files written by a later version with the same schema keep working."""
    tree = json.loads(encode_model(make_model(0)))
    tree["colour"] = "blue"
    same(decode_model(json.dumps(tree).encode()), make_model(0))


def test_a_file_of_the_first_schema_is_read_as_pinholes_that_stand_still():
    tree = json.loads(encode_model(make_model()))
    tree["schema"] = 1
    del tree["mount"]
    for camera in tree["cameras"]:
        del camera["lens"]
    model = decode_model(json.dumps(tree).encode())
    assert model.schema == MODEL_SCHEMA
    assert model.mount == "eye_to_hand"
    assert not model.tip_first
    assert [camera.lens[0] for camera in model.cameras] == [0.0, 0.0]


LOADS = JointLoads(np.array([0.5, 0.1]), np.array([[3.0, 0.1], [1 / 3, 4.0]]), np.array([5.0, 9.0]), np.full(2, 1e-3))


def test_loads_come_back_and_a_file_without_them_is_read():
    for loads in (LOADS, JointLoads(np.ones(2)), JointLoads(np.ones(2), following_errors=np.zeros(2))):
        back = decode_model(encode_model(make_model(loads=loads))).loads
        for field in JointLoads.__struct_fields__:
            assert np.array_equal(getattr(back, field), getattr(loads, field)), field
    tree = json.loads(encode_model(make_model()))
    del tree["loads"]
    assert decode_model(json.dumps(tree).encode()).loads is None


@pytest.mark.parametrize(
    ("key", "text", "fields"),
    [
        ("loads.efforts", r"shape \(2,\); \(2, 2\)", {"efforts": np.ones(2)}),
        ("loads.velocities", "negative or not finite", {"velocities": np.array([1.0, -0.1])}),
        ("loads.following_errors", "negative or not finite", {"following_errors": np.array([np.nan, 0.0])}),
        ("loads", "both or none", {"largest_efforts": None}),
    ],
)
def test_refuses_loads_that_cannot_be(key, text, fields):
    model = make_model(loads=msgspec.structs.replace(LOADS, **fields))
    with pytest.raises(ModelFileError, match=text) as caught:
        check_model(model)
    assert caught.value.key == key


def test_nothing_but_a_file_is_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link"):
        with pytest.raises(OSError, match="Not a regular file"):
            write_atomically(tmp_path / name, b"data")
    with pytest.raises(IsADirectoryError, match="the name of a file"):
        write_atomically(tmp_path, b"data")
    with pytest.raises(FileNotFoundError, match="a folder that exists"):
        write_atomically(tmp_path / "none" / "file", b"data")
    assert (tmp_path / "pipe").is_fifo()
    assert (tmp_path / "link").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "pipe"]


def put(*where):
    """A change of a file's tree: the last argument goes where the others lead."""

    def change(tree):
        *keys, last, value = where
        for key in keys:
            tree = tree[key]
        tree[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        (put("projective_to_euclidean", np.eye(4).tolist()), "projective_to_euclidean", "Euclidean rotation"),
        (put("projective_to_euclidean", np.ones((4, 4)).tolist()), "projective_to_euclidean", "invertible"),
        (put("projective_to_euclidean", np.zeros((4, 4)).tolist()), "projective_to_euclidean", "invertible"),
        (put("cameras", 0, "matrix", [[1, 2, 3, 4]] * 3), "cameras[0].matrix", "rank 3"),
        (put("cameras", 1, "matrix", np.zeros((3, 4)).tolist()), "cameras[1].matrix", "rank 3"),
        (put("cameras", 1, "lens", [-5.0, 398.0, 301.0, 400.0]), "cameras[1].lens", "at most ±1"),
        (put("generators", 0, (1e200 * np.eye(4)).tolist()), "generators[0]", "is needed"),
        (put("epoch", 10**40), "epoch", r"below 2\^63"),
        (put("schema", True), "schema", "is True"),
    ],
)  # fmt: skip
def test_refuses_files_whose_numbers_cannot_be_a_cell_s(change, key, words):
    tree = json.loads(encode_model(make_model()))
    change(tree)
    with pytest.raises(ModelFileError, match=words) as caught:
        decode_model(json.dumps(tree).encode())
    assert caught.value.key == key


def test_refuses_lists_in_lists_without_end():
    with pytest.raises(ModelFileError, match="is not JSON"):
        decode_model(b"[" * 100_000)
