"""The truth over time: interpolation, wrap-around, torn samples, several processes."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo_sim.world.history import FILE_NAME, HistoryError, TrueJointHistory

MS = 1_000_000


def fill(history, count, start=1000 * MS, step=4 * MS):
    for i in range(count):
        t = (start + i * step) * 1e-9
        history.append(start + i * step, motion(t), velocity(t))


def motion(t):
    return np.array([np.sin(t), 0.5 * np.cos(2 * t)])


def velocity(t):
    return np.array([np.cos(t), -np.sin(2 * t)])


def test_interpolates_a_smooth_motion_to_nanoradians():
    history = TrueJointHistory.in_memory(2)
    fill(history, 200)
    for t_ns in np.random.default_rng(0).integers(1000 * MS, 1796 * MS, 50).tolist():
        assert np.abs(history.at(t_ns) - motion(t_ns * 1e-9)).max() < 1e-10


def test_samples_come_back_bit_for_bit():
    history = TrueJointHistory.in_memory(2)
    fill(history, 5)
    t = 1008 * MS
    assert np.array_equal(history.at(t), motion(t * 1e-9))
    newest = history.newest()
    assert newest is not None
    assert newest[0] == 1016 * MS
    assert np.array_equal(newest[2], velocity(1016 * MS * 1e-9))


def test_before_the_first_sample_the_arm_stood_there_and_after_the_last_nobody_knows():
    history = TrueJointHistory.in_memory(2)
    assert history.newest() is None
    assert history.at(0) is None
    fill(history, 3)
    assert np.array_equal(history.at(0), motion(1.0))
    assert history.at(1008 * MS) is not None
    assert history.at(1008 * MS + 1) is None


def test_an_arm_that_stands_stands_still_to_the_last_bit():
    history = TrueJointHistory.in_memory(2)
    place = np.random.default_rng(0).normal(size=2)
    for k in range(3):
        history.append(k * 4 * MS, place, np.zeros(2))
    assert all(np.array_equal(history.at(t_ns), place) for t_ns in range(0, 8 * MS, 77_777))


def test_times_must_grow():
    history = TrueJointHistory.in_memory(2)
    fill(history, 3)
    history.append(1000 * MS, np.zeros(2), np.zeros(2))
    assert history.count == 3


@settings(max_examples=30, deadline=None)
@given(count=st.integers(1, 200), asked=st.integers(0, 900 * MS))
def test_a_full_ring_answers_for_what_it_still_holds(count, asked):
    history = TrueJointHistory.in_memory(2, capacity=64)
    fill(history, count)
    held, times, positions = history.since(0)
    assert held == count
    assert len(times) == len(positions) == min(count, 63 if count > 63 else count)
    t_ns = 1000 * MS + asked
    answer = history.at(t_ns)
    if t_ns > times[-1]:
        assert answer is None
    elif t_ns >= times[0]:
        assert np.abs(answer - motion(t_ns * 1e-9)).max() < 1e-10


def test_a_damaged_sample_is_not_taken():
    history = TrueJointHistory.in_memory(2)
    fill(history, 3)
    history._buffer[history._at(2) + 20] ^= 1
    assert history.sample(2) is None
    newest = history.newest()
    assert newest is not None
    assert newest[0] == 1004 * MS


def test_the_writer_goes_on_with_its_file(tmp_path):
    path = tmp_path / FILE_NAME
    history = TrueJointHistory.create(path, 2, now_ns=1000 * MS, capacity=64)
    fill(history, 3)
    reader = TrueJointHistory.open(path)
    history.close()
    again = TrueJointHistory.create(path, 2, now_ns=2000 * MS, capacity=64)
    again.append(2000 * MS, np.ones(2), np.zeros(2))
    assert reader.count == 4
    assert not reader.replaced()
    assert np.array_equal(reader.at(2000 * MS), np.ones(2))


@pytest.mark.parametrize(("joints", "now_ns"), [(3, 2000 * MS), (2, 1001 * MS)], ids=["arm", "future"])
def test_a_file_of_another_arm_or_from_the_future_is_replaced(tmp_path, joints, now_ns):
    path = tmp_path / FILE_NAME
    fill(TrueJointHistory.create(path, 2, now_ns=1000 * MS, capacity=64), 3)
    reader = TrueJointHistory.open(path)
    fresh = TrueJointHistory.create(path, joints, now_ns=now_ns, capacity=64)
    assert fresh.count == 0
    assert reader.replaced()


def test_a_file_that_is_no_history_is_refused(tmp_path):
    path = tmp_path / FILE_NAME
    with pytest.raises(HistoryError, match=FILE_NAME):
        TrueJointHistory.open(path)
    path.write_bytes(b"x" * 100)
    with pytest.raises(HistoryError, match="not the history"):
        TrueJointHistory.open(path)


WRITER = """
import sys
from pathlib import Path
import numpy as np
from stereoservo_sim.world.history import TrueJointHistory
history = TrueJointHistory.open(Path(sys.argv[1]))
for i in range(1, 20_001):
    history.append(i, np.full(2, float(i)), np.zeros(2))
"""


def test_a_reader_in_another_process_never_sees_a_torn_sample(tmp_path):
    path = tmp_path / FILE_NAME
    history = TrueJointHistory.create(path, 2, now_ns=0, capacity=64)
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)]) as writer:
        while writer.poll() is None:
            newest = history.newest()
            if newest is not None:
                assert newest[1].tolist() == [float(newest[0])] * 2
    assert writer.returncode == 0
    assert history.count == 20_000
    newest = history.newest()
    assert newest is not None
    assert newest[0] == 20_000
