"""Offsets of shutter stamps, against markers that really move."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo.core.block import HISTORY
from stereoservo.core.camera_state import CameraTiming
from stereoservo.core.estimate import Moved, TimingSums, fold_timing
from stereoservo.core.ingest import remember_joints
from stereoservo.core.prediction import MODEL_SIGMA_PX, joints_at, velocities_at
from stereoservo.core.report import advice, offset_s
from stereoservo.core.state import JointHistory
from stereoservo.numerics.arrays import FloatArray


def fold(timing: CameraTiming, innovation: FloatArray, velocity: FloatArray, t_ns: int) -> None:
    """Take in a frame of markers of a detector of 0.05 px."""
    noise, used = np.full(len(innovation), 0.05**2), np.ones(len(innovation))
    sums = fold_timing(
        TimingSums(timing.product, timing.square, timing.seen_ns),
        t_ns,
        Moved(innovation, velocity, noise),
        used,
    )
    timing.product, timing.square, timing.seen_ns = sums


def seen(late_s: float, *, seed: int, frames: int = 300, amplitude: float = 60.0, bias: float = 0.1) -> CameraTiming:
    """Markers that swing by ``amplitude`` [px] at 0.5 Hz, predicted for stamps that are ``late_s`` too early."""
    rng = np.random.default_rng(seed)
    timing = CameraTiming()
    offsets = rng.normal(0.0, bias, (6, 2))  # what the model is off by
    w = 2 * np.pi * 0.5
    directions = rng.normal(0, 1, (6, 2))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for k in range(frames):
        t = k / 30.0
        velocity = amplitude * w * np.cos(w * t) * directions
        moved = amplitude * (np.sin(w * (t + late_s)) - np.sin(w * t)) * directions
        innovation = moved + offsets + rng.normal(0.0, 0.05, (6, 2))
        fold(timing, innovation, velocity, round(t * 1e9) + 1)
    return timing


@pytest.mark.parametrize("late_ms", [-20.0, 0.0, 3.0, 15.0])
def test_the_offset_is_found_within_its_deviation(late_ms: float) -> None:
    deviations = []
    for seed in range(40):
        late, deviation = offset_s(seen(1e-3 * late_ms, seed=seed))
        deviations.append((late - 1e-3 * late_ms) / deviation)
    # The stated deviation supposes that the model is off by MODEL_SIGMA_PX anew in each frame: an upper bound here, but
    # for the curvature of the swing, cos(w late) to second order.
    assert np.abs(deviations).max() < 5.0
    assert MODEL_SIGMA_PX > 0.1


def test_nothing_is_said_of_an_arm_at_rest() -> None:
    timing = seen(0.015, seed=1, amplitude=1.0)
    assert offset_s(timing) == (0.0, np.inf)
    assert advice(timing) == ""


def test_advice_names_the_offset_and_the_setting() -> None:
    assert advice(seen(0.0, seed=2)) == ""
    told = advice(seen(0.015, seed=3))
    assert "15" in told
    assert "later than stated" in told
    assert "less latency_s" in told
    assert "more latency_s" in advice(seen(-0.015, seed=4))


def test_old_frames_are_forgotten() -> None:
    timing = seen(0.02, seed=5, frames=600)
    late = [0.0]
    rng = np.random.default_rng(6)
    for k in range(6000):
        t_ns = timing.seen_ns + 33_333_333
        velocity = np.array([[100.0, 0.0]])
        fold(timing, rng.normal(0, 0.05, (1, 2)), velocity, t_ns)
        late.append(offset_s(timing)[0])
        assert timing.seen_ns == t_ns, k
    assert abs(late[-1]) < 0.001


def append(history: JointHistory, t_ns: int, q: float) -> None:
    history.count = remember_joints(history.t_ns, history.positions, history.count, t_ns, np.array([q]))


def test_a_third_of_a_second_of_joint_samples_is_kept_at_a_kilohertz() -> None:
    history = JointHistory(np.zeros(HISTORY, np.int64), np.zeros((HISTORY, 1)))
    for k in range(2000):
        append(history, k * 1_000_000, 1e-3 * k)
    for back_ms in (0, 1, 2, 7, 150, 300):
        found = joints_at(history, (1999 - back_ms) * 1_000_000)
        assert found is not None
        assert found[0] == pytest.approx(1e-3 * (1999 - back_ms), abs=1e-12), back_ms


def test_motion_is_known_between_samples_and_for_one_interval_after_them() -> None:
    history = JointHistory(np.zeros(HISTORY, np.int64), np.zeros((HISTORY, 1)))
    ms = 1_000_000
    for t_ms, q in ((100, 0.0), (104, 0.004), (108, 0.016), (400, 0.3), (404, 0.304)):
        append(history, t_ms * ms, q)
    for t_ms, speed in ((102, 1.0), (106, 3.0), (402, 1.0), (407, 1.0)):
        known, found = velocities_at(history.t_ns, history.positions, history.count, t_ms * ms)
        assert known
        assert found[0] == pytest.approx(speed)
    for t_ms in (99, 200, 399, 409):
        assert not velocities_at(history.t_ns, history.positions, history.count, t_ms * ms)[0], t_ms
