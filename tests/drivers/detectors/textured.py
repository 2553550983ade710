"""Scenes of textured planes in projective cameras, whose every pixel is the image of a known point of a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from stereoservo_sim.experiments.textured import Face, texture


def rotation(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    """Rz Ry Rx (3, 3) of angles [deg]."""
    R = np.eye(3)
    for axis, degrees in ((2, z), (1, y), (0, x)):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        i, j = ((1, 2), (2, 0), (0, 1))[axis]
        turn = np.eye(3)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        R = R @ turn
    return R


def pose(R=None, t=(0.0, 0.0, 0.0)) -> np.ndarray:
    """(4, 4)."""
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if R is None else R
    T[:3, 3] = t
    return T


def box(rng, size, *, side=256, scale=1.6) -> list[Face]:
    """Three faces of a box of ``size`` (3,) about its origin: the front (towards -z) and two beside it."""
    x, y, z = 0.5 * np.asarray(size)
    X, Y, Z = 2 * x * np.eye(3)[0], 2 * y * np.eye(3)[1], 2 * z * np.eye(3)[2]
    corner = np.array([-x, -y, -z])
    return [
        Face(texture(rng, side, scale), corner, X, Y),
        Face(texture(rng, side, scale), corner + X, Z, Y),
        Face(texture(rng, side, scale), corner, X, Z),
    ]


@dataclass
class Camera:
    """``P = K [R | t]`` from the world."""

    K: np.ndarray
    to_camera: np.ndarray
    width: int = 320
    height: int = 240

    @property
    def P(self) -> np.ndarray:
        return self.K @ self.to_camera[:3]


def camera(f=400.0, width=320, height=240, to_camera=None) -> Camera:
    K = np.array([[f, 0.0, 0.5 * width - 0.5], [0.0, f, 0.5 * height - 0.5], [0.0, 0.0, 1.0]])
    return Camera(K, pose() if to_camera is None else to_camera, width, height)


def stereo(baseline=0.12, vergence=7.0, **settings) -> dict[str, Camera]:
    """Two cameras beside each other that look at about (0, 0, 1)."""
    return {
        "left": camera(to_camera=pose(rotation(y=-vergence / 2), (baseline / 2, 0, 0)), **settings),
        "right": camera(to_camera=pose(rotation(y=vergence / 2), (-baseline / 2, 0, 0)), **settings),
    }


def plane_map(face: Face, body: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Homography (3, 3) from texels of a face, in a body at ``body`` (4, 4), to pixels of ``P`` (3, 4)."""
    side = face.grey.shape[0]
    columns = np.column_stack([face.across / (side - 1), face.down / (side - 1), face.origin])
    return P @ body @ np.vstack([columns, [0.0, 0.0, 1.0]])


@dataclass
class Scene:
    """Bodies, each a list of faces; nearer ones hide those behind by the depth of each pixel."""

    bodies: list[list[Face]]

    def render(self, camera: Camera, poses, rng=None, noise=0.0, gain=1.0, offset=0.0) -> np.ndarray:
        """Image (h, w) with the bodies at ``poses`` (4, 4) each."""
        image, _ = self.layers(camera, poses)
        image = gain * image + offset
        if noise:
            image = image + rng.normal(0.0, noise, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def layers(self, camera: Camera, poses) -> tuple[np.ndarray, np.ndarray]:
        """Grey levels (h, w) and which face (body, face, -1 for none) is seen (h, w, 2)."""
        shape = (camera.height, camera.width)
        image, nearest = np.full(shape, 60.0), np.full(shape, np.inf)
        owner = np.full((*shape, 2), -1)
        v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
        rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
        for b, (faces, body) in enumerate(zip(self.bodies, poses, strict=True)):
            for f, face in enumerate(faces):
                H = plane_map(face, body, camera.P)
                texel = np.linalg.inv(H) @ rays
                depth = 1.0 / texel[2]  # of the scaled ray: that of the camera, since K's last row is (0, 0, 1)
                x, y = texel[:2] / texel[2]
                side = face.grey.shape[0]
                seen = (x >= 0) & (y >= 0) & (x <= side - 1) & (y <= side - 1) & (depth > 0)
                seen &= depth < nearest.ravel()
                at = np.flatnonzero(seen)
                grey = map_coordinates(face.grey, [y[at], x[at]], order=3, mode="nearest", prefilter=True)
                image.ravel()[at], nearest.ravel()[at] = grey, depth[at]
                owner.reshape(-1, 2)[at] = b, f
        return image, owner

    def follow(self, camera: Camera, pixels, before, after, to_camera: Camera | None = None) -> np.ndarray:
        """Where the points seen at ``pixels`` (n, 2) with the bodies at ``before`` are ``after``; NaN: on none."""
        to_camera = camera if to_camera is None else to_camera
        _, owner = self.layers(camera, before)
        result = np.full((len(pixels), 2), np.nan)
        for k, pixel in enumerate(pixels):
            if not np.isfinite(pixel).all():
                continue
            b, f = owner[int(np.rint(pixel[1])), int(np.rint(pixel[0]))]
            if b < 0:
                continue
            face = self.bodies[b][f]
            H = plane_map(face, after[b], to_camera.P) @ np.linalg.inv(plane_map(face, before[b], camera.P))
            mapped = H @ np.array([*pixel, 1.0])
            result[k] = mapped[:2] / mapped[2]
        return result
