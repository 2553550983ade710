"""Bodies and heads of MJPEG streams as servers send them: the same pictures however the bytes come in pieces."""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.video.mjpeg import ChunkedDecoder, MjpegSource, PictureParser, StreamError
from stereoservo_drivers.video.options import decode_video_options

from .conftest import HEIGHT, WIDTH, jpeg, picture

COUNT = 12
HEAD = b"HTTP/1.1 200 OK\r\n"
MIXED = HEAD + b"Content-Type: multipart/x-mixed-replace; boundary="


def encoded(number: int, *settings: int) -> bytes:
    return cv2.imencode(".jpg", picture(number), settings)[1].tobytes()


def with_thumbnail(number: int) -> bytes:
    """A picture with a smaller one in its EXIF segment, as cameras with a preview write it."""
    data = jpeg(picture(number))
    segment = b"Exif\0\0II*\0\x08\0\0\0\0\0\0\0\0\0" + jpeg(np.full((12, 16), number, np.uint8))
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:]


def with_comment(number: int) -> bytes:
    """A picture whose comment contains markers, and which has fill bytes before a marker."""
    data = jpeg(picture(number))
    return data[:2] + b"\xff\xfe\x00\x0a\xff\xd8\xff\xda\xff\xd9\xff\xd9" + b"\xff\xff" + data[2:]


PICTURES = {
    "plain": [jpeg(picture(k)) for k in range(COUNT)],
    "colour": [jpeg(cv2.merge([picture(k)] * 3)) for k in range(COUNT)],
    "restarts": [encoded(k, cv2.IMWRITE_JPEG_RST_INTERVAL, 2) for k in range(COUNT)],
    "progressive": [encoded(k, cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_OPTIMIZE, 1) for k in range(COUNT)],
    "thumbnail": [with_thumbnail(k) for k in range(COUNT)],
    "comment": [with_comment(k) for k in range(COUNT)],
    "png": [cv2.imencode(".png", picture(k))[1].tobytes() for k in range(COUNT)],
    "png of 16 bits": [cv2.imencode(".png", picture(k).astype(np.uint16) << 4)[1].tobytes() for k in range(COUNT)],
}


def parts(template: str, kind: str = "plain", says=len, eol: str = "\r\n", after: bytes = b"") -> bytes:
    """Pictures, each after ``template`` with its length and number, with these line ends, and followed by ``after``."""
    return b"".join(
        template.format(length=says(data), number=number, stamp=1e9 + number).replace("\n", eol).encode() + data + after
        for number, data in enumerate(PICTURES[kind])
    )


def chunked(body: bytes, size: int) -> bytes:
    """In HTTP's chunked coding, in chunks of ``size``."""
    chunks = [body[at : at + size] for at in range(0, len(body), size)]
    return b"".join(b"%x\r\n%b\r\n" % (len(chunk), chunk) for chunk in [*chunks, b""])


EDGE = "--frame\nContent-Type: image/jpeg\nContent-Length: {length}\n\n"
BARE = "--frame\nContent-Type: image/jpeg\n\n"
END = b"\r\n"
TEXT = "--frame\nContent-Type: text/plain\nContent-Length: 20\n\ntemperature: 41.5 deg\n"
STREAMS = {
    "ESP32-CAM": (MIXED + b"123456789000000000000987654321\r\nX-Framerate: 60\r\n\r\n",
        parts("\n--123456789000000000000987654321\nContent-Type: image/jpeg\nContent-Length: {length}\n"
              "X-Timestamp: {stamp:.6f}\n\n", "colour")),
    "ESP32-CAM of 2019": (MIXED + b"frame\r\n\r\n",
        parts("Content-Type: image/jpeg\nContent-Length: {length}\n\n", after=b"\r\n--frame\r\n")),
    "ESP32, Arduino's WebServer": (HEAD + b"Content-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n",
        parts("--frame\nContent-Type: image/jpeg\n\n", after=END)),
    "mjpg-streamer": (b"HTTP/1.0 200 OK\r\nConnection: close\r\nServer: MJPG-Streamer/0.2\r\nExpires: 0\r\n"
        b"Content-Type: multipart/x-mixed-replace;boundary=boundarydonotcross\r\n\r\n--boundarydonotcross\r\n",
        parts("Content-Type: image/jpeg\nContent-Length: {length}\nX-Timestamp: {stamp:.6f}\n\n",
              after=b"\r\n--boundarydonotcross\r\n")),
    "motion": (MIXED + b"BoundaryString\r\nCache-Control: private\r\n\r\n",
        parts("--BoundaryString\nContent-type: image/jpeg\nContent-Length: {length:>9}\n\n", after=END)),
    "motion with EXIF": (MIXED + b"BoundaryString\r\n\r\n",
        parts("--BoundaryString\nContent-type: image/jpeg\nContent-Length: {length:>9}\n\n", "thumbnail", after=END)),
    "ustreamer": (HEAD + b'Content-Type: multipart/x-mixed-replace;boundary="boundarydonotcross"\r\n\r\n'
        b"--boundarydonotcross\r\n",
        parts("Content-Type: image/jpeg\nContent-Length: {length}\nX-Timestamp: {stamp:.6f}\n\n",
              after=b"\r\n--boundarydonotcross\r\n")),
    "ustreamer, heads in advance": (MIXED + b"boundarydonotcross\r\n\r\n--boundarydonotcross\r\n",
        parts("Content-Type: image/jpeg\nX-Timestamp: {stamp:.6f}\n\n", after=b"\r\n--boundarydonotcross\r\n")),
    "go2rtc": (MIXED + b"frame\r\nTransfer-Encoding: chunked\r\n\r\n",
        chunked(parts(EDGE, after=END), len(parts(EDGE, after=END)) // COUNT)),
    "OctoPrint (a proxy of mjpg-streamer)": (b"HTTP/1.1 200 OK\r\nServer: nginx\r\nContent-Type: "
        b"multipart/x-mixed-replace;boundary=boundarydonotcross\r\nTransfer-Encoding: chunked\r\n\r\n",
        chunked(b"--boundarydonotcross\r\n" + parts("Content-Type: image/jpeg\nContent-Length: {length}\n\n",
                                                    after=b"\r\n--boundarydonotcross\r\n"), 1000)),
    "ffmpeg mpjpeg": (MIXED + b"ffmpeg\r\n\r\n", b"--ffmpeg\r\n" + parts(
        "Content-type: image/jpeg\nContent-length: {length}\n\n", after=b"\r\n--ffmpeg\r\n")),
    "ffmpeg -listen": (HEAD + b"Content-Type: application/octet-stream\r\n\r\n", b"--ffmpeg\r\n" + parts(
        "Content-type: image/jpeg\nContent-length: {length}\n\n", after=b"\r\n--ffmpeg\r\n")),
    "ffmpeg -f mjpeg: no parts": (HEAD + b"Content-Type: application/octet-stream\r\n\r\n", parts("")),
    "no parts, thumbnails": (HEAD + b"Content-Type: video/x-motion-jpeg\r\n\r\n", parts("", "thumbnail")),
    "cpp-mjpeg-streamer": (HEAD + b"Connection: close\r\nMax-Age: 0\r\nExpires: 0\r\nContent-Type: "
        b"multipart/x-mixed-replace; boundary=nadjiebmjpegstreamer\r\n\r\n",
        parts("--nadjiebmjpegstreamer\nContent-Type: image/jpeg\nContent-Length: {length}\n\n")),
    "boundary without dashes": (MIXED + b"frame\r\n\r\n", parts(EDGE.replace("--frame", "frame"), after=END)),
    "another boundary than it says": (MIXED + b"edge\r\n\r\n", parts(EDGE, after=END)),
    "dashes in the head too": (MIXED + b"--frame\r\n\r\n", parts(EDGE, after=END)),
    "no boundary said": (HEAD + b"Content-Type: multipart/x-mixed-replace\r\n\r\n", parts(BARE, after=END)),
    "no Content-Type": (HEAD + b"\r\n", parts(EDGE, after=END)),
    "the head says text/html": (HEAD + b"Content-Type: text/html\r\n\r\n", parts(EDGE, after=END)),
    "the head says image/jpeg": (HEAD + b"Content-Type: image/jpeg\r\n\r\n", parts("", after=END)),
    "the head says Content-Length: 0": (HEAD + b"Content-Length: 0\r\n\r\n", parts(EDGE)),
    "bare LF": (MIXED.replace(b"\r", b"") + b"frame\n\n", parts(EDGE, eol="\n", after=b"\n")),
    "bare CR in parts": (MIXED + b"frame\r\n\r\n", parts(EDGE, eol="\r", after=b"\r")),
    "no empty line behind the part's headers": (MIXED + b"frame\r\n\r\n", parts(EDGE.replace("\n\n", "\n"))),
    "no part headers": (MIXED + b"frame\r\n\r\n", parts("--frame\n\n", after=END)),
    "nothing but boundaries": (MIXED + b"frame\r\n\r\n", parts("--frame\n")),
    "text parts": (MIXED + b"frame\r\n\r\n", parts(TEXT + EDGE, after=END)),
    "lengths too long": (MIXED + b"frame\r\n\r\n", parts(EDGE, says=lambda data: len(data) + 100, after=END)),
    "lengths too short": (MIXED + b"frame\r\n\r\n", parts(EDGE, says=lambda data: len(data) // 2, after=END)),
    "lengths of the part with its head": (MIXED + b"f\r\n\r\n", parts(EDGE, says=lambda data: len(data) + 60)),
    "lengths of another picture": (MIXED + b"f\r\n\r\n", parts(EDGE, "thumbnail", says=lambda _: 4000, after=END)),
    "lengths of no sense": (MIXED + b"f\r\n\r\n", parts(EDGE, "restarts", says=lambda _: "-1", after=END)),
    "lengths beyond all bounds": (MIXED + b"f\r\n\r\n", parts(EDGE, says=lambda _: 10**15, after=END)),
    "padded pictures": (MIXED + b"f\r\n\r\n", parts(EDGE, says=lambda data: len(data) + 8, after=bytes(8) + END)),
    "progressive": (MIXED + b"f\r\n\r\n", parts(BARE, "progressive", after=END)),
    "markers in comments": (MIXED + b"f\r\n\r\n", parts(BARE, "comment", after=END)),
    "PNG": (MIXED + b"frame\r\n\r\n", parts(EDGE.replace("jpeg", "png"), "png", after=END)),
    "PNG, lengths too short": (MIXED + b"frame\r\n\r\n",
        parts(EDGE, "png of 16 bits", says=lambda data: len(data) // 2, after=END)),
    "ffmpeg -f image2pipe: PNG, no parts": (HEAD + b"Content-Type: application/octet-stream\r\n\r\n", parts("", "png")),
    "ICY": (b"ICY 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n", parts(EDGE, after=END)),
    "no version, no reason": (b"HTTP 200\r\nContent-Type: image/jpeg\r\n\r\n", parts(EDGE, after=END)),
    "a line without a colon": (HEAD + b"Camera 7\r\nTransfer-Encoding: chunked\r\n\r\n",
        chunked(parts(EDGE), 5000)),
}  # fmt: skip
KINDS = {
    "ESP32-CAM": "colour", "motion with EXIF": "thumbnail", "no parts, thumbnails": "thumbnail",
    "lengths of another picture": "thumbnail", "lengths of no sense": "restarts", "progressive": "progressive",
    "markers in comments": "comment", "PNG": "png", "PNG, lengths too short": "png of 16 bits",
    "ffmpeg -f image2pipe: PNG, no parts": "png",
}  # fmt: skip


def fed(parser, data, cuts):
    """Pictures out of ``data`` in pieces that end at ``cuts``; a piece's time is its number."""
    found = []
    edges = [0, *sorted({min(cut, len(data)) for cut in cuts}), len(data)]
    for t_ns, (a, b) in enumerate(pairwise(edges)):
        found += parser.feed(data[a:b], t_ns)
    return found


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("piece", [1, 50, 1448, 10**6])
def test_every_picture_of_a_servers_body_is_found(name, piece):
    """Byte by byte, in pieces of random lengths, and at once."""
    head, body = STREAMS[name]
    if b"Transfer-Encoding: chunked" in head:
        body = ChunkedDecoder().feed(body)
    pieces = np.random.default_rng(piece).integers(1, 2 * piece, len(body) // piece + 1)
    found = fed(PictureParser(), body, np.cumsum(pieces))
    assert [part.body for part in found] == PICTURES[KINDS.get(name, "plain")]
    assert not any(part.cut for part in found)


def test_there_are_as_many_streams_as_asked():
    assert len(STREAMS) >= 30


def test_every_head_is_accepted_and_its_pictures_decoded():
    """One server on a loopback socket that answers each request with the next stream."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            for head, body in STREAMS.values():
                connection = listener.accept()[0]
                with connection, suppress(OSError):
                    connection.recv(4096)
                    connection.sendall(head + body)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
        options, place = decode_video_options({"source": url, "width": WIDTH, "height": HEIGHT}, Path())
        counts = {name: pictures_of(MjpegSource(place, options, MonotonicClock())) for name in STREAMS}
        thread.join(10.0)
    assert counts == dict.fromkeys(STREAMS, (COUNT, "connection_lost"))


def pictures_of(source):
    """Number of pictures until the stream ends, with those that newer ones replaced; and the code of its end."""
    count = 0
    try:
        source.open()
        while True:
            found = source.read()
            assert found is not None, "a whole picture counted as damaged"
            count += 1 + found.skipped
    except DriverError as error:
        return count, error.code
    finally:
        source.release()


def test_a_picture_is_stamped_when_its_first_byte_arrives_not_with_the_boundary_before():
    data = jpeg(picture(1))
    parser = PictureParser()
    assert parser.feed(b"--edge\r\n", 10) == []
    assert parser.feed(b"X-Sequence: 7\r\n\r\n" + data[:1], 20) == []
    assert parser.feed(data[1:-1], 30) == []
    (part,) = parser.feed(data[-1:], 40)
    assert (part.t_ns, part.headers, part.body) == (20, {"x-sequence": "7"}, data)
    (part,) = parser.feed(b"\r\n--edge\r\n\r\n" + data, 50)
    assert (part.t_ns, part.headers) == (50, {})


@pytest.mark.parametrize("piece", [1, 100, 10**6])
@pytest.mark.parametrize("kind", PICTURES)
def test_a_cut_picture_is_told_as_cut_and_the_next_one_is_whole(kind, piece):
    """Cut anywhere, in a segment too; the next picture keeps its own stamp and headers."""
    first, second, *_ = PICTURES[kind]
    for at in np.random.default_rng(1).integers(3, len(first) - 1, 20):
        head = b"\r\n--edge\r\nContent-Type: image/jpeg\r\nX-Sequence: %d\r\nContent-Length: %d\r\n\r\n"
        data = head % (1, len(first)) + first[:at] + head % (2, len(second)) + second
        cut, whole = fed(PictureParser(), data, range(piece, len(data), piece))
        assert (cut.cut, whole.cut) == (True, False)
        assert whole.body == second
        assert whole.headers["x-sequence"] == "2"
        begin = len(data) - len(second)
        assert abs(whole.t_ns - begin // piece) <= max(1, 7 // piece)  # PNG is known by its first eight bytes


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"--edge\r\n\r\n\xff\xd8\xff\xdb" + b"x" * 1100, "frame_too_large"),
        (b"--edge\r\nContent-Length: 2000\r\n\r\n\xff\xd8\xff\xdb" + b"x" * 1100, "frame_too_large"),
        (b"x" * (1 << 20) + b"y", "not_mjpeg"),
        (b"--edge\r\n\r\n<html>" * (1 << 16), "not_mjpeg"),
    ],
)
def test_what_has_no_end_is_refused(data, code):
    with pytest.raises(StreamError) as caught:
        fed(PictureParser(largest=1000), data, range(0, len(data), 100))
    assert caught.value.code == code


@given(st.binary(max_size=300), st.lists(st.integers(0, 400)))
def test_any_bytes_are_taken_and_none_made_up(data, cuts):
    data = b"\xff\xd8\xff" + data
    found = fed(PictureParser(), data, cuts)
    assert all(part.body in data for part in found)
    assert sum(len(part.body) for part in found) <= len(data)


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
    with pytest.raises(StreamError) as caught:
        ChunkedDecoder().feed(data)
    assert caught.value.code == "http"
