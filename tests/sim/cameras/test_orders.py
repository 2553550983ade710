"""Orders to emulated cameras: what they say, and what is said about those that cannot be."""

from __future__ import annotations

import pytest

from stereoservo_sim.cameras.obeying import _ACTS
from stereoservo_sim.cameras.orders import GRAMMAR, LASTING, Order, help_lines, parse_order
from stereoservo_sim.emulation.errors import OrderError

MS = 1_000_000
ORDERS = {
    "freeze left": Order("freeze", "left"),
    "freeze left for 2s": Order("freeze", "left", for_ns=2000 * MS),
    "drop all for 2s @ 1.5s": Order("drop", "all", for_ns=2000 * MS, at_ns=1500 * MS),
    "latency left 80ms": Order("latency", "left", time_ns=80 * MS),
    "skew right 0": Order("skew", "right"),
    "loss left 10%": Order("loss", "left", 0.1),
    "loss left 0.25": Order("loss", "left", 0.25),
    "exposure left 0.5": Order("exposure", "left", 0.5),
    "lamp on": Order("lamp", "all", what="on"),
    "swap left right": Order("swap", "left", what="right"),
    "truncate left": Order("truncate", "left", 1.0),
    "truncate left 3": Order("truncate", "left", 3.0),
    "size left 320x240": Order("size", "left", size=(320, 240)),
    "bump left 5deg 3cm": Order("bump", "left", 5.0, 0.03, what="y"),
    "bump left -3mm about z": Order("bump", "left", 0.0, -0.003, what="z"),
    "bump left back": Order("bump", "left", what="back"),
    "STATUS": Order("status"),
}


@pytest.mark.parametrize("text", ORDERS)
def test_an_order_is_what_its_text_says(text: str) -> None:
    assert parse_order(text) == ORDERS[text]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "an empty order; orders: freeze"),
        ("melt left", "no order 'melt'"),
        ("freeze", "the camera's name is missing; usage: freeze CAM"),
        ("freeze left right", "'right' is too much"),
        ("freeze left for", "`for` ends an order"),
        ("freeze left for 2", "a number with us, ms or s"),
        ("freeze left for 0", "a time above 0"),
        ("freeze left @ soon", "time 'soon'"),
        ("disconnect left for 2s", "`for` makes no sense here"),
        ("latency left", "missing"),
        ("loss left 110%", "share '110%'; 0 to 1 is valid"),
        ("loss left nan", "0 to 1 is valid"),
        ("exposure left bright", "factor 'bright'"),
        ("lamp dim", "valid: on, off"),
        ("swap left left", "two different cameras"),
        ("swap left all", "two different cameras"),
        ("truncate left 1.5", "a whole number"),
        ("size left 0x5", "WIDTHxHEIGHT"),
        ("bump left", "the angle or the length is missing"),
        ("bump left 400deg", "an angle up to 180deg"),
        ("bump left 5deg about w", "x, y or z"),
    ],
)
def test_what_cannot_be_is_told_with_what_would_be_valid(text: str, told: str) -> None:
    with pytest.raises(OrderError) as refused:
        parse_order(text)
    assert told in str(refused.value)


def test_every_order_is_helped_with_and_can_be_done() -> None:
    lines = help_lines()
    assert len(lines) == len(GRAMMAR) + 2
    for verb, line in zip(GRAMMAR, lines, strict=False):
        assert line.split()[0] == verb
    assert set(_ACTS) | {"swap", "status", "help"} == set(GRAMMAR)
    assert set(LASTING) <= set(GRAMMAR)


@pytest.mark.parametrize("number", ["1000001", "9" * 20, "9" * 400])
def test_a_time_without_end_is_refused(number):
    for order in (f"latency left {number}s", f"freeze left for {number}s", f"freeze left @ {number}s"):
        with pytest.raises(OrderError, match="up to 1000000 s is valid"):
            parse_order(order)
    assert parse_order("latency left 1000000s").time_ns == 10**15
