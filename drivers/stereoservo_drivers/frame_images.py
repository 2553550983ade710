"""Validation of a frame's image before detection."""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.devices import DriverError, Frame

SMALLEST_IMAGE = 32
"""Least side of an image [px]."""


def gray_image(frame: Frame, camera: str) -> ImageArray:
    """The frame's image (height, width). Raises DriverError (``image_format``) for anything else."""
    image = frame.image
    if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype != np.uint8:
        shape, kind = getattr(image, "shape", None), getattr(image, "dtype", type(image).__name__)
        raise DriverError(
            "image_format",
            f"camera {camera!r}: image of shape {shape}, {kind}; expected (height, width) of uint8",
            shape=shape,
            dtype=str(kind),
        )
    return np.ascontiguousarray(image)


def sized_image(frame: Frame, camera: str, size: tuple[int, int] | None) -> ImageArray:
    """The frame's image of ``size`` (width, height) [px], or with sides of at least SMALLEST_IMAGE if it is None.

    Raises DriverError (``image_format``, ``image_size``).
    """
    image = gray_image(frame, camera)
    height, width = image.shape
    if (width, height) == size or (size is None and min(width, height) >= SMALLEST_IMAGE):
        return image
    expected = f"{size[0]}x{size[1]}" if size else f"at least {SMALLEST_IMAGE} a side"
    raise DriverError(
        "image_size",
        f"camera {camera!r}: image of {width}x{height} px; expected {expected}",
        size=(width, height),
        expected=size,
    )
