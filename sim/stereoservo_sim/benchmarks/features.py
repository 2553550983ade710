"""``bench features``: duration of dot detection on simulated images (tracking, acquisition), with OpenCV labelling
as a baseline.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, Frame, Prior
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_sim.benchmarks.features_robustness import robustness
from stereoservo_sim.benchmarks.timing import summary, timed
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import demo_cell

IMAGES = 8
"""Pictures that the repetitions take in turn."""


def run_features(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Milliseconds per image of 640x480: search without a prior, windows at a prior, one labelling pass.

    And what is found how well, in four pictures a repetition of each of the conditions of ``robustness``.
    """
    rng = np.random.default_rng(seed)
    cell = demo_cell()
    camera = cell.rig.cameras[0]
    renderer = Renderer(cell, camera, RenderSettings())
    frames, priors = [], []
    here = Path(".")
    context = DriverContext(
        clock=MonotonicClock(), cell="bench", runtime_dir=here, cell_dir=here, camera=camera.name
    )
    detector = DotDetector({}, context)
    for k in range(IMAGES):
        q = cell.base + rng.uniform(-0.1, 0.1, len(cell.base))
        frames.append(Frame(camera.name, k, 1_000_000_000, 1_004_000_000, renderer.render(q, rng)))
        seen = detector.detect(frames[-1], None)
        priors.append(
            Prior(
                camera.name,
                frames[-1].t_shutter_ns,
                seen.ids,
                seen.pixels + rng.normal(0.0, 0.5, seen.pixels.shape),
                np.zeros((len(seen.ids), 2)),
                np.tile(np.eye(2), (len(seen.ids), 1, 1)),
            )
        )
        progress("pictures", k + 1, IMAGES)
    count = max(100, 20 * repetitions)
    found = [len(prior.ids) for prior in priors]

    def label(k: int) -> None:
        image = frames[k % IMAGES].image
        _, binary = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        cv2.connectedComponents(binary)

    times = {
        "cold": timed(lambda k: detector.detect(frames[k % IMAGES], None), count)[0],
        "tracking": timed(lambda k: detector.detect(frames[k % IMAGES], priors[k % IMAGES]), count)[0],
        "cv2_threshold_and_connected_components": timed(label, count)[0],
    }
    medians = {name: float(np.median(samples)) for name, samples in times.items()}
    baseline = medians["cv2_threshold_and_connected_components"]
    return {
        "image": [camera.width, camera.height],
        "dots_found": {"least": min(found), "most": max(found)},
        "ms": {name: summary(samples, 1e3) for name, samples in times.items()},
        "cold_over_baseline": medians["cold"] / baseline,
        "tracking_over_baseline": medians["tracking"] / baseline,
        "robustness": robustness(detector, 4 * repetitions, seed, progress),
    }
