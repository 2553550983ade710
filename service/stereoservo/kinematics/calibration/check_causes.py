"""What may have changed since a cell was calibrated, as changes of its model: hypotheses of the drift check.

A camera moved, the cameras moved together, the marker body moved, one marker slipped, the zero of a joint drifted:
each is a change of few parameters whose pixels are predicted, and estimated, without a new fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.calibration.bundle import (
    Charts,
    Measurements,
    Rig,
    full_charts,
    jacobian,
    residuals,
)
from stereoservo.kinematics.calibration.check_report import CauseKind
from stereoservo.kinematics.calibration.model_rig import acting_order, acting_rig
from stereoservo.kinematics.calibration.normal_equations import triangle_of
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData
from stereoservo.kinematics.model import CellModel, ModelCovariance

FloatArray = npt.NDArray[np.float64]
STEP = 1e-6
"""Of the finite differences, relative to the size of the scene."""
ROUNDS = 10
SETTLED = 1e-3
"""Last step [sigmas] at which an estimate has converged."""

State = tuple[Rig, FloatArray]
"""A rig and the drift (n,) of its joints' zeros, in the rig's order."""


@dataclass(frozen=True)
class Cause:
    """One hypothesis: ``size`` parameters, which ``apply`` puts into a state."""

    kind: CauseKind
    subject: str
    size: int
    apply: Callable[[State, FloatArray], State]


@dataclass(frozen=True)
class Bench:
    """A model before the pixels of a check: ``rig`` in its Euclidean frame where it has one, ``data``, and ``loose``
    (2 k, p), which tells the covariance that the model's own uncertainty adds to the residuals: see ``_bound``.
    """

    rig: Rig
    data: Measurements
    loose: FloatArray
    order: tuple[int, ...]
    """Joints in the order of the rig's factors."""

    def residuals_at(self, state: State) -> FloatArray:
        """Weighted residuals (2 k,) of a changed model."""
        rig, drift = state
        return residuals(rig, replace(self.data, offsets=self.data.offsets + drift))

    def whitened(self, rows: FloatArray) -> FloatArray:
        """``W rows`` with ``W = (I + A Aᵀ)⁻¹``, ``A`` the model's own uncertainty; ``rows`` (2 k,) or (2 k, q)."""
        found: FloatArray = rows - self.loose @ (self.loose.T @ rows)
        return found

    def select(self, keep: npt.NDArray[np.bool_]) -> Bench:
        """The bench without some of the pixels (k,)."""
        root = _unbound(self.loose)
        return replace(self, data=self.data.select(keep), loose=_bound(root[np.repeat(keep, 2)]))


def _bound(A: FloatArray) -> FloatArray:
    """``B`` with ``(I + A Aᵀ)⁻¹ = I - B Bᵀ``."""
    if not A.shape[1]:
        return A
    triangle = np.linalg.cholesky(np.eye(A.shape[1]) + A.T @ A)
    bound: FloatArray = np.linalg.solve(triangle, A.T).T
    return bound


def _unbound(B: FloatArray) -> FloatArray:
    """Inverse of :func:`_bound`, up to a rotation: ``A Aᵀ = B (I - Bᵀ B)⁻¹ Bᵀ``."""
    if not B.shape[1]:
        return B
    triangle = np.linalg.cholesky(np.eye(B.shape[1]) - B.T @ B)
    root: FloatArray = np.linalg.solve(triangle, B.T).T
    return root


def pixels_of(model: CellModel, trials: TrialData, order: tuple[int, ...]) -> Measurements:
    """The pixels of markers and cameras that the model knows.

    Raises CalibrationError (``bad_data``) where joints or cameras are not the model's.
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
        camera, stop, index[marker], trials.pixels[camera, stop, marker], trials.sigmas[camera, stop, marker],
    )  # fmt: skip


def make_bench(model: CellModel, check: TrialData, made_from: TrialData | None, noise_factor: float) -> Bench:
    """Model and pixels side by side. ``noise_factor`` >= 1 widens every sigma.

    How well the model is known it says itself; one that does not is taken from the trials of its calibration,
    ``made_from``, and without those as if exact.
    """
    rig, order = acting_rig(model), acting_order(model)
    data = pixels_of(model, check, order)
    data = replace(data, sigmas=data.sigmas * noise_factor)
    if model.covariance is not None:
        loose = _stated_looseness(model, model.covariance, data, order)
    elif made_from is not None:
        past = pixels_of(model, made_from, order)
        loose = _looseness(model, rig, replace(past, sigmas=past.sigmas * noise_factor), data)
    else:
        loose = np.zeros((2 * len(data.camera), 0))
    return Bench(rig, data, _bound(loose), order)


def rezeroed(bench: Bench, model: CellModel, drift: FloatArray) -> Bench:
    """The bench with the joints' readings corrected by ``drift`` (n,), in the rig's order."""
    data = replace(bench.data, offsets=bench.data.offsets + drift)
    if model.covariance is None:
        return replace(bench, data=data)
    return replace(
        bench, data=data, loose=_bound(_stated_looseness(model, model.covariance, data, bench.order))
    )


def _stated_looseness(
    model: CellModel, stated: ModelCovariance, data: Measurements, order: tuple[int, ...]
) -> FloatArray:
    """Root (2 k, p) of what the model's covariance does to the pixels of ``data`` [sigmas²]."""
    slopes, columns = stated_slopes(model, stated, data, order)
    values, vectors = np.linalg.eigh(stated.covariance[np.ix_(columns, columns)])
    root: FloatArray = slopes @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return root


def stated_slopes(
    model: CellModel, stated: ModelCovariance, data: Measurements, order: tuple[int, ...]
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Derivative (2 k, p) of the residuals by the parameters of the model's covariance, and which of them (p,) each
    column stands for.
    """
    rig = Rig(
        tuple(model.joint_kinds[j] for j in order),
        model.generators[list(order)],
        np.array([camera.matrix for camera in model.cameras]),
        model.marker_points,
        np.array([camera.lens for camera in model.cameras]),
    )
    charts = Charts(tuple(stated.generators[j] for j in order), stated.cameras, stated.lenses, stated.markers)
    sizes = [len(basis) for basis in stated.generators]
    starts = np.cumsum([0, *sizes])
    columns = np.concatenate([np.arange(starts[j], starts[j + 1]) for j in order])
    columns = np.append(columns, np.arange(starts[-1], charts.size))
    return jacobian(rig, charts, np.zeros(charts.size), data), columns


def _looseness(model: CellModel, rig: Rig, past: Measurements, data: Measurements) -> FloatArray:
    """The same from the curvature of the calibration's own least squares at the model."""
    bent = bool((rig.lenses[:, 0] != 0.0).any())
    charts = full_charts(rig, model.stratum, lenses="radial_centre" if bent else "none")
    triangle = triangle_of(rig, charts, past)[:-1, :-1]
    sizes = np.linalg.norm(triangle, axis=0)
    sizes[sizes == 0.0] = 1.0
    # A direction that the calibration left open has a large finite deviation here instead of none.
    bounded = np.linalg.qr(np.vstack([triangle / sizes, 1e-7 * np.eye(charts.size)]), mode="r")
    slopes = jacobian(rig, charts, np.zeros(charts.size), data) / sizes
    loose: FloatArray = slopes @ np.linalg.inv(np.asarray(bounded))
    return loose


# -- the hypotheses -----------------------------------------------------------------------------------------


def causes(model: CellModel, bench: Bench) -> list[Cause]:
    """Everything that is thought of. Rigid motions need a Euclidean frame; a camera may change freely without."""
    rig = bench.rig
    metric = model.stratum == "metric"
    found: list[Cause] = []
    for c, camera in enumerate(model.cameras):
        found.append(Cause("camera", camera.name, 6 if metric else 11, _camera(rig, (c,), metric)))
    if metric:
        if len(model.cameras) > 1:
            found.append(Cause("cameras", "", 6, _camera(rig, tuple(range(len(model.cameras))), True)))
        found.append(Cause("body", "", 6, _body(rig)))
    seen = set(bench.data.marker.tolist())
    found += [Cause("marker", str(i), 3, _marker(k)) for k, i in enumerate(model.marker_ids) if k in seen]
    found += [Cause("joint", model.joint_names[j], 1, _joint(k)) for k, j in enumerate(bench.order)]
    return found


def rigid(x: FloatArray, centre: FloatArray, scale: float) -> FloatArray:
    """Motion (4, 4): turned by ``x[:3]`` [rad] about ``centre`` (3,), then shifted by ``scale x[3:]``."""
    angle = float(np.linalg.norm(x[:3]))
    K = np.array([(0.0, -x[2], x[1]), (x[2], 0.0, -x[0]), (-x[1], x[0], 0.0)])
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    R = np.eye(3) + a * K + b * (K @ K)
    motion = np.eye(4)
    motion[:3, :3] = R
    motion[:3, 3] = centre - R @ centre + scale * x[3:]
    return motion


def _scene(rig: Rig) -> tuple[FloatArray, float]:
    middle = rig.points[:, :3].mean(axis=0)
    return middle, float(np.linalg.norm(middle)) or 1.0


def _camera(rig: Rig, which: tuple[int, ...], metric: bool) -> Callable[[State, FloatArray], State]:
    middle, scale = _scene(rig)
    bases = {}
    for c in which:
        matrix = rig.cameras[c].ravel() / np.linalg.norm(rig.cameras[c])
        bases[c] = np.linalg.svd(matrix[None])[2][1:].reshape(11, 3, 4) * np.linalg.norm(rig.cameras[c])

    def apply(state: State, x: FloatArray) -> State:
        cameras = state[0].cameras.copy()
        for c in which:
            if metric:
                cameras[c] = cameras[c] @ rigid(x, middle, scale)
            else:
                cameras[c] = cameras[c] + np.einsum("p,pij->ij", x, bases[c])
        return replace(state[0], cameras=cameras), state[1]

    return apply


def _body(rig: Rig) -> Callable[[State, FloatArray], State]:
    middle, scale = _scene(rig)

    def apply(state: State, x: FloatArray) -> State:
        return replace(state[0], points=state[0].points @ rigid(x, middle, scale).T), state[1]

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
class Estimate:
    """Causes estimated together: ``x`` (q,), its ``information`` (q, q), ``chi2`` that is left, and the change of the
    pixels that each cause makes alone, ``effects_px`` (rms over all pixels of the check).
    """

    found: tuple[Cause, ...]
    x: FloatArray
    information: FloatArray
    chi2: float
    left: FloatArray
    effects_px: tuple[float, ...]


def start_state(bench: Bench) -> State:
    """The model as it is."""
    return bench.rig, np.zeros(len(bench.order))


def changed(bench: Bench, found: tuple[Cause, ...], x: FloatArray) -> State:
    """The model with the causes put in."""
    state, at = start_state(bench), 0
    for cause in found:
        state = cause.apply(state, x[at : at + cause.size])
        at += cause.size
    return state


def slopes_of(bench: Bench, found: tuple[Cause, ...], x: FloatArray, here: FloatArray) -> FloatArray:
    """Derivative (2 k, q) of the residuals by the causes' parameters, by finite differences."""
    columns = []
    for i in range(x.size):
        step = np.zeros(x.size)
        step[i] = STEP
        columns.append((bench.residuals_at(changed(bench, found, x + step)) - here) / STEP)
    return np.array(columns).T.reshape(here.size, x.size)


def linear_gain(bench: Bench, cause: Cause, here: FloatArray) -> float:
    """How much of the model's chi-square a cause takes away to first order."""
    slopes = slopes_of(bench, (cause,), np.zeros(cause.size), here)
    whitened = bench.whitened(slopes)
    moment = whitened.T @ here
    information = slopes.T @ whitened
    return float(moment @ np.linalg.lstsq(information, moment, rcond=None)[0])


def estimate(bench: Bench, found: tuple[Cause, ...], start: FloatArray | None = None) -> Estimate:
    """Least squares over the parameters of the causes from ``start`` (q,) on, default nothing changed, with the model's
    own uncertainty in the weights.
    """
    x = np.zeros(sum(cause.size for cause in found)) if start is None else start
    here = bench.residuals_at(changed(bench, found, x))
    chi2 = float(here @ bench.whitened(here))
    slopes = slopes_of(bench, found, x, here)
    for _ in range(ROUNDS):
        whitened = bench.whitened(slopes)
        information = slopes.T @ whitened
        step = -np.linalg.lstsq(information, whitened.T @ here, rcond=None)[0]
        for _ in range(6):
            trial = bench.residuals_at(changed(bench, found, x + step))
            cost = float(trial @ bench.whitened(trial))
            if cost <= chi2:
                break
            step = 0.5 * step
        else:
            break
        x, here, chi2 = x + step, trial, cost
        slopes = slopes_of(bench, found, x, here)
        if float(step @ information @ step) < SETTLED**2:
            break
    before = bench.residuals_at(start_state(bench))
    effects, at = [], 0
    for cause in found:
        alone = bench.residuals_at(cause.apply(start_state(bench), x[at : at + cause.size]))
        change = (alone - before).reshape(-1, 2) * bench.data.sigmas[:, None]
        effects.append(float(np.sqrt((change**2).mean())))
        at += cause.size
    return Estimate(found, x, slopes.T @ bench.whitened(slopes), chi2, here, tuple(effects))
