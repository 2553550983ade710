"""States as former versions of the program wrote them."""

from __future__ import annotations

from typing import Any

import msgspec

from stereoservo.core.state_encoding import (
    BEFORE_VERSION_10,
    FRICTION_BEFORE_VERSION_12,
    KNOWN_BY,
    RUN_BEFORE_VERSION_12,
    WATCH_BEFORE_VERSION_12,
)


def before_version_12(data: bytes) -> dict[str, Any]:
    """A state as it was written with a law's progress and friction on their own."""
    state: dict[str, Any] = msgspec.msgpack.decode(data)
    block, source, subject = state["block"], state["source"], state.pop("friction_of")
    run = block.pop("run")
    if "reasons" in source:  # a law
        source |= {name: run[name] for name in RUN_BEFORE_VERSION_12}
        source["watch"] = {name: run[name] for name in WATCH_BEFORE_VERSION_12}
        source["watch"]["reasons"] = source.pop("reasons")
        source["error_px"] = run["newest_px"] if run["measured"] else None
    places = {place: block.pop(name) for name, place in FRICTION_BEFORE_VERSION_12.items()}
    state["friction"] = {"subject": subject, **places} if subject else None
    state["version"] = 11
    return state


def without_a_block(data: bytes) -> dict[str, Any]:
    """A state as it was written before version 10, with all arrays on their own."""
    state = before_version_12(data)
    block = state.pop("block")
    for name, place in BEFORE_VERSION_10.items():
        *path, last = (place or name).split(".")
        into = state
        for part in path:
            into = into.setdefault(part, {})
        into[last] = block[name] if block.get(KNOWN_BY.get(name, ""), True) else None
    state["contact"]["loads"] = state.pop("loads")
    return state
