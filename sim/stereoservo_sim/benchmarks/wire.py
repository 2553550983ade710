"""``bench wire``: latency of messages between a client and the servo loop of a daemon, beside bare zenoh over the
same router.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from stereoservo.client import Client
from stereoservo.client.events import EventWatch
from stereoservo.messages.wire import FeaturesMessage, StateMessage, decode
from stereoservo_sim.benchmarks.service_bench import running_daemon
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.progress import ProgressCall

LIMITS = "\n".join(
    f'[[safety.limit]]\njoint = "j{k}"\nmin = -1.7\nmax = 1.7\nvelocity = 0.8\nacceleration = 3.0' for k in range(1, 7)
)
CELL = f"""
schema = 1
[cell]
name = "wire"
[joints]
driver = "fake"
[[camera]]
name = "left"
driver = "fake"
[[camera]]
name = "right"
driver = "fake"
[safety]
{LIMITS}
[calibration]
base = {{ j1 = 0.0, j2 = -1.3, j3 = -0.4, j4 = 0.0, j5 = 0.0, j6 = 0.0 }}
"""
"""Drivers without physics and images, so that only the wire is timed."""
CALLS = 100
"""Calls of each kind per repetition."""
GOALS = 10
ECHO = """
import sys, time
from stereoservo.client.session import client_config, open_session
session = open_session(client_config(sys.argv[1], None))
queryable = session.declare_queryable("bench/echo", lambda query: query.reply("bench/echo", b"{}"))
print("ready", flush=True)
sys.stdin.read()
session.close()
"""
"""Program that replies at once, until its standard input ends."""


def run_wire(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Latencies of messages, by kind.

    ``query_us``: a query to another process and its reply, by bare zenoh and from the gateway (``status``);
    ``command_us``: with the servo loop between (``hold``). ``put_us``: duration of a put for its caller.
    ``one_way_us``:
    from the creation of a message (a cycle, or a frame's arrival) to a client that waits for it. ``goal_us``: from
    sending a joint goal to the cycle of its first command, and to the reply.

    Raises ExperimentError if the daemon does not start.
    """
    calls = repetitions * CALLS
    with tempfile.TemporaryDirectory(prefix="stereoservo-wire-") as scratch:
        path = Path(scratch) / "wire.toml"
        path.write_text(CELL)
        daemon = running_daemon(path, Path(scratch), ("--seed", str(seed)), code="wire")
        with daemon as info, Client(info.cell) as client, _echo(info.endpoint):
            client.enable()
            progress("wire", 0, 4)
            query = {
                "bare_zenoh": _times(lambda: client.query("bench/echo"), calls),
                "status": _times(client.status, calls),
            }
            progress("wire", 1, 4)
            command = {"hold": _times(client.hold, calls)}
            client.resume()
            put = _times(lambda: client.session.put("bench/unheard", b"{}"), calls)
            progress("wire", 2, 4)
            features = f"{client.keys.prefix}/features/left"
            ways = {
                "state": _one_way(client, client.keys.state, _of_state, calls),
                "features": _one_way(client, features, _of_features, calls),
            }
            progress("wire", 3, 4)
            goals = _goals(client, repetitions * GOALS)
            rate_hz = client.status().loop.rate_hz
            progress("wire", 4, 4)

    def of_each(samples: dict[str, list[float]]) -> dict[str, Any]:
        return {name: summary(seconds, 1e6) for name, seconds in samples.items()}

    return {
        "rate_hz": rate_hz,
        "query_us": of_each(query),
        "command_us": of_each(command),
        "put_us": summary(put, 1e6),
        "one_way_us": of_each(ways),
        "goal_us": of_each(goals),
    }


@contextmanager
def _echo(endpoint: str) -> Iterator[None]:
    process = subprocess.Popen([sys.executable, "-c", ECHO, endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield
    finally:
        process.communicate(timeout=20.0)


def _times(call: Callable[[], object], count: int) -> list[float]:
    """Seconds of each call, with pauses that are no multiple of the loop's period."""
    samples = []
    for _ in range(count):
        time.sleep(0.0033)
        began = time.perf_counter()
        call()
        samples.append(time.perf_counter() - began)
    return samples


def _of_state(data: bytes) -> int:
    return decode(data, StateMessage).t_ns


def _of_features(data: bytes) -> int:
    return decode(data, FeaturesMessage).t_received_ns


def _one_way(client: Client, key: str, stamp: Callable[[bytes], int], count: int) -> list[float]:
    """Seconds from a message's stamp until a waiting client receives it."""
    samples = []
    subscriber = client.session.declare_subscriber(key)
    try:
        while len(samples) < count:
            data = subscriber.recv().payload.to_bytes()
            arrived = time.monotonic_ns()
            samples.append((arrived - stamp(data)) * 1e-9)
    finally:
        subscriber.undeclare()
    return samples


def _goals(client: Client, count: int) -> dict[str, list[float]]:
    """Successive joint goals: seconds from sending to the cycle of the first command, and to the reply."""
    begins, replies = [], []
    joint, start = next(iter(client.status().joints.items()))
    for k in range(count):
        with closing(EventWatch(client)) as watch:
            began = time.monotonic_ns()
            handle = client.goal({joint: start + (0.02 if k % 2 == 0 else 0.0)}, lease_s=None)
            replies.append((time.monotonic_ns() - began) * 1e-9)
            started = watch.wait(lambda event: event.kind == "goal_started", "a goal that starts", 10.0)
            begins.append((started.t_ns - began) * 1e-9)
        handle.wait(20.0)
    return {"first_command": begins, "reply": replies}
