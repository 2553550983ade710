"""Experiment: drives that follow their velocity with a lag, or obey late, and goals with and without damping (thesis
9.3), by the servo core with the true model.

Cells are those of `random_rigs`, all joints alike, and the ways short, so that gain and lag decide and not the joints'
limits. The overshoot is the farthest that a marker goes beyond its set-point in an image, along its way, over the
longest way of one; the time is until the goal is reached.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from stereoservo_sim.experiments.arms.late_drives import overshoot_of
from stereoservo_sim.experiments.experiment import draw_sorted, show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.tasks.driven_cell import DrivenCell, GoalEnd, Imperfections
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.random_cells import random_case

DRIVES = {
    "lag 0.1 s": Mechanics(lag_s=0.1), "lag 0.2 s": Mechanics(lag_s=0.2), "0.1 s late": Mechanics(delay_s=0.1),
}  # fmt: skip
SETTINGS = ((2.0, 0.0), (4.0, 0.0), (8.0, 0.0), (4.0, 0.5), (8.0, 0.5), (8.0, 0.7))
"""Gain [1/s] and damping."""
NOISE_PX = 0.05
SHARE, DRAWS = 0.08, 200
"""Of the joints' ranges from which goals are drawn, and how many."""
TIME_LIMIT_S = 20.0
LAW = "stereo"


def damped_goal(seed: int, drive: str, gain: float, damping: float) -> tuple[GoalEnd, float] | None:
    """How a goal of the case of ``seed`` ended and its overshoot; None where the case has no goal in view."""
    case = random_case(seed)
    drawn = case.cell.held_out(np.random.default_rng([seed, 19]), DRAWS, SHARE)
    places = drawn[case.cell.in_view(drawn, 10.0).all(axis=(0, 2))][:2]
    if len(places) < 2:
        return None
    wrong = Imperfections([DRIVES[drive]] * len(case.cell.home), noise_px=NOISE_PX)
    wanted = case.cell.pixels(places[1][None])[:, 0]
    driven = DrivenCell(case.cell, exact_model(case.cell), places[0], seed, wrong, law=LAW)
    end = driven.run_goal(wanted, gain=gain, damping=damping, time_limit_s=TIME_LIMIT_S)
    return end, overshoot_of(case.cell.pixels(np.array(driven.path)), wanted)


def run_damped_drives(seeds: int = 10, seed: int = 0, progress: ProgressCall | None = None) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1`` by every drive, gain and damping; the JSON object of the command."""
    started = time.process_time()
    rows: list[dict[str, Any]] = []
    curves: dict[str, list[float]] = {}
    conditions = [(drive, *setting) for drive in DRIVES for setting in SETTINGS]
    for k, (drive, gain, damping) in enumerate(conditions):
        flown = []
        for s in range(seeds):
            flown.append(damped_goal(seed + s, drive, gain, damping))
            if progress is not None:
                progress("conditions and seeds", k * seeds + s + 1, len(conditions) * seeds)
        known = [one for one in flown if one is not None]
        reached = [(end, beyond) for end, beyond in known if end.kind == "goal_reached"]
        lost = Counter(end.codes[0] if end.codes else "-" for end, _ in known if end.kind != "goal_reached")
        beyond = [over for _, over in known]
        curves[f"{drive}, gain {gain:g}, damping {damping:g}"] = beyond
        rows.append(
            {
                "drives": drive,
                "gain": gain,
                "damping": damping,
                "reached": f"{len(reached)} of {len(known)}",
                "seconds": float(np.median([end.seconds for end, _ in reached])) if reached else None,
                "overshoot": float(np.median(beyond)) if beyond else None,
                "largest": max(beyond, default=None),
                "not_reached": ", ".join(f"{count} {code}" for code, count in lost.items()),
            }
        )
    return {
        "experiment": "damped-drives",
        "seed": seed,
        "seeds": seeds,
        "title": f"damped-drives: cases {seed} to {seed + seeds - 1}, law {LAW}; seconds and overshoot: medians",
        "rows": rows,
        "overshoots": curves,
        "cpu_s": round(time.process_time() - started, 1),
        "thesis": {"note": "9.3 proposes PD control for tracking; it gives no figures"},
    }


def draw_damped_drives(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Overshoot by drive, gain and damping. Raises OSError."""
    return draw_sorted(answer["overshoots"], "overshoot, of the longest way", folder / "damped_drives.png")


def show_damped_drives(answer: dict[str, Any], console: Console) -> None:
    """Print the rows."""
    show_rows(answer, console)
