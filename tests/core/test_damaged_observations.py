"""Records of slots and sockets with flipped and foreign bytes: left out, or of a shape that the core can work with."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import encode
from stereoservo.daemon.ipc_messages import (
    decode_observation,
    event_decoder,
    prior_decoder,
    report_decoder,
    state_decoder,
    to_servo_decoder,
    unpack_step_message,
)
from stereoservo.messages.decoding import RecordBoundary

CASES = [400, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])]


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(whole)
    for _ in range(int(rng.integers(1, 4))):
        at, length = int(rng.integers(len(data))), int(rng.integers(1, 9))
        match int(rng.integers(4)):
            case 0:
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                data[at : at + length] = rng.bytes(length)
            case 2:
                del data[at : at + length]
            case _:
                data[at:at] = rng.bytes(length)
    return bytes(data)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that overflow
@pytest.mark.parametrize("count", CASES)
def test_a_damaged_observation_ends_no_step(bench: Any, count: int) -> None:
    bench.ready()
    rng = np.random.default_rng(count)
    boundary = RecordBoundary("observation-left.slot")
    taken = 0
    for k in range(count):
        last = bench.log[-1][0]
        if not last.observations:
            bench.step()
            continue
        now = last.now_ns + last.period_ns
        newest = msgspec.structs.replace(last.observations[0], seq=10_000 + k, t_shutter_ns=now - 1_000_000)
        inputs = None
        with boundary:
            observation = decode_observation(damaged(encode(newest), rng))
            inputs = msgspec.structs.replace(last, now_ns=now, observations=(observation,), joints=None)
            taken += 1
        if inputs is not None:
            bench.core.step(inputs)
        bench.step()
    assert taken > 0
    assert boundary.refused > 0


@pytest.mark.parametrize(
    "decode",
    [
        prior_decoder.decode, event_decoder.decode, state_decoder.decode, unpack_step_message,
        report_decoder.decode, to_servo_decoder.decode,
    ],
    ids=["prior", "event", "state", "steps", "report", "to_servo"],
)  # fmt: skip
def test_foreign_records_are_left_out(decode: Any) -> None:
    rng = np.random.default_rng(3)
    boundary = RecordBoundary("slot")
    hostile = [
        b"",
        b"\x91" * 100_000,
        b"\x81\xa4type" * 5000,
        b"\xdd\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xa1\xff",
    ]
    for data in [*hostile, *(rng.bytes(int(rng.integers(1, 200))) for _ in range(300))]:
        with boundary:
            decode(data)
    assert boundary.refused == len(hostile) + 300
