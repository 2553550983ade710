"""The bundle of a camera rig: that of a cell (:mod:`stereoservo.calibration.bundle_adjustment`) with an arm of six
joints that nobody has read, three along and three about the axes of the first camera, in the place of the hand that
waves.

The six joints' errors at each stop are estimated with the rest; their deviations are so wide that they say nothing.
Cameras are tied to pixels without skew, of one focal length, and to a lens about the principal point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.camera_rig.initialization import RigStart
from stereoservo.calibration.camera_rig.views import RigViews
from stereoservo.calibration.joint_errors.joint_noise import joint_columns
from stereoservo.calibration.least_squares import DenseFit, Limits, minimise
from stereoservo.calibration.rig_model import (
    JointNoise,
    Measurements,
    PinholeTies,
    RigModel,
    displacements,
    predicted,
    residuals,
    rig_at,
)
from stereoservo.geometry.screws import twist_matrix
from stereoservo.geometry.strata import decompose_camera
from stereoservo.kinematics.parameterization import Kind, LensModel
from stereoservo.numerics.arrays import BoolArray, FloatArray

HAND: tuple[Kind, ...] = ("prismatic",) * 3 + ("revolute",) * 3
TIED = 1e-2
"""Standard deviation of a tie [px]: below what data show, so that it holds, and not so stiff that steps stall."""
LOOSE = 10.0
"""Ties [px] with which the bundle of an unknown body begins, whose cameras have any pixels yet."""
WIDE = 100.0
"""Deviations of the hand's joints [rad], and [distances of the body]."""
OUTLIER = 5.0
"""Residual, in estimated standard deviations of the noise, beyond which a measurement is left out."""
ROUNDS = 3
ASPECT_GAIN = 25.0
"""Chi-square that pixels which are not square must gain to be believed, beside 2 for each camera."""
ASPECT_ROUNDS = 3
EVALUATIONS = 150
POSE = Limits(evaluations=40, tolerance=1e-6)
"""Of the fit of one pose."""
FRAMES = 60
"""Frames of the body among which the one is taken in which its middle angle stays farthest from a quarter turn."""


@dataclass(frozen=True)
class RigProblem:
    """What a bundle of ``views`` begins from: which measurements ``kept`` (k,) of ``data``, the ``body_frame`` (3, 3)
    of the hand's angles. ``aspect``: factor of the rows' coordinate that makes pixels square.
    """

    views: RigViews
    data: Measurements
    kept: BoolArray
    body_frame: FloatArray
    aspect: float
    length_known: bool


@dataclass(frozen=True)
class RigFit(RigProblem):
    """The bundle of a problem, with its ``solution``."""

    solution: Solution

    @property
    def rig(self) -> RigModel:
        """The model at the minimum."""
        return self.solution.rig

    @cached_property
    def poses(self) -> FloatArray:
        """Poses (s, 4, 4) of the body in the first camera's frame."""
        found: FloatArray = displacements(self.rig, self.solution.data.offsets)
        found[:, :3, :3] = found[:, :3, :3] @ self.body_frame.T
        return found

    @property
    def points(self) -> FloatArray:
        """Markers (m, 3) on the body."""
        return np.asarray(self.rig.points[:, :3] @ self.body_frame.T)

    @property
    def freedoms(self) -> int:
        """Residuals less parameters, those of the body's poses included."""
        solution = self.solution
        free = len(self.views.names) - (0 if self.length_known else 1)
        return solution.rows - solution.charts.size - 6 * free

    @property
    def variance(self) -> float:
        """Variance factor of the stated sigmas: what the residuals show."""
        return self.solution.cost / max(self.freedoms, 1)

    @cached_property
    def residuals(self) -> FloatArray:
        """Residuals (k, 2) [px] of all measurements, those left out included."""
        data = replace(self.data, offsets=self.solution.data.offsets)
        return np.asarray((predicted(self.rig, data) - data.pixels) / np.array([1.0, self.aspect]))

    @cached_property
    def root(self) -> FloatArray:
        """``R⁻¹`` (p, p), with ``R⁻¹ R⁻ᵀ`` the covariance of the parameters at the variance that residuals show."""
        return np.asarray(self.solution.determined.root * np.sqrt(self.variance))

    def moved(self, x: FloatArray) -> RigModel:
        """The model at chart coordinates ``x`` (p,)."""
        return rig_at(self.rig, self.solution.charts, x)

    def pose_deviations(self) -> FloatArray:
        """Deviations (s, 6) of the body's poses, cameras taken for exact: along [m] and about [rad] the axes."""
        data = self.solution.data
        rows = joint_columns(self.rig, data)
        found = np.full((len(self.views.names), 6), np.inf)
        for stop in np.unique(data.stop):
            mine = np.repeat(data.stop == stop, 2)
            J = rows[mine]
            sizes = np.linalg.norm(J, axis=0)
            sizes[sizes == 0.0] = 1.0
            values, vectors = np.linalg.eigh((J / sizes).T @ (J / sizes))
            spread = (vectors**2 / np.maximum(values, 1e-300)).sum(axis=1)
            found[stop] = np.sqrt(self.variance * spread) / sizes
        return found


def fit_rig(views: RigViews, start: RigStart, lenses: LensModel = "brown") -> RigFit:
    """The bundle from ``start``; measurements that stick out of the noise are left out in rounds, pixels that are not
    square are found. Where its ``solution`` has not converged, the data leave the cameras open. Raises GeometryError,
    LinAlgError where they leave no model.
    """
    views, start = _placed(views, start)
    data, body_frame = _measurements(views, start)
    rig = _rig(start, body_frame)
    known = start.reference is None
    if known:
        data = _with_poses_settled(rig, data)
    begun = RigProblem(views, data, np.ones(len(data.camera), dtype=bool), body_frame, 1.0, known)
    if not known:
        ties = PinholeTies(LOOSE, LOOSE, LOOSE)
        loose = _settled(begun, rig, lenses, ties)
        if not loose.solution.converged:  # its first step is too far off where places are
            begun = replace(begun, data=_with_poses_settled(rig, data))
            loose = _settled(begun, rig, lenses, ties)
        if not loose.solution.converged:
            return loose
        begun, rig = loose, loose.rig
    square = _settled(begun, rig, lenses, PinholeTies(TIED, TIED, TIED))
    if not square.solution.converged:
        return square
    open_aspect = PinholeTies(TIED, np.inf, TIED)
    free = _settled(square, square.rig, lenses, open_aspect)
    if not free.solution.converged:
        return free
    # Pixels are square unless the chi-square of all cameras' aspects is beyond chance by far.
    gain = (square.solution.cost - free.solution.cost) / max(free.variance, 1e-300)
    if gain < ASPECT_GAIN + 2.0 * len(views.cameras):
        return square
    for _ in range(ASPECT_ROUNDS):
        ratio = np.mean([np.divide(*np.diag(decompose_camera(P)[0])[:2]) for P in free.rig.cameras])
        free = _settled(*_stretched(free, float(ratio)), lenses, open_aspect)
        if not free.solution.converged:
            break
    return free


def _stretched(fit: RigFit, ratio: float) -> tuple[RigFit, RigModel]:
    """The fit with rows' coordinates stretched by ``ratio``, to begin from."""
    stretch = np.diag([1.0, ratio, 1.0])
    lenses = fit.rig.lenses * np.array([1.0, 1.0, ratio, 1.0, 1.0, 1.0, 1.0])
    rig = replace(fit.rig, cameras=stretch @ fit.rig.cameras, lenses=lenses)
    data = replace(fit.data, pixels=fit.data.pixels * np.array([1.0, ratio]))
    return replace(fit, data=data, aspect=fit.aspect * ratio), rig


def _placed(views: RigViews, start: RigStart) -> tuple[RigViews, RigStart]:
    """Views and start of those stops and markers that have a place in it."""
    stops, markers = np.isfinite(start.poses[:, 0, 0]), np.isfinite(start.points[:, 0])
    reference = None if start.reference is None else int(stops[: start.reference].sum())
    return views.select(stops, markers), replace(
        start, poses=start.poses[stops], points=start.points[markers], reference=reference
    )


def _settled(begun: RigProblem, rig: RigModel, lenses: LensModel, ties: PinholeTies) -> RigFit:
    """The bundle from ``rig``, and from the places and the measurements kept of the fit that has ``begun``."""
    data, kept = replace(begun.data, pinhole_ties=ties), begun.kept
    for _ in range(ROUNDS):
        solution = solve(
            rig, data.select(kept), "metric", generators=False, points=not begun.length_known, lenses=lenses,
            max_evaluations=EVALUATIONS,
        )  # fmt: skip
        data, rig = replace(data, offsets=solution.data.offsets), solution.rig
        fit = RigFit(begun.views, data, kept, begun.body_frame, begun.aspect, begun.length_known, solution)
        sizes = np.linalg.norm(fit.residuals, axis=1) / data.sigmas
        # The median of a Rayleigh distribution is 1.1774 sigmas.
        noise = float(np.median(sizes[np.isfinite(sizes)])) / 1.1774
        inside = np.isfinite(sizes) & (sizes <= OUTLIER * max(noise, 1e-9) * np.sqrt(2.0))
        if (inside == kept).all():
            break
        kept = inside
    return fit


def _with_poses_settled(rig: RigModel, data: Measurements) -> Measurements:
    """The measurements with the hand's readings at the least residuals of each stop, cameras and body as they are: each
    stop on its own, for the bundle does not damp the hand's errors.
    """
    offsets = data.offsets.copy()
    for stop in np.unique(data.stop):
        mine = data.select(data.stop == stop)
        offsets[stop] = _settled_pose(rig, replace(mine, stop=np.zeros_like(mine.stop)), offsets[stop])
    return replace(data, offsets=offsets)


def _settled_pose(rig: RigModel, data: Measurements, reading: FloatArray) -> FloatArray:
    fit = DenseFit[FloatArray](
        lambda q: residuals(rig, replace(data, offsets=q[None]))[:, None],
        lambda q: joint_columns(rig, replace(data, offsets=q[None]))[:, None],
        np.add,
    )
    return minimise(fit, reading, POSE).state


def _rig(start: RigStart, body_frame: FloatArray) -> RigModel:
    none, axes = np.zeros(3), np.eye(3)
    generators = np.concatenate([twist_matrix(none, axes), twist_matrix(axes, none)])
    lenses = np.hstack([start.lenses, np.zeros((len(start.lenses), 3))])
    points = np.hstack([start.points @ body_frame, np.ones((len(start.points), 1))])
    return RigModel(HAND, generators, start.cameras, points, lenses)


def _measurements(views: RigViews, start: RigStart) -> tuple[Measurements, FloatArray]:
    """The flat list of measurements, with the hand's readings at the start's poses, and the body's frame."""
    turns = Rotation.from_matrix(start.poses[:, :3, :3])
    tried = [Rotation.identity(), *Rotation.random(FRAMES, rng=np.random.default_rng(1))]
    worst = [float(np.abs(np.sin((turns * frame).as_euler("XYZ")[:, 1])).max()) for frame in tried]
    frame = tried[int(np.argmin(worst))]
    offsets = np.hstack([start.poses[:, :3, 3], (turns * frame).as_euler("XYZ")])
    s = len(offsets)
    own = np.tile(np.repeat([WIDE * float(np.abs(start.poses[:, :3, 3]).max()), WIDE], 3), (s, 1))
    if start.reference is not None:
        own[start.reference] = 0.0
    noise = JointNoise(own, np.full((s, 6), -1), np.zeros(0), np.zeros((s, 0)), np.zeros(6))
    camera, stop, marker = np.nonzero(views.seen)
    data = Measurements(
        offsets, camera, stop, marker, views.pixels[camera, stop, marker], views.sigmas[camera, stop, marker],
        joint_noise=noise,
    )  # fmt: skip
    return data, frame.as_matrix()
