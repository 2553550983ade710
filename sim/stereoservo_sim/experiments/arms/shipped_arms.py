"""Experiment: self-calibration of the shipped arms, each before its cell's cameras, from many configurations.

A seed draws the configuration, near the cell's base, the noise and the number of stops; each joint moves as far as both
images allow. Evaluated as `random_rigs`: a success is a model that is as true as it says.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from stereoservo.kinematics.model import pinhole
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.twist import TwistJointDriver, seen_as_joints
from stereoservo_sim.cells import ARMS, shipped_cell_path
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.experiments.arms.random_rigs import judged_case
from stereoservo_sim.experiments.experiment import ExperimentError, show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.camera_rig import inverse_pose
from stereoservo_sim.world.random_cells import NOISES, STOPS, RandomCase, visible_ranges
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.synthetic import SyntheticCell

SEEDS = 5
"""Cases of each arm by default."""
AROUND = {"revolute": 0.2, "prismatic": 0.05}
"""How far from the cell's base the drawn configuration may be [rad or m]."""


def run_shipped_arms(
    seeds: int = SEEDS, cell: str = "", seed: int = 0, progress: ProgressCall | None = None
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1`` of every shipped arm, or of ``cell`` alone: rows, and what is no success.

    Raises ExperimentError for a cell that is not one of these, ValueError for fewer than one case.
    """
    if seeds < 1:
        raise ValueError(f"{seeds} cases; at least 1 is needed")
    if cell and cell not in ARMS:
        raise ExperimentError(
            "option", f"--cell {cell!r}: no arm of that name is shipped; there are {', '.join(ARMS)}"
        )
    rows, failed = [], []
    names = (cell,) if cell else ARMS
    for k, name in enumerate(names):
        verdicts = []
        for number in range(seeds):
            verdicts.append(judged_case(arm_case(name, seed + number)))
            if progress is not None:
                progress("cases", k * seeds + number + 1, seeds * len(names))
        good = [verdict for verdict in verdicts if verdict.outcome == "success"]
        errors = [verdict.rms_px / verdict.sigma_px for verdict in good]
        rows.append(
            {
                "condition": name,
                "joints": len(_cell(name).base),
                "cases": seeds,
                "success": len(good),
                "wilson_95": list(wilson(len(good), seeds)),
                "strata": dict(Counter(verdict.stratum for verdict in good)),
                "held_out_error_sigmas": float(np.median(errors)) if errors else None,
                "seconds_median": float(np.median([verdict.seconds for verdict in verdicts])),
            }
        )
        failed += [msgspec.structs.asdict(verdict) for verdict in verdicts if verdict.outcome != "success"]
    return {
        "experiment": "shipped-arms", "seed": seed, "seeds": seeds, "rows": rows, "not_successes": failed,
        "thesis": {"note": "none: the thesis calibrates one robot (5.5)"},
    }  # fmt: skip


def arm_case(name: str, seed: int) -> RandomCase:
    """Case ``seed`` of the shipped cell ``name``, reproducible bit for bit."""
    cell = _cell(name)
    rng = np.random.default_rng([seed, 7])
    low, high = (
        np.array([getattr(j, f"position_{side}") for j in cell.robot.joints]) for side in ("min", "max")
    )
    around = np.array([AROUND[joint.kind] for joint in cell.robot.joints])
    redraws = 0
    while True:
        home = np.clip(cell.base + rng.uniform(-1.0, 1.0, len(around)) * around, low + around, high - around)
        found = twin(cell, home)
        if found.in_view(home[None], 4.0).all():
            break
        redraws += 1
    ranges = np.minimum(visible_ranges(found), np.minimum(home - low, high - home))
    sigma = float(np.exp(rng.uniform(*np.log(NOISES))))
    stops = int(rng.integers(STOPS[0], STOPS[1] + 1))
    return RandomCase(seed, replace(found, ranges=ranges), sigma, stops, name, "two_faces", redraws)


def twin(cell: SimulatedCell, home: FloatArray) -> SyntheticCell:
    """The cell around ``home`` (n,) as a synthetic one: the same pixels of the same markers, hidden or not."""
    stands = cell.stand is None
    in_rig = cell.rig.world_to_rig if cell.stand is None else inverse_pose(cell.stand)
    poses = [
        camera.world_to_camera @ inverse_pose(in_rig) if stands else camera.world_to_camera
        for camera in cell.rig.cameras
    ]
    return SyntheticCell(
        base=in_rig @ cell.robot.base,
        kinds=tuple(joint.kind for joint in cell.robot.joints),
        links=tuple(cell.robot.links),
        body=cell.body.marker_points,
        intrinsics=np.array([camera.K for camera in cell.rig.cameras]),
        poses=np.array(poses),
        home=home,
        ranges=np.zeros(len(home)),
        lenses=np.tile(pinhole(), (len(poses), 1)),
        mount="eye_to_hand" if stands else "eye_in_hand",
    )


def _cell(name: str) -> SimulatedCell:
    path = shipped_cell_path(name)
    file = load_cell_file(path)
    cell = true_cell(file, path.parent)
    return (
        seen_as_joints(file.joints.options, cell) if file.joints.driver == TwistJointDriver.driver else cell
    )


def show_shipped_arms(answer: dict[str, Any], console: Console) -> None:
    """Print rows and what failed."""
    show_rows(answer, console)
    for case in answer["not_successes"]:
        console.print(
            f"{case['arm']}, seed {case['seed']}: {case['outcome']} {case['code']} {case['message']}"
        )
