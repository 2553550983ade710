"""How the cost of a step of the core grows with markers, cameras and joints: microseconds tight and paced, between
frames and with them, and the exponent of a power law through them, an axis at a time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stereoservo.control.marker_groups import with_groups
from stereoservo.messages.goals import LawName
from stereoservo_sim.benchmarks.core_loop import CoreLoop, largest_cell, rx90_with_facets
from stereoservo_sim.benchmarks.cycle import KINDS, PACED_S, drive, of_kind
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell

LAW: LawName = "stereo"
MARKERS, CAMERAS, JOINTS = (4, 16, 64, 256), (1, 2, 4, 8), (1, 2, 4, 8, 12)
OTHER_MARKERS, OTHER_CAMERAS = 16, 2
"""What stands still while another axis grows; six joints then."""


def run_scale(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Step costs along each axis, with the exponents that are fitted to them."""
    axes: dict[str, tuple[Sequence[int], Callable[[int], SyntheticCell]]] = {
        "markers": (MARKERS, with_markers),
        "cameras": (CAMERAS, lambda n: rx90_with_facets(OTHER_MARKERS, n)),
        "joints": (JOINTS, with_joints),
    }
    total, done = sum(len(sizes) for sizes, _ in axes.values()), 0
    found: dict[str, Any] = {}
    for axis, (sizes, cell_of) in axes.items():
        rows = []
        for size in sizes:
            rows.append({axis: size, **step_costs(cell_of(size), 40 * repetitions, seed)})
            done += 1
            progress("cells", done, total)
        found[axis] = {"steps": rows, "exponents": exponents(axis, rows)}
    return {
        "axes": found,
        "law": LAW,
        "at": {"markers": OTHER_MARKERS, "cameras": OTHER_CAMERAS, "joints": 6},
    }


def with_markers(count: int) -> SyntheticCell:
    """The body of `rx90_with_facets` before two cameras; a single facet is as large as a body of several."""
    cell = rx90_with_facets(count, OTHER_CAMERAS)
    return cell if count > 4 else dataclasses.replace(cell, body=cell.body * (5.0, 5.0, 1.0))


def with_joints(count: int) -> SyntheticCell:
    """The last links of the largest cell's arm, as many as asked for, with the body of `rx90_with_facets` before two
    cameras.
    """
    small, large = rx90_with_facets(OTHER_MARKERS, OTHER_CAMERAS), largest_cell()
    return dataclasses.replace(
        large,
        base=large.frames(large.home)[len(large.kinds) - count],
        kinds=large.kinds[-count:], links=large.links[-count:], home=large.home[-count:],
        ranges=large.ranges[-count:], body=small.body, intrinsics=small.intrinsics, poses=small.poses,
        lenses=small.lenses,
    )  # fmt: skip


def step_costs(cell: SyntheticCell, count: int, seed: int) -> dict[str, Any]:
    """Microseconds of CPU of ``count`` steps between frames and of those with frames, tight and paced, while the law
    drives the arm.
    """
    loop = CoreLoop(cell, seed, with_groups(exact_model(cell)))
    drive(loop, LAW, 50)
    found: dict[str, Any] = {}
    for name, pause_s in (("tight", 0.0), ("paced", PACED_S)):
        loop.times.clear()
        drive(loop, LAW, count, pause_s)
        found[name] = {label: summary(of_kind(loop.times, kind), 1e6) for kind, label in KINDS.items()}
    return found


def exponents(axis: str, rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Exponents of power laws: ``all`` is fitted to all sizes, ``last`` to the two largest, where what does not grow
    hides least.
    """
    sizes = [row[axis] for row in rows]
    found: dict[str, dict[str, float]] = {}
    for pace in ("tight", "paced"):
        for label in KINDS.values():
            costs = [row[pace][label]["median"] for row in rows]
            found[f"{pace}, {label}"] = {
                "all": power(sizes, costs),
                "last": power(sizes[-2:], costs[-2:]),
            }
    return found


def power(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent of the power law through the costs, by least squares of logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])
