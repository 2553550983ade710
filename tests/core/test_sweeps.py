"""Calibration by sweeps in the core: where joints sweep, what is recorded, and what ends it."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.messages.goals import Calibrate, Enable

GOAL = "00000011"
COUNT = 2.0 * np.pi / 4096
ENDS = ("calibration_finished", "calibration_aborted")


def sweeping(bench: Any, **changes: Any) -> Any:
    """The bench's core with trial motions that sweep."""
    trials = msgspec.structs.replace(bench.settings.trials, sweeps=True, together=16, **changes)
    bench.settings = msgspec.structs.replace(bench.settings, trials=trials)
    bench.core = ServoCore(bench.settings)
    return bench


def calibrated(bench: Any, seconds: float = 120.0) -> tuple[Any, list[Any]]:
    bench.run(0.1)
    bench.step(Enable())
    assert bench.reply(Calibrate(GOAL)).accepted
    end = bench.until(lambda e: e.kind in ENDS, seconds)
    return end, [e for e in bench.events if e.kind == "calibration_frames"]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_model_is_learnt_from_seconds_of_sweeps(benches: Any, seed: int) -> None:
    bench = sweeping(benches(seed, noise_px=0.05), range=np.full(6, 0.3))
    base = bench.settings.trials.base
    start_ns = bench.now_ns
    end, chunks = calibrated(bench)
    assert end.kind == "calibration_finished", end
    seconds = 1e-9 * (bench.now_ns - start_ns)
    print(f"seed {seed}: {seconds:.1f} s")
    assert seconds < 30.0  # virtual time: the motion's own
    positions = np.concatenate([chunk.path.positions for chunk in chunks])
    assert (np.abs(positions - base) <= 0.3 + 0.15).all()  # an outward sweep brakes beyond where it is enough
    collector = TrialCollector(bench.settings)
    for event in bench.events:
        collector.add(event)
    trials = collector.trials()
    assert set(trials.trials.tolist()) == {-1, 0, 1, 2, 3, 4, 5}
    fit = fit_model(trials, epoch=1)
    assert fit.model.stratum == "metric"
    held = base + np.random.default_rng([seed, 4]).uniform(-0.2, 0.2, (20, 6))
    errors = [fit.model.cameras and bench.truth.pixels(q) for q in held]
    assert len(errors) == 20
    assert fit.model.statistics is not None
    assert fit.model.statistics.chi2_ok


def test_without_ranges_sweeps_end_before_the_border_of_a_view(benches: Any) -> None:
    bench = sweeping(benches(0, noise_px=0.05), range=np.full(6, np.nan))
    end, chunks = calibrated(bench)
    assert end.kind == "calibration_finished", end
    for chunk in chunks:
        if chunk.trial < 0:
            continue
        for frame in chunk.path.frames:
            assert frame.ids.size >= 4, (chunk.trial, frame.t_ns)


def test_every_frame_is_recorded_once_with_its_shutter_time(bench: Any) -> None:
    sweeping(bench, range=np.full(6, 0.2))
    end, chunks = calibrated(bench)
    assert end.kind == "calibration_finished", end
    stamps = [(frame.camera, frame.t_ns) for chunk in chunks for frame in chunk.path.frames]
    assert len(set(stamps)) == len(stamps)
    for camera in (0, 1):
        of_camera = np.array([t for c, t in stamps if c == camera])
        assert (np.diff(of_camera) == 40_000_000).all()  # 25 Hz, none missing
    joints = np.concatenate([chunk.path.joints_ns for chunk in chunks])
    assert (np.diff(joints) > 0).all()


def test_markers_that_are_not_seen_at_the_base_are_said(bench: Any) -> None:
    sweeping(bench, range=np.full(6, 0.2))
    bench.marker_mask[:] = False
    end, chunks = calibrated(bench)
    assert end.kind == "calibration_aborted"
    assert end.reasons[0].code in ("MARKERS_NOT_SEEN", "CAMERA_SILENT")
    assert not chunks


def test_a_joint_that_hardly_moves_the_markers_is_named(benches: Any) -> None:
    bench = sweeping(benches(0, noise_px=0.05), range=np.array([0.1] * 5 + [0.01]), min_range=0.005, frames=1)
    end, _ = calibrated(bench)
    assert end.kind == "calibration_aborted"
    assert (end.reasons[0].code, end.reasons[0].subject) == ("TRIAL_TOO_SMALL", "j6")


def test_the_state_of_sweeps_survives_encoding(bench: Any) -> None:
    sweeping(bench, range=np.full(6, 0.2))
    bench.run(0.1)
    bench.step(Enable())
    assert bench.reply(Calibrate(GOAL)).accepted
    bench.until(lambda e: e.kind == "calibration_frames", 60.0)
    state = bench.core.state
    copy = decode_state(encode_state(state))
    assert type(copy.source) is type(state.source)
    assert encode_state(copy) == encode_state(state)


def jitter_stamps(bench: Any, rng: np.random.Generator) -> None:
    """Let the stamps of the frames deviate by a millisecond."""
    shutter = bench._shutter

    def jittered() -> None:
        before = len(bench.pending)
        shutter()
        for k in range(before, len(bench.pending)):
            stamped = bench.pending[k].t_shutter_ns + round(rng.normal(0.0, 1e6))
            bench.pending[k] = msgspec.structs.replace(bench.pending[k], t_shutter_ns=stamped)

    bench._shutter = jittered


@pytest.mark.parametrize("jitters", [False, True])
def test_the_arm_stops_where_stamps_are_not_exact(benches: Any, jitters: bool) -> None:
    bench = sweeping(benches(2, noise_px=0.05), range=np.full(6, 0.3))
    if jitters:
        jitter_stamps(bench, np.random.default_rng(2))
    end, chunks = calibrated(bench, 300.0)
    assert end.kind == "calibration_finished", end
    said = [e.message for e in bench.events if e.kind == "warning" and "stamps of camera" in e.message]
    assert len(said) == (1 if jitters else 0), said
    collector = TrialCollector(bench.settings)
    for event in bench.events:
        collector.add(event)
    assert chunks
    assert (collector.stops > 10) == jitters
    assert (collector.frames == 0) == jitters
    assert fit_model(collector.trials(), epoch=1).model.stratum == "metric"


def test_coarse_encoders_are_known_better_by_sweeps_than_at_stops(benches: Any) -> None:
    """A joint at rest is within a step; one that passes many of them is known to a fraction of a step."""
    errors = {}
    for sweeps in (True, False):
        bench = sweeping(benches(2, noise_px=0.05), range=np.full(6, np.nan), frames=5, stops=9)
        trials = msgspec.structs.replace(bench.settings.trials, sweeps=sweeps)
        bench.settings = msgspec.structs.replace(bench.settings, trials=trials, resolution=(COUNT,) * 6)
        bench.core = ServoCore(bench.settings)
        bench.resolution = COUNT
        start_ns = bench.now_ns
        end, _ = calibrated(bench, 300.0)
        assert end.kind == "calibration_finished", end
        seconds = 1e-9 * (bench.now_ns - start_ns)
        collector = TrialCollector(bench.settings)
        for event in bench.events:
            collector.add(event)
        model = fit_model(collector.trials(), epoch=1).model
        assert model.statistics is not None
        assert model.statistics.chi2_ok
        held = bench.settings.trials.base + np.random.default_rng(5).uniform(-0.25, 0.25, (40, 6))
        found, covariances = pixel_covariances(model, held)
        exact = np.array([bench.truth.pixels(q) for q in held]).transpose(1, 0, 2, 3)
        errors[sweeps] = float(np.sqrt(((found - exact) ** 2).mean()))
        stated = float(np.sqrt(0.5 * np.trace(covariances, axis1=-2, axis2=-1).mean()))
        kind = "sweeps" if sweeps else "stops"
        print(f"{kind}: {seconds:.0f} s, held-out error {errors[sweeps]:.3f} px, stated {stated:.3f} px")
        assert errors[sweeps] < 2.0 * stated
    assert errors[True] < errors[False]
