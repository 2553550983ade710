"""Experiment ``laws``: every law on three demanding tasks, and a sketch of every kind of goal.

The pictures of `docs/goals-and-laws.md`. Laws run as in ``stereoservo simulate``: the free arm, self-calibrated; the
controller sees noisy pixels, the table and the pictures show the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from stereoservo.control.law_registry import LAWS
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.tasks.calibrations import TaskCalibration, calibrate
from stereoservo_sim.tasks.closed_loop import LoopSettings, TaskResult, Trace, run_task
from stereoservo_sim.tasks.hard_tasks import shipped_tasks_path
from stereoservo_sim.tasks.task_file import AlignmentTask, read_tasks
from stereoservo_sim.world.synthetic import rotation, translation

NOISE_PX = 0.1
LARGE_ID, BENT_ID = 5032, 5116
"""Of the shipped hard tasks: one whose turn swings corners out of the image, one whose straight path leaves it."""
ROLL_ID = 1
CURRENT = "stereo, current"
VARIANTS = ("stereo", CURRENT, *(law for law in LAWS if law != "stereo"))
"""The laws by name, and the classical one, developed around the present points; else around the mean (8.1.1)."""
THESIS = {
    "roll": "8.7: of three classical laws one diverges, two show the plate's back before they converge; "
    "both Cartesian ones converge with the face in view"
}


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """A law on a task: its evaluation, and the path taken."""

    name: str
    task: AlignmentTask
    result: TaskResult
    trace: Trace


@dataclass(frozen=True, eq=False)
class LawComparison:
    """All runs, by task name and law."""

    seed: int
    runs: dict[str, dict[str, ComparedRun]]


def compared_tasks() -> dict[str, AlignmentTask]:
    """``large`` 132° and 0.32 m, ``roll`` thesis 8.7, ``bent`` 117° and 0.39 m beside the images' borders."""
    shipped = {task.id: task for task in read_tasks(shipped_tasks_path())}
    return {"large": shipped[LARGE_ID], "roll": tilted_roll(), "bent": shipped[BENT_ID]}


def tilted_roll() -> AlignmentTask:
    """Half a turn about the rig's line of sight, the face tilted by 60° (thesis 8.7)."""
    goal = translation(0.0, 0.0, 1.0) @ rotation("y", 60)
    start = translation(0.0, 0.0, 1.0) @ rotation("z", 180) @ rotation("y", 60)
    return AlignmentTask(ROLL_ID, 0, 180.0, 0.0, np.array([1.0, 0.0, 0.0]), start, goal)


def run_laws(
    seed: int,
    progress: ProgressCall,
    laws: tuple[str, ...] = VARIANTS,
    calibration: TaskCalibration | None = None,
) -> LawComparison:
    """Every one of ``laws`` on every task; the arm is calibrated first where no ``calibration`` is given."""
    tasks = compared_tasks()
    total = len(tasks) * len(laws)
    progress("laws", 0, total)
    known = calibration or calibrate("free", "self", NOISE_PX, seed)
    runs: dict[str, dict[str, ComparedRun]] = {name: {} for name in tasks}
    for name, task in tasks.items():
        for law in laws:
            settings = LoopSettings(
                law=law.partition(",")[0],
                jacobian="current" if law == CURRENT else "mean",
                noise_px=NOISE_PX,
                seed=seed,
            )
            result, trace = run_task(task, known, settings)
            runs[name][law] = ComparedRun(name, task, result, trace)
            progress("laws", sum(len(of_task) for of_task in runs.values()), total)
    return LawComparison(seed, runs)


def report_laws(comparison: LawComparison) -> dict[str, Any]:
    """JSON report: a row a task and law."""
    rows = [_row(law, run) for runs in comparison.runs.values() for law, run in runs.items()]
    return {
        "experiment": "laws", "rows": rows, "thesis": THESIS, "seed": comparison.seed, "noise_px": NOISE_PX,
        "calibration": "self",
    }  # fmt: skip


def _row(law: str, run: ComparedRun) -> dict[str, Any]:
    result, task = run.result, run.task
    facing = float(np.degrees(np.arccos(np.clip(run.trace.facing.min(), -1.0, 1.0))))
    return {
        "task": run.name, "angle_deg": round(task.angle_deg, 1), "distance_m": round(task.distance_m, 3),
        "law": law, "success": bool(result.success), "reason": result.reason, "refused": result.refused,
        "iterations": result.iterations, "final_error_px": result.final_error_px,
        "line_deviation_mm": result.line_deviation_mm, "worst_view_angle_deg": facing,
        "closest_view_px": result.closest_view_px,
    }  # fmt: skip


def show_laws(answer: dict[str, Any], console: Console) -> None:
    """Print the rows; a view angle of 90° and more is the back, a negative margin is out of the image."""
    table = Table(
        title="laws on demanding tasks, self-calibrated, 25 Hz", title_justify="left", caption_justify="left",
    )  # fmt: skip
    for name in (
        "task",
        "law",
        "comes to",
        "steps",
        "error [px]",
        "off the line [mm]",
        "view angle [°]",
        "room [px]",
    ):
        table.add_column(
            name, justify="left" if name in ("task", "law", "comes to") else "right", no_wrap=True
        )
    for row in answer["rows"]:
        table.add_row(
            f"{row['task']}, {row['angle_deg']:.0f}°, {row['distance_m']:.2f} m", row["law"],
            "the goal" if row["success"] else row["reason"], str(row["iterations"]),
            *(
                "-" if row[key] is None else format(row[key], form)
                for key, form in (
                    ("final_error_px", ".3f"), ("line_deviation_mm", ".2f"), ("worst_view_angle_deg", ".0f"),
                    ("closest_view_px", ".0f"),
                )
            ),
        )  # fmt: skip
    Console(file=console.file, width=max(console.width, 140), markup=False).print(table)
    console.print(f"thesis: {answer['thesis']['roll']}")
