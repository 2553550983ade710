"""Propagation of a model's covariance to quantities that do not depend on its projective frame, such as axis angles,
intrinsics or predicted pixels: covariances and standard deviations. Those of predicted pixels include the errors of the
joint readings.

A quantity is a function of the model: an angle between axes, an intrinsic parameter through
``projective_to_euclidean``, a predicted pixel. Its derivative is a central difference along each principal axis of the
covariance, with a step of a small fraction of the standard deviation; no formula and no step size are needed for each
quantity.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel, ModelCovariance
from stereoservo.kinematics.parameterization import conjugation
from stereoservo.numerics.arrays import FloatArray

STEP = 0.01
"""Step of central differences [standard deviations]."""


JOINT_STEP = 1e-5
"""Step of central differences with respect to a joint's position [rad or m]."""


class NoCovarianceError(ValueError):
    """The model contains no covariance: its file is of an older version, or it is not the result of a fit."""


def displaced_model(model: CellModel, x: FloatArray) -> CellModel:
    """The model with its parameters (p,) changed by ``x`` along the directions of its covariance.

    Generators are conjugated, which keeps their algebra; points are rescaled to height 1 over the plane at infinity.
    The result has neither statistics nor covariance. Raises NoCovarianceError, ValueError.
    """
    given = _covariance_of(model)
    x = np.asarray(x, dtype=np.float64)
    if x.shape != (len(given.covariance),):
        raise ValueError(f"x has shape {x.shape}; ({len(given.covariance)},) is needed")
    at = 0

    def own(basis: FloatArray) -> FloatArray:
        nonlocal at
        at += len(basis)
        return x[at - len(basis) : at]

    generators = []
    for generator, basis in zip(model.generators, given.generators, strict=True):
        frame, _ = conjugation(basis, own(basis))
        generators.append(frame @ generator @ np.linalg.inv(frame))
    matrices = [
        camera.matrix + np.tensordot(own(basis), basis, axes=1)
        for camera, basis in zip(model.cameras, given.cameras, strict=True)
    ]
    lenses = [camera.lens + own(basis) @ basis for camera, basis in zip(model.cameras, given.lenses, strict=True)]
    points = np.array(
        [point + own(basis) @ basis for point, basis in zip(model.marker_points, given.markers, strict=True)]
    )
    return msgspec.structs.replace(
        model,
        generators=np.array(generators),
        cameras=tuple(
            msgspec.structs.replace(camera, matrix=matrix, lens=lens)
            for camera, matrix, lens in zip(model.cameras, matrices, lenses, strict=True)
        ),
        marker_points=points / (points @ model.plane_at_infinity)[:, None],
        statistics=None,
        covariance=None,
    )


def propagate_covariance(
    model: CellModel, function: Callable[[CellModel], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Values (r,) of ``function`` at the model and their covariance (r, r), to first order.

    ``function`` must not depend on the frame, nor, in the metric stratum, on the undetermined scale. Raises
    NoCovarianceError.
    """
    root = covariance_axes(model)
    values = np.atleast_1d(np.asarray(function(model), dtype=np.float64))
    slopes = np.empty((len(values), root.shape[1]))
    for k, axis in enumerate(root.T):
        ahead = np.atleast_1d(function(displaced_model(model, STEP * axis)))
        behind = np.atleast_1d(function(displaced_model(model, -STEP * axis)))
        slopes[:, k] = (ahead - behind) / (2.0 * STEP)
    return values, slopes @ slopes.T


def standard_deviations(model: CellModel, function: Callable[[CellModel], FloatArray]) -> FloatArray | None:
    """Standard deviations (r,) of the values of ``function``; None if the model contains no covariance."""
    if model.covariance is None:
        return None
    return np.asarray(np.sqrt(np.diag(propagate_covariance(model, function)[1])))


def predicted_pixels(model: CellModel, positions: FloatArray) -> FloatArray:
    """Raw pixels (c, s, m, 2) of the markers at joint ``positions`` (s, n); they may lie outside the image."""
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, tip_first=model.tip_first)
    points = model.marker_points @ chain.displacements(positions).transpose(0, 2, 1)
    pixels = []
    for camera in model.cameras:
        images = points @ camera.matrix.T
        pixels.append(distort(camera.lens, images[..., :2] / images[..., 2:]))
    return np.array(pixels)


def pixel_covariances(model: CellModel, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Predicted raw pixels (c, s, m, 2) at reported joint ``positions`` (s, n), and their covariances (c, s, m, 2, 2)
    [px²] with respect to the true pixels: ``J Cov Jᵀ + J_q S_q J_qᵀ``, from the errors of the model's parameters and of
    the joint readings.

    First order; measurement noise is not included. Raises NoCovarianceError.
    """
    positions = np.asarray(positions, dtype=np.float64)
    slopes = [
        (
            predicted_pixels(displaced_model(model, STEP * axis), positions)
            - predicted_pixels(displaced_model(model, -STEP * axis), positions)
        )
        / (2.0 * STEP)
        for axis in covariance_axes(model).T
    ]
    if model.joint_accuracy is not None:
        deviations = model.joint_accuracy.deviations(positions - model.zero)
        for joint, deviation in enumerate(deviations.T):
            shift = np.zeros(positions.shape[1])
            shift[joint] = JOINT_STEP
            ends = [predicted_pixels(model, positions + sign * shift) for sign in (1.0, -1.0)]
            slopes.append((ends[0] - ends[1]) * (deviation[None, :, None, None] / (2.0 * JOINT_STEP)))
    stacked = np.array(slopes)
    return predicted_pixels(model, positions), np.einsum("pcsma,pcsmb->csmab", stacked, stacked)


def covariance_axes(model: CellModel) -> FloatArray:
    """Root ``L`` (p, r) of the covariance ``L Lᵀ``: the principal axes of the correlation matrix, each scaled to one
    standard deviation.

    Raises NoCovarianceError.
    """
    matrix = _covariance_of(model).covariance
    deviations = np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix / np.outer(deviations, deviations))
    kept = values > 0.0
    axes: FloatArray = deviations[:, None] * vectors[:, kept] * np.sqrt(values[kept])
    return axes


def _covariance_of(model: CellModel) -> ModelCovariance:
    if model.covariance is None:
        raise NoCovarianceError("the model carries no covariance; a fit of this version writes one")
    return model.covariance
