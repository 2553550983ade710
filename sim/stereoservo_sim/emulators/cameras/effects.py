"""Image faults: exposure, light, orientation, size, and damaged JPEG data."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import ImageArray
from stereoservo_sim.emulators.fault_engine import EmulationError

LAMP_LEVEL = 110.0
LAMP_REACH = 0.45
"""Sigma of the lamp's light, in image widths, about the upper left corner."""
CUT_SHARE = 0.5
FLIPPED_BYTES = 40
HEADER = 700
"""[bytes] Of a JPEG its tables come first; flipped bytes behind them leave a picture that decodes, wrongly."""


def exposed(image: ImageArray, gain: float) -> ImageArray:
    """``image`` (h, w) with exposure ``gain``, clipped at white."""
    if gain == 1.0:
        return image
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain), dtype=np.uint8)


def lamp_light(height: int, width: int, level: float = LAMP_LEVEL) -> npt.NDArray[np.float32]:
    """Light (h, w) [grey levels] of a lamp beyond the upper left corner."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float32) / (LAMP_REACH * width)
    return np.asarray(level * np.exp(-0.5 * (u * u + v * v)), dtype=np.float32)


def lit(image: ImageArray, light: npt.NDArray[np.float32]) -> ImageArray:
    """``image`` (h, w) with ``light`` (h, w) added, clipped at white."""
    return np.asarray(cv2.add(image, light, dtype=cv2.CV_8U), dtype=np.uint8)


def turned(image: ImageArray, how: str) -> ImageArray:
    """``flip``: the image upside down; ``mirror``: left and right exchanged; else unchanged."""
    if how == "flip":
        return np.ascontiguousarray(image[::-1, ::-1])
    if how == "mirror":
        return np.ascontiguousarray(image[:, ::-1])
    return image


def even(image: ImageArray, level: int) -> ImageArray:
    """Uniform image of the same size, of grey ``level``."""
    return np.full_like(image, level)


def resized(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    """``image`` resampled to ``size`` (width, height)."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def jpeg(image: ImageArray, quality: int) -> bytes:
    """Encode ``image`` (h, w) as a JPEG. Raises EmulationError."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise EmulationError(f"an image of {image.shape} cannot be written as JPEG")
    return bytes(data)


def cut(data: bytes) -> bytes:
    """First half of a JPEG's data."""
    return data[: int(len(data) * CUT_SHARE)]


def corrupted(data: bytes, rng: np.random.Generator) -> bytes:
    """A JPEG with some of its bytes inverted, behind its tables."""
    spoilt = bytearray(data)
    for at in rng.integers(min(HEADER, len(data) - 1), len(data), FLIPPED_BYTES).tolist():
        spoilt[at] ^= 0xFF
    return bytes(spoilt)
