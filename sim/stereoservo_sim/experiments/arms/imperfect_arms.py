"""Experiment: goals in pictures for arms that are not perfect, by the servo core with its watch and safety stage: how
many are reached, and how far those that are called reached are from their set-points in truth.

Cases are those of `random_rigs`; every joint has play, sag, gear ripple and friction at once, and its zero is off by
some tenths of a degree since the model was learnt. No camera moves. The model is learnt from the same arm's trial
motions (``self``), or the true one, which states the errors of the readings that the mechanics cause (``exact``). A
range of seeds is continued with another: ``--seed 100 --seeds 100`` are the cases behind ``--seeds 100``.
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
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.arms.random_mechanics import driven_stops
from stereoservo_sim.experiments.experiment import ExperimentError, draw_sorted, show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import count_row
from stereoservo_sim.tasks.driven_cell import TOLERANCE_PX, DrivenCell, GoalEnd, Imperfections
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.mechanical_trials import mechanical_trials, synthetic_load
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.random_cells import RandomCase, hidden_out_of_view, random_case

MODELS = ("self", "exact")
PLAY, SAG = np.deg2rad(1.5), np.deg2rad(1.0)
"""[rad] The largest of each joint."""
RIPPLES = (0.02e-3, 1e-3)
"""[rad], log-uniform."""
FRICTION = 0.01
"""[rad/s] The largest of each joint."""
ZERO_OFFSET = np.deg2rad(0.3)
"""[rad] The largest of each joint."""
NOISES = (0.02, 0.2)
"""[px], log-uniform."""
GOALS = 2
"""A case."""
SHARE = 0.5
"""Of the trials' ranges, in which goals are."""
REST_S = 60.0
"""After each goal that is called reached."""
AVERAGED_S = 1.0
"""At the beginning of this time, over which the true error is averaged."""
FALSE = 2.0
"""Tolerances that the true error of a goal called reached may have."""
DRAWS = 200


class GoalVerdict(msgspec.Struct, frozen=True):
    """Outcome of a goal. ``outcome``: ``reached``, ``refused`` before motion, ``held``, ``aborted``. ``error_px``: the
    true one, ``later_px`` of a minute later; ``reversals`` of commands in this minute. ``codes``, ``verdict``: what the
    core says. ``zero_load``: joints whose load is too small there to press their links against a flank.
    """

    seed: int
    goal: int
    outcome: str
    seconds: float
    error_px: float
    later_px: float
    reversals: int
    codes: tuple[str, ...]
    verdict: str
    zero_load: tuple[str, ...]


class CaseVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: its goals, or the ``code`` and ``message`` for which it has no model."""

    seed: int
    goals: tuple[GoalVerdict, ...] = ()
    code: str = ""
    message: str = ""


def imperfect_arm(seed: int) -> tuple[RandomCase, Imperfections]:
    """The rig of ``seed`` and what is not perfect about its arm."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 6])
    n = len(case.cell.home)
    play, sag, friction = rng.uniform(0.0, 1.0, 3) * (PLAY, SAG, FRICTION)
    ripple = np.exp(rng.uniform(*np.log(RIPPLES)))
    gears = [
        Mechanics(
            play=float(play * rng.uniform(0.5, 1.0)), sag=float(sag),
            dead_speed=float(friction * rng.uniform(0.5, 1.0)),
            ripple=float(ripple), ripple_order=float(rng.uniform(100.0, 320.0)),
            ripple_phase=float(rng.uniform(0.0, 2.0 * np.pi)),
        )
        for _ in range(n)
    ]  # fmt: skip
    noise = float(np.exp(rng.uniform(*np.log(NOISES))))
    offset = rng.uniform(-1.0, 1.0, n) * rng.uniform(0.0, ZERO_OFFSET)
    return case, Imperfections(tuple(gears), offset, noise_px=noise)


def model_of(case: RandomCase, wrong: Imperfections, kind: str) -> CellModel:
    """The arm's model, with its zeros as they were. Raises CalibrationError."""
    gears = wrong.mechanics
    assert gears is not None
    if kind == "exact":
        play, sag, ripple = (
            np.array([getattr(g, name) for g in gears]) for name in ("play", "sag", "ripple")
        )
        random = np.hypot(0.5 * play, ripple / np.sqrt(2.0))
        off = np.full(len(gears), ZERO_OFFSET / np.sqrt(3.0))
        stated = np.sqrt(random**2 + sag**2 + off**2)
        return msgspec.structs.replace(
            exact_model(case.cell), joint_accuracy=JointAccuracy(random, np.hypot(sag, off), stated, sag)
        )
    rng = np.random.default_rng([case.seed, 1])
    trials = mechanical_trials(case.cell, gears, wrong.noise_px, rng, positions=driven_stops(case))
    return fit_model(hidden_out_of_view(case.cell, trials), epoch=1).model


def judged_case(seed: int, model: str = "self", rest_s: float = REST_S) -> CaseVerdict:
    """Outcome of the case of ``seed``."""
    case, wrong = imperfect_arm(seed)
    try:
        learnt = model_of(case, wrong, model)
    except CalibrationError as error:
        return CaseVerdict(seed, code=error.code, message=error.message)
    ends = _places(case, GOALS + 1)
    if len(ends) <= GOALS:
        return CaseVerdict(seed, code="no_goals", message=f"{len(ends)} places with all markers in view")
    driven = DrivenCell(case.cell, learnt, ends[0], seed, wrong)
    goals = []
    for k, place in enumerate(ends[1:]):
        goals.append(_judged_goal(driven, seed, k, place, rest_s))
        if goals[-1].outcome != "reached":
            break
    return CaseVerdict(seed, tuple(goals))


def _places(case: RandomCase, count: int) -> FloatArray:
    """Configurations (k, n) of the links, k up to ``count``, with all markers in both images."""
    rng = np.random.default_rng([case.seed, 7])
    drawn = case.cell.held_out(rng, DRAWS, SHARE)
    return drawn[case.cell.in_view(drawn, 10.0).all(axis=(0, 2))][:count]


def _judged_goal(driven: DrivenCell, seed: int, number: int, place: FloatArray, rest_s: float) -> GoalVerdict:
    cell = driven.cell
    wanted = cell.pixels(place[None])[:, 0]
    end = driven.run_goal(wanted)
    reached = end.kind == "goal_reached"
    shown, first = driven.rest(min(AVERAGED_S, rest_s))
    further = max(rest_s - AVERAGED_S, 0.0) if reached else 0.0
    later, more = driven.rest(further) if further > 0.0 else (shown, 0)
    friction = np.array([joint.play_friction for joint in driven.mechanics])
    small = np.abs(synthetic_load(cell, place)) < friction
    return GoalVerdict(
        seed, number, _outcome(end), end.seconds, _farthest(shown, wanted), _farthest(later, wanted), first + more,
        end.codes, end.verdict, tuple(np.array(cell.joint_names)[small].tolist()),
    )  # fmt: skip


def _outcome(end: GoalEnd) -> str:
    return {"goal_reached": "reached", "refused": "refused", "": "held"}.get(end.kind, "aborted")


def _farthest(shown: FloatArray, wanted: FloatArray) -> float:
    return float(np.linalg.norm(shown - wanted, axis=-1).max())


def run_imperfect_arms(
    seeds: int = 10, seed: int = 0, model: str = "self", progress: ProgressCall | None = None
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: outcomes with Wilson bounds, every goal that is not reached with what the
    core says of it, and every one that is falsely called reached.

    Raises ExperimentError for an unknown ``model``.
    """
    if model not in MODELS:
        raise ExperimentError("option", f"--model {model!r}; known: {', '.join(MODELS)}")
    started = time.process_time()
    cases = []
    for k in range(seeds):
        cases.append(judged_case(seed + k, model))
        if progress is not None:
            progress("cases", k + 1, seeds)
    goals = [goal for case in cases for goal in case.goals]
    reached = [goal for goal in goals if goal.outcome == "reached"]
    false = [g for g in reached if max(g.error_px, g.later_px) > FALSE * TOLERANCE_PX]
    lost = [g for g in goals if g.outcome not in ("reached", "refused")]
    moved = len(reached) + len(lost)
    return {
        "experiment": "imperfect-arms",
        "seed": seed,
        "seeds": seeds,
        "model": model,
        "title": f"imperfect-arms: cases {seed} to {seed + seeds - 1}, model {model}, tolerance {TOLERANCE_PX:g} px",
        "rows": [
            count_row("reached", len(reached), moved),
            count_row("falsely called reached", len(false), len(reached)),
            count_row("reversal in 60 s", sum(goal.reversals > 0 for goal in reached), len(reached)),
        ],
        "errors_px": {
            "when reached": [goal.error_px for goal in reached],
            "a minute later": [goal.later_px for goal in reached],
        },
        "error_px": _spread([goal.error_px for goal in reached]),
        "later_px": _spread([goal.later_px for goal in reached]),
        "seconds": _spread([goal.seconds for goal in reached]),
        "refused_goals": dict(
            Counter(goal.codes[0] for goal in goals if goal.outcome == "refused" and goal.codes)
        ),
        "no_model": dict(Counter(case.code for case in cases if case.code)),
        "false": [msgspec.to_builtins(goal) for goal in false],
        "lost": [msgspec.to_builtins(goal) for goal in lost],
        "cpu_s": round(time.process_time() - started, 1),
        "thesis": {"note": "none: the thesis has joints without errors"},
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"median": float(np.median(values)), "p99": float(np.quantile(values, 0.99)), "max": max(values)}


def draw_imperfect_arms(answer: dict[str, Any], folder: Path) -> list[Path]:
    """True errors of goals called reached, then and a minute later, beside what would be false. Raises OSError."""
    limit = FALSE * TOLERANCE_PX
    return draw_sorted(answer["errors_px"], "true error [px]", folder / "imperfect_arms.png", limit)


def show_imperfect_arms(answer: dict[str, Any], console: Console) -> None:
    """Print counts, spreads, and every goal that was lost or falsely called reached."""
    show_rows(answer, console)
    for name, unit in (("error_px", "px"), ("later_px", "px"), ("seconds", "s")):
        if answer[name] is not None:
            spread = ", ".join(f"{key} {value:.3g}" for key, value in answer[name].items())
            console.print(f"{name} of goals that were reached: {spread} {unit}")
    console.print(
        f"refused before motion: {answer['refused_goals']}; cases without a model: {answer['no_model']}"
    )
    for kind in ("false", "lost"):
        for goal in answer[kind]:
            console.print(
                f"{kind}: case {goal['seed']} goal {goal['goal']}: {goal['outcome']} after {goal['seconds']:.1f} s, "
                f"true error {goal['error_px']:.3g} px, {goal['later_px']:.3g} px later, watch {goal['verdict']}, "
                f"{', '.join(goal['codes'])}"
                + (f"; load near zero: {', '.join(goal['zero_load'])}" if goal["zero_load"] else "")
            )
