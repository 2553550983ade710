"""Streams of servers that are not ours, and of senders that write as common cameras do.

``pytest -n 0 -s tests/drivers/video/test_foreign_streams.py`` prints the table of docs/cameras.md.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from stereoservo_drivers.video.driver import VideoCameraDriver

from .conftest import connected, poll_until
from .foreign import (
    DIALECTS,
    HEIGHT,
    WIDTH,
    Feeder,
    aiohttp_chunked,
    dialect,
    ffmpeg_mpjpeg,
    gstreamer_rtsp,
    stamp_of,
    stamped,
)

RATE_HZ = 60.0
PICTURES = 90
LEFT_OUT = (31, 50, 51)
"""Of these the source sends none."""


def opened(url, context, **options):
    """A driver of ``url``, once its server listens."""
    settings = {"source": url, "width": WIDTH, "height": HEIGHT, "rate_hz": RATE_HZ, "read_timeout_s": 5.0}
    return connected(VideoCameraDriver({**settings, **options}, context))


@pytest.mark.parametrize("name", DIALECTS)
def test_a_picture_is_delivered_before_the_next_one_begins(context, name):
    with dialect(name) as (url, send):
        driver = VideoCameraDriver({"source": url, "width": WIDTH, "height": HEIGHT, "read_timeout_s": 60.0}, context)
        feeder = Feeder(send, 50.0)
        try:
            driver.configure()
            feeder.close()
            driver.activate()
            time.sleep(0.05)
            driver.poll()
            for number in range(100, 110):
                send(stamped(number, 0))  # and nothing more until it has come
                (frame,) = poll_until(driver, 1)
                assert stamp_of(frame.image) == (number, 0)
        finally:
            feeder.close()
            driver.close()


SERVERS = {
    "ffmpeg -f mpjpeg": (ffmpeg_mpjpeg, {}),
    "aiohttp": (aiohttp_chunked, {}),
    "gst-rtsp-server, TCP": (gstreamer_rtsp, {}),
    "gst-rtsp-server, UDP": (gstreamer_rtsp, {"udp": True}),
    **{name: (lambda _rate, name=name: dialect(name), {}) for name in DIALECTS},
}


@pytest.mark.process
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in DIALECTS else ()) for name in SERVERS]
)
def test_every_picture_of_a_foreign_server_comes_and_those_it_left_out_are_counted(context, name, capsys, monkeypatch):
    make, options = SERVERS[name]
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", f"rtsp_transport;{'udp' if options else 'tcp'}")
    with make(RATE_HZ) as (url, send):
        feeder = Feeder(send, RATE_HZ)  # RTSP servers begin when somebody asks, ffmpeg waits for its client
        driver = None
        try:
            driver = opened(url, context)
            frames, dropped = measured(driver, feeder)
        finally:
            feeder.close()
            if driver is not None:
                driver.close()
    with capsys.disabled():
        print(table_row(name, frames))
    assert len(frames) >= 0.98 * (PICTURES - len(LEFT_OUT))
    assert dropped == len(LEFT_OUT)


def measured(driver, feeder):
    """Of pictures that come, once the stream runs: number, ms from drawing to the stamp and to delivery; drop count."""
    poll_until(driver, 20)
    first = feeder.number + 10
    feeder.left_out = frozenset(first + k for k in LEFT_OUT)
    frames, before, number = {}, None, 0
    end = time.monotonic() + 20.0
    while number < first + PICTURES - 1 and time.monotonic() < end:
        for frame in driver.poll():
            polled_ns = time.monotonic_ns()
            number, drawn_ns = stamp_of(frame.image)
            if number >= first and before is None:
                before = driver.statistics().dropped
            if number >= first:
                frames[number] = (frame.t_received_ns - drawn_ns) * 1e-6, (polled_ns - drawn_ns) * 1e-6
        time.sleep(0.0005)
    return frames, driver.statistics().dropped - before


def table_row(name, frames):
    stamps, delivered = np.array(list(frames.values())).T
    share = len(frames) / (PICTURES - len(LEFT_OUT))
    shown = [f"{np.median(t):.1f} / {np.percentile(t, 95):.1f}" for t in (stamps, delivered)]
    return f"| {name} | {share:.3f} | {shown[0]} | {shown[1]} |"
