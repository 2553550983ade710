"""What moved for good during trial motions: one camera, everything before all cameras, or not decided.

A model that was fitted to trials with such a step shares it out among all cameras: where its residuals step is no
evidence. Each camera in turn is given another pose from the step on, and the bundle is solved again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.input_corrections import solution_of
from stereoservo.calibration.least_squares import RobustLoss
from stereoservo.calibration.trial_data import CalibrationError, TrialData

LOSS = RobustLoss("soft_l1", 2.0)
"""Residual from which a pixel weighs less: stops of an onset that is found a little late, wrong pixels."""
EVALUATIONS = 60
TAIL = 1e-4
"""Probability with which chance alone says that one camera's motion does not explain the step."""
CLEARLY = 4.0
"""Times that chi-square by which everything else must explain it worse."""


def moved_part(trials: TrialData, start: Solution, stop: int) -> CalibrationError:
    """Error that says what moved between ``stop`` and the one before, from a bundle of `every_pixel`: ``camera_moved``,
    ``moved_together``, or ``camera_or_body_moved`` where the pixels do not tell.
    """
    cameras = len(trials.cameras)
    try:
        everything = _solved_with_moved(start, range(cameras), stop)
        alone = [_solved_with_moved(start, (camera,), stop) for camera in range(cameras)]
    except np.linalg.LinAlgError:
        return camera_or_body_moved(trials, stop)
    least = _robust_cost(everything)
    noise = max(1.0, least / max(1, everything.determined.freedom))
    lost = np.array([(_robust_cost(one) - least) / noise for one in alone])
    freedom = max(1, everything.charts.size - alone[0].charts.size)
    limit = float(chi2_distribution.isf(TAIL, freedom))
    first, second = np.argsort(lost)[:2]
    if lost[first] < limit and lost[second] > CLEARLY * limit:
        return camera_moved(trials, int(first), stop)
    settled = everything.converged and all(one.converged for one in alone)
    if settled and lost[first] > CLEARLY * limit:
        return moved_together(stop)
    return camera_or_body_moved(trials, stop)


def camera_moved(trials: TrialData, camera: int, stop: int) -> CalibrationError:
    """Error that a camera was moved before ``stop``."""
    name = trials.cameras[camera].name
    return CalibrationError(
        "camera_moved",
        f"camera {name!r} moved between stops {stop - 1} and {stop}: all markers jump in its images and stay off, in "
        "no other camera. Fasten it and run the trials again",
        camera=name,
        stop=stop,
    )


def moved_together(stop: int) -> CalibrationError:
    """Error that everything jumps in all cameras before ``stop``."""
    return CalibrationError(
        "moved_together",
        f"all markers jump in all cameras between stops {stop - 1} and {stop} and stay off. The images from there on "
        "are of another arm or body, or the body, the arm's base or both cameras moved, or a joint fell through its "
        "play where its load changed sides. Run all trials again: only a joint does it at the same stop again",
        stop=stop,
    )


def camera_or_body_moved(trials: TrialData, stop: int) -> CalibrationError:
    """Error that something moved before ``stop``, and that the trials do not tell what."""
    names = [camera.name for camera in trials.cameras]
    return CalibrationError(
        "camera_or_body_moved",
        f"about stop {stop} the images step and stay off. Not decided: either one camera moved "
        f"({', '.join(map(repr, names))}), or the body, the arm's base or all cameras, or a joint fell through its "
        "play where its load changed sides. Look whether each is fast and run all trials again: only a joint does it "
        "at the same stop again; markers that stand ([scene] static) would tell a camera from the rest",
        cameras=names,
        stop=stop,
    )


def every_pixel(trials: TrialData, result: CalibrationFit) -> Solution:
    """The fit's solution with all pixels of its markers, those that it left out too, without priors of its lenses."""
    solution = solution_of(trials, result)
    kept = [trials.marker_ids.index(i) for i in result.model.marker_ids]
    at = np.nonzero(trials.visible[:, :, kept])
    camera, stop, marker = at
    data = replace(
        solution.data.corrected(None),
        camera=camera,
        stop=stop,
        marker=marker,
        pixels=trials.pixels[:, :, kept][at],
        sigmas=trials.sigmas[:, :, kept][at],
        lens_priors=None,
        pinhole_ties=None,
    )
    return replace(solution, data=data)


def _solved_with_moved(start: Solution, moved: Sequence[int], stop: int) -> Solution:
    """The bundle in which the cameras ``moved`` are others from ``stop`` on. Raises LinAlgError."""
    rig, data, count = start.rig, start.data, len(start.rig.cameras)
    others = np.arange(count)
    others[list(moved)] = count + np.arange(len(moved))
    rig = replace(
        rig,
        cameras=np.concatenate([rig.cameras, rig.cameras[list(moved)]]),
        lenses=np.concatenate([rig.lenses, rig.lenses[list(moved)]]),
    )
    camera = np.where(data.stop >= stop, others[data.camera], data.camera)
    return solve(
        rig,
        replace(data, camera=camera),
        "projective",
        lenses=start.lenses,
        loss=LOSS,
        max_evaluations=EVALUATIONS,
        tolerance=1e-6,
    )


def _robust_cost(solution: Solution) -> float:
    return LOSS.cost(solution.residuals**2)
