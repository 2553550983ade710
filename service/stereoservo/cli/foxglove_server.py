"""A live cell for Foxglove: a server on this host that the program connects to (``ws://localhost:8765``)."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

import foxglove
import numpy as np

from stereoservo.messages.wire import EventMessage, FeaturesMessage, StateMessage
from stereoservo.recording.foxglove_channels import (
    Published,
    cell_status,
    joints,
    log,
    markers_seen,
    reasons,
    schema_of,
)

HOST = "127.0.0.1"


class FoxgloveServer:
    """Serves the given messages on a ``port`` of this host (0: any). Raises OSError if the port is in use."""

    def __init__(self, cell: str, port: int) -> None:
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name=cell, host=HOST, port=port, context=self._context)
        except Exception as error:  # the library's own kinds of error
            raise OSError(f"no Foxglove server on port {port} ({error}); give another with --port") from error
        self.port = int(self._server.port)
        self._channels: dict[str, Any] = {}
        self._codes: tuple[str, ...] | None = None

    def show(self, message: StateMessage | EventMessage | FeaturesMessage) -> None:
        """Send a message of the cell to all connected clients."""
        for published in self._published(message):
            self._channel(published).log(published.encode(), log_time=published.t_ns)

    def _published(self, message: StateMessage | EventMessage | FeaturesMessage) -> list[Published]:
        t_ns = int(message.t_wall * 1e9)
        if isinstance(message, EventMessage):
            return [log(t_ns, message.kind, message.message, message.origin)]
        if isinstance(message, FeaturesMessage):
            return [markers_seen(message.camera, t_ns, np.array(message.pixels).reshape(-1, 2))]
        found = state_channels(message, t_ns)
        codes = tuple(reason.code for reason in message.reasons)
        if codes != self._codes:
            self._codes = codes
            found.append(reasons(t_ns, message.reasons))
        return found

    def _channel(self, published: Published) -> Any:
        if published.topic not in self._channels:
            schema = schema_of(published.content)
            self._channels[published.topic] = foxglove.Channel(
                published.topic,
                schema=foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
                message_encoding=schema.message,
                context=self._context,
            )
        return self._channels[published.topic]

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def state_channels(state: StateMessage, t_ns: int) -> list[Published]:
    """Joints, command and status of a live cell."""
    names = list(state.joints)
    velocities = [state.velocities[name] for name in names] if len(state.velocities) == len(names) else None
    efforts = [state.efforts[name] for name in names] if len(state.efforts) == len(names) else None
    return [
        joints("/joints", t_ns, names, positions=list(state.joints.values()), velocities=velocities, efforts=efforts),
        joints("/command", t_ns, list(state.command), velocities=list(state.command.values())),
        Published("/status", t_ns, cell_status(state)),
    ]
