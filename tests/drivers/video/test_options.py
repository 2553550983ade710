"""Options of the video driver: what is wrong is said before anything is opened."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.video.options import decode_video_options, frozen_frames

SIZE = {"width": 640, "height": 480}
CELL = Path("/cells/one")


def decode(**options):
    return decode_video_options({**SIZE, **options}, CELL)


@pytest.mark.parametrize(
    ("source", "kind", "shown"),
    [
        (0, "device", "/dev/video0"),
        ("/dev/video12", "device", "/dev/video12"),
        ("/dev/v4l/by-id/usb-x", "device", "/dev/v4l/by-id/usb-x"),
        ("left.avi", "file", "/cells/one/left.avi"),
        ("/data/left.MKV", "file", "/data/left.MKV"),
        ("shots/p%04d.png", "sequence", "/cells/one/shots/p%04d.png"),
        ("http://cam:8080/s?x=1", "http", "http://cam:8080/s?x=1"),
        ("https://cam/s", "http", "https://cam/s"),
        ("rtsp://cam/live", "rtsp", "rtsp://cam/live"),
    ],
)
def test_what_a_source_names(source, kind, shown):
    _, place = decode(source=source)
    assert (place.kind, place.shown) == (kind, shown)


def test_a_device_path_is_its_number():
    assert decode(source="/dev/video7")[1].device == 7


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({}, ("source is missing", "an integer or a text in quotes")),
        ({"source": "left.avi", "width": 8}, ("width = 8", "16 to 16384")),
        ({"source": "left.avi", "rate_hz": 0}, ("rate_hz = 0", "0.1 to 1000")),
        ({"source": "left.avi", "chanel": "red"}, ("no option 'chanel'", "did you mean 'channel'")),
        ({"source": "left.avi", "channel": "alpha"}, ('channel = "alpha"', '"blue"', '"gray"')),
        ({"source": "left.avi", "flip": "left"}, ('flip = "left"', '"rotate180"')),
        ({"source": "left.avi", "latency_s": -0.1}, ("latency_s = -0.1", "0 to 10")),
        ({"source": "left.avi", "frozen_frames": -1}, ("frozen_frames = -1", "0")),
        ({"source": "left.avi", "pixel_format": "MJPEG"}, ('pixel_format = "MJPEG"', "four letters")),
        ({"source": "left.avi", "rate_hz": 1.0}, ("read_timeout_s = 1", "2 s")),
        ({"source": -1}, ("source = -1", "/dev/video0")),
        ({"source": "0"}, ('source = "0"', "source = 0")),
        ({"source": "left.txt"}, ('source = "left.txt"', ".avi, .mkv, .mp4")),
        ({"source": "ftp://cam/x"}, ("ftp://cam/x", "https://")),
        ({"source": "http:///x"}, ("http:///x", "with a host")),
        ({"source": "http://cam:port/x"}, ("http://cam:***", "not a URL")),
        ({"source": "http://operator:12/34@cam/x"}, ("http://***", "%2F")),
        ({"source": "operator:Tulpe@cam/v.mp4"}, ("***@cam/v.mp4", "begins with http://")),
        ({"source": "p%04d%d.png"}, ("p%04d%d.png", "one %d")),
        ({"source": "d%d/left.png"}, ("d%d/left.png", "in the name of the file")),
        ({"source": "p%s.png"}, ("p%s.png", "one %d")),
        ({"source": "p%04d.avi"}, ("p%04d.avi", ".png")),
        ({"source": 0, "loop": True}, ("loop = true", "/dev/video0")),
        ({"source": "http://cam/x", "pace": "every"}, ('pace = "every"', "files")),
        ({"source": 0, "start": 3}, ("start = 3", "files")),
    ],
)
def test_wrong_options_are_told_with_value_and_what_is_valid(options, parts):
    with pytest.raises(DriverError) as caught:
        decode_video_options({**SIZE, **options}, CELL)
    assert caught.value.code == "option"
    for part in ("driver 'video'", *parts):
        assert part in str(caught.value)


def test_a_password_is_not_shown():
    _, place = decode(source="http://user:secret@cam:81/s")
    assert place.shown == "http://***@cam:81/s"
    with pytest.raises(DriverError) as caught:
        decode(source="gopher://user:secret@cam/s")
    assert "secret" not in str(caught.value)
    assert "secret" not in repr(caught.value.data)


def test_live_cameras_are_watched_for_frozen_pictures_and_files_are_not():
    assert frozen_frames(*decode(source=0)) == 10
    assert frozen_frames(*decode(source="a.avi")) == 0
    assert frozen_frames(*decode(source="a.avi", frozen_frames=4)) == 4
    assert frozen_frames(*decode(source=0, frozen_frames=0)) == 0
