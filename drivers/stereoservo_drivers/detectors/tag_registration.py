"""Corners of a tag from its whole printed pattern: the known cells, seen through a homography and blurred by a
Gaussian, are fitted to the grey values of the tag.

A search for each corner by itself looks at a few pixels, and is pulled inwards by blur: both legs of an L bend.
The pattern's edges, all of them, say where the corners are ten times better, and how well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo_drivers.detectors.kernel_types import FLOAT, IMAGE, compile_for, fields, given, written
from stereoservo_drivers.detectors.tag_fit import fit_tag

FIRST_BLUR_PX = 1.0
"""Blur at which a fit begins, unless told otherwise; a larger one draws from further away."""


@dataclass(frozen=True)
class Registered:
    """A tag found in its place: ``corners`` (4, 2) [px] and their ``covariances`` (4, 2, 2) [px²], those of the noise.

    ``noise_variance`` [levels²] of the fit's residuals, ``contrast`` [levels] between white and black at the middle,
    ``blur`` [px], ``correlation`` of pattern and image; ``misfit`` [px²]: what residuals that are alike within a cell
    add to the covariances.
    """

    corners: FloatArray
    covariances: FloatArray
    noise_variance: float
    contrast: float
    blur: float
    correlation: float
    misfit: float


def register_tag(
    image: ImageArray, start: FloatArray, cells: FloatArray, blur_px: float = FIRST_BLUR_PX
) -> Registered | None:
    """Fit the blurred pattern of ``cells`` (n, n) to an image (h, w) about ``start`` (4, 2) [px].

    None where the fit cannot be believed: the grey values do not follow the pattern, a cell is not what the code
    says, a corner moved by more than a cell.
    """
    corners, covariances, told = np.empty((4, 2)), np.empty((4, 2, 2)), np.empty(5)
    start = np.ascontiguousarray(start, dtype=np.float64)
    if not fit_tag(np.ascontiguousarray(image), start, cells, blur_px, (corners, covariances, told)):
        return None
    return Registered(corners, 0.5 * (covariances + covariances.transpose(0, 2, 1)), *told.tolist())


def compile_kernels() -> None:
    """Compile what the detector calls, or load it from the cache."""
    compile_for(
        fit_tag,
        IMAGE,
        given(FLOAT, 2),
        given(FLOAT, 2),
        FLOAT,
        fields(written(FLOAT, 2), written(FLOAT, 3), written(FLOAT, 1)),
    )


DictionaryName = Literal[
    "36h11", "36h10", "25h9", "16h5", "original", "mip_36h12",
    "4x4_50", "4x4_100", "4x4_250", "4x4_1000", "5x5_50", "5x5_100", "5x5_250", "5x5_1000",
    "6x6_50", "6x6_100", "6x6_250", "6x6_1000", "7x7_50", "7x7_100", "7x7_250", "7x7_1000",
]  # fmt: skip

_CONSTANTS = {
    "36h11": "DICT_APRILTAG_36h11",
    "36h10": "DICT_APRILTAG_36h10",
    "25h9": "DICT_APRILTAG_25h9",
    "16h5": "DICT_APRILTAG_16h5",
    "original": "DICT_ARUCO_ORIGINAL",
    "mip_36h12": "DICT_ARUCO_MIP_36h12",
    **{f"{n}x{n}_{size}": f"DICT_{n}X{n}_{size}" for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)},
}
DICTIONARIES: tuple[str, ...] = tuple(_CONSTANTS)
"""Every dictionary there is, by the name that a cell file gives it."""


@cache
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of that name. Raises KeyError."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _CONSTANTS[name]))


def size_of(name: str) -> int:
    """How many tags the dictionary has: ids 0 .. n - 1. Raises KeyError."""
    return int(dictionary(name).bytesList.shape[0])


def cells_along(name: str) -> int:
    """Cells along a side, the black border included. Raises KeyError."""
    return int(dictionary(name).markerSize) + 2


def tag_cells(name: str, tag: int) -> npt.NDArray[np.float64]:
    """Darkness (n, n) of a tag's cells, its black border included: 1 black, 0 white; rows downwards.

    Raises KeyError, IndexError.
    """
    if not 0 <= tag < size_of(name):
        raise IndexError(f"tag {tag} is not in {name}: 0..{size_of(name) - 1}")
    image = cv2.aruco.generateImageMarker(dictionary(name), tag, cells_along(name))
    return np.where(np.asarray(image) > 127, 0.0, 1.0)
