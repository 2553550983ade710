"""Interfaces (protocols) of the servo loop and the vision loop: links to the other processes, messages from the
gateway, and pacing of the cycles.

The code of the loops is the same in all cases. Between processes the links are slots and sockets (`servo_links`,
`vision`) and time is the host's; in lockstep (`lockstep`) the links are objects in memory and time is virtual.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from stereoservo.core.cycle import Event, ModelUpdate
from stereoservo.daemon.ipc_messages import ServoState
from stereoservo.messages.goals import Request
from stereoservo.messages.servo_state import LoopStatistics
from stereoservo.ports.devices import CameraObservation, Prior
from stereoservo.recording.step_messages import StepSink


class GatewayMessages(NamedTuple):
    """Messages from the gateway since the last cycle. ``heard``: whether there were any, heartbeats included."""

    heard: bool = False
    requests: tuple[Request, ...] = ()
    model_update: ModelUpdate | None = None


class ServoLinks(Protocol):
    """Links of the servo loop to the other processes. No call blocks."""

    def receive(self) -> GatewayMessages:
        """Messages from the gateway since the last call."""
        ...

    def observations(self) -> tuple[CameraObservation, ...]:
        """The newest observation of each camera, unless it was returned before."""
        ...

    def stop_raised(self) -> bool:
        """Whether the stop was raised since the last call; acknowledges it."""
        ...

    def step_recorder(self) -> StepSink | None:
        """The connected recorder; a new object for each connection."""
        ...

    def publish_prior(self, prior: Prior) -> None:
        """Send the expected marker positions to a camera's vision loop."""
        ...

    def publish_state(self, state: ServoState) -> None:
        """Replace the state that the gateway reads."""
        ...

    def publish_events(self, events: tuple[Event, ...]) -> None:
        """Queue events, whose numbers ascend, and send the queue; none is lost while the gateway restarts."""
        ...


class VisionLinks(Protocol):
    """Links of one camera's vision loop to the servo loop. No call blocks."""

    def newest_prior(self) -> Prior | None:
        """The newest prior of this camera, of any age; None before the first."""
        ...

    def publish_observation(self, observation: CameraObservation) -> None:
        """Replace the observation that the servo loop reads."""
        ...


class Pacing(Protocol):
    """Source of the servo loop's cycles: a fixed time grid (`pacing.ClockPacing`), or an arm that sets the cycle."""

    def wait(self) -> int:
        """Block until the next cycle is due; returns the time [ns] of waking."""
        ...

    def statistics(self) -> LoopStatistics:
        """Counts and quantiles of the cycles so far."""
        ...
