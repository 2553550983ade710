"""What the page's server lets through, over real sockets, to a link that notes it."""

import http.client
import itertools
import json
import random
import socket
import time
from threading import Event
from typing import Any, cast

import msgspec
import pytest

pytest.importorskip("websockets", reason="the page's server needs websockets (extra web)")

from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from stereoservo.client import Client, ClientError
from stereoservo.messages.goals import Goal, TaughtTarget
from stereoservo.messages.wire import Reply
from stereoservo.web import server as page_server
from stereoservo.web.server import PageRequest
from web.page_bench import serving

EXAMPLE = Client.make_goal(TaughtTarget("a"))
VERBS = [kind.__struct_config__.tag for kind in PageRequest.__args__]
NEEDED: dict[str, dict[str, Any]] = {
    "take": {"token": "guess"},
    "teach": {"name": "a"},
    "drag": {"camera": "left", "shift": [1, 1]},
    "send": {"goal": msgspec.to_builtins(EXAMPLE)},
    "update": {"id": EXAMPLE.id, "target": {"kind": "features", "set_points": {}}},
    "seek": {"at": 1.0},
}
"""What a request must hold beside its verb."""
PATIENCE_S = 60.0
"""[s] For what a busy machine does late; how long it takes is not judged."""


def answer(page: ClientConnection, request: Any, n: int) -> dict[str, Any]:
    """The answer number ``n`` to a request; other messages are passed over."""
    page.send(request if isinstance(request, str | bytes) else msgspec.json.encode({**request, "n": n}).decode())
    while True:
        message = msgspec.json.decode(page.recv(timeout=PATIENCE_S))
        if message.get("answer", {}).get("n") == n:
            return cast(dict[str, Any], message["answer"])


def fuzzed(rng: random.Random) -> str | bytes:
    """A request: valid, of a wrong shape, or bytes; never a valid stop."""
    verb = rng.choice([verb for verb in VERBS if verb != "stop"])
    tree: dict[str, Any] = {"do": verb, "n": 0}
    fields: dict[str, Any] = {
        "token": rng.choice(["", "x" * 16, "\u0000", "ann"]), "name": rng.choice(["park", "../x", "", None, "*"]),
        "check": rng.random() < 0.5, "camera": rng.choice(["left", "*", 3]),
        "shift": rng.choice([[1, 2], [1e9, 0], "x"]),
        "turn": rng.choice([0.1, 1e308]),
        "draft": True, "done": True, "operator": "ann", "holds": True, "page": 1,
    }  # fmt: skip
    for key in rng.sample(sorted(fields), rng.randint(0, 3)):
        tree[key] = fields[key]
    if rng.random() < 0.5:
        tree |= NEEDED.get(verb, {})
    data = bytearray(msgspec.json.encode(tree))
    match rng.randint(0, 5):
        case 0:
            data[rng.randrange(len(data))] = rng.randrange(256)
            return bytes(data)
        case 1:
            return bytes(data[: rng.randrange(len(data))])
        case 2:
            return b"[" * rng.randint(1, 4000)
        case _:
            return data.decode()


def test_a_thousand_fuzzed_requests_of_a_read_only_page_command_nothing_but_stop() -> None:
    rng = random.Random(18)
    with serving(None) as (port, calls, _, _), connect(f"ws://127.0.0.1:{port}/socket") as page:
        for k in range(1000):
            page.send(fuzzed(rng))
            if k % 50 == 49:  # the server answers each, and goes on
                assert answer(page, {"do": "stop"}, k)["ok"]
        refused = answer(page, {"do": "enable"}, 5000)
        assert not refused["ok"]
        assert "read-only" in refused["message"]
        assert set(calls) == {"stop"}
        assert len(calls) == 20


def test_every_verb_needs_the_arm_but_stop_take_and_release() -> None:
    with serving("ann") as (port, calls, tokens, link), connect(f"ws://127.0.0.1:{port}/socket") as page:
        requests = [
            {"do": verb, **NEEDED.get(verb, {})}
            for verb in VERBS
            if verb not in ("stop", "take", "release", "play", "seek")
        ]
        for n, request in enumerate(requests, 1):
            assert "does not hold the arm" in answer(page, request, n)["message"]
        assert calls == []
        assert answer(page, {"do": "take", "token": tokens[0]}, 100)["ok"]
        for n, verb in enumerate(("enable", "hold", "resume", "disable"), 200):
            assert answer(page, {"do": verb}, n)["ok"]
        assert calls == ["enable", "hold", "resume", "disable"]
        assert "check the goal first" in answer(page, {"do": "go"}, 300)["message"]
        assert "calibrate first" in answer(page, {"do": "drag", "camera": "left", "shift": [0, 0]}, 301)["message"]
        with connect(f"ws://127.0.0.1:{port}/socket") as other:
            assert "another page holds" in answer(other, {"do": "take", "token": tokens[1]}, 1)["message"]
            assert answer(other, {"do": "stop"}, 2)["ok"]
            page.close()  # whoever holds the arm and goes lets it rest
            until = time.monotonic() + PATIENCE_S
            for n in itertools.count(3):
                if answer(other, {"do": "take", "token": tokens[1]}, n)["ok"]:
                    break
                assert time.monotonic() < until
            assert answer(other, {"do": "hold"}, n + 1)["ok"]
            assert link.ended >= 1
        with connect(f"ws://127.0.0.1:{port}/socket") as later:
            while "held the arm was closed" not in (told := str(later.recv(timeout=PATIENCE_S))):
                assert "answer" not in told, "it is told with what happened before"


def test_a_page_that_does_not_read_is_sent_no_more_pictures_until_it_has() -> None:
    count, size = 150, 100_000
    with (
        serving(None) as (port, _, _, link),
        connect(f"ws://127.0.0.1:{port}/socket", max_queue=1) as page,
    ):
        answer(page, {"do": "take", "token": ""}, 1)
        for k in range(count):
            link.publish("picture left", k.to_bytes(4, "little") + bytes(size), False)
            time.sleep(0.002)  # for the server's loop, which sends what fits
        link.publish("", b'{"last": true}', False)
        shown = []
        while (message := page.recv(timeout=PATIENCE_S)) != '{"last": true}':
            if isinstance(message, bytes):
                shown.append(int.from_bytes(message[:4], "little"))
        assert len(shown) <= 8, "the sockets' buffers would hold some sixty"
        while not isinstance(message := page.recv(timeout=PATIENCE_S), bytes):
            pass
        assert int.from_bytes(message[:4], "little") == count - 1, "the newest of all"


def test_pages_get_to_know_that_the_server_lives_and_for_how_long_the_cell_has_been_silent() -> None:
    with serving(None) as (port, _, _, link), connect(f"ws://127.0.0.1:{port}/socket") as page:

        def tick() -> dict[str, Any]:
            while "tick" not in (message := msgspec.json.decode(page.recv(timeout=PATIENCE_S))):
                pass
            return cast(dict[str, Any], message["tick"])

        assert tick()["silent_s"] == 0.0
        link.silent_s = 7.25
        while tick()["silent_s"] != 7.25:
            pass


def test_a_stop_names_the_page_that_asked_for_it() -> None:
    with serving("ann") as (port, _, tokens, link):
        stopped: list[str] = []
        link.stop = lambda operator: stopped.append(operator) or Reply(True, "stopped")
        with (
            connect(f"ws://127.0.0.1:{port}/socket") as first,
            connect(f"ws://127.0.0.1:{port}/socket") as second,
        ):
            assert answer(first, {"do": "take", "token": tokens[0]}, 1)["ok"]
            for n, page in enumerate((first, second), 2):
                assert answer(page, {"do": "stop"}, n)["ok"]
        assert stopped == ["ann", "viewer 2"]


def frame(text: str) -> bytes:
    """A masked WebSocket frame of a short text, by the letter of RFC 6455."""
    return bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text.encode()


def test_a_page_that_answers_no_ping_lets_the_arm_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_server, "PING_S", 0.2)
    monkeypatch.setattr(page_server, "SILENT_S", 1.0)
    with serving("ann") as (port, _, tokens, link), socket.create_connection(("127.0.0.1", port)) as frozen:
        frozen.sendall(
            f"GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        frozen.sendall(frame(json.dumps({"do": "take", "token": tokens[0]})))  # and nothing from here on
        until = time.monotonic() + PATIENCE_S
        while not link.ended:
            assert time.monotonic() < until
            time.sleep(0.01)
        with connect(f"ws://127.0.0.1:{port}/socket") as other:
            while "held the arm lost its connection" not in str(other.recv(timeout=PATIENCE_S)):
                pass
            assert answer(other, {"do": "take", "token": tokens[1]}, 1)["ok"]


def test_a_stop_waits_for_nothing_that_a_page_has_asked_for() -> None:
    free = Event()
    with serving("ann") as (port, calls, tokens, link), connect(f"ws://127.0.0.1:{port}/socket") as page:
        assert answer(page, {"do": "take", "token": tokens[0]}, 1)["ok"]
        link.client.hold = lambda: free.wait(2 * PATIENCE_S) and Reply(True, "held")
        try:
            for n in range(100, 130):
                page.send(msgspec.json.encode({"do": "hold", "n": n}).decode())
            assert answer(page, {"do": "stop"}, 2)["ok"]
            assert calls == ["stop"]
            assert not free.is_set()
        finally:
            free.set()


def test_a_goal_is_not_sent_where_another_was_asked_for_while_it_was_checked() -> None:
    checking, free = Event(), Event()

    def slow(goal: Goal) -> Reply:
        checking.set()
        free.wait(2 * PATIENCE_S)
        return Reply(True, "a path")

    def refused(goal: Goal) -> Reply:
        raise ClientError("no path")

    with serving("ann") as (port, calls, tokens, link), connect(f"ws://127.0.0.1:{port}/socket") as page:
        assert answer(page, {"do": "take", "token": tokens[0]}, 1)["ok"]
        link.client.check = slow
        link.taught_goal = lambda name: EXAMPLE
        try:
            page.send(msgspec.json.encode({"do": "check", "name": "a", "n": 2}).decode())
            assert checking.wait(PATIENCE_S)
            link.client.check = refused
            assert not answer(page, {"do": "check", "name": "b"}, 3)["ok"]
        finally:
            free.set()
        while msgspec.json.decode(page.recv(timeout=PATIENCE_S)).get("answer", {}).get("n") != 2:
            pass
        assert "check the goal first" in answer(page, {"do": "go"}, 4)["message"]
        assert "send" not in calls


def test_a_page_of_a_recording_commands_nothing_not_even_a_stop() -> None:
    with serving("ann") as (port, calls, _, link), connect(f"ws://127.0.0.1:{port}/socket") as page:
        link.recording = True
        link.seek = lambda at: {"message": f"at {at}"}
        for n, verb in enumerate(sorted(set(VERBS) - {"play", "seek"}), 1):
            told = answer(page, {"do": verb, **NEEDED.get(verb, {})}, n)
            assert not told["ok"]
        assert "play and seek are valid" in told["message"]
        assert answer(page, {"do": "seek", "at": 3.0}, 100)["message"] == "at 3.0"
        assert calls == []


@pytest.mark.parametrize(
    ("request_", "told"),
    [
        ('{"do": "dance", "n": 7}', ["dance", "stop", "enable"]),
        ('{"do": "teach", "nmae": "a", "n": 7}', ["nmae", "name"]),
        ('{"do": "teach", "n": 7}', ["`name`"]),
        ('{"do": "send", "n": 7, "goal": {"id": "12345678", "target": {"kind": "taught", "name": "a", "tol": 1}}}',
         ["goal.target", "`tol`", "relative_to"]),
        ('{"do": "send", "n": 7, "goal": {"id": "12345678", "target": {"kind": "tought", "name": "a"}}}',
         ["tought", "taught", "features"]),
        ('{"n": 7}', ["`do`", "stop"]),
    ],
)  # fmt: skip
def test_a_wrong_key_is_named_with_what_would_be_valid(request_: str, told: list[str]) -> None:
    with serving(None) as (port, _, _, _), connect(f"ws://127.0.0.1:{port}/socket") as page:
        found = answer(page, request_, 7)
        assert not found["ok"]
        assert all(word in found["message"] for word in told), found


def test_other_hosts_origins_and_paths_get_nothing() -> None:
    with serving(None) as (port, calls, _, _):
        for headers, path, status in (
            ({}, "/", 200),
            ({}, "/page.js", 200),
            ({"Host": "evil.example"}, "/", 403),
            ({}, "/../server.py", 404),
            ({}, "/page/index.html", 404),
        ):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
            connection.request("GET", path, headers=headers)
            response = connection.getresponse()
            assert response.status == status, path
            assert "default-src 'none'" in (response.headers["Content-Security-Policy"] or "")
            connection.close()
        for origin in ("http://evil.example", "null"):
            with pytest.raises(InvalidStatus) as refused:
                connect(f"ws://127.0.0.1:{port}/socket", origin=origin)
            assert refused.value.response.status_code == 403
        assert calls == []


def test_the_page_loads_nothing_from_elsewhere() -> None:
    from stereoservo.web.server import FILES, FOLDER

    assert {name for name, _ in FILES.values()} == {path.name for path in FOLDER.iterdir()}
    for path in FOLDER.iterdir():
        assert "://" not in path.read_text().replace('"wss" : "ws"}://', "")
