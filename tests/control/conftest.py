"""Virtual cells as independent truth: Euclidean arms and a stereo rig, hidden by a random frame."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.kinematics.kernels import triangulate

PLATE = np.array([[-0.05, -0.05, 0, 1], [0.05, -0.05, 0, 1], [0.05, 0.05, 0, 1], [-0.05, 0.05, 0, 1.0]])
RX90 = ((0, -90, 0.42), (0.40, 0, 0), (0, 90, 0), (0, -90, 0.80), (0, 90, 0), (0, 0, 0.085))
RX90_MIDDLE = np.radians([10.0, -50.0, 120.0, 40.0, 60.0, 20.0])


def pose(rotation, translation):
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = translation
    return T


def screw(axis, point=None):
    """Euclidean generator: rotation about ``axis`` through ``point``, or translation along it."""
    G = np.zeros((4, 4))
    x, y, z = axis
    if point is None:
        G[:3, 3] = axis
    else:
        G[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        G[:3, 3] = -np.cross(axis, point)
    return G


def exponential(G, amount):
    """Rodrigues, or a translation."""
    return np.eye(4) + np.sin(amount) * G + (1 - np.cos(amount)) * G @ G if G[:3, :3].any() else np.eye(4) + amount * G


def dh_screws(rows):
    """Generators (n, 4, 4) at joint angles zero, and the flange's pose there."""
    T, generators = np.eye(4), []
    for a, alpha, d in rows:
        generators.append(screw(T[:3, 2], T[:3, 3]))
        T = T @ pose(Rotation.from_euler("x", alpha, degrees=True), [a, 0, d])
    return np.array(generators), T


@dataclass
class World:
    """An arm with a plate in front of two cameras. Everything Euclidean is truth; the ``frame`` hides it.

    ``generators`` (n, 4, 4) at q = 0 and ``plate`` (4, 4), the plate's pose at q = 0, in rig coordinates [m].
    """

    generators: np.ndarray
    plate: np.ndarray
    frame: np.ndarray
    q: np.ndarray

    def __post_init__(self):
        K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
        eyes = [pose(Rotation.from_euler("y", s * 10, degrees=True), [-s * 0.1, 0, 0]) for s in (1, -1)]
        self.eyes = np.array([eye[:, 3] for eye in eyes])
        self.euclidean = np.array([K @ np.linalg.inv(eye)[:3] for eye in eyes])
        self.matrices = self.euclidean @ np.linalg.inv(self.frame)
        self.infinity = np.linalg.inv(self.frame)[3]
        self.camera_centres = self.eyes @ self.frame.T

    def displacement(self, q):
        H = np.eye(4)
        for angle, G in zip(q, self.generators, strict=True):
            H = H @ exponential(G, angle)
        return H

    def plate_pose(self, q=None):
        return self.displacement(self.q if q is None else q) @ self.plate

    def markers(self, q=None):
        """True marker points (4, 4) in rig coordinates."""
        return PLATE @ self.plate_pose(q).T

    def operators(self, q=None):
        """The joints' operators at ``q`` in the projective frame (n, 4, 4)."""
        H, operators = np.eye(4), []
        for angle, G in zip(self.q if q is None else q, self.generators, strict=True):
            operators.append(H @ G @ np.linalg.inv(H))
            H = H @ exponential(G, angle)
        return self.frame @ np.array(operators) @ np.linalg.inv(self.frame)

    def pixels(self, X):
        """(2, m, 2) of Euclidean points (m, 4)."""
        m = np.einsum("cij,mj->cmi", self.euclidean, X)
        return m[..., :2] / m[..., 2:]

    def triangulated(self, pixels):
        """Points (m, 4) in the projective frame, height 1."""
        M, ok = triangulate(self.matrices, np.ascontiguousarray(pixels), np.ones(pixels.shape[:2]), 3)
        assert ok.all()
        return M / (M @ self.infinity)[:, None]

    def hidden(self, X):
        """Euclidean points (..., 4) of height 1 in the projective frame."""
        return X @ self.frame.T

    def front_facing(self, T):
        """Cosine, per camera, between the printed side's normal and the way to the camera."""
        way = self.eyes[:, :3] - T[:3, 3]
        return -way @ T[:3, 2] / np.linalg.norm(way, axis=1)


def random_frame(rng):
    """A well-conditioned projective frame that keeps the heights of what is in front of the rig positive."""
    while True:
        T = np.eye(4) + 0.35 * rng.normal(size=(4, 4))
        if np.linalg.det(T) > 0.2 and np.linalg.cond(T) < 8:
            return T


def free_arm(rng, T0):
    """Three prismatic and three revolute joints, through the middle of the plate at its start ``T0``."""
    generators = np.array([screw(axis) for axis in np.eye(3)] + [screw(axis, T0[:3, 3]) for axis in np.eye(3)])
    return World(generators, T0, random_frame(rng), np.zeros(6))


def rx90(rng, q=RX90_MIDDLE, T0=None, rows=RX90):
    """The six-revolute arm; the rig stands so that at ``q`` the plate's pose is ``T0``."""
    generators, flange = dh_screws(rows)
    n = len(rows)
    q = np.array(q[:n])
    if T0 is None:
        T0 = pose(Rotation.from_euler("xyz", [20, -15, 40], degrees=True), [0.05, -0.03, 1.1])
    mount = pose(Rotation.from_euler("xz", [25, 10], degrees=True), [0.03, 0.02, 0.1])
    H = np.eye(4)
    for angle, G in zip(q, generators, strict=True):
        H = H @ exponential(G, angle)
    rig_from_base = T0 @ np.linalg.inv(H @ flange @ mount)
    inverse = np.linalg.inv(rig_from_base)
    return World(rig_from_base @ generators @ inverse, rig_from_base @ flange @ mount, random_frame(rng), q)


GRAZING = np.cos(np.radians(75))


def random_task(rng, angle_deg, distance, front=GRAZING):
    """Poses of start and target that both cameras see, ``angle_deg`` and ``distance`` [m] apart."""
    probe = World(np.zeros((0, 4, 4)), np.eye(4), np.eye(4), np.zeros(0))

    def visible(T):
        uv = probe.pixels(PLATE @ T.T)
        inside = (uv > 20).all() and (uv[..., 0] < 620).all() and (uv[..., 1] < 460).all()
        return inside and (probe.front_facing(T) > front).all()

    def direction():
        v = rng.normal(size=3)
        return v / np.linalg.norm(v)

    while True:
        R = Rotation.random(random_state=int(rng.integers(2**31)))
        T_star = pose(R, [rng.uniform(-0.25, 0.25), rng.uniform(-0.2, 0.2), rng.uniform(0.8, 1.4)])
        if not visible(T_star):
            continue
        T0 = pose(
            Rotation.from_rotvec(np.radians(angle_deg) * direction()) * R,
            T_star[:3, 3] + distance * direction(),
        )
        if visible(T0):
            return T0, T_star


@pytest.fixture(scope="session")
def virtual():
    """Builders of virtual cells, by name."""
    return SimpleNamespace(
        free_arm=free_arm,
        rx90=rx90,
        random_task=random_task,
        random_frame=random_frame,
        pose=pose,
        screw=screw,
        World=World,
        PLATE=PLATE,
        RX90=RX90,
        RX90_MIDDLE=RX90_MIDDLE,
    )
