"""Tags that stand still before fixed cameras: found in each camera's median image, triangulated, held against
a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.cameras import triangulate
from stereoservo.geometry.homogeneous import from_homogeneous
from stereoservo_sim.experiments.aruco_tags import find_tags, register_tag, tag_cells
from stereoservo_sim.experiments.driven_cameras import DrivenCameras, undistort

FloatArray = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]

MEDIAN_OF = 25
"""Images that enter a median at most: the arm is gone from it, and so is most of the noise."""


@dataclass(frozen=True)
class Flatness:
    """rms distance [mm] of ``points`` (n, 3) [m] from their best plane; None with the ``reason`` where there
    is none."""

    rms_mm: float | None
    reason: str | None
    tags: tuple[int, ...]
    points: FloatArray


def median_image(images: list[GreyImage]) -> GreyImage:
    """Per-pixel median of at most MEDIAN_OF evenly chosen images of one size."""
    chosen = np.unique(np.linspace(0, len(images) - 1, min(len(images), MEDIAN_OF)).round().astype(int))
    median: GreyImage = np.median(np.stack([images[i] for i in chosen]), axis=0).astype(np.uint8)
    return median


def find_standing_tags(image: GreyImage, tags: tuple[int, ...]) -> dict[int, FloatArray]:
    """Registered corners ``(4, 2)`` [px] of those of ``tags`` that are in a median image."""
    found = find_tags(image)
    return {tag: register_tag(image, found[tag], tag_cells(tag)).corners for tag in tags if tag in found}


def flatness(model: DrivenCameras, seen: list[dict[int, FloatArray]], tags: tuple[int, ...]) -> Flatness:
    """Triangulate the corners of ``tags`` from ``seen`` (one dict a camera of ``model``) and fit a plane."""
    nothing = np.zeros((0, 3))
    if not tags:
        return Flatness(None, "no table tags were asked for", (), nothing)
    if not any(seen):
        return Flatness(None, f"none of the table tags {list(tags)} is seen standing still", (), nothing)
    shared = tuple(tag for tag in tags if sum(tag in camera for camera in seen) >= 2)
    if not shared:
        return Flatness(None, f"no table tag of {list(tags)} is seen by two cameras or more", (), nothing)
    missing = np.full((4, 2), np.nan)
    pixels = np.stack([np.concatenate([camera.get(tag, missing) for tag in shared]) for camera in seen])
    straight = undistort(pixels, model.radial[:, None], model.sizes[:, None])
    points = from_homogeneous(triangulate(model.Ps, straight, iterations=20))
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 4:
        return Flatness(
            None, f"only {len(points)} corners of table tags could be triangulated", shared, points
        )
    smallest = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2]
    return Flatness(float(smallest / np.sqrt(len(points)) * 1e3), None, shared, points)
