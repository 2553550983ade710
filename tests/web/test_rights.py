"""Hosts, origins, tokens, and the one page that holds the arm."""

import socket

import pytest

from stereoservo.web.rights import ArmHolder, RightsError, allowed_hosts, check_host, check_origin


def test_only_this_servers_names_are_hosts() -> None:
    loopback = allowed_hosts("127.0.0.1", 8080)
    for host in ("127.0.0.1:8080", "localhost:8080", "LOCALHOST:8080", "[::1]:8080"):
        check_host(host, loopback, "127.0.0.1", 8080)
    for host in (
        None,
        "",
        "evil.example",
        "evil.example:8080",
        "127.0.0.1",
        "localhost:8081",
        "127.0.0.1:8080:1",
    ):
        with pytest.raises(RightsError):
            check_host(host, loopback, "127.0.0.1", 8080)
    assert {"10.0.0.5:443", "10.0.0.5"} < allowed_hosts("10.0.0.5", 443)


def test_a_server_beyond_loopback_has_this_computers_names_and_those_given() -> None:
    names = allowed_hosts("0.0.0.0", 8443, ["Cell.example", "fd00::5"])
    computer = socket.gethostname()
    for host in (f"{computer}:8443", "cell.example:8443", "[fd00::5]:8443", "10.0.0.5:8443"):
        check_host(host, names, "10.0.0.5", 8443)
    for host in ("evil.example:8443", "10.0.0.6:8443", "10.0.0.5", "10.0.0.5:8444", "localhost:8443"):
        with pytest.raises(RightsError, match="--host NAME"):
            check_host(host, names, "10.0.0.5", 8443)


def test_another_pages_origin_is_refused() -> None:
    check_origin(None, "localhost:8080", False)
    check_origin("http://localhost:8080", "localhost:8080", False)
    check_origin("https://cell.example:8443", "cell.example:8443", True)
    for origin in (
        "null",
        "http://evil.example",
        "http://127.0.0.1:8080",
        "https://localhost:8080",
        "localhost:8080",
    ):
        with pytest.raises(RightsError):
            check_origin(origin, "localhost:8080", False)


def test_a_token_works_once_and_one_page_holds_the_arm() -> None:
    tokens: list[str] = []
    holder = ArmHolder("ann", tokens.append)
    first, second = object(), object()
    with pytest.raises(RightsError, match="token"):
        holder.take(first, "")
    holder.take(first, tokens[0])
    holder.require(first, "enable")
    with pytest.raises(RightsError, match="another page"):
        holder.take(second, tokens[1])
    with pytest.raises(RightsError):
        holder.require(second, "enable")
    assert not holder.release(second)
    assert holder.release(first)
    with pytest.raises(RightsError, match="used before"):
        holder.take(second, tokens[0])
    holder.take(second, tokens[1])
    assert len(set(tokens)) == 3


def test_a_read_only_page_takes_no_token() -> None:
    holder = ArmHolder(None, pytest.fail)
    with pytest.raises(RightsError, match="read-only"):
        holder.take(object(), "")
