"""Cells of `bench scale` are what they say and take goals; exponents are those of the costs."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_sim.benchmarks.cycle import (
    JOINTS,
    MARKERS,
    CoreLoop,
    drive,
    exponents,
    power,
    rx90_with_facets,
    with_joints,
    with_markers,
)
from stereoservo_sim.world.synthetic import SyntheticCell


def test_exponents_are_those_of_the_costs() -> None:
    sizes = np.array([4.0, 16.0, 64.0, 256.0])
    assert power(sizes, 3.0 * sizes) == pytest.approx(1.0)
    assert power(sizes, 7.0 * sizes**0.5) == pytest.approx(0.5)
    rows = [
        {
            "markers": n,
            **{
                pace: {
                    "between frames": {"median": 50.0 + 0 * n},
                    "with frames": {"median": 2.0 * n**1.5},
                }
                for pace in ("tight", "paced")
            },
        }
        for n in sizes
    ]
    found = exponents("markers", rows)
    assert found["tight, between frames"] == pytest.approx({"all": 0.0, "last": 0.0})
    assert found["paced, with frames"] == pytest.approx({"all": 1.5, "last": 1.5})


@pytest.mark.parametrize(
    ("cell", "sizes"),
    [
        (with_markers(MARKERS[0]), (4, 2, 6)),
        (rx90_with_facets(16, 1), (16, 1, 6)),
        (with_joints(JOINTS[0]), (16, 2, 1)),
        (with_joints(JOINTS[-1]), (16, 2, 12)),
    ],
    ids=["markers", "camera", "joint", "joints"],
)
def test_the_cells_have_their_sizes_and_take_goals(cell: SyntheticCell, sizes: tuple[int, int, int]) -> None:
    assert (len(cell.body), len(cell.poses), len(cell.kinds)) == sizes
    pixels = cell.pixels(cell.home[None])
    assert np.isfinite(pixels).all()
    assert (np.abs(pixels - (320.0, 240.0)) < 600.0).all()
    loop = CoreLoop(cell, 1)
    drive(loop, "stereo", 25)
    assert np.any(loop.core.state.block.command)
