"""Arms whose joints stand elsewhere than they read, by as much as the model states: the watch stays calm, goals end by
the pictures, and what is no error of the joints is still told.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import ModelUpdate
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.messages.goals import FeatureTarget

SEEDS = range(3)


def stated(deviation: float) -> JointAccuracy:
    """A model's statement that each reading is off by ``deviation`` [rad]."""
    return JointAccuracy(np.full(6, deviation), np.zeros(6), np.full(6, deviation), np.zeros(6))


def imperfect(benches: Any, seed: int, play: float, accuracy: JointAccuracy | None) -> Any:
    """A ready bench of an arm with ``play`` [rad] to either side in each joint, whose model states ``accuracy``."""
    bench = benches(seed, noise_px=0.05)
    bench.truth.model = msgspec.structs.replace(bench.truth.model, joint_accuracy=accuracy)
    bench.play = np.full(6, play)
    return bench.ready()


def run_goals(bench: Any, seed: int, count: int = 2) -> tuple[list[float], set[str]]:
    """True errors [px] at goals that were told to be reached, and all verdicts of the watch on the way."""
    rng = np.random.default_rng(seed)
    errors = []
    home = bench.q.copy()
    for _ in range(count):
        q = home + rng.uniform(-0.15, 0.15, 6)
        assert bench.reply(bench.goal(FeatureTarget(bench.features(q)), law="cartesian3")).accepted
        if bench.ended(40.0).kind == "goal_reached":
            bench.run(1.0)
            errors.append(float(np.linalg.norm(bench.truth.pixels(bench.q) - bench.truth.pixels(q), axis=-1).max()))
    return errors, {outputs.status.health.verdict for _, outputs in bench.log}


@pytest.mark.parametrize("play_deg", [0.5, 1.0])
def test_play_that_the_model_states_is_no_verdict_and_goals_end_by_the_pictures(benches: Any, play_deg: float) -> None:
    play = np.radians(play_deg)
    for seed in SEEDS:
        bench = imperfect(benches, seed, play, stated(play))
        errors, verdicts = run_goals(bench, seed)
        assert verdicts <= {"ok", "unknown"}, seed
        assert len(errors) == 2, seed
        assert max(errors) <= 2.0 * bench.settings.tolerance_px, seed


def test_the_same_play_unstated_is_told(benches: Any) -> None:
    for seed in SEEDS:
        bench = imperfect(benches, seed, np.radians(1.0), None)
        goal = FeatureTarget(bench.features(bench.q + 0.1))
        assert bench.reply(bench.goal(goal, law="cartesian3")).accepted
        told = bench.until(lambda event: event.kind == "health", 10.0)
        assert told.name == "cameras_or_arm", seed


def standing_beside(benches: Any, seed: int) -> tuple[Any, np.random.Generator]:
    """A bench at rest whose joints stand beside their readings by up to half a degree, as the model states."""
    rng = np.random.default_rng(seed)
    bench = imperfect(benches, seed, 0.0, stated(np.radians(0.3)))
    bench.zero_offset = np.radians(0.5) * rng.uniform(-1.0, 1.0, 6)
    bench.run(0.5)
    assert bench.log[-1][1].status.health.verdict == "ok"
    return bench, rng


@pytest.mark.parametrize("degrees", [0.3, 2.0])
def test_a_bumped_camera_is_told_of_an_arm_beside_its_readings(benches: Any, degrees: float) -> None:
    for seed in SEEDS:
        bench, _ = standing_beside(benches, seed)
        angle = np.radians(degrees)
        turn = np.eye(4)
        turn[np.ix_([0, 2], [0, 2])] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        K = np.array([[800, 0, 320], [0, 800, 240], [0, 0, 1.0]])
        camera = seed % 2
        extrinsic = np.linalg.solve(K, bench.truth.cameras[camera])
        bench.truth.cameras[camera] = K @ (turn @ np.vstack([extrinsic, [0, 0, 0, 1.0]]))[:3]
        told = bench.until(lambda event: event.kind == "health", 1.0)
        if degrees > 1.0:  # a small one may as well be the joints, to the other camera
            assert told.name == "camera_moved", (seed, told.message)
        if told.name == "camera_moved":
            assert told.cameras == (("left", "right")[camera],), seed


def test_a_slipped_marker_is_told_of_an_arm_beside_its_readings(benches: Any) -> None:
    for seed in SEEDS:
        bench, rng = standing_beside(benches, seed)
        marker = int(rng.integers(8))
        bench.bias_px = np.zeros((8, 2))
        bench.bias_px[marker] = (4.0, -3.0)
        told = bench.until(lambda event: event.kind == "health", 1.0)
        assert told.name == "marker_slipped", (seed, told.message)
        assert f"marker {marker} " in told.message, seed
        bench.bias_px = 0.0
        bench.until(lambda event: "used again" in event.message, 5.0)


def test_an_outlier_is_left_out_where_joints_pass_through_their_play(benches: Any) -> None:
    for seed in SEEDS:
        bench, _ = standing_beside(benches, seed)
        before = bench.core.state.cameras[0].innovation.copy()
        bench.zero_offset = -bench.zero_offset
        bench.bias_px = np.zeros((8, 2))
        bench.bias_px[3] = (30.0, 10.0)
        bench.run(0.1)
        found = bench.core.state.cameras[0]
        assert found.last_visible == 7, seed
        change = np.linalg.norm(found.innovation - before, axis=1)
        assert change[3] < 0.3 < change[[0, 1, 2, 4, 5, 6, 7]].min(), (seed, change)


def test_what_a_model_states_of_its_joints_has_a_bound(benches: Any) -> None:
    bench = imperfect(benches, 0, 0.0, stated(1e6))
    for _ in range(1000):  # slowly: a jump, or a joint that does not follow, is a fault of its own
        bench.zero_offset[0] += 0.9e-3
        bench.step()
    assert any(event.kind == "health" for event in bench.events)
    short = msgspec.structs.replace(bench.truth.model, joint_accuracy=JointAccuracy(*(np.zeros(2),) * 4), epoch=8)
    bench.step(model_update=ModelUpdate(short))
    assert "errors of joint readings" in bench.events[-1].message


def test_a_zero_that_is_off_by_far_more_is_told(benches: Any) -> None:
    for seed in SEEDS:
        bench = imperfect(benches, seed, 0.0, stated(np.radians(0.1)))
        bench.zero_offset[seed] = np.radians(1.5)
        told = bench.until(lambda event: event.kind == "health", 1.0)
        assert told.name == "joint_zero", seed
        assert f"joint {bench.settings.joint_names[seed]} " in told.message
