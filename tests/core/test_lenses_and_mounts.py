"""The core behind lenses that bend, and with the cameras on the arm: raw pixels in and out, every law at work."""

from __future__ import annotations

import uuid
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import ModelUpdate
from stereoservo.core.estimate import KNOWN, see_frame, workspace
from stereoservo.core.model_arrays import model_arrays
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state import initial_state
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.messages.goals import FeatureTarget, Goal, Jog, JointTarget, RunGoal, Teach
from stereoservo.ports.devices import CameraObservation

TERMINAL = {"goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted"}
FAR = np.array([0.25, -0.2, 0.15, 0.4, -0.3, 0.5])
NEAR_ON_THE_ARM = np.array([0.1, -0.08, 0.1, 0.2, -0.15, 0.4])
K1 = -0.3


def goal(bench: Any, q: np.ndarray, **options: Any) -> RunGoal:
    target = FeatureTarget(bench.features(q))
    return RunGoal(Goal(str(uuid.UUID(int=bench.seq + 1)), target, **options))


def ended(event: Any) -> bool:
    return event.kind in TERMINAL


def spatial_error(bench: Any, q: np.ndarray) -> float:
    return float(np.linalg.norm(bench.truth.points(bench.q) - bench.truth.points(q), axis=1).max())


def test_the_bench_bends_pixels_as_opencv_does(benches: Any) -> None:
    straight, bent = benches(3), benches(3, k1=K1)
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    q = bent.q + FAR
    ideal = (straight.truth.pixels(q) - (320, 240)) / 800
    rays = np.dstack([ideal, np.ones(ideal.shape[:2])]).reshape(-1, 3)
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array([K1, 0, 0, 0.0]))
    assert np.abs(bent.truth.pixels(q) - straight.truth.pixels(q)).max() > 4.0
    np.testing.assert_allclose(bent.truth.pixels(q).reshape(-1, 2), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("law", ["stereo", "cartesian3"])
@pytest.mark.parametrize("points", ["predicted", "triangulated"])
def test_goal_shown_in_raw_pixels_is_reached_through_lenses(benches: Any, law: str, points: str) -> None:
    bench = benches(1, noise_px=0.05, k1=K1).ready()
    target = bench.q + FAR * (0.5 if law == "stereo" else 1.0)
    assert bench.reply(goal(bench, target, law=law, points=points)).accepted
    event = bench.until(ended, 25.0)
    assert event.kind == "goal_reached", event
    bench.run(0.5)
    assert bench.error_px(target) < 0.3
    assert spatial_error(bench, target) < 2e-3
    assert bench.core.state.cameras[0].rms_px < 0.2  # the model explains what the lens shows


def test_the_lens_is_what_makes_the_images_fit(benches: Any) -> None:
    """The same images under the same model without its lenses contradict it."""
    bench = benches(1, k1=K1)
    pinholes = tuple(
        msgspec.structs.replace(camera, lens=np.array([0.0, 320, 240, 320])) for camera in bench.truth.model.cameras
    )
    bench.truth.model = msgspec.structs.replace(bench.truth.model, cameras=pinholes)
    bench.ready()
    bench.reply(
        RunGoal(Goal("0000000a", JointTarget(dict(zip(bench.settings.joint_names, bench.q + FAR, strict=True)))))
    )
    bench.until(ended, 10.0)
    bench.run(0.3)
    frames = bench.core.state.watching.sightings
    assert min(np.sqrt(np.mean(s.innovation[s.seen > 0.0] ** 2)) for s in frames) > 1.5


@pytest.mark.parametrize("k1", [0.0, K1])
def test_priors_are_raw_pixels_with_raw_velocities(benches: Any, k1: float) -> None:
    bench = benches(2, k1=k1).ready()
    bench.reply(Jog({"j1": 0.3, "j5": -0.4, "j6": 0.5}, lease_s=1.5))
    bench.run(1.0)
    joint_speed = bench.commands[-1]
    h = 1e-5
    checked = 0
    for inputs, outputs in bench.log[-8:]:
        q = inputs.joints.positions
        raw = bench.truth.pixels(q)
        speed = (bench.truth.pixels(q + h * joint_speed) - bench.truth.pixels(q - h * joint_speed)) / (2 * h)
        for prior in outputs.priors:
            camera = ("left", "right").index(prior.camera)
            np.testing.assert_allclose(prior.pixels, raw[camera, prior.ids], atol=1e-6)
            np.testing.assert_allclose(prior.velocities, speed[camera, prior.ids], rtol=1e-4, atol=0.05)
            checked += len(prior.ids)
    assert checked >= 16


def test_prior_covariance_shrinks_where_the_lens_compresses(benches: Any) -> None:
    """A marker that was never seen is expected within 6 ideal pixels, of which a barrel's rim shows fewer."""
    bench = benches(2, k1=K1)
    bench.marker_mask[:] = False
    bench.ready()
    (prior, _) = next(o.priors for _, o in reversed(bench.log) if o.priors)
    lens = bench.truth.lens
    squared = ((bench.truth.pixels(bench.q)[0] - lens[1:3]) ** 2).sum(axis=1)
    areas = np.linalg.det(prior.covariances) / 6.0**4
    assert (areas < 1.0).all()
    assert np.argmin(areas) == np.argmax(squared)


def sights(pixels: list[tuple[float, float]]) -> CameraObservation:
    n = len(pixels)
    covariances = np.tile(0.01 * np.eye(2), (n, 1, 1))
    return CameraObservation("left", 1, 1, 2, np.arange(n), np.array(pixels), covariances)


def test_sights_beyond_the_fold_are_dropped_and_pinholes_pass_untouched(benches: Any) -> None:
    observation = sights([(320.0, 240.0), (620.0, 240.0), (350.0, 260.0)])
    straight, bent = benches(0), benches(0, k1=-1.8)  # folds 229 px from its centre
    seen, pixels = [], []
    for bench in (straight, bent):
        arrays = model_arrays(bench.truth.model, bench.settings)
        rest = np.zeros_like(arrays.zero)
        block, room = initial_state(bench.settings).block, workspace(bench.settings, None)
        block.history_ns[1], block.history_positions[:2], block.numbers.history_count = 1, rest, 2
        block.begin_observations(len(arrays.ids), len(arrays.row_ids))
        room.use(arrays)
        given = observation.ids, observation.pixels, observation.covariances
        room.put_frame(0, 0, (1, 1), given)
        assert see_frame(block.record, room.record, 0) & KNOWN
        found = room.residuals(1)
        seen.append(found.seen[:3].tolist())
        pixels.append((room.of_frame.pixels[0] + found.innovation[: len(arrays.ids)])[:3])
    assert seen == [[True, True, True], [True, False, True]]
    np.testing.assert_allclose(pixels[0], observation.pixels, atol=1e-9)
    np.testing.assert_allclose(pixels[1][0], (320, 240), atol=1e-9)
    assert np.linalg.det(found.covariance[2]) > 1e-4  # a barrel compressed it


def test_set_point_where_the_lens_images_nothing_is_refused_with_its_value(benches: Any) -> None:
    bench = benches(0, k1=-1.8)
    bench.ready()
    target = bench.features(bench.q)
    target["left"][0] = (635.0, 2.0)
    reply = bench.reply(RunGoal(Goal("00000001", FeatureTarget(target))))
    assert not reply.accepted
    assert "marker 0: (635.0, 2.0)" in reply.message
    assert "lens" in reply.message


def test_taught_pixels_stay_raw(benches: Any) -> None:
    bench = benches(5, k1=K1).ready()
    bench.reply(Teach("here", 4))
    taught = bench.until(lambda e: e.kind == "taught", 5.0)
    for camera, sample in enumerate(taught.samples):
        np.testing.assert_allclose(sample.pixels, bench.truth.pixels(bench.q)[camera, sample.ids], atol=1e-9)


@pytest.mark.parametrize(("k1", "mount"), [(K1, "eye_to_hand"), (0.0, "eye_in_hand"), (K1, "eye_in_hand")])
def test_state_survives_serialisation_bit_for_bit(benches: Any, k1: float, mount: str) -> None:
    bench = benches(4, noise_px=0.05, k1=k1, mount=mount).ready()
    bench.reply(goal(bench, bench.q + 0.5 * NEAR_ON_THE_ARM, law="cartesian3"))
    assert np.abs(bench.run(0.4).command).max() > 0.05
    twin = ServoCore(bench.settings, decode_state(encode_state(bench.core.state)))
    start = len(bench.log)
    bench.run(1.0)
    for inputs, outputs in bench.log[start:]:
        assert twin.step(inputs).command.tobytes() == outputs.command.tobytes()
    assert encode_state(twin.state) == encode_state(bench.core.state)


@pytest.mark.parametrize("law", ["stereo", "cartesian3"])
@pytest.mark.parametrize("points", ["predicted", "triangulated"])
@pytest.mark.parametrize("k1", [0.0, K1])
def test_arm_that_carries_the_cameras_reaches_its_goal(benches: Any, law: str, points: str, k1: float) -> None:
    bench = benches(6, noise_px=0.05, k1=k1, mount="eye_in_hand").ready()
    target = bench.q + NEAR_ON_THE_ARM
    assert bench.reply(goal(bench, target, law=law, points=points)).accepted
    event = bench.until(ended, 25.0)
    assert event.kind == "goal_reached", event
    bench.run(0.5)
    assert bench.error_px(target) < 0.3
    assert spatial_error(bench, target) < 2e-3


def test_cartesian3_draws_the_markers_along_a_line_before_the_carried_cameras(benches: Any) -> None:
    bench = benches(6, mount="eye_in_hand").ready()
    target = bench.q + NEAR_ON_THE_ARM
    ends = [bench.truth.points(q).mean(axis=0) for q in (bench.q, target)]
    assert bench.reply(goal(bench, target, law="cartesian3")).accepted
    bench.until(ended, 25.0)
    line = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    path = np.array([bench.truth.points(i.joints.positions).mean(axis=0) for i, _ in bench.log]) - ends[0]
    off = np.linalg.norm(path - (path @ line)[:, None] * line, axis=1)
    assert np.linalg.norm(ends[1] - ends[0]) > 0.03
    assert off.max() < 2e-3


@pytest.mark.parametrize(("learnt", "cell"), [("eye_to_hand", "eye_in_hand"), ("eye_in_hand", "eye_to_hand")])
def test_model_of_another_mount_is_refused_by_name(benches: Any, learnt: str, cell: str) -> None:
    bench, other = benches(0, mount=cell), benches(0, mount=learnt)
    bench.run(0.1)
    outputs = bench.step(model_update=ModelUpdate(other.truth.model))
    (warning,) = [event for event in outputs.events if event.kind == "warning"]
    assert f"mounted {learnt}" in warning.message
    assert f"left {cell}, right {cell}" in warning.message
    assert outputs.status.model_epoch == 0
