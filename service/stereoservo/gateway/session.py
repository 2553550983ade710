"""zenoh sessions with the habits that were measured to matter: bounded, local, no discovery, never
blocking.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import zenoh

from stereoservo.runtime.cellfile import CellFile
from stereoservo.runtime.directories import check_socket_path

MAX_MESSAGE_BYTES = 1 << 18
MAX_SESSIONS = 64
CLOSE_TIMEOUT_S = 2.0


class SessionError(Exception):
    """A zenoh session cannot be opened; names the endpoint and the cause."""


def endpoint_of(cell: CellFile, socket: Path) -> str:
    """Where clients of this host reach the cell: the unix socket, or the site's router."""
    if cell.zenoh.mode == "client" and cell.zenoh.endpoints:
        return cell.zenoh.endpoints[0]
    return f"unixsock-stream/{socket}"


def _common() -> dict[str, Any]:
    return {
        # Discovery would announce the arm to every host of the network and bring in peers that no access rule
        # sees.
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},  # leaves segments behind and has watchdog drops
            "unicast": {"max_sessions": MAX_SESSIONS, "accept_timeout": 1000},
            "link": {
                "tx": {
                    "lease": 2000,
                    # A subscriber that hangs must cost its messages, not this process's time.
                    "queue": {
                        "congestion_control": {
                            "drop": {"wait_before_drop": 0},
                            "block": {"wait_before_close": 20000},
                        }
                    },
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }


def gateway_config(cell: CellFile, cell_dir: Path, socket: Path) -> dict[str, Any]:
    """The gateway's main session: the router itself, or a client of a site's router.

    A router listens on the unix socket in any case: the gateway's own second session and this host's clients use it.
    Raises SessionError: more than this host may connect, and no TLS is configured.
    """
    section = cell.zenoh
    config = _common()
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
        return config | _client(list(section.endpoints))
    check_socket_path(socket)
    for endpoint in section.endpoints:
        check_listen_endpoint(endpoint, secured=section.tls is not None)
    endpoints = [f"unixsock-stream/{socket}", *section.endpoints]
    return config | {"mode": "router", "listen": {"endpoints": endpoints}, "connect": {"endpoints": []}}


def stop_config(cell: CellFile, cell_dir: Path, socket: Path) -> dict[str, Any]:
    """The session for stop and enable: a client of the gateway's own router, or of the site's."""
    if cell.zenoh.mode == "client":
        return gateway_config(cell, cell_dir, socket)
    return client_config(endpoint_of(cell, socket))


def check_listen_endpoint(endpoint: str, *, secured: bool) -> None:
    """Refuse to listen where the whole network could command the arm. Raises SessionError."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return
    host = address.rpartition(":")[0].strip("[]")
    local = host in ("127.0.0.1", "::1", "localhost")
    if protocol not in ("tcp", "tls") or not address.rpartition(":")[2].isdigit():
        raise SessionError(
            f"zenoh.endpoints: {endpoint!r}; valid are unixsock-stream/PATH, tcp/127.0.0.1:PORT, or "
            f"tls/HOST:PORT with [zenoh.tls]"
        )
    if protocol == "tcp" and not local:
        raise SessionError(
            f"zenoh.endpoints: {endpoint!r} would let every host that reaches it command the arm; "
            "listen on 127.0.0.1, or use tls/HOST:PORT with [zenoh.tls]"
        )
    if protocol == "tls" and not secured:
        raise SessionError(f"zenoh.endpoints: {endpoint!r} needs [zenoh.tls]")


def _client(endpoints: list[str]) -> dict[str, Any]:
    return {
        "mode": "client",
        "listen": {"endpoints": []},
        "connect": {
            "endpoints": endpoints,
            "timeout_ms": 2000,
            "exit_on_failure": True,
            "retry": {"period_init_ms": 100, "period_max_ms": 500},
        },
    }


def client_config(endpoint: str, tls: Path | None = None) -> dict[str, Any]:
    """A client of the daemon at ``endpoint``; ``tls``: directory with ``ca.pem``, ``cert.pem`` and ``key.pem``.

    Raises SessionError for a file that is missing.
    """
    config = _common()
    if tls is not None:
        files = {
            "root_ca_certificate": tls / "ca.pem",
            "connect_certificate": tls / "cert.pem",
            "connect_private_key": tls / "key.pem",
        }
        for path in files.values():
            if not path.is_file():
                raise SessionError(
                    f"{path}: no such file; a TLS directory holds ca.pem, cert.pem and key.pem"
                )
        config["transport"]["link"]["tls"] = {key: str(path) for key, path in files.items()} | {
            "enable_mtls": True
        }
    return config | _client([endpoint])


def open_session(config: dict[str, Any]) -> Any:
    """Open a session. Raises SessionError."""
    zenoh.init_log_from_env_or("error")
    where = ", ".join(config["listen"]["endpoints"] or config["connect"]["endpoints"])
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        verb = "listen on" if config["mode"] == "router" else "connect to"
        raise SessionError(f"cannot {verb} {where}: {error}") from error


def close_session(session: Any, declared: list[Any]) -> bool:
    """Undeclare, then close, in a side thread with a time limit (a hung client would hold ``close`` for 10
    s).

    False where the limit passed; the process may then end without it.
    """

    def work() -> None:
        for entity in declared:
            entity.undeclare()
        session.close()

    thread = threading.Thread(target=work, name="zenoh-close", daemon=True)
    thread.start()
    thread.join(CLOSE_TIMEOUT_S)
    return not thread.is_alive()
