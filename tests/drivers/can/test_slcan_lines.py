"""Lawicel lines both ways, in pieces of any size, and the adapter's answers."""

import itertools

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.can.frames import CanFrame, from_message, to_message
from stereoservo_drivers.can.slcan_adapter import SlcanAdapter
from stereoservo_drivers.can.slcan_lines import (
    BEL,
    LineError,
    LineSplitter,
    bitrate_command,
    decode_frame,
    encode_frame,
    flags_in_words,
)


def in_pieces(stream: bytes, cuts: list[int]) -> list[bytes]:
    places = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return [stream[a:b] for a, b in itertools.pairwise(places)]


@pytest.mark.parametrize(
    ("frame", "line"),
    [
        (CanFrame(0x80), b"t0800\r"),
        (CanFrame(0x201, b"\x0f\x00\xff\xee\xdd\xcc"), b"t20160F00FFEEDDCC\r"),
        (CanFrame(0x7FF, b"\x01"), b"t7FF101\r"),
        (CanFrame(0x12ABCDEF, b"\x10\x20", extended=True), b"T12ABCDEF21020\r"),
        (CanFrame(0x181, remote=True, length=8), b"r1818\r"),
        (CanFrame(0x1FFFFFFF, remote=True, extended=True), b"R1FFFFFFF0\r"),
    ],
)
def test_lines_of_the_manual(frame, line):
    assert encode_frame(frame) == line
    assert decode_frame(line[:-1]) == frame
    assert decode_frame(line[:1] + line[1:-1].lower()) == frame
    assert decode_frame(line[:-1] + b"EA5F") == frame  # with a time stamp [ms]
    assert decode_frame(line[:-1] + b"0001F2E0") == frame  # [us]


@given(data=st.data())
def test_any_frames_in_any_pieces(data, any_frame):
    frames = data.draw(st.lists(any_frame, max_size=20))
    stream = b"".join(encode_frame(frame) for frame in frames)
    splitter = LineSplitter()
    got = [
        decode_frame(line)
        for piece in in_pieces(stream, data.draw(st.lists(st.integers(0, 10**6), max_size=8)))
        for line in splitter.feed(piece)
    ]
    assert got == frames


@given(data=st.data())
def test_answers_and_bells_in_any_pieces(data, any_frame):
    line = encode_frame(data.draw(any_frame))
    parts = data.draw(st.lists(st.sampled_from([b"\r", b"z\r", b"\a", line]), max_size=20))
    expected = [BEL if part == BEL else part[:-1] for part in parts]
    splitter = LineSplitter()
    pieces = in_pieces(b"".join(parts), data.draw(st.lists(st.integers(0, 10**6), max_size=8)))
    assert [got for piece in pieces for got in splitter.feed(piece)] == expected


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
@pytest.mark.parametrize("stamp", [b"", b"1F2E", b"0001F2E0"])
def test_other_line_ends_and_stamps_in_any_pieces(end, stamp):
    frames = [CanFrame(0x181, b"\xaa\xbb"), CanFrame(0x182), CanFrame(0x12ABCDEF, b"\x10", extended=True)]
    lines = [encode_frame(frame)[:-1] + stamp for frame in frames]
    stream = b"".join((lines[0], end, end, b"z", end, BEL, lines[1], end, BEL, lines[2], end, b"V1013", end, end))
    expected = [lines[0], b"", b"z", BEL, lines[1], BEL, lines[2], b"V1013", b""]
    assert [decode_frame(line) for line in lines] == frames
    for cuts in [(a, b) for a in range(len(stream) + 1) for b in range(a, len(stream) + 1)]:
        splitter = LineSplitter()
        assert [line for piece in in_pieces(stream, [*cuts]) for line in splitter.feed(piece)] == expected
    splitter = LineSplitter()
    assert [line for byte in stream for line in splitter.feed(bytes([byte])) + splitter.feed(b"")] == expected


def test_mixed_line_ends():
    for cut in range(12):
        splitter = LineSplitter()
        lines = splitter.feed(b"t0800\r\n\n\r\r\n"[:cut]) + splitter.feed(b"t0800\r\n\n\r\r\n"[cut:])
        assert lines == [b"t0800", b"", b"", b""]


@given(data=st.data())
def test_the_same_as_python_can_sends_and_reads(data, any_frame):
    frame = data.draw(any_frame)
    message = to_message(frame)
    assert from_message(message) == frame
    assert message.dlc == (frame.length if frame.remote else len(frame.data))


def test_messages_that_are_no_classical_frames():
    with pytest.raises(ValueError, match="error frame"):
        from_message(can.Message(arbitration_id=0x40, is_error_frame=True))
    with pytest.raises(ValueError, match="CAN FD"):
        from_message(can.Message(arbitration_id=1, is_fd=True, data=bytes(12)))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"", "begins with"),
        (b"x1230", "begins with"),
        (b"t12", "at least 5"),
        (b"t1239", "data length b'9'"),
        (b"t123z", "data length b'z'"),
        (b"t1232AA", "with length 2: 9"),
        (b"t1231AABB0", "with length 1: 7, or 11 or 15"),
        (b"t1231GG", "hexadecimal"),
        (b"t+1F0", "hexadecimal"),
        (b"t1 30", "hexadecimal"),
        (b"t8000", "beyond 11 bits"),
        (b"T200000000", "beyond 29 bits"),
        (b"T123", "at least 10"),
        (b"t1230zzzz", "hexadecimal"),
    ],
)
def test_malformed_lines_are_named(line, reason):
    with pytest.raises(LineError) as caught:
        decode_frame(line)
    assert caught.value.line == line
    assert reason in caught.value.reason
    assert reason in str(caught.value)


@given(line=st.binary(max_size=40))
def test_any_bytes_are_a_frame_or_refused(line):
    try:
        frame = decode_frame(line)
    except LineError:
        return
    assert encode_frame(frame)[:-1].lower() in (line.lower(), line[:-4].lower(), line[:-8].lower())


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (CanFrame(0x800), "0x7FF"),
        (CanFrame(-1), "0x7FF"),
        (CanFrame(2**29, extended=True), "0x1FFFFFFF"),
        (CanFrame(1, bytes(9)), "9 data bytes"),
        (CanFrame(1, b"\x01", remote=True), "remote frame with 1"),
        (CanFrame(1, remote=True, length=9), "9 data bytes"),
    ],
)
def test_frames_that_no_line_can_carry(frame, reason):
    with pytest.raises(ValueError, match=reason):
        encode_frame(frame)


def test_noise_without_ends_does_not_pile_up():
    splitter = LineSplitter()
    lines = [line for _ in range(1000) for line in splitter.feed(b"\xff" * 50)]
    assert sum(map(len, lines)) >= 1000 * 50 - 64
    assert splitter.feed(b"\rt0800\r")[-1] == b"t0800"


def test_bitrates():
    assert bitrate_command(1_000_000) == "S8"
    assert bitrate_command(125_000) == "S4"
    with pytest.raises(ValueError, match=r"666 bit/s .* valid: 10000, .*, 1000000"):
        bitrate_command(666)


def test_flags():
    assert flags_in_words(0) == "no error"
    assert flags_in_words(0x82) == "transmit buffer full, bus error"


class TestAdapter:
    def opened(self) -> SlcanAdapter:
        adapter = SlcanAdapter()
        assert adapter.feed(b"S8\rO\r") == ([], b"\r\r")
        return adapter

    def test_set_up_open_send_deliver_close(self):
        adapter = self.opened()
        assert adapter.bitrate == 1_000_000
        frames, answer = adapter.feed(b"t0800\rT000000051AA\rr1814\r")
        expected = [CanFrame(0x80), CanFrame(5, b"\xaa", extended=True)]
        assert frames == [*expected, CanFrame(0x181, remote=True, length=4)]
        assert answer == b"z\rZ\rz\r"
        assert adapter.deliver(frames) == b"t0800\rT000000051AA\rr1814\r"
        assert adapter.feed(b"C\r") == ([], b"\r")
        assert adapter.deliver(frames) == b""

    @pytest.mark.parametrize("line", [b"t0800\r", b"C\r", b"F\r", b"S9\r", b"Q\r", b"s12\r", b"szzzz\r", b"t08\r"])
    def test_closed_refuses(self, line):
        assert SlcanAdapter().feed(line) == ([], BEL)

    @pytest.mark.parametrize("line", [b"O\r", b"L\r", b"S8\r", b"s0014\r", b"Z1\r"])
    def test_open_refuses(self, line):
        assert self.opened().feed(line) == ([], BEL)

    def test_registers_version_serial_flags(self):
        adapter = SlcanAdapter()
        assert adapter.feed(b"s031C\rV\rN\r\r") == ([], b"\rV1013\rNSERV\r\r")
        assert (adapter.bitrate, adapter.registers) == (None, (0x03, 0x1C))
        adapter.feed(b"O\r")
        adapter.flags = 0x82
        assert adapter.feed(b"F\rF\r") == ([], b"F82\rF00\r")

    def test_listening_does_not_send(self):
        adapter = SlcanAdapter()
        adapter.feed(b"S6\rL\r")
        assert adapter.feed(b"t0800\r") == ([], BEL)
        assert adapter.deliver([CanFrame(1)]) == b"t0010\r"

    def test_stamps(self):
        adapter = SlcanAdapter()
        adapter.feed(b"S8\rZ1\rO\r")
        assert adapter.deliver([CanFrame(1)], 0x1234 * 1_000_000) == b"t00101234\r"

    def test_malformed_is_counted_and_what_follows_goes_on(self):
        adapter = self.opened()
        assert adapter.feed(b"t1239\rt0800\r") == ([CanFrame(0x80)], BEL + b"z\r")
        assert adapter.malformed == 1
