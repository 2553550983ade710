"""Joint axes of a calibrated model as directions and points in its Euclidean (or affine) frame, with their angles and
common normals; camera centres and intrinsics in that frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.strata import projective_to_affine, upper_triangular
from stereoservo.kinematics.model import CellModel, Stratum
from stereoservo.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class FramedModel:
    """A model's parts in a frame of its stratum (projective, affine or Euclidean).

    Metric: Euclidean up to scale, the left camera ``K [I | 0]``. Affine: infinity is (0, 0, 0, 1). Projective: any.
    ``generators`` (n, 4, 4): motions of the markers at the zero, base first, with the signs of an arm that carries the
    markers (those of an eye-in-hand model are negated); ``zero`` (n,); ``cameras`` (c, 3, 4) to ideal pixels;
    ``lenses`` (c, 4); ``points`` (m, 4), height 1.
    """

    kinds: tuple[str, ...]
    generators: FloatArray
    zero: FloatArray
    cameras: FloatArray
    lenses: FloatArray
    points: FloatArray


def framed_model(model: CellModel) -> FramedModel:
    """Transform the parts of ``model`` into the frame of its stratum."""
    frame = stratum_frame(model.stratum, model.plane_at_infinity, model.projective_to_euclidean)
    back = np.asarray(np.linalg.inv(frame), dtype=np.float64)
    points = model.marker_points @ frame.T
    sense = -1.0 if model.tip_first else 1.0
    return FramedModel(
        model.joint_kinds,
        sense * (frame @ model.generators @ back),
        model.zero,
        np.array([camera.matrix for camera in model.cameras]) @ back,
        np.array([camera.lens for camera in model.cameras]),
        points if model.stratum == "projective" else points / points[:, 3:],
    )


def stratum_frame(stratum: Stratum, plane: FloatArray, to_euclidean: FloatArray | None) -> FloatArray:
    """Homography (4, 4) from the model's projective frame into one of its stratum."""
    if stratum == "metric" and to_euclidean is not None:
        return to_euclidean
    return projective_to_affine(plane) if stratum == "affine" else np.eye(4)


@dataclass(frozen=True, eq=False)
class Axes:
    """Axes of a rigid mechanism at the zero: unit ``directions`` (n, 3) of positive motion, ``points`` (n, 3).

    Prismatic joints have a direction only: their points are NaN. ``scales`` (n,): length in units of the frame for one
    unit of a prismatic joint; NaN for revolute ones.
    """

    kinds: tuple[str, ...]
    directions: FloatArray
    points: FloatArray
    scales: FloatArray


def joint_axes(kinds: tuple[str, ...], generators: FloatArray) -> Axes:
    """Axes of twists (n, 4, 4) in a Euclidean frame: ``[w]ₓ`` and ``-w × c`` (2.43), or ``(0, τ)`` (3.1).

    The point of a revolute axis is the one nearest to the frame's origin.
    """
    n = len(kinds)
    directions, points, scales = np.empty((n, 3)), np.full((n, 3), np.nan), np.full(n, np.nan)
    for j, (kind, G) in enumerate(zip(kinds, generators, strict=True)):
        if kind == "revolute":
            rotation_vector = 0.5 * np.array([G[2, 1] - G[1, 2], G[0, 2] - G[2, 0], G[1, 0] - G[0, 1]])
            size = float(np.linalg.norm(rotation_vector))
            directions[j] = rotation_vector / size
            points[j] = np.cross(directions[j], G[:3, 3]) / size
        else:
            scales[j] = np.linalg.norm(G[:3, 3])
            directions[j] = G[:3, 3] / scales[j]
    return Axes(kinds, directions, points, scales)


def unit(v: FloatArray) -> FloatArray:
    """Normalised ``v`` (3,)."""
    result: FloatArray = v / np.linalg.norm(v)
    return result


def axis_angle(u: FloatArray, v: FloatArray) -> float:
    """Angle [rad] in [0, π] between directions (3,); accurate near 0 and π."""
    return float(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))


def common_normal(c1: FloatArray, u1: FloatArray, c2: FloatArray, u2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Feet (3,), (3,) of the common normal on two lines that are not parallel."""
    normal = np.cross(u1, u2)
    square = float(normal @ normal)
    between = c2 - c1
    foot1 = c1 + u1 * (np.cross(between, u2) @ normal / square)
    foot2 = c2 + u2 * (np.cross(between, u1) @ normal / square)
    return foot1, foot2


def euclidean_centres(cameras: FloatArray) -> FloatArray:
    """Centres (c, 3) of finite cameras (c, 3, 4)."""
    return np.asarray(-np.linalg.solve(cameras[:, :, :3], cameras[:, :, 3:])[..., 0], dtype=np.float64)


def camera_intrinsics(matrix: FloatArray) -> FloatArray:
    """``fx, skew, fy, u0, v0`` (5,) [px] of a camera (3, 4) in a Euclidean frame."""
    K, _ = upper_triangular(matrix[:, :3])
    result: FloatArray = K[[0, 0, 1, 0, 1], [0, 1, 1, 2, 2]]
    return result
