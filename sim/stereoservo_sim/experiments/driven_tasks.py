"""Alignment tasks run by control laws in parallel, with measures and drawings of their paths, for chapter 8."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.tasks.calibrations import TaskCalibration
from stereoservo_sim.tasks.closed_loop import LoopSettings, TaskResult, run_task
from stereoservo_sim.tasks.ground_truth import MATRICES
from stereoservo_sim.tasks.setting import HOMOGENEOUS_MARKERS
from stereoservo_sim.tasks.task_file import AlignmentTask

CHUNK = 5
"""Tasks per unit of work of a process."""
CURVE_POINTS = 150
"""Largest number of points of a curve in an answer."""


class Case(NamedTuple):
    """How tasks are run: the controller's model and settings."""

    calibration: TaskCalibration
    settings: LoopSettings


_cases: Sequence[Case] = ()


def results_of(
    cases: Sequence[Case], tasks: Sequence[AlignmentTask], jobs: int, tell: Callable[[int, int], None]
) -> list[list[TaskResult]]:
    """Results of all tasks in all cases, one list per case; ``tell(done, total)`` is called as they end."""
    total = len(cases) * len(tasks)
    found: list[list[TaskResult]] = [[] for _ in cases]
    tell(0, total)
    if jobs == 1:
        for i, case in enumerate(cases):
            for task in tasks:
                found[i].append(run_task(task, *case)[0])
                tell(i * len(tasks) + len(found[i]), total)
        return found
    chunks = [(i, tasks[k : k + CHUNK]) for i in range(len(cases)) for k in range(0, len(tasks), CHUNK)]
    # A new interpreter each: a fork would copy the threads of the progress bar in an undefined state.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(chunks)), context, initializer=_start, initargs=(cases,)) as pool:
        futures = [pool.submit(_run_chunk, *chunk) for chunk in chunks]
        try:
            done = 0
            for future in as_completed(futures):
                done += len(future.result())
                tell(done, total)
        finally:
            for future in futures:
                future.cancel()
    for (i, _), future in zip(chunks, futures, strict=True):
        found[i] += future.result()
    return found


def _start(cases: Sequence[Case]) -> None:
    global _cases  # noqa: PLW0603 - one a process, handed over once instead of with each task
    _cases = cases


def _run_chunk(case: int, tasks: Sequence[AlignmentTask]) -> list[TaskResult]:
    return [run_task(task, *_cases[case])[0] for task in tasks]


def images(poses: FloatArray) -> FloatArray:
    """Noise-free pixels (k, c, m, 2) of the plate at ``poses`` (k, 4, 4)."""
    x = np.einsum("cij,kjl,ml->kcmi", MATRICES, poses, HOMOGENEOUS_MARKERS)
    return np.asarray(x[..., :2] / x[..., 2:])


def image_errors(poses: FloatArray, goal: FloatArray) -> FloatArray:
    """Total error (k,) [px]: the norm over all cameras and markers."""
    difference = images(poses) - images(goal[None])
    return np.asarray(np.sqrt((difference**2).sum(axis=(1, 2, 3))))


def path_ratio(poses: FloatArray) -> float:
    """Length of the markers' image paths divided by the distance from their start to their end, over all of them."""
    pixels = images(poses)
    walked = np.linalg.norm(np.diff(pixels, axis=0), axis=-1).sum()
    return float(walked / np.linalg.norm(pixels[-1] - pixels[0], axis=-1).sum())


class Decay(NamedTuple):
    """Exponential ``A e^{-rate t}`` fitted to an error by least squares of its logarithm: ``rate`` [1/s], and
    ``r_squared``.
    """

    rate: float
    r_squared: float


def decay(errors: FloatArray, dt_s: float, least: float) -> Decay | None:
    """Fit of errors (k,) from the first one until they have fallen to the share ``least`` of it.

    None for fewer than four samples, or if the first is not positive.
    """
    if not (len(errors) and errors[0] > 0.0 and np.isfinite(errors[0])):
        return None
    small = np.flatnonzero(~(errors > least * errors[0]))
    k = int(small[0]) if len(small) else len(errors)
    if k < 4:
        return None
    t, y = dt_s * np.arange(k), np.log(errors[:k])
    slope, level = np.polyfit(t, y, 1)
    left = y - (level + slope * t)
    spread = float(((y - y.mean()) ** 2).sum())
    return Decay(-float(slope), 1.0 - float((left**2).sum()) / spread if spread > 0.0 else 0.0)


def thinned(values: FloatArray, digits: int = 4) -> list[Any]:
    """At most ``CURVE_POINTS`` of the values (k, …), evenly spaced, with the first and the last."""
    if len(values) == 0:
        return []
    picked = np.unique(np.linspace(0, len(values) - 1, CURVE_POINTS).round().astype(int))
    listed: list[Any] = np.round(values[picked], digits).tolist()
    return listed
