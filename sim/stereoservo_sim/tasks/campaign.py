"""Parallel execution of many tasks, each with its own seed: results do not depend on the number of processes."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import msgspec
import numpy as np

from stereoservo_sim.summaries import wilson
from stereoservo_sim.tasks.calibrations import TaskCalibration, calibrate
from stereoservo_sim.tasks.closed_loop import LoopSettings, TaskResult, run_task
from stereoservo_sim.tasks.task_file import AlignmentTask

Tell = Callable[[int, int], None]
CHUNK = 4
"""Tasks per unit of work of a process."""

_worker: tuple[TaskCalibration, LoopSettings] | None = None


def run_campaign(
    tasks: Sequence[AlignmentTask], settings: LoopSettings, jobs: int, tell: Tell = lambda done, total: None
) -> dict[str, Any]:
    """Run every task; ``tell(done, total)`` is called as they end. Raises CalibrationError.

    Returns the results in the order of the tasks, and their `summary`.
    """
    started = time.perf_counter()
    calibration = calibrate(settings.arm, settings.calibration, settings.noise_px, settings.seed, settings.mechanics)
    results: dict[int, TaskResult] = {}
    tell(0, len(tasks))
    for batch in _batches(tasks, calibration, settings, jobs):
        results.update({result.id: result for result in batch})
        tell(len(results), len(tasks))
    ordered = [results[task.id] for task in tasks]
    return {
        "tasks": [msgspec.to_builtins(result) for result in ordered],
        **summary(ordered),
        "settings": msgspec.to_builtins(settings),
        "calibration": calibration.facts,
        "set_points": "exact projections of the goal",
        "seconds": round(time.perf_counter() - started, 3),
    }


def _batches(
    tasks: Sequence[AlignmentTask], calibration: TaskCalibration, settings: LoopSettings, jobs: int
) -> Iterator[list[TaskResult]]:
    if jobs == 1 or len(tasks) <= CHUNK:
        for task in tasks:
            yield [run_task(task, calibration, settings)[0]]
        return
    chunks = [tasks[i : i + CHUNK] for i in range(0, len(tasks), CHUNK)]
    # A new interpreter each: a fork would copy the threads of the progress bar in an undefined state.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        min(jobs, len(chunks)), context, initializer=_start, initargs=(calibration, settings)
    ) as pool:
        futures = [pool.submit(_run_chunk, chunk) for chunk in chunks]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            for future in futures:
                future.cancel()


def _start(calibration: TaskCalibration, settings: LoopSettings) -> None:
    global _worker  # noqa: PLW0603 - one a process, handed over once instead of with each task
    _worker = (calibration, settings)


def _run_chunk(chunk: Sequence[AlignmentTask]) -> list[TaskResult]:
    assert _worker is not None
    calibration, settings = _worker
    return [run_task(task, calibration, settings)[0] for task in chunk]


def default_jobs() -> int:
    """Number of processors available to this process."""
    return len(os.sched_getaffinity(0))


def summary(results: Sequence[TaskResult]) -> dict[str, Any]:
    """Rates and extremes of a campaign over the reachable tasks; errors and deviations over the solved ones."""
    judged = [result for result in results if result.success is not None]
    solved = [result for result in judged if result.success]
    low, high = wilson(len(solved), len(judged)) if judged else (0.0, 1.0)
    reasons: dict[str, int] = {}
    for result in judged:
        if result.reason:
            reasons[result.reason] = reasons.get(result.reason, 0) + 1
    return {
        "success_rate": len(solved) / len(judged) if judged else None,
        "wilson_95": [low, high],
        "solved": len(solved),
        "refused": sum(bool(result.refused) for result in judged),
        "failed_moving": sum(not result.success and not result.refused for result in judged),
        "unreachable": len(results) - len(judged),
        "reasons": reasons,
        "back_face": sum(result.back_face for result in judged),
        "out_of_view": sum(result.out_of_view for result in judged),
        "line_deviation_mm": _spread([result.line_deviation_mm for result in solved]),
        "final_error_px": _spread([result.final_error_px for result in solved]),
        "floor_px": _spread([result.floor_px for result in solved]),
        "error_over_floor": _spread(
            [_ratio(result.final_error_px, result.floor_px) for result in solved if result.floor_px]
        ),
        "rest_mm_s": _spread([result.rest_mm_s for result in solved]),
        "rest_mrad_s": _spread([result.rest_mrad_s for result in solved]),
        "closest_view_px": _least([result.closest_view_px for result in solved]),
        "iterations": _spread([float(result.iterations) for result in solved]),
    }


def _ratio(value: float | None, floor: float | None) -> float | None:
    return None if value is None or not floor else value / floor


def _least(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return min(known) if known else None


def _spread(values: Sequence[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"median": float(np.median(known)), "mean": float(np.mean(known)), "max": float(np.max(known))}
