"""Trial data: a file that comes back bit for bit, refusals that name what does not fit."""

import io

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.trial_data import (
    CalibrationError,
    PathObservations,
    TrialCamera,
    check_trials,
    decode_trials,
    encode_trials,
    load_trials,
    save_trials,
)
from stereoservo.kinematics.model import JointLoads


@pytest.fixture
def trials(arms):
    rng = np.random.default_rng(1)
    trials = arms["mixed"]().trials(0.1, rng, stops=4)
    trials.pixels[0, 3, 2] = np.nan
    trials.sigmas[0, 3, 2] = np.nan
    return trials


def test_round_trip_bit_for_bit(trials, tmp_path):
    save_trials(trials, tmp_path / "trials.npz")
    again = load_trials(tmp_path / "trials.npz")
    for field in ("positions", "trials", "pixels", "sigmas"):
        assert np.array_equal(getattr(again, field), getattr(trials, field), equal_nan=field in ("pixels", "sigmas"))
    for field in ("joint_names", "joint_kinds", "cameras", "marker_ids", "images"):
        assert getattr(again, field) == getattr(trials, field)
    assert not again.visible[0, 3, 2]
    assert [path.name for path in tmp_path.iterdir()] == ["trials.npz"]


def test_loads_of_the_joints_come_back_and_may_be_missing(trials):
    n = len(trials.joint_names)
    assert decode_trials(encode_trials(trials)).loads is None
    efforts = np.arange(float(n * n)).reshape(n, n) / 3.0
    for loads in (
        JointLoads(np.ones(n), efforts, np.ones(n), np.full(n, 1e-3)),
        JointLoads(np.ones(n), following_errors=np.zeros(n)),
    ):
        again = decode_trials(encode_trials(wrong(trials, loads=loads))).loads
        for field in JointLoads.__struct_fields__:
            assert np.array_equal(getattr(again, field), getattr(loads, field)), field
    with pytest.raises(CalibrationError, match="negative or not finite"):
        check_trials(wrong(trials, loads=JointLoads(-np.ones(n))))
    data = encode_trials(trials)
    for arrays in ({"loads_efforts": efforts}, {"loads_velocities": np.ones(n), "loads_colour": np.ones(1)}):
        if "loads_colour" in arrays:  # of a later version: the rest is read
            assert decode_trials(rewritten(data, **arrays)).loads.velocities.tolist() == [1.0] * n
            continue
        with pytest.raises(CalibrationError, match="velocities"):
            decode_trials(rewritten(data, **arrays), "here.npz")


def seen_on_the_way(trials, frames=5, samples=9, seen=3):
    rng = np.random.default_rng(2)
    pixels = rng.uniform(0.0, 480.0, (frames, seen, 2))
    pixels[1, 2] = np.nan
    return PathObservations(
        ways=np.arange(frames) // 2, cameras=np.arange(frames) % 2, times=rng.uniform(0.0, 9.0, frames),
        markers=np.full((frames, seen), trials.marker_ids[0]), pixels=pixels, joint_ways=np.zeros(samples, np.int64),
        joint_times=np.linspace(0.0, 9.0, samples), positions=rng.normal(size=(samples, len(trials.joint_names))),
    )  # fmt: skip


def test_what_was_seen_on_the_path_comes_back_and_may_be_missing(trials):
    assert decode_trials(encode_trials(trials)).way is None
    way = seen_on_the_way(trials)
    again = decode_trials(encode_trials(wrong(trials, way=way))).way
    for field in PathObservations.__struct_fields__:
        assert np.array_equal(getattr(again, field), getattr(way, field), equal_nan=field == "pixels"), field
    for words, field, array in (
        ("way_positions has shape", "positions", way.positions[:, 1:]),
        ("way_times holds numbers", "times", np.full(5, np.nan)),
        ("0 to 1 are cameras", "cameras", np.full(5, 2)),
    ):
        with pytest.raises(CalibrationError, match=words):
            check_trials(wrong(trials, way=wrong(way, **{field: array})))


def holed(positions):
    return np.where(np.arange(len(positions))[:, None] == 2, np.nan, positions)


def rewritten(data, /, **arrays):
    """The file with other arrays, None leaves one out."""
    with np.load(io.BytesIO(data)) as archive:
        kept = {**archive, **arrays}
    buffer = io.BytesIO()
    np.savez(buffer, **{key: array for key, array in kept.items() if array is not None})
    return buffer.getvalue()


def sized(cameras, size):
    return tuple(TrialCamera(camera.name, size, size) for camera in cameras)


def emptied(data):
    return {
        "positions": data.positions[:0],
        "trials": data.trials[:0],
        "pixels": data.pixels[:, :0],
        "sigmas": data.sigmas[:, :0],
    }


def wrong(data, /, **fields):
    return msgspec.structs.replace(data, **fields)


@pytest.mark.parametrize(
    ("code", "words", "fields"),
    [
        ("too_few_cameras", "1 camera", lambda t: {"cameras": t.cameras[:1]}),
        ("bad_data", "9 cameras; a cell has at most 8", lambda t: {"cameras": t.cameras[:1] * 9}),
        ("bad_data", "257 markers; a cell has at most 256", lambda t: {"marker_ids": tuple(range(257))}),
        (
            "bad_data", "13 joints; a cell has at most 12",
            lambda t: {"joint_names": tuple("abcdefghijklm"), "joint_kinds": t.joint_kinds[:1] * 13},
        ),
        ("bad_data", "kinds", lambda t: {"joint_kinds": t.joint_kinds[:2]}),
        ("bad_data", "not all different", lambda t: {"marker_ids": (10,) * 14}),
        ("bad_data", "not all different", lambda t: {"joint_names": ("a", "a", "b", "c")}),
        ("bad_data", r"pixels has shape .* is needed", lambda t: {"pixels": t.pixels[:, 1:]}),
        ("bad_data", r"sigmas has shape", lambda t: {"sigmas": t.sigmas[..., None]}),
        ("bad_data", "positions of stop 2", lambda t: {"positions": holed(t.positions)}),
        ("bad_data", "from -1 to 7; -1 to 3", lambda t: {"trials": np.array([-1, 7] * 8)}),
        ("bad_data", "has 0 px; positive ones", lambda t: {"sigmas": np.zeros_like(t.sigmas)}),
        ("bad_data", "has nan px; positive ones up to 64", lambda t: {"sigmas": np.full_like(t.sigmas, np.nan)}),
        ("bad_data", "has 1000 px; positive ones up to 64", lambda t: {"sigmas": np.full_like(t.sigmas, 1e3)}),
        ("bad_data", r"has 1e\+300, .* px; pixels within 2560", lambda t: {"pixels": t.pixels * 0 + 1e300}),
        ("bad_data", "Is its image size", lambda t: {"pixels": t.pixels + 640}),
        ("bad_data", "size 0x0 px is not positive", lambda t: {"cameras": sized(t.cameras, 0)}),
        ("bad_data", "at most 1e\\+06", lambda t: {"positions": t.positions + 1e30}),
        ("bad_data", "'screw'", lambda t: {"joint_kinds": ("screw",) * 4}),
        ("bad_data", "float64 numbers; indices", lambda t: {"trials": t.trials + 0.5}),
        ("too_few_stops", "no stops", emptied),
    ],
)  # fmt: skip
def test_refuses_what_does_not_fit(trials, code, words, fields):
    with pytest.raises(CalibrationError, match=words) as caught:
        check_trials(wrong(trials, **fields(trials)))
    assert caught.value.code == code


def test_refuses_broken_files(trials, tmp_path):
    data = encode_trials(trials)
    for broken in (b"", b"not a zip", data[: len(data) // 2], data.replace(b'"schema":1', b'"schema":9')):
        with pytest.raises(CalibrationError) as caught:
            decode_trials(broken, "here.npz")
        assert caught.value.code == "bad_data"
        assert "here.npz" in str(caught.value)
    with pytest.raises(CalibrationError, match="array 'pixels' is missing"):
        decode_trials(rewritten(data, pixels=None), "here.npz")
    for arrays in (
        {"trials": trials.trials + 0.4},
        {"pixels": trials.pixels.astype(complex)},
        {"positions": trials.positions.ravel()},
    ):
        with pytest.raises(CalibrationError, match=r"here\.npz") as caught:
            decode_trials(rewritten(data, **arrays), "here.npz")
        assert caught.value.code == "bad_data"
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_trials(tmp_path / "missing.npz")
