"""Experiment: a camera creeps slowly while goals are sent, one a minute: how many are called reached although cameras
that had not crept show the body beside the set-points; and how many goals of healthy cells are held.

Cells are those of `random_rigs`, with one imperfection of the arm or of the stamps each, in turn; every model is learnt
from the same cell's trial motions. A case with ``creep`` has one camera, drawn, that turns and moves about drawn axes
by ``CREEP_PX`` a minute, rms over the markers; a healthy case is the same without. A case ends with the first goal that
is refused, or waits without an end. A range of seeds is continued with another: ``--seed 100 --seeds 100`` are the
cases behind ``--seeds 100``.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.arms.random_mechanics import driven_stops
from stereoservo_sim.experiments.experiment import draw_sorted, show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import count_row
from stereoservo_sim.tasks.driven_cell import TOLERANCE_PX, Creep, DrivenCell, Imperfections
from stereoservo_sim.world.mechanical_trials import mechanical_trials
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.random_cells import RandomCase, hidden_out_of_view, random_case
from stereoservo_sim.world.synthetic import SyntheticCell

KINDS = ("exact", "ripple", "play", "sag", "late")
"""What is imperfect in the case of seed k: the one at k modulo their number."""
CREEP_PX = 0.5
"""[px a minute] Rms over the markers, at the case's home."""
TURNED = 0.7
"""Share of the creep that a rotation makes; a translation makes the rest."""
NOISES = (0.02, 0.2)
"""[px], log-uniform."""
GOALS = 3
EVERY_S = 60.0
"""From one goal to the next."""
LIMIT_S = 20.0
AVERAGED_S = 0.5
SHARE = 0.5
"""Of the trials' ranges, in which goals are."""
FALSE = 1.5
"""Tolerances beside its set-points, in the pictures of cameras that stand, from which on a goal is falsely called
reached: its tolerance, and the part of it by which cameras may be displaced (`core.sources.progress.SHARE`).
"""


class CreepVerdict(msgspec.Struct, frozen=True):
    """Outcome of a goal, sent ``minutes`` after the first step: ``outcome`` as the core calls it, ``codes`` and
    ``verdict`` of the core, the true ``error_px`` in the pictures of cameras that stand, the ``crept_px`` by which the
    camera's pictures are off there, and how far the body is from its place [mm].
    """

    seed: int
    kind: str
    goal: int
    outcome: str
    codes: tuple[str, ...]
    verdict: str
    error_px: float
    crept_px: float
    beside_mm: float


def creeping_case(seed: int) -> tuple[RandomCase, str, Imperfections]:
    """The rig of ``seed``, what is imperfect about it, and the camera that creeps."""
    case, kind = random_case(seed), KINDS[seed % len(KINDS)]
    rng = np.random.default_rng([seed, 16])
    noise = float(np.exp(rng.uniform(*np.log(NOISES))))
    joints = [
        {
            "ripple": Mechanics(
                ripple=float(np.exp(rng.uniform(*np.log((0.02e-3, 1e-3))))), ripple_order=float(rng.uniform(100, 320)),
                ripple_phase=float(rng.uniform(0.0, 2.0 * np.pi)),
            ),
            "play": Mechanics(play=float(np.deg2rad(rng.uniform(0.0, 0.5)))),
            "sag": Mechanics(sag=float(np.deg2rad(rng.uniform(0.0, 1.0)))),
        }.get(kind, Mechanics())
        for _ in case.cell.home
    ]  # fmt: skip
    late_s, jitter_s = (float(rng.uniform(0.0, 0.03)), 0.01) if kind == "late" else (0.0, 0.0)
    creep = drawn_creep(case.cell, rng)
    return case, kind, Imperfections(joints, late_s=late_s, jitter_s=jitter_s, noise_px=noise, creep=creep)


def drawn_creep(cell: SyntheticCell, rng: np.random.Generator) -> Creep:
    """A camera, and the direction in which it creeps by ``CREEP_PX`` a minute."""
    camera, directions = int(rng.integers(len(cell.poses))), rng.standard_normal((2, 3))
    sizes = []
    for k, direction in enumerate(directions):
        twist = np.zeros(6)
        twist[3 * (1 - k) : 3 * (2 - k)] = 1e-5 * direction
        sizes.append(twist * (TURNED, 1.0 - TURNED)[k] / _rms(cell, Creep(camera, twist), 1.0, cell.home))
    twist = sizes[0] + sizes[1]
    return Creep(
        camera, twist * CREEP_PX / 60.0 / _rms(cell, Creep(camera, 1e-3 * twist), 1.0, cell.home) * 1e-3
    )


def _rms(cell: SyntheticCell, creep: Creep, seconds: float, q: FloatArray) -> float:
    """By how much the pixels of the camera that creeps are off with the arm at ``q`` [px], rms."""
    off = creep.moved(cell, seconds).pixels(q[None]) - cell.pixels(q[None])
    return float(np.sqrt((off[creep.camera] ** 2).sum(axis=-1).mean()))


def judged_creep(seed: int, *, creeps: bool, goals: int = GOALS) -> list[CreepVerdict]:
    """Outcome of the goals of the case of ``seed``. Raises CalibrationError."""
    case, kind, wrong = creeping_case(seed)
    assert wrong.mechanics is not None
    trials = mechanical_trials(
        case.cell,
        wrong.mechanics,
        wrong.noise_px,
        np.random.default_rng([seed, 1]),
        positions=driven_stops(case),
    )
    model = fit_model(hidden_out_of_view(case.cell, trials), epoch=1).model
    rng = np.random.default_rng([seed, 7])
    drawn = case.cell.held_out(rng, 200, SHARE)
    places = drawn[case.cell.in_view(drawn, 10.0).all(axis=(0, 2))][: goals + 1]
    if len(places) <= goals:
        raise CalibrationError("no_goals", f"{len(places)} places with all markers in view")
    creep = wrong.creep
    assert creep is not None
    driven = DrivenCell(case.cell, model, places[0], seed, wrong if creeps else replace(wrong, creep=None))
    found = []
    first_s = float(rng.uniform(0.0, EVERY_S))
    for k, place in enumerate(places[1:]):
        driven.rest(max(0.0, first_s + k * EVERY_S - driven.seconds))
        end = driven.run_goal(case.cell.pixels(place[None])[:, 0], time_limit_s=LIMIT_S)
        crept = _rms(case.cell, creep, driven.seconds, driven.links) if creeps else 0.0
        outcome = {"goal_reached": "reached", "refused": "refused", "goal_aborted": "aborted"}.get(
            end.kind, "held"
        )
        shown, _ = driven.rest(AVERAGED_S)
        error = float(np.linalg.norm(shown - case.cell.pixels(place[None])[:, 0], axis=-1).max())
        beside = np.linalg.norm(
            (case.cell.markers(driven.links[None]) - case.cell.markers(place[None]))[0, :, :3], axis=1
        )
        found.append(
            CreepVerdict(
                seed, kind, k, outcome, end.codes, end.verdict, error, crept, 1e3 * float(beside.max()),
            )
        )  # fmt: skip
        if outcome in ("held", "refused"):
            break
    return found


def run_creeping_cameras(
    seeds: int = 10, seed: int = 0, progress: ProgressCall | None = None
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``, with a creeping camera and without: goals called reached and held, with
    Wilson bounds, and every one of them that is falsely called so.
    """
    found: dict[bool, list[CreepVerdict]] = {True: [], False: []}
    no_model: Counter[str] = Counter()
    for k in range(seeds):
        for creeps in (True, False):
            try:
                found[creeps] += judged_creep(seed + k, creeps=creeps)
            except CalibrationError as error:
                no_model[error.code] += 1
        if progress is not None:
            progress("cases", k + 1, seeds)
    crept = [goal for goal in found[True] if goal.outcome == "reached"]
    healthy = [goal for goal in found[False] if goal.outcome != "refused"]
    false = [goal for goal in crept if goal.error_px > FALSE * TOLERANCE_PX]
    held = [goal for goal in healthy if "CAMERAS_DISAGREE" in goal.codes]
    return {
        "experiment": "creeping-cameras",
        "seed": seed,
        "seeds": seeds,
        "title": f"creeping-cameras: cases {seed} to {seed + seeds - 1}, {CREEP_PX:g} px a minute, tolerance "
        f"{TOLERANCE_PX:g} px",
        "rows": [
            count_row("creep: called reached", len(crept), len(found[True])),
            count_row(
                "creep: reached beyond tolerance", sum(g.error_px > TOLERANCE_PX for g in crept), len(crept)
            ),
            count_row("creep: falsely called reached", len(false), len(crept)),
            count_row("healthy: called reached", sum(g.outcome == "reached" for g in healthy), len(healthy)),
            count_row("healthy: cameras said to disagree", len(held), len(healthy)),
        ],
        "errors_px": {
            "creeping camera": [goal.error_px for goal in crept],
            "healthy": [goal.error_px for goal in healthy if goal.outcome == "reached"],
        },
        "beside_mm": {"creeping camera": max((goal.beside_mm for goal in crept), default=None)},
        "no_model": dict(no_model),
        "false": [msgspec.to_builtins(goal) for goal in false],
        "held": [msgspec.to_builtins(goal) for goal in held],
        "thesis": {"note": "none: the thesis's cameras stand"},
    }


def draw_creeping_cameras(answer: dict[str, Any], folder: Path) -> list[Path]:
    """True errors of goals called reached, beside what would be false. Raises OSError."""
    limit = FALSE * TOLERANCE_PX
    return draw_sorted(answer["errors_px"], "true error [px]", folder / "creeping_cameras.png", limit)


def show_creeping_cameras(answer: dict[str, Any], console: Console) -> None:
    """Print counts, and every goal that was falsely called reached or falsely held."""
    show_rows(answer, console)
    console.print(f"cases without a model: {answer['no_model']}")
    for kind in ("false", "held"):
        for goal in answer[kind]:
            console.print(
                f"{kind}: case {goal['seed']} ({goal['kind']}) goal {goal['goal']}: {goal['outcome']}, true error "
                f"{goal['error_px']:.3g} px, {goal['beside_mm']:.2g} mm, creep {goal['crept_px']:.2g} px, "
                + ", ".join(goal["codes"])
            )
