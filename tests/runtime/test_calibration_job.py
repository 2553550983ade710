"""From calibration events to trial data."""

import msgspec
import numpy as np
import pytest

from stereoservo.kinematics.calibration.trials import CalibrationError, check_trials
from stereoservo.kinematics.model import JointLoads
from stereoservo.runtime.calibration_job import CalibrationJob
from stereoservo.runtime.cycle import Event, Sample
from stereoservo.runtime.settings import CameraSettings, CoreSettings
from stereoservo.runtime.warmup import _settings


@pytest.fixture
def settings() -> CoreSettings:
    base = _settings()
    cameras = tuple(
        CameraSettings(name, 640, 480, 30.0, "eye_to_hand", (1, 4, 7)) for name in ("left", "right")
    )
    return msgspec.structs.replace(base, cameras=cameras)


def sample(camera: str, ids: list[int], offset: float = 0.0) -> Sample:
    k = len(ids)
    pixels = np.arange(2.0 * k).reshape(k, 2) + offset
    covariances = np.tile(np.diag([0.03, 0.01]), (k, 1, 1))
    count = len(ids)
    return Sample(
        camera, np.array(ids, dtype=np.int64), pixels, covariances, 5, np.full(count, 5.0), np.zeros(count)
    )


def stop(seq: int, trial: int, *samples: Sample, goal: str = "a") -> Event:
    return Event(
        seq, seq, "calibration_sample", id=goal, joints=np.full(6, 0.1 * seq), samples=samples, trial=trial
    )


def test_each_pixel_stands_at_its_camera_stop_and_marker(settings: CoreSettings) -> None:
    job = CalibrationJob(settings)
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
    job = CalibrationJob(settings)
    job.add(stop(1, 0, sample("left", [1])))
    job.add(stop(2, 0, sample("left", [1]), goal="b"))
    assert (job.id, job.stops) == ("b", 1)


def test_no_stop_is_an_error_with_its_code(settings: CoreSettings) -> None:
    with pytest.raises(CalibrationError, match="no stop") as caught:
        CalibrationJob(settings).trials()
    assert caught.value.code == "too_few_stops"


def test_loads_are_those_of_the_same_calibration(settings: CoreSettings) -> None:
    loads = JointLoads(np.ones(6), following_errors=np.full(6, 1e-3))
    job = CalibrationJob(settings)
    job.add(stop(1, 0, sample("left", [1])))
    job.add(Event(2, 2, "calibration_finished", id="another", loads=JointLoads(np.zeros(6))))
    assert job.trials().loads is None
    job.add(Event(3, 3, "calibration_finished", id="a", loads=loads))
    assert job.trials().loads is loads
    job.add(stop(4, 0, sample("left", [1]), goal="b"))
    assert job.trials().loads is None
