"""A camera's frame against the prediction at its shutter, and folded into the camera's estimate, by the definitions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class Residuals:
    """Rows of a frame: innovations (k, 2) [px], covariances (k, 2, 2) by detector and stamp, detector variances (k,),
    pixel velocities (k, 2).
    """

    innovation: np.ndarray
    spread: np.ndarray
    noise: np.ndarray
    velocity: np.ndarray


def residuals(
    observed: np.ndarray, predicted: np.ndarray, velocity: np.ndarray, covariances: np.ndarray, timing_s: float
) -> Residuals:  # fmt: skip
    """A stamp that is off by ``timing_s`` moves each row along its velocity."""
    along = velocity[:, :, None] * velocity[:, None, :]
    noise = 0.5 * np.trace(covariances, axis1=1, axis2=2)
    return Residuals(observed - predicted, covariances + timing_s**2 * along, noise, velocity)


def distances(vectors: np.ndarray, spread: np.ndarray, model_px: float | np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (k,), the model being off by ``model_px``."""
    total = spread + np.reshape(np.square(model_px), (-1, 1, 1)) * np.eye(2)
    found: np.ndarray = np.einsum("ki,ki->k", vectors, np.linalg.solve(total, vectors[..., None])[..., 0])
    return found


def fold(
    filtered: np.ndarray, seen_s: np.ndarray, now_s: float, frame: Residuals, rows: np.ndarray, *, known_s: float,
    filter_s: float, gate: float, model_px: float, first_px: float, huber: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Filtered innovations (m, 2), when each was seen (m,) [s], sigmas (m,) of the accepted, and which (m,) these are,
    of the ``rows`` (m,) that may be used.
    """
    m = len(filtered)
    known = now_s - seen_s <= known_s
    age_s = np.where(known, now_s - seen_s, 0.0)
    change = frame.innovation[:m] - np.where(known[:, None], filtered, 0.0)
    d2 = distances(change, frame.spread[:m], np.where(known, model_px, first_px))
    accepted = rows & (d2 <= gate)
    weight = np.minimum(1.0, huber / np.sqrt(np.maximum(d2, 1e-12)))
    share = np.where(known & (filter_s > 0.0), weight * age_s / (filter_s + age_s + 1e-300), 1.0)
    folded = np.where(known[:, None], filtered, 0.0) + share[:, None] * change
    sigma = np.sqrt(frame.noise[:m] / weight)
    return (
        np.where(accepted[:, None], folded, filtered),
        np.where(accepted, now_s, seen_s),
        sigma,
        accepted,
    )
