"""The fault console's language."""

import pytest

from stereoservo_sim.emulators.bus.bus_emulator import LANGUAGE
from stereoservo_sim.emulators.bus.bus_emulator import BusCommand as Command
from stereoservo_sim.emulators.fault_engine import FaultCommandError

GOOD = {
    "fault node 3 0x3210": Command("fault", node=3, number=0x3210),
    "fault 3 12816": Command("fault", node=3, number=0x3210),
    "sticky 3 0x4310": Command("sticky", node=3, number=0x4310),
    "sticky 3 off": Command("sticky", node=3, what="off"),
    "emcy 3 0x8611": Command("emcy", node=3, number=0x8611),
    "silence 4": Command("silence", node=4),
    "speak 4": Command("speak", node=4),
    "reboot 5": Command("reboot", node=5),
    "lose 2 tpdo1": Command("lose", node=2, what="tpdo1", number=1),
    "lose 2 heartbeat 5": Command("lose", node=2, what="heartbeat", number=5),
    "lose 2 0x049 3": Command("lose", node=2, what="0x49", number=3),
    "late 2 6ms": Command("late", node=2, duration_ns=6_000_000),
    "late 2 0": Command("late", node=2),
    "late 2 1.5us": Command("late", node=2, duration_ns=1500),
    "duplicate 3": Command("duplicate", node=3, what="boots"),
    "duplicate 3 running": Command("duplicate", node=3, what="running"),
    "remap 3": Command("remap", node=3),
    "cable out": Command("cable", what="out"),
    "cable 3 in": Command("cable", node=3, what="in"),
    "adapter out": Command("adapter", what="out"),
    "drop-sync": Command("drop-sync"),
    "pass-sync": Command("pass-sync"),
    "limit 2 +": Command("limit", node=2, number=1),
    "limit 2 -": Command("limit", node=2, number=-1),
    "limit 2 off": Command("limit", node=2),
    "nmt stop": Command("nmt", what="stop", number=2),
    "nmt reset 4": Command("nmt", what="reset", number=129, node=4),
    "flood 5": Command("flood", node=5, rate_hz=5000.0),
    "flood 5 2000": Command("flood", node=5, rate_hz=2000.0),
    "calm 5": Command("calm", node=5),
    "invert 2": Command("invert", node=2, what="on"),
    "invert 2 off": Command("invert", node=2, what="off"),
    "block 2": Command("block", node=2),
    "free 2": Command("free", node=2),
    "status": Command("status"),
    "help": Command("help"),
    "  SILENCE 4 @ 2.5s ": Command("silence", node=4, at_ns=2_500_000_000),
    "drop-sync@0": Command("drop-sync", at_ns=0),
    "late 2 6ms for 2s @ 1s": Command("late", node=2, duration_ns=6_000_000, for_ns=2_000_000_000, at_ns=1_000_000_000),
    "cable 3 out for 50ms": Command("cable", node=3, what="out", for_ns=50_000_000),
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
    "reboot 4 for 2s": "`for` makes no sense here; it does with silence, late",
    "silence 4 for": "`for` ends an order, with one time",
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
    assert LANGUAGE.parse(text) == GOOD[text]


@pytest.mark.parametrize("text", BAD)
def test_what_is_no_order_is_told_what_would_be(text):
    with pytest.raises(FaultCommandError) as refused:
        LANGUAGE.parse(text)
    assert BAD[text] in str(refused.value)


def test_every_order_is_tried_and_explained():
    assert {text.split()[0].split("@")[0].lower() for text in GOOD} == set(LANGUAGE.verbs)
    lines = LANGUAGE.help_lines()
    for name, verb in LANGUAGE.verbs.items():
        assert verb.usage.split()[0] == name
        assert any(line.startswith(verb.usage) and line.endswith(verb.meaning) for line in lines)
