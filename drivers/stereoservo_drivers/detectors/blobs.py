"""Acquisition: every dot-like spot of a whole image, before anything is known about it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo_drivers.detectors.centroids import measure_windows
from stereoservo_drivers.detectors.components import MAX_WINDOW
from stereoservo_drivers.detectors.measurements import FIELDS, LOPSIDED, OK
from stereoservo_drivers.detectors.tracking import whole

SHRINK_FROM = 240
"""Least side of an image [px] that is searched, not measured, at half its size: a third of the time, half
the noise.
"""
GROW = 7
"""Pixels around a component's bounding box in the window that measures it."""
MIN_FILL = 0.3
"""Least part of its bounding box that a component covers (an ellipse of axes 1:4 on the diagonal: 0.37)."""
MAX_ASPECT = 6.0


def noise_level(image: npt.NDArray[np.uint8]) -> float:
    """Standard deviation of the noise [grey levels] of an image (h, w), from differences of neighbours on
    some thirty rows.
    """
    rows = image[:: max(1, image.shape[0] // 30)].astype(np.int16)
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
    shrink = 2 if min(image.shape) >= SHRINK_FROM else 1
    if shrink == 2:
        even = bright[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
        bright = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    side = max(31 // shrink, bright.shape[1] // 10) | 1
    offset = max(0.4 * min_contrast, 4.0 * noise_level(bright))
    mean = cv2.blur(bright, (side, side), borderType=cv2.BORDER_REPLICATE)
    mask = cv2.compare(bright, cv2.add(mean, offset), cv2.CMP_GT)
    # labels of 16 bits take less than half the time; no more components than a quarter of the pixels
    labelled = cv2.CV_16U if mask.size <= 4 * 65535 else cv2.CV_32S
    _, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=labelled)
    left, top, width, height, area = stats[1:].T
    longer, shorter = np.maximum(width, height), np.minimum(width, height)
    keep = (
        (area >= 6 // shrink**2 + 1)
        & (shrink * longer <= MAX_WINDOW - 2 * GROW)
        & (longer <= MAX_ASPECT * shorter)
        & (area >= MIN_FILL * width * height)
    )
    left, top, right, bottom = (shrink * x[keep] for x in (left, top, left + width, top + height))
    windows = np.column_stack([left - GROW, top - GROW, right + GROW, bottom + GROW]).astype(np.int64)
    near = shrink * centres[1:][keep] + 0.5 * (shrink - 1)
    spots, status = np.zeros((len(windows), FIELDS)), np.zeros(len(windows), np.int64)
    least = np.full(len(windows), 5, np.int64)
    measure_windows(image, dark, windows, near, min_contrast, least, labels, stack, spots, status)
    spots = np.array([spot for spot in spots[status == OK] if whole(spot, lopsided)]).reshape(-1, FIELDS)
    spots = spots[np.argsort(spots[:, LOPSIDED], kind="stable")][: 2 * most]
    # one spot may be measured from two components
    distances = np.hypot(*(spots[:, None, :2] - spots[None, :, :2]).transpose(2, 0, 1))
    twins = np.triu(distances < 2.0, 1).any(axis=0)
    return spots[~twins][:most]
