"""Registry of the installed control laws, found by entry point: laws by name, and the hash of a law's source for
recordings.

A law's name is its entry point's name in the group ``stereoservo.laws``; the object is a `control.law.Law`. Laws are
imported together on first use, so that none is imported while an arm moves. A law that does not import, or is not a
`Law`, is listed in ``errors`` and takes no other with it.
"""

from __future__ import annotations

import hashlib
import inspect
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import msgspec

from stereoservo.control.law import Law, OneCamera, Path
from stereoservo.ports import plugins

OPTIONS = ("centre", "jacobian", "profile")
"""Fields of a goal that belong to some laws only."""


class LawDescription(msgspec.Struct, frozen=True):
    """The properties of a law by which requests are checked (see `Law`), for processes that step none."""

    name: str
    summary: str
    options: tuple[str, ...]
    one_camera: OneCamera


class UnknownLawError(KeyError):
    """No usable law has this name; the message lists the usable ones, and the error of a broken one."""

    def __init__(self, name: str, known: tuple[str, ...], error: str = "") -> None:
        super().__init__(name)
        self.name = name
        broken = f"; it is installed but broken: {error}" if error else ""
        self.message = f"no law {name!r}; valid: {', '.join(known)}{broken}"

    def __str__(self) -> str:
        return self.message


class LawRegistry(Mapping[str, Law]):
    """The usable laws of an entry point group by name, ordered by rank, then by name."""

    def __init__(self, group: str = plugins.LAWS) -> None:
        self._group = group
        self._laws: dict[str, Law] | None = None
        self._errors: dict[str, str] = {}

    def __getitem__(self, name: str) -> Law:
        laws = self._loaded()
        if name not in laws:
            raise self.unknown(name)
        return laws[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._loaded())

    def __len__(self) -> int:
        return len(self._loaded())

    @property
    def errors(self) -> Mapping[str, str]:
        """Errors of installed laws that cannot be used, by name."""
        self._loaded()
        return self._errors

    def unknown(self, name: str) -> UnknownLawError:
        """The error for a name that no usable law has."""
        return UnknownLawError(name, tuple(self._loaded()), self._errors.get(name, ""))

    def usable(self) -> dict[str, Law]:
        """The usable laws as a dict, for lookups in the loop. A disabled law is removed from it."""
        return self._loaded()

    def disable(self, name: str, error: str) -> None:
        """Disable a law in this process, for the reason ``error``."""
        if self._loaded().pop(name, None) is not None:
            self._errors[name] = error

    def having(self, option: str) -> tuple[str, ...]:
        """Names of the laws that take ``option`` of a goal."""
        return tuple(name for name, law in self.items() if option in law.options)

    def on_path(self, path: Path) -> tuple[str, ...]:
        """Names of the laws that move the body on such a path."""
        return tuple(name for name, law in self.items() if law.path == path)

    def surest_first(self) -> tuple[str, ...]:
        """All names, ordered by how reliably a law arrives: on a straight line, by the goal's pose, by its pixels."""
        return tuple(sorted(self, key=lambda name: (self[name].path != "straight", not self[name].needs_pose)))

    def descriptions(self) -> tuple[LawDescription, ...]:
        """The usable laws in their order, for `adopt` in another process."""
        return tuple(LawDescription(name, law.summary, law.options, law.one_camera) for name, law in self.items())

    def adopt(self, laws: tuple[LawDescription, ...], errors: Mapping[str, str]) -> None:
        """Hold these laws of another process, and its ``errors``, in place of the installed ones: no law is imported,
        and none can be stepped.
        """
        self._laws = {
            law.name: Law(_not_here, law.summary, options=law.options, one_camera=law.one_camera) for law in laws
        }
        self._errors = dict(errors)

    def sources(self) -> dict[str, str]:
        """Source of every law: its distribution with its version, and a hash of its source file."""
        found = {}
        for plugin in plugins.list_plugins(self._group):
            if plugin.name in self:
                found[plugin.name] = f"{plugin.distribution} {source_hash(self[plugin.name])}"
        return found

    def _loaded(self) -> dict[str, Law]:
        if self._laws is None:
            laws = {}
            for name in plugins.names(self._group):
                try:
                    laws[name] = _checked(plugins.load(self._group, name))
                except (plugins.PluginError, TypeError, ValueError) as error:
                    self._errors[name] = str(error)
            self._laws = dict(sorted(laws.items(), key=lambda item: (item[1].rank, item[0])))
        return self._laws


def _not_here(*_: Any) -> NoReturn:
    raise RuntimeError("this process holds only descriptions of the laws (LawRegistry.adopt); it cannot step one")


def source_hash(law: Law) -> str:
    """Sixteen hexadecimal digits of the SHA-256 of the file that defines the law's step."""
    return hashlib.sha256(pathlib.Path(inspect.getfile(inspect.unwrap(law.step))).read_bytes()).hexdigest()[:16]


def _checked(law: Any) -> Law:
    """The law, after validation. Raises TypeError or ValueError if it is not a valid one."""
    if not isinstance(law, Law):
        raise TypeError(f"is a {type(law).__name__}; an instance of stereoservo.control.law.Law is needed")
    unknown = [option for option in law.options if option not in OPTIONS]
    if unknown:
        raise ValueError(f"takes the option {unknown[0]!r}; there are: {', '.join(OPTIONS)}")
    if len(law.components) != len(law.units):
        raise ValueError(f"names {len(law.components)} components and {len(law.units)} units; each component needs one")
    return law


LAWS = LawRegistry()
