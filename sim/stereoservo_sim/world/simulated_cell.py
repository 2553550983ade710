"""Ground truth of the simulated cell: arm, marker body and cameras in one world, and noise-free marker images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from stereoservo.messages.cell_file import Mount
from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo_sim.world.body import LIGHT, MarkerBody, roof_body, wedge
from stereoservo_sim.world.camera_rig import PinholeCamera, StereoRig, inverse_pose, look_at, stereo_rig
from stereoservo_sim.world.robots import RX90, Robot, flange_pose, shape_segments
from stereoservo_sim.world.synthetic import rotation, translation
from stereoservo_sim.world.workpiece import Moved, Workpiece, plate_body

MAX_INCIDENCE = float(np.deg2rad(72.0))
"""Angle between line of sight and face normal beyond which a dot counts as not measurable."""


@dataclass(frozen=True, eq=False)
class SimulatedCell:
    """Arm, body, cameras; ``base`` (n,) [rad] is the configuration around which the cell is laid out.

    Eye-to-hand: the body is on the flange and the rig is fixed in the world. Eye-in-hand: ``stand`` (4, 4) is the
    body's fixed pose in the world, and the flange carries the rig, which is given in its frame. ``workpiece``: a second
    marked object beside the body, if any.
    """

    robot: Robot
    body: MarkerBody
    rig: StereoRig
    base: FloatArray
    stand: FloatArray | None = None
    workpiece: Workpiece | None = None

    def camera(self, view: str, k1: float = 0.0, moved: Moved | None = None) -> PinholeCamera:
        """The camera ``view`` of the rig with a lens of ``k1``, moved in its own frame. Raises KeyError, ValueError."""
        camera = replace(self.rig.camera(view), k1=k1)
        return camera if moved is None else camera.moved_by(moved.matrix)

    def flange(self, q: FloatArray) -> FloatArray:
        """Pose of the flange in the world at ``q`` (n,), (4, 4)."""
        return flange_pose(self.robot, q)

    def body_pose(self, q: FloatArray) -> FloatArray:
        """Pose of the body in the world at ``q`` (n,), (4, 4)."""
        return self.flange(q) if self.stand is None else self.stand

    def in_world(self, camera: PinholeCamera, q: FloatArray) -> PinholeCamera:
        """A camera of the rig at its pose in the world at ``q`` (n,)."""
        return camera if self.stand is None else camera.moved(self.flange(q))

    def marker_positions(self, q: FloatArray) -> FloatArray:
        """Markers in the world at ``q`` (n,), (m, 3) [m], rows in the order of ``body.ids``."""
        pose = self.body_pose(q)
        return self.body.marker_points @ pose[:3, :3].T + pose[:3, 3]

    def marker_positions_rig(self, q: FloatArray) -> FloatArray:
        """Markers in the rig's frame at ``q`` (n,), (m, 3) [m], for errors in millimetres."""
        frame = self.rig.world_to_rig
        if self.stand is not None:
            frame = frame @ inverse_pose(self.flange(q))
        return self.marker_positions(q) @ frame[:3, :3].T + frame[:3, 3]

    def truth_pixels(self, q: FloatArray) -> dict[str, FloatArray]:
        """Noise-free raw pixels of all marker centres at ``q`` (n,), visible or not: camera name -> (m, 2)."""
        points = self.marker_positions(q)
        return {camera.name: self.in_world(camera, q).image_of(points)[0] for camera in self.rig.cameras}

    def visible(self, q: FloatArray, camera: PinholeCamera, *, max_incidence: float = MAX_INCIDENCE) -> BoolArray:
        """Mask (m,) of the markers that ``camera`` of the rig sees at ``q`` (n,): those of :meth:`turned_to` that no
        link occludes.
        """
        camera = self.in_world(camera, q)
        seen = self.turned_to(self.body_pose(q), camera, max_incidence=max_incidence)
        points = self.marker_positions(q)
        return seen & ~self._behind_arm(q, points, camera.centre)

    def turned_to(self, pose: FloatArray, camera: PinholeCamera, *, max_incidence: float = MAX_INCIDENCE) -> BoolArray:
        """Mask (m,) of the body's markers with their whole dot in the image and their face turned to ``camera``.

        ``pose`` (4, 4) of the body in the camera's frame of reference; the arm need not be able to reach it.
        """
        return turned_to(self.body, pose, camera, max_incidence=max_incidence)

    def workpiece_visible(
        self, q: FloatArray, pose: FloatArray, camera: PinholeCamera, *, max_incidence: float = MAX_INCIDENCE
    ) -> BoolArray:
        """Mask (m,) of the workpiece's markers that ``camera`` of the rig sees, with the workpiece at ``pose`` (4, 4)
        in the
        world; as :meth:`visible`. Occlusion by the body is not checked. Raises ValueError if there is no workpiece.
        """
        if self.workpiece is None:
            raise ValueError("this cell has no workpiece")
        camera = self.in_world(camera, q)
        points = self.workpiece.marker_positions(pose)
        seen = turned_to(self.workpiece.body, pose, camera, max_incidence=max_incidence)
        return seen & ~self._behind_arm(q, points, camera.centre)

    def _behind_arm(self, q: FloatArray, points: FloatArray, eye: FloatArray) -> BoolArray:
        ends, radii = shape_segments(self.robot, q)
        hidden = np.zeros(len(points), dtype=np.bool_)
        for (start, end), radius in zip(ends, radii, strict=True):
            # Start slightly in front of the dot: the mount behind the plate does not occlude it.
            hidden |= _segment_distance(points + 0.02 * (eye - points), eye, start, end) < radius
        return hidden


def turned_to(
    body: MarkerBody, pose: FloatArray, camera: PinholeCamera, *, max_incidence: float = MAX_INCIDENCE
) -> BoolArray:
    """Mask (m,) of the markers of ``body`` at ``pose`` (4, 4) with their whole dot in the image and their face turned
    to ``camera``.
    """
    points = body.marker_points @ pose[:3, :3].T + pose[:3, 3]
    normals = body.marker_normals @ pose[:3, :3].T
    pixels, depths = camera.image_of(points)
    sight = camera.centre - points
    distances = np.linalg.norm(sight, axis=1)
    turned = np.sum(sight * normals, axis=1) > np.cos(max_incidence) * distances
    stretch = 1.0 + 3.0 * max(camera.k1, 0.0) * (distances / np.maximum(depths, 1e-6)) ** 2
    border = stretch * camera.K[0, 0] * body.marker_radii / np.maximum(depths, 1e-6) + 2.0
    inside = (
        (depths > 0.05)
        & np.all(pixels >= border[:, None], axis=1)
        & np.all(pixels <= np.array([camera.width - 1, camera.height - 1]) - border[:, None], axis=1)
    )
    return np.asarray(turned & inside, dtype=np.bool_)


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


@lru_cache(maxsize=8)
def solid_cell(light: tuple[float, float, float] = LIGHT) -> SimulatedCell:
    """The embedded cell with a solid without markers on its flange, and the direction of its ``light``."""
    return replace(demo_cell(), body=replace(wedge(), light=np.array(light)))


@lru_cache(maxsize=1)
def workpiece_cell() -> SimulatedCell:
    """The same cell with a workpiece nearer to the cameras, at the upper left of both images. It does not occlude the
    body on any path between the base and DEMO_GOALS, nor at any calibration stop.
    """
    cell = demo_cell()
    rig_to_workpiece = translation(-0.223, -0.155, 1.0) @ rotation("y", 12.0) @ rotation("z", 7.0)
    return replace(cell, workpiece=Workpiece(plate_body(), inverse_pose(cell.rig.world_to_rig) @ rig_to_workpiece))


@lru_cache(maxsize=1)
def hand_cell() -> SimulatedCell:
    """The same arm with the stereo rig on its flange, before the same body, which is fixed 0.85 m away."""
    base = demo_cell().base
    body = roof_body()
    flange_to_rig = translation(0.03, -0.02, 0.07) @ rotation("z", 8.0) @ rotation("x", -2.0)
    rig = stereo_rig(
        inverse_pose(flange_to_rig), baseline=0.16, vergence=2 * float(np.arctan(0.08 / 0.85)), focal=500.0
    )
    facing = rotation("y", 6.0) @ rotation("x", 180.0) @ rotation("z", -85.0)
    ahead = translation(0.0, 0.0, 0.85) @ facing @ translation(*-body.marker_points.mean(axis=0))
    stand = flange_pose(RX90, base) @ flange_to_rig @ ahead
    return SimulatedCell(robot=RX90, body=body, rig=rig, base=base, stand=stand)


DEMO_GOALS: dict[str, FloatArray] = {
    "near": np.array([-0.01, -1.44, -0.16, 1.13, 0.17, -0.79]),
    "roll": np.array([-0.192416, -1.27605, -0.515402, 0.079712, 0.702957, 3.181643]),
    "far": np.array([0.20, -1.52, -0.57, 0.33, 0.61, -1.82]),
}
"""Goal configurations [rad]. Both cameras see every marker at them and on the path between any two of them or the
base, along straight lines in joint space and in Cartesian space.

From the base: ``near`` is 29 degrees and 0.12 m away, ``roll`` 180 degrees about the line of
sight and 0.14 m, ``far`` 94 degrees and 0.37 m.
"""

HAND_GOALS: dict[str, FloatArray] = {
    "near": np.array([0.24, -1.18, -0.45, 1.05, 0.61, -1.47]),
    "roll": np.array([-0.111708, -1.3627, -0.281001, 0.358958, 0.572148, 2.901605]),
    "far": np.array([0.37, -1.41, -0.39, 0.52, 1.19, -1.96]),
}
"""The same for :func:`hand_cell`: seen by the carried rig, the body rotates by 33, 180 and 82 degrees and moves by
0.18, 0.14 and 0.39 m.
"""


def simulated_cell(mount: Mount) -> SimulatedCell:
    """The embedded cell with cameras on the given mount."""
    return hand_cell() if mount == "eye_in_hand" else demo_cell()
