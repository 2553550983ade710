"""From calibration events to trial data."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.trial_data import CalibrationError, check_trials
from stereoservo.core.cycle import Event, Sample
from stereoservo.core.settings import CameraSettings, CoreSettings
from stereoservo.daemon.jobs import fit_job
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.daemon.kernel_compilation import example_model, example_settings
from stereoservo.kinematics.model import JointLoads


@pytest.fixture
def settings() -> CoreSettings:
    base = example_settings()
    cameras = tuple(CameraSettings(name, 640, 480, 30.0, "eye_to_hand", (1, 4, 7)) for name in ("left", "right"))
    return msgspec.structs.replace(base, cameras=cameras)


def sample(camera: str, ids: list[int], offset: float = 0.0) -> Sample:
    k = len(ids)
    pixels = np.arange(2.0 * k).reshape(k, 2) + offset
    covariances = np.tile(np.diag([0.03, 0.01]), (k, 1, 1))
    count = len(ids)
    return Sample(camera, np.array(ids, dtype=np.int64), pixels, covariances, 5, np.full(count, 5.0), np.zeros(count))


def stop(seq: int, trial: int, *samples: Sample, goal: str = "a") -> Event:
    return Event(seq, seq, "calibration_sample", id=goal, joints=np.full(6, 0.1 * seq), samples=samples, trial=trial)


def test_each_pixel_stands_at_its_camera_stop_and_marker(settings: CoreSettings) -> None:
    job = TrialCollector(settings)
    job.add(Event(1, 1, "calibration_progress", id="a"))
    job.add(stop(2, -1, sample("left", [1, 7]), sample("right", [7], 100.0)))
    job.add(stop(3, 0, sample("right", [7, 1], 200.0), sample("left", [])))
    trials = job.trials()
    check_trials(trials)
    assert trials.marker_ids == (1, 7)  # 4 was never seen
    assert trials.images == 20
    np.testing.assert_array_equal(trials.trials, [-1, 0])
    np.testing.assert_allclose(trials.positions[:, 0], [0.2, 0.3])
    nan = np.nan
    np.testing.assert_array_equal(trials.pixels[0], [[[0, 1], [2, 3]], [[nan, nan], [nan, nan]]])
    np.testing.assert_array_equal(trials.pixels[1], [[[nan, nan], [100, 101]], [[202, 203], [200, 201]]])
    np.testing.assert_allclose(trials.sigmas[1, 1], np.sqrt(0.02))


def test_another_calibration_starts_anew(settings: CoreSettings) -> None:
    job = TrialCollector(settings)
    job.add(stop(1, 0, sample("left", [1])))
    job.add(stop(2, 0, sample("left", [1]), goal="b"))
    assert (job.id, job.stops) == ("b", 1)


def test_no_stop_is_an_error_with_its_code(settings: CoreSettings) -> None:
    with pytest.raises(CalibrationError, match="no stop") as caught:
        TrialCollector(settings).trials()
    assert caught.value.code == "too_few_stops"


def test_loads_are_those_of_the_same_calibration(settings: CoreSettings) -> None:
    loads = JointLoads(np.ones(6), following_errors=np.full(6, 1e-3))
    job = TrialCollector(settings)
    job.add(stop(1, 0, sample("left", [1])))
    job.add(Event(2, 2, "calibration_finished", id="another", loads=JointLoads(np.zeros(6))))
    assert job.trials().loads is None
    job.add(Event(3, 3, "calibration_finished", id="a", loads=loads))
    assert job.trials().loads is loads
    job.add(stop(4, 0, sample("left", [1]), goal="b"))
    assert job.trials().loads is None


def test_noise_is_as_the_frames_scatter_whatever_few_markers_of_great_variance_state(
    settings: CoreSettings,
) -> None:
    """Means of four frames, white noise of 0.9 of the stated variance; a hundredth are stated 30 times as uncertain."""
    rng = np.random.default_rng(0)
    job = TrialCollector(settings)
    stated, stops, sights = 0.005**2, 1000, 4
    doubted = rng.random((stops, 3)) < 0.01
    for s in range(stops):
        variances = np.where(doubted[s], 30.0**2 * stated, stated) / sights
        scatter = 0.9 * stated * rng.chisquare(2 * (sights - 1), 3) / (2 * (sights - 1))
        job.add(
            stop(s, 0, Sample(
                "left", np.array([1, 4, 7]), 100.0 * rng.random((3, 2)), variances[:, None, None] * np.eye(2), sights,
                np.full(3, float(sights)), scatter,
            ))
        )  # fmt: skip
    sigmas = job.trials().sigmas[0]
    # 18 000 degrees of freedom: a standard deviation of 1 % in the variance
    np.testing.assert_allclose(sigmas[~doubted] ** 2, 0.9 * stated / sights, rtol=0.04)


@pytest.mark.parametrize("systematic_px", [0.0, np.sqrt(0.02)])
def test_where_no_noise_is_seen_or_stated_the_detector_is_believed(
    settings: CoreSettings, systematic_px: float
) -> None:
    cameras = tuple(msgspec.structs.replace(camera, systematic_px=float(systematic_px)) for camera in settings.cameras)
    job = TrialCollector(msgspec.structs.replace(settings, cameras=cameras))
    job.add(stop(1, 0, sample("left", [1, 4])))
    np.testing.assert_allclose(job.trials().sigmas[0, 0], np.sqrt(0.02))


def test_a_fit_that_fails_for_a_full_disk_leaves_no_model_to_be_taken_up_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    fit: Any = SimpleNamespace(model=example_model(), report={})
    monkeypatch.setattr(fit_job, "fit_model", lambda trials, **_: fit)
    monkeypatch.setattr(fit_job, "write_atomically", full)  # the model itself still has room
    path = tmp_path / "model-000008.json"
    with pytest.raises(OSError, match="No space left"):
        fit_job.fit_trials(None, path, 8)  # type: ignore[arg-type]
    assert not path.exists()
