"""Leases of a page's motions, over sessions that come and go."""

import pytest
import zenoh

from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import EventMessage
from stereoservo.web.rights import Leases


class Session:
    """Notes what is renewed over it; a closed one fails as zenoh's do."""

    def __init__(self) -> None:
        self.renewed: list[str] = []
        self.closed = False

    def renew(self, goal_id: str) -> None:
        if self.closed:
            raise zenoh.ZError("session closed")
        self.renewed.append(goal_id)


def event(kind: str, motion: str, *codes: str) -> EventMessage:
    reasons = tuple(Reason(code, "info", motion, None, None, "", "") for code in codes)
    return EventMessage(1, "boot", 0, 0.0, kind, id=motion, reasons=reasons)


def test_a_lease_outlives_the_session_over_which_its_goal_was_sent() -> None:
    sessions: list[Session | None] = [Session()]
    leases = Leases(lambda: sessions[-1])
    with leases.held("goal"):
        leases.renew()
        assert sessions[0].renewed == [], "it is not accepted yet, and a renewal would be refused"  # type: ignore[union-attr]
    leases.renew()
    sessions[0].closed = True  # type: ignore[union-attr]
    leases.renew()
    sessions.append(None)
    leases.renew()
    sessions.append(after := Session())
    leases.renew()
    assert sessions[0].renewed == after.renewed == ["goal"]  # type: ignore[union-attr]
    leases.end()
    leases.renew()
    assert after.renewed == ["goal"]


def test_what_ended_is_renewed_no_more_even_if_its_end_is_reported_first_or_never() -> None:
    leases = Leases(lambda: None)
    with leases.held("quick"):
        leases.on_event(event("goal_reached", "quick"))
    with pytest.raises(OSError, match="refused"), leases.held("refused"):
        raise OSError("refused")
    with leases.held("unheard"):
        leases.on_event(event("goal_refused", "unheard", "NO_SUCH_GOAL"))
    with leases.held("lasting"):
        pass
    assert leases.renewed == ("unheard", "lasting"), "what is asked for now is not known yet"
    leases.on_event(event("goal_refused", "unheard", "NO_SUCH_GOAL"))
    leases.on_event(event("goal_refused", "lasting", "OUT_OF_VIEW"))
    leases.on_event(event("goal_reached", "another"))
    assert leases.renewed == ("lasting",)
