"""A Euclidean cell as independent truth: Denavit-Hartenberg arms, pinhole cameras, trial motions with
noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from stereoservo.kinematics.calibration.trials import TrialCamera, TrialData

RX90 = ((0, -90, 0.42), (0.40, 0, 0), (0, 90, 0), (0, -90, 0.80), (0, 90, 0), (0, 0, 0.085))


def translation(x, y, z):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def rotation(axis, degrees):
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.eye(4)
    T[i, i], T[i, j], T[j, i], T[j, j] = c, -s, s, c
    return T


@dataclass(frozen=True)
class Cell:
    """Arm as (kind, fixed transform after the joint about or along its z) links, in the rig's frame."""

    base: np.ndarray
    kinds: tuple
    links: tuple
    body: np.ndarray  # (m, 3) in the flange frame
    intrinsics: np.ndarray  # (c, 3, 3)
    poses: np.ndarray  # (c, 4, 4) rig -> camera
    home: np.ndarray
    ranges: np.ndarray

    def flange(self, q):
        T = self.base
        for kind, link, value in zip(self.kinds, self.links, q, strict=True):
            joint = rotation("z", np.degrees(value)) if kind == "revolute" else translation(0, 0, value)
            T = T @ joint @ link
        return T

    def axes(self, q):
        """Joint axes at q in the rig's frame: points (n, 3) and directions (n, 3)."""
        T, points, directions = self.base, [], []
        for kind, link, value in zip(self.kinds, self.links, q, strict=True):
            points.append(T[:3, 3])
            directions.append(T[:3, 2])
            joint = rotation("z", np.degrees(value)) if kind == "revolute" else translation(0, 0, value)
            T = T @ joint @ link
        return np.array(points), np.array(directions)

    def pixels(self, positions):
        """Exact pixels (c, s, m, 2)."""
        body = np.hstack([self.body, np.ones((len(self.body), 1))])
        world = np.array([body @ self.flange(q).T for q in positions])
        seen = np.einsum("cij,cjk,smk->csmi", self.intrinsics, self.poses[:, :3], world)
        assert (seen[..., 2] > 0.1).all()
        return seen[..., :2] / seen[..., 2:]

    def stops(self, count):
        positions, trials = [], []
        for j in range(len(self.kinds)):
            for value in np.linspace(-1, 1, count):
                q = self.home.copy()
                q[j] += value * self.ranges[j]
                positions.append(q)
                trials.append(j)
        return np.array(positions), np.array(trials)

    def held_out(self, rng, count, share=0.7):
        return self.home + rng.uniform(-share, share, (count, len(self.home))) * self.ranges

    def trials(self, sigma, rng, stops=9, positions=None, stated=None):
        if positions is None:
            positions, trials = self.stops(stops)
        else:
            positions, trials = positions
        exact = self.pixels(positions)
        return TrialData(
            joint_names=tuple(f"j{j + 1}" for j in range(len(self.kinds))),
            joint_kinds=self.kinds,
            cameras=tuple(TrialCamera(f"cam{c}", 640, 480) for c in range(len(self.poses))),
            marker_ids=tuple(range(10, 10 + len(self.body))),
            positions=positions,
            trials=trials,
            pixels=exact + rng.normal(0, sigma, exact.shape),
            sigmas=np.full(exact.shape[:3], stated or sigma),
            images=5 * len(positions) * len(self.poses),
        )

    def with_body(self, body):
        return replace(self, body=np.asarray(body, dtype=float))


def two_faces():
    """14 dots on two faces of a body, 7 each, about 12 cm across."""
    face = np.array([(-45, -30), (0, -32), (45, -28), (-48, 5), (10, 0), (-40, 34), (42, 30)]) / 1000
    front = np.hstack([face, np.full((7, 1), 0.05)])
    side = front @ rotation("y", 50)[:3, :3].T + np.array([0.07, 0.0, -0.02])
    return np.vstack([front, side])


PLATE = np.array([(-50, -50, 20), (50, -48, 20), (47, 50, 20), (-49, 45, 20)]) / 1000


def stereo_rig(count=2):
    """Cameras of fx = 800, 640x480, baseline 20 cm, vergence 20°, looking along z; a third one from above."""
    K = np.array([[800, 0, 322.0], [0, 795, 238.5], [0, 0, 1]])
    K2 = np.array([[812, 0, 315.0], [0, 806, 243.0], [0, 0, 1]])
    poses = [
        rotation("y", -10) @ translation(0.1, 0, 0),
        rotation("y", 10) @ translation(-0.1, 0, 0),
        rotation("x", -12) @ translation(0, -0.25, 0.05),
    ]
    return np.array([K, K2, K][:count]), np.array(poses[:count])


def placed(kinds, links, body, home, ranges, facing, cameras=2, distance=1.3):
    """The cell with the body's middle ``distance`` in front of the rig at home, its flange turned by
    ``facing``.
    """
    K, poses = stereo_rig(cameras)
    home, ranges = np.asarray(home, dtype=float), np.asarray(ranges, dtype=float)
    cell = Cell(np.eye(4), tuple(kinds), tuple(links), body, K, poses, home, ranges)
    middle = np.eye(4)
    middle[:3, 3] = body.mean(axis=0)
    base = translation(0, 0, distance) @ facing @ np.linalg.inv(cell.flange(home) @ middle)
    return replace(cell, base=base)


def rx90(body=None, cameras=2, distance=1.3):
    links = [translation(0, 0, d) @ translation(a, 0, 0) @ rotation("x", alpha) for a, alpha, d in RX90]
    home = np.radians([10, -60, 120, 20, 40, 15])
    ranges = np.radians([15, 15, 15, 30, 30, 40])
    facing = rotation("x", 180) @ rotation("y", 15) @ rotation("x", 10)
    return placed(
        ["revolute"] * 6,
        links,
        two_faces() if body is None else body,
        home,
        ranges,
        facing,
        cameras,
        distance,
    )


def gantry():
    """Three prismatic joints along x, y, z."""
    links = [rotation("x", -90), rotation("y", 90), np.eye(4)]
    facing = rotation("x", 160) @ rotation("y", 20)
    return placed(["prismatic"] * 3, links, two_faces(), np.zeros(3), [0.2, 0.15, 0.2], facing)


def scara(body=None):
    """R, R, P, R with all axes parallel."""
    links = [translation(0.35, 0, 0.2), translation(0.3, 0, 0), np.eye(4), translation(0, 0, 0.03)]
    ranges = [*np.radians([15, 20]), 0.1, np.radians(40)]
    facing = rotation("x", 150) @ rotation("y", 25)
    return placed(
        ["revolute", "revolute", "prismatic", "revolute"],
        links,
        two_faces() if body is None else body,
        [0.3, 0.5, 0, 0.2],
        ranges,
        facing,
    )


def mixed():
    """A linear axis under a wrist: P, R, R, R with different directions."""
    links = [
        rotation("x", 90),
        translation(0.2, 0, 0) @ rotation("x", 90),
        translation(0.1, 0, 0.1) @ rotation("x", -70),
        translation(0, 0, 0.1),
    ]
    ranges = [0.15, *np.radians([25, 30, 35])]
    facing = rotation("x", 170) @ rotation("y", 20)
    return placed(
        ["prismatic", "revolute", "revolute", "revolute"],
        links,
        two_faces(),
        [0, 0.3, 0.4, 0.2],
        ranges,
        facing,
    )


def parallel(body=None):
    """Three parallel revolute axes: no plane at infinity."""
    links = [translation(0.3, 0, 0), translation(0.25, 0, 0), translation(0.05, 0, 0)]
    facing = rotation("x", 150) @ rotation("y", 25)
    return placed(
        ["revolute"] * 3,
        links,
        two_faces() if body is None else body,
        [0.3, 0.5, 0.2],
        np.radians([18, 22, 40]),
        facing,
    )


ARMS = {"rx90": rx90, "gantry": gantry, "scara": scara, "mixed": mixed, "parallel": parallel}


@pytest.fixture(scope="session")
def arms():
    """Makers of cells by name."""
    return ARMS


@pytest.fixture(scope="session")
def plate():
    """Four dots of a plane."""
    return PLATE
