"""`stereoservo web`: where it listens without TLS and with it."""

import asyncio
import shutil
import socket
import ssl
import subprocess
from pathlib import Path
from threading import Event
from typing import Any

import pytest

pytest.importorskip("websockets", reason="the page's server needs websockets (extra web)")

from websockets.asyncio.client import connect
from websockets.exceptions import InvalidHandshake, InvalidStatus

from stereoservo.cli import web as command
from stereoservo.cli.output import CommandError
from stereoservo.web.rights import RightsError, allowed_hosts, check_host
from stereoservo.web.server import PageServer


class NoLink:
    """A `CellLink` to no cell."""

    cell = "none"
    silent_s = 0.0

    def __init__(self, publish: Any) -> None:
        self.watched = Event()

    def start(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with ``cert.pem`` and ``key.pem`` of localhost and 127.0.0.1."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs openssl")
    made = tmp_path_factory.mktemp("tls")
    subprocess.run(
        [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
         "-keyout", made / "key.pem", "-out", made / "cert.pem", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"],
        check=True, capture_output=True,
    )  # fmt: skip
    return made


@pytest.mark.parametrize("address", ["127.0.0.1", "localhost", "::1"])
def test_loopback_is_served_without_tls(address: str) -> None:
    assert command._tls_context(address, None) is None


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.5", "cell.example", "127.0.0.1.evil.example", ""])
def test_no_other_address_is_served_without_tls_whatever_the_cell(address: str) -> None:
    with pytest.raises(CommandError, match="without --tls") as refused:
        command.web("a cell that need not be there", address=address, port=0, tls=None)
    assert "127.0.0.1, localhost, ::1" in str(refused.value)


def test_with_tls_any_address_is_served(certified: Path) -> None:
    context = command._tls_context("0.0.0.0", certified)
    assert context is not None
    assert context.protocol == ssl.PROTOCOL_TLS_SERVER


@pytest.mark.parametrize("spoilt", ["cert.pem", "key.pem"])
def test_files_that_are_missing_or_do_not_fit_are_named(spoilt: str, certified: Path, tmp_path: Path) -> None:
    for name in ("cert.pem", "key.pem"):
        shutil.copy(certified / name, tmp_path)
    (tmp_path / spoilt).write_text("no PEM")
    with pytest.raises(CommandError, match=r"cert\.pem and key\.pem, in PEM, are needed"):
        command._tls_context("0.0.0.0", tmp_path)
    (tmp_path / spoilt).unlink()
    with pytest.raises(CommandError, match=str(tmp_path)):
        command._tls_context("127.0.0.1", tmp_path)


def test_over_tls_the_page_opens_for_its_own_origin_and_not_without_tls(certified: Path) -> None:
    async def visit() -> None:
        server = PageServer(NoLink, None, pytest.fail)  # type: ignore[arg-type]
        port = await server.start("localhost", 0, command._tls_context("localhost", certified))
        trusting = ssl.create_default_context(cafile=certified / "cert.pem")
        url = f"wss://localhost:{port}/socket"
        try:
            async with connect(url, ssl=trusting, origin=f"https://localhost:{port}") as page:
                assert '"cell":"none"' in str(await page.recv())
            with pytest.raises(InvalidStatus, match="403"):
                async with connect(url, ssl=trusting, origin=f"http://localhost:{port}"):
                    pass
            with pytest.raises(ssl.SSLCertVerificationError):  # whoever does not know the certificate
                async with connect(url):
                    pass
            with pytest.raises((OSError, InvalidHandshake)):
                async with connect(f"ws://localhost:{port}/socket"):
                    pass
        finally:
            await server.close()

    asyncio.run(visit())


def test_a_server_beyond_loopback_has_its_names_and_the_address_it_is_reached_at() -> None:
    for host in ("cell.example:8443", socket.gethostname() + ":8443", "192.0.2.7:8443"):
        check_host(host, allowed_hosts("cell.example", 8443), "192.0.2.7", 8443)
    for host in ("localhost:8443", "0.0.0.0:8443", "192.0.2.8:8443", "cell.example:8444"):
        with pytest.raises(RightsError):
            check_host(host, allowed_hosts("cell.example", 8443), "192.0.2.7", 8443)
