"""Experiment: cameras whose pictures are 0 to 150 ms older than their stamps tell, with up to 20 ms of jitter, and
nobody has stated it: the trial motions show it, the model states it, goals are driven with it.

Each case is a cell of `random_rigs` with a perfect arm. Its trial motions are those of the servo core; a goal is driven
with the model as fitted, with the true offset in its place, and with none. A range of seeds is continued with another.
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
from stereoservo.kinematics.model import ShutterOffset
from stereoservo_sim.experiments.experiment import draw_sorted, show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import count_row
from stereoservo_sim.tasks.driven_cell import DrivenCell, Imperfections
from stereoservo_sim.world.random_cells import random_case

LATEST_S, JITTER_S = 0.15, 0.02
"""[s] The largest of each."""
NOISE_PX = 0.05
WITHIN_S = 0.002
"""[s] Of the true mean offset: what may be left."""
SHARE = 0.5
"""Of the trials' ranges, in which the goal is."""
DRAWS = 100
KNOWLEDGE = ("learnt", "true", "none")


class LateVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: true mean offset and jitter [s], what of it the model does not know (``residual_s``, the worst
    camera), and by what the model knows of it: how a goal ended, and its true error [px]. ``code``: no model.
    """

    seed: int
    late_s: float
    jitter_s: float
    residual_s: float = np.inf
    deviation_s: float = 0.0
    ends: dict[str, str] = {}
    errors_px: dict[str, float] = {}
    code: str = ""


def judged_late(seed: int, drive: bool = True) -> LateVerdict:
    """Outcome of the case of ``seed``; without goals where not ``drive``."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 9])
    late_s, jitter_s = rng.uniform(0.0, LATEST_S), rng.uniform(0.0, JITTER_S)
    wrong = Imperfections(late_s=late_s, jitter_s=jitter_s, noise_px=NOISE_PX)
    try:
        trials = DrivenCell(case.cell, None, case.cell.home, seed, wrong).trials()
        model = fit_model(trials, epoch=1).model
    except CalibrationError as error:
        return LateVerdict(seed, late_s, jitter_s, code=error.code)
    mean_s = -(late_s + 0.5 * jitter_s)
    found = {offset.camera: offset for offset in model.shutter_offsets}
    residual = max((abs(o.offset_s - mean_s) for o in found.values()), default=np.inf)
    residual = residual if len(found) == len(model.cameras) else np.inf
    deviation = max((o.deviation_s for o in found.values()), default=0.0)
    ends: dict[str, str] = {}
    errors: dict[str, float] = {}
    if drive:
        true = tuple(ShutterOffset(camera.name, mean_s, 1e-4) for camera in model.cameras)
        drawn = case.cell.held_out(rng, DRAWS, SHARE)
        place = drawn[case.cell.in_view(drawn, 10.0).all(axis=(0, 2))][0]
        wanted = case.cell.pixels(place[None])[:, 0]
        for name, offsets in zip(KNOWLEDGE, (model.shutter_offsets, true, ()), strict=True):
            known = msgspec.structs.replace(model, shutter_offsets=offsets)
            driven = DrivenCell(case.cell, known, case.cell.home, seed, wrong)
            end = driven.run_goal(wanted)
            ends[name] = end.kind if end.kind == "goal_reached" or not end.codes else end.codes[0]
            shown, _ = driven.rest(1.0)
            errors[name] = float(np.linalg.norm(shown - wanted, axis=-1).max())
    return LateVerdict(seed, late_s, jitter_s, residual, deviation, ends, errors)


def run_late_pictures(seeds: int = 10, seed: int = 0, progress: ProgressCall | None = None) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: how many offsets are known to ``WITHIN_S``, how the goals end by what is
    known, and every case beyond.
    """
    started = time.process_time()
    cases = []
    for k in range(seeds):
        cases.append(judged_late(seed + k))
        if progress is not None:
            progress("cases", k + 1, seeds)
    known = [case for case in cases if not case.code]
    rows = [count_row("offset within 2 ms", sum(case.residual_s <= WITHIN_S for case in known), len(known))]
    for name in KNOWLEDGE:
        reached = sum(case.ends[name] == "goal_reached" for case in known)
        rows.append(count_row(f"goal reached, offset {name}", reached, len(known)))
    both = [c for c in known if c.ends["learnt"] == c.ends["true"] == "goal_reached"]
    errors = {
        name: float(np.mean([c.errors_px[name] for c in both])) if both else None for name in KNOWLEDGE[:2]
    }
    return {
        "experiment": "late-pictures",
        "seed": seed,
        "seeds": seeds,
        "title": f"late-pictures: cases {seed} to {seed + seeds - 1}",
        "rows": rows,
        "mean_error_px": errors,
        "residual_ms": [round(1e3 * case.residual_s, 3) for case in known if np.isfinite(case.residual_s)],
        "ends": {name: dict(Counter(case.ends[name] for case in known)) for name in KNOWLEDGE},
        "no_model": dict(Counter(case.code for case in cases if case.code)),
        "beyond": [_plain(case) for case in known if not case.residual_s <= WITHIN_S],
        "cpu_s": round(time.process_time() - started, 1),
        "thesis": {"note": "none: 8.5 has cameras with a trigger"},
    }


def _plain(case: LateVerdict) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.to_builtins(case)
    return found | {"residual_s": case.residual_s if np.isfinite(case.residual_s) else None}


def draw_late_pictures(answer: dict[str, Any], folder: Path) -> list[Path]:
    """What the model does not know of the offsets, beside what is asked. Raises OSError."""
    residuals = {"worst camera": answer["residual_ms"]}
    return draw_sorted(residuals, "residual offset [ms]", folder / "late_pictures.png", 1e3 * WITHIN_S)


def show_late_pictures(answer: dict[str, Any], console: Console) -> None:
    """Print counts, how the goals ended, and every case whose offset is not known."""
    show_rows(answer, console)
    console.print(
        f"true error at rest, mean [px]: {answer['mean_error_px']}; residuals [ms]: {answer['residual_ms']}"
    )
    console.print(f"ends by what is known: {answer['ends']}; cases without a model: {answer['no_model']}")
    for case in answer["beyond"]:
        console.print(f"case {case['seed']}: late {case['late_s']:.4f} s, residual {case['residual_s']} s")
