"""Experiment: arms with the mechanics of each preset, at work for ten virtual minutes in the servo core: goals in
pictures, one after the other, and every verdict of the watch, which has nothing to find, for nothing moves but the arm.

Cases are those of `random_rigs`; the model is the one that the arm learns. A range of seeds is continued with another.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from stereoservo.calibration.trial_data import CalibrationError
from stereoservo_sim.experiments.arms.imperfect_arms import DRAWS, SHARE, model_of
from stereoservo_sim.experiments.experiment import draw_sorted, show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.tasks.driven_cell import RATE_HZ, DrivenCell, Imperfections
from stereoservo_sim.world.mechanics import PRESETS, preset
from stereoservo_sim.world.presets import MechanicsPreset
from stereoservo_sim.world.random_cells import random_case

MINUTES = 10.0
NOISE_PX = 0.05
PAUSE_S = 1.0
"""Between goals."""


class PresetVerdict(msgspec.Struct, frozen=True):
    """A case at work with a preset: ``minutes`` of virtual time, how its goals ended, how long [s] those took that were
    reached, and the ``verdicts`` of the watch. ``code``: why there is no model.
    """

    seed: int
    preset: str
    minutes: float = 0.0
    ends: dict[str, int] = {}
    seconds: tuple[float, ...] = ()
    verdicts: tuple[str, ...] = ()
    code: str = ""


def watched_preset(seed: int, name: MechanicsPreset, minutes: float = MINUTES) -> PresetVerdict:
    """The case of ``seed`` at work with the mechanics ``name``."""
    case = random_case(seed)
    wrong = Imperfections(preset(name, len(case.cell.home)), noise_px=NOISE_PX)
    try:
        model = model_of(case, wrong, "self")
    except CalibrationError as error:
        return PresetVerdict(seed, name, code=error.code)
    drawn = case.cell.held_out(np.random.default_rng([seed, 7]), DRAWS, SHARE)
    places = drawn[case.cell.in_view(drawn, 10.0).all(axis=(0, 2))]
    if len(places) < 2:
        return PresetVerdict(seed, name, code="no_goals")
    driven = DrivenCell(case.cell, model, places[0], seed, wrong)
    driven.verdicts.clear()
    ends: list[str] = []
    seconds: list[float] = []
    cycles = round(60.0 * minutes * RATE_HZ)
    while len(driven.path) < cycles:
        wanted = case.cell.pixels(places[(len(ends) + 1) % len(places)][None])[:, 0]
        end = driven.run_goal(wanted)
        ends.append(end.kind if end.kind in ("goal_reached", "refused") else ", ".join(end.codes))
        if end.kind == "goal_reached":
            seconds.append(end.seconds)
        driven.rest(PAUSE_S)
    at_work = len(driven.path) / RATE_HZ / 60.0
    return PresetVerdict(seed, name, at_work, dict(Counter(ends)), tuple(seconds), tuple(driven.verdicts))


def run_preset_verdicts(
    seeds: int = 1, seed: int = 0, progress: ProgressCall | None = None
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1`` with every preset: minutes at work, goals and verdicts of each."""
    started = time.process_time()
    cases = []
    for k in range(seeds):
        for i, name in enumerate(PRESETS):
            cases.append(watched_preset(seed + k, name))
            if progress is not None:
                progress("presets", k * len(PRESETS) + i + 1, seeds * len(PRESETS))
    rows = [
        {
            "preset": case.preset, "seed": case.seed, "minutes": case.minutes, "goals": sum(case.ends.values()),
            "reached": case.ends.get("goal_reached", 0), "refused": case.ends.get("refused", 0),
            "verdicts": ", ".join(case.verdicts) or case.code or "none",
        }
        for case in cases
    ]  # fmt: skip
    return {
        "experiment": "preset-verdicts",
        "seed": seed,
        "seeds": seeds,
        "title": f"preset-verdicts: cases {seed} to {seed + seeds - 1}",
        "rows": rows,
        "ends": {f"{case.preset} {case.seed}": case.ends for case in cases},
        "seconds": {name: [s for c in cases if c.preset == name for s in c.seconds] for name in PRESETS},
        "cpu_s": round(time.process_time() - started, 1),
        "thesis": {"note": "none: the thesis has joints without errors"},
    }


def draw_preset_verdicts(answer: dict[str, Any], folder: Path) -> list[Path]:
    """How long the goals that are reached take, by preset. Raises OSError."""
    return draw_sorted(answer["seconds"], "time to the goal [s]", folder / "preset_verdicts.png")


def show_preset_verdicts(answer: dict[str, Any], console: Console) -> None:
    """Print minutes, goals and verdicts by preset, and how the goals ended."""
    show_rows(answer, console)
    for name, ends in answer["ends"].items():
        console.print(f"{name}: {ends}")
