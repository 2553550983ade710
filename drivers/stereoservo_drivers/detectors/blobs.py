"""Acquisition: every dot-like spot of a whole image, before anything is known about it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo_drivers.detectors import centroids
from stereoservo_drivers.detectors.centroids import FIELDS, MAX_WINDOW
from stereoservo_drivers.detectors.tracking import measure_windows, whole

GROW = 7
"""Pixels around a component's bounding box in the window that measures it."""
MIN_FILL = 0.3
"""Least part of its bounding box that a component covers (an ellipse of axes 1:4 on the diagonal: 0.37)."""
MAX_ASPECT = 6.0


def noise_level(image: npt.NDArray[np.uint8]) -> float:
    """Standard deviation of the noise [grey levels] of an image (h, w), from differences of neighbours on
    every 16th row.
    """
    rows = image[::16].astype(np.int16)
    differences = np.abs(rows[:, 1:] - rows[:, :-1])
    # the median of |difference| in whole levels, interpolated within its level
    counts = np.bincount(differences.ravel(), minlength=2)
    cumulated = np.cumsum(counts)
    half = 0.5 * cumulated[-1]
    level = int(np.searchsorted(cumulated, half))
    below = cumulated[level - 1] if level else 0
    width = 0.5 if level == 0 else 1.0
    start = 0.0 if level == 0 else level - 0.5
    median = start + width * (half - below) / counts[level]
    return float(median / (0.6745 * np.sqrt(2.0)))


def find_spots(
    image: npt.NDArray[np.uint8],
    dark: bool,
    min_contrast: int,
    lopsided: float,
    most: int,
    labels: npt.NDArray[np.int32],
    stack: npt.NDArray[np.int32],
) -> npt.NDArray[np.float64]:
    """Measurements (m, FIELDS) of the whole, elliptical spots of an image (h, w), at most ``most`` of them.

    A pixel is bright when it exceeds the mean of its surroundings (a tenth of the image's width, so that
    gradients do not matter) by half the least contrast or four times the noise.
    """
    bright = cv2.bitwise_not(image) if dark else image
    side = max(31, image.shape[1] // 10) | 1
    offset = max(0.4 * min_contrast, 4.0 * noise_level(image))
    mean = cv2.blur(bright, (side, side), borderType=cv2.BORDER_REPLICATE)
    mask = cv2.compare(bright, cv2.add(mean, np.full((1, 1), offset).item()), cv2.CMP_GT)
    _, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    stats, centres = stats[1:], centres[1:]
    left, top, width, height, area = stats.T
    keep = (
        (area >= 6)
        & (np.maximum(width, height) <= MAX_WINDOW - 2 * GROW)
        & (np.maximum(width, height) <= MAX_ASPECT * np.minimum(width, height))
        & (area >= MIN_FILL * width * height)
    )
    left, top, width, height, centres = left[keep], top[keep], width[keep], height[keep], centres[keep]
    windows = np.column_stack([left - GROW, top - GROW, left + width + GROW, top + height + GROW]).astype(
        np.int64
    )
    spots = np.zeros((len(windows), FIELDS))
    status = measure_windows(image, dark, windows, centres, min_contrast, 5, labels, stack, spots)
    spots = spots[status == centroids.OK]
    spots = spots[whole(spots, lopsided)]
    # a component may be measured from two sides of a larger one
    order = np.argsort(spots[:, centroids.LOPSIDED], kind="stable")[: 2 * most]
    spots = spots[order]
    distances = np.hypot(*(spots[:, None, :2] - spots[None, :, :2]).transpose(2, 0, 1))
    twins = np.triu(distances < 2.0, 1).any(axis=0)
    return spots[~twins][:most]
