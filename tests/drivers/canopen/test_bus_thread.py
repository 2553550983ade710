"""The grid of the bus thread's cycles."""

from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.canopen.bus_thread import next_slot

MS = 1_000_000


def test_in_time_every_slot_is_served() -> None:
    assert next_slot(100 * MS, 100 * MS + 60_000, 4 * MS) == (104 * MS, 0)
    assert next_slot(100 * MS, 102 * MS, 4 * MS) == (104 * MS, 0)


def test_a_slot_that_is_nearly_over_is_left_out() -> None:
    assert next_slot(100 * MS, 103 * MS, 4 * MS) == (108 * MS, 1)
    assert next_slot(100 * MS, 141 * MS, 4 * MS) == (144 * MS, 10)


@given(slot=st.integers(0, 10**15), late=st.integers(0, 10**9), period=st.integers(10**6, 10**8))
def test_the_first_slot_of_the_grid_that_leaves_half_a_period(slot: int, late: int, period: int) -> None:
    now = slot + late
    chosen, skipped = next_slot(slot, now, period)
    assert (chosen - slot) % period == 0
    assert chosen == slot + (1 + skipped) * period
    assert chosen >= now + period // 2
    assert skipped == 0 or chosen - period < now + period // 2
