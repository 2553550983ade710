"""The page's link to a cell whose messages are not what they should be."""

from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from stereoservo.client import NoReplyError
from stereoservo.web import cell_link
from stereoservo.web.cell_link import CellLink


class Cell:
    """A client of a cell that publishes nothing by itself."""

    cell = "far"

    def info(self) -> Any:
        return None

    def close(self) -> None: ...


def test_whatever_a_cell_sends_the_link_goes_on_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    heard = Event()

    def publish(slot: str, message: bytes, keep: bool) -> None:
        told.append(msgspec.json.decode(message))
        if len(told) == 2:
            heard.set()

    monkeypatch.setattr(cell_link, "Client", lambda *arguments, **named: Cell())
    monkeypatch.setattr(cell_link, "AGAIN_S", 0.01)
    monkeypatch.setattr(CellLink, "_read", lambda self, client: client.nothing)
    link = CellLink("far", None, "page", publish)
    link.start()
    try:
        assert heard.wait(10)
    finally:
        link.close()
    assert not told[0]["up"]
    assert "no attribute 'nothing'" in told[0]["why"]


def test_a_daemon_without_the_key_of_goals_is_shown_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    monkeypatch.setattr(cell_link, "Client", lambda *arguments, **named: Cell())
    link = CellLink(
        "far", None, "page", lambda slot, message, keep: told.append(msgspec.json.decode(message))
    )
    asked: list[str] = []

    def running_goals() -> Any:
        asked.append("goals")
        raise NoReplyError("goals", 2.0)

    client = cast(Any, SimpleNamespace(running_goals=running_goals))
    link._tell_goal(client, "12345678")
    link._tell_goal(client, "")
    assert asked == ["goals"]
    assert "goal 12345678 cannot be drawn" in told[0]["notice"]
    assert len(told) == 1


def test_a_picture_without_its_header_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(cell_link, "Client", lambda *arguments, **named: Cell())
    link = CellLink("far", None, "page", lambda slot, message, keep: told.append(slot))
    payload = SimpleNamespace(to_bytes=lambda: b"jpeg")
    for attachment in (None, payload):
        link._take_picture(
            cast(Any, SimpleNamespace(attachment=attachment, key_expr="c/preview/left", payload=payload))
        )
    assert told == ["picture left"]
