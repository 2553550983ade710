"""Robustness of the dot detector: detection rate and accuracy under light, lens, sensor and clutter effects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation, Frame, Prior
from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_sim.benchmarks.features_scenes import Conditions, random_picture
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import wilson

NEAR = (0.8, 1.2)
"""Distances [m] at which a dot's diameter is 13 to 20 px; 1.6 m: 10 px."""
ROWS: dict[str, Conditions] = {
    "detection: up to all of it": Conditions(
        tilt=70.0, distance=NEAR, blur=1.5, noise=10.0, gradient=0.5, clutter=9, drawn=True
    ),
    "detection: all at once": Conditions(
        tilt=70.0, distance=NEAR, blur=1.5, noise=10.0, gradient=0.5, clutter=9
    ),
    "detection: all at once, 10 px": Conditions(tilt=70.0, blur=1.5, noise=10.0, gradient=0.5, clutter=9),
    "detection: tilt 70, clutter": Conditions(tilt=70.0, distance=NEAR, clutter=9),
    "n0": Conditions(noise=0.0),
    "n2 b.7": Conditions(),
    "n5 b.7": Conditions(noise=5.0),
    "n10 b.7": Conditions(noise=10.0),
    "n2 b1.5": Conditions(blur=1.5),
    "n2 b.7 g50%": Conditions(gradient=0.5),
    "n5 b1.5 g50%": Conditions(noise=5.0, blur=1.5, gradient=0.5),
    "n0 g50%, near": Conditions(noise=0.0, gradient=0.5, distance=(0.8, 1.0)),
    "banding 20%": Conditions(banding=0.2),
    "light x 0.4 to 1.6": Conditions(gain=(0.4, 1.6)),
    "white clipped": Conditions(gain=(1.3, 1.8)),
    "shot noise": Conditions(noise=1.0, shot=0.2),
    "motion 5 px": Conditions(motion=5.0),
    "cut 0.3 px": Conditions(cut=0.3),
    "cut 1 px": Conditions(cut=1.0),
    "jpeg 95": Conditions(jpeg=95),
    "jpeg 75": Conditions(jpeg=75),
    "jpeg 50": Conditions(jpeg=50),
}
"""Dots of 10 px, tilts to 50 degrees, 2 grey levels of noise, 0.7 px of blur where nothing else is stated."""
REFERENCE_PX = {
    "n0": 0.011,
    "n2 b.7": 0.013,
    "n5 b.7": 0.023,
    "n10 b.7": 0.041,
    "n2 b1.5": 0.017,
    "n2 b.7 g50%": 0.017,
    "n5 b1.5 g50%": 0.035,
}
"""Thresholded components with weighted centroids (OpenCV), measured on pictures of this kind beforehand."""
WRONG_PX = 2.0
"""A dot reported farther than this from where it is has another's id."""
TRACKED_DOTS = 4


@dataclass
class _Tally:
    """Counts of one row's images, for one mode of detection."""

    faces: int = 0
    dots: int = 0
    wrong: int = 0
    frames: int = 0
    found: int = 0
    errors: list[FloatArray] = field(default_factory=list)
    squares: list[FloatArray] = field(default_factory=list)

    def add(self, observation: CameraObservation, truth: FloatArray) -> None:
        errors = observation.pixels - truth[observation.ids]
        seen = [int(np.isin(face.ids, observation.ids).sum()) for face in DEFAULT_BODY]
        faces = sum(count >= TRACKED_DOTS for count in seen)
        self.frames += 1
        self.faces += faces
        self.found += faces == len(seen)
        self.dots += len(errors)
        self.wrong += int((np.hypot(*errors.T) > WRONG_PX).sum())
        self.errors.append(errors)
        self.squares.append(
            np.sum(errors * np.linalg.solve(observation.covariances, errors[:, :, None])[:, :, 0], axis=1)
        )

    def row(self) -> dict[str, Any]:
        errors, squares = np.concatenate(self.errors), np.concatenate(self.squares)
        low, high = wilson(self.found, self.frames)
        face_low, face_high = wilson(self.faces, len(DEFAULT_BODY) * self.frames)
        share, most_wrong = wilson(self.wrong, max(self.dots, 1))
        figures: dict[str, Any] = {
            "frames": self.frames,
            "all_faces": self.found,
            "all_faces_wilson_95": [low, high],
            "faces": self.faces,
            "faces_wilson_95": [face_low, face_high],
            "dots": self.dots,
            "wrong_ids": self.wrong,
            "wrong_ids_wilson_95": [share, most_wrong],
        }
        if self.dots:
            figures["rms_px"] = float(np.sqrt(np.mean(errors**2)))
            figures["bias_px"] = [float(x) for x in errors.mean(axis=0)]
            figures["max_px"] = float(np.abs(errors).max())
            figures["chi2_per_freedom"] = float(squares.mean() / 2.0)
            figures["beyond_chi2_0.999"] = float(np.mean(squares > -2.0 * np.log(0.001)))
        return figures


def robustness(
    detector: DotDetector,
    pictures: int,
    seed: int,
    progress: ProgressCall,
    rows: dict[str, Conditions] = ROWS,
) -> list[dict[str, Any]]:
    """A row for each of the conditions, by acquisition (no prior) and by tracking (a prior some 1 px off), of as many
    random pictures; a face counts as found with four right dots or more, a frame with all its faces.
    """
    table = []
    for at, (name, conditions) in enumerate(rows.items()):
        rng = np.random.default_rng([seed, at])
        acquired, tracked = _Tally(), _Tally()
        for k in range(pictures):
            image, truth = random_picture(conditions, rng)
            frame = Frame("bench", k, 1_000_000_000, 1_000_000_000, image)
            off = rng.normal(0.0, 1.0, 2) + rng.normal(0.0, 0.3, truth.shape)
            prior = Prior(
                "bench", frame.t_shutter_ns, np.arange(len(truth)), truth + off, np.zeros_like(truth),
                np.tile(1.1 * np.eye(2), (len(truth), 1, 1)),
            )  # fmt: skip
            acquired.add(detector.detect(frame, None), truth)
            tracked.add(detector.detect(frame, prior), truth)
        row: dict[str, Any] = {"conditions": name, "acquired": acquired.row(), "tracked": tracked.row()}
        if name in REFERENCE_PX and tracked.dots:
            row["reference_px"] = REFERENCE_PX[name]
            row["rms_over_reference"] = row["tracked"]["rms_px"] / REFERENCE_PX[name]
        table.append(row)
        progress("robustness", at + 1, len(rows))
    return table
