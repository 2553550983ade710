"""States as former versions of the program wrote them."""

from __future__ import annotations

from typing import Any

import msgspec

from stereoservo.core.state_encoding import BEFORE_VERSION_10, KNOWN_BY


def without_a_block(data: bytes) -> dict[str, Any]:
    """A state as it was written before version 10, with all arrays on their own."""
    state: dict[str, Any] = msgspec.msgpack.decode(data)
    block = state.pop("block")
    for name, place in BEFORE_VERSION_10.items():
        *path, last = (place or name).split(".")
        into = state
        for part in path:
            into = into.setdefault(part, {})
        into[last] = block[name] if block.get(KNOWN_BY.get(name, ""), True) else None
    state["contact"]["loads"] = state.pop("loads")
    return state
