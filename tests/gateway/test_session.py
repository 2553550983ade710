"""zenoh configurations: what listens where, and what is refused."""

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from stereoservo.gateway.session import (
    SessionError,
    check_listen_endpoint,
    client_config,
    endpoint_of,
    gateway_config,
    open_session,
    stop_config,
)
from stereoservo.runtime.cellfile import CellFile, check_cell


def cell(**section: Any) -> CellFile:
    return check_cell(
        {
            "schema": 1,
            "cell": {"name": "demo"},
            "joints": {"driver": "fake"},
            "camera": [{"name": "left", "driver": "fake"}],
            "safety": {"limit": []},
            "zenoh": section,
        }
    )


SOCKET = Path("/tmp/x/zenoh.sock")


def test_by_default_the_router_listens_on_a_unix_socket_and_discovers_nobody() -> None:
    config = gateway_config(cell(), Path("/"), SOCKET)
    assert config["mode"] == "router"
    assert config["listen"]["endpoints"] == ["unixsock-stream//tmp/x/zenoh.sock"]
    assert config["scouting"]["multicast"]["enabled"] is False
    assert config["scouting"]["gossip"]["enabled"] is False
    assert config["transport"]["shared_memory"]["enabled"] is False


@pytest.mark.parametrize(
    "config", [gateway_config(cell(), Path("/"), SOCKET), client_config("tcp/127.0.0.1:1")]
)
def test_zenoh_knows_every_key_of_ours(config: dict[str, Any]) -> None:
    read = zenoh.Config.from_json5(json.dumps(config))
    assert json.loads(read.get_json("transport/link/tx/queue/congestion_control/drop/wait_before_drop")) == 0
    assert json.loads(read.get_json("scouting/multicast/enabled")) is False


@pytest.mark.parametrize(
    ("endpoint", "secured", "text"),
    [
        ("tcp/0.0.0.0:7447", False, "every host"),
        ("tcp/[::]:7447", False, "every host"),
        ("tcp/192.168.0.5:7447", True, "every host"),
        ("tls/0.0.0.0:7447", False, r"needs \[zenoh.tls\]"),
        ("udp/127.0.0.1:7447", False, "valid are"),
        ("nonsense", False, "valid are"),
        ("tcp/127.0.0.1", False, "valid are"),
    ],
)
def test_listening_to_the_whole_network_without_tls_is_refused(
    endpoint: str, secured: bool, text: str
) -> None:
    with pytest.raises(SessionError, match=text):
        check_listen_endpoint(endpoint, secured=secured)


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7447", "tcp/localhost:7447", "tcp/[::1]:7447", "unixsock-stream//run/a.sock"]
)
def test_local_endpoints_are_fine(endpoint: str) -> None:
    check_listen_endpoint(endpoint, secured=False)


def test_client_mode_needs_a_router_to_connect_to() -> None:
    with pytest.raises(SessionError, match=r"needs zenoh\.endpoints"):
        gateway_config(cell(mode="client"), Path("/"), SOCKET)
    config = gateway_config(cell(mode="client", endpoints=["tcp/10.0.0.1:7447"]), Path("/"), SOCKET)
    assert config["mode"] == "client"
    assert config["listen"]["endpoints"] == []


def test_a_router_with_endpoints_still_listens_on_its_own_socket_for_this_host() -> None:
    config = gateway_config(cell(endpoints=["tcp/127.0.0.1:7447"]), Path("/"), SOCKET)
    assert config["listen"]["endpoints"] == ["unixsock-stream//tmp/x/zenoh.sock", "tcp/127.0.0.1:7447"]
    assert endpoint_of(cell(endpoints=["tcp/127.0.0.1:7447"]), SOCKET) == "unixsock-stream//tmp/x/zenoh.sock"


TLS = {"root_ca_certificate": "ca.pem", "listen_private_key": "key.pem", "listen_certificate": "cert.pem"}


def test_tls_paths_are_relative_to_the_cell_file_on_either_side() -> None:
    server = gateway_config(cell(endpoints=["tls/0.0.0.0:7447"], tls=TLS), Path("/etc/cell"), SOCKET)
    assert server["transport"]["link"]["tls"]["listen_certificate"] == "/etc/cell/cert.pem"
    assert server["transport"]["link"]["tls"]["enable_mtls"] is True
    client = stop_config(cell(mode="client", endpoints=["tls/r:7447"], tls=TLS), Path("/etc/cell"), SOCKET)
    assert client["transport"]["link"]["tls"]["connect_private_key"] == "/etc/cell/key.pem"
    zenoh.Config.from_json5(json.dumps(server))
    zenoh.Config.from_json5(json.dumps(client))


@pytest.mark.process
def test_nobody_at_the_endpoint_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"cannot connect to unixsock-stream/.*none\.sock"):
        open_session(client_config(f"unixsock-stream/{tmp_path}/none.sock"))


def test_a_clients_tls_files_are_looked_for_before_it_connects(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"ca\.pem: no such file; a TLS directory holds"):
        client_config("tls/10.0.0.1:7447", tmp_path)
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (tmp_path / name).touch()
    tls = client_config("tls/10.0.0.1:7447", tmp_path)["transport"]["link"]["tls"]
    assert tls["connect_private_key"] == str(tmp_path / "key.pem")
