"""Command ``stereoservo drivers``: lists the installed plug-ins (drivers, detectors, control laws, commands), marking
those that fail to load.
"""

from __future__ import annotations

from dataclasses import replace

from stereoservo.cli.output import JsonOption, emit
from stereoservo.control.law_registry import LAWS
from stereoservo.ports import plugins


def drivers(json: JsonOption = False) -> None:
    """List drivers, detectors, laws and commands that are installed; broken ones with their error."""
    groups = {group.rpartition(".")[2]: plugins.list_plugins(group, check=True) for group in plugins.GROUPS}
    groups["laws"] = [replace(law, error=LAWS.errors.get(law.name, law.error)) for law in groups["laws"]]
    tree = {
        kind: [
            {"name": p.name, "value": p.value, "distribution": p.distribution, "error": p.error or None} for p in found
        ]
        for kind, found in groups.items()
    }
    lines = []
    for kind, found in groups.items():
        lines.append(kind.replace("_", " "))
        lines += [f"  {p.name:12} {p.value}" + (f"  BROKEN: {p.error}" if p.error else "") for p in found]
    emit(tree, "\n".join(lines), json)
