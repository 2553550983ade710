"""Marker bodies of several faces before the virtual rig: Euclidean truth, and what the loop would know of it."""

import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.control.faces import find_faces
from stereoservo.control.law import Scene, Task

SIGMA = 0.1
DOTS = np.array([[-0.04, -0.04], [0.04, -0.035], [0.038, 0.04], [-0.036, 0.03]])


def box(turns, half=0.06):
    """Markers (4 f, 4) and outward normals (4 f, 3) of faces whose normals are -z turned about y by ``turns`` [°]."""
    front = np.column_stack([DOTS, np.full(4, -half)])
    points, normals = [], []
    for turn in turns:
        R = Rotation.from_euler("y", turn, degrees=True).as_matrix()
        points.append(front @ R.T)
        normals.append(np.tile(R @ [0, 0, -1.0], (4, 1)))
    X = np.concatenate(points)
    return np.column_stack([X, np.ones(len(X))]), np.concatenate(normals)


class Body:
    """Markers on faces in front of the virtual rig; a marker is seen where its face fronts the camera."""

    def __init__(self, virtual, rng, turns, T0):
        self.world = virtual.free_arm(rng, T0)
        self.markers, self.normals = box(turns)

    def at(self, T):
        return self.markers @ T.T

    def seen(self, T, least=0.15):
        """(2, m): cosine between outward normal and the way to the camera above ``least``."""
        X, n = self.at(T)[:, :3], self.normals @ T[:3, :3].T
        way = self.world.eyes[:, None, :3] - X[None]
        way = way / np.linalg.norm(way, axis=-1, keepdims=True)
        return ((way * n[None]).sum(axis=-1) > least).astype(float)

    def pixels(self, T):
        return self.world.pixels(self.at(T))

    def find(self, T, noise=0.0, rng=None, sigma=SIGMA):
        """Faces of the body as calibration would know it, looking at ``T``."""
        pixels = self.pixels(T)
        if noise:
            pixels = pixels + noise * rng.normal(size=pixels.shape)
        points = self.world.triangulated(pixels)
        return find_faces(
            points,
            self.world.matrices,
            sigma,
            self.world.camera_centres,
            self.seen(T),
            self.world.operators(),
        )


def six_faces(virtual, rng, T0):
    """A box with four dots on each of its sides."""
    body = Body(virtual, rng, (0, 90, 180, 270), T0)
    X, n = body.markers[:4, :3], body.normals[:4]
    for turn in (90, -90):
        R = Rotation.from_euler("x", turn, degrees=True).as_matrix()
        body.markers = np.concatenate([body.markers, np.column_stack([X @ R.T, np.ones(4)])])
        body.normals = np.concatenate([body.normals, n @ R.T])
    return body


def upright(virtual, turn=0.0, tilt=10.0, at=(0.0, 0.0, 1.0)):
    return virtual.pose(Rotation.from_euler("yx", [turn, tilt], degrees=True), at)


def outward_is_right(body, faces, T):
    """Whether every triple's minors are positive before the face's front, by the Euclidean truth."""
    X = body.at(T)
    for triple, members in zip(faces.triples, faces.markers(), strict=True):
        normal = T[:3, :3] @ body.normals[members[0]]
        eye = np.append(X[members[0], :3] + 0.5 * normal, 1.0)
        if not np.linalg.det(np.stack([*X[triple], eye])) > 0:
            return False
    return True


def corner(virtual, rng, turn, gap):
    """Two plates that meet in an edge: bent away from the cameras (turn > 0), or towards them. ``gap`` from it [m]."""
    T = upright(virtual, 0.5 * turn)
    body = Body(virtual, rng, (0,), T)
    R = Rotation.from_euler("y", -turn, degrees=True).as_matrix()
    second = (body.markers[:, :3] + [0.04 + gap, 0, 0.06]) @ R.T + [0.04 + gap, 0, -0.06]
    body.markers = np.concatenate([body.markers, np.column_stack([second, np.ones(4)])])
    body.normals = np.concatenate([body.normals, np.tile(R @ [0, 0, -1.0], (4, 1))])
    return body, T


def scene_of(body, T, rng=None, noise=0.0, only_visible=True):
    """What the loop knows at the pose ``T``; markers that two cameras do not see have no point."""
    world, weights = body.world, body.seen(T) / SIGMA
    pixels = body.pixels(T)
    if noise:
        pixels = pixels + noise * rng.normal(size=pixels.shape)
    points = np.full((len(body.markers), 4), np.nan)
    both = (weights > 0).all(axis=0)
    if both.any():
        points[both] = world.triangulated(pixels[:, both])
    if not only_visible:
        points = world.hidden(body.at(T))
    return Scene(world.operators(), 0, world.matrices, world.camera_centres, points, pixels, weights)


def task_of(body, T_star):
    world, m = body.world, len(body.markers)
    return Task(
        set_points=body.pixels(T_star), wanted=body.seen(T_star), rates=np.zeros((2, m, 2)),
        target_points=world.hidden(body.at(T_star)), target_known=np.ones(m), centre=np.zeros(4),
        centre_target=np.zeros(4), face=np.zeros(3, np.int64),
    )  # fmt: skip


def many_plates(virtual, rng, count, T0):
    """Plates of four dots each, tangent to a sphere, evenly around it."""
    body = Body(virtual, rng, (0,), T0)
    radius = 0.09 * np.sqrt(count / 6.0)
    points, normals = [], []
    for k in range(count):
        height = 1.0 - 2.0 * (k + 0.5) / count
        turn = np.pi * (3.0 - np.sqrt(5.0)) * k
        out = np.array([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height])
        R = Rotation.align_vectors([out], [[0, 0, -1.0]])[0].as_matrix()
        R = R @ Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        dots = 0.7 * DOTS + rng.uniform(-0.004, 0.004, DOTS.shape)
        points.append(np.column_stack([dots, np.full(4, -radius)]) @ R.T)
        normals.append(np.tile(out, (4, 1)))
    X = np.concatenate(points)
    body.markers, body.normals = np.column_stack([X, np.ones(len(X))]), np.concatenate(normals)
    return body
