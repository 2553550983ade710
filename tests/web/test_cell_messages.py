"""The page's link to a cell whose messages are not what they should be."""

from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from stereoservo.client import NoReplyError
from stereoservo.messages.status import RefinementState
from stereoservo.messages.wire import LoopInfo, StateMessage, encode
from stereoservo.web import cell_link
from stereoservo.web.cell_link import CellLink


class Cell:
    """A client of a cell that publishes nothing by itself."""

    cell = "far"

    def info(self) -> Any:
        return None

    def close(self) -> None: ...


def test_whatever_a_cell_sends_the_link_goes_on_and_states_it(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    heard = Event()

    def publish(slot: str, message: bytes, keep: bool) -> None:
        told.append(msgspec.json.decode(message))
        if len(told) == 2:
            heard.set()

    monkeypatch.setattr(cell_link, "Client", lambda *arguments, **named: Cell())
    monkeypatch.setattr(cell_link, "RECONNECT_S", 0.01)
    monkeypatch.setattr(CellLink, "_read", lambda self, client: client.nothing)
    link = CellLink("far", None, "page", publish)
    link.start()
    try:
        assert heard.wait(60)
    finally:
        link.close()
    assert not told[0]["up"]
    assert "no attribute 'nothing'" in told[0]["why"]


def test_a_daemon_without_the_key_of_goals_is_shown_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    monkeypatch.setattr(cell_link, "Client", lambda *arguments, **named: Cell())
    link = CellLink("far", None, "page", lambda slot, message, keep: told.append(msgspec.json.decode(message)))
    asked: list[str] = []

    def running_goals() -> Any:
        asked.append("goals")
        raise NoReplyError("goals", 2.0)

    client = cast(Any, SimpleNamespace(running_goals=running_goals))
    link._publish_goal(client, "12345678")
    link._publish_goal(client, "")
    assert asked == ["goals"]
    assert "goal 12345678 cannot be drawn" in told[0]["notice"]
    assert len(told) == 1


def test_a_picture_without_its_header_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(cell_link, "Client", lambda *arguments, **named: Cell())
    link = CellLink("far", None, "page", lambda slot, message, keep: told.append(slot))
    payload = SimpleNamespace(to_bytes=lambda: b"jpeg")
    for attachment in (None, payload):
        link._on_picture(cast(Any, SimpleNamespace(attachment=attachment, key_expr="c/preview/left", payload=payload)))
    assert told == ["picture left"]


def test_how_far_the_refinement_is_comes_with_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    monkeypatch.setattr(cell_link, "Client", lambda *arguments, **named: Cell())
    link = CellLink("far", None, "page", lambda slot, message, keep: told.append(msgspec.json.decode(message)))
    state = StateMessage(
        cell="far", boot="b", t_ns=1, step=0, t_wall=1.0, lifecycle="active", model="none", model_epoch=0,
        source="hold", goal="", law="", level="ok", reasons=(), joints={}, velocities={}, command={}, error_px=None,
        task_error=(),
        innovation_px={}, visible={}, loop=LoopInfo(250.0, 1, 0, 0, {"p99": 1.0}, {}),
    )  # fmt: skip
    for refinement in (None, RefinementState(5, 16)):
        link._on_state(cast(Any, None), encode(msgspec.structs.replace(state, refinement=refinement)))
    assert [one["refinement"] for one in told] == ["", "5 rest poses, a model is estimated from 16 on"]
    assert told[1]["state"]["refinement"]["poses"] == 5
