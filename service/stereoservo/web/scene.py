"""What a metric model shows in three dimensions: joint axes, markers and cameras in its Euclidean frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from stereoservo.kinematics.axes import euclidean_centres, framed, joint_axes
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray


@dataclass(frozen=True)
class Scene:
    """The scene of a metric model of cameras that stand; its unit of length is the model's own."""

    chain: ProjectiveChain
    points: FloatArray
    cameras: list[dict[str, Any]]

    @classmethod
    def of(cls, model: CellModel) -> Self | None:
        """The scene of ``model``; None where it is not metric, or its cameras ride on the arm."""
        if model.stratum != "metric" or model.tip_first:
            return None
        parts = framed(model)
        directions = parts.cameras[:, 2, :3] * np.sign(np.linalg.det(parts.cameras[:, :, :3]))[:, None]
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        cameras = [
            {"name": camera.name, "centre": centre.tolist(), "axis": axis.tolist()}
            for camera, centre, axis in zip(
                model.cameras, euclidean_centres(parts.cameras), directions, strict=True
            )
        ]
        return cls(ProjectiveChain(parts.kinds, parts.generators, parts.zero), parts.points, cameras)

    def markers(self, joints: FloatArray) -> FloatArray:
        """Markers (m, 3) at ``joints`` (n,)."""
        points = self.points @ self.chain.displacement(joints).T
        found: FloatArray = points[:, :3] / points[:, 3:]
        return found

    def at(self, joints: FloatArray) -> dict[str, Any]:
        """Axes (a point near the markers, a direction), markers and cameras at ``joints`` (n,)."""
        markers = self.markers(joints)
        axes = joint_axes(self.chain.kinds, self.chain.operators_at(joints))
        middle = markers.mean(axis=0)
        origins = np.where(np.isfinite(axes.points), axes.points, middle)
        along = ((middle - origins) * axes.directions).sum(axis=1)
        nearest = origins + along[:, None] * axes.directions
        return {
            "axes": [[p.tolist(), d.tolist()] for p, d in zip(nearest, axes.directions, strict=True)],
            "markers": markers.tolist(),
            "cameras": self.cameras,
        }
