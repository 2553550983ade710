"""Camera matrices from known points by robust damped least squares, over rigid motions or free matrices.

A class of changes is a displacement of one camera, or of several together, that keeps the intrinsics; a change of
frame, where the stratum has no displacements (2.19); or one whole matrix. Pixels are raw ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stereoservo.calibration.least_squares import DenseFit, Limits, Minimum, RobustLoss, minimise
from stereoservo.geometry.distortion import bends, distort, distortion_jacobian
from stereoservo.kinematics.kernels import exp_twist
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

EVALUATIONS = 100
SETTLED = 1e-4
"""Length of a step [standard deviations of the parameters] at which a fit has converged."""
SUBSETS, OF_SUBSET, SUBSET_EVALUATIONS = 30, 4, 20
"""Random starts, ids of each and evaluations, that are tried where a fit to everything leaves outliers: of 30 % wrong
ids one in a thousand searches finds no clean start."""
NOISY, FEW = 4.0, 0.25
"""Variance of the pixels over the stated one, and share of outliers, at which a search for better starts ends."""
OUTSTANDING = 25.0
"""Squared distance, in the noise of the median, above which a pixel is an outlier: two degrees of freedom."""
LOSS = RobustLoss("cauchy", 3.0)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Correspondences of known points and their raw pixels in a flat list: ``camera`` (k,) index into the fitted
    cameras, ``ids`` (k,), ``pose`` (k,) of the arm, -1 for static points; ``points`` (k, 4), ``pixels`` (k, 2) and
    ``covariances`` (k, 2, 2) [px²].
    """

    camera: IntArray
    ids: IntArray
    pose: IntArray
    points: FloatArray
    pixels: FloatArray
    covariances: FloatArray

    def select(self, keep: BoolArray) -> Correspondences:
        """The views where ``keep`` (k,) holds."""
        return Correspondences(
            self.camera[keep],
            self.ids[keep],
            self.pose[keep],
            self.points[keep],
            self.pixels[keep],
            self.covariances[keep],
        )


class MatrixChange(Protocol):
    """Parameterization of a permitted change of camera matrices (c, 3, 4)."""

    @property
    def size(self) -> int:
        """Number of parameters."""

    def directions(self, matrices: FloatArray) -> FloatArray:
        """Derivative (c, size, 3, 4) of the matrices by the parameters, at 0."""

    def step(self, matrices: FloatArray, x: FloatArray) -> FloatArray:
        """The matrices at parameters ``x`` (size,)."""


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """All cameras moved by one element of a group: ``P exp(Σ x_k B_k)``, ``algebra`` B (size, 4, 4)."""

    algebra: FloatArray

    @property
    def size(self) -> int:
        return len(self.algebra)

    def directions(self, matrices: FloatArray) -> FloatArray:
        found: FloatArray = matrices[:, None] @ self.algebra[None]
        return found

    def step(self, matrices: FloatArray, x: FloatArray) -> FloatArray:
        motion: FloatArray = exp_twist(np.tensordot(x, self.algebra, axes=1))
        moved: FloatArray = matrices @ motion
        return moved


@dataclass(frozen=True)
class FreeMatrix:
    """One camera's matrix but for its scale: 11 parameters."""

    size: int = 11

    def directions(self, matrices: FloatArray) -> FloatArray:
        matrix = matrices[0] / np.linalg.norm(matrices[0])
        rows = np.linalg.svd(matrix.reshape(1, 12))[2][1:]
        return np.asarray(rows.reshape(1, 11, 3, 4) * np.linalg.norm(matrices[0]))

    def step(self, matrices: FloatArray, x: FloatArray) -> FloatArray:
        return np.asarray(matrices + np.tensordot(x, self.directions(matrices)[0], axes=1))


def predicted(matrices: FloatArray, lenses: FloatArray, views: Correspondences) -> FloatArray:
    """Raw pixels (k, 2) of the points; NaN behind a camera and outside of its lens's image."""
    images = np.einsum("kij,kj->ki", matrices[views.camera], views.points)
    ahead = images[:, 2] > 0.0
    ideal = images[:, :2] / np.where(ahead, images[:, 2], np.nan)[:, None]
    pixels: FloatArray = np.empty_like(ideal)
    for c, lens in enumerate(lenses):
        mine = views.camera == c
        pixels[mine] = distort(lens, ideal[mine]) if bends(lens) else ideal[mine]
    return pixels


def entry_jacobian(matrices: FloatArray, lenses: FloatArray, views: Correspondences) -> FloatArray:
    """Derivative (k, 2, 12) of the raw pixels by the entries of each one's matrix."""
    images = np.einsum("kij,kj->ki", matrices[views.camera], views.points)
    ideal = images[:, :2] / images[:, 2:]
    bend = np.tile(np.eye(2), (len(ideal), 1, 1))
    for c, lens in enumerate(lenses):
        mine = views.camera == c
        if bends(lens):
            bend[mine] = distortion_jacobian(lens, ideal[mine])
    by_image = np.zeros((len(ideal), 2, 3))
    by_image[:, 0, 0] = by_image[:, 1, 1] = 1.0
    by_image[:, :, 2] = -ideal
    by_image = bend @ by_image / images[:, 2, None, None]
    found: FloatArray = (by_image[..., None] * views.points[:, None, None, :]).reshape(-1, 2, 12)
    return found


def parameter_jacobian(
    family: MatrixChange, matrices: FloatArray, lenses: FloatArray, views: Correspondences
) -> FloatArray:
    """Derivative (k, 2, size) of the raw pixels by the parameters of a change."""
    directions = family.directions(matrices).reshape(len(matrices), family.size, 12)
    found: FloatArray = np.einsum(
        "kia,kga->kig", entry_jacobian(matrices, lenses, views), directions[views.camera], optimize=True
    )
    return found


def whitening(covariances: FloatArray) -> FloatArray:
    """Whitening matrices ``L⁻¹`` (k, 2, 2) of covariances ``L Lᵀ``."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def matrix_fit(
    family: MatrixChange,
    lenses: FloatArray,
    views: Correspondences,
    whiten: Callable[[FloatArray], FloatArray],
    loss: RobustLoss | None = None,
) -> DenseFit[FloatArray]:
    """The fit of matrices (c, 3, 4); ``whiten`` takes rows (k, 2, q) [px] to sigmas."""
    return DenseFit(
        lambda matrices: whiten((predicted(matrices, lenses, views) - views.pixels)[..., None])[..., 0],
        lambda matrices: whiten(parameter_jacobian(family, matrices, lenses, views)),
        family.step,
        loss,
    )


def fit_matrices(
    family: MatrixChange, start: FloatArray, lenses: FloatArray, views: Correspondences,
    *, loss: RobustLoss | None, evaluations: int = EVALUATIONS,
) -> Minimum[FloatArray]:  # fmt: skip
    """Matrices (c, 3, 4) of least squared residuals, or of least ``loss``, from ``start``; the cost is infinite where
    points lie behind a camera at the start.
    """
    roots = whitening(views.covariances)
    fit = matrix_fit(family, lenses, views, lambda rows: roots @ rows, loss)
    return minimise(fit, start, Limits(evaluations, 0.0, SETTLED**2))


def fit_with_outliers(
    family: MatrixChange, starts: list[FloatArray], lenses: FloatArray, views: Correspondences
) -> tuple[FloatArray, float]:
    """The best robust fit to ``views``, some of whose ids may be wrong, from several starts and subsets of ids."""
    best = min(
        (fit_matrices(family, start, lenses, views, loss=LOSS) for start in starts), key=lambda one: one.cost
    )
    roots = whitening(views.covariances)
    if _clean(_whitened(best.state, lenses, views, roots)):
        return best.state, best.cost
    for subset in _subsets(views, family):
        some = views.select(subset)
        for start in starts:
            part = fit_matrices(family, start, lenses, some, loss=None, evaluations=SUBSET_EVALUATIONS)
            found = fit_matrices(family, part.state, lenses, views, loss=LOSS)
            best = found if found.cost < best.cost else best
        if _is_good_enough(_whitened(best.state, lenses, views, roots)):
            break
    return best.state, best.cost


def _clean(error: FloatArray) -> bool:
    """Whether no whitened error (k, 2) exceeds the noise that their median indicates."""
    squares = (error**2).sum(axis=1)
    return bool(squares.max() <= OUTSTANDING * max(1.0, float(np.median(squares)) / np.log(4.0)))


def _is_good_enough(error: FloatArray) -> bool:
    """Whether most whitened errors (k, 2) are about as large as the stated noise, so that no other start can do
    better.
    """
    squares = (error**2).sum(axis=1)
    factor = max(1.0, float(np.median(squares)) / np.log(4.0))
    return bool(factor < NOISY and (squares > OUTSTANDING * factor).mean() <= FEW)


def _subsets(views: Correspondences, family: MatrixChange) -> Iterator[BoolArray]:
    """Subsets of the views of a few ids each, enough for the parameters; deterministic."""
    rng = np.random.default_rng(views.pixels.shape[0])
    ids = np.unique(views.ids)
    for _ in range(SUBSETS):
        order = rng.permutation(ids)
        for count in range(OF_SUBSET, len(ids)):
            keep = np.isin(views.ids, order[:count])
            if 2 * int(keep.sum()) >= family.size + 2:
                yield keep
                break


def _whitened(
    matrices: FloatArray, lenses: FloatArray, views: Correspondences, roots: FloatArray
) -> FloatArray:
    error: FloatArray = (roots @ (predicted(matrices, lenses, views) - views.pixels)[..., None])[..., 0]
    return error
