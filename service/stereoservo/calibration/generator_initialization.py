"""Start values of a single joint's generator (its projective twist) from its own trial: linear least squares, rigid by
nominal cameras, or rotations about a set of directions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereoservo.calibration.stratum_upgrade import twist_between
from stereoservo.calibration.trial_data import finite_rows
from stereoservo.geometry.cameras import NOMINAL_FOCAL
from stereoservo.geometry.displacements import (
    exp_generator,
    nearest_rotation_generator,
    nearest_translation_generator,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.parameterization import Kind
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

MAX_PAIRS = 150
"""Pairs of stops that a start looks at: plenty for a start, and its cost stays linear in the stops."""
DIRECTIONS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=np.float64
)
"""Start directions (26, 3): faces, edges and corners of a cube."""


def distant_pairs(apart: BoolArray) -> tuple[IntArray, IntArray]:
    """First and second stops of the pairs where ``apart`` (k, k) holds, at most ``MAX_PAIRS``, evenly spread."""
    first, second = np.nonzero(apart)
    if len(first) <= MAX_PAIRS:
        return first, second
    # Multiples of the golden section spread evenly over the list and meet all steps between stops alike.
    chosen = np.unique((np.arange(MAX_PAIRS) * 0.6180339887498949 % 1.0 * len(first)).astype(np.int64))
    return first[chosen], second[chosen]


def linear_generator(
    kind: Kind,
    cameras: FloatArray,
    points: FloatArray,
    usable: BoolArray,
    pixels: FloatArray,
    sigmas: FloatArray,
    angles: FloatArray,
) -> FloatArray | None:
    """Generator (4, 4) by linear least squares over ordered pairs of stops, then the nearest exact one.

    A revolute joint takes a point ``M_k`` of stop k to ``M_k + sin Δ Ĥ M_k + (1 - cos Δ) Ĥ² M_k`` at stop l
    (4.27), linear in ``Ĥ`` and ``Ĥ²`` taken as unknowns of their own; seen in pixels of stop l, the heights
    drop out. Any steps will do, equal or not, and the union over pairs spans space for a planar target, too
    (5.4). ``points`` (k, m, 4), ``usable`` (c, k, m), ``pixels`` (c, k, m, 2), ``sigmas`` (c, k, m) [px],
    ``angles`` (k,). None where the solution is no rotation.
    """
    span = float(np.ptp(angles))
    first, second = distant_pairs(np.abs(angles[:, None] - angles[None, :]) > 0.2 * span)
    valid = finite_rows(points)
    pair, marker = np.nonzero(valid[first] & valid[second])
    here, there = first[pair], second[pair]
    step = angles[there] - angles[here]
    source = points[here, marker]
    blocks, rights = [], []
    for c, P in enumerate(cameras):
        keep = usable[c, there, marker]
        target = pixels[c, there, marker][keep]
        weight = 1.0 / (sigmas[c, there, marker][keep] * (points[there, marker][keep] @ P[2]))
        rows = (P[None, :2] - target[:, :, None] * P[None, 2:]) * weight[:, None, None]
        moment = rows[:, :, :, None] * source[keep][:, None, None, :]
        parts = (
            [np.sin(step[keep]), 2.0 * np.sin(0.5 * step[keep]) ** 2] if kind == "revolute" else [step[keep]]
        )
        blocks.append(
            np.concatenate([(part[:, None, None, None] * moment).reshape(-1, 16) for part in parts], axis=1)
        )
        rights.append(-np.einsum("kij,kj->ki", rows, source[keep]).ravel())
    system, right = np.concatenate(blocks), np.concatenate(rights)
    if not right.size:  # no two stops far apart show a marker in common
        return None
    # The scale of a point moved by the identity alone is fixed: the system is inhomogeneous, its unit
    # eigenvalue exact.
    solution = _robust_least_squares(system, right)
    try:
        matrix = solution[:16].reshape(4, 4)
        return (
            nearest_rotation_generator(matrix)
            if kind == "revolute"
            else nearest_translation_generator(matrix)
        )
    except GeometryError:
        return None  # no rotation in sight: the other start may see one


def nominal_generator(
    kind: Kind,
    cameras: FloatArray,
    points: FloatArray,
    usable: BoolArray,
    pixels: FloatArray,
    sigmas: FloatArray,
    angles: FloatArray,
) -> FloatArray | None:
    """Generator (4, 4) as if the canonical frame's nominal cameras were the true ones: a rigid motion.

    The motion between the two stops, of those far apart, that explains all stops best; arguments as for
    :func:`linear_generator`. Coarse, but bounded: it needs three markers at two stops, and is None without them.
    """
    upgrade = np.diag([1.0 / NOMINAL_FOCAL, 1.0 / NOMINAL_FOCAL, 1.0, 1.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        euclidean = points @ upgrade.T / points[..., 3:]
    valid = finite_rows(euclidean)
    first, second = distant_pairs(angles[None, :] - angles[:, None] > 0.5 * np.ptp(angles))
    best, least = None, np.inf
    for k, n in zip(first, second, strict=True):
        both = valid[k] & valid[n]
        if int(both.sum()) < 3:
            continue
        before, after = euclidean[k, both, :3], euclidean[n, both, :3]
        if kind == "revolute":
            twist = twist_between(before, after)
        else:
            twist = np.zeros((4, 4))
            twist[:3, 3] = (after - before).mean(axis=0) / (angles[n] - angles[k])
        generator = np.linalg.inv(upgrade) @ twist @ upgrade
        structure = common_points(generator, kind, points, angles)
        moved = np.einsum("kij,mj->kmi", exp_generator(kind, generator, angles), structure)
        images = np.einsum("cij,kmj->ckmi", cameras, moved)
        error = np.linalg.norm(images[..., :2] / images[..., 2:] - pixels, axis=-1)[usable]
        typical = float(np.median(error[np.isfinite(error)]))
        if typical < least:
            best, least = generator, typical
    return best


def turned_generators(points: FloatArray, angles: FloatArray) -> list[FloatArray]:
    """Generators (4, 4) of rotations about ``DIRECTIONS``, as if the cameras were nominal ones: each moves the
    markers' centroid along the trial's chord.

    ``points`` (k, m, 4), ``angles`` (k,). Noise excludes none of them, however little the markers turn.
    Empty where no two stops far apart have three markers in common.
    """
    upgrade = np.diag([1.0 / NOMINAL_FOCAL, 1.0 / NOMINAL_FOCAL, 1.0, 1.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        euclidean = points @ upgrade.T / points[..., 3:]
    valid = finite_rows(euclidean)
    common = valid.astype(np.int64) @ valid.T.astype(np.int64)
    spans = np.where(common >= 3, angles[None, :] - angles[:, None], 0.0)
    k, n = np.unravel_index(int(spans.argmax()), spans.shape)
    span = float(spans[k, n])
    if span < 0.5 * np.ptp(angles):
        return []
    both = valid[k] & valid[n]
    middles = [euclidean[stop, both, :3].mean(axis=0) for stop in (k, n)]
    return [np.linalg.inv(upgrade) @ twist_about(one, middles, span) @ upgrade for one in DIRECTIONS]


def twist_about(direction: FloatArray, middles: Sequence[FloatArray], span: float) -> FloatArray:
    """Unit twist (4, 4) about a ``direction`` (3,) that moves the markers' centroid as observed in the trial.

    The centre lies on the bisector of the chord, at half its length over tan(θ/2) to the side.
    """
    axis = direction / np.linalg.norm(direction)
    chord = middles[1] - middles[0]
    chord = chord - axis * (axis @ chord)
    centre = 0.5 * (middles[0] + middles[1]) + 0.5 * np.cross(axis, chord) / np.tan(0.5 * span)
    x, y, z = axis
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    twist[:3, 3] = -np.cross(axis, centre)
    return twist


def _robust_least_squares(system: FloatArray, right: FloatArray, rounds: int = 8) -> FloatArray:
    """Least squares by iterative re-weighting with Cauchy weights at the median residual."""
    scale = np.linalg.norm(system, axis=0)
    scale[scale == 0] = 1.0
    weights = np.ones(len(right))
    solution = np.zeros(system.shape[1])
    for _ in range(rounds):
        scaled = system / scale * weights[:, None]
        before, solution = solution, np.linalg.lstsq(scaled, right * weights, rcond=1e-12)[0] / scale
        if float(np.linalg.norm((solution - before) * scale)) < 1e-4 * float(
            np.linalg.norm(solution * scale)
        ):
            break
        error = np.abs(system @ solution - right)
        typical = float(np.median(error))
        if typical <= 0.0:
            break
        weights = 1.0 / np.sqrt(1.0 + (error / (3.0 * typical)) ** 2)
    return solution


def common_points(generator: FloatArray, kind: str, points: FloatArray, angles: FloatArray) -> FloatArray:
    """Markers (m, 4) at angle 0: median over stops of the points (k, m, 4) moved back there, depth 1; NaN if never
    seen.
    """
    back = exp_generator(kind, generator, -angles)
    moved = np.einsum("kij,kmj->kmi", back, points)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = moved / moved[..., 2:3]
    result = np.full(points.shape[1:], np.nan)
    for i in range(points.shape[1]):
        known = np.isfinite(moved[:, i]).all(axis=1)
        if known.any():
            result[i] = np.median(moved[known, i], axis=0)
    return result
