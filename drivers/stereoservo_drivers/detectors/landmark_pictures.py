"""Landmarks drawn into the reference pictures, for people."""

from __future__ import annotations

import cv2
import numpy as np

from stereoservo_drivers.detectors.landmarks import ImageArray, Landmarks

COLOURS = ((60, 160, 255), (90, 220, 90), (220, 220, 60))
"""Tool, static, unsorted (BGR)."""
SHIFT = 4


def draw_landmarks(landmarks: Landmarks) -> ImageArray:
    """The cameras' pictures side by side (h, w, 3) BGR: orange tool, green scene, blue unsorted; lines join a landmark
    in the first camera and in the others.
    """
    height = max(camera.picture.shape[0] for camera in landmarks.cameras)
    parts, left = [], []
    for camera in landmarks.cameras:
        left.append(sum(part.shape[1] for part in parts))
        part = np.zeros((height, camera.picture.shape[1], 3), np.uint8)
        part[: camera.picture.shape[0]] = camera.picture[:, :, None]
        parts.append(part)
    drawn = np.hstack(parts)
    joined = drawn.copy()
    for k, kind in enumerate(landmarks.kinds.tolist()):
        places = []
        for camera, shift in zip(landmarks.cameras, left, strict=True):
            if np.isfinite(camera.pixels[k]).all():
                at = (camera.pixels[k] + np.array([shift, 0.0])) * 2**SHIFT
                places.append((int(at[0]), int(at[1])))
        for place in places:
            cv2.circle(drawn, place, 3 * 2**SHIFT, COLOURS[kind], 1, cv2.LINE_AA, SHIFT)
        for place in places[1:]:
            cv2.line(joined, places[0], place, COLOURS[kind], 1, cv2.LINE_AA, SHIFT)
    return np.asarray(cv2.addWeighted(drawn, 0.7, joined, 0.3, 0.0), dtype=np.uint8)
