"""What `watch --foxglove` serves, read by a client of the protocol that is not ours."""

import json
import time
from collections.abc import Iterator
from typing import Any

import pytest

from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import EventMessage, FeaturesMessage, LoopInfo, StateMessage

pytest.importorskip("foxglove", reason="foxglove-sdk is of the extra `cell`")

STATE = StateMessage(
    0, 0, "active", "valid", 7, "law", "g", "stereo", "slow", (Reason("JOINT_LIMIT", "slow", "j1"),), "c", "b", 1e9,
    {"j1": 0.5}, {"j1": 0.1}, {"j1": 0.2}, 3.5, (), {"left": 0.1}, {"left": 4}, LoopInfo(250.0, 1, 0, 0, {}, {}),
)  # fmt: skip
FEATURES = FeaturesMessage("left", 1, 0, 0, 1e9, (7,), ((1.0, 2.0),), (0.1,))
EVENT = EventMessage(1, "b", 0, 1e9, "goal_started", "off we go")


PATIENCE_S = 60.0
"""[s] For what a busy machine does late; how long it takes is not judged."""
SCHEMAS = {
    "/joints": "foxglove.JointStates",
    "/command": "foxglove.JointStates",
    "/status": "stereoservo.CellStatus",
    "/reasons": "foxglove.Log",
    "/log": "foxglove.Log",
    "/camera/left/annotations": "foxglove.ImageAnnotations",
}


def advertised(socket: Any, count: int) -> Iterator[dict[str, Any]]:
    """The first channels that the server tells of, at least ``count``."""
    found = 0
    while found < count:
        message = socket.recv(timeout=PATIENCE_S)
        channels = json.loads(message).get("channels", []) if isinstance(message, str) else []
        found += len(channels)
        yield from channels


def test_a_cell_is_served_with_foxgloves_schemas() -> None:
    from websockets.sync.client import connect

    from stereoservo.cli.foxglove_server import FoxgloveServer

    with FoxgloveServer("c", 0) as server:
        address = f"ws://127.0.0.1:{server.port}"
        with connect(address, subprotocols=["foxglove.sdk.v1"]) as socket:  # type: ignore[list-item]
            for message in (STATE, FEATURES, EVENT):
                server.show(message)
            channels = {channel["id"]: channel for channel in advertised(socket, len(SCHEMAS))}
            assert {channel["topic"]: channel["schemaName"] for channel in channels.values()} == SCHEMAS
            wanted = [{"id": number, "channelId": number} for number in channels]
            socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            status = None
            until = time.monotonic() + PATIENCE_S
            while status is None and time.monotonic() < until:  # until the subscription has arrived there
                server.show(STATE)
                try:
                    data = socket.recv(timeout=0.2)
                except TimeoutError:
                    continue
                number = int.from_bytes(data[1:5], "little")
                if isinstance(data, bytes) and channels[number]["topic"] == "/status":
                    status = json.loads(data[13:])
            assert status is not None
            assert (status["error_px"], status["reasons"]) == (3.5, ["JOINT_LIMIT"])
