"""The boundary: what a message raises is refused, counted, and logged once a second; replies that cannot be sent."""

import time
from typing import Any

import pytest

from stereoservo.gateway import boundary as boundary_module
from stereoservo.gateway.boundary import MAX_TEXT_CHARS, Boundary
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.gateway.publisher import ReplyThread
from stereoservo.messages.wire import MessageError, Reply


def refused(boundary: Boundary, error: Exception, key: str = "goal/anna") -> Reply:
    replies: list[Reply] = []

    def work() -> None:
        raise error

    boundary.take(key, work, replies.append)
    (reply,) = replies
    return reply


@pytest.mark.parametrize(
    ("error", "message", "problem"),
    [
        (MessageError("gain: too high"), "the message is not valid", "gain: too high"),
        (TransferError("marker 3 moves"), "no goal could be made", "marker 3 moves"),
        (RecursionError("too deep"), "the message could not be taken", "RecursionError: too deep"),
        (MemoryError(), "the message could not be taken", "MemoryError: "),
    ],
)
def test_every_error_is_a_refusal_in_words(error: Exception, message: str, problem: str) -> None:
    reply = refused(Boundary("boot"), error)
    assert not reply.accepted
    assert reply.message.startswith(message)
    assert (reply.problems, reply.boot) == ((problem,), "boot")


def test_what_is_taken_is_not_refused() -> None:
    boundary = Boundary("boot")
    done: list[int | Reply] = []
    boundary.take("goal/anna", lambda: done.append(1), done.append)
    assert done == [1]
    assert boundary.refusals.count == 0


def test_refusals_are_counted_and_logged_once_a_second(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(boundary_module.time, "monotonic", lambda: now)
    boundary = Boundary("boot")
    for _ in range(1000):
        refused(boundary, MessageError("bad"))
    now += 1.0
    refused(boundary, ValueError("worse"))
    first, second = capsys.readouterr().err.splitlines()
    assert "'goal/anna': bad (1 of this kind" in first
    assert "ValueError: worse (work, " in second
    assert "(1001 of this kind since the start)" in second


def test_what_a_client_sent_cannot_fill_or_forge_the_log(capsys: pytest.CaptureFixture[str]) -> None:
    boundary = Boundary("boot")
    reply = refused(boundary, MessageError("\x1b[2J\nstereoservo servo: all is well" + "x" * 60_000), "goal/\n")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert len(line) < MAX_TEXT_CHARS + 200
    assert len(reply.problems[0]) < MAX_TEXT_CHARS + 50


class Query:
    """Takes a reply, or raises."""

    def __init__(self, error: Exception | None) -> None:
        self.key_expr = "goal/anna"
        self.error = error
        self.sent: list[bytes] = []

    def __enter__(self) -> "Query":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def reply(self, key: str, payload: bytes, **_: Any) -> None:
        if self.error is not None:
            raise self.error
        self.sent.append(payload)


def test_a_reply_that_cannot_be_sent_leaves_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    replies, good = ReplyThread(), Query(None)
    for query in (Query(ValueError("no such key")), Query(RuntimeError("gone")), good):
        replies.reply(query, b"{}")
    until = time.monotonic() + 60.0
    while not good.sent and time.monotonic() < until:
        time.sleep(0.005)
    replies.close()
    assert good.sent == [b"{}"]
    assert "could not be sent: ValueError: no such key" in capsys.readouterr().err
