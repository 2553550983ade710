"""Image-based control with cameras that have moved, or move: every camera is estimated again from the markers in every
step (thesis 8.27, 8.28).

For experiments: it uses LAPACK and loads scipy, and is not for the loop.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import LawStep, Options, Scene, Task
from stereoservo.control.laws.image import image
from stereoservo.geometry.cameras import camera_centre
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.moved_cameras import resect_moved_camera
from stereoservo.numerics.arrays import FloatArray


def with_resected_cameras(scene: Scene) -> Scene:
    """The scene with every camera estimated anew from the markers that it sees now (8.27, 8.28).

    The operators and the points stand in a projective frame of the arm's own, in which the markers are known: six of
    them, not in one plane, give a camera wherever it has gone. A camera that sees fewer, or only a plane, is given no
    weight.
    """
    matrices, weights, centres = scene.matrices.copy(), scene.weights.copy(), scene.camera_centres.copy()
    for c, pixels in enumerate(scene.pixels):
        seen = scene.weights[c] > 0.0
        try:
            P = resect_moved_camera(scene.points[seen], pixels[seen]).P
        except GeometryError:  # what it sees does not determine the camera: the law goes on with the others
            weights[c] = 0.0
            continue
        # In front of the camera depths are positive.
        depths = scene.points[seen] @ P[2]
        matrices[c] = P if float(depths.sum()) >= 0.0 else -P
        centre: FloatArray = camera_centre(matrices[c])
        height = float(centre @ plane_of_heights(scene.points))
        centres[c] = centre / height if height != 0.0 else centre
    return scene._replace(matrices=matrices, weights=weights, camera_centres=centres)


def plane_of_heights(points: FloatArray) -> FloatArray:
    """The plane (4,) with ``aᵀM = 1`` for points (m, 4) of height 1 that do not lie in a plane: that at infinity."""
    plane: FloatArray = np.linalg.pinv(points).sum(axis=1)
    return plane


def image_of_moved_cameras(scene: Scene, task: Task, options: Options) -> LawStep:
    """The law `image` with the cameras estimated anew in this very step (8.27, 8.28)."""
    return image(with_resected_cameras(scene), task, options)
