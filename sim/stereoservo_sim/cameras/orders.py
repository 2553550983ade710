"""What can be ordered of emulated cameras: text to typed orders, with errors that say what there is."""

from __future__ import annotations

import re
from collections.abc import Callable

import msgspec

from stereoservo_sim.emulation.errors import OrderError
from stereoservo_sim.emulation.orders import misused, split_order, usage_lines
from stereoservo_sim.emulation.times import duration_ns

ALL = "all"
_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"(-?\d+(?:\.\d*)?)(mm|cm|m)")
_ANGLE = re.compile(r"(-?\d+(?:\.\d*)?)deg")
_SIZE = re.compile(r"(\d{1,4})x(\d{1,4})")
LARGEST_SIZE = 4096


class Order(msgspec.Struct, frozen=True):
    """One order. ``camera``: its name, or ``all``. ``number``: a count, a share, a gain, an angle [deg], as the verb
    has it; ``length_m``; ``size`` (width, height); ``what``: a second word.

    ``for_ns``: after that it is taken back by itself; 0: never. ``at_ns``: when, after the start; None: at once.
    """

    verb: str
    camera: str = ""
    number: float = 0.0
    length_m: float = 0.0
    time_ns: int = 0
    size: tuple[int, int] = (0, 0)
    what: str = ""
    for_ns: int = 0
    at_ns: int | None = None


def parse_order(text: str) -> Order:
    """An order from its text, e.g. ``freeze left for 2s @ 1.5s``. Raises OrderError."""
    verb, words, at_ns = split_order(text, GRAMMAR)
    try:
        words, lasting = _lasting(verb, words)
        return msgspec.structs.replace(GRAMMAR[verb][0](verb, words), for_ns=lasting, at_ns=at_ns)
    except OrderError as error:
        raise misused(text, verb, GRAMMAR, error) from None


def help_lines() -> list[str]:
    """One line an order."""
    return usage_lines(
        GRAMMAR,
        ("ORDER for TIME", "taken back after that time, e.g. `freeze left for 2s`; CAM may be all"),
        ("ORDER @ TIME", "at that time after the start, e.g. `freeze left for 2s @ 1.5s`"),
    )


def _lasting(verb: str, words: list[str]) -> tuple[list[str], int]:
    """The words before ``for TIME``, and that time [ns]."""
    if "for" not in words:
        return words, 0
    k = words.index("for")
    if verb not in LASTING:
        raise OrderError(f"`for` makes no sense here; it does with {', '.join(LASTING)}")
    if len(words) != k + 2:
        raise OrderError("`for` ends an order, with one time, e.g. for 2s")
    lasting = duration_ns(words[k + 1])
    if lasting == 0:
        raise OrderError("`for` needs a time above 0")
    return words[:k], lasting


def _at_most(words: list[str], count: int) -> None:
    if len(words) > count:
        raise OrderError(f"{' '.join(words[count:])!r} is too much")


def _camera(words: list[str], k: int = 0) -> str:
    if len(words) <= k:
        raise OrderError("the camera's name is missing")
    return words[k]


def _number(
    words: list[str], k: int, what: str, low: float, high: float, default: float | None = None
) -> float:
    if len(words) <= k:
        if default is None:
            raise OrderError(f"the {what} is missing")
        return default
    text = words[k]
    try:
        value = float(text.removesuffix("%")) * (0.01 if text.endswith("%") else 1.0)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise OrderError(f"{what} {text!r}; {low:g} to {high:g} is valid")
    return value


def _plain(verb: str, words: list[str]) -> Order:
    _at_most(words, 0)
    return Order(verb)


def _of_camera(verb: str, words: list[str]) -> Order:
    _at_most(words, 1)
    return Order(verb, _camera(words))


def _timed(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    if len(words) < 2:
        raise OrderError("the camera's name or the time is missing")
    return Order(verb, _camera(words), time_ns=duration_ns(words[1]))


def _loss(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    return Order(verb, _camera(words), _number(words, 1, "share", 0.0, 1.0))


def _exposure(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    return Order(verb, _camera(words), _number(words, 1, "factor", 0.0, 100.0))


def _counted(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    count = _number(words, 1, "count", 1, 1e6, 1.0)
    if count != int(count):
        raise OrderError(f"count {words[1]!r}; a whole number is valid")
    return Order(verb, _camera(words), count)


def _lamp(verb: str, words: list[str]) -> Order:
    _at_most(words, 1)
    if words not in (["on"], ["off"]):
        raise OrderError(f"{' '.join(words)!r}; valid: on, off")
    return Order(verb, ALL, what=words[0])


def _swap(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    order = Order(verb, _camera(words), what=_camera(words, 1))
    if order.camera == order.what or ALL in words:
        raise OrderError("two different cameras are swapped")
    return order


def _size(verb: str, words: list[str]) -> Order:
    _at_most(words, 2)
    match = _SIZE.fullmatch(words[1]) if len(words) > 1 else None
    if match is None or not all(1 <= int(part) <= LARGEST_SIZE for part in match.groups()):
        raise OrderError(f"a size is WIDTHxHEIGHT, 1 to {LARGEST_SIZE} each, e.g. 320x240")
    return Order(verb, _camera(words), size=(int(match[1]), int(match[2])))


def _bump(verb: str, words: list[str]) -> Order:
    if words[1:] == ["back"]:
        return Order(verb, words[0], what="back")
    order = Order(verb, _camera(words), what="y")
    rest = words[1:]
    if len(rest) >= 2 and rest[-2] == "about":
        if rest[-1] not in ("x", "y", "z"):
            raise OrderError(f"axis {rest[-1]!r}; x, y or z is valid")
        order, rest = msgspec.structs.replace(order, what=rest[-1]), rest[:-2]
    for word in rest:
        angle, length = _ANGLE.fullmatch(word), _LENGTH.fullmatch(word)
        if angle is not None and abs(float(angle[1])) <= 180.0:
            order = msgspec.structs.replace(order, number=float(angle[1]))
        elif length is not None and abs(float(length[1])) * _LENGTHS[length[2]] <= 10.0:
            order = msgspec.structs.replace(order, length_m=float(length[1]) * _LENGTHS[length[2]])
        else:
            raise OrderError(
                f"{word!r}; an angle up to 180deg and a length up to 10m are valid, e.g. 5deg 3cm"
            )
    if order.number == 0.0 and order.length_m == 0.0:
        raise OrderError("the angle or the length is missing, e.g. 5deg 3cm")
    return order


GRAMMAR: dict[str, tuple[Callable[[str, list[str]], Order], str, str]] = {
    "freeze": (_of_camera, "freeze CAM", "the same picture comes again and again, with new numbers and stamps"),
    "drop": (_of_camera, "drop CAM", "its pictures are lost; the connection stands"),
    "stall": (_of_camera, "stall CAM", "the stream stops in the middle of a picture; the connection stands"),
    "disconnect": (_of_camera, "disconnect CAM", "its connections are closed; they may come again"),
    "cut": (_of_camera, "cut CAM", "the same, in the middle of a picture"),
    "refuse": (_of_camera, "refuse CAM", "its connections are closed and new ones turned away (503)"),
    "latency": (_timed, "latency CAM TIME", "from shutter to sending, e.g. `latency left 80ms`"),
    "jitter": (_timed, "jitter CAM TIME", "sent up to so much sooner or later"),
    "skew": (_timed, "skew CAM TIME", "its shutters open so much after those of a camera without skew"),
    "loss": (_loss, "loss CAM SHARE", "chance that a picture is lost, e.g. `loss left 10%`"),
    "exposure": (_exposure, "exposure CAM FACTOR", "so many times as long, e.g. `exposure left 0.5`"),
    "lamp": (_lamp, "lamp on|off", "a lamp beside the upper left corners of all pictures"),
    "black": (_of_camera, "black CAM", "the lens cap is on"),
    "white": (_of_camera, "white CAM", "dazzled"),
    "flip": (_of_camera, "flip CAM", "mounted upside down"),
    "mirror": (_of_camera, "mirror CAM", "left for right"),
    "size": (_size, "size CAM WIDTHxHEIGHT", "pictures of another size, e.g. `size left 320x240`"),
    "swap": (_swap, "swap CAM CAM", "their cables are exchanged"),
    "truncate": (_counted, "truncate CAM [COUNT]", "its next JPEGs end in the middle"),
    "corrupt": (_counted, "corrupt CAM [COUNT]", "bytes of its next JPEGs are flipped"),
    "bump": (
        _bump, "bump CAM 5deg 3cm [about x|y|z]", "turned about its own axis (y), shifted along its x; `bump CAM back`",
    ),
    "clear": (_of_camera, "clear CAM", "takes back everything but `bump`"),
    "status": (_plain, "status", "the state of all cameras"),
    "help": (_plain, "help", "this list"),
}  # fmt: skip
"""Order -> its parser, its usage, its meaning."""
LASTING = (
    "freeze", "drop", "stall", "refuse", "latency", "jitter", "skew", "loss", "exposure", "lamp", "black", "white",
    "flip", "mirror", "size", "swap",
)  # fmt: skip
"""Orders that can be taken back by themselves."""
