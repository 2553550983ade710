"""Rigid bundle of generators, cameras and markers in any stratum (5.53, 5.55-5.57): residuals, Jacobian,
solution.

Angles are exact; pixels carry the noise. All quantities are moved along the minimal charts of
:mod:`stereoservo.kinematics.calibration.charts`, so that the Jacobian has full rank where the data identify
the model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from stereoservo.kinematics.calibration.charts import (
    Kind,
    camera_basis,
    conjugation,
    exponentials,
    generator_basis,
    point_basis,
)
from stereoservo.kinematics.model import Stratum

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Rig:
    """A model under estimation: ``generators`` (n, 4, 4), ``cameras`` (c, 3, 4), ``points`` (m, 4) at
    joint offset 0.
    """

    kinds: tuple[Kind, ...]
    generators: FloatArray
    cameras: FloatArray
    points: FloatArray


@dataclass(frozen=True)
class Measurements:
    """Pixels in a flat list: camera, stop and marker of each (k,), ``pixels`` (k, 2), ``sigmas`` (k,) [px].

    ``offsets`` (s, n): joint positions of each stop minus the zero.
    """

    offsets: FloatArray
    camera: IntArray
    stop: IntArray
    marker: IntArray
    pixels: FloatArray
    sigmas: FloatArray

    def select(self, keep: npt.NDArray[np.bool_]) -> Measurements:
        """The measurements where ``keep`` (k,) holds."""
        return Measurements(
            self.offsets,
            self.camera[keep],
            self.stop[keep],
            self.marker[keep],
            self.pixels[keep],
            self.sigmas[keep],
        )


@dataclass(frozen=True)
class Charts:
    """Directions of each part; an empty basis (0, ...) keeps the part fixed."""

    generators: tuple[FloatArray, ...]
    cameras: tuple[FloatArray, ...]
    points: tuple[FloatArray, ...]

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(len(basis) for part in (self.generators, self.cameras, self.points) for basis in part)


def full_charts(rig: Rig, stratum: Stratum, *, cameras: bool = True, points: bool = True) -> Charts:
    """Minimal charts around ``rig``; cameras or points may be kept fixed.

    With free cameras the first is the gauge's (projective, affine: fixed; metric: ``K [I | 0]``), the second
    loses the remaining gauge, further ones are free.
    """
    none = np.zeros((0, 3, 4))
    matrices: tuple[FloatArray, ...] = tuple(none for _ in rig.cameras)
    if cameras:
        left = camera_basis(rig.cameras[0], "left_metric", stratum) if stratum == "metric" else none
        matrices = (
            left,
            *(
                camera_basis(matrix, "right" if c == 0 else "other", stratum)
                for c, matrix in enumerate(rig.cameras[1:])
            ),
        )
    return Charts(
        tuple(generator_basis(h, kind, stratum) for h, kind in zip(rig.generators, rig.kinds, strict=True)),
        matrices,
        tuple(point_basis(point, stratum) if points else np.zeros((0, 4)) for point in rig.points),
    )


def unit_charts(
    rig: Rig, data: Measurements, stratum: Stratum, *, cameras: bool = True, points: bool = True
) -> Charts:
    """``full_charts`` scaled so that the columns of the Jacobian have unit length: chart coordinates in
    sigmas.
    """
    charts = full_charts(rig, stratum, cameras=cameras, points=points)
    sizes = np.linalg.norm(jacobian(rig, charts, np.zeros(charts.size), data), axis=0)
    sizes[sizes == 0.0] = 1.0
    at = 0
    scaled: list[tuple[FloatArray, ...]] = []
    for part in (charts.generators, charts.cameras, charts.points):
        bases = []
        for basis in part:
            size = sizes[at : at + len(basis)]
            bases.append(basis / size.reshape(-1, *(1,) * (basis.ndim - 1)))
            at += len(basis)
        scaled.append(tuple(bases))
    return Charts(scaled[0], scaled[1], scaled[2])


def moved(rig: Rig, charts: Charts, x: FloatArray) -> Rig:
    """The rig at chart coordinates ``x``."""
    at = 0
    generators: list[FloatArray] = []
    cameras: list[FloatArray] = []
    points: list[FloatArray] = []
    for generator, basis in zip(rig.generators, charts.generators, strict=True):
        frame, _ = conjugation(basis, x[at : at + len(basis)])
        generators.append(frame @ generator @ np.linalg.inv(frame))
        at += len(basis)
    for part, bases, out in ((rig.cameras, charts.cameras, cameras), (rig.points, charts.points, points)):
        for value, basis in zip(part, bases, strict=True):
            out.append(value + np.tensordot(x[at : at + len(basis)], basis, axes=1))
            at += len(basis)
    return Rig(rig.kinds, np.array(generators), np.array(cameras), np.array(points))


def displaced(rig: Rig, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Partial products ``E_1 … E_j`` (n + 1, s, 4, 4) and ``E_{j+1} … E_n M`` (n + 1, s, m, 4), j = 0 … n
    (5.18).
    """
    steps = exponentials(rig.generators, rig.kinds, offsets)
    s, n = offsets.shape
    before = np.empty((n + 1, s, 4, 4))
    after = np.empty((n + 1, s, len(rig.points), 4))
    before[0] = np.eye(4)
    after[n] = rig.points
    for j in range(n):
        before[j + 1] = before[j] @ steps[:, j]
        after[n - 1 - j] = after[n - j] @ steps[:, n - 1 - j].transpose(0, 2, 1)
    return before, after


def predicted(rig: Rig, data: Measurements) -> FloatArray:
    """Pixels (k, 2) of the rig for each measurement (5.56)."""
    _, after = displaced(rig, data.offsets)
    images = np.einsum("kij,kj->ki", rig.cameras[data.camera], after[0][data.stop, data.marker])
    pixels: FloatArray = images[:, :2] / images[:, 2:]
    return pixels


def residuals(rig: Rig, data: Measurements) -> FloatArray:
    """Weighted residuals (2 k,): prediction minus measurement in sigmas, u and v of each measurement
    together.
    """
    return ((predicted(rig, data) - data.pixels) / data.sigmas[:, None]).ravel()


def jacobian(rig: Rig, charts: Charts, x: FloatArray, data: Measurements) -> FloatArray:
    """Derivative (2 k, p) of ``residuals(moved(rig, charts, x), data)`` by ``x``."""
    here = moved(rig, charts, x)
    before, after = displaced(here, data.offsets)
    k, n = len(data.pixels), len(rig.generators)
    world = after[0][data.stop, data.marker]
    images = np.einsum("kij,kj->ki", here.cameras[data.camera], world)
    scale = 1.0 / (images[:, 2] * data.sigmas)
    pixels = images[:, :2] / images[:, 2:]

    def through_camera(change: FloatArray) -> FloatArray:
        """d pixel / d (homogeneous point in front of ``change`` (s, 4, 4)) as (k, 2, 4), weighted."""
        rows = np.einsum("cij,sjl->csil", here.cameras, change)[data.camera, data.stop]
        result: FloatArray = (rows[:, :2] - pixels[:, :, None] * rows[:, 2:]) * scale[:, None, None]
        return result

    out = np.zeros((2 * k, charts.size))
    at = 0
    outer = through_camera(before[0])
    for j in range(n):
        inner = through_camera(before[j + 1])
        basis = charts.generators[j]
        p = len(basis)
        if p:
            # d exp(qĤ) = [L, exp(qĤ)] under the joints before, acting on the points behind.
            _, motions = conjugation(basis, x[at : at + p])
            moment = outer[..., None] * after[j][data.stop, data.marker][:, None, None, :]
            moment -= inner[..., None] * after[j + 1][data.stop, data.marker][:, None, None, :]
            out[:, at : at + p] = moment.reshape(2 * k, 16) @ motions.reshape(p, 16).T
        at += p
        outer = inner
    out3 = out.reshape(k, 2, charts.size)
    for c, basis in enumerate(charts.cameras):
        p = len(basis)
        if p:
            mine = np.flatnonzero(data.camera == c)
            rays = world[mine] * scale[mine, None]
            change = np.einsum("pij,kj->kip", basis, rays)
            out3[mine, :, at : at + p] = change[:, :2] - pixels[mine][:, :, None] * change[:, 2:]
        at += p
    for i, basis in enumerate(charts.points):
        p = len(basis)
        if p:
            mine = np.flatnonzero(data.marker == i)
            out3[mine, :, at : at + p] = outer[mine] @ basis.T
        at += p
    return out


@dataclass(frozen=True)
class Solution:
    """A solved bundle: the rig, its charts there, ``cost`` = sum of squared weighted residuals, and the
    Jacobian.
    """

    rig: Rig
    charts: Charts
    stratum: Stratum
    cost: float
    residuals: FloatArray
    jacobian: FloatArray
    converged: bool
    evaluations: int


def solve(
    rig: Rig,
    data: Measurements,
    stratum: Stratum,
    *,
    cameras: bool = True,
    points: bool = True,
    loss: Literal["linear", "soft_l1", "cauchy"] = "linear",
    loss_scale: float = 1.0,
    rounds: int = 3,
    max_evaluations: int = 60,
    tolerance: float = 1e-10,
) -> Solution:
    """Least squares over the minimal charts of ``stratum``, re-centred between ``rounds``.

    ``loss_scale`` [sigmas] for the robust losses. Raises LinAlgError where the start has no finite residuals.
    Never raises on a bad fit: look at ``converged`` and ``cost``.
    """
    if not np.isfinite(residuals(rig, data)).all():
        raise np.linalg.LinAlgError("points at infinity or in a focal plane at the start of a bundle")
    evaluations = 0
    converged = False
    for _ in range(rounds):
        start, charts = rig, unit_charts(rig, data, stratum, cameras=cameras, points=points)

        def error_at(x: FloatArray, start: Rig = start, charts: Charts = charts) -> FloatArray:
            return residuals(moved(start, charts, x), data)

        def slope_at(x: FloatArray, start: Rig = start, charts: Charts = charts) -> FloatArray:
            return jacobian(start, charts, x, data)

        fit = least_squares(
            error_at,
            np.zeros(charts.size),
            jac=slope_at,
            x_scale="jac",
            loss=loss,
            f_scale=loss_scale,
            ftol=tolerance,
            xtol=1e-10,
            # Columns have unit length: a gradient so small moves no parameter by a notable part of its
            # deviation.
            gtol=1e-6,
            max_nfev=max_evaluations,
        )
        rig = moved(start, charts, fit.x)
        evaluations += fit.nfev
        converged = fit.status > 0
        if converged and fit.nfev <= 3:
            break
    charts = unit_charts(rig, data, stratum, cameras=cameras, points=points)
    error = residuals(rig, data)
    slope = jacobian(rig, charts, np.zeros(charts.size), data)
    return Solution(rig, charts, stratum, float(error @ error), error, slope, converged, evaluations)
