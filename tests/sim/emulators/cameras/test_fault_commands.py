"""Orders to emulated cameras: what they say, and what is said about those that cannot be."""

from __future__ import annotations

import pytest

from stereoservo_sim.emulators.cameras.camera_emulator import LANGUAGE
from stereoservo_sim.emulators.cameras.camera_emulator import CameraCommand as Command
from stereoservo_sim.emulators.fault_engine import FaultCommandError

MS = 1_000_000
ORDERS = {
    "freeze left": Command("freeze", "left"),
    "freeze left for 2s": Command("freeze", "left", for_ns=2000 * MS),
    "drop all for 2s @ 1.5s": Command("drop", "all", for_ns=2000 * MS, at_ns=1500 * MS),
    "latency left 80ms": Command("latency", "left", time_ns=80 * MS),
    "skew right 0": Command("skew", "right"),
    "loss left 10%": Command("loss", "left", 0.1),
    "loss left 0.25": Command("loss", "left", 0.25),
    "exposure left 0.5": Command("exposure", "left", 0.5),
    "lamp on": Command("lamp", "all", what="on"),
    "swap left right": Command("swap", "left", what="right"),
    "truncate left": Command("truncate", "left", 1.0),
    "truncate left 3": Command("truncate", "left", 3.0),
    "size left 320x240": Command("size", "left", size=(320, 240)),
    "bump left 5deg 3cm": Command("bump", "left", 5.0, 0.03, what="y"),
    "bump left -3mm about z": Command("bump", "left", 0.0, -0.003, what="z"),
    "bump left back": Command("bump", "left", what="back"),
    "STATUS": Command("status"),
}


@pytest.mark.parametrize("text", ORDERS)
def test_an_order_is_what_its_text_says(text: str) -> None:
    assert LANGUAGE.parse(text) == ORDERS[text]


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
    with pytest.raises(FaultCommandError) as refused:
        LANGUAGE.parse(text)
    assert told in str(refused.value)


def test_every_order_is_helped_with_and_can_be_done() -> None:
    lines = LANGUAGE.help_lines()
    assert len(lines) == len(LANGUAGE.verbs) + 2
    for name, line in zip(LANGUAGE.verbs, lines, strict=False):
        assert line.split()[0] == name
    assert LANGUAGE.lasting == (
        "freeze", "drop", "stall", "refuse", "latency", "jitter", "skew", "loss", "exposure", "lamp", "black", "white",
        "flip", "mirror", "size", "swap",
    )  # fmt: skip


@pytest.mark.parametrize("number", ["1000001", "9" * 20, "9" * 400])
def test_a_time_without_end_is_refused(number):
    for order in (f"latency left {number}s", f"freeze left for {number}s", f"freeze left @ {number}s"):
        with pytest.raises(FaultCommandError, match="up to 1000000 s is valid"):
            LANGUAGE.parse(order)
    assert LANGUAGE.parse("latency left 1000000s").time_ns == 10**15
