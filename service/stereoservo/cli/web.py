"""Command ``stereoservo web``: serves the operators' page of a cell until Ctrl-C."""

from __future__ import annotations

import asyncio
import re
import ssl
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoservo.cli import interruption
from stereoservo.cli.output import CommandError, EndpointOption, JsonOption, emit, log
from stereoservo.messages.keys import InvalidKeyError, check_name

if TYPE_CHECKING:
    from stereoservo.web.server import PageServer

HOST_NAME = re.compile(r"[A-Za-z0-9._-]+|[0-9A-Fa-f:.]+")
LOOPBACK = ("127.0.0.1", "localhost", "::1")
END_S = 20.0
"""Time from Ctrl-C to an end by force [s]. Pages are given 2 s, the link 6 s, then other threads `THREADS_S`."""
THREADS_S = 1.0


def web(
    cell: Annotated[
        str | None, typer.Argument(metavar="CELL", help="Name of a live cell, or path of a cell file (*.toml).")
    ] = None,
    flight: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Show a flight recording (*.mcap) in the place of a live cell.")
    ] = None,
    port: Annotated[int, typer.Option(help="TCP port; 0: a free one.", min=0, max=65535)] = 8080,
    address: Annotated[str, typer.Option(help="Address to listen on; any but loopback needs --tls.")] = "127.0.0.1",
    tls: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Directory with cert.pem and key.pem: https, on any address.")
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Another name under which browsers reach the server (a cell.example); repeat."
        ),
    ] = None,
    operate: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Let one page command the arm under this name, with the one-time token that is printed.",
        ),
    ] = None,
    endpoint: EndpointOption = None,
    json: JsonOption = False,
) -> None:
    """Serve the operators' page, until Ctrl-C. Without --operate it shows the cell and may stop the arm.

    With --flight it plays a recording, and commands nothing.
    """
    if (cell is None) == (flight is None):
        raise CommandError("usage", "one of CELL, a live cell, and --flight FILE, a recording, is to be given")
    if flight is not None and (operate is not None or endpoint is not None):
        raise CommandError("usage", "--flight shows a recording: --operate and --endpoint are of a live CELL")
    context = _tls_context(address, tls)
    _check_names(host or [], operate)
    try:
        from stereoservo.web.cell_link import CellLink, Publish
        from stereoservo.web.server import PageServer
    except ModuleNotFoundError as error:
        if error.name != "websockets":
            raise
        raise CommandError(
            "missing", "the page needs the package websockets: pip install 'stereoservo[web]'"
        ) from error
    make_link: Callable[[Publish], CellLink | PlaybackLink]
    if flight is not None:
        from stereoservo.web.playback import PlaybackLink

        make_link = partial(PlaybackLink, flight)
    else:
        assert cell is not None
        make_link = partial(CellLink, cell, endpoint, operate or "page", log=log)
    tokens: list[str] = []

    def announce(token: str) -> None:
        tokens.append(token)
        if len(tokens) > 1 or not json:
            log(f"token to command the arm as {operate}, good for one use: {token}")

    interruption.check()  # an interrupt that was lost while packages were imported
    with interruption.graceful_shutdown(END_S) as shutdown:
        server = PageServer(make_link, operate, announce)
        asyncio.run(_serve(server, address, port, context, host or [], tokens, json, shutdown))
        left = interruption.unfinished_threads(THREADS_S)
        if left:
            log(f"ended without waiting for what does not answer: {', '.join(left)}")
            interruption.exit_now(0)


def _check_names(hosts: list[str], operator: str | None) -> None:
    """Raise CommandError for an invalid host or operator name."""
    for name in hosts:
        if not HOST_NAME.fullmatch(name):
            raise CommandError(
                "usage", f"--host {name!r}: a name or address is valid, cell.example or 10.0.0.5, without a port"
            )
    if operator is not None:
        try:
            check_name("operator", operator)
        except InvalidKeyError as error:
            raise CommandError("usage", str(error)) from error


async def _serve(
    server: PageServer,
    address: str,
    port: int,
    context: ssl.SSLContext | None,
    names: list[str],
    tokens: list[str],
    as_json: bool,
    shutdown: interruption.ShutdownRequest,
) -> None:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()

    def wake() -> None:
        loop.call_soon_threadsafe(ended.set)

    shutdown.wake = wake
    try:
        found = await server.start(address, port, context, names)
    except OSError as error:
        await asyncio.to_thread(server.link.close)
        raise CommandError("listen", f"{address}:{port}: {error.strerror or error}; choose another --port") from error
    try:
        shown = f"[{address}]" if ":" in address else address
        url = f"{'http' if context is None else 'https'}://{shown}:{found}/"
        emit({"url": url, "token": tokens[-1] if tokens else None}, f"{url}  (Ctrl-C ends it)", as_json)
        if not shutdown.asked:
            await ended.wait()
        log(
            f"ending: pages are closed, and what they have started stops; by force after {END_S:g} s, or at once by a "
            "second Ctrl-C"
        )
    finally:
        await server.close()


def _tls_context(address: str, directory: Path | None) -> ssl.SSLContext | None:
    """The server's TLS settings; None without. Raises CommandError: not loopback and no TLS, or files missing."""
    if directory is None:
        if address not in LOOPBACK:
            raise CommandError(
                "usage",
                f"--address {address} without --tls: whoever is on the way could command the arm; loopback alone "
                f"({', '.join(LOOPBACK)}) is served without TLS",
            )
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(directory / "cert.pem", directory / "key.pem")
    except (OSError, ssl.SSLError) as error:
        raise CommandError("tls", f"{directory}: cert.pem and key.pem, in PEM, are needed: {error}") from error
    return context
