"""Least squares with errors in the joint readings: rows whitened stop by stop by ``J_q S_q J_qᵀ + S_px``, normal
equations, orthogonal factor and leverages (a linear mixed model; Searle, Casella, McCulloch, 2006, ch. 7).

Errors of a single stop are eliminated within the stop; errors that stops share are columns beside the parameters. The
common error of a stop's pixels couples its markers, so that these are not eliminated one by one: rows are dense.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stereoservo.calibration.least_squares import NormalEquations, column_root, column_sizes
from stereoservo.calibration.normal_equations import (
    ArrowFactor,
    Weights,
    arrow_factor,
    by_stop,
    chunks,
    leverages,
    prior_rows,
)
from stereoservo.calibration.rig_model import Charts, JointErrors, Measurements, RigModel, partial_products
from stereoservo.geometry.distortion import distortion_jacobian, has_distortion
from stereoservo.numerics.arrays import FloatArray, IntArray


def joint_columns(rig: RigModel, data: Measurements) -> FloatArray:
    """Derivatives (2 k, n) of the weighted residuals by the positions of the joints at each measurement's stop."""
    stops, stop = np.unique(data.stop, return_inverse=True)
    before, after = partial_products(rig, data.offsets[stops])
    operators = before[:-1] @ rig.generators[:, None] @ after[:-1]
    shifts = np.einsum("jsab,mb->sjma", operators, rig.points)[stop, :, data.marker]
    world = np.einsum("sab,mb->sma", after[0], rig.points)[stop, data.marker]
    matrices = rig.cameras[data.camera]
    ray = np.einsum("kca,ka->kc", matrices, world)
    ideal = ray[:, :2] / ray[:, 2:]
    change = np.einsum("kca,kja->kjc", matrices, shifts)
    slopes = (change[:, :, :2] - ideal[:, None] * change[:, :, 2:]) / ray[:, None, 2:]
    for camera, lens in enumerate(rig.lenses):
        mine = data.camera == camera
        if has_distortion(lens):
            slopes[mine] = np.einsum("kab,kjb->kja", distortion_jacobian(lens, ideal[mine]), slopes[mine])
    slopes /= data.sigmas[:, None, None]
    return np.ascontiguousarray(slopes.transpose(0, 2, 1)).reshape(2 * len(data.camera), -1)


def error_columns(rig: RigModel, data: Measurements) -> FloatArray:
    """Derivatives (2 k, e) of the weighted residuals by all joint errors of ``data``, which has joint noise, in units
    of their standard deviations: a root of the covariance that they add to the residuals.
    """
    noise, slopes = data.joint_noise, joint_columns(rig, data)
    assert noise is not None
    stop = np.repeat(data.stop, 2)
    stops = np.unique(stop)
    own = np.where(stop[:, None, None] == stops[:, None], (slopes * noise.own[stop])[:, None], 0.0)
    common = np.zeros((len(slopes), noise.common))
    for one in stops:
        here = stop == one
        common[here] = slopes[here] @ noise.common_factors(np.array([one]))[0]
    columns = np.hstack([own.reshape(len(slopes), -1), common])
    return columns[:, columns.any(axis=0)]


class StopRows(NamedTuple):
    """Weighted rows of one stop: derivatives ``joints`` (2 k, n) by its joints' positions, ``rows`` (2 k, p + 1) by the
    parameters, with the residuals at the reported positions, to first order. ``measurements``: their indices in the
    sorted data.
    """

    stop: int
    measurements: slice
    joints: FloatArray
    rows: FloatArray


def stop_rows(rig: RigModel, charts: Charts, data: Measurements, weights: Weights | None = None) -> Iterator[StopRows]:
    """Rows of ``data``, sorted by :func:`by_stop`, one stop after the other."""
    corrections = data.corrections
    edges = [*np.flatnonzero(np.diff(data.stop, prepend=-1)).tolist(), len(data.stop)]
    first, ends = 0, iter(edges[1:])
    end = next(ends, 0)
    rows, joints = np.zeros((0, charts.size + 1)), np.zeros((0, len(rig.kinds)))
    for here, block in chunks(rig, charts, data):
        # A chunk may end within a stop, which the next one continues.
        rows = np.vstack([rows, block.dense(len(rig.points))])
        joints = np.vstack([joints, joint_columns(rig, data.select(np.arange(here.start, here.stop)))])
        while first < end <= here.stop:
            count, stop = 2 * (end - first), int(data.stop[first])
            mine, by_joint = rows[:count], joints[:count]
            rows, joints = rows[count:], joints[count:]
            if weights is not None:
                root = np.sqrt(weights(mine[:, -1] ** 2))[:, None]
                mine, by_joint = mine * root, by_joint * root
            mine[:, -1] -= by_joint @ corrections[stop]
            yield StopRows(stop, slice(first, end), by_joint, mine)
            first, end = end, next(ends, 0)


class _Whitened(NamedTuple):
    """A stop's rows (2 k, e + p + 1), by shared errors, parameters and residual, whitened of the stop's own errors;
    ``basis`` (2 k, n) of the own errors' span, ``triangle`` (n, n) their columns in it, ``projected`` (n, e + p + 1)
    the original rows in it, ``shrink`` (n, n) of the projected rows.
    """

    rows: FloatArray
    basis: FloatArray
    triangle: FloatArray
    projected: FloatArray
    shrink: FloatArray


def _whitened(one: StopRows, data: Measurements) -> _Whitened:
    noise = data.joint_noise
    assert noise is not None
    rows = np.hstack([one.joints @ noise.common_factors(np.array([one.stop]))[0], one.rows])
    basis, triangle = np.linalg.qr(one.joints * noise.own[one.stop])
    values, vectors = np.linalg.eigh(np.eye(len(triangle)) + triangle @ triangle.T)
    shrink = np.eye(len(triangle)) - (vectors / np.sqrt(values)) @ vectors.T
    projected = basis.T @ rows
    rows -= basis @ (shrink @ projected)
    return _Whitened(rows, basis, triangle, projected, shrink)


@dataclass(frozen=True)
class StopEquations:
    """Normal equations of whitened rows: ``marginal`` of the parameters, with all errors eliminated.

    Errors after a step: shared ones by ``common`` (e, e + p + 1), residuals last; those of each of the ``stops`` (k,)
    by their ``information`` (k, n, n) and ``projected`` (k, n, e + p + 1).
    """

    marginal: NormalEquations
    common: FloatArray
    stops: IntArray
    information: FloatArray
    projected: FloatArray
    data: Measurements

    @property
    def gradient(self) -> FloatArray:
        """Gradient (p + 1,) on unit columns; its last entry is the gain from changing the joint errors alone."""
        cost = self.marginal.cost
        gain = cost - float(self.marginal.core[-1, -1])
        return np.append(self.marginal.gradient, max(gain, 0.0) / max(cost, 1.0))

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """Damped step as `NormalEquations.step` (p,), followed by all joint errors after the step: those that
        stops share (e,), and each stop's own (s n,).
        """
        x, expected = self.marginal.step(damping)
        return np.concatenate([x, *self._errors(x)]), expected

    def errors(self) -> JointErrors:
        """Joint errors at a step of zero."""
        own, common = self._errors(np.zeros(len(self.marginal.sizes)))[::-1]
        return JointErrors(own.reshape(self.data.offsets.shape), common)

    def _errors(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joint errors after a step ``x`` (p,), to first order: those that stops share (e,) and their own (s n,)."""
        e = len(self.common)
        step = np.append(x, 1.0)
        common = -np.linalg.solve(self.common[:, :e], self.common[:, e:] @ step) if e else np.zeros(0)
        own = np.zeros_like(self.data.offsets)
        right = self.projected @ np.concatenate([common, step])
        own[self.stops] = -np.linalg.solve(self.information, right[:, :, None])[:, :, 0]
        return common, own.ravel()


def stop_equations(rig: RigModel, charts: Charts, data: Measurements, weights: Weights | None) -> StopEquations:
    """Normal equations of sorted ``data`` with joint noise; ``weights`` as for `normal_equations`.

    With a stop's rows ``A`` and ``U`` those of its own errors, they are ``Aᵀ A - Aᵀ U (1 + Uᵀ U)⁻¹ Uᵀ A``.
    """
    noise = data.joint_noise
    assert noise is not None
    e, p, n = noise.common, charts.size, len(rig.kinds)
    corrections, cost = data.corrections, 0.0
    inner, stops, gram, moments = np.zeros((p + 1, p + 1)), [], [], []
    for one in stop_rows(rig, charts, data, weights):
        present = one.rows[:, -1] + one.joints @ corrections[one.stop]
        cost += float(present @ present)
        inner += one.rows.T @ one.rows
        stops.append(one.stop)
        gram.append(one.joints.T @ one.joints)
        moments.append(one.joints.T @ one.rows)
    at, G = np.array(stops, dtype=np.int64), np.array(gram).reshape(-1, n, n)
    own, factors = noise.own[at], noise.common_factors(at)
    whole = np.concatenate([G @ factors, np.array(moments).reshape(-1, n, p + 1)], axis=2)
    information = np.eye(n) + own[:, :, None] * G * own[:, None, :]
    projected = own[:, :, None] * whole
    half = np.linalg.solve(np.linalg.cholesky(information), projected).reshape(-1, e + p + 1)
    matrix = -half.T @ half
    matrix[:e] += factors.reshape(len(at) * n, e).T @ whole.reshape(len(at) * n, e + p + 1)
    matrix[e:, :e] = matrix[:e, e:].T
    matrix[np.arange(e), np.arange(e)] += 1.0
    prior = prior_rows(rig, charts, data)
    matrix[e:, e:] += inner + prior.T @ prior
    cost += float((prior[:, -1] ** 2).sum()) + (0.0 if data.joint_errors is None else data.joint_errors.cost)
    sizes = np.sqrt(np.maximum(np.diag(matrix)[e:-1], 0.0))
    scale = np.append(np.where(sizes > 0.0, sizes, 1.0), 1.0)
    core = matrix[e:, e:] / np.outer(scale, scale)
    if e:
        half = np.linalg.solve(np.linalg.cholesky(matrix[:e, :e]), matrix[:e, e:] / scale)
        core -= half.T @ half
    none = np.zeros((0, 0, p + 1))
    marginal = NormalEquations(core, none, none[..., :0], scale[:-1], cost)
    return StopEquations(marginal, matrix[:e], at, information, projected, data)


def estimated_errors(rig: RigModel, charts: Charts, data: Measurements) -> JointErrors:
    """Estimated joint errors of ``data``, which has joint noise, at the parameters of ``rig``."""
    ordered, _ = by_stop(data)
    return stop_equations(rig, charts, ordered, None).errors()


@dataclass(frozen=True)
class StopFactor:
    """Orthogonal factor ``triangle`` (p + 1, p + 1) of whitened rows and residuals, columns of ``markers`` first;
    the counterpart of `ArrowFactor` for joints with noise.
    """

    triangle: FloatArray
    markers: int

    @property
    def core(self) -> FloatArray:
        """The triangle of generators, cameras, lenses and residuals with the markers eliminated."""
        return self.triangle[self.markers :, self.markers :]

    def without(self, columns: IntArray) -> StopFactor:
        """The factor without these ``columns`` of generators, cameras and lenses: they are kept fixed."""
        if not len(columns):
            return self
        kept = np.delete(self.triangle, self.markers + columns, axis=1)
        return StopFactor(np.asarray(np.linalg.qr(kept, mode="r")), self.markers)

    def dense(self) -> FloatArray:
        """The triangle, columns in the order of the charts and the residuals last."""
        order = [*range(self.markers, len(self.triangle) - 1), *range(self.markers), len(self.triangle) - 1]
        return self.triangle[:, order]


def orthogonal_factor(
    rig: RigModel, charts: Charts, data: Measurements, more: FloatArray | None = None
) -> ArrowFactor | StopFactor:
    """Orthogonal factor of the Jacobian and residuals, whitened if the joints have noise; ``more`` (2 k, e): columns
    after those of the lenses.
    """
    noise = data.joint_noise
    if noise is None:
        return arrow_factor(rig, charts, data, more)
    ordered, order = by_stop(data)
    beside = np.zeros((2 * len(order), 0)) if more is None else more
    extra = beside.reshape(len(order), 2, -1)[order].reshape(2 * len(order), -1)
    core, e, markers = charts.start(3), noise.common, charts.size - charts.start(3)
    prior = np.insert(prior_rows(rig, charts, data), [core] * extra.shape[1], 0.0, axis=1)
    width = e + charts.size + extra.shape[1] + 1
    triangle = np.zeros((e + len(prior), width))
    triangle[np.arange(e), np.arange(e)] = 1.0
    triangle[e:, e:] = prior
    pending = [triangle]
    for one in stop_rows(rig, charts, ordered):
        own = extra[2 * one.measurements.start : 2 * one.measurements.stop]
        rows = np.hstack([one.rows[:, :core], own, one.rows[:, core:]])
        pending.append(_whitened(one._replace(rows=rows), data).rows)
        if sum(len(part) for part in pending) > 8 * width:
            pending = [np.asarray(np.linalg.qr(np.vstack(pending), mode="r"))]
    # Reorder: shared errors, markers, the other parameters, residuals.
    inner = e + core + extra.shape[1]
    columns = [*range(e), *range(inner, width - 1), *range(e, inner), width - 1]
    whole = np.linalg.qr(np.vstack(pending)[:, columns], mode="r")
    square = np.zeros((width, width))
    square[: len(whole)] = whole
    return StopFactor(square[e:, e:], markers)


def prediction_leverages(
    rig: RigModel, charts: Charts, data: Measurements, factor: ArrowFactor | StopFactor
) -> FloatArray:
    """Leverage (k,) of each measurement by the parameters alone, as `leverages`; ``data`` without joint noise."""
    if isinstance(factor, ArrowFactor):
        return leverages(rig, charts, data, factor)
    ordered, order = by_stop(data)
    root = column_root(factor.dense()[:-1, :-1])
    out = np.empty(len(order))
    for here, block in chunks(rig, charts, ordered):
        rows = block.dense(len(rig.points))[:, :-1] @ root
        out[order[here]] = (rows**2).sum(axis=1).reshape(-1, 2).sum(axis=1)
    return out


def expected_squares(rig: RigModel, charts: Charts, data: Measurements) -> FloatArray:
    """Expected squared residual (k,) of each measurement [sigmas², both coordinates] after estimation of parameters and
    joint errors: the diagonal of ``V⁻¹ - V⁻¹ X (Xᵀ V⁻¹ X)⁻¹ Xᵀ V⁻¹``.
    """
    noise = data.joint_noise
    assert noise is not None
    ordered, order = by_stop(data)
    e = noise.common
    prior = prior_rows(rig, charts, data)
    start = np.zeros((e + len(prior), e + charts.size + 1))
    start[np.arange(e), np.arange(e)] = 1.0
    start[e:, e:] = prior
    stops = [(one, _whitened(one, data)) for one in stop_rows(rig, charts, ordered)]
    triangle = np.asarray(np.linalg.qr(np.vstack([start, *(white.rows for _, white in stops)]), mode="r"))
    root = column_root(triangle[:-1, :-1])
    out = np.empty(len(order))
    for one, white in stops:
        # T = I - Q (I - W) Qᵀ whitens; T T = V⁻¹.
        twice = 2.0 * white.shrink - white.shrink @ white.shrink
        own = 1.0 - ((white.basis @ twice) * white.basis).sum(axis=1)
        scaled = white.rows[:, :-1] @ root
        scaled -= white.basis @ (white.shrink @ (white.basis.T @ scaled))
        left = own - (scaled**2).sum(axis=1)
        out[order[one.measurements]] = left.reshape(-1, 2).sum(axis=1)
    return out


def exact_fit_factor(rig: RigModel, charts: Charts, data: Measurements, triangle: FloatArray) -> StopFactor:
    """Factor whose inverse square is the covariance of parameters fitted to ``data``, which has joint noise, as if its
    readings were exact; ``triangle`` (p, p): root of that fit's normal matrix.
    """
    noise, (ordered, _) = data.joint_noise, by_stop(data)
    assert noise is not None
    p = charts.size
    sizes = column_sizes(triangle)
    own, common = np.zeros((p, p)), np.zeros((p, noise.common))
    for one in stop_rows(rig, charts, ordered):
        slopes = (one.rows[:, :-1] / sizes).T @ one.joints
        moved = slopes * noise.own[one.stop]
        own += moved @ moved.T
        common += slopes @ noise.common_factors(np.array([one.stop]))[0]
    unit = triangle / sizes
    # With A = R⁻ᵀ Jᵀ Z the covariance is R⁻¹ (I + A Aᵀ) R⁻ᵀ.
    half = np.linalg.solve(unit.T, own + common @ common.T)
    inner = np.eye(p) + np.linalg.solve(unit.T, half.T)
    root = np.linalg.cholesky(0.5 * (inner + inner.T))
    whole = np.eye(p + 1)
    whole[:-1, :-1] = np.linalg.solve(root, triangle)
    return StopFactor(whole, 0)
