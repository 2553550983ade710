"""Reset of joint zeros: a new model in which the zeros of drifted joints are moved by the drifts that a check
estimated.

Nothing else of the model changes. Its covariance is extended by that of the drifts and their correlation with the
errors of the model.
"""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.calibration.change.model_changes import (
    ChangeEstimate,
    LinearisedProblem,
    change_jacobian,
    changed_state,
    covariance_jacobian,
    estimate_changes,
    with_corrected_zeros,
)
from stereoservo.calibration.change.model_check import ModelExamination
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.joint_angles import LARGEST_DEVIATION
from stereoservo.kinematics.model import CellModel, ModelCovariance
from stereoservo.messages.check_report import CheckReport, JointReset, ZeroReset
from stereoservo.numerics.arrays import FloatArray

DISTINGUISHABLE = 25.0
"""Chi-square by which another joint must explain the check worse than the one that is reset."""


def reset_zeros(
    examined: ModelExamination, report: CheckReport, *, epoch: int, created: str = ""
) -> tuple[CellModel, ZeroReset]:
    """New model of epoch ``epoch`` with the zeros of drifted joints moved, and what was moved.

    Raises CalibrationError: ``check_holds`` where nothing drifted, ``other_cause`` where anything but joint zeros
    changed, ``not_observable`` with the ``joints`` that the check does not distinguish or not determine well enough.
    """
    _must_be_zeros(report)
    model, found = examined.model, examined.explanation
    # Again at the true joint positions: far zeros change what the model's own uncertainty does to the pixels.
    problem = with_corrected_zeros(
        examined.problem, model, changed_state(examined.problem, found.changes, found.x)[1]
    )
    rest = estimate_changes(problem, found.changes)
    drift = found.x + rest.x
    at = [model.joint_names.index(cause.subject) for cause in found.changes]
    covariance: FloatArray = np.asarray(np.linalg.pinv(rest.information), dtype=np.float64)
    deviations = np.sqrt(np.diag(covariance))
    _must_be_observable(examined, deviations)
    zero = model.zero.copy()
    zero[at] -= drift
    joints = tuple(
        JointReset(
            model.joint_names[j],
            model.joint_kinds[j],
            float(x),
            float(s),
            float(model.zero[j]),
            float(zero[j]),
        )
        for j, x, s in zip(at, drift, deviations, strict=True)
    )
    stated = model.covariance
    told = ", ".join(f"{joint.joint} {_amount(joint)}" for joint in joints)
    source = f"{model.source or 'model'} (epoch {model.epoch}); zeros reset by a check"
    source += f" at {report.created}" if report.created else ""
    source += f": {told}" + (
        "" if stated is not None else "; their uncertainty is not carried, the model had no covariance"
    )
    after = float(np.sqrt(rest.chi2 / max(1, report.measurements - drift.size)))
    reset = ZeroReset(
        epoch, model.epoch, joints, report.sigmas, after,
        f"zeros reset in model epoch {epoch}: {told}; residuals {report.sigmas:.3g} times the expected noise before, "
        f"{after:.3g} times after. Teach the goals of epoch {model.epoch} again",
    )  # fmt: skip
    return msgspec.structs.replace(
        model, epoch=epoch, created=created, source=source, zero=zero, refined_from=0, in_place_of=0,
        covariance=None if stated is None else _with_zeros(model, stated, problem, rest, covariance),
    ), reset  # fmt: skip


def _must_be_zeros(report: CheckReport) -> None:
    if report.status == "holds" or not report.causes:
        raise CalibrationError("check_holds", f"no joint zero is to be reset: {report.message}")
    others = [cause.message for cause in report.causes if cause.kind != "joint"]
    if others:
        raise CalibrationError(
            "other_cause",
            f"a reset of joint zeros does not cure this: {'; '.join(others)}. Remove the cause, or calibrate anew",
            causes=others,
        )


def _must_be_observable(examined: ModelExamination, deviations: FloatArray) -> None:
    found, problem = examined.explanation, examined.problem
    poor = [c.subject for c, s in zip(found.changes, deviations, strict=True) if s > LARGEST_DEVIATION]
    if poor:
        raise CalibrationError(
            "not_observable",
            f"the check does not tell the zero of {', '.join(poor)}: standard deviation above {LARGEST_DEVIATION:g} "
            "rad or m. Markers farther from its axis, or another base, are needed",
            joints=poor,
        )
    noise = max(1.0, found.chi2 / max(1, 2 * len(problem.data.camera) - found.x.size))
    idle = [cause for cause in examined.hypotheses if cause.kind == "joint" and cause not in found.changes]
    for i, cause in enumerate(found.changes):
        for other in idle:
            swapped = (*found.changes[:i], other, *found.changes[i + 1 :])
            if estimate_changes(problem, swapped).chi2 - found.chi2 < DISTINGUISHABLE * noise:
                raise CalibrationError(
                    "not_observable",
                    f"the check does not tell a drift of {cause.subject} from one of {other.subject}: at these stops "
                    "both move the markers alike. Take a base where their axes are different lines, or calibrate anew",
                    joints=[cause.subject, other.subject],
                )


def _amount(joint: JointReset) -> str:
    if joint.kind == "revolute":
        return f"by {np.degrees(joint.drift):+.4g}° ± {np.degrees(joint.deviation):.2g}°"
    return f"by {joint.drift:+.5g} m ± {joint.deviation:.2g} m"


def _with_zeros(
    model: CellModel,
    stated: ModelCovariance,
    problem: LinearisedProblem,
    found: ChangeEstimate,
    own: FloatArray,
) -> ModelCovariance:
    """The model's covariance with that of its moved zeros, ``own`` (z, z), and between both.

    A zero that is off by ``e`` moves what its joint carries by ``exp(e Ĥ)``: the generators of the joints behind it
    in the chain and the markers, all with the same ``e``. The rest of what the check estimates is not used.
    """
    at = [model.joint_names.index(cause.subject) for cause in found.changes]
    order = list(problem.order)
    here = problem.residuals_at(changed_state(problem, found.changes, found.x))
    weighted = problem.whitened(change_jacobian(problem, found.changes, found.x, here))
    slopes, columns = covariance_jacobian(model, stated, problem.data)
    sway = np.empty((len(at), len(stated.covariance)))
    sway[:, columns] = -own @ (weighted.T @ slopes)
    across = sway @ stated.covariance

    rows: list[FloatArray] = []
    p, z = len(stated.covariance), len(at)
    start = 0

    def widened(basis: FloatArray, more: list[tuple[int, FloatArray]]) -> FloatArray:
        nonlocal start
        for i in range(start, start + len(basis)):
            rows.append(np.eye(p + z)[i])
        start += len(basis)
        for k, _ in more:
            rows.append(np.eye(p + z)[p + k])
        return np.concatenate([basis, np.array([d for _, d in more]).reshape(-1, *basis.shape[1:])])

    def before(j: int) -> list[int]:
        return [k for k, moved in enumerate(at) if order.index(moved) < order.index(j)]

    generators = tuple(
        widened(basis, [(k, model.generators[at[k]]) for k in before(j)])
        for j, basis in enumerate(stated.generators)
    )
    cameras = tuple(widened(basis, []) for basis in stated.cameras)
    lenses = tuple(widened(basis, []) for basis in stated.lenses)
    markers = tuple(
        widened(basis, [(k, model.generators[j] @ point) for k, j in enumerate(at)])
        for basis, point in zip(stated.markers, model.marker_points, strict=True)
    )
    jacobian = np.array(rows)
    whole = np.block([[stated.covariance, across.T], [across, own]])
    return ModelCovariance(generators, cameras, lenses, markers, jacobian @ whole @ jacobian.T)
