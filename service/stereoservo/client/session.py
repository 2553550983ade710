"""zenoh sessions: their configuration as a client, opening, and closing within a time limit.

Bounded, local, without discovery, and never blocking.
"""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from stereoservo.client.errors import ClientError
from stereoservo.messages.addresses import Address

MAX_MESSAGE_BYTES = 1 << 18
MAX_SESSIONS = 64
CLOSE_TIMEOUT_S = 2.0


class SessionError(ClientError):
    """A zenoh session cannot be opened; names the endpoint and the cause."""


def base_config() -> dict[str, Any]:
    """Settings common to every session: no discovery, no shared memory, bounded queues and messages."""
    return {
        # Discovery would announce the arm to every host of the network and connect peers that no access rule
        # covers.
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},  # leaves segments behind and has watchdog drops
            "unicast": {"max_sessions": MAX_SESSIONS, "accept_timeout": 1000},
            "link": {
                "tx": {
                    "lease": 2000,
                    # A subscriber that hangs must lose its messages, and not delay this process.
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


def client_mode(endpoints: list[str]) -> dict[str, Any]:
    """Settings of a session that connects to a router at ``endpoints`` and does not listen."""
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
    """Settings of a client of the daemon at ``endpoint``; ``tls``: directory with ``ca.pem``, ``cert.pem`` and
    ``key.pem``.

    Raises SessionError for a missing file.
    """
    config = base_config()
    if tls is not None:
        files = {
            "root_ca_certificate": tls / "ca.pem",
            "connect_certificate": tls / "cert.pem",
            "connect_private_key": tls / "key.pem",
        }
        for path in files.values():
            if not path.is_file():
                raise SessionError(f"{path}: no such file; a TLS directory holds ca.pem, cert.pem and key.pem")
        config["transport"]["link"]["tls"] = {key: str(path) for key, path in files.items()} | {"enable_mtls": True}
    return config | client_mode([endpoint])


def open_session(config: dict[str, Any]) -> Any:
    """Open a session. Raises SessionError."""
    zenoh.init_log_from_env_or("error")
    endpoints = [Address(each) for each in config["listen"]["endpoints"] or config["connect"]["endpoints"]]
    where = ", ".join(endpoints)
    try:
        return zenoh.open(zenoh.Config.from_json5(msgspec.json.encode(config).decode()))
    except zenoh.ZError as error:
        verb = "listen on" if config["mode"] == "router" else "connect to"
        cause = re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error))  # zenoh's own source line
        for endpoint in endpoints:
            cause = endpoint.hidden_in(cause)
        raise SessionError(f"cannot {verb} {where}: {cause}{_certificate_hint(config, where)}") from error


def _certificate_hint(config: dict[str, Any], where: str) -> str:
    """Hint for a failed TLS connection of a client: zenoh reports a refused certificate as a time-out."""
    if config["mode"] != "client" or "tls/" not in where:
        return ""
    tls = config["transport"]["link"].get("tls", {})
    if "connect_certificate" not in tls:
        return " This client has no certificate: STEREOSERVO_TLS_DIR names the directory with ca.pem, cert.pem, key.pem"
    return (
        f" Where the daemon listens there, a certificate was refused: {tls['connect_certificate']} must be in date, "
        "X.509 version 3 (`openssl x509 -req` makes one with -extfile only) and signed by the daemon's authority; the "
        f"daemon's must be signed by {tls['root_ca_certificate']} and hold this address"
    )


def close_session(session: Any, declared: list[Any]) -> bool:
    """Undeclare, then close, in another thread: a hung client would block ``close`` for 10 s.

    Returns whether this was completed within `CLOSE_TIMEOUT_S`; the process may end without it.
    """

    def work() -> None:
        for entity in declared:
            entity.undeclare()
        session.close()

    thread = threading.Thread(target=work, name="zenoh-close", daemon=True)
    thread.start()
    thread.join(CLOSE_TIMEOUT_S)
    return not thread.is_alive()
