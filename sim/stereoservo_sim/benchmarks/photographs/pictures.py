"""Photographs that lie on this computer: the Franka set, OpenCV's samples, tags that another program rendered; and how
a detector is counted on them.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraObservation, Detector, DriverContext, Frame

DEBIAN = Path("/usr/share/doc/opencv-doc")
"""Where Debian's package opencv-doc puts its files."""
T = TypeVar("T")
BOARDS = "[lr][ei][fg]*t[0-9][0-9].jpg"
"""OpenCV's chessboard pairs, among its samples."""
LEAST = 200
"""Rows and columns of a photograph at least: smaller ones are icons."""


@dataclass(frozen=True)
class Photographs:
    """Paths of pictures by what they show; empty where they are not here, with the reason in ``missing``.

    ``franka``: ``pose##_cam#.jpg``; ``boards``: chessboards of 9x6 inner corners; ``sheet``: six tags of 6x6_250 on one
    sheet; ``webots``: tags of 36h11 that Webots rendered; ``others``: no tag, no chessboard, no plate.
    """

    franka: tuple[Path, ...]
    boards: tuple[Path, ...]
    sheet: tuple[Path, ...]
    webots: tuple[Path, ...]
    others: tuple[Path, ...]
    missing: tuple[str, ...]


def photographs(root: Path | None = None) -> Photographs:
    """Those below ``root`` (default: ``$STEREOSERVO_DATA``, else ``../shared/data``) and of Debian's opencv-doc.

    Below ``root``: ``fairo_franka/set_a``, ``opencv-doc`` (as the package has it), ``april_vision`` (``test_data`` of
    the source distribution).
    """
    root = Path(os.environ.get("STEREOSERVO_DATA", "../shared/data")) if root is None else root
    doc = next((place for place in (root / "opencv-doc", DEBIAN) if place.is_dir()), DEBIAN)
    samples = sorted((doc / "examples" / "data").glob("*.[jp][pn]g"))
    boards = [path for path in samples if path.match(BOARDS)]
    others = [
        path for path in samples if path not in boards and path.name != "chessboard.png" and _large(path)
    ]
    found = {
        "franka": sorted((root / "fairo_franka" / "set_a").glob("pose*_cam*.jpg")),
        "boards": boards,
        "sheet": sorted((doc / "opencv4" / "html").glob("singlemarkersoriginal.jpg")),
        "webots": sorted((root / "april_vision").glob("*.png")),
        "others": others,
    }
    where = {
        "franka": f"no fairo_franka/set_a in {root}; $STEREOSERVO_DATA names the folder",
        "boards": f"no left01.jpg in {doc}: Debian's package opencv-doc has it",
        "sheet": f"no singlemarkersoriginal.jpg in {doc}: Debian's package opencv-doc has it",
        "webots": f"no april_vision in {root}: test_data of the source distribution of april-vision",
        "others": f"no samples in {doc}: Debian's package opencv-doc has them",
    }
    missing = tuple(why for name, why in where.items() if not found[name])
    return Photographs(**{name: tuple(paths) for name, paths in found.items()}, missing=missing)


def _large(path: Path) -> bool:
    return min(read(path).shape) >= LEAST


def read(path: Path) -> ImageArray:
    """A picture in grey. Raises OSError where it does not decode."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise OSError(f"{path} is no picture that OpenCV decodes")
    return np.asarray(image, dtype=np.uint8)


@dataclass
class Row:
    """What ``detector`` found ``on`` some ``pictures``: ``found`` right ones of ``shown``, ``false`` ones, how far off
    (``rms_px``, by the measure that ``accuracy`` names), and the processor's time for a picture."""

    on: str
    pictures: int
    detector: str
    shown: int
    found: int
    false: int
    rms_px: float | None
    accuracy: str
    cpu_ms: float

    def report(self) -> dict[str, Any]:
        """As JSON."""
        return {**vars(self), "recall": self.found / self.shown if self.shown else None}


def context() -> DriverContext:
    """The context of a detector that stands alone."""
    here = Path(".")
    return DriverContext(
        clock=MonotonicClock(), cell="bench", runtime_dir=here, cell_dir=here, camera="photograph"
    )


def look(detector: Detector, image: ImageArray) -> CameraObservation:
    """What ``detector`` sees in ``image`` without a prior."""
    return detector.detect(Frame("photograph", 0, 1_000_000_000, 1_000_000_000, image), None)


def over(
    images: Sequence[ImageArray], call: Callable[[ImageArray], T], repetitions: int
) -> tuple[list[T], float]:
    """``call`` of each image, and the median of its processor time [ms] over ``repetitions`` of each."""
    found, times = [], []
    call(images[0])
    for image in images:
        for _ in range(repetitions):
            at = time.process_time()
            answer = call(image)
            times.append(1e3 * (time.process_time() - at))
        found.append(answer)
    return found, float(f"{np.median(times):.3g}")
