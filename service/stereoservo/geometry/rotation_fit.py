"""Maximum likelihood of one projective rotation from pixels and known angles (thesis 4.4, (4.42), (4.43)).

Ten parameters, and points, eliminated by the Schur complement. Pixels are ideal ones [px], NaN
where missing. Everything runs in coordinates whitened over the points at all stops.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.displacements import conjugate, exp_rotation
from stereoservo.geometry.homogeneous import GeometryError, whitener
from stereoservo.geometry.reprojection_fit import Images, Motion, covariance_of, minimise, read_images
from stereoservo.geometry.rotations import (
    RotationChart,
    check_rotation_generator,
    rotation_chart,
    rotation_from_parameters,
    rotation_parameter_derivatives,
    rotation_parameters,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class RotationFit:
    """The rotation ``exp(θĤ)`` of least squared reprojection error.

    ``generator`` (4, 4); ``parameters`` (10,) in ``chart`` with ``covariance`` (10, 10), and the
    ``generator_covariance`` (16, 16) of its entries row by row, of rank ten, both at the stated noise;
    ``points`` (m, 4) at angle 0, NaN where left out, depth 1 in the first camera; ``cost`` the sum of squares
    over the stated variances; ``freedom`` measurements less parameters; ``evaluations`` of the model.
    """

    generator: FloatArray
    chart: RotationChart
    parameters: FloatArray
    covariance: FloatArray
    generator_covariance: FloatArray
    points: FloatArray
    cost: float
    freedom: int
    evaluations: int


def rotation_motion(chart: RotationChart, angles: FloatArray) -> Motion:
    """Ten parameters to ``exp(θ_s Ĥ)`` (s, 4, 4) at ``angles`` (s,) [rad] and their derivatives (s, 10, 4, 4)."""
    sine, cosine = np.sin(angles)[:, None, None, None], 2.0 * np.sin(0.5 * angles)[:, None, None, None] ** 2

    def motion(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        G = rotation_from_parameters(x, chart)
        changes = rotation_parameter_derivatives(x, chart)
        slopes: FloatArray = sine * changes + cosine * (changes @ G + G @ changes)
        return exp_rotation(G, angles), slopes

    return motion


def bundle_rotation(
    Ps: FloatArray,
    pixels: FloatArray,
    points: FloatArray,
    generator: FloatArray,
    angles: npt.ArrayLike,
    sigma: FloatArray | float,
) -> RotationFit:
    """The rotation and the points of least reprojection error (4.42 with free points, three parameters each).

    Cameras ``Ps`` (c, 3, 4); ``pixels`` (s, c, m, 2) [px] at ``angles`` (s,) [rad]; start ``points`` (m, 4) at angle
    0, NaN where one is to be left out, and ``generator`` (4, 4); noise ``sigma``, a number or (s, c, m) [px]. Points
    seen fewer than twice are left out. Raises GeometryError for shapes that do not fit, a start that is no rotation, a
    generator that the data do not determine, no convergence.
    """
    images = read_images(Ps, pixels, sigma)
    theta = np.asarray(angles, dtype=np.float64)
    if (
        theta.shape != pixels.shape[:1]
        or points.shape != (pixels.shape[2], 4)
        or not np.isfinite(theta).all()
    ):
        raise GeometryError(
            "shape",
            f"points {points.shape} and angles {theta.shape} do not fit pixels {pixels.shape}; finite "
            f"({pixels.shape[2]}, 4) and ({pixels.shape[0]},) are needed",
            points=points.shape,
            angles=theta.shape,
        )
    G = check_rotation_generator(generator)
    views = (images.weights > 0).sum(axis=(0, 1))
    known: BoolArray = np.asarray(np.isfinite(points).all(axis=1) & (views >= 2))
    used = Images(images.cameras, images.pixels[:, :, known], images.weights[:, :, known])
    size = 10 + 3 * int(known.sum())
    if used.measurements < size:
        raise GeometryError(
            "too_few",
            f"{used.measurements} pixel coordinates of {int(known.sum())} points for {size} parameters",
            measurements=used.measurements,
            parameters=size,
        )
    # A flat scene spans space only over its stops.
    W = whitener((points[known] @ exp_rotation(G, theta).transpose(0, 2, 1)).reshape(-1, 4))
    M = points[known] @ W.T
    M = M / np.linalg.norm(M, axis=1, keepdims=True)
    white = conjugate(W, G)
    chart = rotation_chart(white)
    seen = Images(used.cameras @ np.linalg.inv(W), used.pixels, used.weights)
    best = minimise(seen, rotation_motion(chart, theta), rotation_parameters(white, chart), M, True)
    covariance = covariance_of(best.information, "the generator")
    back: FloatArray = np.asarray(np.linalg.inv(W), dtype=np.float64)
    found = conjugate(back, rotation_from_parameters(best.x, chart))
    changes = conjugate(back, rotation_parameter_derivatives(best.x, chart)).reshape(10, 16)
    covariance_x = changes.T @ covariance @ changes
    own = rotation_chart(found)
    parameters = rotation_parameters(found, own)
    inverse = np.linalg.pinv(rotation_parameter_derivatives(parameters, own).reshape(10, 16).T)
    estimated = np.full(points.shape, np.nan)
    estimated[known] = best.points @ back.T
    estimated = estimated / (estimated @ images.cameras[0, 2])[:, None]
    return RotationFit(
        found,
        own,
        parameters,
        np.asarray(inverse @ covariance_x @ inverse.T, dtype=np.float64),
        np.asarray(covariance_x, dtype=np.float64),
        estimated,
        best.cost,
        used.measurements - size,
        best.evaluations,
    )
