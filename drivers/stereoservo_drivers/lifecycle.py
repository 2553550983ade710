"""Lifecycle of a driver: the calls that each state allows."""

from __future__ import annotations

from enum import StrEnum

from stereoservo.ports.devices import DriverError


class LifecycleState(StrEnum):
    """State of a driver. From CLOSED a camera driver can be configured again, a joint driver cannot."""

    CREATED = "created"
    CONFIGURED = "configured"
    ACTIVE = "active"
    CLOSED = "closed"


_CODES = {
    LifecycleState.CREATED: "not_configured",
    LifecycleState.CONFIGURED: "not_active",
    LifecycleState.CLOSED: "closed",
}


class DriverLifecycle:
    """State of one driver. ``what`` names the driver in messages."""

    def __init__(self, what: str) -> None:
        self.what = what
        self.state = LifecycleState.CREATED

    def require(self, call: str, *allowed: LifecycleState) -> None:
        """Raise DriverError (``not_configured``, ``not_active``, ``closed``, ``state``) unless in an
        allowed state.
        """
        if self.state not in allowed:
            names = " or ".join(state.value for state in allowed)
            raise DriverError(
                _CODES.get(self.state, "state"),
                f"{self.what}: {call} while {self.state.value}; allowed while {names}",
                state=self.state.value,
                call=call,
            )
