"""Hypothetical changes of a calibrated cell (camera, cameras, marker body, marker, joint zero), and their
least-squares estimates from the pixels of a check motion.

A camera moved, the cameras moved together, the marker body moved, one marker slipped, the zero of a joint drifted:
each is a change of few parameters. Its estimate uses the pixels of many poses and the covariance of the model itself,
and several changes may be estimated together; `model_check` decides which of them is significant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.calibration.bundle_adjustment import jacobian
from stereoservo.calibration.joint_noise import error_columns
from stereoservo.calibration.least_squares import DenseFit, Limits, column_root, estimate_beside, minimise
from stereoservo.calibration.normal_equations import triangle_of
from stereoservo.calibration.rig_model import (
    Charts,
    Measurements,
    RigModel,
    acting_order,
    acting_rig,
    full_charts,
    own_acting_rig,
    residuals,
)
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.calibration.variance_components import noise_of_accuracy, readings
from stereoservo.kinematics.model import CellModel, ModelCovariance
from stereoservo.kinematics.parameterization import lens_model_of
from stereoservo.messages.check_report import CauseKind
from stereoservo.numerics.arrays import FloatArray

STEP = 1e-6
"""Step of the finite differences, relative to the size of the scene."""
EVALUATIONS = 60
SETTLED = 1e-3
"""Size of the last step [sigmas] at which an estimate has converged."""

State = tuple[RigModel, FloatArray]
"""A model under estimation and the drift (n,) of its joints' zeros, in the model's order."""


@dataclass(frozen=True)
class ModelChange:
    """A hypothetical change of ``size`` parameters; ``apply`` returns the changed state at given parameters (size,)."""

    kind: CauseKind
    subject: str
    size: int
    apply: Callable[[State, FloatArray], State]


@dataclass(frozen=True)
class LinearisedProblem:
    """Model and pixels of a check: ``rig`` in its Euclidean frame, if it has one, its ``data``, and ``uncertainty``
    B (2 k, p) of the covariance that the model's own uncertainty adds to the residuals (see `bounded`).
    """

    rig: RigModel
    data: Measurements
    uncertainty: FloatArray
    order: tuple[int, ...]
    """Joints in the order of the rig's factors."""

    def residuals_at(self, state: State) -> FloatArray:
        """Weighted residuals (2 k,) of a changed model."""
        rig, drift = state
        return residuals(rig, replace(self.data, offsets=self.data.offsets + drift))

    def whitened(self, rows: FloatArray) -> FloatArray:
        """Rows whitened by the model's own uncertainty A: ``W rows`` with ``W = (I + A Aᵀ)⁻¹``; ``rows`` (2 k,) or
        (2 k, q).
        """
        found: FloatArray = rows - self.uncertainty @ (self.uncertainty.T @ rows)
        return found

    @cached_property
    def white(self) -> Callable[[FloatArray], FloatArray]:
        """Function that whitens rows by a root of that weight, `whitening`."""
        return whitening(self.uncertainty)

    def select(self, keep: npt.NDArray[np.bool_]) -> LinearisedProblem:
        """The problem with only the pixels where ``keep`` (k,) holds."""
        root = unbounded(self.uncertainty)
        return replace(self, data=self.data.select(keep), uncertainty=bounded(root[np.repeat(keep, 2)]))


def bounded(A: FloatArray) -> FloatArray:
    """Matrix ``B`` with ``(I + A Aᵀ)⁻¹ = I - B Bᵀ``: maps an uncertainty ``A`` of any size to one of norm below 1."""
    if not A.shape[1]:
        return A
    triangle = np.linalg.cholesky(np.eye(A.shape[1]) + A.T @ A)
    bound: FloatArray = np.linalg.solve(triangle, A.T).T
    return bound


def whitening(B: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Function that multiplies rows (2 k, q) by the symmetric root of ``I - B Bᵀ``, with ``B`` by :func:`bounded`."""
    values, vectors = np.linalg.eigh(B.T @ B)
    inner = (vectors / (1.0 + np.sqrt(np.maximum(1.0 - values, 0.0)))) @ vectors.T
    return lambda rows: rows - B @ (inner @ (B.T @ rows))


def unbounded(B: FloatArray) -> FloatArray:
    """Inverse of :func:`bounded`, up to a rotation: ``A Aᵀ = B (I - Bᵀ B)⁻¹ Bᵀ``."""
    if not B.shape[1]:
        return B
    triangle = np.linalg.cholesky(np.eye(B.shape[1]) - B.T @ B)
    root: FloatArray = np.linalg.solve(triangle, B.T).T
    return root


def known_measurements(model: CellModel, trials: TrialData, order: tuple[int, ...]) -> Measurements:
    """Pixels of those markers and cameras that are part of the model.

    Raises CalibrationError (``bad_data``) if joints or cameras are not the model's.
    """
    of_model = [camera.name for camera in model.cameras]
    if trials.joint_names != model.joint_names or [camera.name for camera in trials.cameras] != of_model:
        raise CalibrationError(
            "bad_data",
            f"the check is of joints {', '.join(trials.joint_names)} and cameras "
            f"{', '.join(camera.name for camera in trials.cameras)}; the model has {', '.join(model.joint_names)} "
            f"and {', '.join(of_model)}",
        )
    known = np.array([marker in model.marker_ids for marker in trials.marker_ids], dtype=bool)
    camera, stop, marker = np.nonzero(trials.visible & known)
    index = np.array([model.marker_ids.index(i) if i in model.marker_ids else -1 for i in trials.marker_ids])
    return Measurements(
        (trials.positions - model.zero)[:, list(order)],
        camera,
        stop,
        index[marker],
        trials.pixels[camera, stop, marker],
        trials.sigmas[camera, stop, marker],
    )


def linearised_problem(
    model: CellModel, check: TrialData, made_from: TrialData | None, noise_factor: float
) -> LinearisedProblem:
    """The problem of a check; ``noise_factor`` >= 1 multiplies every sigma.

    The model's uncertainty is its own covariance; without one it is computed from the trials of its calibration,
    ``made_from``; without those the model is assumed exact.
    """
    rig, order = acting_rig(model), acting_order(model)
    data = known_measurements(model, check, order)
    data = replace(data, sigmas=data.sigmas * noise_factor)
    if model.covariance is not None:
        uncertainty = _stated_uncertainty(model, model.covariance, data, order)
    elif made_from is not None:
        past = known_measurements(model, made_from, order)
        uncertainty = _curvature_uncertainty(model, rig, replace(past, sigmas=past.sigmas * noise_factor), data)
    else:
        uncertainty = np.zeros((2 * len(data.camera), 0))
    return LinearisedProblem(rig, data, bounded(uncertainty), order)


def with_corrected_zeros(problem: LinearisedProblem, model: CellModel, drift: FloatArray) -> LinearisedProblem:
    """The problem with the joints' readings corrected by ``drift`` (n,), in the rig's order."""
    data = replace(problem.data, offsets=problem.data.offsets + drift)
    if model.covariance is None:
        return replace(problem, data=data)
    return replace(
        problem,
        data=data,
        uncertainty=bounded(_stated_uncertainty(model, model.covariance, data, problem.order)),
    )


def _stated_uncertainty(
    model: CellModel, stated: ModelCovariance, data: Measurements, order: tuple[int, ...]
) -> FloatArray:
    """Root (2 k, p) of the covariance [sigmas²] of the pixels of ``data`` due to the model's stated covariance, and to
    the errors of its joints' readings.
    """
    slopes, columns = covariance_jacobian(model, stated, data)
    values, vectors = np.linalg.eigh(stated.covariance[np.ix_(columns, columns)])
    root: FloatArray = slopes @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return np.hstack([root, joint_uncertainty(model, data, order)])


def joint_uncertainty(model: CellModel, data: Measurements, order: tuple[int, ...]) -> FloatArray:
    """Root (2 k, e) of the covariance [sigmas²] of the pixels of ``data`` due to the errors of the joints' readings
    that the model states, at stops outside its trials; e = 0 if it states none.
    """
    accuracy = model.joint_accuracy
    if accuracy is None:
        return np.zeros((2 * len(data.camera), 0))
    unseen = msgspec.structs.replace(
        accuracy, random=np.sqrt(np.maximum(accuracy.stated**2 - accuracy.repeatable**2, accuracy.random**2))
    )
    noise = noise_of_accuracy(unseen.in_order(np.array(order)), readings(data.offsets))
    return error_columns(acting_rig(model), data.with_joint_noise(noise))


def covariance_charts(model: CellModel, stated: ModelCovariance) -> tuple[RigModel, Charts, npt.NDArray[np.int64]]:
    """The model as a rig in its own frame, joints in `acting_order`, the charts of its covariance there, and the index
    (p,) in the covariance of each parameter of the charts.
    """
    order = acting_order(model)
    charts = Charts(tuple(stated.generators[j] for j in order), stated.cameras, stated.lenses, stated.markers)
    sizes = [len(basis) for basis in stated.generators]
    starts = np.cumsum([0, *sizes])
    columns = np.concatenate([np.arange(starts[j], starts[j + 1]) for j in order])
    return own_acting_rig(model), charts, np.append(columns, np.arange(starts[-1], charts.size))


def covariance_jacobian(
    model: CellModel, stated: ModelCovariance, data: Measurements
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Derivative (2 k, p) of the residuals by the parameters of the model's covariance, and the parameter index (p,) of
    each column.
    """
    rig, charts, columns = covariance_charts(model, stated)
    return jacobian(rig, charts, np.zeros(charts.size), data), columns


def _curvature_uncertainty(model: CellModel, rig: RigModel, past: Measurements, data: Measurements) -> FloatArray:
    """Like `_stated_uncertainty`, from the curvature of the calibration's own least squares at the model."""
    charts = full_charts(rig, model.stratum, lenses=lens_model_of(rig.lenses))
    triangle = triangle_of(rig, charts, past)[:-1, :-1]
    slopes = jacobian(rig, charts, np.zeros(charts.size), data)
    return np.asarray(slopes @ column_root(triangle, bounded=True))


# -- the hypotheses -----------------------------------------------------------------------------------------


def possible_changes(model: CellModel, problem: LinearisedProblem) -> list[ModelChange]:
    """All changes to test: rigid motions in a Euclidean frame, else free camera matrices."""
    rig = problem.rig
    metric = model.stratum == "metric"
    found: list[ModelChange] = []
    for c, camera in enumerate(model.cameras):
        found.append(ModelChange("camera", camera.name, 6 if metric else 11, _camera(rig, (c,), metric)))
    if metric:
        if len(model.cameras) > 1:
            found.append(ModelChange("cameras", "", 6, _camera(rig, tuple(range(len(model.cameras))), True)))
        found.append(ModelChange("body", "", 6, _body(rig)))
    seen = set(problem.data.marker.tolist())
    found += [ModelChange("marker", str(i), 3, _marker(k)) for k, i in enumerate(model.marker_ids) if k in seen]
    found += [ModelChange("joint", model.joint_names[j], 1, _joint(k)) for k, j in enumerate(problem.order)]
    return found


def rigid_motion(x: FloatArray, centre: FloatArray, scale: float) -> FloatArray:
    """Rigid motion (4, 4): rotation by ``x[:3]`` [rad] about ``centre`` (3,), then translation by ``scale x[3:]``."""
    angle = float(np.linalg.norm(x[:3]))
    K = np.array([(0.0, -x[2], x[1]), (x[2], 0.0, -x[0]), (-x[1], x[0], 0.0)])
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    R = np.eye(3) + a * K + b * (K @ K)
    motion = np.eye(4)
    motion[:3, :3] = R
    motion[:3, 3] = centre - R @ centre + scale * x[3:]
    return motion


def _scene(rig: RigModel) -> tuple[FloatArray, float]:
    centroid = rig.points[:, :3].mean(axis=0)
    return centroid, float(np.linalg.norm(centroid)) or 1.0


def _camera(rig: RigModel, which: tuple[int, ...], metric: bool) -> Callable[[State, FloatArray], State]:
    centroid, scale = _scene(rig)
    bases = {}
    for c in which:
        matrix = rig.cameras[c].ravel() / np.linalg.norm(rig.cameras[c])
        bases[c] = np.linalg.svd(matrix[None])[2][1:].reshape(11, 3, 4) * np.linalg.norm(rig.cameras[c])

    def apply(state: State, x: FloatArray) -> State:
        cameras = state[0].cameras.copy()
        for c in which:
            if metric:
                cameras[c] = cameras[c] @ rigid_motion(x, centroid, scale)
            else:
                cameras[c] = cameras[c] + np.einsum("p,pij->ij", x, bases[c])
        return replace(state[0], cameras=cameras), state[1]

    return apply


def _body(rig: RigModel) -> Callable[[State, FloatArray], State]:
    centroid, scale = _scene(rig)

    def apply(state: State, x: FloatArray) -> State:
        return replace(state[0], points=state[0].points @ rigid_motion(x, centroid, scale).T), state[1]

    return apply


def _marker(k: int) -> Callable[[State, FloatArray], State]:
    def apply(state: State, x: FloatArray) -> State:
        points = state[0].points.copy()
        size = float(np.linalg.norm(points[k, :3])) or 1.0
        points[k, :3] += size * x
        return replace(state[0], points=points), state[1]

    return apply


def _joint(k: int) -> Callable[[State, FloatArray], State]:
    def apply(state: State, x: FloatArray) -> State:
        drift = state[1].copy()
        drift[k] += x[0]
        return state[0], drift

    return apply


# -- estimates ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChangeEstimate:
    """Changes estimated together: ``x`` (q,), its ``information`` (q, q), the remaining ``chi2``, and the change of the
    pixels by each cause alone, ``effects_px`` (rms over all pixels of the check).
    """

    changes: tuple[ModelChange, ...]
    x: FloatArray
    information: FloatArray
    chi2: float
    left: FloatArray
    effects_px: tuple[float, ...]

    @property
    def covariance(self) -> FloatArray:
        """Covariance (q, q); zero for directions that the pixels leave undetermined."""
        return np.asarray(np.linalg.pinv(self.information))


def start_state(problem: LinearisedProblem) -> State:
    """The state of the unchanged model."""
    return problem.rig, np.zeros(len(problem.order))


def changed_state(problem: LinearisedProblem, found: tuple[ModelChange, ...], x: FloatArray) -> State:
    """The state of a model with changes ``found`` at parameters ``x`` (q,)."""
    state, at = start_state(problem), 0
    for cause in found:
        state = cause.apply(state, x[at : at + cause.size])
        at += cause.size
    return state


def change_jacobian(
    problem: LinearisedProblem, found: tuple[ModelChange, ...], x: FloatArray, here: FloatArray
) -> FloatArray:
    """Derivative (2 k, q) of the residuals by the changes' parameters, by finite differences."""
    columns = []
    for i in range(x.size):
        step = np.zeros(x.size)
        step[i] = STEP
        columns.append((problem.residuals_at(changed_state(problem, found, x + step)) - here) / STEP)
    return np.array(columns).T.reshape(here.size, x.size)


def first_order_gain(problem: LinearisedProblem, cause: ModelChange, here: FloatArray) -> float:
    """Reduction of chi-square by one change, to first order."""
    slopes = change_jacobian(problem, (cause,), np.zeros(cause.size), here)
    return estimate_beside(problem.white(np.column_stack([slopes, here]))).gain


def estimate_changes(
    problem: LinearisedProblem, found: tuple[ModelChange, ...], start: FloatArray | None = None
) -> ChangeEstimate:
    """Least-squares estimate of changes from ``start`` (q,), default no change, with the model's
    own uncertainty in the weights.
    """

    def seen(x: FloatArray) -> FloatArray:
        return problem.residuals_at(changed_state(problem, found, x))

    fit = DenseFit[FloatArray](
        lambda x: problem.white(seen(x))[:, None],
        lambda x: problem.white(change_jacobian(problem, found, x, seen(x)))[:, None],
        np.add,
    )
    x = np.zeros(sum(cause.size for cause in found)) if start is None else start
    end = minimise(fit, x, Limits(EVALUATIONS, 0.0, SETTLED**2))
    x = end.state
    before = problem.residuals_at(start_state(problem))
    effects, at = [], 0
    for cause in found:
        alone = problem.residuals_at(cause.apply(start_state(problem), x[at : at + cause.size]))
        change = (alone - before).reshape(-1, 2) * problem.data.sigmas[:, None]
        effects.append(float(np.sqrt((change**2).mean())))
        at += cause.size
    rows = fit.rows(x)[:, :-1]
    return ChangeEstimate(found, x, rows.T @ rows, end.cost, seen(x), tuple(effects))
