"""zenoh configurations: what listens where, and what is refused."""

import contextlib
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh

from stereoservo.client.session import (
    MAX_SESSIONS,
    SessionError,
    client_config,
    close_session,
    open_session,
)
from stereoservo.gateway.zenoh_config import endpoint_of, gateway_config, split_listeners, stop_config
from stereoservo.messages.cell_file import CellFile, CellFileError, check_cell
from stereoservo_sim.benchmarks.service_bench import CONNECTS


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
TLS = {"root_ca_certificate": "ca.pem", "listen_private_key": "key.pem", "listen_certificate": "cert.pem"}


def test_by_default_the_router_listens_on_a_unix_socket_and_discovers_nobody() -> None:
    config = gateway_config(cell(), Path("/"), SOCKET)
    assert config["mode"] == "router"
    assert config["listen"]["endpoints"] == ["unixsock-stream//tmp/x/zenoh.sock"]
    assert config["scouting"]["multicast"]["enabled"] is False
    assert config["scouting"]["gossip"]["enabled"] is False
    assert config["transport"]["shared_memory"]["enabled"] is False


@pytest.mark.parametrize("config", [gateway_config(cell(), Path("/"), SOCKET), client_config("tcp/127.0.0.1:1")])
def test_zenoh_knows_every_key_of_ours(config: dict[str, Any]) -> None:
    read = zenoh.Config.from_json5(json.dumps(config))
    assert json.loads(read.get_json("transport/link/tx/queue/congestion_control/drop/wait_before_drop")) == 0
    assert json.loads(read.get_json("scouting/multicast/enabled")) is False


def configured(mode: str, endpoint: str, tls: dict[str, Any] | None) -> dict[str, Any]:
    """The gateway's configuration of a cell with one endpoint, to listen on or to connect to."""
    section = {"mode": mode, "endpoints": [endpoint]} | ({} if tls is None else {"tls": tls})
    return gateway_config(cell(**section), Path("/"), SOCKET)


@pytest.mark.parametrize("mode", ["router", "client"])
@pytest.mark.parametrize(
    ("endpoint", "tls", "text"),
    [
        ("tcp/0.0.0.0:7447", None, "every host"),
        ("tcp/[::]:7447", None, "every host"),
        ("tcp/10.0.0.1:7447", None, "every host"),
        ("tcp/192.168.0.5:7447", TLS, "every host"),
        ("tcp/router:7447", TLS, "every host"),
        ("tcp/127.0.0.1.evil.org:7447", None, "every host"),
        ("tcp/localhost.evil:7447", None, "every host"),
        ("tcp/128.0.0.1:7447", None, "every host"),
        ("tcp/[::ffff:10.0.0.1]:7447", None, "every host"),
        ("tls/0.0.0.0:7447", None, r"needs \[zenoh.tls\]"),
        ("tls/router:7447", None, r"needs \[zenoh.tls\]"),
        ("udp/127.0.0.1:7447", None, "valid are"),
        ("quic/127.0.0.1:7447", TLS, "valid are"),
        ("nonsense", None, "valid are"),
        ("tcp/127.0.0.1", None, "valid are"),
        ("tcp/evil@127.0.0.1:7447", None, "valid are"),
        ("tls/router:7447#enable_mtls=false", TLS, "valid are .* without . or # parameters"),
        ("tls/0.0.0.0:7447#enable_mtls=false;x=:1", TLS, "valid are"),
        ("unixsock-stream//run/a.sock#x=1", None, "valid are"),
        ("tls/0.0.0.0:7447", TLS | {"enable_mtls": False}, r"zenoh\.tls\.enable_mtls = false"),
        ("tls/router:7447", TLS | {"enable_mtls": False}, r"zenoh\.tls\.enable_mtls = false"),
        ("tls/localhost.evil:7447", TLS | {"enable_mtls": False}, r"zenoh\.tls\.enable_mtls = false"),
    ],
)
def test_beyond_this_host_both_sides_show_certificates(
    mode: str, endpoint: str, tls: dict[str, Any] | None, text: str
) -> None:
    with pytest.raises(SessionError, match=text):
        configured(mode, endpoint, tls)


@pytest.mark.parametrize("mode", ["router", "client"])
@pytest.mark.parametrize(
    ("endpoint", "tls"),
    [
        ("tcp/127.0.0.1:7447", None),
        ("tcp/127.8.0.1:7447", None),
        ("tcp/localhost:7447", None),
        ("tcp/[::1]:7447", None),
        ("unixsock-stream//run/a.sock", None),
        ("tls/router.site-a:7447", TLS),
        ("tls/[fd00::1]:7447", TLS),
        ("tls/localhost:7447", TLS | {"enable_mtls": False}),
    ],
)
def test_this_host_and_mutual_tls_are_fine(mode: str, endpoint: str, tls: dict[str, Any] | None) -> None:
    config = configured(mode, endpoint, tls)
    assert endpoint in config["listen" if mode == "router" else "connect"]["endpoints"]


@pytest.mark.parametrize("word", ["false", 0, "no"])
def test_mutual_tls_is_switched_off_by_one_word_only(word: object) -> None:
    with pytest.raises(CellFileError, match="enable_mtls"):
        configured("router", "tls/0.0.0.0:7447", TLS | {"enable_mtls": word})


def test_client_mode_needs_a_router_to_connect_to() -> None:
    with pytest.raises(SessionError, match=r"needs zenoh\.endpoints"):
        gateway_config(cell(mode="client"), Path("/"), SOCKET)
    config = gateway_config(cell(mode="client", endpoints=["tls/10.0.0.1:7447"], tls=TLS), Path("/"), SOCKET)
    assert config["mode"] == "client"
    assert config["listen"]["endpoints"] == []


def test_a_router_with_endpoints_still_listens_on_its_own_socket_for_this_host() -> None:
    config = gateway_config(cell(endpoints=["tcp/127.0.0.1:7447"]), Path("/"), SOCKET)
    assert config["listen"]["endpoints"] == ["unixsock-stream//tmp/x/zenoh.sock", "tcp/127.0.0.1:7447"]
    assert endpoint_of(cell(endpoints=["tcp/127.0.0.1:7447"]), SOCKET) == "unixsock-stream//tmp/x/zenoh.sock"


def test_what_is_open_to_others_is_a_router_of_its_own() -> None:
    endpoints = ["tcp/127.0.0.1:7447", "tls/0.0.0.0:7448"]
    local, network = split_listeners(gateway_config(cell(endpoints=endpoints, tls=TLS), Path("/"), SOCKET))
    assert local["listen"]["endpoints"] == ["unixsock-stream//tmp/x/zenoh.sock"]
    assert local["connect"]["endpoints"] == []
    assert network is not None
    assert network["listen"]["endpoints"] == endpoints
    assert network["connect"]["endpoints"] == ["unixsock-stream//tmp/x/zenoh.sock"]
    assert network["transport"]["unicast"]["max_sessions"] == local["transport"]["unicast"]["max_sessions"]
    for config in (local, network):
        zenoh.Config.from_json5(json.dumps(config))
    for section in ({}, {"mode": "client", "endpoints": endpoints[:1]}):
        config = gateway_config(cell(**section), Path("/"), SOCKET)
        assert split_listeners(config) == (config, None)


def unused_port() -> int:
    """A TCP port of this host that nobody listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.mark.process
def test_a_peer_that_takes_all_sessions_of_the_network_locks_out_nobody_on_this_host(tmp_path: Path) -> None:
    own, endpoint = f"unixsock-stream/{tmp_path}/z", f"tcp/127.0.0.1:{unused_port()}"
    both = split_listeners(gateway_config(cell(endpoints=[endpoint]), Path("/"), tmp_path / "z"))
    sessions = [open_session(config) for config in both if config is not None]
    answers = sessions[0].declare_queryable("it", zenoh.handlers.Callback(lambda query: query.reply("it", b"yes")))

    def answered(where: str) -> bool:
        try:
            client = open_session(client_config(where))
        except SessionError:
            return False
        sessions.append(client)
        return any(reply.ok is not None for reply in client.get("it", timeout=30.0))

    try:
        while not answered(endpoint):  # through both routers, once they know each other
            close_session(sessions.pop(), [])
        taken = [answered(endpoint) for _ in range(MAX_SESSIONS + 5)]
        assert not taken[-1]
        assert answered(own)
    finally:
        answers.undeclare()
        for session in reversed(sessions):
            close_session(session, [])


ROUTERS = """
import json, sys
from stereoservo.client.session import open_session
from stereoservo.gateway.zenoh_config import prepare_runtime
prepare_runtime()
sessions = [open_session(config) for config in json.loads(sys.argv[1])]
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.process
def test_connects_of_strangers_lock_out_nobody_on_this_host(tmp_path: Path) -> None:
    """200 TCP sockets that say nothing, and are opened again as soon as the router gives them up."""
    port = unused_port()
    both = split_listeners(gateway_config(cell(endpoints=[f"tcp/127.0.0.1:{port}"]), Path("/"), tmp_path / "z"))
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with contextlib.ExitStack() as ended:
        for program, *arguments in ((ROUTERS, json.dumps(both)), (CONNECTS, str(port), "200")):
            child = ended.enter_context(subprocess.Popen([sys.executable, "-c", program, *arguments], **pipes))
            ended.callback(child.kill)
            assert child.stdout.readline()
        time.sleep(0.4)
        for _ in range(5):
            close_session(open_session(client_config(f"unixsock-stream/{tmp_path}/z")), [])
            time.sleep(0.2)


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


@pytest.mark.process
def test_a_tls_connection_that_fails_names_what_certificates_must_be(tmp_path: Path) -> None:
    endpoint = "tls/127.0.0.1:1"  # nobody: a certificate that is refused looks the same
    with pytest.raises(SessionError, match=r"has no certificate: STEREOSERVO_TLS_DIR") as none:
        open_session(client_config(endpoint))
    assert ".rs:" not in str(none.value)
    for command in (
        "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=cells -keyout ca.key -out ca.pem",
        "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=me -keyout key.pem -out cert.pem",
    ):
        subprocess.run(command.split(), cwd=tmp_path, check=True, capture_output=True)
    with pytest.raises(SessionError, match=r"cert\.pem must be in date, X\.509 version 3"):
        open_session(client_config(endpoint, tmp_path))


def test_a_clients_tls_files_are_looked_for_before_it_connects(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"ca\.pem: no such file; a TLS directory holds"):
        client_config("tls/10.0.0.1:7447", tmp_path)
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (tmp_path / name).touch()
    tls = client_config("tls/10.0.0.1:7447", tmp_path)["transport"]["link"]["tls"]
    assert tls["connect_private_key"] == str(tmp_path / "key.pem")


def test_an_endpoint_is_reported_without_a_password() -> None:
    with pytest.raises(SessionError, match="valid are unixsock-stream") as caught:
        gateway_config(cell(endpoints=["tls/operator:Tulpe@router:7447"]), Path("/"), SOCKET)
    assert "Tulpe" not in str(caught.value)
    with pytest.raises(SessionError, match="cannot connect to") as failed:
        open_session(client_config("tcp/operator:Tulpe@127.0.0.1:1"))
    assert "Tulpe" not in str(failed.value)
