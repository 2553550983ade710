"""State of a Linux CAN network interface (SocketCAN)."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
from typing import Any

import can
import msgspec

RECEIVE_BUFFER = 1 << 20
"""[bytes] of the socket; the default holds some 300 frames, the kernel drops what comes beyond (python-can #657)."""
_SO_RCVBUFFORCE = 33


class SocketcanState(msgspec.Struct, frozen=True):
    """State as `ip -details link show` reports it; None: not reported (a virtual interface has no bit rate)."""

    kind: str
    up: bool
    state: str | None = None
    bitrate: int | None = None
    restart_ms: int | None = None
    queue_length: int | None = None


def read_state(channel: str) -> SocketcanState | None:
    """State of ``channel``; None where `ip` is missing or does not know the interface."""
    command = shutil.which("ip") or shutil.which("ip", path="/usr/sbin:/sbin")
    if command is None:
        return None
    try:
        answer = subprocess.run(
            [command, "-json", "-details", "link", "show", "dev", channel],
            capture_output=True,
            timeout=2.0,
            check=False,
        )
        links = json.loads(answer.stdout or b"[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    return state_of(links[0]) if answer.returncode == 0 and links else None


def state_of(link: dict[str, Any]) -> SocketcanState:
    """State from ``link``: one element of what `ip -json -details link show` prints."""
    about = link.get("linkinfo", {})
    facts = about.get("info_data", {})
    return SocketcanState(
        kind=about.get("info_kind", ""),
        up="UP" in link.get("flags", ()),
        state=facts.get("state"),
        bitrate=facts.get("bittiming", {}).get("bitrate"),
        restart_ms=facts.get("restart_ms", 0) if about.get("info_kind") == "can" else None,
        queue_length=link.get("txqlen"),
    )


def objection(state: SocketcanState, channel: str, bitrate: int) -> str | None:
    """Text: why ``channel`` cannot be used at ``bitrate`` [bit/s], with the remedy; None where it can."""
    if state.kind not in ("can", "vcan", "vxcan", "slcan"):
        return f"it is a network interface of kind {state.kind or 'unknown'!r}, not of CAN"
    remedy = f"ip link set {channel} down; ip link set {channel} up type can bitrate {bitrate} restart-ms 0"
    if not state.up:
        return f"the interface is down. Cure: {remedy}, or the units in deploy/can"
    if state.bitrate is not None and state.bitrate != bitrate:
        return f"it runs at {state.bitrate} bit/s, the cell says {bitrate}. Cure: {remedy}"
    if state.state == "BUS-OFF":
        return f"its controller is in bus-off. Find the cause (cable, terminators, bit rate), then: {remedy}"
    return None


def enlarge_receive_buffer(bus: can.BusABC) -> int:
    """Enlarge the receive buffer for bursts while the receiving thread is delayed; returns the size granted
    [bytes].
    """
    channel: socket.socket = bus.socket  # type: ignore[attr-defined]
    try:
        channel.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
    except PermissionError:
        # Without CAP_NET_ADMIN, up to net.core.rmem_max.
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    return channel.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
