"""Examination of recordings: against generated ones whose faults are known, and its parts against closed forms."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.change.model_changes import start_state
from stereoservo.calibration.examination.change_points import CLEAR, moved_camera, step_of_camera
from stereoservo.calibration.examination.examination import examine_views
from stereoservo.calibration.examination.recorded_views import examined_frames, gaps, single_joint_motions
from stereoservo.calibration.examination.reference_model import estimate_offsets, frame_noise, learn_reference
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo_sim.experiments.examined_recordings import (
    examined_case,
    judged_examination,
    run_examined_recordings,
)

BUMPED, QUIET, LATE, BUMPED_IN_TRIALS, STOP_MISTAKEN, DRIFTED_IN_TRIALS, POSES = 5, 11, 8, 2, 22, 7, 12
LATE_POSES, DRIFTED_AND_RIPPLED, REFUSED_OTHERWISE, LATE_TO_THE_LAST_REST = 5004, 5012, 84004, 101092
"""Seeds of cases; of one the fit's refusal names a stop that is wrong by five, of another no camera; the last ends at a
rest, which says nothing of stamps.
"""


@pytest.mark.parametrize(
    ("seed", "kinds"),
    [
        (BUMPED, ["camera_moved"]),
        (LATE, ["late_stamps"]),
        (QUIET, []),
        (BUMPED_IN_TRIALS, ["camera_moved"]),
        (STOP_MISTAKEN, ["camera_moved"]),
        (REFUSED_OTHERWISE, ["camera_moved"]),
        (LATE_POSES, ["late_stamps"]),
        (LATE_TO_THE_LAST_REST, ["late_stamps", "dropped_frames"]),
        pytest.param(DRIFTED_AND_RIPPLED, ["joint_zero"], marks=pytest.mark.slow),
        pytest.param(POSES, ["camera_moved"], marks=pytest.mark.slow),
        pytest.param(DRIFTED_IN_TRIALS, ["joint_zero", "dropped_frames"], marks=pytest.mark.slow),
    ],
)
def test_what_was_done_is_reported_and_nothing_else(seed: int, kinds: list[str]) -> None:
    verdict = judged_examination(seed)
    assert list(verdict.found) == kinds == list(verdict.true)
    assert verdict.falsely == ()
    assert all(abs(frames) <= 2 for frames in verdict.late_by)
    assert all(abs(deviations) < 5.0 for deviations in verdict.sizes_in_deviations)


@pytest.mark.slow
def test_generated_recordings_are_distinguished() -> None:
    """Of 30 recordings; the page has the counts of more."""
    answer = run_examined_recordings(seeds=30, seed=1000)
    rows = {row["goals"]: row for row in answer["rows"]}
    bumped = rows["camera_moved: found"]
    assert bumped["of"] >= 8
    assert bumped["count"] >= bumped["of"] - 1
    assert rows["recordings with a false cause"]["count"] <= 3


def test_a_recording_without_single_joint_motions_states_which_joints_lack_them() -> None:
    views = examined_case(QUIET).views
    work = views.select(views.times > views.times[-1] - 10.0)
    with pytest.raises(CalibrationError, match="j1, j2, j3, j4, j5, j6 never moves alone") as caught:
        examine_views(work)
    assert caught.value.code == "too_few_stops"
    with pytest.raises(CalibrationError, match="no frame"):
        examine_views(views.select(np.zeros(len(views.camera), dtype=bool)))


def test_residuals_are_whitened_by_errors_of_the_joints_and_of_the_model() -> None:
    """Chi-square against the explicit covariance, rows of a frame coupled by its joints' errors."""
    views = examined_case(BUMPED).views.select(np.arange(4, 656))
    model = learn_reference(views).model
    errors = np.full(6, 1e-3)
    accuracy = JointAccuracy(errors, 0.0 * errors, errors, 0.0 * errors)
    noisy = examined_frames(with_accuracy(model, accuracy), views, 1.0)
    plain = examined_frames(with_accuracy(model, None), views, 1.0)
    keep = plain.data.stop < 30
    noisy, plain = noisy.select(keep), plain.select(keep)
    here = plain.residuals_at(start_state(plain))
    frame = np.repeat(plain.data.stop, 2)
    same = frame[:, None] == frame[None, :]
    covariance = np.eye(len(here)) + plain.root @ plain.root.T
    covariance += np.where(same, noisy.joint_slopes @ noisy.joint_slopes.T, 0.0)
    white = noisy.residuals_at(start_state(noisy))
    assert white @ noisy.whitened(white) == pytest.approx(here @ np.linalg.solve(covariance, here), rel=1e-8)


def with_accuracy(model, accuracy):
    return msgspec.structs.replace(model, joint_accuracy=accuracy)


def test_single_joint_motions_are_recognised_from_positions_alone() -> None:
    home = np.array([0.1, -0.2, 0.3])
    first, second = (np.repeat(home[None], 5, axis=0) for _ in range(2))
    first[:, 0] += np.linspace(-0.2, 0.2, 5)
    second[:, 2] += np.linspace(-0.2, 0.2, 5)
    free = home + np.random.default_rng(3).uniform(-0.2, 0.2, (4, 3))
    alone = single_joint_motions(np.vstack([first, second, free]))
    assert alone.tolist() == [0] * 5 + [2] * 5 + [-1] * 4


def test_dropped_frames_are_counted_by_numbers_and_by_stamps() -> None:
    rng = np.random.default_rng(4)
    case = examined_case(QUIET).views
    mine = np.flatnonzero(case.camera == 0)[:200]
    lost = np.zeros(200, dtype=bool)
    lost[[20, 21, 22, 90]] = True
    views = case.select(mine)
    views = replace(views, times=np.arange(200) / 30.0 + rng.normal(0.0, 1e-3, 200), numbers=np.arange(200)).select(
        ~lost
    )
    assert gaps(views, 0) == [(20, 3), (87, 1)]
    assert gaps(replace(views, numbers=4 * views.numbers), 0) == [(20, 3), (87, 1)]
    assert gaps(replace(views, numbers=np.full(196, -1)), 0) == [(20, 3), (87, 1)]
    irregular = replace(views, numbers=np.full(196, -1), times=np.sort(rng.uniform(0.0, 6.0, 196)))
    assert gaps(irregular, 0) is None


def test_a_camera_that_moves_while_the_arm_is_learnt_is_reported_to_the_frame() -> None:
    """A shift of 0.5 px, and of one marker, found by the pixels of that camera alone; late stamps are none."""
    rng = np.random.default_rng(5)
    views = examined_case(QUIET).views
    assert moved_camera(views) is None
    every = np.ones(len(views.camera), dtype=np.bool_)
    mine = np.flatnonzero(views.camera == 1)
    for jump in (int(mine[20]), int(mine[150])):
        later = (views.camera == 1) & (np.arange(len(views.camera)) >= jump)
        shift = rng.normal(0.0, 1.0, 2)
        shift *= 0.5 / np.linalg.norm(shift)
        pixels = views.pixels.copy()
        pixels[later] += shift
        moved = replace(views, pixels=pixels)
        assert moved_camera(moved) == 1
        step = step_of_camera(moved, 1, every)
        assert step is not None
        assert step.onset == jump
        assert step.span[0] <= jump <= step.span[1]
        other = step_of_camera(moved, 0, every)
        assert other is not None
        assert other.gain < CLEAR
        one = np.where(np.arange(views.pixels.shape[1]) == 2, 5.0, 0.0)
        pixels = views.pixels.copy()
        pixels[later] += one[:, None] * shift
        slipped = step_of_camera(replace(views, pixels=pixels), 1, every, 2)
        assert slipped is not None
        assert abs(slipped.onset - jump) <= 2
    late = views.shifted(np.where(views.camera == 1, -0.04, 0.0))
    assert moved_camera(late) is None


def test_what_else_happened_is_reported_beside_a_camera_that_moved_while_the_arm_is_learnt() -> None:
    """Of a bump during the trial motions its size, and the other camera's stamps, late from later on."""
    views = examined_case(REFUSED_OTHERWISE).views
    f = len(views.camera)
    late = np.where((views.camera == 0) & (np.arange(f) >= 850), 0.03, 0.0)
    report = examine_views(views.shifted(-late))
    bump, stamps = report.causes
    assert (bump.kind, bump.subject, stamps.kind, stamps.subject) == (
        "camera_moved",
        "cam1",
        "late_stamps",
        "cam0",
    )
    assert bump.onset is not None
    assert bump.onset.frame == 150
    assert bump.effect_px == pytest.approx(examined_case(REFUSED_OTHERWISE).faults[0].size, rel=0.1)
    assert stamps.value == pytest.approx(0.03, abs=1e-3)
    assert report.rms_px == pytest.approx(examined_case(REFUSED_OTHERWISE).sigma, rel=0.05)


def test_of_a_body_that_moves_by_itself_stamps_are_not_examined() -> None:
    views = examined_case(LATE).views
    assert any(cause.kind == "late_stamps" for cause in examine_views(views).causes)
    report = examine_views(replace(views, body_moves=True))
    assert all(cause.kind != "late_stamps" for cause in report.causes)
    assert all(camera.offset_s is None for camera in report.cameras.values())


def test_stamps_are_reported_against_poses_before_any_camera_is_known() -> None:
    """Offsets against those of the generated recording, of either half, and of a recording without any."""
    late, plain = examined_case(LATE_POSES), examined_case(POSES).views
    size = late.faults[0].size
    f = len(late.views.camera)
    for frames in (np.arange(f), np.arange(f // 2), np.arange(f // 2, f)):
        assert estimate_offsets(late.views, frames).offsets == pytest.approx([0.0, size], abs=2e-3)
    half = np.arange(len(plain.camera) // 2)
    moved = plain.shifted(np.where(plain.camera == 0, -0.04, 0.0))
    assert moved.stamped[moved.camera == 0] == pytest.approx(plain.times[plain.camera == 0])
    assert estimate_offsets(moved, half).offsets[0] - estimate_offsets(plain, half).offsets[0] == pytest.approx(
        0.04, abs=2e-3
    )


def test_the_noise_of_frames_is_that_of_the_pixels_where_the_motion_is_even() -> None:
    rng = np.random.default_rng(6)
    views = examined_case(QUIET).views
    even = views.ranks[:, None, None] * rng.normal(size=(1, views.pixels.shape[1], 2))
    noisy = replace(views, pixels=even + rng.normal(0.0, 3.0, views.pixels.shape), sigmas=np.ones(views.sigmas.shape))
    assert frame_noise(noisy) == pytest.approx(3.0, rel=0.05)
