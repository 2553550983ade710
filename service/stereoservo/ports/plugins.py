"""Plug-ins by entry point (drivers, detectors, laws, commands): imported on demand; a broken one is listed as such,
with the missing extra of the installation.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from stereoservo.messages.addresses import redacted

JOINT_DRIVERS = "stereoservo.joint_drivers"
CAMERA_DRIVERS = "stereoservo.camera_drivers"
DETECTORS = "stereoservo.detectors"
LAWS = "stereoservo.laws"
COMMANDS = "stereoservo.commands"
CELLS = "stereoservo.cells"
"""Functions from the name of a cell file that a distribution ships to its path; they raise ValueError."""
GROUPS = (JOINT_DRIVERS, CAMERA_DRIVERS, DETECTORS, LAWS, COMMANDS)

EXTRAS = {
    "cell": (
        "numpy",
        "scipy",
        "cv2",
        "numba",
        "can",
        "canopen",
        "serial",
        "mcap",
        "zstandard",
        "foxglove",
        "matplotlib",
        "yaml",
    ),
    "sim": ("pybullet", "pybullet_data"),
    "web": ("websockets",),
    "watch": ("rerun",),
    "lerobot": ("pyarrow", "av"),
}
"""Top-level modules that each extra of the distribution installs, as in pyproject.toml."""
BESIDE = {
    "cell": ", or with the simulated cell: pip install 'stereoservo[demo]'",
    "sim": " on Python 3.11, Linux x86_64; elsewhere pybullet has no wheel, and `pip install pybullet` compiles it",
}
"""Remarks on extras."""


class PluginError(Exception):
    """A plug-in is unknown or does not import. ``known`` lists the names of its group."""

    def __init__(self, group: str, name: str, message: str, known: tuple[str, ...]) -> None:
        super().__init__(redacted(message))
        self.group = group
        self.name = redacted(name)
        self.known = known


def missing_extra(error: BaseException) -> str | None:
    """Message naming the extra to install if ``error`` is a failed import of one of its modules; else None."""
    if not isinstance(error, ModuleNotFoundError) or error.name is None:
        return None
    module = error.name.partition(".")[0]
    for extra, modules in EXTRAS.items():
        if module in modules:
            beside = BESIDE.get(extra, "")
            return f"{module} is not installed; it comes with: pip install 'stereoservo[{extra}]'{beside}"
    return None


@dataclass(frozen=True)
class Plugin:
    """One entry point; ``error`` is empty if it imports (or was not tried)."""

    group: str
    name: str
    value: str
    distribution: str
    error: str = ""


def names(group: str) -> tuple[str, ...]:
    """Names of a group's plug-ins, sorted; imports nothing."""
    return tuple(sorted({entry.name for entry in entry_points(group=group)}))


def list_plugins(group: str, *, check: bool = False) -> list[Plugin]:
    """All plug-ins of a group; ``check`` imports each and reports its error. Never raises for a broken one."""
    found = []
    for entry in sorted(entry_points(group=group), key=lambda e: e.name):
        error = ""
        if check:
            try:
                entry.load()
            except Exception as caught:  # a third party's module may raise anything on import
                error = _cause(caught)
        found.append(Plugin(group, entry.name, entry.value, _distribution(entry), error))
    return found


def load(group: str, name: str) -> Any:
    """Import one plug-in. Raises PluginError: unknown (lists the known names) or broken (gives its error)."""
    matching = [entry for entry in entry_points(group=group) if entry.name == name]
    known = names(group)
    kind = group.rpartition(".")[2].replace("_", " ").removesuffix("s")
    if not matching:
        raise PluginError(group, name, f"no {kind} {name!r}; there are: {', '.join(known) or 'none'}", known)
    origins = sorted({entry.value for entry in matching})
    if len(origins) > 1:
        raise PluginError(group, name, f"{kind} {name!r} is offered twice: {', '.join(origins)}", known)
    try:
        return matching[0].load()
    except Exception as error:
        raise PluginError(
            group,
            name,
            f"{kind} {name!r} ({matching[0].value}) does not import: {_cause(error)}",
            known,
        ) from error


def _cause(error: Exception) -> str:
    """Why the import of a plug-in fails."""
    return missing_extra(error) or f"{type(error).__name__}: {error}"


def _distribution(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else ""
