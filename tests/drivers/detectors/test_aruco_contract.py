"""The tag detector keeps the contract of detectors."""

import cv2
import numpy as np

from stereoservo_drivers.contracts import DetectorContract
from stereoservo_drivers.detectors.aruco import TagDetector

from .rendering import project
from .tag_rendering import CORNERS, TagScene, printed, tag_view


class TestTagDetector(DetectorContract):
    accuracy_px = 0.05
    least_markers = 8

    def make_detector(self, context):
        return TagDetector({"tags": [3, 11], "first_marker": 100}, context)

    def make_scene(self):
        views = {
            3: tag_view(80, 35, 1.0, 0.3, (200, 220)),
            11: tag_view(60, 10, 2.0, 2.0, (430, 260)),
            4: tag_view(50, 10, 2.0, 2.0, (560, 400)),  # of another cell
        }
        tags = [(printed(cv2.aruco.DICT_APRILTAG_36h11, tag), H) for tag, H in views.items()]
        image = TagScene(tags, noise=2.0).render(np.random.default_rng(5))
        truth = {100 + 4 * t + c: tuple(p) for t in (3, 11) for c, p in enumerate(project(views[t], CORNERS))}
        return image, truth
