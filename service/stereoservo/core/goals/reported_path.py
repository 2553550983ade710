"""Samples of a path for the report of a plan: how many, and the raw pixels of the markers at each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereoservo.core.model_arrays import ModelArrays
from stereoservo.kinematics.kernels import distort_pixel, project_points, transform_points
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

REPORTED = 17
"""Samples of a path that a report holds."""
REPORTED_PIXELS = 2048
"""Largest number of pixels in a report: of a large body it has fewer samples, at least the ends of the path."""
REPORTED_OF_LARGE = 512
"""The same if the ends alone would exceed it: then only every second, third … marker is reported."""

Pixels = dict[int, tuple[tuple[float, float], ...]]


def reported_samples(arrays: ModelArrays | None) -> int:
    """Number of samples of a path in a report: at least its ends."""
    pixels = 1 if arrays is None else arrays.observation_count
    return max(2, min(REPORTED, REPORTED_PIXELS // pixels))


def reported_pixels(arrays: ModelArrays, displacements: FloatArray, points: FloatArray) -> list[Pixels]:
    """Raw pixels of ``points`` (m, 4) after ``displacements`` (k, 4, 4), by marker, for each camera.

    Markers that a lens does not image at all of them are left out.
    """
    pixels = max(len(displacements), 2) * arrays.observation_count  # a path to the current pose has one sample
    every = 1 if pixels <= REPORTED_PIXELS else math.ceil(pixels / REPORTED_OF_LARGE)
    chosen = np.ascontiguousarray(points[::every])
    paths = _raw_paths(arrays.matrices, arrays.lenses, displacements, chosen)
    imaged: list[list[bool]] = np.asarray(np.isfinite(paths).all(axis=(0, 3))).tolist()
    by_camera: list[list[list[Any]]] = paths.transpose(1, 2, 0, 3).tolist()
    return [
        {
            marker: tuple(map(tuple, path))
            for marker, path, whole in zip(arrays.marker_ids[::every], of_camera, whole_paths, strict=True)
            if whole
        }
        for of_camera, whole_paths in zip(by_camera, imaged, strict=True)
    ]


@kernel
def _raw_paths(matrices: FloatArray, lenses: FloatArray, displacements: FloatArray, points: FloatArray) -> FloatArray:
    """Raw pixels (k, c, m, 2) of ``points`` (m, 4) after ``displacements`` (k, 4, 4); NaN beyond a lens's fold."""
    found = np.empty((displacements.shape[0], matrices.shape[0], points.shape[0], 2))
    for k in range(displacements.shape[0]):
        pixels, _ = project_points(matrices, transform_points(displacements[k], points))
        for c in range(matrices.shape[0]):
            for i in range(points.shape[0]):
                u, v = distort_pixel(lenses[c], pixels[c, i, 0], pixels[c, i, 1])
                found[k, c, i, 0], found[k, c, i, 1] = u, v
    return found
