"""Square tags with a code: the dictionaries of ArUco and the families of AprilTag, as OpenCV draws them.

Corner 0 is the top left of the tag as drawn, the others follow clockwise as seen from in front.
"""

from __future__ import annotations

from functools import cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

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


@cache
def mirror_twins(name: str) -> dict[int, int]:
    """Tags of a dictionary that, printed mirrored, read as a tag of it: which ones, and as which. Raises KeyError.

    Of these no reading of the code tells that the print is mirrored.
    """
    cells = [tag_cells(name, tag) for tag in range(size_of(name))]
    reads = {np.rot90(c, k).tobytes(): tag for tag, c in enumerate(cells) for k in range(4)}
    mirrored = {tag: np.ascontiguousarray(c[:, ::-1]).tobytes() for tag, c in enumerate(cells)}
    return {tag: reads[key] for tag, key in mirrored.items() if key in reads}
