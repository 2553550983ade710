"""Tasks A, B, C of `tasks-abc` through rendered pictures, calibration and all: what the extraction of the markers does
to a run with and without the prediction by the kinematics (8.6, figs 8.9, 8.10).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.comparison import Comparison, of_statement
from stereoservo_sim.experiments.laws.driven_tasks import picture, saved
from stereoservo_sim.experiments.pictures.plates import PlatePictures
from stereoservo_sim.tasks.arms import PLATE_ON_FLANGE, rx90_cell
from stereoservo_sim.tasks.calibrations import TaskCalibration, calibrate, with_trial_ranges
from stereoservo_sim.tasks.closed_loop import LoopSettings, run_task
from stereoservo_sim.tasks.options import STOPS
from stereoservo_sim.tasks.setting import MARKERS
from stereoservo_sim.tasks.task_file import AlignmentTask

DETECTED_PX = 0.02
"""[px] an axis, that the fit is told of the markers in the trials' pictures."""
HARD = ("B", "projective", True)
IN_BOTH = 2 * len(MARKERS)
RUNS = (
    ("A", "projective", True),
    ("A", "coarse", False),
    HARD,
    ("B", "projective", False),
    ("B", "coarse", False),
    ("B", "coarse", True),
    ("C", "projective", True),
)
"""Task, calibration, and whether the detector is given what the kinematics predict."""
COASTS = (
    "the law coasts on its wrong prediction, and the search of the whole image finds the marked dots again once they "
    "lean less; the thesis's four like markers had to be told apart by where they were"
)
ASSUMPTIONS = [
    "pictures: the plate as a face of seven dots, whose corners are the four markers, 2 grey levels of noise; markers "
    "by the product's detector of dots; the projective model learnt from pictures of the trial motions too",
    "with prediction: the detector gets the expected pixels, the law goes on by them where it finds nothing; without: "
    "it searches whole images, and the arm stands while a marker of either image is missing, for 1 s at most",
]


def pictured_calibration(seed: int) -> TaskCalibration:
    """The RX 90's model learnt from pictures of its trial motions. Raises CalibrationError."""
    cell = with_trial_ranges(rx90_cell())
    rng = np.random.default_rng([seed, 20])
    pictures = PlatePictures(predicts=True)
    trials = cell.trials(DETECTED_PX, rng, STOPS)
    pixels = np.full(trials.pixels.shape, np.nan)
    for k, q in enumerate(trials.positions):
        found, seen = pictures.extracted(cell.flange(q) @ PLATE_ON_FLANGE, None, rng)
        pixels[:, k] = np.where(seen[..., None] > 0.0, found, np.nan)
    result = fit_model(msgspec.structs.replace(trials, pixels=pixels), epoch=1)
    return TaskCalibration("rx90", cell, result.model, {"rms_px": result.report.rms_px})


def through_pictures(
    tasks: dict[str, AlignmentTask], settings: LoopSettings
) -> tuple[list[dict[str, Any]], FloatArray]:
    """How each of ``RUNS`` ends, in how many frames the extraction lacked markers, how far predictions were off; and
    the pose (4, 4) of task B's plate where it is inclined most. Raises CalibrationError.
    """
    known = {
        "projective": pictured_calibration(settings.seed),
        "coarse": calibrate("rx90", "coarse", 0.0, settings.seed),
    }
    rows, steepest = [], np.eye(4)
    for name, calibration, predicts in RUNS:
        pictures = PlatePictures(predicts)
        result, trace = run_task(
            tasks[name], known[calibration], replace(settings, coasts=predicts), pictures
        )
        if (name, calibration, predicts) == HARD:
            steepest = trace.poses[int(trace.facing.argmin())]
        lacking = np.array(pictures.found) < IN_BOTH
        rows.append(
            {
                "task": name,
                "calibration": calibration,
                "prediction": predicts,
                "converged": bool(result.success),
                "reason": result.reason,
                "final_error_px": result.final_error_px,
                "frames": len(lacking),
                "incomplete_frames": int(lacking.sum()),
                "smallest_facing": float(trace.facing.min()),
                "extraction_rms_px": float(np.sqrt(np.mean(np.square(pictures.off)))),
                "prediction_rms_px": float(np.sqrt(np.mean(np.square(pictures.ahead))))
                if pictures.ahead
                else None,
                "prediction_worst_px": max(pictures.ahead, default=None),
            }
        )
    return rows, steepest


def draw_pictures(answer: dict[str, Any], folder: Path) -> Path:
    """The left camera's pictures of start and goal of each task, and of B's plate inclined most (fig. 8.6)."""
    pictures, rng = PlatePictures(predicts=False), np.random.default_rng(0)
    figure = picture(11, 4)
    axes = figure.subplots(2, len(answer["tasks"]) + 1)
    columns = [
        (f"task {task['task']}", ((task["start"], "start"), (task["goal"], "goal")))
        for task in answer["tasks"]
    ]
    columns.append(("task B, inclined most", ((answer["steepest"], "left"), (answer["steepest"], "right"))))
    for column, (title, shown) in zip(axes.T, columns, strict=True):
        for axis, (pose, name) in zip(column, shown, strict=True):
            camera = pictures.cameras[int(name == "right")]
            axis.imshow(pictures.picture(camera, np.array(pose), rng), cmap="gray", vmin=0, vmax=255)
            axis.set_title(f"{title}: {name}", fontsize=8)
            axis.axis("off")
    return saved(figure, folder, "tasks-abc-pictures")


def compare_pictures(rows: list[dict[str, Any]]) -> list[Comparison]:
    """8.6, figs 8.9 and 8.10 beside the runs through pictures."""

    def run(name: str, calibration: str, predicts: bool) -> dict[str, Any]:
        (found,) = (
            r for r in rows if (r["task"], r["calibration"], r["prediction"]) == (name, calibration, predicts)
        )
        return found

    own, alone = run("B", "projective", True), run("B", "projective", False)
    coarse, coasting = run("B", "coarse", False), run("B", "coarse", True)
    simple = [run("A", "projective", True), run("A", "coarse", False)]
    degrees = np.degrees(np.arccos([own["smallest_facing"], alone["smallest_facing"]]))
    recovered = own["converged"] and own["incomplete_frames"] > 0
    return [
        of_statement("8.6", "task B in pictures, no prediction", "the extraction fails",
                     f"{_end(alone)} at {degrees[1]:.0f}°", alone["reason"] == "EXTRACTION_LOST"),
        of_statement("8.6", "task B in pictures, prediction by the kinematics", "tolerates it and recovers",
                     f"{_end(own)}; markers missing in {own['incomplete_frames']} of {own['frames']} frames, "
                     f"inclined to {degrees[0]:.0f}°", recovered),
        of_statement("8.6", "accuracy of prediction, task B", "far better than a pixel",
                     f"{own['prediction_rms_px']:.2g} px rms, {own['prediction_worst_px']:.2g} px at worst; coarse "
                     f"{coasting['prediction_rms_px']:.2g} and {coasting['prediction_worst_px']:.2g} px",
                     own["prediction_worst_px"] < 1.0),
        of_statement("8.6", "task C in pictures, prediction by the kinematics", "realized successfully",
                     _end(run("C", "projective", True)), run("C", "projective", True)["converged"]),
        of_statement("fig. 8.9", "simple task A in pictures, projective and coarse", "both servo it",
                     "; ".join(_end(row) for row in simple), all(row["converged"] for row in simple)),
        of_statement("fig. 8.10", "hard task B in pictures, coarse, no prediction", "a run failed", _end(coarse),
                     not coarse["converged"]),
        of_statement("fig. 8.10", "hard task B in pictures, coarse, predicted by the coarse model itself",
                     "a run failed", _end(coasting), not coasting["converged"], COASTS),
    ]  # fmt: skip


def _end(row: dict[str, Any]) -> str:
    if row["converged"]:
        return "converges"
    return (
        "the markers are lost, the run ends"
        if row["reason"] == "EXTRACTION_LOST"
        else f"fails: {row['reason']}"
    )
