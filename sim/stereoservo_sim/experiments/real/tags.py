"""ArUco tags in grey images: detection, and registration of their corners on the whole printed pattern.

``CORNER_REFINE_SUBPIX`` looks at a few pixels about each corner; on tags of 20 px, with cells of 3 px, it
pulls the corners inwards (2 % of the side) and is unsure by up to a pixel. Here it is only the start: the
tag's known black and white cells, seen through a homography and blurred by a Gaussian, are fitted to the grey
values of the whole tag.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import from_homogeneous
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.detectors import tag_registration
from stereoservo_drivers.detectors.tag_registration import compile_kernels

GreyImage = npt.NDArray[np.uint8]

DICTIONARY = cv2.aruco.DICT_4X4_50
DICTIONARY_NAME = "DICT_4X4_50"
TAG_IDS = 50
STANDING = 100
"""Marker id from which corners of standing tags count, four a tag."""
UNREGISTERED_SIGMA = 0.5
"""Deviation [px] that is stated for corners that were not registered."""
CELLS = 6
"""Cells along a side: four of data and the black border on both ends."""


@dataclass(frozen=True)
class TagView:
    """One tag in one image: ``corners`` (4, 2) [px] in the dictionary's order, clockwise from the printed top
    left.

    ``sigmas`` (4,) [px]: of the corners, an axis, from the noise of the image. ``start``: the corners of cv2's subpixel
    refinement. ``registered``: whether the pattern fit was taken.
    ``blur`` [px] and ``correlation`` of pattern and image are NaN where it was not.
    """

    corners: FloatArray
    sigmas: FloatArray
    start: FloatArray
    registered: bool
    blur: float
    correlation: float


def tag_cells(tag: int) -> FloatArray:
    """Darkness (6, 6) of the cells of ``tag``: 1 black, 0 white; rows downwards."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    image = cv2.aruco.generateImageMarker(dictionary, tag, CELLS)
    return np.where(np.asarray(image) > 127, 0.0, 1.0)


def find_tags(image: GreyImage) -> dict[int, FloatArray]:
    """Corners ``(4, 2)`` [px] by tag id: cv2's detector with subpixel refinement. Of a repeated id the
    larger."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY), parameters)
    corners, ids, _ = detector.detectMarkers(image)
    tags: dict[int, FloatArray] = {}
    for quad, tag in zip(corners, [] if ids is None else np.ravel(ids), strict=True):
        found = np.asarray(quad, dtype=np.float64).reshape(4, 2)
        if int(tag) not in tags or _area(found) > _area(tags[int(tag)]):
            tags[int(tag)] = found
    return tags


def register_tag(image: GreyImage, start: FloatArray, cells: FloatArray) -> TagView:
    """The tag of ``cells`` (n, n) about ``start`` (4, 2) [px], as the detector `aruco` measures it.

    Where the fit cannot be believed the start is kept and ``registered`` is False.
    """
    start = np.asarray(start, dtype=np.float64)
    compile_kernels()
    fit = tag_registration.register_tag(image, start, cells)
    if fit is None:
        return TagView(start, np.full(4, UNREGISTERED_SIGMA), start, False, float("nan"), float("nan"))
    sigmas = np.sqrt(np.trace(fit.covariances, axis1=1, axis2=2) / 2.0)
    return TagView(fit.corners, sigmas, start, True, fit.blur, fit.correlation)


def _area(quad: FloatArray) -> float:
    x, y = quad[:, 0], quad[:, 1]
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2)


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


def flatness(model: CellModel, tags: tuple[int, ...]) -> Flatness:
    """Plane fitted to the model's static points that are corners of ``tags``."""
    nothing = np.zeros((0, 3))
    if not tags:
        return Flatness(None, "no table tags were asked for", (), nothing)
    shared = tuple(tag for tag in tags if any((i - STANDING) // 4 == tag for i in model.scene_ids))
    if not shared or model.projective_to_euclidean is None:
        return Flatness(
            None, f"no table tag of {list(tags)} is seen standing still by two cameras or more", (), nothing
        )
    points = from_homogeneous(model.scene_points @ model.projective_to_euclidean.T)
    if len(points) < 4:
        return Flatness(
            None, f"only {len(points)} corners of table tags could be triangulated", shared, points
        )
    smallest = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2]
    return Flatness(float(smallest / np.sqrt(len(points)) * 1e3), None, shared, points)
