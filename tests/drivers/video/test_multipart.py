"""The multipart parser: the same parts however the bytes come in pieces, and what is wrong with a stream."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo_drivers.video.mjpeg import ChunkedDecoder, MultipartError, MultipartParser

BODIES = st.lists(st.binary(max_size=40).filter(lambda b: b"\n--edge" not in b), min_size=1, max_size=5)


def written(bodies, *, length, dashes="--", newline=b"\r\n"):
    out = b"preamble" + newline
    for body in bodies:
        out += dashes.encode() + b"edge" + newline + b"Content-Type: image/jpeg" + newline
        if length:
            out += b"Content-Length: %d" % len(body) + newline
        out += newline + body + newline
    return out + dashes.encode() + b"edge" + newline


def fed(parser, data, cuts):
    parts = []
    edges = [0, *sorted({min(cut, len(data)) for cut in cuts}), len(data)]
    for t_ns, (a, b) in enumerate(pairwise(edges)):
        parts += parser.feed(data[a:b], t_ns)
    return parts


@settings(max_examples=60)
@given(BODIES, st.booleans(), st.lists(st.integers(0, 400)))
def test_parts_come_out_whole_however_they_come_in(bodies, length, cuts):
    parts = fed(MultipartParser("edge"), written(bodies, length=length), cuts)
    assert [part.body for part in parts] == bodies
    assert not any(part.cut for part in parts)
    assert all(part.headers["content-type"] == "image/jpeg" for part in parts)


@pytest.mark.parametrize("told", ["edge", "--edge"])
@pytest.mark.parametrize("dashes", ["--", "----"])
@pytest.mark.parametrize("newline", [b"\r\n", b"\n"])
def test_the_ways_in_which_servers_write_boundaries(told, dashes, newline):
    data = written([b"one", b"two"], length=True, dashes=dashes, newline=newline)
    assert [part.body for part in fed(MultipartParser(told), data, [])] == [b"one", b"two"]


def test_a_part_is_stamped_when_its_first_byte_arrives_not_with_the_boundary_before():
    parser = MultipartParser("edge")
    assert parser.feed(b"--edge\r\n", 10) == []
    assert parser.feed(b"Content-Length: 3\r\n\r\na", 20) == []
    (part,) = parser.feed(b"bc\r\n--edge\r\n", 30)
    assert (part.t_ns, part.body) == (20, b"abc")
    (part,) = parser.feed(b"Content-Length: 1\r\n\r\nx", 40)
    assert (part.t_ns, part.body) == (40, b"x")


def test_a_part_shorter_than_it_says_is_cut_and_the_next_one_whole():
    data = b"--edge\r\nContent-Length: 500\r\n\r\nhalf\r\n--edge\r\nContent-Length: 5\r\n\r\nwhole\r\n--edge\r\n"
    cut, whole = MultipartParser("edge").feed(data, 0)
    assert cut.cut
    assert (whole.body, whole.cut) == (b"whole", False)


def test_a_part_longer_than_it_says_does_not_take_the_next_one_along():
    data = b"--edge\r\nContent-Length: 2\r\n\r\nlonger\r\n--edge\r\nContent-Length: 2\r\n\r\nab"
    first, second = MultipartParser("edge").feed(data, 0)
    assert (first.body, second.body) == (b"lo", b"ab")


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"--edge\r\nContent-Length: 1001\r\n\r\n", "frame_too_large"),
        (b"--edge\r\n\r\n" + b"x" * 1100, "frame_too_large"),
        (b"x" * 1100, "not_mjpeg"),
        (b"--edge\r\nA: " + b"x" * 20000, "not_mjpeg"),
        (b"--edge" + b"x" * 20000, "not_mjpeg"),
    ],
)
def test_what_has_no_end_is_refused(data, code):
    with pytest.raises(MultipartError) as caught:
        fed(MultipartParser("edge", largest=1000), data, range(0, len(data), 100))
    assert caught.value.code == code


@given(st.binary(max_size=300))
def test_any_bytes_are_taken_or_refused(data):
    parser = MultipartParser("edge", largest=200)
    try:
        parts = fed(parser, b"--edge\r\n" + data, range(0, 300, 7))
    except MultipartError as error:
        found = error.code
    else:
        found = "taken" if sum(len(part.body) for part in parts) <= len(data) else "made up"
    assert found in ("taken", "frame_too_large", "not_mjpeg")


@settings(max_examples=60)
@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=5), st.lists(st.integers(0, 400)))
def test_a_chunked_body_comes_out_whole_however_it_comes_in(bodies, cuts):
    chunks = [b'%x ; a="b"\r\n%b\r\n' % (len(body), body) for body in bodies]
    data = b"".join(chunks) + b"0\r\nTrailer: x\r\n\r\n"
    decoder = ChunkedDecoder()
    edges = [0, *sorted({min(cut, len(data)) for cut in cuts}), len(data)]
    assert b"".join(decoder.feed(data[a:b]) for a, b in pairwise(edges)) == b"".join(bodies)
    assert decoder.ended
    whole = ChunkedDecoder()
    assert b"".join(whole.feed(chunk[:-2]) for chunk in chunks[:1]) == bodies[0]  # its line end is not waited for


@pytest.mark.parametrize("data", [b"x\r\n", b"\r\n", b"-1\r\n", b"1\r\nabc\r\n", b"1" * 5000, b"f" * 17 + b"\r\n"])
def test_what_is_no_chunk_is_told(data):
    with pytest.raises(MultipartError) as caught:
        ChunkedDecoder().feed(data)
    assert caught.value.code == "http"
