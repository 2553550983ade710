"""Contract tests, as pytest classes: requirements for every joint driver, camera driver and detector.

Subclass one in your own tests, override the factory of your driver, and run pytest::

    from stereoservo_drivers.contracts import JointDriverContract

    class TestMyArm(JointDriverContract):
        def make_driver(self, context):
            return MyArm({"port": "/dev/ttyUSB0"}, context)

Needs pytest, which the service itself does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.ports.devices import (
    CameraDriver,
    CameraObservation,
    Detector,
    DriverContext,
    DriverError,
    Frame,
    Prior,
)
from stereoservo_drivers.kit.bench import JointDriverSetup, Paced, call_times_us
from stereoservo_drivers.kit.joint_checks import JOINT_CHECKS, JointCheck, run_check

# -- time ----------------------------------------------------------------------------------------------------
# Time in contract tests: virtual if the device simulates, real if it does not; measured call budgets.


class PacedSuite(Paced):
    """Common base of the contract tests. Override :attr:`real_time` and :meth:`make_context` if a device needs it."""

    @pytest.fixture
    def context(self, tmp_path: Path) -> DriverContext:
        """A context of its own for each test."""
        return self.make_context(tmp_path)


def measure(calls: int, call: Callable[[], Any], before: Callable[[], Any] = lambda: None) -> dict[str, float]:
    """Median, 99th percentile and maximum [us] of ``calls`` calls, each after an untimed ``before``."""
    times = call_times_us(calls, call, before)
    median, p99 = np.percentile(times, [50, 99])
    return {"median_us": float(median), "p99_us": float(p99), "max_us": float(times.max())}


def report_budget(
    record: Callable[[str, object], None], name: str, budget_us: float, **calls: dict[str, float]
) -> None:
    """Print call times beside the declared budget, and add them to the JUnit report; without an assertion, since
    machines stall.
    """
    for call, figures in calls.items():
        text = ", ".join(f"{key[:-3]} {value:.0f}" for key, value in figures.items())
        print(f"{name}.{call}: {text} us; declared budget {budget_us:.0f} us")
        record(f"{name}.{call}", figures)
    record(f"{name}.call_budget_us", budget_us)


class CameraDriverContract(PacedSuite):
    """Base class of the tests: subclass under pytest and override :meth:`make_driver`; the camera is called
    :attr:`camera_name`.
    """

    camera_name = "left"
    frames = 5
    """Number of frames that a test waits for."""
    patience_s = 5.0
    """Time limit of waiting for frames on the driver's clock."""

    def make_driver(self, context: DriverContext) -> CameraDriver:
        """A new driver, not connected."""
        raise NotImplementedError("override make_driver(context)")

    def make_context(self, tmp_path: Path) -> DriverContext:
        """The context given to the driver."""
        return replace(super().make_context(tmp_path), camera=self.camera_name)

    @pytest.fixture
    def driver(self, context: DriverContext) -> Iterator[CameraDriver]:
        """A fresh driver, closed after the test."""
        driver = self.make_driver(context)
        yield driver
        driver.close()

    @pytest.fixture
    def active(self, driver: CameraDriver) -> CameraDriver:
        """An active driver."""
        driver.configure()
        driver.activate()
        return driver

    def collect(self, driver: CameraDriver, context: DriverContext, count: int) -> list[Frame | CameraObservation]:
        """Poll until ``count`` items arrived. Fails the test when they do not come in time."""
        period = 1.0 / driver.describe().rate_hz
        items: list[Frame | CameraObservation] = []
        for _ in range(round(self.patience_s / period * 4)):
            self.wait(context, period / 4)
            items.extend(driver.poll())
            if len(items) >= count:
                return items
        pytest.fail(f"{len(items)} of {count} items within {self.patience_s} s")

    def test_is_a_camera_driver(self, driver: CameraDriver) -> None:
        assert isinstance(driver, CameraDriver)

    def test_describes_itself_before_it_is_configured(self, driver: CameraDriver) -> None:
        description = driver.describe()
        assert description.name == self.camera_name
        assert description.width > 0
        assert description.height > 0
        assert description.rate_hz > 0
        assert description.call_budget_us > 0
        if description.delivers == "observations":
            assert description.marker_ids
            assert len(set(description.marker_ids)) == len(description.marker_ids)

    def test_polling_before_activate_is_refused(self, driver: CameraDriver) -> None:
        with pytest.raises(DriverError):
            driver.poll()
        driver.configure()
        with pytest.raises(DriverError):
            driver.poll()

    def test_activate_before_configure_is_refused(self, driver: CameraDriver) -> None:
        with pytest.raises(DriverError):
            driver.activate()

    def test_delivers_what_it_says(self, active: CameraDriver, context: DriverContext) -> None:
        description = active.describe()
        for item in self.collect(active, context, self.frames):
            assert item.camera == self.camera_name
            if description.delivers == "frames":
                assert isinstance(item, Frame)
                assert item.image.shape == (description.height, description.width)
                assert item.image.dtype == np.uint8
                assert item.image.flags.c_contiguous
            else:
                assert isinstance(item, CameraObservation)
                check_observation(item, description.marker_ids, description.width, description.height)

    def test_stamps_and_numbers_grow_and_are_in_order(self, active: CameraDriver, context: DriverContext) -> None:
        items = self.collect(active, context, self.frames)
        for item in items:
            assert item.t_shutter_ns <= item.t_received_ns <= context.clock.now_ns()
        for before, after in pairwise(items):
            assert after.seq > before.seq
            assert after.t_shutter_ns > before.t_shutter_ns
            assert after.t_received_ns >= before.t_received_ns

    def test_a_frame_is_delivered_once(self, active: CameraDriver, context: DriverContext) -> None:
        numbers = [item.seq for item in self.collect(active, context, self.frames)]
        assert len(set(numbers)) == len(numbers)
        if not self.real_time:
            assert active.poll() == []

    def test_items_are_not_changed_by_later_polls(self, active: CameraDriver, context: DriverContext) -> None:
        item = self.collect(active, context, 1)[0]
        data = item.image if isinstance(item, Frame) else item.pixels
        before = data.copy()
        self.collect(active, context, 2)
        assert np.array_equal(data, before)

    def test_polling_after_deactivate_is_refused(self, active: CameraDriver) -> None:
        active.deactivate()
        with pytest.raises(DriverError):
            active.poll()

    def test_can_be_activated_again(self, active: CameraDriver, context: DriverContext) -> None:
        first = self.collect(active, context, 1)[-1]
        active.deactivate()
        active.activate()
        again = self.collect(active, context, 1)[0]
        assert again.t_shutter_ns > first.t_shutter_ns
        assert again.seq > first.seq

    def test_deactivate_and_close_are_idempotent(self, active: CameraDriver) -> None:
        active.deactivate()
        active.deactivate()
        active.close()
        active.close()

    def test_can_be_opened_again_after_close(self, active: CameraDriver, context: DriverContext) -> None:
        """Reaction of the vision process to any error of a camera."""
        first = self.collect(active, context, 1)[-1]
        active.close()
        active.configure()
        active.activate()
        again = self.collect(active, context, 1)[0]
        assert again.t_shutter_ns > first.t_shutter_ns
        assert again.seq > first.seq

    def test_close_never_raises_in_any_state(self, context: DriverContext) -> None:
        fresh = self.make_driver(context)
        fresh.close()
        configured = self.make_driver(context)
        configured.configure()
        configured.close()
        with pytest.raises(DriverError):
            configured.poll()

    def test_call_times_beside_the_budget(
        self, active: CameraDriver, context: DriverContext, record_property: Callable[[str, object], None]
    ) -> None:
        description = active.describe()

        period = 1.0 / description.rate_hz
        figures = measure(50, active.poll, before=lambda: self.wait(context, period))
        report_budget(record_property, description.driver, description.call_budget_us, poll=figures)
        assert figures["median_us"] > 0


def check_observation(observation: CameraObservation, marker_ids: tuple[int, ...], width: int, height: int) -> None:
    """Assert that an observation is well formed: shapes, known and unique ids, pixels inside, covariances
    positive.
    """
    k = len(observation.ids)
    assert observation.ids.dtype == np.int64
    assert len(set(observation.ids.tolist())) == k
    assert set(observation.ids.tolist()) <= set(marker_ids)
    assert observation.pixels.shape == (k, 2)
    assert observation.covariances.shape == (k, 2, 2)
    assert np.all(np.isfinite(observation.pixels))
    assert np.all(observation.pixels > -0.5)
    assert np.all(observation.pixels < np.array([width, height]) - 0.5)
    assert np.array_equal(observation.covariances, np.swapaxes(observation.covariances, 1, 2))
    if k:
        assert np.all(np.linalg.eigvalsh(observation.covariances) > 0)


# -- detectors -----------------------------------------------------------------------------------------------
# Contract tests of detectors.


class DetectorContract(PacedSuite):
    """Base class of the tests: subclass under pytest; override :meth:`make_detector` and :meth:`make_scene`.

    Requirements for any image: well-formed observations, no exception, no references to the caller's arrays, the same
    observation for the same input.
    """

    camera_name = "left"
    accuracy_px = 0.5
    """Largest distance of a reported marker from the truth in the scene."""
    least_markers = 4
    """Number of markers of the scene that must be found without a prior."""

    def make_detector(self, context: DriverContext) -> Detector:
        """A new detector."""
        raise NotImplementedError("override make_detector(context)")

    def make_scene(self) -> tuple[np.ndarray, dict[int, tuple[float, float]]]:
        """An image (height, width) uint8 with markers in it, and their positions: id -> (u, v) [px]."""
        raise NotImplementedError("override make_scene()")

    def make_context(self, tmp_path: Path) -> DriverContext:
        """The context given to the detector."""
        return replace(super().make_context(tmp_path), camera=self.camera_name)

    @pytest.fixture
    def detector(self, context: DriverContext) -> Detector:
        """A fresh detector."""
        return self.make_detector(context)

    @pytest.fixture
    def scene(self) -> tuple[np.ndarray, dict[int, tuple[float, float]]]:
        """The scene."""
        return self.make_scene()

    def frame(self, image: np.ndarray, seq: int = 7) -> Frame:
        """``image`` as a frame of the contract's camera."""
        t_ns = 1_000_000_000 + seq * 33_000_000
        return Frame(self.camera_name, seq, t_ns, t_ns + 5_000_000, image)

    def prior(self, frame: Frame, truth: dict[int, tuple[float, float]], offset: float = 1.0) -> Prior:
        """A prior at the frame's time, ``offset`` [px] beside the truth."""
        k = len(truth)
        return Prior(
            camera=self.camera_name,
            t_ns=frame.t_shutter_ns,
            ids=np.array(list(truth), dtype=np.int64),
            pixels=np.array(list(truth.values()), dtype=np.float64).reshape(k, 2) + offset,
            velocities=np.zeros((k, 2)),
            covariances=np.tile(np.eye(2) * 4.0, (k, 1, 1)),
        )

    def check(self, observation: CameraObservation, frame: Frame, detector: Detector) -> None:
        """Assert that an observation belongs to its frame and is well formed."""
        assert observation.camera == frame.camera
        assert observation.seq == frame.seq
        assert observation.t_shutter_ns == frame.t_shutter_ns
        assert observation.t_received_ns >= frame.t_shutter_ns
        height, width = frame.image.shape
        check_observation(observation, detector.describe().marker_ids, width, height)

    def check_accuracy(self, observation: CameraObservation, truth: dict[int, tuple[float, float]]) -> None:
        """Assert that each reported marker is in the scene, at the reported pixel."""
        for marker, pixel in zip(observation.ids.tolist(), observation.pixels, strict=True):
            assert marker in truth
            assert np.linalg.norm(pixel - np.array(truth[marker])) <= self.accuracy_px, marker

    def test_is_a_detector(self, detector: Detector) -> None:
        assert isinstance(detector, Detector)

    def test_describes_its_markers(self, detector: Detector) -> None:
        ids = detector.describe().marker_ids
        assert ids
        assert len(set(ids)) == len(ids)

    def test_finds_markers_without_a_prior(
        self, detector: Detector, scene: tuple[np.ndarray, dict[int, tuple[float, float]]]
    ) -> None:
        image, truth = scene
        frame = self.frame(image)
        observation = detector.detect(frame, None)
        self.check(observation, frame, detector)
        assert len(observation.ids) >= self.least_markers
        self.check_accuracy(observation, truth)

    def test_finds_markers_with_a_prior(
        self, detector: Detector, scene: tuple[np.ndarray, dict[int, tuple[float, float]]]
    ) -> None:
        image, truth = scene
        frame = self.frame(image)
        observation = detector.detect(frame, self.prior(frame, truth))
        self.check(observation, frame, detector)
        assert len(observation.ids) >= self.least_markers
        self.check_accuracy(observation, truth)

    def test_a_wrong_prior_gives_no_wrong_marker(
        self, detector: Detector, scene: tuple[np.ndarray, dict[int, tuple[float, float]]]
    ) -> None:
        image, truth = scene
        frame = self.frame(image)
        far = {marker: (3.0 + 2 * i, 5.0 + i) for i, marker in enumerate(truth)}
        observation = detector.detect(frame, self.prior(frame, far, 0.0))
        self.check(observation, frame, detector)
        self.check_accuracy(observation, truth)

    def test_a_stale_prior_does_no_harm(
        self, detector: Detector, scene: tuple[np.ndarray, dict[int, tuple[float, float]]]
    ) -> None:
        image, truth = scene
        prior = self.prior(self.frame(image, seq=1), truth)
        frame = self.frame(image, seq=1000)
        observation = detector.detect(frame, prior)
        self.check(observation, frame, detector)
        self.check_accuracy(observation, truth)

    @pytest.mark.parametrize("content", ["black", "white", "noise", "checks"])
    def test_no_content_raises_or_invents_markers(self, detector: Detector, content: str) -> None:
        shape = (480, 640)
        v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
        image = {
            "black": np.zeros(shape, dtype=np.uint8),
            "white": np.full(shape, 255, dtype=np.uint8),
            "noise": np.random.default_rng(3).integers(0, 256, shape, dtype=np.uint8),
            "checks": (((u // 16 + v // 16) % 2) * 255).astype(np.uint8),
        }[content]
        frame = self.frame(image)
        observation = detector.detect(frame, None)
        self.check(observation, frame, detector)
        assert len(observation.ids) == 0

    def test_the_image_is_left_alone(
        self, detector: Detector, scene: tuple[np.ndarray, dict[int, tuple[float, float]]]
    ) -> None:
        image, _ = scene
        before = image.copy()
        detector.detect(self.frame(image), None)
        assert np.array_equal(image, before)

    def test_the_same_image_gives_the_same_answer(
        self, context: DriverContext, scene: tuple[np.ndarray, dict[int, tuple[float, float]]]
    ) -> None:
        image, _ = scene
        frame = self.frame(image)
        first = self.make_detector(context).detect(frame, None)
        second = self.make_detector(context).detect(frame, None)
        assert np.array_equal(first.ids, second.ids)
        assert np.array_equal(first.pixels, second.pixels)

    def test_call_times(
        self,
        detector: Detector,
        scene: tuple[np.ndarray, dict[int, tuple[float, float]]],
        record_property: Callable[[str, object], None],
    ) -> None:
        image, truth = scene
        frame = self.frame(image)
        prior = self.prior(frame, truth)
        cold = measure(20, lambda: detector.detect(frame, None))
        tracking = measure(20, lambda: detector.detect(frame, prior))
        name = detector.describe().detector
        report_budget(record_property, name, 5000.0, detect=cold, detect_with_prior=tracking)
        assert cold["median_us"] > 0
        assert tracking["median_us"] > 0


# -- joint drivers -------------------------------------------------------------------------------------------
# Contract tests of joint drivers.


class JointDriverContract(JointDriverSetup):
    """Base class of the tests: subclass under pytest and override :meth:`make_driver`.

    The suite moves the arm: slowly (``speed`` of each joint's largest velocity) and for fractions of a
    second. Clear the machine's surroundings before you run it on hardware.
    """

    @pytest.mark.parametrize("check", [pytest.param(check, id=check.name) for check in JOINT_CHECKS])
    def test_joint_driver(
        self, check: JointCheck, tmp_path: Path, record_property: Callable[[str, object], None]
    ) -> None:
        result = run_check(check, self, tmp_path)
        record_property(check.name, result.measured)
        if result.verdict == "not run":
            pytest.skip(result.measured)
        assert result.verdict == "passed", f"{result.measured}; {result.remedy}"
