"""What can go wrong for a client; each error carries its data."""

from __future__ import annotations

from stereoservo.gateway.messages import EventMessage, Reply


class ClientError(Exception):
    """Something that a client asked for did not happen."""


class NoReplyError(ClientError):
    """Nobody answered: the daemon is gone, hangs, or does not let this client ask. Means refused."""

    def __init__(self, key: str, timeout_s: float) -> None:
        super().__init__(
            f"no reply on {key} within {timeout_s:g} s: the daemon is gone, hangs, or refuses this client"
        )
        self.key = key
        self.timeout_s = timeout_s


class RefusedError(ClientError):
    """The daemon refused; ``reply`` says why."""

    def __init__(self, what: str, reply: Reply) -> None:
        why = "; ".join(
            reply.problems or tuple(reason.hint for reason in reply.reasons if reason.hint != reply.message)
        )
        super().__init__(f"{what} refused: {reply.message}" + (f": {why}" if why else ""))
        self.reply = reply


class FailedError(ClientError):
    """What was accepted ended badly; ``event`` says how."""

    def __init__(self, what: str, event: EventMessage) -> None:
        super().__init__(f"{what}: {event.kind.replace('_', ' ')}: {event.message}")
        self.event = event

    @property
    def code(self) -> str:
        """Its cause's own: the event's ``name`` (a fit's code), else that of its first reason, else ``failed``."""
        return self.event.name or next((reason.code for reason in self.event.reasons), "failed")


class TimedOutError(ClientError):
    """What was waited for did not happen in time."""


class DaemonLostError(ClientError):
    """The daemon went away, or another one took its place, while this client waited."""
