"""The dot detector keeps the contract of detectors."""

import numpy as np

from stereoservo_drivers.contracts import DetectorContract
from stereoservo_drivers.detectors.dots import DotDetector

from .scenes import random_shot


class TestDotDetector(DetectorContract):
    accuracy_px = 0.05
    least_markers = 14

    def make_detector(self, context):
        return DotDetector({}, context)

    def make_scene(self):
        shot = random_shot(np.random.default_rng(5), noise=2.0, clutter=4)
        return shot.frame.image, {i: tuple(p) for i, p in enumerate(shot.truth.tolist())}
