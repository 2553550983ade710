"""The fault console's language."""

import pytest

from stereoservo_sim.drives.faults import GRAMMAR, Order, help_lines, parse_order
from stereoservo_sim.emulation.errors import OrderError

GOOD = {
    "fault node 3 0x3210": Order("fault", node=3, number=0x3210),
    "fault 3 12816": Order("fault", node=3, number=0x3210),
    "sticky 3 0x4310": Order("sticky", node=3, number=0x4310),
    "sticky 3 off": Order("sticky", node=3, what="off"),
    "emcy 3 0x8611": Order("emcy", node=3, number=0x8611),
    "silence 4": Order("silence", node=4),
    "speak 4": Order("speak", node=4),
    "reboot 5": Order("reboot", node=5),
    "lose 2 tpdo1": Order("lose", node=2, what="tpdo1", number=1),
    "lose 2 heartbeat 5": Order("lose", node=2, what="heartbeat", number=5),
    "lose 2 0x049 3": Order("lose", node=2, what="0x49", number=3),
    "late 2 6ms": Order("late", node=2, duration_ns=6_000_000),
    "late 2 0": Order("late", node=2),
    "late 2 1.5us": Order("late", node=2, duration_ns=1500),
    "duplicate 3": Order("duplicate", node=3, what="boots"),
    "duplicate 3 running": Order("duplicate", node=3, what="running"),
    "remap 3": Order("remap", node=3),
    "cable out": Order("cable", what="out"),
    "cable 3 in": Order("cable", node=3, what="in"),
    "adapter out": Order("adapter", what="out"),
    "drop-sync": Order("drop-sync"),
    "pass-sync": Order("pass-sync"),
    "limit 2 +": Order("limit", node=2, number=1),
    "limit 2 -": Order("limit", node=2, number=-1),
    "limit 2 off": Order("limit", node=2),
    "nmt stop": Order("nmt", what="stop", number=2),
    "nmt reset 4": Order("nmt", what="reset", number=129, node=4),
    "flood 5": Order("flood", node=5, rate_hz=5000.0),
    "flood 5 2000": Order("flood", node=5, rate_hz=2000.0),
    "calm 5": Order("calm", node=5),
    "invert 2": Order("invert", node=2, what="on"),
    "invert 2 off": Order("invert", node=2, what="off"),
    "block 2": Order("block", node=2),
    "free 2": Order("free", node=2),
    "status": Order("status"),
    "help": Order("help"),
    "  SILENCE 4 @ 2.5s ": Order("silence", node=4, at_ns=2_500_000_000),
    "drop-sync@0": Order("drop-sync", at_ns=0),
}

BAD = {
    "": "orders: fault, sticky",
    "explode 3": "no order 'explode'; orders: fault",
    "fault": "number is missing; usage: fault [node] N CODE",
    "fault 3": "error code is missing, e.g. 0x3210",
    "fault 0 1": "a number from 1 to 126 is valid",
    "fault 127 1": "a number from 1 to 126 is valid",
    "fault x 1": "node 'x'",
    "fault 3 zero": "a number such as 0x3210 is valid",
    "fault 3 0": "1 to 0xFFFFFFFF is valid",
    "emcy 3 0x12345": "at most 0xFFFF is valid",
    "silence 4 5": "'5' is too much; usage: silence N",
    "lose 2": "one of emcy, tpdo1",
    "lose 2 rpdo1": "valid: emcy, tpdo1, tpdo2, tpdo3, tpdo4, sdo, heartbeat",
    "lose 2 0xZZ": "hexadecimal",
    "lose 2 tpdo1 -1": "1 to 1000000 is valid",
    "late 2": "the delay is missing; usage: late N TIME|0",
    "late 2 6": "a number with us, ms or s is valid",
    "duplicate 3 twice": "valid: boots, running, off",
    "cable": "one of in, out is missing",
    "cable up": "node 'up'",
    "adapter 3": "valid: in, out",
    "drop-sync 3": "'3' is too much",
    "limit 2 left": "valid: +, -, off",
    "nmt halt": "valid: start, stop, preop, reset, reset-communication",
    "flood 5 fast": "1 to 20000 is valid",
    "flood 5 nan": "1 to 20000 is valid",
    "invert 2 maybe": "valid: on, off",
    "silence 4 @ soon": "time 'soon'",
    "silence 4 @": "time ''",
}


@pytest.mark.parametrize("text", GOOD)
def test_an_order_is_understood(text):
    assert parse_order(text) == GOOD[text]


@pytest.mark.parametrize("text", BAD)
def test_what_is_no_order_is_told_what_would_be(text):
    with pytest.raises(OrderError) as refused:
        parse_order(text)
    assert BAD[text] in str(refused.value)


def test_every_order_is_tried_and_explained():
    assert {text.split()[0].split("@")[0].lower() for text in GOOD} == set(GRAMMAR)
    lines = help_lines()
    for verb, (_, usage, meaning) in GRAMMAR.items():
        assert usage.split()[0] == verb
        assert any(line.startswith(usage) and line.endswith(meaning) for line in lines)
