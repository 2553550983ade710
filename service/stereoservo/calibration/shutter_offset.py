"""Delay of the cameras' shutters after their stamps, relative to the joints' stamps, from the observations on the
paths between the stops of the trial motions.

On such a path one joint moves. The model gives this joint's position in each frame; the joint's samples give the time
of that position. A position difference that is constant along a path is not due to time: play of the joint, once it is
taken up, or its zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np

from stereoservo.calibration.trial_data import PathObservations
from stereoservo.geometry.distortion import undistort
from stereoservo.kinematics.covariance import predicted_pixels
from stereoservo.kinematics.model import CellModel, ShutterOffset
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

LEAST_TRAVEL = {"revolute": 0.01, "prismatic": 0.002}
"""Shortest travel of the joint [rad, m] on a path that is used."""
ALONE = 0.02
"""Largest share of that travel by which another joint may move."""
LONGEST_S, GRID_S = 0.3, 0.005
"""Range of offsets, and their spacing in the initial grid [s]."""
STEPS = 3
STEP = 1e-5
"""Joint step [rad or m] of difference quotients."""
SLOPE_S = 0.01
"""Half of the interval over which a joint's speed is computed [s]."""
FAR_SIGMAS = 4.0
FEWEST = 20
"""Least number of a camera's frames with the joint in motion."""
FEWEST_FRAMES = 4
PLAY = 0.03
"""Largest play [rad or m]: travel of a joint before its link moves."""
MOVING = 0.1
"""Share of a path's largest speed above which a joint counts as moving."""
LEAST_DEVIATION_S = 1e-4


_Series = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Samples of a joint (times and positions), and frames of a camera (stamps and the joint positions they show)."""


class _JointPath(NamedTuple):
    """One path of one joint: its samples ``times`` (j,), ``positions`` (j,); frames of each camera: stamps and the
    joint positions they show.
    """

    times: FloatArray
    positions: FloatArray
    seen: tuple[tuple[FloatArray, FloatArray], ...]


def with_shutter_offsets(model: CellModel, path: PathObservations | None) -> CellModel:
    """The model with the offsets estimated on the paths between its stops, if these were recorded."""
    return model if path is None else msgspec.structs.replace(model, shutter_offsets=shutter_offsets(model, path))


def shutter_offsets(model: CellModel, path: PathObservations) -> tuple[ShutterOffset, ...]:
    """Offsets of the cameras with enough frames of moving joints."""
    paths = list(_joint_paths(model, path))
    found = []
    for c, camera in enumerate(model.cameras):
        series = [(w.times, w.positions, *w.seen[c]) for w in paths if len(w.seen[c][0]) > 2]
        if series:
            offset = _aligned(series)
            if offset is not None:
                found.append(ShutterOffset(camera.name, *offset))
    return tuple(found)


def _joint_paths(model: CellModel, path: PathObservations) -> Iterator[_JointPath]:
    for number in np.unique(path.joint_ways):
        of_path = path.joint_ways == number
        times, positions = path.joint_times[of_path], path.positions[of_path]
        travel = np.ptp(positions, axis=0)
        joint = int(travel.argmax())
        others = np.delete(travel, joint).max(initial=0.0)
        if travel[joint] < LEAST_TRAVEL[model.joint_kinds[joint]] or others > ALONE * travel[joint]:
            continue
        seen: list[tuple[FloatArray, FloatArray]] = []
        for c in range(len(model.cameras)):
            rows = np.flatnonzero((path.ways == number) & (path.cameras == c))
            if not len(rows):
                seen.append((np.zeros(0), np.zeros(0)))
                continue
            start = np.array([np.interp(path.times[rows], times, q) for q in positions.T]).T
            shown, known = _joint_by_pictures(model, c, joint, start, path, rows)
            seen.append((path.times[rows][known], shown[known]))
        yield _JointPath(times, positions[:, joint], tuple(seen))


def _joint_by_pictures(
    model: CellModel, camera: int, joint: int, start: FloatArray, path: PathObservations, rows: IntArray
) -> tuple[FloatArray, BoolArray]:
    """Position (f,) of a joint shown by each frame, with the others as in ``start`` (f, n), and mask of valid ones."""
    column = {marker: i for i, marker in enumerate(model.marker_ids)}
    index = np.array([column.get(i, -1) for i in path.markers[rows].reshape(-1).tolist()], dtype=np.int64)
    index = index.reshape(len(rows), -1)
    seen = (index >= 0) & np.isfinite(path.pixels[rows]).all(axis=-1)
    lens = model.cameras[camera].lens
    ideal = undistort(lens, np.where(seen[..., None], path.pixels[rows], lens[1:3]))
    seen &= np.isfinite(ideal).all(axis=-1)
    straight = _one_pinhole(model, camera)
    positions, shift = start.copy(), np.zeros(start.shape[1])
    shift[joint] = STEP
    at = np.arange(len(rows))[:, None], np.maximum(index, 0)
    for _ in range(STEPS):
        here = predicted_pixels(straight, positions)[0][at]
        slope = (predicted_pixels(straight, positions + shift)[0][at] - here) / STEP
        slope = np.where(seen[..., None], slope, 0.0)
        residual = np.where(seen[..., None], ideal - here, 0.0)
        square = (slope * slope).sum(axis=(1, 2))
        positions[:, joint] += (slope * residual).sum(axis=(1, 2)) / np.maximum(square, 1e-12)
    shown: FloatArray = positions[:, joint]
    return shown, (square > 0.0) & np.isfinite(shown)


def _one_pinhole(model: CellModel, camera: int) -> CellModel:
    """The model with only one of its cameras, without its lens."""
    chosen = model.cameras[camera]
    lens = chosen.lens.copy()
    lens[[0, *range(4, len(lens))]] = 0.0
    return msgspec.structs.replace(model, cameras=(msgspec.structs.replace(chosen, lens=lens),))


def _aligned(series: list[_Series]) -> tuple[float, float] | None:
    """Delay [s] of the joint positions shown by the frames relative to the joint samples, with its standard deviation;
    None if too few frames show motion.
    """
    kept = [np.ones(len(stamps), dtype=bool) for _, _, stamps, _ in series]
    grid = np.arange(-LONGEST_S, LONGEST_S + 0.5 * GRID_S, GRID_S)
    costs = [
        sum(float((_residual(path, offset, use) ** 2).sum()) for path, use in zip(series, kept, strict=True))
        for offset in grid.tolist()
    ]
    offset, deviation = float(grid[int(np.argmin(costs))]), np.inf
    for _ in range(2 * STEPS):
        residual = [_residual(path, offset, use) for path, use in zip(series, kept, strict=True)]
        slopes = [_speeds(path, offset, use) for path, use in zip(series, kept, strict=True)]
        y, v = np.concatenate(residual), np.concatenate(slopes)
        square = float((v * v).sum())
        moving = sum(int((np.abs(s) > MOVING * np.abs(s).max(initial=0.0)).sum()) for s in slopes)
        if moving < FEWEST or not square > 0.0:
            return None
        step = float((v * y).sum()) / square
        offset = float(np.clip(offset + step, -LONGEST_S, LONGEST_S))
        scale = 1.4826 * float(np.median(np.abs(y - step * v)))
        deviation = float(np.sqrt((v * v * (y - step * v) ** 2).sum())) / square  # jitter grows with the speed
        for k, path in enumerate(series):
            use = _beyond_play(path, offset)
            every = _residual(path, offset, np.ones(len(use), dtype=bool))
            use &= np.abs(every - np.median(every[use])) <= max(FAR_SIGMAS * scale, 1e-12)
            kept[k] = use
    return offset, max(deviation, LEAST_DEVIATION_S)


def _beyond_play(path: _Series, offset: float) -> BoolArray:
    """Mask of the frames in which the joint has taken up its play; all frames if the path is too short for that."""
    times, positions, stamps, _ = path
    travel = np.abs(np.interp(stamps + offset, times, positions) - positions[0])
    beyond: BoolArray = travel > min(PLAY, 0.5 * float(travel.max()))
    return beyond if beyond.sum() >= FEWEST_FRAMES else np.ones(len(stamps), dtype=bool)


def _residual(path: _Series, offset: float, use: BoolArray) -> FloatArray:
    """Joint positions shown by the frames minus samples ``offset`` later than stamped, less their mean."""
    times, positions, stamps, shown = path
    residual = (shown - np.interp(stamps + offset, times, positions))[use]
    return np.asarray(residual - residual.mean()) if len(residual) else residual


def _speeds(path: _Series, offset: float, use: BoolArray) -> FloatArray:
    times, positions, stamps, _ = path
    at = (stamps + offset)[use]
    speed = (np.interp(at + SLOPE_S, times, positions) - np.interp(at - SLOPE_S, times, positions)) / (2.0 * SLOPE_S)
    return np.asarray(speed - speed.mean()) if len(speed) else speed
