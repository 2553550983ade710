"""The page server's link without a cell: what it does when its session fails."""

import threading
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
import zenoh

from stereoservo.client import ClientError, NoReplyError
from stereoservo.messages.discovery import NotRunningError
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.wire import Reply
from stereoservo.web import cell_link
from stereoservo.web.cell_link import CellLink, LinkDownError


class Cell:
    """Clients of one cell: the first one's session fails when it is read, with ``fails``; the link gets no other, who
    only wants to stop the arm does.
    """

    def __init__(self, fails: Exception, stops: Callable[[], Reply]) -> None:
        self.fails = fails
        self.stops = stops
        self.gone = False
        self.clients: list[ClientOfCell] = []

    def connect(self, *arguments: Any, **named: Any) -> "ClientOfCell":
        if self.clients and (self.gone or threading.current_thread().name == "cell-link"):
            raise NotRunningError("noted", ())
        self.clients.append(made := ClientOfCell(self, first=not self.clients))
        return made


class ClientOfCell:
    """What `CellLink` needs of a client."""

    cell = "noted"
    keys = KeySpace("noted")

    def __init__(self, cell: Cell, first: bool) -> None:
        self._of = cell
        self._first = first
        self.session = self
        self.stopped = self.closed = 0

    def info(self) -> dict[str, Any]:
        return {}

    def declare_subscriber(self, *arguments: Any) -> None:
        raise self._of.fails

    def stop(self, operator: str) -> Reply:
        self.stopped += 1
        return self._of.stops() if self._first else Reply(True, "stopped")

    def close(self) -> None:
        self.closed += 1

    def __enter__(self) -> "ClientOfCell":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def link_of(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> tuple[CellLink, threading.Event, list[str]]:
    """A link to ``cell``; what is set when it goes down, and why it says that it is."""
    down, why = threading.Event(), list[str]()

    def publish(slot: str, data: bytes, keep: bool) -> None:
        tree = msgspec.json.decode(data)
        if tree.get("up") is False:
            why.append(tree["why"])
            down.set()

    monkeypatch.setattr(cell_link, "Client", cell.connect)
    return CellLink("noted", None, "ann", publish), down, why


@pytest.mark.parametrize(
    ("fails", "told"),
    [
        (ClientError("it is silent"), "it is silent"),
        (zenoh.ZError("session closed"), "session closed"),
        (KeyError("joint"), "KeyError: 'joint'"),
    ],
)
def test_where_the_link_is_down_the_arm_is_stopped_over_a_session_of_its_own(
    fails: Exception, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = Cell(fails, stops=pytest.fail)
    link, down, why = link_of(cell, monkeypatch)
    link.start()
    try:
        assert down.wait(60)
        assert told in why[0]
        assert link.stop("ann").message == "stopped"
        with pytest.raises(LinkDownError):
            link.client.enable()
    finally:
        link.close()
    first, fresh = cell.clients
    assert (first.stopped, first.closed) == (0, 1)
    assert (fresh.stopped, fresh.closed) == (1, 1), "it is left behind by nobody"


@pytest.mark.parametrize("error", [NoReplyError("stop", 2.0), zenoh.ZError("session closed")])
def test_a_stop_without_an_answer_is_given_again_over_a_fresh_session(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stops() -> Reply:
        raise error

    cell = Cell(ClientError("not read here"), stops)
    link, _, _ = link_of(cell, monkeypatch)
    assert link.stop("ann").message == "stopped"
    assert [client.stopped for client in cell.clients] == [1, 1]


def test_where_there_is_no_daemon_the_stop_states_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def stops() -> Reply:
        cell.gone = True
        raise NoReplyError("stop", 2.0)

    cell = Cell(ClientError("not read here"), stops)
    link, _, _ = link_of(cell, monkeypatch)
    with pytest.raises(NotRunningError, match="no daemon runs"):
        link.stop("ann")
