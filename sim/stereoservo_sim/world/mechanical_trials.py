"""Synthetic cells whose arms are not perfect: gravity loads, directions of approach, and trial data."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from stereoservo.calibration.trial_data import TrialData
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.world.mechanics import Mechanics, at_rest, gravity_torques
from stereoservo_sim.world.synthetic import SyntheticCell


def synthetic_load(cell: SyntheticCell, q: FloatArray) -> FloatArray:
    """Loads (n,) of a synthetic arm at ``q`` (n,) as shares of what each joint would bear stretched out.

    Every link weighs the same, with its centre halfway to the next joint, under a base that stands upright: its z axis,
    the first joint's, points up. A prismatic joint bears the share of its links' weight along its axis.
    """
    frames = cell.frames(q)
    origins, axes = frames[:, :3, 3], frames[:-1, :3, 2]
    up = cell.base[:3, 2]
    count = len(q)
    centres, masses = 0.5 * (origins[:-1] + origins[1:]), np.ones(count)
    lengths = np.linalg.norm(np.diff(origins, axis=0), axis=1)
    ahead = np.cumsum(lengths)
    # Of link k from joint j: what lies between them, and half of the link itself.
    levers = np.triu(ahead[None, :] - 0.5 * lengths[None, :] - (ahead - lengths)[:, None])
    torques = gravity_torques(origins[:-1], axes, centres, masses, -up)
    slides = np.array([kind == "prismatic" for kind in cell.kinds])
    along: FloatArray = -axes @ up
    return np.where(slides, along, torques / np.maximum(levers.sum(axis=1), 1e-9))


def approaches(positions: FloatArray, start: FloatArray) -> FloatArray:
    """Directions (s, n), -1, 0 or 1, in which each joint last moved on its way from ``start`` (n,) through
    ``positions`` (s, n); 0: not at all.
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
    """Trial data as of :meth:`SyntheticCell.trials`: positions that the encoders report, pixels of the links."""
    motors, moved = cell.stops(stops) if positions is None else positions
    links, readings = links_and_readings(cell, mechanics, motors)
    seen = cell.trials(sigma, rng, positions=(links, moved))
    return msgspec.structs.replace(seen, positions=readings)
