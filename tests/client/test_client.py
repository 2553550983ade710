"""The client, with strangers on the cell's keys: whatever they answer is an error of the client's own."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from stereoservo.client import Client, ClientError, EventWatch, InvalidReplyError, NoReplyError, RefusedError
from stereoservo.client.client import with_newest_markers
from stereoservo.client.session import client_config, close_session, open_session
from stereoservo.gateway.zenoh_config import gateway_config
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.wire import EventList, EventMessage, FeaturesMessage, Reply, StateMessage, encode

pytestmark = pytest.mark.process

STRANGE = [b"", b"\xff", b"{}", b'{"accepted": "\xff"}', b"[" * 100_000, b'{"accepted": 5, "x": "\xff"}']
KEYS = KeySpace("demo")


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    """A router of no daemon."""
    tree: dict[str, Any] = {
        "schema": 1,
        "cell": {"name": "demo"},
        "joints": {"driver": "fake"},
        "camera": [{"name": "left", "driver": "fake"}],
        "safety": {"limit": []},
    }
    router = open_session(gateway_config(check_cell(tree), tmp_path, tmp_path / "z"))
    yield f"unixsock-stream/{tmp_path}/z"
    close_session(router, [])


@contextmanager
def stranger(endpoint: str, payload: bytes) -> Iterator[Any]:
    """A session that answers every key of the cell with ``payload``."""
    session = open_session(client_config(endpoint))

    def answer(query: Any) -> None:
        with query:
            query.reply(str(query.key_expr), payload)

    queryable = session.declare_queryable(f"{KEYS.prefix}/**", answer)
    try:
        yield session
    finally:
        close_session(session, [queryable])


CALLS: dict[str, Callable[[Client], object]] = {
    "status": Client.status,
    "info": Client.info,
    "events": Client.events,
    "stop": Client.stop,
    "hold": Client.hold,
    "record": Client.record,
    "enable": Client.enable,
    "goal": lambda client: client.goal({"j1": 0.1}),
}


@pytest.mark.parametrize("payload", STRANGE, ids=lambda payload: str(payload[:20]))
def test_a_strange_answer_is_the_clients_own_error(endpoint: str, payload: bytes) -> None:
    with stranger(endpoint, payload), Client("demo", endpoint=endpoint, operator="anna") as client:
        for name, call in CALLS.items():
            with pytest.raises(InvalidReplyError) as caught:
                call(client)
            assert isinstance(caught.value, ClientError), name
            assert KEYS.prefix in str(caught.value)


def test_a_refusal_in_the_place_of_a_state_is_still_a_refusal(endpoint: str) -> None:
    payload = encode(Reply(False, "no state yet"))
    with (
        stranger(endpoint, payload),
        Client("demo", endpoint=endpoint) as client,
        pytest.raises(RefusedError, match="state refused: no state yet"),
    ):
        client.status()


@pytest.mark.parametrize(
    ("name", "lost", "asked"),
    [("events", 1, 2), ("events", 2, 2), ("hold", 1, 1)],
    ids=["a reading is repeated", "not without end", "a command is not repeated"],
)
def test_a_reading_whose_reply_is_lost_is_asked_for_again(endpoint: str, name: str, lost: int, asked: int) -> None:
    session, heard = open_session(client_config(endpoint)), []

    def answer(query: Any) -> None:
        with query:
            heard.append(str(query.key_expr))
            if len(heard) > lost:
                query.reply(str(query.key_expr), encode(EventList("boot", 1, 1, ())))

    queryable = session.declare_queryable(f"{KEYS.prefix}/**", answer)
    try:
        with Client("demo", endpoint=endpoint, operator="anna") as client:
            if lost < asked:
                assert CALLS[name](client) == EventList("boot", 1, 1, ())
            else:
                with pytest.raises(NoReplyError, match="in 2 tries of 2 s" if asked == 2 else "within 2 s"):
                    CALLS[name](client)
        assert len(heard) == asked
    finally:
        close_session(session, [queryable])


@contextmanager
def putting(session: Any, payload: bytes) -> Iterator[None]:
    """Puts ``payload`` on the cell's event key, again and again."""
    ended = threading.Event()

    def work() -> None:
        while not ended.wait(0.01):
            session.put(KEYS.event, payload)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize("payload", STRANGE, ids=lambda payload: str(payload[:20]))
def test_a_strange_event_is_the_clients_own_error(
    endpoint: str, payload: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with stranger(endpoint, b"{}") as session, Client("demo", endpoint=endpoint) as client:
        with putting(session, payload), pytest.raises(InvalidReplyError, match=f"{KEYS.event} is not of"):
            next(client.watch())
        monkeypatch.setattr(client, "status", lambda: SimpleNamespace(boot="boot"))
        monkeypatch.setattr(client, "events", lambda first: SimpleNamespace(next=1))
        with (
            EventWatch(client) as watch,
            putting(session, payload),
            pytest.raises(InvalidReplyError, match=f"{KEYS.event} is not of"),
        ):
            watch.wait(lambda event: True, "an event", 10.0)


def test_who_looks_now_and_then_is_given_each_cameras_newest_markers_and_all_else() -> None:
    seen = [("left", 0, FeaturesMessage), ("event", 1, EventMessage), ("left", 2, FeaturesMessage),
            ("right", 3, FeaturesMessage), ("event", 4, EventMessage), ("state", 5, StateMessage)]  # fmt: skip
    assert [payload for _, payload, _ in with_newest_markers(seen)] == [1, 2, 3, 4, 5]
    assert with_newest_markers([]) == []


def test_a_page_of_events_that_were_not_asked_for_is_the_clients_own_error(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a page would be asked for again without end."""
    event = EventMessage(1, "boot", 0, 0.0, "held")
    monkeypatch.setattr(Client, "status", lambda self: SimpleNamespace(boot="boot"))
    pages = [
        EventList("boot", 1, 8, ()),
        EventList("boot", 1, 8, (event,)),
        EventList("boot", 1, 8, (msgspec.structs.replace(event, seq=9),)),
    ]
    monkeypatch.setattr(Client, "events", lambda self, first=1: pages.pop(0) if len(pages) > 1 else pages[0])
    with Client("demo", endpoint=endpoint) as client, EventWatch(client) as watch:
        for number in (1, 9):
            with pytest.raises(InvalidReplyError, match=rf"events \[{number}\] in reply to a query from 8 on"):
                watch._fill([], 20)
