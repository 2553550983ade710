"""Experiment: self-calibration on the random rigs behind lenses that distort, with second radial and tangential terms:
how many models are usable, wrong, or refused, and by which cause.

Cases and their evaluation are those of `random_rigs`, with lenses of `world.random_cells.random_lenses`: radial terms
k1 -0.4 to 0.1 and k2 -0.05 to 0.2, tangential ones up to 0.001. A range of seeds is continued with another: ``--seed
100 --seeds 100`` are the cases behind ``--seeds 100``.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from stereoservo_sim.experiments.arms.random_rigs import Verdict, judged_case
from stereoservo_sim.experiments.experiment import show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.random_cells import random_lens_case

SEEDS = 12
"""Cases of the command by default."""
BENDS = ((-0.4, -0.2), (-0.2, -0.05), (-0.05, 0.1))
"""Ranges of k1 that the rows are of."""


def run_random_lenses(
    seeds: int = SEEDS, seed: int = 0, progress: ProgressCall | None = None
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: counts of usable, wrong and refused ones, the refusals by cause, rows
    over the first radial term, and every case that is not usable.

    Raises ValueError for fewer than one case.
    """
    if seeds < 1:
        raise ValueError(f"{seeds} cases; at least 1 is needed")
    verdicts, bends = [], []
    for k in range(seeds):
        case = random_lens_case(seed + k)
        verdicts.append(judged_case(case))
        K, lens = case.cell.intrinsics[0], case.cell.lenses[0]
        bends.append(float(lens[0] * K[0, 0] * K[1, 1] / lens[3] ** 2))
        if progress is not None:
            progress("cases", k + 1, seeds)
    counts = Counter(verdict.outcome for verdict in verdicts)
    return {
        "experiment": "random-lenses",
        "seed": seed,
        "seeds": seeds,
        "title": f"random-lenses: cases {seed} to {seed + seeds - 1} by k1 of the left lens",
        "usable": counts["success"],
        "wrong": counts["wrong"],
        "refused": counts["failure"],
        "refused_by_cause": dict(Counter(v.code for v in verdicts if v.outcome == "failure")),
        "strata": dict(Counter(verdict.stratum for verdict in verdicts if verdict.stratum)),
        "seconds_median": float(np.median([verdict.seconds for verdict in verdicts])),
        "rows": _rows(verdicts, bends),
        "not_usable": [
            {"k1": bend, **msgspec.structs.asdict(v)}
            for v, bend in zip(verdicts, bends, strict=True)
            if v.outcome != "success"
        ],
        "thesis": {"note": "none: the thesis has lenses without distortion"},
    }


def _rows(verdicts: list[Verdict], bends: list[float]) -> list[dict[str, Any]]:
    """One object for each range of k1."""
    rows = []
    for low, high in BENDS:
        own = Counter(v.outcome for v, bend in zip(verdicts, bends, strict=True) if low <= bend < high)
        rows.append(
            {
                "k1": f"{low:g} to {high:g}",
                "cases": own.total(),
                "usable": own["success"],
                "wrong": own["wrong"],
                "refused": own["failure"],
            }
        )
    return rows


def draw_random_lenses(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Usable, wrong and refused cases by k1, as bars. Raises OSError."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    rows = answer["rows"]
    places, left = np.arange(len(rows)), np.zeros(len(rows))
    figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
    for outcome in ("usable", "wrong", "refused"):
        counts = np.array([row[outcome] for row in rows])
        axes.barh(places, counts, left=left, label=outcome)
        left += counts
    axes.set_yticks(places, [f"k1 {row['k1']}" for row in rows])
    axes.legend()
    path = folder / "random_lenses.png"
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return [path]


def show_random_lenses(answer: dict[str, Any], console: Console) -> None:
    """Print rows, counts, and every case that is not usable."""
    show_rows(answer, console)
    causes = ", ".join(f"{code} {count}" for code, count in sorted(answer["refused_by_cause"].items()))
    console.print(
        f"{answer['usable']} of {answer['seeds']} usable, {answer['wrong']} wrong, {answer['refused']} refused"
        + (f" ({causes})" if causes else "")
    )
    for case in answer["not_usable"]:
        console.print(
            f"case {case['seed']}: k1 {case['k1']:.2f}, {case['sigma_px']:.3f} px, {case['outcome']} {case['code']} "
            f"{case['message']}"
        )
