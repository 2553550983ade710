"""On-line refinement of a calibrated model (recursive calibration, thesis 9.3): its kinematics, cameras, lenses and
markers are estimated again from observations at the rest poses of goals, with the calibrated model and its covariance
as the prior.

The estimate is the bundle's, linearised in the directions of the model's covariance. A step is accepted only within
that covariance: a chi-square test of the pixels with named causes (`model_check`) and one of the step itself must pass
first, and the refined model must predict poses that were not used significantly better than the model in use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import norm

from stereoservo.calibration.bundle_adjustment import jacobian
from stereoservo.calibration.change.model_changes import (
    bounded,
    covariance_charts,
    joint_uncertainty,
    whitening,
)
from stereoservo.calibration.change.model_check import examine_model, make_check_report
from stereoservo.calibration.least_squares import DenseFit, Limits, minimise
from stereoservo.calibration.rig_model import (
    Measurements,
    acting_order,
    own_acting_rig,
    residuals,
    rig_at,
)
from stereoservo.calibration.static_points import with_static_points
from stereoservo.calibration.trial_data import LEAST_POSES, CalibrationError, StaticObservations, TrialData
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.covariance import (
    NoCovarianceError,
    covariance_axes,
    displaced_model,
    pixel_covariances,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.check_report import RefinementReport
from stereoservo.numerics.arrays import FloatArray

CHANCE = 0.001
"""Probability with which each test fails although nothing is wrong, or passes although nothing is better."""
FOLDS = 4
"""Number of cross-validation folds: each is held out of an estimate, which is then evaluated on it."""
LEAST_KNOWLEDGE = 0.01
"""Information of the poses on a direction, relative to the prior's, below which its step is not tested."""
EVALUATIONS = 40
SETTLED = 1e-3
"""Last step [sigmas of the prior] at which the estimate has converged."""


def refine_model(
    base: CellModel, samples: TrialData, *, used: CellModel | None = None, created: str = ""
) -> tuple[CellModel, RefinementReport]:
    """The model ``base`` refined by rest poses (trial data, of any postures), epoch 0, and the report. ``used``: the
    model in use, possibly a refinement of ``base``, which the new one must improve; default ``base``.

    Raises CalibrationError: ``too_few_stops``, ``no_covariance``; ``model_does_not_fit`` with the causes of the check
    if the poses contradict the calibrated model; ``step_too_large``; ``not_better``.
    """
    if base.covariance is None:
        raise CalibrationError(
            "no_covariance",
            f"model epoch {base.epoch} carries no covariance, which a refinement starts from: calibrate again",
        )
    poses = len(samples.positions)
    if poses < LEAST_POSES:
        raise CalibrationError(
            "too_few_stops", f"{poses} rest poses; {LEAST_POSES} are needed", stops=poses, minimum=LEAST_POSES
        )
    examined = examine_model(base, samples)
    check = make_check_report(examined)
    if check.causes:
        raise CalibrationError(
            "model_does_not_fit",
            f"not refined: the model does not fit any more: {check.message}. That is what the poses together are most "
            "like; where the cell changed while they were collected, `calibrate --check` reports what it is. Remove "
            "the cause, or calibrate again",
            causes=[cause.message for cause in check.causes],
        )
    data = examined.problem.data
    poses = len(np.unique(data.stop))
    current = base if used is None else used
    score, before, after = _cross_validated(base, current, data, samples)
    limit = float(norm.isf(CHANCE))
    if score <= limit:
        raise CalibrationError(
            "not_better",
            f"not refined: at each of {poses} rest poses, a model refined by the others "
            f"predicts the pixels to {after:.3g} px rms, the one in use to {before:.3g}: better by {score:.1f} "
            f"deviations of chance, {limit:.1f} are needed. The model in use stays",
            score=score,
            limit=limit,
        )
    whole = estimate_step(base, data)
    if whole.chi2 > whole.limit:
        raise CalibrationError(
            "step_too_large",
            f"not refined: the step away from calibrated model epoch {base.epoch} has chi-square {whole.chi2:.0f} by "
            f"that model's covariance, {whole.limit:.0f} is allowed: the model does not fit any more. Check it "
            "(`calibrate --check`), or calibrate again",
            chi2=whole.chi2,
            limit=whole.limit,
        )
    model = _refined(base, whole, created)
    report = RefinementReport(
        base.epoch, poses, before, after, score, limit, whole.chi2, whole.limit,
        _predicted(current, samples.positions), _predicted(model, samples.positions),
    )  # fmt: skip
    return msgspec.structs.replace(model, source=f"{base.source or 'model'}; {report.message}"), report


@dataclass(frozen=True)
class RefinementStep:
    """A step ``x`` (p,) of the parameters of a model's covariance, and the ``covariance`` (p, p) after it; ``chi2`` of
    the step under a valid prior, and its ``limit``.
    """

    x: FloatArray
    covariance: FloatArray
    chi2: float
    limit: float


def estimate_step(base: CellModel, data: Measurements) -> RefinementStep:
    """Maximum a posteriori estimate by ``data``, its joints in the model's acting order, with the prior of ``base``.

    In coordinates z of unit covariance, ``x = L z``: minimises ``zᵀz + rᵀ W r``, with the errors of the joints
    in the weights W. Raises NoCovarianceError.
    """
    stated = base.covariance
    if stated is None:
        raise NoCovarianceError("the model carries no covariance")
    order = acting_order(base)
    rig, charts, columns = covariance_charts(base, stated)
    axes = covariance_axes(base)
    L = axes[columns]
    white = whitening(bounded(joint_uncertainty(base, data, order)))
    q = L.shape[1]
    fit = DenseFit[FloatArray](
        lambda z: white(residuals(rig_at(rig, charts, L @ z), data))[:, None],
        lambda z: white(jacobian(rig, charts, L @ z, data) @ L)[:, None],
        np.add,
        prior=lambda z: np.column_stack([np.eye(q), z]),
    )
    z = minimise(fit, np.zeros(q), Limits(EVALUATIONS, 0.0, SETTLED**2)).state
    rows = fit.rows(z)[:-q, :-1]
    values, vectors = np.linalg.eigh(rows.T @ rows)
    values = np.maximum(values, 0.0)
    covariance = (axes @ vectors / (1.0 + values)) @ (axes @ vectors).T
    observable = values > LEAST_KNOWLEDGE
    steps = (vectors.T @ z)[observable]
    # Under a valid prior the estimate has the covariance M (I + M)⁻¹.
    chi2 = float((steps**2 * (1.0 + values[observable]) / values[observable]).sum())
    limit = float(chi2_distribution.isf(CHANCE, max(1, int(observable.sum()))))
    return RefinementStep(axes @ z, 0.5 * (covariance + covariance.T), chi2, limit)


def _squares(error: FloatArray, B: FloatArray) -> float:
    inner = B.T @ error
    return float(error @ error - inner @ inner)


def _cross_validated(
    base: CellModel, used: CellModel, data: Measurements, samples: TrialData
) -> tuple[float, float, float]:
    """Score [standard deviations] by which models refined without some poses predict these better than ``used``, and
    the rms [px] of both.

    If ``used`` were exact, ``-rᵀ W δ`` of its residuals r and the change δ of the prediction, which is independent of
    the same r, would have mean zero and variance ``δᵀ W δ``; over all folds at most twice the sum, since r of one fold
    enters δ of the others. Residual noise above the stated one reduces the score.
    """
    gain = size = before = after = 0.0
    errors: list[tuple[FloatArray, FloatArray]] = []
    for fold in range(FOLDS):
        held_out = data.stop % FOLDS == fold
        held = data.select(held_out)
        found = displaced_model(base, estimate_step(base, data.select(~held_out)).x)
        old, new = (_seen(model, held, samples) for model in (used, found))
        B = bounded(joint_uncertainty(base, held, acting_order(base)))
        change = new - old
        gain -= float(old @ change - (B.T @ old) @ (B.T @ change))
        size, before, after = size + _squares(change, B), before + _squares(old, B), after + _squares(new, B)
        errors.append((_pixels(old, held), _pixels(new, held)))
    rms = [float(np.sqrt((np.concatenate(one) ** 2).mean())) for one in zip(*errors, strict=True)]
    if size <= 0.0 or after >= before:
        return 0.0, rms[0], rms[1]
    noise = max(1.0, after / (2 * len(data.camera)))
    return float(gain / np.sqrt(2.0 * size * noise)), rms[0], rms[1]


def _pixels(error: FloatArray, data: Measurements) -> FloatArray:
    return np.asarray(error.reshape(-1, 2) * data.sigmas[:, None])


def _seen(model: CellModel, held: Measurements, samples: TrialData) -> FloatArray:
    """Residuals (2 k,) of a model at measurements of its poses."""
    offsets = (samples.positions - model.zero)[:, list(acting_order(model))]
    return residuals(own_acting_rig(model), replace(held, offsets=offsets))


def _refined(base: CellModel, step: RefinementStep, created: str) -> CellModel:
    """The model after a step, with its covariance in the same directions and static points moved with the cameras."""
    stated = base.covariance
    assert stated is not None
    model = msgspec.structs.replace(
        displaced_model(base, step.x),
        epoch=0,
        created=created,
        statistics=base.statistics,
        covariance=msgspec.structs.replace(stated, covariance=step.covariance),
        refined_from=base.epoch,
    )
    return model if not base.scene_ids else _with_scene(base, model)


def _with_scene(base: CellModel, model: CellModel) -> CellModel:
    """The refined model with static points moved to keep their images; their covariance is unchanged."""
    pixels = []
    for camera in base.cameras:
        images = base.scene_points @ camera.matrix.T
        pixels.append(distort(camera.lens, images[:, :2] / images[:, 2:]))
    static = StaticObservations(base.scene_ids, np.array(pixels), np.ones((len(pixels), len(base.scene_ids))))
    placed, _ = with_static_points(model, static)
    kept = [base.scene_ids.index(marker) for marker in placed.scene_ids]
    return msgspec.structs.replace(placed, scene_covariances=base.scene_covariances[kept])


def _predicted(model: CellModel, positions: FloatArray) -> float:
    """Root mean variance [px] of a coordinate of predicted pixels at joint ``positions`` (s, n)."""
    covariances = pixel_covariances(msgspec.structs.replace(model, joint_accuracy=None), positions)[1]
    return float(np.sqrt(0.5 * np.trace(covariances, axis1=-2, axis2=-1).mean()))
