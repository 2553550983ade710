"""Experiment: goals from starts near the singularities of an arm with a spherical wrist, by every law in the servo
core: wrist, elbow and shoulder, exactly there and within half a degree.

Each case has one start before the cameras, drawn by its seed, and one goal in images, up to a fifth of a radian away
in all joints; the model is the true one. A case counts for a law if `stereo` or `trajectory` reaches it. A range of
seeds is continued by another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.experiment import cases
from stereoservo_sim.experiments.figures import drawing_sorted
from stereoservo_sim.experiments.imperfect_arms import outcome
from stereoservo_sim.progress import ProgressCall, silent
from stereoservo_sim.summaries import wilson
from stereoservo_sim.tasks.driven_cell import DrivenCell, Imperfections
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import RX90_ROWS, SyntheticCell, dh_link, placed, rotation, two_faces

LAWS = ("stereo", "trajectory", "cartesian3", "cartesian2")
REFERENCES = ("stereo", "trajectory")
Kind = Literal["wrist", "elbow", "shoulder"]
KINDS: tuple[Kind, ...] = ("wrist", "elbow", "shoulder")
NEAR = np.deg2rad(0.5)
"""Largest distance from the singularity of the joint concerned [rad]; every third case is exactly singular."""
AWAY = 0.2
"""Largest distance of every joint from start to goal [rad]."""
NOISE_PX = 0.05
TIME_LIMIT_S = 40.0
DRAWS = 400


class SingularVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case by a law: ``outcome`` as in `imperfect_arms`, the ``codes`` of its end."""

    seed: int
    kind: str
    offset: float
    law: str
    outcome: str
    seconds: float
    codes: tuple[str, ...]


def singular_case(seed: int) -> tuple[SyntheticCell, FloatArray, FloatArray, float]:
    """Cell, start and goal (6,) of ``seed``, and the start's distance [rad] from the singularity."""
    rng = np.random.default_rng([seed, 8])
    kind = KINDS[seed % len(KINDS)]
    offset = 0.0 if (seed // len(KINDS)) % 3 == 0 else float(rng.uniform(-NEAR, NEAR))
    while True:
        start = np.radians(rng.uniform([-30, -100, 60, -60, 25, -60], [30, -40, 140, 60, 70, 60]))
        if kind == "wrist":
            start[4] = offset
        elif kind == "elbow":  # the wrist's centre on the line of shoulder and elbow
            start[2] = 0.5 * np.pi + offset
        else:
            start[1] = _over_the_base(start, offset)
        turns = (
            rotation("x", 180) @ rotation("y", float(rng.uniform(-25, 25))) @ rotation("x", float(rng.uniform(-25, 25)))
        )
        cell = placed(
            ("revolute",) * 6,
            tuple(dh_link(*row) for row in RX90_ROWS),
            two_faces(),
            start,
            np.full(6, 0.3),
            turns,
        )
        for _ in range(20):
            goal = start + rng.uniform(-AWAY, AWAY, 6)
            ways = start + np.linspace(0.0, 1.0, 6)[:, None] * (goal - start)
            if cell.in_view(ways, 10.0).all():
                return cell, start, goal, offset


def _over_the_base(q: FloatArray, offset: float) -> float:
    """Second joint [rad] with the wrist's centre ``offset`` [rad] of this joint from the first joint's axis."""
    upper, fore = RX90_ROWS[1][0], RX90_ROWS[3][2]
    # The wrist's centre is upper cos q2 + fore sin(q2 + q3) from the axis.
    return float(np.arctan2(-(upper + fore * np.sin(q[2])), fore * np.cos(q[2])) + offset)


def judged_singular(seed: int, laws: tuple[str, ...] = LAWS) -> list[SingularVerdict]:
    """Outcomes of the case of ``seed`` by every law."""
    cell, start, goal, offset = singular_case(seed)
    wanted = cell.pixels(goal[None])[:, 0]
    found = []
    for law in laws:
        model = exact_model(replace(cell, home=start + 0.1))  # its zero is no singularity
        driven = DrivenCell(cell, model, start, seed, Imperfections(noise_px=NOISE_PX), law=law)
        end = driven.run_goal(wanted, time_limit_s=TIME_LIMIT_S)
        kind = KINDS[seed % len(KINDS)]
        found.append(SingularVerdict(seed, kind, offset, law, outcome(end), end.seconds, end.codes))
    return found


def run_singularities(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``, for each law and kind: number reached of those that one of the
    references reaches, number that end by the time limit, and every one of them that the law does not reach.
    """
    verdicts = [verdict for found in cases(judged_singular, seeds, seed, progress) for verdict in found]
    possible = {v.seed for v in verdicts if v.law in REFERENCES and v.outcome == "reached"}
    rows, lost = [], []
    for law in LAWS:
        for kind in KINDS:
            of_law = [v for v in verdicts if v.law == law and v.kind == kind]
            counted = [v for v in of_law if v.seed in possible]
            reached = sum(v.outcome == "reached" for v in counted)
            low, high = wilson(reached, len(counted)) if counted else (0.0, 1.0)
            rows.append(
                {
                    "law": law,
                    "singularity": kind,
                    "reached": reached,
                    "of": len(counted),
                    "wilson_low": low,
                    "wilson_high": high,
                    "time_outs": sum("TIME_LIMIT" in v.codes for v in of_law),
                    "seconds_median": float(np.median([v.seconds for v in of_law])) if of_law else None,
                }
            )
            lost += [msgspec.to_builtins(v) for v in of_law if v.outcome not in ("reached", "refused")]
    return {
        "title": f"singularities: cases {seed} to {seed + seeds - 1}",
        "rows": rows,
        "refused": dict(Counter(f"{v.law} {v.codes[0]}" for v in verdicts if v.outcome == "refused" and v.codes)),
        "seconds": {law: [v.seconds for v in verdicts if v.law == law and v.outcome == "reached"] for law in LAWS},
        "lost": lost,
        "thesis": {"note": "none: 8.5 leaves singularities to the planner"},
    }


draw_singularities = drawing_sorted("singularities", "seconds", "time to the goal [s]")
"""Durations of reached goals, by law."""


def notes_singularities(answer: dict[str, Any]) -> Iterator[str]:
    """Refusals, and every goal that was lost in motion."""
    yield f"refused before motion: {answer['refused']}"
    for case in answer["lost"]:
        yield (
            f"case {case['seed']} ({case['kind']}, {np.degrees(case['offset']):.3f} degrees), {case['law']}: "
            f"{case['outcome']} after {case['seconds']:.1f} s: {', '.join(case['codes'])}"
        )
