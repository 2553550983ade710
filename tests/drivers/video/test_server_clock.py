"""The clock of a camera's server: the stated deviation covers the true error of emulated clocks; what is not known is
refused; a driver's stamps are those of the server.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.video.driver import VideoCameraDriver
from stereoservo_drivers.video.server_clock import ServerClock, envelope, seconds_in

RATE_HZ = 30


def seen(
    seed,
    seconds=90,
    offset_s=25_200.0,
    drift=50e-6,
    there=0.4e-3,
    back=0.4e-3,
    jitter=1e-3,
    jump=None,
    held=None,
):
    """Time [s], whether it is known, error and deviation [ms] of a server's clock at each picture; the clock.

    ``there``, ``back``: least times to the server and from it [s]; ``jump``: time and step of the server's clock [s];
    ``held``: from when until when pictures come by how much later [s].
    """
    rng = np.random.default_rng(seed)
    clock = ServerClock(0.005)
    for _ in range(3):
        clock.round_trip(round(1e9 * (there + back + rng.exponential(jitter))))
    rows = []
    for k in range(seconds * RATE_HZ):
        t = k / RATE_HZ
        sent = (100.0 + t) * (1.0 + drift) + offset_s + (jump[1] if jump and t > jump[0] else 0.0)
        delay = back + rng.exponential(jitter) + (held[2] if held and held[0] < t < held[1] else 0.0)
        sent_ns, now_ns = round(1e9 * sent), round(1e9 * (100.0 + t))
        found = clock.see(sent_ns, now_ns + round(1e9 * delay))
        rows.append((t, found.known, 1e-6 * (sent_ns + found.offset_ns - now_ns), 1e-6 * found.deviation_ns))
    return np.array(rows), clock


CASES = {
    "hours apart, 50 ppm": {},
    "-50 ppm": {"drift": -50e-6},
    "slow back": {"there": 0.1e-3, "back": 4e-3},
    "slow there": {"there": 4e-3, "back": 0.1e-3},
    "jitter 5 ms": {"jitter": 5e-3},
    "set on by 0.5 s": {"jump": (45.0, 0.5)},
    "set back by 0.5 s": {"jump": (45.0, -0.5)},
    "held up for 10 s": {"held": (45.0, 55.0, 0.03)},
}


@pytest.mark.parametrize("name", CASES)
def test_the_stated_deviation_covers_the_true_error(name):
    for seed in range(4):
        rows, clock = seen(seed, **CASES[name])
        known = rows[:, 1] > 0
        assert known[-1]
        assert known[rows[:, 0] > 6.0].mean() > 0.75
        # evenly distributed over the round trip: root 3 at most, and what noise adds
        assert np.abs(rows[known, 2] / rows[known, 3]).max() < 1.8
        assert abs(clock.estimate.drift + CASES[name].get("drift", 50e-6)) < 5e-6
        assert clock.jumps == {"set on by 0.5 s": 1, "set back by 0.5 s": 1, "held up for 10 s": 2}.get(name, 0)


def test_a_clock_that_was_set_is_refused_until_it_is_known_again():
    rows, _ = seen(1, jump=(45.0, -0.5))
    after = (rows[:, 0] > 45.0) & (rows[:, 0] < 60.0)
    assert not rows[after, 1].any()
    rows, _ = seen(1, jump=(45.0, 0.5))
    assert not rows[(rows[:, 0] > 45.0) & (rows[:, 0] < 48.0), 1].any()


def test_what_is_not_known_is_refused_with_the_reason():
    assert ServerClock(0.005).estimate.told == (False, "no picture has carried a stamp")
    _, clock = seen(2, seconds=3)
    assert "5 s are needed" in clock.estimate.reason
    _, clock = seen(2, back=30e-3, seconds=20)
    assert clock.estimate.reason.endswith("the limit 5.00 ms")
    _, clock = seen(2, drift=2e-3, seconds=20)
    assert "ppm" in clock.estimate.reason
    never = ServerClock(0.005)
    for k in range(300):
        assert never.stamp(k * 33_000_000, k * 33_000_000 + 5) is None
    assert "nothing bounds" in never.estimate.reason
    assert math.isinf(never.estimate.deviation_ns)


def test_the_envelope_is_the_highest_line_below_on_average():
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(-1.0, 1.0, 40))
    y = 0.3 * x + rng.exponential(1.0, 40)
    level, slope = envelope(x, y)
    assert (y - level - slope * x).min() > -1e-12
    best = max(
        (y[a] + (y[b] - y[a]) / (x[b] - x[a]) * (x.mean() - x[a]))
        for a in range(40)
        for b in range(40)
        if a != b and (y - y[a] - (y[b] - y[a]) / (x[b] - x[a]) * (x - x[a])).min() > -1e-12
    )
    assert level + slope * x.mean() == pytest.approx(best)


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("1700000000.123456", 1_700_000_000_123_456_000),
        ("5", 5 * 10**9),
        ("5.1e3", None),
        ("-1", None),
        ("9223372036", None),
        ("99999999999999999999", None),
        (None, None),
    ],
)
def test_stamps_of_headers(text, ns):
    assert seconds_in(text) == ns


class StampingServer(threading.Thread):
    """An MJPEG server whose clock is ``offset_s`` ahead; pictures are sent ``late_s`` after their stamps."""

    def __init__(self, offset_s: float, late_s: float) -> None:
        super().__init__(daemon=True)
        self._offset_s, self._late_s = offset_s, late_s
        self.ended = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/stream"

    def run(self) -> None:
        connection, _ = self._listener.accept()
        with connection, self._listener:
            connection.recv(4096)
            connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=b\r\n\r\n--b\r\n")
            number = 0
            while not self.ended.wait(0.02):
                shutter = time.monotonic() + self._offset_s
                time.sleep(self._late_s)
                image = np.full((48, 64), 40 + number % 50, np.uint8)
                image[10:20, 10 + number % 30 : 20 + number % 30] = 250
                data = cv2.imencode(".jpg", image)[1].tobytes()
                head = f"Content-Type: image/jpeg\r\nContent-Length: {len(data)}\r\nX-Timestamp: {shutter:.6f}\r\n\r\n"
                try:
                    connection.sendall(head.encode() + data + b"\r\n--b\r\n")
                except OSError:  # the driver was closed
                    return
                number += 1


def test_a_driver_takes_the_servers_stamps_once_its_clock_is_known(tmp_path):
    server = StampingServer(7200.0, 0.0)
    server.start()
    context = DriverContext(MonotonicClock(), "clocks", tmp_path, tmp_path, "left")
    options = {
        "source": server.url,
        "width": 64,
        "height": 48,
        "rate_hz": 40.0,
        "latency_s": 0.25,
        "server_clock_s": 0.1,
    }
    driver = VideoCameraDriver(options, context)
    driver.configure()
    driver.activate()
    until, ages, known, told = time.monotonic() + 60.0, [], False, ""
    try:
        while time.monotonic() < until and not (known and ages and ages[-1] < 0.2):
            ages += [(f.t_received_ns - f.t_shutter_ns) * 1e-9 for f in driver.poll()]
            known, told = driver.statistics().server_clock
            time.sleep(0.005)
    finally:
        server.ended.set()
        driver.close()
    assert known, told
    assert ages[0] == pytest.approx(0.25)  # until then the time of reception less latency_s
    assert 0.0 <= ages[-1] < 0.2
    assert "offset -7200." in told or "offset -7199." in told


def test_other_sources_have_no_server():
    with pytest.raises(DriverError, match="server_clock_s"):
        VideoCameraDriver(
            {"source": 0, "width": 64, "height": 48, "server_clock_s": 0.01},
            DriverContext(MonotonicClock(), "clocks", Path(), Path(), "left"),
        )
