"""What can be ordered of the rack: text to typed orders, with errors that say what there is."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from stereoservo_sim.emulation.errors import OrderError
from stereoservo_sim.emulation.orders import misused, split_order, usage_lines
from stereoservo_sim.emulation.times import duration_ns

COB_IDS = {
    "emcy": 0x080, "tpdo1": 0x180, "tpdo2": 0x280, "tpdo3": 0x380, "tpdo4": 0x480, "sdo": 0x580, "heartbeat": 0x700,
}  # fmt: skip
"""Frames of a node by name: the base of their id in the predefined connection set (CiA 301, 7.3.5)."""
NMT = {"start": 1, "stop": 2, "preop": 128, "reset": 129, "reset-communication": 130}
FLOOD_HZ = 5000.0
FLOOD_HZ_MAX = 20_000.0


class Order(msgspec.Struct, frozen=True):
    """One order. ``node``: 0 is the whole bus. ``number``: an error code, a count, an NMT command, as the verb has it.

    ``at_ns``: when, after the start of the rack; None: at once.
    """

    verb: str
    node: int = 0
    number: int = 0
    duration_ns: int = 0
    rate_hz: float = 0.0
    what: str = ""
    at_ns: int | None = None


def parse_order(text: str) -> Order:
    """An order from its text, e.g. ``lose 2 tpdo1 3 @ 1.5s``. Raises OrderError."""
    verb, words, at_ns = split_order(text, GRAMMAR)
    try:
        return msgspec.structs.replace(GRAMMAR[verb][0](verb, words), at_ns=at_ns)
    except OrderError as error:
        raise misused(text, verb, GRAMMAR, error) from None


def help_lines() -> list[str]:
    """One line an order."""
    return usage_lines(GRAMMAR, ("ORDER @ TIME", "at that time after the start, e.g. `silence 4 @ 2.5s`"))


def _node(words: list[str], k: int = 0) -> int:
    if len(words) <= k:
        raise OrderError("the node's number is missing")
    if not words[k].isdecimal() or not 1 <= int(words[k]) <= 126:
        raise OrderError(f"node {words[k]!r}; a number from 1 to 126 is valid")
    return int(words[k])


def _code(words: list[str], k: int) -> int:
    if len(words) <= k:
        raise OrderError("the error code is missing, e.g. 0x3210")
    try:
        code = int(words[k], 0)
    except ValueError:
        raise OrderError(f"error code {words[k]!r}; a number such as 0x3210 is valid") from None
    if not 1 <= code <= 0xFFFFFFFF:
        raise OrderError(f"error code {words[k]!r}; 1 to 0xFFFFFFFF is valid")
    return code


def _count(words: list[str], k: int) -> int:
    if len(words) <= k:
        return 1
    if not words[k].isdecimal() or not 1 <= int(words[k]) <= 1_000_000:
        raise OrderError(f"count {words[k]!r}; 1 to 1000000 is valid")
    return int(words[k])


def _choice(words: list[str], k: int, valid: tuple[str, ...], default: str | None = None) -> str:
    if len(words) <= k:
        if default is None:
            raise OrderError(f"one of {', '.join(valid)} is missing")
        return default
    if words[k] not in valid:
        raise OrderError(f"{words[k]!r}; valid: {', '.join(valid)}")
    return words[k]


def _at_most(words: list[str], count: int) -> None:
    if len(words) > count:
        raise OrderError(f"{' '.join(words[count:])!r} is too much")


def _plain(verb: str, words: list[str]) -> Order:
    _at_most(words, 0)
    return Order(verb)


def _of_node(verb: str, words: list[str]) -> Order:
    _at_most(words, 1)
    return Order(verb, node=_node(words))


def _fault(verb: str, words: list[str]) -> Order:
    words = words[1:] if words[:1] == ["node"] else words
    _at_most(words, 2)
    return Order(verb, node=_node(words), number=_code(words, 1))


def _emcy(verb: str, words: list[str]) -> Order:
    order = _fault(verb, words)
    if order.number > 0xFFFF:
        raise OrderError(f"emergency code {order.number:#x}; at most 0xFFFF is valid")
    return order


def _sticky(verb: str, words: list[str]) -> Order:
    if words[1:] == ["off"]:
        return Order(verb, node=_node(words), what="off")
    return _fault(verb, words)


def _lose(verb: str, words: list[str]) -> Order:
    _at_most(words, 3)
    node = _node(words)
    if len(words) > 1 and words[1].lower().startswith("0x"):
        try:
            can_id = int(words[1], 16)
        except ValueError:
            raise OrderError(f"id {words[1]!r}; hexadecimal, e.g. 0x182") from None
        return Order(verb, node=node, what=f"{can_id:#x}", number=_count(words, 2))
    what = _choice(words, 1, tuple(COB_IDS))
    return Order(verb, node=node, what=what, number=_count(words, 2))


def _late(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    node = _node(words)
    if len(words) < 2:
        raise OrderError("the delay is missing")
    return Order(verb, node=node, duration_ns=duration_ns(words[1]))


def _duplicate(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    return Order(verb, node=_node(words), what=_choice(words, 1, ("boots", "running", "off"), "boots"))


def _cable(verb: str, words: list[str]) -> Order:
    node = _node(words) if words and words[0] not in ("in", "out") else 0
    k = 1 if node else 0
    _at_most(words, k + 1)
    return Order(verb, node=node, what=_choice(words, k, ("in", "out")))


def _adapter(verb: str, words: list[str]) -> Order:
    _at_most(words, 1)
    return Order(verb, what=_choice(words, 0, ("in", "out")))


def _limit(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    side = _choice(words, 1, ("+", "-", "off"))
    return Order(verb, node=_node(words), number={"+": 1, "-": -1, "off": 0}[side])


def _invert(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    return Order(verb, node=_node(words), what=_choice(words, 1, ("on", "off"), "on"))


def _nmt(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    what = _choice(words, 0, tuple(NMT))
    return Order(verb, what=what, number=NMT[what], node=_node(words, 1) if len(words) > 1 else 0)


def _flood(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    node = _node(words)
    rate = FLOOD_HZ
    if len(words) > 1:
        try:
            rate = float(words[1])
        except ValueError:
            rate = -1.0
        if not 1.0 <= rate <= FLOOD_HZ_MAX:
            raise OrderError(f"rate {words[1]!r} Hz; 1 to {FLOOD_HZ_MAX:g} is valid")
    return Order(verb, node=node, rate_hz=rate)


GRAMMAR: dict[str, tuple[Callable[[str, list[str]], Order], str, str]] = {
    "fault": (_fault, "fault [node] N CODE", "drive N trips with an error code, e.g. `fault node 3 0x3210`"),
    "sticky": (_sticky, "sticky N CODE|off", "the same, and the cause stays: it trips again after each reset"),
    "emcy": (_emcy, "emcy N CODE", "an emergency frame of node N without a fault"),
    "silence": (_of_node, "silence N", "node N hears but sends nothing"),
    "speak": (_of_node, "speak N", "ends `silence`"),
    "reboot": (_of_node, "reboot N", "node N loses its power supply for a moment"),
    "lose": (_lose, "lose N FRAME|0xID [COUNT]", f"its next frames are lost; FRAME: {', '.join(COB_IDS)}"),
    "late": (_late, "late N TIME|0", "everything that node N sends comes later by so much, e.g. `late 2 6ms`"),
    "duplicate": (
        _duplicate, "duplicate N [boots|running|off]", "a second drive numbered N: switched on now, or there already",
    ),
    "remap": (_of_node, "remap N", "somebody changes the mapping of node N's TPDO 1"),
    "cable": (_cable, "cable [N] out|in", "the bus cable at the master, or at node N"),
    "adapter": (_adapter, "adapter out|in", "the adapter is unplugged: its connection closes"),
    "drop-sync": (_plain, "drop-sync", "the master's SYNC does not get through"),
    "pass-sync": (_plain, "pass-sync", "ends `drop-sync`"),
    "limit": (_limit, "limit N +|-|off", "the limit switch of that side"),
    "nmt": (_nmt, "nmt COMMAND [N]", f"an NMT command of a foreign master, to all or to N: {', '.join(NMT)}"),
    "flood": (_flood, "flood N [HZ]", f"node N babbles ({FLOOD_HZ:g} Hz, id 0x17F)"),
    "calm": (_of_node, "calm N", "ends `flood`"),
    "invert": (_invert, "invert N [on|off]", "the encoder of node N counts against the motion"),
    "block": (_of_node, "block N", "the joint of node N is in contact: it cannot move"),
    "free": (_of_node, "free N", "ends `block`"),
    "status": (_plain, "status", "the state of all drives"),
    "help": (_plain, "help", "this list"),
}  # fmt: skip
"""Order -> its parser, its usage, its meaning."""
