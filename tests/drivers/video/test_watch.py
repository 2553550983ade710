"""Numbers, missing and repeated pictures."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo_drivers.video.pictures import StreamMonitor

MS = 1_000_000


def image(value):
    return np.full((4, 6), value, np.uint8)


@settings(max_examples=40)
@given(st.lists(st.integers(1, 9), min_size=1, max_size=30))
def test_gaps_of_the_sources_numbers_are_dropped_frames(steps):
    watch = StreamMonitor(30.0)
    numbers = []
    seq = 17
    for k, step in enumerate(steps):
        seq += step
        assert watch.see(image(k), k * 33 * MS, seq, 0, look=True)
        numbers.append(watch.number)
    assert watch.dropped == seq - 17 - steps[0] - (len(steps) - 1)
    assert np.diff(numbers).tolist() == steps[1:]


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(1, 5), st.floats(-0.2, 0.2)), min_size=2, max_size=30))
def test_without_numbers_the_grid_tells(steps):
    watch = StreamMonitor(50.0)
    slot = 0
    for k, (step, jitter) in enumerate(steps):
        slot += step
        watch.see(image(k), round((slot + jitter) * 20 * MS), None, 0, look=True)
    assert watch.dropped == sum(step - 1 for step, _ in steps[1:])
    assert watch.number == slot - steps[0][0]


def test_a_late_picture_is_not_a_lost_one():
    watch = StreamMonitor(100.0)
    for k, t_ms in enumerate((0, 10, 26, 30, 40)):
        watch.see(image(k), t_ms * MS, None, 0, look=True)
    assert watch.dropped == 0
    assert watch.frames == 5


def test_pictures_that_were_passed_over_are_not_missing():
    watch = StreamMonitor(100.0)
    watch.see(image(0), 0, 5, 0, look=True)
    watch.see(image(1), 40 * MS, 9, 3, look=True)
    assert (watch.dropped, watch.frames, watch.number) == (0, 5, 4)


def test_a_source_that_counts_anew_goes_on():
    watch = StreamMonitor(100.0)
    for k, seq in enumerate((500, 501, 0, 1)):
        assert watch.see(image(k), k * 10 * MS, seq, 0, look=True)
    assert (watch.number, watch.dropped) == (3, 0)


def test_equal_pictures_are_withheld_from_the_first_on_and_over_reconnections():
    watch = StreamMonitor(100.0)
    assert watch.see(image(1), 0, None, 0, look=True)
    assert not watch.see(image(1), 10 * MS, None, 0, look=True)
    watch.begin()
    assert not watch.see(image(1), 5000 * MS, None, 0, look=True)
    assert (watch.row, watch.frozen, watch.dropped) == (1, 2, 0)
    one_pixel = image(1)
    one_pixel[3, 5] = 2
    assert watch.see(one_pixel, 5010 * MS, None, 0, look=True)
    assert watch.row == 0


def test_a_number_that_came_before_is_a_repetition_whatever_the_picture():
    watch = StreamMonitor(100.0)
    assert watch.see(image(1), 0, 7, 0, look=False)
    assert not watch.see(image(2), 10 * MS, 7, 0, look=False)
    assert watch.frozen == 1
