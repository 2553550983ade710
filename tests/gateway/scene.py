"""A Euclidean scene as independent truth: a hand with markers and a tool, a workpiece, two cameras with lenses, and
models that see all of it through a random projective frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.core.cycle import Event, Sample
from stereoservo.daemon.taught_goals import taught_goal
from stereoservo.gateway.observation_cache import MarkerObservation
from stereoservo.geometry.displacements import exp_rotation
from stereoservo.geometry.distortion import distort
from stereoservo.geometry.strata import euclidean_to_projective
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel

WIDTH, HEIGHT = 640, 480
DISTANCE = 0.9
BODY = {
    0: (-0.05, -0.05, 0.0), 1: (0.05, -0.05, 0.0), 2: (0.05, 0.05, 0.01), 3: (-0.05, 0.05, 0.0),
    4: (0.0, 0.0, -0.05), 5: (0.02, -0.03, 0.04),
}  # fmt: skip
WORK = {
    10: (-0.08, -0.06, 0.0), 11: (0.09, -0.07, 0.02), 12: (0.07, 0.08, -0.02), 13: (-0.06, 0.07, 0.0),
    14: (0.0, 0.02, 0.08), 15: (0.01, -0.03, -0.07),
}  # fmt: skip
TOOL = {
    20: (-0.02, 0.0, 0.06), 21: (0.05, 0.01, 0.08), 22: (0.0, 0.06, 0.09), 23: (0.03, -0.05, 0.12),
    24: (-0.04, -0.04, 0.03),
}  # fmt: skip
AXES = np.array([(0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=float)
FEET = np.array([(-0.5, 0, 0.9), (-0.4, 0, 0.9), (-0.2, 0, 0.8), (-0.1, 0.1, 0.9), (-0.1, 0, 0.9), (0, 0, 0.9)])


def pose(turn, move):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = move
    return T


def some_pose(rng, turn=0.4, move=0.05):
    return pose(rng.uniform(-turn, turn, 3), rng.uniform(-move, move, 3) + np.array([0, 0, DISTANCE]))


def placed(points, T):
    """Marker -> (4,) in the world."""
    return {marker: T @ np.append(x, 1.0) for marker, x in points.items()}


def twist(axis, foot):
    G = np.zeros((4, 4))
    x, y, z = axis
    G[:3, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
    G[:3, 3] = -np.cross(axis, foot)
    return G


def arm(q):
    """The hand's displacement from its zero, in the world."""
    H = np.eye(4)
    for axis, foot, angle in zip(AXES, FEET, q, strict=True):
        H = H @ exp_rotation(twist(axis, foot), angle)
    return H


@dataclass
class Cameras:
    """Two cameras of the world by name; the world's origin is near the first."""

    focal: float = 800.0
    names: tuple[str, str] = ("left", "right")
    looks: np.ndarray = field(default_factory=lambda: np.eye(4))
    bend: float = -0.08

    @property
    def lens(self):
        return np.array([self.bend, 322.0, 238.0, 320.0])

    @property
    def Ps(self):
        K = np.array([[self.focal, 0, 319.5], [0, self.focal, 239.5], [0, 0, 1.0]])
        angle = -np.arctan(0.24 / DISTANCE)
        right = pose([0.02, -angle, 0.03], [0, 0, 0]) @ pose([0, 0, 0], [-0.24, 0.01, 0.0])
        return np.array([(K @ np.eye(3, 4)) @ self.looks, (K @ np.eye(3, 4)) @ right @ self.looks])

    def pixels(self, points):
        """Camera -> marker -> raw pixel, exact."""
        seen = {}
        for name, P in zip(self.names, self.Ps, strict=True):
            seen[name] = {}
            for marker, X in points.items():
                m = P @ X
                seen[name][marker] = distort(self.lens, m[:2] / m[2])
        return seen

    def sights(self, points, rng, sigma=0.05, moves=()):
        """What a gateway would hold of them."""
        return {
            name: {
                marker: MarkerObservation(
                    tuple((u + sigma * rng.normal(size=2)).tolist()), max(sigma, 1e-6), marker in moves
                )
                for marker, u in seen.items()
            }
            for name, seen in self.pixels(points).items()
        }  # fmt: skip


def make_model(rng, cameras, body, epoch=1, stratum="metric", mount="eye_to_hand"):
    """A model of the arm whose ``body`` (marker -> world point at joints zero) it carries, in a random frame."""
    K = np.array([[320 / cameras.focal, 0, 0], [0, 320 / cameras.focal, 0], [0, 0, 1.0]])
    infinity = np.append(rng.uniform(-0.1, 0.1, 3), rng.uniform(0.5, 2.0))
    frame = euclidean_to_projective(infinity, np.linalg.inv(K)) @ cameras.looks
    plane = np.linalg.inv(frame)[3]
    upgrade = np.diag([*[rng.uniform(0.5, 2)] * 3, 1.0]) @ pose(rng.uniform(-2, 2, 3), rng.normal(size=3))
    twists = np.array([twist(axis, foot) for axis, foot in zip(AXES, FEET, strict=True)])
    return CellModel(
        schema=MODEL_SCHEMA,
        epoch=epoch,
        joint_names=tuple(f"j{k}" for k in range(1, 7)),
        joint_kinds=("revolute",) * 6,
        zero=np.zeros(6),
        generators=frame @ twists @ np.linalg.inv(frame),
        cameras=tuple(
            CameraModel(name, P @ np.linalg.inv(frame), WIDTH, HEIGHT, cameras.lens)
            for name, P in zip(cameras.names, cameras.Ps, strict=True)
        ),
        marker_ids=tuple(body),
        marker_points=np.array([frame @ X for X in body.values()]),
        plane_at_infinity=plane,
        stratum=stratum,
        projective_to_euclidean=upgrade @ np.linalg.inv(frame) if stratum == "metric" else None,
        statistics=None,
        mount=mount,
    )


def teach(model, cameras, points, rng, sigma=0.05, joints=None, tool=()):
    """A goal shown as the points stand."""
    samples = tuple(
        Sample(
            name,
            np.array(list(seen)),
            np.array([u + sigma * rng.normal(size=2) for u in seen.values()]),
            np.tile(max(sigma, 1e-6) ** 2 * np.eye(2), (len(seen), 1, 1)),
            20,
            np.full(len(seen), 20.0),
            np.zeros(len(seen)),
        )
        for name, seen in cameras.pixels(points).items()
    )
    event = Event(1, 1, "taught", name="pick", joints=joints, samples=samples)
    return taught_goal(event, model, "2026", tool)
