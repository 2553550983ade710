"""Contract tests of detectors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereoservo.ports.devices import CameraObservation, Detector, DriverContext, Frame, Prior
from stereoservo_drivers.contracts.camera import PacedSuite, check_observation, measure, report_budget


class DetectorContract(PacedSuite):
    """Base class of the tests: subclass under pytest; override :meth:`make_detector` and :meth:`make_scene`.

    What a detector must keep whatever it is shown: well-formed answers, no exception, no memory of the
    caller's arrays, the same answer to the same question.
    """

    camera_name = "left"
    accuracy_px = 0.5
    """Largest distance of a reported marker from the truth in the scene."""
    least_markers = 4
    """How many markers of the scene must be found without a prior."""

    def make_detector(self, context: DriverContext) -> Detector:
        """A new detector."""
        raise NotImplementedError("override make_detector(context)")

    def make_scene(self) -> tuple[np.ndarray, dict[int, tuple[float, float]]]:
        """An image (height, width) uint8 with markers in it, and where they are: id -> (u, v) [px]."""
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
