"""Addresses: whatever the password, nothing of it is shown; what connects gets it whole, or is told what to write."""

from __future__ import annotations

import copy
import json
import logging
import pickle
from urllib.parse import quote, unquote

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from stereoservo.messages.addresses import Address, AddressError, without_secrets

HOSTS = ("127.0.0.1:9", "cam", "cam.local:8080", "[::1]:8080", "[fe80::1%25eth0]")
SECRET = "Tulpe"
passwords = st.text(
    st.one_of(
        st.sampled_from("#@/:%?&=;[]\\\"'<>{}|^ ,äß€日"),
        st.sampled_from("0123456789"),
        st.characters(codec="utf-8", exclude_categories=("C", "Z")),
    ),
    max_size=12,
)


def every_text_of(address: Address) -> list[str]:
    """The texts that come of printing, formatting, joining, logging and encoding."""
    record = logging.LogRecord("x", 0, "", 0, "%s %r", (address, address), None)
    return [
        str(address), repr(address), f"{address}", f"{address!r:>5}", "%s" % address, " ".join([address]),  # noqa: UP031
        address + "", json.dumps({"source": address}, ensure_ascii=False), record.getMessage(),
        str(AddressError(address)), repr({"source": address}), format(address, ""),
        msgspec.json.encode({"source": address}, enc_hook=str).decode(),
    ]  # fmt: skip


@given(passwords, st.sampled_from(("http", "https", "rtsp")), st.sampled_from(HOSTS), st.booleans())
@example("#@", "http", "127.0.0.1:9", False)
def test_no_password_is_shown_and_none_goes_elsewhere(password, scheme, host, named):
    """A password between two marks, raw, as people write it: the marks are never shown, nor what is between them; read,
    it is the whole password for that host, or it is refused.
    """
    secret = f"q{password}z7"
    user = "operator" if named else ""
    address = Address(f"{scheme}://{user}:{secret}@{host}/straße/live")
    for text in every_text_of(address):
        assert "q" not in text.removeprefix(scheme).replace("***", "")
        assert "z7" not in text
        assert "operator" not in text
    if address == f"{scheme}://***":
        assert set(password) & set("/?"), "only what cannot be told apart is refused"
        with pytest.raises(AddressError, match="%40") as caught:
            address.parsed()
        assert "z7" not in str(caught.value)
        return
    url = address.parsed()
    assert url.netloc.rpartition("@")[2] == host
    expected = unquote(secret, errors="surrogateescape")
    assert unquote(url.password or "", errors="surrogateescape") == expected
    assert url.geturl().isascii()


@given(passwords, st.sampled_from(HOSTS))
def test_an_encoded_password_is_always_read(password, host):
    address = Address(f"rtsp://operator:{quote(password, safe='')}@{host}/live?channel=2")
    url = address.parsed()
    assert unquote(url.password or "") == password
    assert (url.path, url.query) == ("/live", "channel=2")
    assert address == f"rtsp://***@{host}/live?channel=2"


@given(
    passwords,
    st.sampled_from(("pwd", "password", "loginpas", "token", "p%77d", "Passwd", "api_key", "psw")),
    st.sampled_from(
        ("/cgi?user=operator&{}={}&channel=1", "/cgi?channel=1&{}={}", "/user=operator_{}={}_channel=1.sdp")
    ),
    st.sampled_from(("", "operator:other@")),
    st.sampled_from(HOSTS),
)
def test_no_password_among_the_parameters_is_shown(password, key, form, userinfo, host):
    address = Address(f"http://{userinfo}{host}{form.format(key, f'Q{password}Z7')}")
    for text in every_text_of(address):
        for word in ("Q", "Z7", "operator", "other"):
            assert word not in text
    assert "***" in address


@pytest.mark.parametrize(
    ("text", "shown", "url"),
    [
        ("http://operator:Tulpe#77@127.0.0.1:9/v.mjpg", "http://***@127.0.0.1:9/v.mjpg",
         "http://operator:Tulpe%2377@127.0.0.1:9/v.mjpg"),
        ("http://operator:77#Tulpe@cam/v", "http://***@cam/v", "http://operator:77%23Tulpe@cam/v"),
        ("http://a:b@c:Tulpe@cam/v", "http://***@cam/v", "http://a:b%40c%3ATulpe@cam/v"),
        ("http://operator:Tul/pe@cam/v", "http://***@cam/v", "http://operator:Tul%2Fpe@cam/v"),
        ("http://cam/straße 1", "http://cam/straße 1", "http://cam/stra%C3%9Fe%201"),
        ("HTTP://Cam:81/s?x=1&y=%20", "HTTP://Cam:81/s?x=1&y=%20", "http://Cam:81/s?x=1&y=%20"),
        ("http://cam/stream@2x", "http://cam/stream@2x", "http://cam/stream@2x"),
        ("http://10.0.0.7:80/c?user=a&pwd=Tul@pe", "http://10.0.0.7:80/c?***", "http://10.0.0.7:80/c?user=a&pwd=Tul@pe"),
        ("http://nvr.local:80/c?pwd=Tul@pe", "http://nvr.local/***", "http://nvr.local:80/c?pwd=Tul@pe"),
        ("rtsp://10.0.0.1:554/user=admin_password=Tulpe_channel=1.sdp?real", "rtsp://10.0.0.1:554/***",
         "rtsp://10.0.0.1:554/user=admin_password=Tulpe_channel=1.sdp?real"),
        ("genicam://Basler-acA%20x", "genicam://Basler-acA%20x", "genicam://Basler-acA%20x"),
        ("http://operator@cam/v", "http://***@cam/v", "http://operator@cam/v"),
        ("http://:Tulpe@cam/v", "http://***@cam/v", "http://:Tulpe@cam/v"),
    ],
)  # fmt: skip
def test_how_an_address_is_read_and_shown(text, shown, url):
    address = Address(text)
    assert address == shown
    assert address.parsed().geturl() == url
    assert address.unredacted == text


@pytest.mark.parametrize(
    ("text", "shown", "told"),
    [
        ("http://operator:12/Tulpe@cam/v", "http://***", "%2F"),
        ("http://operator:a@b/Tulpe@cam/v", "http://***", "%2F"),
        ("http://operator:Tulpe", "http://operator:***", "host and port"),
        ("http://operator:Tulpe/v", "http://operator:***", "host and port"),
        ("http://cam:99999/v", "http://cam:99999/v", "host and port"),
        ("http://fe80::1/v", "http://fe80:***", "[fe80::1]:80"),
        ("http:///v", "http:///v", "with a host"),
        ("http://operator:Tulpe@/v", "http://***@/v", "with a host"),
        ("http://operator:Tul\npe@cam/v", "http://***@cam/v", "%0A"),
        ("operator:Tulpe@cam/v", "***@cam/v", "begins with no http://"),
        ("http:/operator:Tulpe@cam/v", "***@cam/v", "begins with no http://"),
        ("cam/v?pwd=Tulpe", "cam/v?***", "begins with no http://"),
        ("/dev/ttyUSB0@1000000", "/dev/ttyUSB0@1000000", "begins with no http://"),
        (
            "stereoservo_slcan:/dev/ttyUSB0@1000000",
            "stereoservo_slcan:/dev/ttyUSB0@1000000",
            "begins with no",
        ),
        ("", "", "begins with no http://"),
    ],
)
def test_what_is_no_address_is_reported_without_its_secrets(text, shown, told):
    address = Address(text)
    assert address == shown
    with pytest.raises(AddressError) as caught:
        address.parsed()
    assert told in str(caught.value)
    assert SECRET not in repr(caught.value)
    assert caught.value.__cause__ is None


def test_copies_keep_what_is_not_shown():
    address = Address("http://operator:Tulpe@cam/v")
    for other in (
        copy.copy(address),
        copy.deepcopy(address),
        pickle.loads(pickle.dumps(address)),
        Address(address),
    ):
        assert (other, other.unredacted) == (address, "http://operator:Tulpe@cam/v")


def test_a_librarys_error_is_shown_without_the_address():
    address = Address("socket://operator:Tulpe@cam:1")
    assert address.hidden_in(f"could not open {address.unredacted}: no") == "could not open socket://***@cam:1: no"


def test_options_are_shown_without_secrets():
    options = {
        "source": "http://a:Tulpe@cam/v",
        "password": "Tulpe",
        "width": 640,
        "list": [{"port": "x:Tulpe@cam"}],
    }
    shown = without_secrets(options)
    assert SECRET not in repr(shown)
    assert shown == {
        "source": "http://***@cam/v", "password": "***", "width": 640, "list": [{"port": "***@cam"}],
    }  # fmt: skip
    assert options["password"] == SECRET
