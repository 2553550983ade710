"""Experiment: drives whose commands arrive 100 to 200 ms late, held by friction of up to 10 mrad/s, which nobody has
stated: goals by the servo core with the model that the arm has learnt, and beside it with the true one.

Cases are those of `random_rigs`, all joints alike. The model is fitted to the arm's own trial motions. Each goal is
that of a core that has just been started with its model, and so knows no delay: what the trial motions have shown of it
is forgotten. The overshoot is the farthest that a marker goes beyond its set-point in an image, along its way, over the
longest way of one. A range of seeds is continued with another.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.experiment import draw_sorted, show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import count_row
from stereoservo_sim.tasks.driven_cell import TOLERANCE_PX, DrivenCell, Imperfections
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.random_cells import random_case

DELAYS_S, FRICTION = (0.1, 0.2), 0.01
"""[s], [rad/s]"""
NOISE_PX = 0.05
SHARE = 0.5
DRAWS = 200
WITHIN = 2.0
"""Tolerances of the true error at rest."""
MORE = 0.01
"""Overshoot that counts as more than the true model's, of the longest way."""
LONG = 0.5
"""Of the longest way in the images, from which on a marker's overshoot counts."""
MODELS = ("learnt", "true")


class DriveVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: by the model, how the goal ended, its true error [px] at rest and the overshoot. ``code``: why
    there is none.
    """

    seed: int
    delay_s: float
    friction: float
    ends: dict[str, str] = {}
    errors_px: dict[str, float] = {}
    overshoot: dict[str, float] = {}
    code: str = ""


def judged_drives(seed: int) -> DriveVerdict:
    """Outcome of the case of ``seed``."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 10])
    delay_s, friction = float(rng.uniform(*DELAYS_S)), float(rng.uniform(0.0, FRICTION))
    drawn = case.cell.held_out(rng, DRAWS, SHARE)
    places = drawn[case.cell.in_view(drawn, 10.0).all(axis=(0, 2))][:2]
    if len(places) < 2:
        return DriveVerdict(seed, delay_s, friction, code="no_goals")
    wrong = Imperfections(
        [Mechanics(delay_s=delay_s, dead_speed=friction)] * len(case.cell.home), noise_px=NOISE_PX
    )
    try:
        trials = DrivenCell(case.cell, None, case.cell.home, seed, wrong).trials()
        learnt = fit_model(trials, epoch=1).model
    except CalibrationError as error:
        return DriveVerdict(seed, delay_s, friction, code=error.code)
    wanted = case.cell.pixels(places[1][None])[:, 0]
    ends: dict[str, str] = {}
    errors: dict[str, float] = {}
    overshoot: dict[str, float] = {}
    for name, model in zip(MODELS, (learnt, exact_model(case.cell)), strict=True):
        driven = DrivenCell(case.cell, model, places[0], seed, wrong)
        end = driven.run_goal(wanted)
        shown, _ = driven.rest(1.0)
        ends[name] = end.kind if end.kind == "goal_reached" or not end.codes else end.codes[0]
        errors[name] = float(np.linalg.norm(shown - wanted, axis=-1).max())
        overshoot[name] = overshoot_of(case.cell.pixels(np.array(driven.path)), wanted)
    return DriveVerdict(seed, delay_s, friction, ends, errors, overshoot)


def overshoot_of(pixels: FloatArray, wanted: FloatArray) -> float:
    """Of pixels (c, k, m, 2) on their way to ``wanted`` (c, m, 2), over the longest way."""
    way = wanted - pixels[:, 0]
    length = np.linalg.norm(way, axis=-1)
    beyond = ((pixels - wanted[:, None]) * (way / np.maximum(length, 1e-9)[..., None])[:, None]).sum(axis=-1)
    farthest = beyond.max(axis=1)[length >= LONG * length.max()]
    return max(0.0, float(farthest.max() / length.max()))


def run_late_drives(seeds: int = 10, seed: int = 0, progress: ProgressCall | None = None) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: goals within tolerance and overshoot beside that of the true model."""
    started = time.process_time()
    cases = []
    for k in range(seeds):
        cases.append(judged_drives(seed + k))
        if progress is not None:
            progress("cases", k + 1, seeds)
    known = [case for case in cases if not case.code]
    driven = [case for case in known if case.ends["true"] == "goal_reached"]
    within = [
        c
        for c in driven
        if c.ends["learnt"] == "goal_reached" and c.errors_px["learnt"] <= WITHIN * TOLERANCE_PX
    ]
    more = [case for case in within if case.overshoot["learnt"] > case.overshoot["true"] + MORE]
    return {
        "experiment": "late-drives",
        "seed": seed,
        "seeds": seeds,
        "title": f"late-drives: cases {seed} to {seed + seeds - 1}, of those that the true model reaches",
        "rows": [
            count_row("reached, within tolerance", len(within), len(driven)),
            count_row("more overshoot", len(more), len(within)),
        ],
        "overshoot": {
            name: float(np.max([case.overshoot[name] for case in within])) if within else None
            for name in MODELS
        },
        "overshoots": {name: [case.overshoot[name] for case in within] for name in MODELS},
        "ends": {name: dict(Counter(case.ends[name] for case in known)) for name in MODELS},
        "no_case": dict(Counter(case.code for case in cases if case.code)),
        "lost": [msgspec.to_builtins(case) for case in driven if case not in within]
        + [msgspec.to_builtins(c) for c in more],
        "cpu_s": round(time.process_time() - started, 1),
        "thesis": {"note": "none: the thesis has drives without delay"},
    }


def draw_late_drives(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Overshoot with the model that was learnt and with the true one. Raises OSError."""
    return draw_sorted(answer["overshoots"], "overshoot, of the longest way", folder / "late_drives.png")


def show_late_drives(answer: dict[str, Any], console: Console) -> None:
    """Print counts, the largest overshoots, how goals ended, and every case beyond."""
    show_rows(answer, console)
    console.print(
        f"largest overshoot, of the way: {answer['overshoot']}; ends: {answer['ends']}; {answer['no_case']}"
    )
    for case in answer["lost"]:
        console.print(str(case))
