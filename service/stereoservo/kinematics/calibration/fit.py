"""Self-calibration, from trial data to a model: separate joints, linked joints, rigid bundle, metric bundle (5.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.geometry.cameras import pixel_normaliser
from stereoservo.geometry.displacements import exp_generator
from stereoservo.geometry.errors import GeometryError
from stereoservo.kinematics.calibration import upgrade
from stereoservo.kinematics.calibration.bundle import Measurements, Rig, Solution, residuals, solve
from stereoservo.kinematics.calibration.report import (
    CalibrationResult,
    build_result,
    degrees_of_freedom,
    rank_of,
    variance_factor,
)
from stereoservo.kinematics.calibration.separate import MIN_MARKERS, JointTrial, measurements, separate_joint
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData, check_trials
from stereoservo.kinematics.calibration.views import first_views
from stereoservo.kinematics.model import Stratum

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class FitOptions:
    """Thresholds of the fit.

    ``outlier_chi2``: a pixel (2 degrees of freedom) farther than this from the model is left out; 25 loses 4 in a
    million good ones. ``max_outliers``: share of pixels that may be left out. ``max_sigma_factor``: how many times
    the stated sigmas the residuals may be before the fit is refused; detectors misjudge their noise, a wrong model
    misses by far more. ``metric_loss``: how much worse, in variance, the metric bundle may fit than the projective one.
    ``metric_focal``: largest relative standard deviation of a focal length with which the metric is believed.
    """

    outlier_chi2: float = 25.0
    max_outliers: float = 0.3
    max_sigma_factor: float = 3.0
    metric_loss: float = 1.3
    metric_focal: float = 0.1


DEFAULTS = FitOptions()

MIN_SIGHTINGS = 2
"""Stops of joint trials at which two cameras must see a marker for it to enter the model."""


def fit_model(
    trials: TrialData,
    *,
    epoch: int,
    created: str = "",
    progress: Progress | None = None,
    options: FitOptions = DEFAULTS,
) -> CalibrationResult:
    """Fit a cell's model to its trial motions.

    ``progress(stage, fraction)`` is called as the work goes on. Raises CalibrationError with the cause where the data
    do not give a model that fits them; never returns a model that does not.
    """
    tell = progress or _silent
    check_trials(trials)
    tell("cameras", 0.0)
    cameras, points, usable = first_views(trials)
    trials, points, usable, left_out = _without_rare_markers(trials, points, usable)
    separate = []
    for j, name in enumerate(trials.joint_names):
        tell(f"joint {name}", 0.1 + 0.4 * j / len(trials.joint_names))
        separate.append(separate_joint(trials, cameras, points, usable, j))
    tell("linked joints", 0.5)
    zero = np.median(trials.positions, axis=0)
    rig = linked_rig(trials, cameras, separate, zero)
    every = measurements(trials, trials.visible, trials.positions - zero)
    clean = every.select(usable[every.camera, every.stop, every.marker])
    linked = solve(rig, clean, "projective", cameras=False, loss="soft_l1", loss_scale=2.0, rounds=1, tolerance=1e-4)
    tell("rigid bundle", 0.6)
    robust = solve(linked.rig, clean, "projective", loss="soft_l1", loss_scale=2.0, rounds=1, tolerance=1e-4)
    solution, inliers = settled(robust.rig, every, "projective", options)
    _refuse_misfit(trials, solution, every.select(inliers), inliers, options)
    tell("metric bundle", 0.8)
    final, plane, notes = upgraded(solution, every.select(inliers), options)
    if final is not solution:
        final, inliers = settled(final.rig, every, final.stratum, options)
        _refuse_misfit(trials, final, every.select(inliers), inliers, options)
    tell("report", 0.95)
    result = build_result(
        trials,
        final,
        every,
        inliers,
        zero,
        plane,
        pixel_normaliser(trials.cameras[0].width, trials.cameras[0].height),
        epoch=epoch,
        created=created,
        notes=notes,
        projective=(solution.cost, degrees_of_freedom(solution)),
        markers_left_out=left_out,
    )
    tell("done", 1.0)
    return result


def _silent(stage: str, fraction: float) -> None:
    return


def _without_rare_markers(
    trials: TrialData, points: FloatArray, usable: BoolArray
) -> tuple[TrialData, FloatArray, BoolArray, tuple[int, ...]]:
    """Leave out markers that two cameras see at fewer than two stops of joint trials. Raises CalibrationError."""
    often = np.isfinite(points[trials.trials >= 0]).all(axis=2).sum(axis=0) >= MIN_SIGHTINGS
    if int(often.sum()) < MIN_MARKERS:
        raise CalibrationError(
            "too_few_markers",
            f"two cameras see {int(often.sum())} markers at {MIN_SIGHTINGS} stops or more; at least {MIN_MARKERS} are needed",
            markers=int(often.sum()),
            minimum=MIN_MARKERS,
        )
    left_out = tuple(i for i, keep in zip(trials.marker_ids, often, strict=True) if not keep)
    kept = msgspec.structs.replace(
        trials,
        marker_ids=tuple(i for i, keep in zip(trials.marker_ids, often, strict=True) if keep),
        pixels=trials.pixels[:, :, often],
        sigmas=trials.sigmas[:, :, often],
    )
    return kept, points[:, often], usable[:, :, often], left_out


def linked_rig(trials: TrialData, cameras: FloatArray, separate: list[JointTrial], zero: FloatArray) -> Rig:
    """Operators brought from their trials' bases to one zero (5.21), base to tip, with one marker structure (5.53).

    Raises CalibrationError (``too_few_markers``) for a marker that no trial shows.
    """
    kinds = trials.joint_kinds
    generators = np.zeros((len(kinds), 4, 4))
    for j, trial in enumerate(separate):
        moved = _chain(kinds[:j], generators[:j], trial.base[:j] - zero[:j])
        generators[j] = np.linalg.inv(moved) @ trial.generator @ moved
    # Every trial has seen the markers in its own base configuration; take them all to the zero.
    clouds = np.array(
        [trial.points @ np.linalg.inv(_chain(kinds, generators, trial.base - zero)).T for trial in separate]
    )
    clouds /= clouds[:, :, 2:3]
    points = np.empty((len(trials.marker_ids), 4))
    for i, marker in enumerate(trials.marker_ids):
        seen = clouds[np.isfinite(clouds[:, i]).all(axis=1), i]
        if not len(seen):
            raise CalibrationError(
                "too_few_markers", f"marker {marker} is shown by no joint's usable stops", marker=marker
            )
        points[i] = np.median(seen, axis=0)
    return Rig(kinds, generators, cameras, points)


def _chain(kinds: tuple[str, ...], generators: FloatArray, offsets: FloatArray) -> FloatArray:
    product = np.eye(4)
    for kind, generator, offset in zip(kinds, generators, offsets, strict=True):
        product = product @ exp_generator(kind, generator, offset)
    return product


def settled(rig: Rig, every: Measurements, stratum: Stratum, options: FitOptions) -> tuple[Solution, BoolArray]:
    """Plain least squares on the pixels that fit: gate, solve, gate again until the set stays.

    Raises CalibrationError (``no_convergence``).
    """
    inliers = gate(rig, every, options)
    for _ in range(8):
        solution = solve(rig, every.select(inliers), stratum)
        again = gate(solution.rig, every, options)
        rig = solution.rig
        if np.array_equal(again, inliers):
            break
        inliers = again
    else:
        raise CalibrationError(
            "no_convergence",
            f"the set of outliers does not settle: {int((~inliers).sum())} of {len(inliers)} pixels in the last round",
            outliers=int((~inliers).sum()),
        )
    if not solution.converged:
        raise CalibrationError(
            "no_convergence",
            f"the {stratum} bundle did not converge in {solution.evaluations} evaluations; residual "
            f"{np.sqrt(solution.cost / max(1, len(solution.residuals))):.3g} sigmas",
            stratum=stratum,
            evaluations=solution.evaluations,
        )
    return solution, inliers


def gate(rig: Rig, every: Measurements, options: FitOptions) -> BoolArray:
    """Which pixels (k,) fit the rig, by their own squared distance, with the noise estimated from the median."""
    squares = (residuals(rig, every).reshape(-1, 2) ** 2).sum(axis=1)
    # The median of a chi-square with two degrees of freedom is ln 4.
    factor = max(1.0, float(np.median(squares)) / np.log(4.0))
    inside: BoolArray = squares <= options.outlier_chi2 * factor
    return inside


def upgraded(
    solution: Solution, data: Measurements, options: FitOptions
) -> tuple[Solution, FloatArray, tuple[str, ...]]:
    """The highest stratum that the data identify, its plane at infinity in the projective frame (4,), and notes."""
    noise = generator_noise(solution)
    plane, unique = upgrade.plane_at_infinity(solution.rig.generators, noise)
    scaled = upgrade.scaled_plane(plane, solution.rig.points)
    if scaled is None:
        raise CalibrationError(
            "views_degenerate",
            "the plane that the joints leave fixed passes between the markers: no consistent side of infinity",
            plane=plane.tolist(),
        )
    if not unique:
        return solution, scaled, ("the plane at infinity is not identifiable: all axes are parallel",)
    try:
        start, _ = upgrade.affine_rig(solution.rig, scaled)
    except GeometryError as error:
        return solution, scaled, (f"no affine stratum: {error}",)
    limit = options.metric_loss * max(1.0, variance_factor(solution))
    notes: tuple[str, ...] = ()
    revolute = np.array([kind == "revolute" for kind in solution.rig.kinds])
    omega = upgrade.image_of_absolute_conic(start.generators, revolute, noise)
    if omega is None:
        notes = ("the intrinsics are not identifiable: fewer than two directions of rotation stand above the noise",)
    else:
        metric = solve(upgrade.metric_rig(start, upgrade.triangular_root(omega)), data, "metric", rounds=4)
        problem = _distrust(metric, limit, options)
        if not problem:
            return metric, scaled, ()
        notes = (f"metric stratum refused: {problem}",)
    affine = solve(start, data, "affine", rounds=4)
    problem = _distrust(affine, limit, options)
    if problem:
        return solution, scaled, (*notes, f"affine stratum refused: {problem}")
    return affine, scaled, notes


def _distrust(solution: Solution, limit: float, options: FitOptions) -> str:
    """Why a solution of a higher stratum must not be taken; empty where it may."""
    if not solution.converged:
        return f"no convergence in {solution.evaluations} evaluations"
    factor = variance_factor(solution)
    if factor > limit:
        return f"variance factor {factor:.3g}, at most {limit:.3g} allowed beside the projective bundle"
    if rank_of(solution) < solution.charts.size:
        return f"rank {rank_of(solution)} of {solution.charts.size} parameters"
    if solution.stratum == "metric":
        lengths = solution.rig.cameras[0][[0, 1], [0, 1]]
        if lengths.min() <= 0:
            return f"focal lengths {lengths.tolist()} are not positive"
        start = sum(len(basis) for basis in solution.charts.generators)
        covariance = np.linalg.inv(solution.jacobian.T @ solution.jacobian) * max(1.0, factor)
        spread = np.sqrt(covariance[[start, start + 3], [start, start + 3]]) / lengths
        if spread.max() > options.metric_focal:
            return f"focal length known to {spread.max():.0%} only, {options.metric_focal:.0%} needed"
    return ""


def generator_noise(solution: Solution) -> float:
    """Standard deviation of the generators' entries, rms over all, from the bundle's covariance."""
    scale = np.linalg.norm(solution.jacobian, axis=0)
    scale[scale == 0] = 1.0
    information = solution.jacobian.T @ solution.jacobian / np.outer(scale, scale)
    covariance = np.linalg.pinv(information, rcond=1e-13, hermitian=True) / np.outer(scale, scale)
    at, squares, entries = 0, 0.0, 0
    for generator, basis in zip(solution.rig.generators, solution.charts.generators, strict=True):
        p = len(basis)
        changes = (basis @ generator - generator @ basis).reshape(p, 16)
        squares += float(np.einsum("pa,pq,qa->", changes, covariance[at : at + p, at : at + p], changes))
        entries += 16
        at += p
    return float(np.sqrt(squares / entries * max(1.0, variance_factor(solution))))


def _refuse_misfit(
    trials: TrialData, solution: Solution, data: Measurements, inliers: BoolArray, options: FitOptions
) -> None:
    share = float((~inliers).mean())
    if share > options.max_outliers:
        raise CalibrationError(
            "too_many_outliers",
            f"{share:.0%} of the pixels do not fit the {solution.stratum} model; at most {options.max_outliers:.0%} may",
            share=share,
            maximum=options.max_outliers,
        )
    freedom = 2 * len(data.pixels) - solution.charts.size
    if freedom <= 0:
        raise CalibrationError(
            "too_few_stops",
            f"{2 * len(data.pixels)} measurements for {solution.charts.size} parameters; more stops or markers are needed",
            measurements=2 * len(data.pixels),
            parameters=solution.charts.size,
        )
    rank = rank_of(solution)
    if rank < solution.charts.size:
        raise CalibrationError(
            "not_identifiable",
            f"the trials determine {rank} of {solution.charts.size} parameters of the {solution.stratum} model; more "
            "markers, stops or larger motions are needed",
            rank=rank,
            parameters=solution.charts.size,
        )
    factor = float(np.sqrt(variance_factor(solution)))
    if factor > options.max_sigma_factor:
        squares = (solution.residuals.reshape(-1, 2) ** 2).sum(axis=1)
        of_stop = trials.trials[data.stop]
        per_joint = {
            name: float(np.sqrt(squares[of_stop == j].mean() / 2))
            for j, name in enumerate(trials.joint_names)
            if (of_stop == j).any()
        }
        worst = max(per_joint, key=lambda name: per_joint[name])
        raise CalibrationError(
            "residual_above_floor",
            f"residuals are {factor:.3g} times the stated sigmas; at most {options.max_sigma_factor:g} allowed. Worst is "
            f"joint {worst!r} ({per_joint[worst]:.3g})",
            sigma_factor=factor,
            maximum=options.max_sigma_factor,
            joints=per_joint,
        )
