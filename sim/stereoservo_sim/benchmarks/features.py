"""``bench features``: duration of dot detection on simulated images (tracking, acquisition), with OpenCV labelling
as a baseline.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraObservation, DriverContext, Frame, Prior
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_sim.benchmarks.features_robustness import robustness
from stereoservo_sim.benchmarks.features_tags import tags
from stereoservo_sim.benchmarks.timing import summary, timed
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import demo_cell

IMAGES = 8
"""Pictures that the repetitions take in turn."""
FOUR = (0, 1, 2, 3)
"""The corners of the first face: what is tracked where two cameras see four dots each."""
OFF_PX = (0.4, -0.3)
"""How far their prior is off: four dots are checked against it, so that it is off evenly."""


class Pictures(NamedTuple):
    """A detector and what it looks at: frames, priors of all their dots, priors of four."""

    detector: DotDetector
    frames: list[Frame]
    priors: list[Prior]
    fours: list[Prior]

    def cold(self, k: int) -> CameraObservation:
        """Picture ``k``, counted round, without a prior."""
        return self.detector.detect(self.frames[k % IMAGES], None)

    def track(self, k: int) -> CameraObservation:
        """Picture ``k`` with a prior of all its dots."""
        return self.detector.detect(self.frames[k % IMAGES], self.priors[k % IMAGES])

    def track_two(self, k: int) -> list[CameraObservation]:
        """Pictures ``k`` and ``k`` + 1 with priors of four dots."""
        return [self.detector.detect(self.frames[i % IMAGES], self.fours[i % IMAGES]) for i in (k, k + 1)]

    def label(self, k: int) -> int:
        """OpenCV's number of components of picture ``k``: the baseline."""
        _, binary = cv2.threshold(self.frames[k % IMAGES].image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        return int(cv2.connectedComponents(binary)[0])


def pictures(seed: int, progress: ProgressCall) -> Pictures:
    """IMAGES pictures of the demo's cell."""
    rng = np.random.default_rng(seed)
    cell = demo_cell()
    camera = cell.rig.cameras[0]
    renderer = Renderer(cell, camera, RenderSettings())
    frames, priors, fours = [], [], []
    here = Path(".")
    context = DriverContext(
        clock=MonotonicClock(), cell="bench", runtime_dir=here, cell_dir=here, camera=camera.name
    )
    detector = DotDetector({}, context)
    for k in range(IMAGES):
        q = cell.base + rng.uniform(-0.1, 0.1, len(cell.base))
        frames.append(Frame(camera.name, k, 1_000_000_000, 1_004_000_000, renderer.render(q, rng)))
        seen = detector.detect(frames[-1], None)
        priors.append(_prior(frames[-1], seen.ids, seen.pixels + rng.normal(0.0, 0.5, seen.pixels.shape)))
        rows = np.flatnonzero(np.isin(seen.ids, FOUR))
        fours.append(_prior(frames[-1], seen.ids[rows], seen.pixels[rows] + OFF_PX))
        progress("pictures", k + 1, IMAGES)
    return Pictures(detector, frames, priors, fours)


def _prior(frame: Frame, ids: IntArray, pixels: FloatArray) -> Prior:
    return Prior(
        frame.camera,
        frame.t_shutter_ns,
        ids,
        pixels,
        np.zeros_like(pixels),
        np.tile(np.eye(2), (len(ids), 1, 1)),
    )


def run_features(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Milliseconds per image of 640x480: search without a prior, windows at a prior of 14 dots, two images at priors of
    four, one labelling pass.

    And what is found how well, in four pictures a repetition of each of the conditions of ``robustness``; and
    twelve tags.
    """
    shown = pictures(seed, progress)
    count = max(100, 20 * repetitions)
    found = [len(prior.ids) for prior in shown.priors]
    times = {
        "cold": timed(shown.cold, count)[0],
        "tracking": timed(shown.track, count)[0],
        "tracking_2x4": timed(shown.track_two, count)[0],
        "cv2_threshold_and_connected_components": timed(shown.label, count)[0],
    }
    medians = {name: float(np.median(samples)) for name, samples in times.items()}
    baseline = medians["cv2_threshold_and_connected_components"]
    height, width = shown.frames[0].image.shape
    return {
        "image": [width, height],
        "dots_found": {"least": min(found), "most": max(found)},
        "ms": {name: summary(samples, 1e3) for name, samples in times.items()},
        "cold_over_baseline": medians["cold"] / baseline,
        "tracking_over_baseline": medians["tracking"] / baseline,
        "tracking_2x4_over_baseline": medians["tracking_2x4"] / baseline,
        "tags": tags(repetitions, seed),
        "robustness": robustness(shown.detector, 4 * repetitions, seed, progress),
    }
