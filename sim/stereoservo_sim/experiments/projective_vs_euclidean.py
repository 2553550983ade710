"""Experiment ``projective-vs-euclidean`` (thesis 9.3): the same tasks with a self-calibrated model and with metric
ones of growing errors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo_sim.experiments.driven_tasks import Case, results_of
from stereoservo_sim.experiments.experiment import Comparison, not_comparable, of_statement
from stereoservo_sim.experiments.figures import COLOURS, Figures, labelled, picture
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import spread, wilson
from stereoservo_sim.tasks.arms import free_cell
from stereoservo_sim.tasks.calibrations import metric_model, self_calibrated
from stereoservo_sim.tasks.campaign import default_jobs
from stereoservo_sim.tasks.closed_loop import LoopSettings, TaskResult
from stereoservo_sim.tasks.marker_estimate import PointsName
from stereoservo_sim.tasks.random_tasks import MAX_ANGLE_DEG, MAX_DISTANCE_M, random_tasks

LEVELS = ((0.0, 0.0), (0.02, 1.0), (0.05, 2.5), (0.1, 5.0), (0.2, 10.0))
"""Focal error (share) and hand-eye error [°] of the metric models."""
LAWS_COMPARED = ("cartesian3", "stereo")
NOISE_PX = 0.1
THESIS = {
    "section": "9.3",
    "asks for": "an in-depth comparison of performances under Euclidean and projective modeling",
    "8.6": "coarse calibration fails on the hard task, projective does not",
    "8.7": "almost perfect overlap of projective and Euclidean model",
}
ASSUMPTIONS = [
    f"random tasks to {MAX_ANGLE_DEG:g}° and {MAX_DISTANCE_M:g} m, both ends in view of both cameras; virtual arm of "
    "six Cartesian generators; 25 Hz, gain 0.5/s; set-points are exact projections of the goal",
    f"{NOISE_PX} px noise in all images, those of the projective model's trial motions included (25 are averaged)",
    "metric models: focal lengths of both cameras too long by the share, the arm turned about an axis of the task's "
    "own; points are triangulated in every frame, as the markers' places on the plate are not calibrated; the "
    "projective model runs in the same way ('triangulated') and as it does in the cell ('predicted')",
    "stereo takes the mean Jacobian of here and goal",
]
TITLE = "projective-vs-euclidean: {count} tasks a row; spreads over solved tasks, medians (16 % to 84 %)"


def run_projective_vs_euclidean(
    *,
    seeds: int,
    seed: int,
    progress: ProgressCall,
    levels: tuple[tuple[float, float], ...] = LEVELS,
    jobs: int | None = None,
) -> dict[str, Any]:
    """Run ``seeds`` tasks by both laws with every model. Raises CalibrationError."""
    tasks = random_tasks(seed, seeds)
    cell = free_cell()
    learnt = self_calibrated("free", cell, NOISE_PX, seed)
    sources: tuple[PointsName, ...] = ("predicted", "triangulated")
    models = [("projective", points, learnt) for points in sources]
    models += [("metric", sources[1], metric_model("free", cell, *level)) for level in levels]
    cases, heads = [], []
    for law in LAWS_COMPARED:
        for name, points, calibration in models:
            settings = LoopSettings(law=law, points=points, noise_px=NOISE_PX, seed=seed)
            cases.append(Case(calibration, settings))
            metric = name == "metric"
            heads.append(
                {
                    "law": law,
                    "model": name,
                    "points": points,
                    "focal_error": calibration.focal_error if metric else None,
                    "hand_eye_error_deg": calibration.hand_eye_error_deg if metric else None,
                }
            )
    workers = default_jobs() if jobs is None else jobs
    results = results_of(cases, tasks, workers, lambda done, total: progress("projective-vs-euclidean", done, total))
    return {
        "title": TITLE.format(count=seeds),
        "noise_px": NOISE_PX,
        "rows": [head | _summary(found) for head, found in zip(heads, results, strict=True)],
        "thesis": THESIS,
        "assumptions": ASSUMPTIONS,
        "calibration": learnt.facts,
    }


def compare_projective_vs_euclidean(answer: dict[str, Any]) -> list[Comparison]:
    """Thesis 9.3 concludes that the properties are almost the same, and asks for a comparison without a figure."""
    found = []
    for law in LAWS_COMPARED:
        rows = {(row["model"], row["points"], row["focal_error"]): row for row in answer["rows"] if row["law"] == law}
        own, exact = rows["projective", "triangulated", None], rows["metric", "triangulated", 0.0]
        apart = [row["line_deviation_mm"]["median"] for row in (own, exact)]
        found.append(
            of_statement(
                "9.3",
                f"{law}, projective beside an exact Euclidean model",
                "almost the same properties, qualitatively and quantitatively",
                f"{own['solved']} and {exact['solved']} of {answer['seeds']} solved; {apart[0]:.2g} and "
                f"{apart[1]:.2g} mm from the line",
                "solved: 4 % of the tasks apart at most; medians of the deviation: a tenth at most",
                abs(apart[0] - apart[1]) <= 0.1 * apart[1]
                and abs(own["solved"] - exact["solved"]) <= 0.04 * answer["seeds"],
            )
        )
    asked = "the thesis asks for it as further work and has no figure"
    return [*found, not_comparable("9.3", "growing metric errors", "-", "see the rows", asked)]


def _summary(results: list[TaskResult]) -> dict[str, Any]:
    solved = [result for result in results if result.success]
    low, high = wilson(len(solved), len(results))
    failed = [result.reason for result in results if not result.success]
    deviations = [result.line_deviation_mm for result in solved if result.line_deviation_mm is not None]
    return {
        "solved": len(solved),
        "success_rate": len(solved) / len(results),
        "wilson_low": low,
        "wilson_high": high,
        "line_deviation_mm": spread(deviations),
        "worst_line_deviation_mm": max(deviations, default=None),
        "final_error_px": spread([r.final_error_px for r in solved if r.final_error_px is not None]),
        "iterations": spread([float(result.iterations) for result in solved]),
        "failed": "; ".join(f"{failed.count(reason)} {reason}" for reason in sorted(set(failed))) or None,
    }


def draw_projective_vs_euclidean(answer: dict[str, Any]) -> Figures:
    """Success and deviation over the metric model's error; the projective model as a line across."""
    figure = picture(10, 4.2)
    success, deviation = figure.subplots(1, 2)
    for law, colour in zip(LAWS_COMPARED, COLOURS, strict=False):
        rows = [row for row in answer["rows"] if row["law"] == law]
        metric = [row for row in rows if row["model"] == "metric"]
        level = next(row for row in rows if row["model"] == "projective")
        across = [row["hand_eye_error_deg"] for row in metric]
        rate = np.array([row["success_rate"] for row in metric])
        bounds = np.array([(row["wilson_low"], row["wilson_high"]) for row in metric])
        success.errorbar(
            across,
            rate,
            yerr=np.abs(bounds - rate[:, None]).T,
            fmt="o-",
            color=colour,
            capsize=3,
            label=f"{law}, metric",
        )
        success.axhline(level["success_rate"], color=colour, linestyle="--", label=f"{law}, projective")
        drawn = [row for row in metric if row["solved"]]
        deviation.plot(
            [row["hand_eye_error_deg"] for row in drawn],
            [row["line_deviation_mm"]["median"] for row in drawn],
            "o-",
            color=colour,
        )
        if level["solved"]:
            deviation.axhline(level["line_deviation_mm"]["median"], color=colour, linestyle="--")
    labelled(success, "success, Wilson 95 %", "hand-eye error [deg]; focal error [%] is twice that", "share")
    labelled(deviation, "of the plate's middle from its line, median", "hand-eye error [deg]", "[mm]")
    deviation.set_yscale("log")
    success.set_ylim(0.0, 1.03)
    success.legend(fontsize=7)
    return {"projective-vs-euclidean": figure}
