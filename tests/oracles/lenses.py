"""The simulated cell with other lenses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from stereoservo_sim.world.simulated_cell import SimulatedCell


def with_lenses(cell: SimulatedCell, k1: Mapping[str, float]) -> SimulatedCell:
    """The same cell with lenses of ``k1`` by the cameras' names; the others keep theirs."""
    cameras = tuple(replace(camera, k1=k1.get(camera.name, camera.k1)) for camera in cell.rig.cameras)
    return replace(cell, rig=replace(cell.rig, cameras=cameras))
