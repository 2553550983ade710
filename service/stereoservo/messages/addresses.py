"""Addresses of devices (URLs of streams, serial ports on a network, endpoints), which are displayed without their
secrets.
"""

from __future__ import annotations

import hashlib
import re
import string
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Self
from urllib.parse import SplitResult, quote, unquote, unquote_to_bytes

HIDDEN = "***"
"""Placeholder for an omitted user, password or token."""
SHORTEST = 4
"""Characters of a text that is replaced wherever it stands: shorter ones are parts of words."""
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://", re.ASCII)
_HOST = re.compile(
    r"(?P<host>\[[0-9A-Fa-f:.]+(?:%[A-Za-z0-9._~%-]+)?\]|(?:[A-Za-z0-9._~!$&'()*+,;=-]|%[0-9A-Fa-f]{2})*)"
    r"(?::(?P<port>[0-9]{0,5}))?",
    re.ASCII,
)
_NO_USER = re.compile(r"\[.*\]|[0-9]{1,3}(?:\.[0-9]{1,3}){3}|localhost", re.ASCII | re.IGNORECASE)
_KEY = re.compile(r"[^?&;/#=:\s\"'{},]+(?=\s*=)")
_SECRET_KEY = re.compile(
    r"pas|pwd|psw|secret|token|auth|sig|cred|key|login|user|usr|account|sess|hash|^(?:p|pw|pin|sid|jwt|code)$",
    re.IGNORECASE,
)
_USER_KEY = re.compile(r"user|usr|account|login$", re.IGNORECASE)
_SECRET_OPTION = re.compile(r"passw|pwd|secret|token|credential|api_?key", re.IGNORECASE)
_VALUE = re.compile(r"([^?&;/#=\s]*)=[^?&;/#]*?(?=_[A-Za-z]+=|[?&;/#]|$)")
_BEHIND = (
    "an '@' stands behind a '/' or '?', so that where the password ends is open; in user and password '@' is "
    "written %40, '/' %2F, '?' %3F, '#' %23, ':' %3A, '%' %25; in path and parameters '@' is %40"
)


class AddressError(ValueError):
    """A text is no usable URL; the message contains the cause and valid forms, and no secrets."""


class Address(str):
    """An address in its displayable form: ``***`` replaces user and password, and everything from the first parameter
    that names one of them.

    The text of this string, and so everything that is printed, formatted, joined, encoded or compared, is the
    displayable form. Code that connects uses ``unredacted`` or :meth:`parsed`. Any text is accepted, also one that is
    no address.
    """

    __slots__ = ("_given",)
    _given: str

    def __new__(cls, given: str) -> Self:
        if isinstance(given, Address):
            given = given._given
        made = super().__new__(cls, _shown(given))
        made._given = given
        return made

    def __getnewargs__(self) -> tuple[str]:
        return (self._given,)

    @property
    def unredacted(self) -> str:
        """The address as it was given, for the code that connects."""
        return self._given

    def parsed(self) -> SplitResult:
        """The URL for a client: user and password are percent-encoded, as are blanks and non-ASCII letters of the path.

        User and password are the text before the last ``@``, also with a ``#`` in it, and with a ``/`` or ``?`` if no
        other interpretation is possible. Raises AddressError.
        """
        scheme, userinfo, rest, problem = _read(self._given)
        if not scheme:
            raise AddressError("not a URL: it begins with no http://, rtsp:// or the like")
        if problem:
            raise AddressError(f"not a URL: {problem}")
        if not self._given.isprintable():
            raise AddressError("not a URL: it has characters that are not printed; those are written %0A and the like")
        authority, tail = _split(rest)
        match = _HOST.fullmatch(authority)
        if match is None or int(match["port"] or 0) > 65535:
            raise AddressError(
                "not a URL: what stands for host and port is none; valid: camera.local, 192.168.1.7:8080, [fe80::1]:80"
            )
        if not match["host"]:
            raise AddressError("valid: a URL with a host, such as http://camera.local:8080/stream")
        if userinfo is not None:
            if any(byte < 0x20 or byte == 0x7F for byte in unquote_to_bytes(userinfo)):
                raise AddressError("not a URL: control characters are valid in no user and no password")
            user, colon, password = userinfo.partition(":")
            authority = f"{_encoded(user)}{colon}{_encoded(password)}@{authority}"
        path, _, fragment = quote(tail, safe=string.punctuation).partition("#")
        path, _, query = path.partition("?")
        return SplitResult(scheme.lower(), authority, path, query, fragment)

    def digest(self) -> str:
        """Eight hexadecimal digits of the part that the displayable form omits, except user, password and their
        parameters: they distinguish two streams of one server and reveal no secrets.
        """
        rest = _read(self._given).rest
        kept = _VALUE.sub(lambda found: "" if _SECRET_KEY.search(unquote(found[1])) else found[0], rest)
        return hashlib.sha256(kept.encode(errors="surrogatepass")).hexdigest()[:8]

    def hidden_in(self, text: str) -> str:
        """``text``, such as a library's error, with this address replaced by its displayable form."""
        return text.replace(self._given, self) if self._given else text


def without_secrets(value: Any) -> Any:
    """Options of a driver in displayable form: addresses in their displayable form, ``***`` for options named as a
    password.
    """
    if isinstance(value, str):
        return str(Address(value))
    if isinstance(value, Mapping):
        return {
            key: HIDDEN if _SECRET_OPTION.search(str(key)) else without_secrets(item) for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [without_secrets(item) for item in value]
    return value


_kept: dict[str, str] = {}
"""Secret texts of this process's cell files and what is shown instead of each."""


def keep_secret(value: Any, key: str = "") -> None:
    """Have :func:`redacted` replace the secrets in ``value``, a cell file or options of drivers, from now on."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            keep_secret(item, str(name))
    elif isinstance(value, list | tuple):
        for item in value:
            keep_secret(item, key)
    elif isinstance(value, str):
        if _SECRET_OPTION.search(key) and len(value) >= SHORTEST:
            _kept[value] = HIDDEN
        address = Address(value)
        if address != value:
            _kept[value] = address
        for secret in _secrets_in(value):
            for form in (secret, unquote(secret), quote(unquote(secret)), quote(secret)):
                if len(form) >= SHORTEST:
                    _kept[form] = HIDDEN


def _secrets_in(text: str) -> Iterator[str]:
    """User and password of an address, the password alone, and its parameters from the first secret one on; of these
    each value but a user's name.
    """
    _, userinfo, rest, _ = _read(text)
    if userinfo is not None:
        yield userinfo
        yield userinfo.partition(":")[2]
    shown = _without_parameters(rest)
    if shown != rest:
        yield rest[len(shown) - len(HIDDEN) :]
        for match in _VALUE.finditer(rest):
            if _SECRET_KEY.search(key := unquote(match[1])) and not _USER_KEY.search(key):
                yield match[0].partition("=")[2]


def redacted(text: str) -> str:
    """``text``, such as a driver's error, without the secrets that the cell files of this process contain."""
    for secret in sorted((secret for secret in _kept if secret in text), key=len, reverse=True):
        text = text.replace(secret, _kept[secret])
    return text


class _Reading(NamedTuple):
    scheme: str
    userinfo: str | None
    rest: str
    problem: str


def _read(text: str) -> _Reading:
    """Scheme, user and password (None: none), and the text after them; ``problem``: why the result is uncertain."""
    match = _SCHEME.match(text)
    if match is None:
        return _Reading("", None, text, "")
    scheme, rest = match[1], text[match.end() :]
    authority, tail = _split(rest)
    if "@" not in tail:
        before, at, behind = rest.rpartition("@")
        return _Reading(scheme, before if at else None, behind, "")
    found = _HOST.fullmatch(authority)
    if found is not None and not tail.startswith("#"):
        certain = ":" not in rest.rpartition("@")[0] or _NO_USER.fullmatch(found["host"]) or "." in found["host"]
        return _Reading(scheme, None, rest, "" if certain else _BEHIND)
    within = tail.rpartition("@")[0]
    if tail.startswith("#"):
        unclear = "@" in within and any(mark in within for mark in "/?")
    else:
        unclear = "@" in within or "@" in authority
    if unclear:
        return _Reading(scheme, None, rest, _BEHIND)
    before, _, behind = rest.rpartition("@")
    return _Reading(scheme, before, behind, "")


def _split(rest: str) -> tuple[str, str]:
    """The text before the first of ``/?#``, and the rest including it."""
    end = min((k for k in map(rest.find, "/?#") if k >= 0), default=len(rest))
    return rest[:end], rest[end:]


def _shown(text: str) -> str:
    scheme, userinfo, rest, problem = _read(text)
    if not scheme:
        _, colon, tail = text.partition(":")
        if colon and "@" in tail and not tail.startswith("/dev/"):
            return f"{HIDDEN}@{_without_parameters(text.rpartition('@')[2])}"
        return _without_parameters(text)
    if problem:
        return f"{scheme}://{HIDDEN}"
    if userinfo is not None:
        return f"{scheme}://{HIDDEN}@{_without_parameters(rest)}"
    authority, tail = _split(rest)
    host, colon, _ = authority.partition(":")
    found = _HOST.fullmatch(authority)
    if found is None and colon:  # a password whose host is missing
        return f"{scheme}://{host}:{HIDDEN}"
    if found is not None and ":" in rest.rpartition("@")[0] and not _NO_USER.fullmatch(found["host"]):
        return f"{scheme}://{host}/{HIDDEN}"  # host.name:8080/a@b, or first.last:8080/a and a host
    return f"{scheme}://{_without_parameters(rest)}"


def _without_parameters(text: str) -> str:
    """``text`` up to the first parameter that names a user, password or token: the end of its value is unknown."""
    for match in _KEY.finditer(text):
        if _SECRET_KEY.search(unquote(match[0])):
            return text[: match.start()] + HIDDEN
    return text


def _encoded(text: str) -> str:
    return quote(unquote_to_bytes(text), safe="")
