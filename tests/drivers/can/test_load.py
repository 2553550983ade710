"""Bits on the wire against a reference that goes bit by bit over text, and values worked out by hand."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.load import crc15, cycle_load, frame_bits, refusal, worst_bits

SYNC_AND_THREE_PDOS = [0] + [6] * 12 + [4] * 6
"""SYNC, and of six drives: RPDO 6 bytes, TPDO 6 bytes, TPDO 4 bytes."""


def crc_by_division(text: str) -> str:
    """Remainder of polynomial division, on text."""
    divisor = "1100010110011001"  # x15 + x14 + x10 + x8 + x7 + x4 + x3 + 1
    rest = list(text + "0" * 15)
    for k in range(len(text)):
        if rest[k] == "1":
            for j, digit in enumerate(divisor):
                rest[k + j] = "0" if rest[k + j] == digit else "1"
    return "".join(rest[-15:])


def on_the_wire(frame: CanFrame) -> str:
    """The stuffed part as text, then the fixed tail with the intermission."""
    length = frame.length if frame.remote else len(frame.data)
    if frame.extended:
        number = f"{frame.id:029b}"
        head = "0" + number[:11] + "11" + number[11:] + f"{frame.remote:b}" + "00" + f"{length:04b}"
    else:
        head = "0" + f"{frame.id:011b}" + f"{frame.remote:b}" + "00" + f"{length:04b}"
    text = head + "".join(f"{byte:08b}" for byte in frame.data)
    text += crc_by_division(text)
    sent = ""
    for bit in text:
        sent += bit
        if sent.endswith(("00000", "11111")):
            sent += "1" if bit == "0" else "0"
    return sent + "1" + "01" + "1" * 7 + "1" * 3


@given(data=st.data())
def test_exact_length_is_that_of_the_bits_one_by_one(data, any_frame):
    frame = data.draw(any_frame)
    bits = frame_bits(frame)
    assert bits == len(on_the_wire(frame))
    assert bits <= worst_bits(len(frame.data), extended=frame.extended)


@given(bits=st.integers(0, 2**83 - 1), count=st.integers(83, 120))
def test_crc_is_the_remainder_of_division(bits, count):
    assert f"{crc15(bits, count):015b}" == crc_by_division(f"{bits:0{count}b}")


def test_frame_of_zeros():
    # Id 0 without data: the head's 19 bits and the CRC of zeros are 0. A stuff bit after every five of 34 zeros.
    assert frame_bits(CanFrame(0)) == 34 + 6 + 13


@pytest.mark.parametrize(
    ("length", "extended", "bits"),
    [(0, False, 55), (4, False, 95), (6, False, 115), (8, False, 135), (0, True, 80), (8, True, 160)],
)
def test_worst_case(length, extended, bits):
    assert worst_bits(length, extended=extended) == bits


def test_worst_case_stuffing_is_reached_by_a_bit_pattern():
    # The bound assumes 00000 1111 0000 1111 ...; stuffing of that pattern gives one bit in four.
    pattern = "00000" + "11110000" * 11 + "1111"
    sent = ""
    for bit in pattern:
        sent += bit
        if sent.endswith(("00000", "11111")):
            sent += "1" if bit == "0" else "0"
    assert len(sent) - len(pattern) == (len(pattern) - 1) // 4


@pytest.mark.parametrize(
    ("lengths", "bitrate", "bits", "most", "at_60_percent"),
    [
        (SYNC_AND_THREE_PDOS, 1_000_000, 2005, 499, 299),
        (SYNC_AND_THREE_PDOS, 500_000, 2005, 249, 150),
        ([0] + [6, 8] * 6, 1_000_000, 1555, 643, 386),
        ([0] + [6, 6] * 6, 1_000_000, 1435, 697, 418),
        ([0] + [4, 4] * 6, 1_000_000, 1195, 837, 502),
    ],
)
def test_six_axes(lengths, bitrate, bits, most, at_60_percent):
    load = cycle_load(lengths, 250.0, bitrate)
    assert load.cycle_bits == bits
    assert round(load.max_rate_hz) == most
    assert round(load.rate_at(0.6)) == at_60_percent
    assert load.share == pytest.approx(bits * 250 / bitrate)


def test_background_takes_its_share():
    heartbeats = [(1, 7 / 0.02)]
    load = cycle_load(SYNC_AND_THREE_PDOS, 250.0, 1_000_000, heartbeats)
    assert load.background == 350 * 65
    assert load.share == pytest.approx((2005 * 250 + 350 * 65) / 1e6)
    assert cycle_load(SYNC_AND_THREE_PDOS, load.rate_at(0.7), 1_000_000, heartbeats).share == pytest.approx(0.7)


def test_refusal_says_value_limit_and_what_fits():
    load = cycle_load(SYNC_AND_THREE_PDOS, 400.0, 1_000_000)
    text = refusal(load, 0.7)
    assert text is not None
    for part in ("80.2%", "70.0%", "2005 bits", "400 Hz", "rate_hz up to 349 fits"):
        assert part in text
    assert refusal(cycle_load(SYNC_AND_THREE_PDOS, 349.0, 1_000_000), 0.7) is None
    assert refusal(cycle_load(SYNC_AND_THREE_PDOS, 350.0, 1_000_000), 0.7) is not None


def test_refusal_where_nothing_fits():
    text = refusal(cycle_load([0, 8], 10.0, 10_000, [(8, 100.0)]), 0.7)
    assert text is not None
    assert "no cycle rate fits" in text
