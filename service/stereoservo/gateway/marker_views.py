"""Observations of markers as arrays of undistorted pixels with their cameras, from a taught goal or the newest frames;
and the projective frame of a goal's or the current model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stereoservo.daemon.taught_goals import TaughtGoal, TaughtModel
from stereoservo.gateway.observation_cache import MarkerObservations
from stereoservo.geometry.alignment import AlignmentFrame
from stereoservo.geometry.cameras import triangulate, triangulation_covariance
from stereoservo.geometry.distortion import distort, distortion_jacobian, undistort
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.strata import projective_to_affine
from stereoservo.kinematics.model import CellModel, Stratum
from stereoservo.numerics.arrays import FloatArray

UNKNOWN_SIGMA_PX = 0.1
"""Standard deviation [px] of a pixel that was stored without one (goals of schema 1)."""


@dataclass(frozen=True)
class MarkerViews:
    """Observations of markers ``ids`` in several cameras.

    ``Ps`` (c, 3, 4), ``lenses`` (c, 4), ``sizes`` (c, 2): the cameras.
    ``pixels`` (c, n, 2): ideal, NaN if not seen; ``sigmas`` (c, n) [px].
    ``scene`` (m, 4): points that are in front of all cameras.
    """

    cameras: tuple[str, ...]
    Ps: FloatArray
    lenses: FloatArray
    sizes: FloatArray
    ids: list[int]
    pixels: FloatArray
    sigmas: FloatArray
    scene: FloatArray

    @classmethod
    def empty(cls, model: CellModel, ids: Sequence[int]) -> MarkerViews:
        """Views of a model's cameras without observations."""
        shape = (len(model.cameras), len(ids))
        return cls(
            tuple(camera.name for camera in model.cameras),
            np.array([camera.matrix for camera in model.cameras]),
            np.array([camera.lens for camera in model.cameras]),
            np.array([(camera.width, camera.height) for camera in model.cameras], dtype=np.float64),
            list(ids),
            np.full((*shape, 2), np.nan),
            np.full(shape, np.inf),
            model.marker_points,
        )

    def add(self, camera: str, seen: Mapping[int, tuple[tuple[float, float], float]]) -> None:
        """Enter raw pixels with their standard deviations; cameras and markers outside of these views are ignored."""
        known = [marker for marker in seen if marker in self.ids]
        if camera not in self.cameras or not known:
            return
        c, rows = self.cameras.index(camera), [self.ids.index(marker) for marker in known]
        ideal = undistort(self.lenses[c], np.array([seen[marker][0] for marker in known]))
        visible = np.flatnonzero(np.isfinite(ideal).all(axis=1))  # others are beyond the lens model's fold
        bend = np.sqrt(np.abs(np.linalg.det(distortion_jacobian(self.lenses[c], ideal[visible]))))
        kept = [rows[k] for k in visible]
        self.pixels[c, kept] = ideal[visible]
        self.sigmas[c, kept] = np.array([seen[known[k]][1] for k in visible]) / bend

    def subset(self, ids: Sequence[int]) -> MarkerViews:
        """The views of some markers, in their order; missing ones are unseen."""
        pixels = np.full((len(self.cameras), len(ids), 2), np.nan)
        sigmas = np.full((len(self.cameras), len(ids)), np.inf)
        for k, marker in enumerate(ids):
            if marker in self.ids:
                pixels[:, k] = self.pixels[:, self.ids.index(marker)]
                sigmas[:, k] = self.sigmas[:, self.ids.index(marker)]
        return MarkerViews(self.cameras, self.Ps, self.lenses, self.sizes, list(ids), pixels, sigmas, self.scene)

    def points(self) -> tuple[FloatArray, FloatArray]:
        """Points (n, 4) at depth 1 in the first camera and their covariances (n, 4, 4); NaN if seen by fewer than two
        cameras.
        """
        points = triangulate(self.Ps, self.pixels, self.sigmas, iterations=6)
        covariance = np.full((len(points), 4, 4), np.nan)
        known = np.isfinite(points).all(axis=1)
        if known.any():
            covariance[known] = triangulation_covariance(self.Ps, points[known], self.sigmas[:, known])
        return points, covariance

    def front_signs(self) -> FloatArray:
        """Sign (c,) of the product of each camera's third row with a point in front of it, 1 for the first camera."""
        depths = self.scene @ self.Ps[:, 2].T
        depths = depths * np.sign(depths[:, :1])
        return np.where((depths > 0).sum(axis=0) * 2 >= len(self.scene), 1.0, -1.0)

    def raw(self, pixels: FloatArray) -> FloatArray:
        """Raw pixels (c, n, 2) of ideal ones; NaN outside of a lens's image."""
        return np.array([distort(lens, seen) for lens, seen in zip(self.lenses, pixels, strict=True)])


def observed_views(observations: MarkerObservations, model: CellModel, ids: Sequence[int]) -> MarkerViews:
    """The current observations of markers ``ids``."""
    views = MarkerViews.empty(model, ids)
    for camera, seen in observations.items():
        views.add(camera, {marker: (observation.pixel, observation.sigma) for marker, observation in seen.items()})
    return views


def taught_views(goal: TaughtGoal) -> MarkerViews:
    """All observations stored with a goal, with the cameras of its model. The goal must have its model."""
    assert goal.model is not None
    cameras = goal.model.cameras
    seen: Mapping[str, Mapping[int, tuple[float, float]]]
    ids = sorted({m for seen in (goal.target.set_points, goal.others) for p in seen.values() for m in p})
    shape = (len(cameras), len(ids))
    views = MarkerViews(
        tuple(camera.name for camera in cameras),
        np.array([camera.matrix for camera in cameras]).reshape(-1, 3, 4),
        np.array([camera.lens for camera in cameras]),
        np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64),
        ids,
        np.full((*shape, 2), np.nan),
        np.full(shape, np.inf),
        np.zeros((0, 4)),
    )
    for seen in (goal.target.set_points, goal.others):
        for camera, points in seen.items():
            known = goal.sigmas.get(camera, {})
            views.add(
                camera,
                {marker: (pixel, known.get(marker, UNKNOWN_SIGMA_PX)) for marker, pixel in points.items()},
            )
    return views


def taught_frame(model: TaughtModel) -> AlignmentFrame:
    """The frame of a goal's model."""
    upgrade = model.projective_to_euclidean
    return _frame(
        model.stratum,
        np.array([camera.matrix for camera in model.cameras]).reshape(-1, 3, 4),
        np.array(model.plane_at_infinity),
        None if upgrade is None else np.array(upgrade).reshape(4, 4),
    )


def model_frame(model: CellModel) -> AlignmentFrame:
    """The frame of a model."""
    return _frame(
        model.stratum,
        np.array([camera.matrix for camera in model.cameras]),
        model.plane_at_infinity,
        model.projective_to_euclidean,
    )


def _frame(stratum: Stratum, Ps: FloatArray, plane: FloatArray, upgrade: FloatArray | None) -> AlignmentFrame:
    if stratum == "projective":
        return AlignmentFrame(Ps)
    try:
        affine: FloatArray | None = projective_to_affine(plane)
    except GeometryError:  # the plane passes through the first camera; a Euclidean frame determines it, too
        affine = upgrade
    return AlignmentFrame(Ps, affine, upgrade if stratum == "metric" else None)
