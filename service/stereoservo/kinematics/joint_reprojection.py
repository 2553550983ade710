"""Reprojection error of known points as a function of the joint angles, for many configurations at once: residuals,
derivatives, predicted pixels; and the known points, triangulated from images.

The thesis's objective (4.42) over the joint angles (4.45), for any chain, mount and number of cameras. Points may carry
a covariance; the residuals are then whitened by the joint covariance of pixels and points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stereoservo.geometry.cameras import triangulate, triangulation_covariance
from stereoservo.geometry.displacements import exp_generator
from stereoservo.geometry.distortion import distort, distortion_jacobian, undistort
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel, pinhole
from stereoservo.numerics.arrays import BoolArray, FloatArray


class JointAnglesError(ValueError):
    """Joint angles cannot be estimated from the images; the message states the cause, the value and the valid range.

    Attributes:
        code: ``shape``, ``too_few``, ``limits``, ``not_observable``, ``no_agreement``, ``outside_limits``.
        data: the values in the message; ``joints`` names those that are not observable.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data


@dataclass(frozen=True, eq=False)
class ObservedChain:
    """A chain and the cameras that observe its points, or are mounted on it: ``cameras`` (c, 3, 4) to ideal pixels,
    ``lenses`` (c, 4) or (c, 7) from them to raw ones. The third row of each camera is positive for points in front, as
    in calibrated models.
    """

    chain: ProjectiveChain
    cameras: FloatArray
    lenses: FloatArray
    joint_names: tuple[str, ...]

    def __post_init__(self) -> None:
        c, n = len(self.cameras), self.chain.joints
        if (
            self.cameras.shape != (c, 3, 4)
            or self.lenses.shape not in ((c, 4), (c, 7))
            or len(self.joint_names) != n
            or not c
        ):
            raise JointAnglesError(
                "shape",
                f"cameras {self.cameras.shape}, lenses {self.lenses.shape}, {len(self.joint_names)} names for {n} "
                f"joints; (c, 3, 4), (c, 4) and {n} names are needed",
            )

    def displacements(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``H(q)`` (s, 4, 4) and ``∂H/∂q_j`` (s, n, 4, 4) at configurations ``q`` (s, n) (5.18, 5.38).

        Eye-in-hand (4.44 with errata): ``∂H/∂q_j = E_n … E_{j+1} Ĥ_j E_j … E_1``.
        """
        chain = self.chain
        s, n = q.shape
        before, steps = np.empty((n + 1, s, 4, 4)), np.empty((n, s, 4, 4))
        before[0] = np.eye(4)
        for i, j in enumerate(chain.order):
            steps[i] = exp_generator(chain.kinds[j], chain.generators[j], q[:, j] - chain.zero[j])
            before[i + 1] = before[i] @ steps[i]
        slopes = np.empty((s, n, 4, 4))
        after: FloatArray = np.broadcast_to(np.eye(4), (s, 4, 4))
        for i in reversed(range(n)):
            after = steps[i] @ after
            j = chain.order[i]
            slopes[:, j] = before[i] @ chain.generators[j] @ after
        return before[n], slopes


def observed_chain(model: CellModel) -> ObservedChain:
    """Chain, cameras and lenses of a calibrated cell."""
    return ObservedChain(
        ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first),
        np.array([camera.matrix for camera in model.cameras]),
        np.array([camera.lens for camera in model.cameras]),
        model.joint_names,
    )


def pinhole_lenses(cameras: int) -> FloatArray:
    """Lenses (c, 4) of cameras without distortion."""
    return np.tile(pinhole(), (cameras, 1))


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Least-squares problem of one unknown ``q`` (n,): pixels of known points at joints ``q + offsets[k]``.

    ``points`` (m, 4) at the chain's zero; ``point_roots`` (m, 4, 4) with ``root rootᵀ`` their covariance, or None if
    they are exact; ``pixels`` (k, c, m, 2) ideal [px], 0 where missing; ``roots`` (k, c, m, 2, 2) [1/px] that whiten
    them, 0 where missing; ``offsets`` (k, n).
    """

    seen: ObservedChain
    points: FloatArray
    point_roots: FloatArray | None
    pixels: FloatArray
    roots: FloatArray
    offsets: FloatArray

    @property
    def measurements(self) -> int:
        """Number of pixel coordinates."""
        return 2 * int((self.roots[..., 0, 0] > 0).sum())

    @property
    def freedom(self) -> int:
        """Degrees of freedom: measurements minus parameters (uncertain points count as both)."""
        return self.measurements - self.seen.chain.joints

    def project(self, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Projected points ``m = P H M`` (s, k, c, m, 3) and their derivatives with respect to the joints
        (s, k, c, m, 3, n) at configurations ``q`` (s, n), ``P H`` (s, k, c, 3, 4), and whether all points lie in front
        of the cameras that see them (s,).
        """
        s, n = q.shape
        k = len(self.offsets)
        H, slopes = self.seen.displacements((q[:, None] + self.offsets).reshape(s * k, n))
        through: FloatArray = (self.seen.cameras @ H[:, None]).reshape(s, k, -1, 3, 4)
        by_joint = self.seen.cameras[:, None] @ slopes[:, None]
        images = through @ self.points.T
        changes = (by_joint @ self.points.T).reshape(s, k, len(self.seen.cameras), n, 3, -1)
        depths = np.where(self.roots[..., 0, 0] > 0, images[..., 2, :], 1.0)
        front: BoolArray = np.asarray((depths > 0.0).all(axis=(1, 2, 3)))
        return np.moveaxis(images, -1, -2), np.moveaxis(changes, (-1, -3), (-3, -1)), through, front

    def linearise(self, q: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Whitened residuals (s, r) (predicted minus measured pixels), derivatives (s, r, n), and whether in front
        (s,), at configurations ``q`` (s, n).
        """
        images, changes, through, front = self.project(q)
        here = self.roots[..., 0, 0] > 0
        depth = np.where(here & (images[..., 2] != 0.0), images[..., 2], 1.0)
        predicted = images[..., :2] / depth[..., None]
        error = (self.roots @ (predicted - self.pixels)[..., None])[..., 0]
        scaled = self.roots / depth[..., None, None]
        slope = scaled @ (changes[..., :2, :] - predicted[..., None] * changes[..., 2:, :])
        s, n = q.shape
        error = np.moveaxis(error, 3, 1).reshape(s, len(self.points), -1)
        slope = np.moveaxis(slope, 3, 1).reshape(s, len(self.points), -1, n)
        if self.point_roots is not None:
            lever = through[:, :, :, None, :2] - predicted[..., None] * through[:, :, :, None, 2:]
            lever = np.moveaxis(scaled @ lever @ self.point_roots, 3, 1).reshape(s, len(self.points), -1, 4)
            # Contribution of the points' uncertainty to the pixels' unit noise.
            factor = np.linalg.cholesky(np.eye(lever.shape[2]) + lever @ lever.swapaxes(-1, -2))
            error = np.linalg.solve(factor, error[..., None])[..., 0]
            slope = np.linalg.solve(factor, slope)
        return error.reshape(s, -1), slope.reshape(s, -1, n), front

    def linearise_rays(self, q: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Like `linearise`, with unit rays instead of pixels: bounded, and valid behind a camera, for a search from a
        distant start.
        """
        images, changes, _, front = self.project(q)
        blocks = np.linalg.inv(self.seen.cameras[:, :, :3])[:, None]
        target = blocks @ np.concatenate([self.pixels, np.ones((*self.pixels.shape[:-1], 1))], axis=-1)[..., None]
        target = target[..., 0] / np.linalg.norm(target[..., 0], axis=-1, keepdims=True)
        rays, by_joint = (blocks @ images[..., None])[..., 0], blocks @ changes
        length = np.linalg.norm(rays, axis=-1)
        length = np.where(length > 0.0, length, 1.0)[..., None]
        rays = rays / length
        by_joint = (by_joint - rays[..., None] * (rays[..., None, :] @ by_joint)) / length[..., None]
        here = (self.roots[..., 0, 0] > 0)[..., None]
        s, n = q.shape
        error, slope = (rays - target) * here, by_joint * here[..., None]
        return error.reshape(s, -1), slope.reshape(s, -1, n), front


def joint_problem(
    seen: ObservedChain,
    points: FloatArray,
    pixels: FloatArray,
    sigma: FloatArray | float,
    *,
    offsets: FloatArray | None = None,
    point_covariance: FloatArray | None = None,
) -> JointProblem:
    """The problem of raw ``pixels`` (c, m, 2), or (k, c, m, 2) at joints that differ by ``offsets`` (k, n).

    ``points`` (m, 4) at the chain's zero, NaN for excluded points, with ``point_covariance`` (m, 4, 4), default exact;
    ``sigma`` [px]: a number, or an array of the pixels' shape; NaN pixels are missing. Raises JointAnglesError for
    wrong shapes, a sigma that is not positive, no pixels.
    """
    n, c = seen.chain.joints, len(seen.cameras)
    images = pixels[None] if pixels.ndim == 3 else pixels
    steps = np.zeros((1, n)) if offsets is None else np.asarray(offsets, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 4 or images.shape != (len(steps), c, len(points), 2):
        raise JointAnglesError(
            "shape",
            f"pixels {pixels.shape} and points {points.shape} do not fit {c} cameras and {len(steps)} offsets; "
            "(k, c, m, 2) and (m, 4) are needed",
            pixels=pixels.shape,
            points=points.shape,
        )
    if steps.shape[1:] != (n,) or not np.isfinite(steps).all():
        raise JointAnglesError("shape", f"offsets {steps.shape}; finite ones (k, {n}) are needed")
    known: BoolArray = np.asarray(np.isfinite(points).all(axis=1), dtype=bool)
    ideal = np.stack([undistort(lens, images[:, i]) for i, lens in enumerate(seen.lenses)], axis=1)
    here: BoolArray = np.asarray(np.isfinite(ideal).all(axis=-1), dtype=bool) & known
    noise = np.asarray(sigma, dtype=np.float64)
    noise = np.broadcast_to(noise, here.shape)
    if not (noise[here] > 0).all():
        raise JointAnglesError("shape", "sigma must be positive wherever a pixel is given")
    if not here.any():
        raise JointAnglesError("too_few", "no pixel of a known point is given; at least one is needed")
    ideal = np.where(here[..., None], ideal, 0.0)
    bends = np.stack([distortion_jacobian(lens, ideal[:, i]) for i, lens in enumerate(seen.lenses)], axis=1)
    roots = np.where(here, 1.0 / np.where(here, noise, 1.0), 0.0)[..., None, None] * bends
    roots[~here] = 0.0
    factors = None
    if point_covariance is not None:
        values, vectors = np.linalg.eigh(np.where(known[:, None, None], point_covariance, 0.0))
        factors = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return JointProblem(seen, np.where(known[:, None], points, 0.0), factors, ideal, roots, steps)


def reconstruct_points(
    seen: ObservedChain, q: FloatArray, pixels: FloatArray, sigma: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Points (m, 4) at the chain's zero, and their covariance (m, 4, 4), from raw ``pixels`` (c, m, 2) [px] at ``q``
    (n,).

    NaN and 0 if fewer than two cameras see a point. Depth is 1 in the first camera at ``q``. Raises JointAnglesError
    for wrong shapes.
    """
    here = joint_problem(seen, np.zeros((pixels.shape[-2], 4)), pixels, sigma)
    given = here.roots[0, ..., 0, 0] > 0
    # One standard deviation per camera and point: the geometric mean of the two after undistortion.
    noise = 1.0 / np.sqrt(np.where(given, np.abs(np.linalg.det(here.roots[0])), 1.0))
    points = triangulate(seen.cameras, np.where(given[..., None], here.pixels[0], np.nan), noise)
    known = np.isfinite(points).all(axis=1)
    covariance = np.zeros((len(points), 4, 4))
    sigmas = np.where(given, noise, np.inf)
    covariance[known] = triangulation_covariance(seen.cameras, points[known], sigmas[:, known])
    back: FloatArray = np.asarray(np.linalg.inv(seen.chain.displacement(q)), dtype=np.float64)
    return points @ back.T, back @ covariance @ back.T


def predicted_pixels(seen: ObservedChain, q: FloatArray, points: FloatArray) -> FloatArray:
    """Raw pixels (s, c, m, 2) of ``points`` (m, 4), given at the zero, at configurations ``q`` (s, n) (4.44)."""
    H, _ = seen.displacements(q)
    images = np.einsum("cij,sjl,ml->scmi", seen.cameras, H, points, optimize=True)
    ideal = images[..., :2] / np.where(images[..., 2:] == 0.0, np.nan, images[..., 2:])
    return np.stack([distort(lens, ideal[:, i]) for i, lens in enumerate(seen.lenses)], axis=1)
