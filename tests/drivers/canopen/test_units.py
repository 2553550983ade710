"""Units of the drives: round trips, signs, the wrap of 32-bit counters."""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_drivers.canopen.units import INT32_MAX, INT32_MIN, JointScale, Unwrapper, clamp_int32


def joint(**changes: object) -> CanJoint:
    values: dict[str, object] = {
        "name": "j1", "node_id": 1, "counts_per_rev": 4096, "gear_ratio": 100.0, "max_velocity": 1.0,
        "max_acceleration": 4.0, "quick_stop_deceleration": 10.0, "position_min": -2.9, "position_max": 2.9,
    }  # fmt: skip
    return CanJoint(**(values | changes))  # type: ignore[arg-type]


def wrapped(counts: int) -> int:
    """What a signed 32-bit register shows of ``counts``."""
    return int.from_bytes((counts % 2**32).to_bytes(4, "little"), "little", signed=True)


def test_a_quarter_turn_of_a_geared_joint() -> None:
    scale = JointScale.of(joint(direction=-1, offset_rad=0.5))
    # 4096 counts a motor turn, 100 motor turns a joint turn: a quarter is 102400 counts, backwards.
    assert scale.position(-102_400) == pytest.approx(math.pi / 2 - 0.5, abs=1e-12)
    assert scale.counts(math.pi / 2 - 0.5) == -102_400
    assert scale.velocity_units(math.pi / 2) == -102_400
    assert scale.difference(-102_400) == pytest.approx(math.pi / 2)
    assert scale.resolution == pytest.approx(2 * math.pi / 409_600)


def test_velocity_in_rpm_of_the_motor() -> None:
    scale = JointScale.of(joint(velocity_units_per_rev_s=60.0))
    # One joint turn a second is 100 motor turns a second: 6000 rpm.
    assert scale.velocity_units(2 * math.pi) == 6000
    assert scale.velocity(-6000) == pytest.approx(-2 * math.pi)
    assert scale.rate_units(-math.pi) == 3000
    assert scale.counts(2 * math.pi) == 409_600


def test_a_spindle_counts_per_metre() -> None:
    scale = JointScale.of(joint(kind="prismatic", counts_per_rev=2000, gear_ratio=200.0))
    # 5 mm a motor turn: 200 turns a metre.
    assert scale.counts(0.005) == 2000
    assert scale.velocity_units(0.01) == 4000


def test_a_limit_is_never_sent_as_zero() -> None:
    assert JointScale.of(joint(counts_per_rev=1, gear_ratio=1.0)).rate_units(1e-6) == 1


def test_commands_beyond_32_bits_are_clamped() -> None:
    scale = JointScale.of(joint())
    assert scale.velocity_units(1e9) == INT32_MAX
    assert scale.velocity_units(-1e9) == INT32_MIN
    assert clamp_int32(math.inf) == INT32_MAX
    with pytest.raises(ValueError, match="NaN"):
        scale.velocity_units(math.nan)


@given(
    counts=st.floats(1, 2**23),
    gear=st.floats(0.1, 500),
    direction=st.sampled_from([1, -1]),
    offset=st.floats(-math.pi, math.pi),
    q=st.floats(-3, 3),
    kind=st.sampled_from(["revolute", "prismatic"]),
)
def test_positions_return_within_half_a_count(
    counts: float, gear: float, direction: int, offset: float, q: float, kind: str
) -> None:
    scale = JointScale.of(
        joint(counts_per_rev=counts, gear_ratio=gear, direction=direction, offset_rad=offset, kind=kind)
    )
    back = scale.position(scale.counts(q))
    assert abs(back - q) <= 0.5 * scale.resolution + 1e-12
    # The same by exact arithmetic of the definition q = counts / k - offset.
    k = Fraction(counts) * Fraction(gear) * direction
    if kind == "revolute":
        k /= Fraction(2) * Fraction(math.pi)
    assert abs(Fraction(scale.counts(q)) / k - Fraction(offset) - Fraction(back)) < 1e-9


@given(
    start=st.integers(INT32_MIN, INT32_MAX),
    steps=st.lists(st.integers(-(2**31) + 1, 2**31 - 1), max_size=40),
)
def test_unwrapping_follows_any_path_of_steps_below_half_a_wrap(start: int, steps: list[int]) -> None:
    unwrapper = Unwrapper()
    assert unwrapper.update(start) == start
    truth = start
    for step in steps:
        truth += step
        assert unwrapper.update(wrapped(truth)) == truth


@pytest.mark.parametrize("sign", [1, -1])
def test_turns_are_kept_across_the_wrap_both_ways(sign: int) -> None:
    # 19 bit times 160 wraps after 51 joint turns: go 60 turns out and come back.
    scale = JointScale.of(joint(counts_per_rev=2**19, gear_ratio=160.0))
    unwrapper = Unwrapper()
    way = [*range(0, 600), *range(600, -1, -1)]
    for tenth in way:
        q = sign * 2 * math.pi * tenth / 10
        counts = unwrapper.update(wrapped(scale.counts(q)))
        assert scale.position(counts) == pytest.approx(q, abs=scale.resolution)


def test_a_reset_forgets_the_turn() -> None:
    unwrapper = Unwrapper()
    unwrapper.update(INT32_MAX)
    assert unwrapper.update(INT32_MIN) == INT32_MAX + 1
    unwrapper.reset()
    assert unwrapper.update(INT32_MIN) == INT32_MIN
