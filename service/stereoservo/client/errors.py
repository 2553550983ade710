"""Exceptions of the goal client; each carries its data."""

from __future__ import annotations

from stereoservo.messages.wire import EventMessage, MessageError, Reply


class ClientError(Exception):
    """Base of all errors of the client."""


class NoReplyError(ClientError):
    """No reply: the daemon does not run, hangs, or does not authorise this client."""

    def __init__(self, key: str, timeout_s: float, tries: int = 1) -> None:
        within = f"within {timeout_s:g} s" if tries == 1 else f"in {tries} tries of {timeout_s:g} s"
        super().__init__(
            f"no reply on {key} {within}: the daemon is gone, hangs, or refuses this client; or this computer is "
            "overloaded (`uptime`)"
        )
        self.key = key
        self.timeout_s = timeout_s


class InvalidReplyError(ClientError):
    """A message on ``key`` cannot be decoded: it is of another version or sender."""

    def __init__(self, key: str, error: MessageError) -> None:
        super().__init__(
            f"what came on {key} is not of this version's daemon: {error}; compare `stereoservo --version` on both "
            "sides, and see that nobody else answers there"
        )
        self.key = key


class RefusedError(ClientError):
    """The daemon refused; ``reply`` has the reasons."""

    def __init__(self, what: str, reply: Reply) -> None:
        why = "; ".join(
            reply.problems or tuple(reason.hint for reason in reply.reasons if reason.hint != reply.message)
        )
        super().__init__(f"{what} refused: {reply.message}" + (f": {why}" if why else ""))
        self.reply = reply


class FailedError(ClientError):
    """An accepted command failed; ``event`` has the cause."""

    def __init__(self, what: str, event: EventMessage) -> None:
        super().__init__(f"{what}: {event.kind.replace('_', ' ')}: {event.message}")
        self.event = event

    @property
    def code(self) -> str:
        """Code of the cause: the event's ``name`` (the code of a fit; in a warning the name of a goal), else the code
        of its first reason, else ``failed``.
        """
        name = "" if self.event.kind == "warning" else self.event.name
        return name or next((reason.code for reason in self.event.reasons), "failed")


class TimedOutError(ClientError):
    """An event or state did not arrive in time."""


class DaemonLostError(ClientError):
    """The daemon ended, or was replaced by another one, while this client waited."""
