"""Analytic Jacobian of the calibration's pixels, the normal equations by blocks for the bundle adjustment's
steps, and an orthogonal factor and the leverages of measurements for its statistics.

A pixel depends on the generators, one camera, one lens and one marker. Rows of the Jacobian are computed in chunks, so
that memory stays bounded and cost grows linearly with the images. Each marker is eliminated separately, since no pixel
depends on two: from the normal equations by blocks (Schur complement), from the factor by reflections. Cost grows
linearly with the markers, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stereoservo.calibration.least_squares import NormalEquations, column_root
from stereoservo.calibration.rig_model import (
    Charts,
    Measurements,
    PinholeTies,
    RigModel,
    partial_products,
)
from stereoservo.geometry.strata import intrinsics_and_jacobian
from stereoservo.kinematics.parameterization import LENS_PARAMETERS
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel

Weights = Callable[[FloatArray], FloatArray]

CHUNK = 1024
"""Number of measurements in a chunk, whose rows are in memory at once."""


class Motions(NamedTuple):
    """Partial products ``before`` and ``after`` each joint, and the ``basis`` (4, 4, p) of the generators' parameters;
    those of joint j start at index ``start`` (n + 1,) j.
    """

    before: FloatArray
    after: FloatArray
    basis: FloatArray
    start: IntArray


@kernel
def _displacement_derivative(motions: Motions, stop: int, half: FloatArray, change: FloatArray) -> None:
    """Derivative ``change`` (4, 4, p) of the displacement at a stop by the generators; ``half`` (4, 4, p) is scratch.

    ``d exp(qĤ) = [L, exp(qĤ)]``: preceding joints are multiplied on the left, following ones on the right.
    """
    before, after, generator_basis, generator_start = motions
    change[:] = 0.0
    for side in range(2):
        sign = 1.0 - 2.0 * side
        for j in range(len(generator_start) - 1):
            low, high = generator_start[j], generator_start[j + 1]
            B = before[j + side, stop]
            A = after[j + side, stop]
            for r in range(4):
                for t in range(4):
                    for a in range(low, high):
                        half[r, t, a] = (
                            B[r, 0] * generator_basis[0, t, a]
                            + B[r, 1] * generator_basis[1, t, a]
                            + B[r, 2] * generator_basis[2, t, a]
                            + B[r, 3] * generator_basis[3, t, a]
                        ) * sign
            for r in range(4):
                for t in range(4):
                    for a in range(low, high):
                        change[r, t, a] += (
                            half[r, 0, a] * A[0, t]
                            + half[r, 1, a] * A[1, t]
                            + half[r, 2, a] * A[2, t]
                            + half[r, 3, a] * A[3, t]
                        )


@kernel
def _point_derivative(H: FloatArray, change: FloatArray, M: FloatArray, world: FloatArray, shift: FloatArray) -> None:
    """Point ``M`` (4,) displaced by ``H`` (4, 4) into ``world`` (4,), and its derivative by the generators into
    ``shift`` (4, p).
    """
    for r in range(4):
        world[r] = H[r, 0] * M[0] + H[r, 1] * M[1] + H[r, 2] * M[2] + H[r, 3] * M[3]
        for a in range(shift.shape[1]):
            shift[r, a] = (
                change[r, 0, a] * M[0] + change[r, 1, a] * M[1] + change[r, 2, a] * M[2] + change[r, 3, a] * M[3]
            )


@kernel
def _marker_columns(H: FloatArray, basis: FloatArray, outer: FloatArray, own: FloatArray) -> None:
    """Derivative (2, q) of a pixel by the coordinates of its marker along ``basis`` (q, 4), into ``own``; ``outer``
    (2, 4) is the derivative by the displaced point.
    """
    for a in range(own.shape[1]):
        D4 = basis[a]
        for row in range(2):
            total = 0.0
            for r in range(4):
                total += outer[row, r] * (H[r, 0] * D4[0] + H[r, 1] * D4[1] + H[r, 2] * D4[2] + H[r, 3] * D4[3])
            own[row, a] = total


class Projections(NamedTuple):
    """``cameras`` (c, 3, 4) and ``lenses`` (c, 7), with the bases of their parameters and each camera's first index."""

    cameras: FloatArray
    camera_basis: FloatArray
    camera_start: IntArray
    lenses: FloatArray
    lens_basis: FloatArray
    lens_start: IntArray


class Detections(NamedTuple):
    """k measurements: indices of ``camera``, ``stop`` and ``marker`` (k,), ``pixels`` (k, 2), ``sigmas`` (k,) [px]."""

    camera: IntArray
    stop: IntArray
    marker: IntArray
    pixels: FloatArray
    sigmas: FloatArray


class Markers(NamedTuple):
    """The markers' ``points`` (m, 4) and the ``basis`` (m, 3 or 0, 4) of each one's parameters."""

    points: FloatArray
    basis: FloatArray


@kernel
def _rows_into(
    motions: Motions, projections: Projections, markers: Markers, seen: Detections, core: FloatArray, own: FloatArray
) -> None:
    """Fill weighted rows of measurements that are sorted by stop and marker; ``stop`` counts from the chunk's
    first.

    ``core`` (2 k, p + 1), zero on entry: derivatives by generators, cameras and lenses, then the residual. ``own``
    (2 k, 3 or 0): derivatives by the coordinates of the measurement's own marker.
    """
    after, width = motions.after, motions.basis.shape[2]
    points, point_basis = markers
    cameras, camera_basis, camera_start, lenses, lens_basis, lens_start = projections
    camera, stop, marker, pixels, sigmas = seen
    lens_at = width + camera_basis.shape[0]
    residual_at = core.shape[1] - 1
    half = np.zeros((4, 4, width))
    change = np.zeros((4, 4, width))  # dH of the stop
    shift = np.zeros((4, width))  # dH M of the marker there
    world = np.zeros(4)
    ray = np.zeros(3)
    outer = np.zeros((2, 4))
    last_stop, last_marker = -1, -1
    for k in range(len(camera)):
        s, i, c = stop[k], marker[k], camera[k]
        if s != last_stop:
            _displacement_derivative(motions, s, half, change)
        H = after[0, s]
        if s != last_stop or i != last_marker:
            _point_derivative(H, change, points[i], world, shift)
            last_stop, last_marker = s, i
        P = cameras[c]
        for r in range(3):
            ray[r] = P[r, 0] * world[0] + P[r, 1] * world[1] + P[r, 2] * world[2] + P[r, 3] * world[3]
        u, v = ray[0] / ray[2], ray[1] / ray[2]
        bend, cu, cv, r0 = lenses[c, 0], lenses[c, 1], lenses[c, 2], lenses[c, 3]
        du, dv = (u - cu) / r0, (v - cv) / r0
        square = du * du + dv * dv
        k2, p1, p2 = lenses[c, 4], lenses[c, 5], lenses[c, 6]
        across_term, down_term = square + 2.0 * du * du, square + 2.0 * dv * dv
        growth = square * (bend + k2 * square)
        slope = 2.0 * bend + 4.0 * k2 * square
        weight = 1.0 / sigmas[k]
        # ∂raw/∂ideal, in sigmas.
        Duu = (1.0 + growth + slope * du * du + 2.0 * p1 * dv + 6.0 * p2 * du) * weight
        Duv = (slope * du * dv + 2.0 * p1 * du + 2.0 * p2 * dv) * weight
        Dvv = (1.0 + growth + slope * dv * dv + 6.0 * p1 * dv + 2.0 * p2 * du) * weight
        bent_u = (u - cu) * growth + r0 * (2.0 * p1 * du * dv + p2 * across_term)
        bent_v = (v - cv) * growth + r0 * (p1 * down_term + 2.0 * p2 * du * dv)
        core[2 * k, residual_at] = (u + bent_u - pixels[k, 0]) * weight
        core[2 * k + 1, residual_at] = (v + bent_v - pixels[k, 1]) * weight
        scale = 1.0 / ray[2]
        for r in range(4):
            across, down = (P[0, r] - u * P[2, r]) * scale, (P[1, r] - v * P[2, r]) * scale
            outer[0, r] = Duu * across + Duv * down
            outer[1, r] = Duv * across + Dvv * down
        for row in range(2):
            for a in range(width):
                core[2 * k + row, a] = (
                    outer[row, 0] * shift[0, a]
                    + outer[row, 1] * shift[1, a]
                    + outer[row, 2] * shift[2, a]
                    + outer[row, 3] * shift[3, a]
                )
        for a in range(camera_start[c], camera_start[c + 1]):
            D = camera_basis[a]
            for r in range(3):
                ray[r] = D[r, 0] * world[0] + D[r, 1] * world[1] + D[r, 2] * world[2] + D[r, 3] * world[3]
            across, down = (ray[0] - u * ray[2]) * scale, (ray[1] - v * ray[2]) * scale
            core[2 * k, width + a] = Duu * across + Duv * down
            core[2 * k + 1, width + a] = Duv * across + Dvv * down
        for a in range(lens_start[c], lens_start[c + 1]):
            dk = square * (lens_basis[a, 0] + square * lens_basis[a, 4])
            dcu, dcv, dp1, dp2 = lens_basis[a, 1], lens_basis[a, 2], lens_basis[a, 5], lens_basis[a, 6]
            turned = r0 * (2.0 * du * dv * dp1 + across_term * dp2)
            core[2 * k, lens_at + a] = ((u - cu) * dk + dcu + turned) * weight - Duu * dcu - Duv * dcv
            turned = r0 * (down_term * dp1 + 2.0 * du * dv * dp2)
            core[2 * k + 1, lens_at + a] = ((v - cv) * dk + dcv + turned) * weight - Duv * dcu - Dvv * dcv
        _marker_columns(H, point_basis[i], outer, own[2 * k : 2 * k + 2])


@kernel
def _markers_into(core: FloatArray, own: FloatArray, marker: IntArray, cross: FloatArray, square: FloatArray) -> None:
    """Accumulate the markers' blocks: ``cross`` (m, q, p + 1) by ``core`` (2 k, p + 1), ``square`` (m, q, q)."""
    q, width = own.shape[1], core.shape[1]
    for row in range(len(core)):
        i = marker[row // 2]
        for a in range(q):
            value = own[row, a]
            for b in range(q):
                square[i, a, b] += value * own[row, b]
            for b in range(width):
                cross[i, a, b] += value * core[row, b]


@dataclass(frozen=True)
class Rows:
    """Weighted rows of some measurements: ``core`` (2 k, p_core + 1) with the residuals as its last column,
    ``own`` (2 k, q) by each row's own ``marker`` (k,).
    """

    core: FloatArray
    own: FloatArray
    marker: IntArray

    def dense(self, markers: int) -> FloatArray:
        """All columns and the residuals, (2 k, p + 1)."""
        width, q = self.core.shape[1] - 1, self.own.shape[1]
        out = np.zeros((len(self.core), width + markers * q + 1))
        out[:, :width] = self.core[:, :-1]
        out[:, -1] = self.core[:, -1]
        rows = np.arange(len(out))[:, None]
        out[rows, width + np.repeat(self.marker, 2)[:, None] * q + np.arange(q)] = self.own
        return out


def by_stop(data: Measurements) -> tuple[Measurements, IntArray]:
    """Measurements sorted by stop, marker and camera, the order that `Rows` requires, and the permutation (k,)."""
    order: IntArray = np.lexsort((data.camera, data.marker, data.stop))
    return data.select(order), order


def chunks(rig: RigModel, charts: Charts, data: Measurements) -> Iterator[tuple[slice, Rows]]:
    """Rows of ``data`` (sorted by :func:`by_stop`) in chunks, each with its slice of ``data``."""
    generator_basis = np.concatenate([np.zeros((0, 4, 4)), *charts.generators])
    camera_basis = np.concatenate([np.zeros((0, 3, 4)), *charts.cameras])
    lens_basis = np.concatenate([np.zeros((0, 7)), *charts.lenses])
    point_basis = np.array(charts.points)
    width = len(generator_basis) + len(camera_basis) + len(lens_basis)
    projections = Projections(
        np.ascontiguousarray(rig.cameras),
        camera_basis,
        _starts(charts.cameras),
        np.ascontiguousarray(rig.lenses),
        lens_basis,
        _starts(charts.lenses),
    )
    for first in range(0, len(data.camera), CHUNK):
        here = slice(first, min(first + CHUNK, len(data.camera)))
        stop = data.stop[here]
        before, after = partial_products(rig, data.offsets[stop[0] : stop[-1] + 1])
        core = np.zeros((2 * len(stop), width + 1))
        own = np.empty((2 * len(stop), point_basis.shape[1]))
        motions = Motions(
            before,
            after,
            np.ascontiguousarray(generator_basis.transpose(1, 2, 0)),
            _starts(charts.generators),
        )
        seen = Detections(data.camera[here], stop - stop[0], data.marker[here], data.pixels[here], data.sigmas[here])
        markers = Markers(np.ascontiguousarray(rig.points), point_basis)
        _rows_into(motions, projections, markers, seen, core, own)
        yield here, Rows(core, own, data.marker[here])


def _starts(bases: tuple[FloatArray, ...]) -> IntArray:
    return np.cumsum([0, *(len(basis) for basis in bases)], dtype=np.int64)


def prior_rows(rig: RigModel, charts: Charts, data: Measurements) -> FloatArray:
    """Rows (r, p + 1) of the priors of free lenses, and of the ties of free cameras to a pinhole's
    form; the last column is the residual.
    """
    out = np.zeros((0, charts.size + 1))
    if data.pinhole_ties is not None:
        out = _tie_rows(rig, charts, data.pinhole_ties)
    if data.lens_priors is None:
        return out
    at = charts.start(2)
    for lens, basis, mean, information in zip(
        rig.lenses, charts.lenses, data.lens_priors.mean, data.lens_priors.information, strict=True
    ):
        # Terms that are fixed get no prior: it would only add to the count of rows.
        part = len(mean) if len(basis) and basis[:, 4:].any() else 3
        entries = list(LENS_PARAMETERS[:part])
        values, vectors = np.linalg.eigh(information[:part, :part])
        known = values > 0.0
        root = np.sqrt(values[known])[:, None] * vectors[:, known].T
        if len(basis) and len(root):
            rows = np.zeros((len(root), charts.size + 1))
            rows[:, at : at + len(basis)] = root @ basis[:, entries].T
            rows[:, -1] = root @ (lens[entries] - mean[:part])
            out = np.vstack([out, rows])
        at += len(basis)
    return out


def _tie_rows(rig: RigModel, charts: Charts, ties: PinholeTies) -> FloatArray:
    """Rows (r, p + 1) of skew, fx - fy and the lens centre's distance from the principal point, in their sigmas."""
    rows = []
    camera_at, lens_at = charts.start(1), charts.start(2)
    sigmas = np.array([ties.skew, ties.aspect, ties.centre, ties.centre])
    for matrix, basis, lens, lens_basis in zip(rig.cameras, charts.cameras, rig.lenses, charts.lenses, strict=True):
        if len(basis):
            (fx, fy, skew, cu, cv), slopes = intrinsics_and_jacobian(matrix, basis)
            centre_slopes = lens_basis[:, 1:3]
            out = np.zeros((4, charts.size + 1))
            mine = slice(camera_at, camera_at + len(basis))
            out[:, mine] = np.array([slopes[2], slopes[0] - slopes[1], slopes[3], slopes[4]])
            out[2:, lens_at : lens_at + len(lens_basis)] = -centre_slopes.T
            out[:, -1] = skew, fx - fy, cu - lens[1], cv - lens[2]
            tied = np.isfinite(sigmas) & np.array([True, True, *np.asarray(centre_slopes.any(axis=0))])
            rows.append(out[tied] / sigmas[tied, None])
        camera_at += len(basis)
        lens_at += len(lens_basis)
    return np.vstack([np.zeros((0, charts.size + 1)), *rows])


def normal_equations(rig: RigModel, charts: Charts, data: Measurements, weights: Weights | None) -> NormalEquations:
    """Normal equations of sorted ``data``; ``weights`` of squared residuals (2 k,) for robust
    losses. Priors of lenses are never weighted down.
    """
    width = charts.start(3)
    core = np.zeros((width + 1, width + 1))
    q = len(charts.points[0])
    cross, square = np.zeros((len(rig.points), q, width + 1)), np.zeros((len(rig.points), q, q))
    for _, rows in chunks(rig, charts, data):
        here = rows
        if weights is not None:
            root = np.sqrt(weights(rows.core[:, -1] ** 2))[:, None]
            here = Rows(rows.core * root, rows.own * root, rows.marker)
        core += here.core.T @ here.core
        _markers_into(here.core, here.own, here.marker, cross, square)
    prior = prior_rows(rig, charts, data)[:, [*range(width), -1]]
    core += prior.T @ prior
    sizes = np.sqrt(np.append(np.diag(core)[:-1], np.diagonal(square, axis1=1, axis2=2)))
    sizes[sizes == 0.0] = 1.0
    across, along = np.append(sizes[:width], 1.0), sizes[width:].reshape(len(rig.points), q)
    return NormalEquations(
        core / np.outer(across, across),
        cross / along[:, :, None] / across,
        square / along[:, :, None] / along[:, None, :],
        sizes,
        float(core[-1, -1]),
    )


@kernel
def _eliminate_markers(
    core: FloatArray, own: FloatArray, order: IntArray, marker: IntArray, blocks: FloatArray
) -> None:
    """Eliminate the columns of each row's own marker from ``core`` (2 k, p + 1) and ``own`` (2 k, q), both overwritten,
    by Householder reflections into ``blocks`` (m, q, q + p + 1): each marker's triangle and its coupling.

    ``order`` (k,) sorts the measurements by ``marker`` (k,).
    """
    q, width = own.shape[1], core.shape[1]
    along = np.zeros(q + width)
    first = 0
    while first < len(order):
        i, end = marker[order[first]], first
        while end < len(order) and marker[order[end]] == i:
            end += 1
        block = blocks[i]
        for a in range(q):
            below = 0.0
            for k in range(first, end):
                for row in range(2 * order[k], 2 * order[k] + 2):
                    below += own[row, a] * own[row, a]
            if below == 0.0:
                continue
            # The reflection that maps (x, y) to (-sign(x) |(x, y)|, 0), by its vector (head, y).
            size = np.sqrt(block[a, a] * block[a, a] + below)
            head = block[a, a] + (size if block[a, a] >= 0.0 else -size)
            scale = 2.0 / (head * head + below)
            for b in range(a, q + width):
                along[b] = head * block[a, b]
            for k in range(first, end):
                for row in range(2 * order[k], 2 * order[k] + 2):
                    y = own[row, a]
                    for b in range(a, q):
                        along[b] += y * own[row, b]
                    for b in range(width):
                        along[q + b] += y * core[row, b]
            for b in range(a, q + width):
                along[b] *= scale
                block[a, b] -= head * along[b]
            for k in range(first, end):
                for row in range(2 * order[k], 2 * order[k] + 2):
                    y = own[row, a]
                    for b in range(a + 1, q):
                        own[row, b] -= y * along[b]
                    for b in range(width):
                        core[row, b] -= y * along[q + b]
                    own[row, a] = 0.0
        first = end


@dataclass(frozen=True)
class ArrowFactor:
    """Orthogonal factor ``R`` of ``[J r]``, triangular with the markers first: ``Rᵀ R = [J r]ᵀ [J r]``.

    ``own`` (m, q, q): each marker's triangle; ``cross`` (m, q, p_core + 1): its rows by the other parameters and the
    residuals; ``core`` (p_core + 1, p_core + 1): the triangle of these with the markers eliminated.
    """

    own: FloatArray
    cross: FloatArray
    core: FloatArray

    def without(self, columns: IntArray) -> ArrowFactor:
        """The factor without these ``columns`` of generators, cameras and lenses: they are kept fixed."""
        if not len(columns):
            return self
        return ArrowFactor(
            self.own, np.delete(self.cross, columns, axis=2), _triangle(np.delete(self.core, columns, axis=1))
        )

    def dense(self) -> FloatArray:
        """``R`` (p + 1, p + 1), columns in the order of the charts and the residuals last; rows of markers first."""
        m, q, width = self.cross.shape
        out = np.zeros((m * q + width, m * q + width))
        core = np.append(np.arange(width - 1), m * q + width - 1)
        out[: m * q, core] = self.cross.reshape(m * q, width)
        out[m * q :, core] = self.core
        rows = np.arange(m * q)
        out[rows[:, None], width - 1 + (rows // max(q, 1))[:, None] * q + np.arange(q)] = self.own.reshape(m * q, q)
        return out


def arrow_factor(rig: RigModel, charts: Charts, data: Measurements, more: FloatArray | None = None) -> ArrowFactor:
    """Orthogonal factor of the Jacobian and the residuals, priors of lenses included, in chunks.

    As accurate as QR of the whole Jacobian, because its condition is not squared; time and memory are linear in the
    markers, because each is eliminated from its own rows. ``more`` (2 k, e): columns after those of the lenses.
    """
    sorted_data, order = by_stop(data)
    beside = np.zeros((2 * len(order), 0)) if more is None else more
    width, q, e = charts.start(3), len(charts.points[0]), beside.shape[1]
    blocks = np.zeros((len(rig.points), q, q + width + e + 1))
    core = np.zeros((width + e + 1, width + e + 1))
    prior = np.insert(prior_rows(rig, charts, data)[:, [*range(width), -1]], [width] * e, 0.0, axis=1)
    core = _triangle(np.vstack([core, prior]))
    for here, rows in chunks(rig, charts, sorted_data):
        whole = rows.core
        if e:
            extra = beside.reshape(-1, 2, e)[order[here]].reshape(-1, e)
            whole = np.hstack([whole[:, :-1], extra, whole[:, -1:]])
        if q:
            _eliminate_markers(whole, rows.own, np.argsort(rows.marker, kind="stable"), rows.marker, blocks)
        core = _triangle(np.vstack([core, whole]))
    return ArrowFactor(blocks[:, :, :q], blocks[:, :, q:], core)


def triangle_of(rig: RigModel, charts: Charts, data: Measurements) -> FloatArray:
    """``R`` (p + 1, p + 1) with ``Rᵀ R = [J r]ᵀ [J r]``, dense, priors of lenses included: see `arrow_factor`."""
    return arrow_factor(rig, charts, data).dense()


def _triangle(rows: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.qr(rows, mode="r"))


def leverages(rig: RigModel, charts: Charts, data: Measurements, factor: ArrowFactor) -> FloatArray:
    """Leverage (k,) of each measurement, ``trace(J_i (Jᵀ J)⁻¹ J_iᵀ)`` in its sigmas: its part of the hat matrix's
    trace. ``factor``: of the measurements that determine the parameters. Raises LinAlgError if they do not.
    """
    sorted_data, order = by_stop(data)
    core_root = column_root(factor.core[:-1, :-1])
    lengths = np.linalg.norm(factor.own, axis=1)
    lengths[lengths == 0.0] = 1.0
    own_roots = np.linalg.inv(factor.own / lengths[:, None, :]) / lengths[:, :, None]
    out = np.empty(len(order))
    for here, rows in chunks(rig, charts, sorted_data):
        marker = np.repeat(rows.marker, 2)
        own = np.einsum("ka,kab->kb", rows.own, own_roots[marker])
        left = rows.core[:, :-1] - np.einsum("ka,kab->kb", own, factor.cross[marker, :, :-1])
        squares = (own**2).sum(axis=1) + ((left @ core_root) ** 2).sum(axis=1)
        out[order[here]] = squares.reshape(-1, 2).sum(axis=1)
    return out
