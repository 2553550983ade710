"""Synthetic cells with imperfect arms: gravity loads, directions of approach, and trial data."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from stereoservo.calibration.trial_data import TrialData
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.world.mechanics import Mechanics, at_rest, gravity_torques
from stereoservo_sim.world.synthetic import SyntheticCell


def synthetic_load(cell: SyntheticCell, q: FloatArray) -> FloatArray:
    """Loads (n,) of a synthetic arm at ``q`` (n,) as shares of each joint's load with the arm stretched out.

    Every link has the same weight, with its centre halfway to the next joint, on an upright base: its z axis, the first
    joint's, points up. A prismatic joint bears the component of its links' weight along its axis, as a share.
    """
    frames = cell.frames(q)
    origins, axes = frames[:, :3, 3], frames[:-1, :3, 2]
    up = cell.base[:3, 2]
    count = len(q)
    centres, masses = 0.5 * (origins[:-1] + origins[1:]), np.ones(count)
    lengths = np.linalg.norm(np.diff(origins, axis=0), axis=1)
    ahead = np.cumsum(lengths)
    # Vector from joint j to the middle of link k.
    levers = np.triu(ahead[None, :] - 0.5 * lengths[None, :] - (ahead - lengths)[:, None])
    torques = gravity_torques(origins[:-1], axes, centres, masses, -up)
    slides = np.array([kind == "prismatic" for kind in cell.kinds])
    along: FloatArray = -axes @ up
    return np.where(slides, along, torques / np.maximum(levers.sum(axis=1), 1e-9))


def approaches(positions: FloatArray, start: FloatArray) -> FloatArray:
    """Directions (s, n), -1, 0 or 1, in which each joint last moved on the path from ``start`` (n,) through
    ``positions`` (s, n); 0: not moved.
    """
    steps = np.sign(np.diff(np.vstack([start, positions]), axis=0))
    for k in range(1, len(steps)):
        steps[k] = np.where(steps[k] == 0.0, steps[k - 1], steps[k])
    return steps


def links_and_readings(
    cell: SyntheticCell, mechanics: Sequence[Mechanics], motors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Link angles and readings (s, n) at rest at motor angles (s, n), visited in this order from the cell's home."""
    loads = np.array([synthetic_load(cell, q) for q in motors])
    return at_rest(mechanics, motors, loads, approaches(motors, cell.home))


def mechanical_trials(
    cell: SyntheticCell,
    mechanics: Sequence[Mechanics],
    sigma: float,
    rng: np.random.Generator,
    stops: int = 9,
    positions: tuple[FloatArray, IntArray] | None = None,
) -> TrialData:
    """Trial data as of :meth:`SyntheticCell.trials`: positions reported by the encoders, pixels of the links."""
    motors, moved = cell.stops(stops) if positions is None else positions
    links, readings = links_and_readings(cell, mechanics, motors)
    seen = cell.trials(sigma, rng, positions=(links, moved))
    return msgspec.structs.replace(seen, positions=readings)
