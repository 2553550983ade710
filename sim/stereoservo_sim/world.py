"""The simulated cell's truth: arm, marker body and cameras in one world, and noise-free images of the
markers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from stereoservo_sim.body import MarkerBody, roof_body
from stereoservo_sim.rig import PinholeCamera, StereoRig, look_at, project, stereo_rig
from stereoservo_sim.robots import RX90, Robot, flange_pose, shape_segments

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MAX_INCIDENCE = float(np.deg2rad(72.0))
"""Angle between line of sight and face normal beyond which no detector is expected to measure a dot."""


@dataclass(frozen=True, eq=False)
class SimulatedCell:
    """Arm, body on its flange, cameras; ``base`` (n,) [rad] is the configuration around which the cell is
    laid out.
    """

    robot: Robot
    body: MarkerBody
    rig: StereoRig
    base: FloatArray

    def flange(self, q: FloatArray) -> FloatArray:
        """Pose of the flange in the world at ``q`` (n,), (4, 4)."""
        return flange_pose(self.robot, q)

    def marker_positions(self, q: FloatArray) -> FloatArray:
        """Markers in the world at ``q`` (n,), (m, 3) [m], rows as ``body.ids``."""
        pose = self.flange(q)
        return self.body.marker_points @ pose[:3, :3].T + pose[:3, 3]

    def marker_positions_rig(self, q: FloatArray) -> FloatArray:
        """Markers in the rig's frame at ``q`` (n,), (m, 3) [m]: what errors in millimetres are judged by."""
        frame = self.rig.world_to_rig
        return self.marker_positions(q) @ frame[:3, :3].T + frame[:3, 3]

    def truth_pixels(self, q: FloatArray) -> dict[str, FloatArray]:
        """Noise-free images of all marker centres at ``q`` (n,), seen or not: camera name -> (m, 2) [px]."""
        points = self.marker_positions(q)
        return {camera.name: project(camera.P, points)[0] for camera in self.rig.cameras}

    def visible(
        self, q: FloatArray, camera: PinholeCamera, *, max_incidence: float = MAX_INCIDENCE
    ) -> BoolArray:
        """Which markers ``camera`` sees at ``q`` (n,), (m,): as :meth:`turned_to`, and no link stands
        before them.
        """
        pose = self.flange(q)
        seen = self.turned_to(pose, camera, max_incidence=max_incidence)
        points = self.body.marker_points @ pose[:3, :3].T + pose[:3, 3]
        return seen & ~self._behind_arm(q, points, camera.centre)

    def turned_to(
        self, flange: FloatArray, camera: PinholeCamera, *, max_incidence: float = MAX_INCIDENCE
    ) -> BoolArray:
        """Which markers have their whole dot in the image and their face turned to ``camera``, (m,).

        ``flange`` (4, 4) may be any pose, also one that the arm does not take.
        """
        points = self.body.marker_points @ flange[:3, :3].T + flange[:3, 3]
        normals = self.body.marker_normals @ flange[:3, :3].T
        radii = np.concatenate([np.full(len(face.ids), face.radius) for face in self.body.faces])
        pixels, depths = project(camera.P, points)
        sight = camera.centre - points
        distances = np.linalg.norm(sight, axis=1)
        turned = np.sum(sight * normals, axis=1) > np.cos(max_incidence) * distances
        border = camera.K[0, 0] * radii / np.maximum(depths, 1e-6) + 2.0
        inside = (
            (depths > 0.05)
            & np.all(pixels >= border[:, None], axis=1)
            & np.all(pixels <= np.array([camera.width - 1, camera.height - 1]) - border[:, None], axis=1)
        )
        return np.asarray(turned & inside, dtype=np.bool_)

    def _behind_arm(self, q: FloatArray, points: FloatArray, eye: FloatArray) -> BoolArray:
        ends, radii = shape_segments(self.robot, q)
        hidden = np.zeros(len(points), dtype=np.bool_)
        for (start, end), radius in zip(ends, radii, strict=True):
            # Start a little in front of the dot: the mount behind the plate is no obstacle.
            hidden |= _segment_distance(points + 0.02 * (eye - points), eye, start, end) < radius
        return hidden


def _segment_distance(starts: FloatArray, eye: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Distances (m,) [m] of the segments ``starts[i]``-``eye`` (m, 3), (3,) from the segment ``a``-``b``."""
    u, v, w = eye - starts, b - a, starts - a
    uu, uv, vv = np.sum(u * u, axis=1), u @ v, v @ v
    uw, vw = np.sum(u * w, axis=1), w @ v
    denominator = np.maximum(uu * vv - uv**2, 1e-12)
    s = np.clip((uv * vw - vv * uw) / denominator, 0, 1)
    t = np.clip((vw + s * uv) / vv, 0, 1)
    s = np.clip((t * uv - uw) / uu, 0, 1)
    return np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)


@lru_cache(maxsize=1)
def demo_cell() -> SimulatedCell:
    """The embedded simulated cell: the six-joint arm, a two-faced body, a stereo rig 1.4 m in front of it."""
    base = np.array([0.0, -1.309, -0.4363, 0.3491, 0.6981, -0.2618])
    # A cell is mounted by hand: nothing is aligned with anything.
    body = roof_body(roll=float(np.deg2rad(-95.0)))
    pose = flange_pose(RX90, base)
    target = pose[:3, 3] + body.marker_points.mean(axis=0) @ pose[:3, :3].T
    eye = target + 1.4 * pose[:3, 2]
    rig = stereo_rig(look_at(eye, target, np.array([0.0, 0.0, 1.0])))
    return SimulatedCell(robot=RX90, body=body, rig=rig, base=base)


DEMO_GOALS: dict[str, FloatArray] = {
    "near": np.array([-0.01, -1.44, -0.16, 1.13, 0.17, -0.79]),
    "roll": np.array([-0.18, -1.44, -0.36, 0.36, 1.07, -2.44]),
    "far": np.array([0.20, -1.52, -0.57, 0.33, 0.61, -1.82]),
}
"""Configurations [rad] worth going to. Both cameras see every marker at them and on the way between any
two of them or the base, along straight lines in joint space and in Cartesian space.

From the base: ``near`` is 29 degrees and 0.12 m away, ``roll`` 132 degrees (nearly about the line of
sight) and 0.13 m, ``far`` 94 degrees and 0.37 m.
"""
