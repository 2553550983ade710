"""What recording costs, in counts: nothing is encoded in a usual step, and an arm at rest takes few bytes."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo.daemon.ipc_messages import rounded
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation
from stereoservo.recording import step_layout
from stereoservo.recording.compression import Checkpoints, StepBlocks
from stereoservo.recording.step_layout import decode_step, encode_step
from stereoservo_sim.benchmarks.cycle import CoreLoop, drive
from stereoservo_sim.world.synthetic import rx90


def test_nothing_is_encoded_in_a_usual_step(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, kept = CoreLoop(rx90(), 1), []
    step = loop.core.step
    monkeypatch.setattr(loop.core, "step", lambda inputs: kept.append((inputs, step(inputs))) or kept[-1][1])
    drive(loop, "stereo", 120)
    encoded = []
    monkeypatch.setattr(step_layout, "encode", lambda value: encoded.append(value) or b"")
    usual = [(inputs, outputs) for inputs, outputs in kept[-100:] if not outputs.events]
    assert len(usual) > 80
    assert any(inputs.observations for inputs, _ in usual)
    encode_step(*usual[0])
    encoded.clear()
    for inputs, outputs in usual:
        encode_step(inputs, outputs)
    frames = sum(bool(inputs.observations) for inputs, _ in usual)
    assert len(encoded) <= frames + 2, "of the health, which a frame may change"


def test_an_arm_at_rest_takes_half_a_gigabyte_a_day_at_most() -> None:
    """Two cameras at 30 Hz with 14 noisy markers, a loop at 250 Hz that wakes up to tens of microseconds late."""
    loop, blocks, again = CoreLoop(rx90(), 1), StepBlocks(), StepBlocks()
    loop.take_model()
    rng, records, size = np.random.default_rng(4), [], 0
    kept = []
    step = loop.core.step
    loop.core.step = lambda inputs: kept.append((inputs, step(inputs))) or kept[-1][1]  # type: ignore[method-assign]
    images = loop._images

    def noisy() -> tuple[CameraObservation, ...]:
        return tuple(noisy_observation(one, rng) for one in images())

    loop._images = noisy  # type: ignore[method-assign]
    seconds = 8.0
    for _ in range(round(seconds * 250)):
        loop.now_ns += int(abs(rng.normal(0.0, 10_000)))
        loop.step()
    records = [encode_step(inputs, outputs) for inputs, outputs in kept]
    for k in range(0, len(records), 100):
        block = blocks.compress(records[k : k + 100])
        assert again.restore(block) == records[k : k + 100]
        size += len(block) + 160  # of the file
    frames = sum(len(inputs.observations) for inputs, _ in kept)
    assert frames == pytest.approx(seconds * 2 * 25, abs=2)
    assert size / seconds * 86_400 < 0.5e9
    assert decode_step(records[-1]).inputs.now_ns == kept[-1][0].now_ns


def noisy_observation(observation: CameraObservation, rng: np.random.Generator) -> CameraObservation:
    """As a detector sees it: sigmas of 0.005 px that are known to a twentieth."""
    k = len(observation.ids)
    roots = rng.normal(0.0, 0.005, (k, 2, 2)) * 0.05 + 0.005 * np.eye(2)
    covariances = roots @ roots.transpose(0, 2, 1)
    pixels = observation.pixels + rng.normal(0.0, 0.005, (k, 2))
    made = CameraObservation(
        observation.camera, observation.seq, observation.t_shutter_ns, observation.t_received_ns,
        observation.ids, pixels, covariances,
    )  # fmt: skip
    return rounded(made)


def test_rounding_states_no_less_noise_and_keeps_covariances_definite() -> None:
    rng = np.random.default_rng(5)
    k = 2000
    scales = 10.0 ** rng.uniform(-4, 1, (k, 1, 1))
    roots: FloatArray = rng.normal(size=(k, 2, 2)) * scales
    covariances = roots @ roots.transpose(0, 2, 1)
    observation = CameraObservation("left", 1, 2, 3, np.arange(k), rng.uniform(-10, 4000, (k, 2)), covariances)
    found = rounded(observation)
    assert np.abs(found.pixels - observation.pixels).max() <= 2.0**-13
    variances = covariances[:, (0, 1), (0, 1)]
    ratio = found.covariances[:, (0, 1), (0, 1)] / variances
    assert ratio.min() >= 1.0
    assert ratio.max() <= 1.0 + 1.0 / 32
    correlations = (found.covariances[:, 0, 1] - covariances[:, 0, 1]) / np.sqrt(variances.prod(axis=1))
    assert np.abs(correlations).max() <= 1.0 / 16
    assert np.all(np.linalg.eigvalsh(found.covariances) > 0.0)
    assert np.array_equal(found.covariances, found.covariances.transpose(0, 2, 1))


def test_a_checkpoint_like_the_one_before_takes_a_twentieth() -> None:
    rng = np.random.default_rng(6)
    state = bytearray(rng.bytes(40_000))
    there, back = Checkpoints(), Checkpoints()
    sizes = []
    for k in range(4):
        state[100 * k : 100 * k + 50] = rng.bytes(50)
        packed = there.compress(bytes(state))
        assert back.restore(packed) == state
        sizes.append(len(packed))
    assert max(sizes[1:]) < sizes[0] / 20
