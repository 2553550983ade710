"""Zenoh configuration of the gateway's sessions; endpoints open to the network require TLS."""

from __future__ import annotations

import ipaddress
import os
import re
from pathlib import Path
from typing import Any

from stereoservo.client.session import SessionError, base_config, client_config, client_mode
from stereoservo.messages.addresses import Address
from stereoservo.messages.cell_file import CellFile, TlsSection
from stereoservo.messages.directories import check_socket_path

_NETWORK_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls)/(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):[0-9]{1,5}")

RECONNECT = {"period_init_ms": 100, "period_max_ms": 500}

RUNTIME = "(net: (worker_threads: 4))"
"""Number of zenoh's threads that accept connections (default: one). With one, strangers who repeatedly connect by TCP
occupy it, and no client of this host can connect.
"""


def prepare_runtime() -> None:
    """Set the number of threads of this process's zenoh, before the first session; environment variables take
    precedence.
    """
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)


def endpoint_of(cell: CellFile, socket: Path) -> str:
    """The endpoint for clients of this host: the unix socket, or the site's router."""
    if cell.zenoh.mode == "client" and cell.zenoh.endpoints:
        return cell.zenoh.endpoints[0]
    return f"unixsock-stream/{socket}"


def gateway_config(cell: CellFile, cell_dir: Path, socket: Path) -> dict[str, Any]:
    """The gateway's main session: the router itself, or a client of a site's router.

    A router always listens on the unix socket as well, which the gateway's second session and this host's clients use.
    Raises SessionError if an endpoint reaches beyond this host without TLS on both sides.
    """
    section = cell.zenoh
    for endpoint in section.endpoints:
        check_endpoint(endpoint, section.tls)
    config = base_config()
    client = section.mode == "client"
    if section.tls is not None:
        side = "connect" if client else "listen"
        config["transport"]["link"]["tls"] = {
            "root_ca_certificate": str(cell_dir / section.tls.root_ca_certificate),
            f"{side}_private_key": str(cell_dir / section.tls.listen_private_key),
            f"{side}_certificate": str(cell_dir / section.tls.listen_certificate),
            "enable_mtls": section.tls.enable_mtls,
        }
    if client:
        if not section.endpoints:
            raise SessionError(
                'zenoh.mode = "client" needs zenoh.endpoints: the router to join, e.g. ["tls/router:7447"]'
            )
        return config | client_mode(list(section.endpoints))
    check_socket_path(socket)
    endpoints = [f"unixsock-stream/{socket}", *section.endpoints]
    return config | {"mode": "router", "listen": {"endpoints": endpoints}, "connect": {"endpoints": []}}


def split_listeners(config: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The gateway's main session, and the router that listens for it on endpoints other than the cell's own socket;
    None if there are no others or the session is a client.

    The limits of a zenoh router (sessions, sockets that are being accepted) are common to all its endpoints. With a
    separate router, strangers on the network, however many, can block only other clients on the network.
    """
    own, others = config["listen"]["endpoints"][:1], config["listen"]["endpoints"][1:]
    if not others:
        return config, None
    connect = {"endpoints": own, "timeout_ms": 2000, "exit_on_failure": True, "retry": RECONNECT}
    local = config | {"listen": {"endpoints": own}}
    return local, config | {"listen": {"endpoints": others}, "connect": connect}


def stop_config(cell: CellFile, cell_dir: Path, socket: Path) -> dict[str, Any]:
    """The session for stop and enable: a client of the gateway's own router, or of the site's."""
    if cell.zenoh.mode == "client":
        return gateway_config(cell, cell_dir, socket)
    return client_config(endpoint_of(cell, socket))


def check_endpoint(endpoint: str, tls: TlsSection | None) -> None:
    """Check an endpoint that the daemon listens on or connects to: beyond this host, both sides need a certificate.

    Zenoh parameters after the address (``?…``, ``#…``) are refused: they override the session's TLS options. Raises
    SessionError.
    """
    if endpoint.startswith("unixsock-stream/") and not set(endpoint) & set("?#"):
        return
    match = _NETWORK_ENDPOINT.fullmatch(endpoint)
    if match is None:
        raise SessionError(
            f"zenoh.endpoints: {Address(endpoint)!r}; valid are unixsock-stream/PATH, tcp/127.0.0.1:PORT, or "
            "tls/HOST:PORT with [zenoh.tls], without ? or # parameters"
        )
    local = is_loopback(match["host"])
    if match["protocol"] == "tcp":
        if not local:
            raise SessionError(
                f"zenoh.endpoints: {Address(endpoint)!r}: without TLS every host on the way could command the arm; "
                "use tcp on 127.0.0.1, [::1] or localhost, or tls/HOST:PORT with [zenoh.tls]"
            )
    elif tls is None:
        raise SessionError(f"zenoh.endpoints: {Address(endpoint)!r} needs [zenoh.tls]")
    elif not tls.enable_mtls and not local:
        raise SessionError(
            f"zenoh.tls.enable_mtls = false with zenoh.endpoints {Address(endpoint)!r}: every host could command the "
            "arm without a certificate; leave enable_mtls out, or use tls on 127.0.0.1, [::1] or localhost"
        )


def is_loopback(host: str) -> bool:
    """Whether ``host`` is certainly this host: ``localhost``, 127.0.0.0/8 or [::1]. Other names are not resolved."""
    if host.startswith("["):
        return host == "[::1]"
    try:
        return host.lower() == "localhost" or ipaddress.IPv4Address(host).is_loopback
    except ipaddress.AddressValueError:  # a name, or not in four decimal numbers
        return False
