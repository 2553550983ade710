"""The page's server on a link that notes what reaches the cell, for tests."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any, cast

from stereoservo.messages.goals import Goal
from stereoservo.messages.wire import Reply
from stereoservo.web.cell_link import CellLink, Publish
from stereoservo.web.model_view import ModelView
from stereoservo.web.server import PageServer


class NotedClient:
    """Notes the name of every method that is called."""

    def __init__(self, calls: list[str]) -> None:
        self._calls = calls

    def __getattr__(self, name: str) -> Callable[..., Reply]:
        def call(*arguments: Any, **named: Any) -> Reply:
            self._calls.append(name)
            return Reply(True, name)

        return call


class NotedLink(NotedClient):
    """A `CellLink` without a cell."""

    cell = "noted"
    recording = False
    view = ModelView()
    publish: Publish
    silent_s = 0.0

    def __init__(self, calls: list[str]) -> None:
        super().__init__(calls)
        self.loop = asyncio.new_event_loop()
        """The server's, which a test may hold up."""
        self.client = NotedClient(calls)
        self.watched = Event()
        self.ended = 0

    def start(self) -> None: ...

    def close(self) -> None: ...

    def end_leases(self) -> None:
        self.ended += 1

    def taught_goal(self, name: str) -> Goal:
        return cast(Goal, None)


@contextmanager
def serving(operator: str | None) -> Iterator[tuple[int, list[str], list[str], NotedLink]]:
    """A server in a thread: its port, the calls that reach the cell, the tokens, its link."""
    calls: list[str] = []
    tokens: list[str] = []
    link = NotedLink(calls)

    def make_link(publish: Publish) -> CellLink:
        link.publish = publish
        return cast(CellLink, link)

    server = PageServer(make_link, operator, tokens.append)
    loop = link.loop
    thread = Thread(target=loop.run_forever, daemon=True)
    thread.start()
    try:
        port = asyncio.run_coroutine_threadsafe(server.start("127.0.0.1", 0), loop).result(60)
        yield port, calls, tokens, link
    finally:
        asyncio.run_coroutine_threadsafe(server.close(), loop).result(60)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
