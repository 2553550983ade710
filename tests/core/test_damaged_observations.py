"""Records of slots and sockets with flipped and foreign bytes: left out, or of a shape that the core can work with."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import check_observation, encode
from stereoservo.daemon.ipc_messages import (
    decode_observation,
    decode_prior,
    encode_observation,
    encode_prior,
    event_decoder,
    report_decoder,
    state_decoder,
    to_servo_decoder,
    unpack_step_message,
)
from stereoservo.messages.decoding import RecordBoundary
from stereoservo.ports.devices import CameraObservation, Prior

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


@pytest.mark.parametrize("k", [0, 1, 256])
def test_observations_and_priors_come_back_bit_for_bit(k: int) -> None:
    rng = np.random.default_rng(k)
    ids, pixels, covariances = (
        rng.permutation(1000)[:k] - 500,
        rng.normal(size=(k, 2)),
        rng.normal(size=(k, 2, 2)),
    )
    pixels[:1, 0] = np.nan
    observation = CameraObservation("links-ü", 2**62, -5, 2**40, ids, pixels, covariances)
    prior = Prior("right", 7, ids, pixels, rng.normal(size=(k, 2)), covariances)
    assert encode(decode_observation(encode_observation(observation))) == encode(observation)
    assert encode(decode_prior(encode_prior(prior))) == encode(prior)
    one = msgspec.structs.replace(observation, ids=ids.astype(np.uint8), pixels=np.asfortranarray(pixels))
    check_observation(one)
    taken = decode_observation(encode_observation(one))
    np.testing.assert_array_equal(taken.ids, one.ids)
    np.testing.assert_array_equal(taken.pixels, pixels)


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
            observation = decode_observation(damaged(encode_observation(newest), rng))
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
        decode_observation, decode_prior, event_decoder.decode, state_decoder.decode, unpack_step_message,
        report_decoder.decode, to_servo_decoder.decode,
    ],
    ids=["observation", "prior", "event", "state", "steps", "report", "to_servo"],
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
