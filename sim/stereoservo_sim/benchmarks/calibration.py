"""``bench calibration``: duration of a fit of the thesis's size, CPU time per image, CPU time and memory over the
markers, and scipy's dense least squares as a baseline.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from stereoservo.calibration.bundle_adjustment import jacobian, solve
from stereoservo.calibration.rig_model import RigModel, full_charts, residuals, rig_at
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.single_joint_fit import measurements
from stereoservo.calibration.trial_data import TrialData
from stereoservo.kinematics.axes import framed_model
from stereoservo_sim.benchmarks.timing import summary, timed
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell, rotation, rx90, two_faces

SIGMA = 0.05
"""Standard deviation of the pixels [px]."""
STOPS = 20
IMAGES = (100, 300, 1000, 3000, 10_000)
"""Approximate numbers of images for the cost per image."""
MARKERS = (8, 16, 32, 64)
"""Numbers of markers for the cost per marker, in two cameras."""
MARKER_IMAGES = 1000
"""Approximate number of images for the cost per marker."""
LARGEST = (64, 4, 10_000)
"""Markers, cameras and images of a large plant, fitted from ``LARGE_FROM`` repetitions on: it takes a minute."""
LARGE_FROM = 20
START = 30.0
"""Distance of the common start of the two least squares from the truth [standard deviations]."""


def thesis_sized() -> SyntheticCell:
    """Six revolute joints, 16 markers, two cameras."""
    more = [(0.02, -0.01, 0.06), (-0.02, 0.01, 0.06)]
    return rx90(np.vstack([two_faces(), more]))


def run_calibration(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Time of ``fit_model`` over fresh noise, of one image, and of scipy's dense least squares from the same start."""
    cell = thesis_sized()
    count = max(3, repetitions)
    data = [cell.trials(SIGMA, np.random.default_rng([seed, k]), STOPS) for k in range(count)]

    def fit(k: int) -> None:
        fit_model(data[k], epoch=1)
        progress("fits", min(k + 1, count), count)

    wall, cpu = timed(fit, count)
    result: dict[str, Any] = {
        "problem": {
            "joints": len(cell.kinds),
            "stops_per_joint": STOPS,
            "markers": len(cell.body),
            "cameras": len(cell.poses),
            "images": data[0].images,
            "measurements": int(2 * data[0].visible.sum()),
        },
        "fit_wall_s": summary(wall),
        "fit_cpu_s": summary(cpu),
        "per_image": _per_image(cell, seed, progress),
        "per_marker": _per_marker(count, seed, progress),
        "least_squares": _beside_scipy(cell, data[0], count, seed, progress),
    }
    times = [row["fit_ms_an_image"] for row in result["per_image"]]
    result["fit_ms_an_image_last_over_first"] = times[-1] / times[0]
    plants = [row for row in result["per_marker"] if row["cameras"] == 2]
    slope = np.polyfit(np.log([row["markers"] for row in plants]), np.log([row["fit_cpu_s"] for row in plants]), 1)
    result["fit_cpu_exponent_over_markers"] = float(slope[0])
    return result


def _per_image(cell: SyntheticCell, seed: int, progress: ProgressCall) -> list[dict[str, float]]:
    """CPU time of one fit divided by its number of images."""
    rows = []
    for k, images in enumerate(IMAGES):
        stops = max(4, round(images / (len(cell.kinds) * len(cell.poses))))
        trials = cell.trials(SIGMA, np.random.default_rng([seed, 1000 + k]), stops)
        at = time.process_time()
        fit_model(trials, epoch=1)
        spent = time.process_time() - at
        rows.append(
            {"images": trials.images, "fit_cpu_s": round(spent, 3), "fit_ms_an_image": 1e3 * spent / trials.images}
        )
        progress("cost an image", k + 1, len(IMAGES))
    return rows


def _per_marker(count: int, seed: int, progress: ProgressCall) -> list[dict[str, float]]:
    """CPU time and peak memory of one fit each, in its own process; of the largest plant from many repetitions on.

    The processes are forked from a small server, since a child of this process would start with its peak memory.
    """
    plants = [(markers, 2, MARKER_IMAGES) for markers in MARKERS]
    if count >= LARGE_FROM:
        plants.append(LARGEST)
    rows = []
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload([__name__])
    with server.Pool(1, maxtasksperchild=1) as pool:
        for k, plant in enumerate(plants):
            rows.append(pool.apply(measured_fit, (*plant, seed)))
            progress("cost a marker", k + 1, len(plants))
    return rows


def measured_fit(markers: int, cameras: int, images: int, seed: int) -> dict[str, float]:
    """CPU time [s] of one fit and the peak memory [MB] of this process, after a small fit that loads all kernels."""
    across = np.random.default_rng([seed, 3000]).uniform([-0.05, -0.035], [0.05, 0.035], (markers, 2))
    front, side = np.array_split(np.column_stack([across, np.full(markers, 0.05)]), 2)
    side = side @ rotation("y", 50)[:3, :3].T + [0.07, 0.0, -0.02]
    cell = rx90(np.vstack([front, side]), cameras)
    fit_model(cell.trials(SIGMA, np.random.default_rng([seed, 3001]), 4), epoch=1)
    stops = max(4, round(images / (len(cell.kinds) * cameras)))
    trials = cell.trials(SIGMA, np.random.default_rng([seed, 3002]), stops)
    at = time.process_time()
    fit_model(trials, epoch=1)
    spent = time.process_time() - at
    return {
        "markers": markers,
        "cameras": cameras,
        "images": trials.images,
        "fit_cpu_s": round(spent, 3),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def _beside_scipy(
    cell: SyntheticCell, trials: TrialData, count: int, seed: int, progress: ProgressCall
) -> dict[str, Any]:
    """Duration of the metric bundle adjustment, ours and scipy's on the dense Jacobian of the same residuals, from one
    start.
    """
    parts = framed_model(exact_model(cell))
    truth = RigModel(cell.kinds, parts.generators, parts.cameras, parts.points, parts.lenses)
    data = measurements(trials, trials.visible, trials.positions - parts.zero)
    charts = full_charts(truth, "metric")
    slope = jacobian(truth, charts, np.zeros(charts.size), data)
    noise = np.random.default_rng([seed, 2000]).standard_normal(charts.size)
    start = rig_at(truth, charts, START * np.linalg.solve(np.linalg.qr(slope, mode="r"), noise))
    here = full_charts(start, "metric")
    costs: dict[str, float] = {}

    def ours(_: int) -> None:
        costs["ours"] = solve(start, data, "metric").cost

    def dense(k: int) -> None:
        found = least_squares(
            lambda x: residuals(rig_at(start, here, x), data),
            np.zeros(here.size),
            jac=lambda x: jacobian(start, here, x, data),
            x_scale="jac",
            xtol=1e-10,
            ftol=1e-10,
        )
        costs["scipy"] = 2.0 * found.cost
        progress("scipy", min(k + 1, count), count)

    mine, theirs = timed(ours, count)[1], timed(dense, count)[1]
    return {
        "ours_cpu_s": summary(mine),
        "scipy_dense_cpu_s": summary(theirs),
        "scipy_over_ours": float(np.median(theirs) / np.median(mine)),
        "chi2": {**costs, "freedom": 2 * len(data.pixels) - charts.size},
    }
