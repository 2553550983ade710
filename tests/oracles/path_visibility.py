"""Visibility of a body along its path in closed form (7.4.2), clearance to image borders and joint limits.

Readable references of the kernels in `stereoservo.planning`. Points, faces' points and camera centres have scale 1, so
that the sign of ``aᵀO`` is the side of the face ``a`` on which the camera is; a face moved by ``H`` is ``H⁻ᵀa``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from stereoservo.geometry.distortion import distort
from stereoservo.numerics.arrays import FloatArray

NO_TURN = 1e-12
"""Amplitude of ``aᵀO`` over a rotation, relative to its size, below which the camera stands on the axis."""
ROOT_HALVINGS = 60


def translation_bound(face: FloatArray, H_t: FloatArray, eye: FloatArray) -> float:
    """``τ₀ = aᵀO / (aᵀĤ_tO)``: the translation at which the face passes the camera; infinite if it never does.

    ``face`` (4,), generator ``H_t`` (4, 4), ``eye`` (4,). Negative where it lies behind the start.
    """
    rate = float(face @ H_t @ eye)
    value = float(face @ eye)
    if abs(rate) <= NO_TURN * float(np.linalg.norm(face) * np.linalg.norm(H_t) * np.linalg.norm(eye)):
        return math.inf
    return value / rate


def rotation_bounds(face: FloatArray, H_r: FloatArray, eye: FloatArray) -> tuple[float, float] | None:
    """``θ₀⁻, θ₀⁺`` [rad]: between them, and at whole turns from there, ``a(θ)ᵀO`` is positive.

    ``a(θ)ᵀO = k + R cos(θ − φ)``: the interval is ``φ ± acos(−k/R)``. (−inf, inf) where it always is, None where never.
    """
    once = H_r @ eye
    u, v = float(face @ once), float(face @ H_r @ once)
    k, R, phi = float(face @ eye) + v, math.hypot(u, v), math.atan2(-u, -v)
    if abs(k) >= R:
        return (-math.inf, math.inf) if k > 0.0 else None
    half = math.acos(-k / R)
    return phi - half, phi + half


def visible_shares(
    displacement: Callable[[float], FloatArray], face: FloatArray, eye: FloatArray, samples: int = 181
) -> list[tuple[float, float]]:
    """Intervals of σ in [0, 1] on which ``aᵀ H(σ)⁻¹ O > 0``, for any way ``displacement(σ)`` (4, 4).

    A sight or loss shorter than the distance of ``samples`` may be missed.
    """

    def side(sigma: float) -> float:
        return float(face @ np.linalg.solve(displacement(sigma), eye))

    sigmas = np.linspace(0.0, 1.0, samples)
    sides = np.array([side(float(sigma)) for sigma in sigmas])
    intervals: list[tuple[float, float]] = []
    begin = 0.0 if sides[0] > 0.0 else None
    for k in range(samples - 1):
        if (sides[k] > 0.0) == (sides[k + 1] > 0.0):
            continue
        root = _crossing(side, float(sigmas[k]), float(sigmas[k + 1]))
        if begin is None:
            begin = root
        else:
            intervals.append((begin, root))
            begin = None
    if begin is not None:
        intervals.append((begin, 1.0))
    return intervals


def common_shares(first: list[tuple[float, float]], second: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Where both hold: the most conservative of two cameras (7.4.2)."""
    both = [(max(a, c), min(b, d)) for a, b in first for c, d in second]
    return sorted((low, high) for low, high in both if low < high)


def view_rooms(
    displacements: FloatArray,
    points: FloatArray,
    matrices: FloatArray,
    lenses: FloatArray,
    sizes: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Distances from the images' borders [px], negative outside, and depths, both (K, c, m), along a way (K, 4, 4).

    A marker behind a camera or beyond its lens's fold is as far outside as the image is wide.
    """
    moved = np.einsum("kij,mj->kmi", displacements, points)
    seen = np.einsum("cij,kmj->kcmi", matrices, moved)
    depths = seen[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = seen[..., :2] / depths[..., None]
        raw = np.stack(
            [distort(lens, ideal[:, c].reshape(-1, 2)).reshape(ideal[:, c].shape) for c, lens in enumerate(lenses)],
            axis=1,
        )
        rooms = np.minimum(raw + 0.5, sizes[None, :, None, :] - 0.5 - raw).min(axis=-1)
    width = -np.broadcast_to(sizes[None, :, :1], rooms.shape)
    rooms = np.where(np.isfinite(rooms) & (depths > 0.0), np.maximum(rooms, width), width)
    return np.asarray(rooms), np.asarray(depths)


def joint_clearances(joints: FloatArray, position_min: FloatArray, position_max: FloatArray) -> FloatArray:
    """What each joint of ``joints`` (K, n) has left to its nearer limit: (K, n), negative beyond."""
    rooms: FloatArray = np.minimum(joints - position_min, position_max - joints)
    return rooms


def keep_out_clearances(joints: FloatArray, keep_outs: FloatArray) -> FloatArray:
    """How far ``joints`` (K, n) are outside each box of ``keep_outs`` (k, n, 2) along its farthest joint: (K, k)."""
    below = keep_outs[None, :, :, 0] - joints[:, None, :]
    above = joints[:, None, :] - keep_outs[None, :, :, 1]
    rooms: FloatArray = np.maximum(below, above).max(axis=-1)
    return rooms


def _crossing(side: Callable[[float], float], low: float, high: float) -> float:
    positive = side(low) > 0.0
    for _ in range(ROOT_HALVINGS):
        middle = 0.5 * (low + high)
        if (side(middle) > 0.0) == positive:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
