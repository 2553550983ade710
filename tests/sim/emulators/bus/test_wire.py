"""Arbitration and bit times of the emulated bus, against bit strings written out by hand."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.emulators.bus.bus_emulator import MASTER, QUEUE_LIMIT, Wire, arbitration_key
from stereoservo_sim.emulators.nodes.node import NEVER_NS

standard = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8), st.just(False), st.just(False), st.just(0))
frames = st.one_of(
    standard,
    st.builds(CanFrame, st.integers(0, 0x7FF), st.just(b""), st.just(True), st.just(False), st.integers(0, 8)),
    st.builds(CanFrame, st.integers(0, 2**29 - 1), st.binary(max_size=8), st.just(False), st.just(True)),
    st.builds(CanFrame, st.integers(0, 2**29 - 1), st.just(b""), st.just(True), st.just(True)),
)


def arbitration_bits(frame):
    """The field as sent: base id, RTR or SRR, IDE, and of extended frames 18 bits and RTR. 0 is dominant."""
    if frame.extended:
        bits = f"{frame.id:029b}"
        return f"{bits[:11]}11{bits[11:]}{int(frame.remote)}"
    return f"{frame.id:011b}{int(frame.remote)}0"


@given(frames, frames)
def test_the_frame_with_the_first_dominant_bit_wins(one, other):
    a, b = arbitration_bits(one), arbitration_bits(other)
    differs = next((k for k in range(min(len(a), len(b))) if a[k] != b[k]), None)
    if differs is None:
        assert arbitration_key(one) == arbitration_key(other)
    else:
        assert (arbitration_key(one) < arbitration_key(other)) == (a[differs] == "0")


def stuffed_length(bits):
    """Bits with a complement after every five equal ones, its own included in the count."""
    sent = ""
    for bit in bits:
        sent += bit
        if len(sent) >= 5 and len(set(sent[-5:])) == 1:
            sent += "1" if bit == "0" else "0"
    return len(sent)


def bits_by_hand(frame):
    """A standard data frame with its intermission, CRC by long division."""
    data = "".join(f"{byte:08b}" for byte in frame.data)
    head = f"0{frame.id:011b}000{len(frame.data):04b}{data}"
    register = [int(bit) for bit in head] + [0] * 15
    for k in range(len(head)):
        if register[k]:
            for j, bit in enumerate("1100010110011001"):
                register[k + j] ^= int(bit)
    return stuffed_length(head + "".join(map(str, register[-15:]))) + 13


@given(standard)
def test_a_frame_occupies_its_stuffed_bits(frame):
    assert Wire(500_000).duration_ns(frame) == bits_by_hand(frame) * 2000
    assert Wire(None).duration_ns(frame) == 0


def test_the_shortest_and_the_longest_frame_of_eight_bytes():
    """111 bits without a stuff bit, at most 135: the bus's 9009 and 7407 frames/s."""
    rng = np.random.default_rng(1)
    wire = Wire(1_000_000)
    for data in (rng.bytes(8) for _ in range(200)):
        assert 111_000 <= wire.duration_ns(CanFrame(int(rng.integers(0x800)), data)) <= 135_000


def drain(wire):
    """Senders and frames in the order in which they end, and when."""
    t, ended = 0, []
    wire.start(t)
    while wire.end_ns != NEVER_NS:
        t = wire.end_ns
        ended.append((t, *wire.finish()))
        wire.start(t)
    return ended


@given(st.lists(st.tuples(st.integers(0, 3), frames), max_size=30))
def test_lowest_id_first_but_every_sender_in_its_order(queued):
    wire = Wire(1_000_000)
    for sender, frame in queued:
        wire.send(sender, frame)
    ended = drain(wire)
    assert len(ended) == len(queued) == wire.frames
    waiting = {s: [f for sender, f in queued if sender == s] for s in range(4)}
    t = 0
    for when, sender, frame in ended:
        heads = [bits for fs in waiting.values() if fs for bits in [arbitration_bits(fs[0])]]
        assert arbitration_bits(frame) == min(heads)
        assert waiting[sender].pop(0) == frame
        t += wire.duration_ns(frame)
        assert when == t
    assert wire.busy_ns == t


def test_a_frame_on_the_wire_is_not_interrupted():
    wire = Wire(1_000_000)
    wire.send(MASTER, CanFrame(0x700, b"\x05"))
    wire.start(0)
    wire.send(1, CanFrame(0x001))
    wire.start(10)
    assert wire.finish() == (MASTER, CanFrame(0x700, b"\x05"))


def test_a_full_transmit_buffer_loses_frames():
    wire = Wire(None)
    for _ in range(QUEUE_LIMIT + 3):
        wire.send(2, CanFrame(1))
    assert (wire.waiting(2), wire.lost) == (QUEUE_LIMIT, 3)
    assert len(drain(wire)) == QUEUE_LIMIT


@pytest.mark.parametrize("pair", list(itertools.combinations(range(3), 2)))
def test_of_frames_that_begin_alike_data_goes_before_remote_before_extended(pair):
    ranked = [CanFrame(0x123, b"x"), CanFrame(0x123, remote=True), CanFrame(0x123 << 18, extended=True)]
    wire = Wire(None)
    for k in reversed(pair):
        wire.send(k, ranked[k])
    assert [sender for _, sender, _ in drain(wire)] == list(pair)
