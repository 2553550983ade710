"""Experiment: self-calibration of arms that are not perfect, on the random rigs: how many models are usable, which
causes are named although nothing but the gears and encoders is wrong, and whether stated ellipses hold.

Cases are those of `random_rigs` with noise of 0.01 to 0.5 px and one mechanism each, all joints alike: gear ripple of
0.02 to 1 mrad, encoders of 4096 counts a turn, play up to 1.5°, sag up to 2.5°, a wrist coupled by up to 5 %. A range
of seeds is continued with another: ``--seed 100 --seeds 100`` are the cases behind ``--seeds 100``.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from stereoservo.calibration.fit_assessment import assess_fit
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.core.sources.calibration import combined_offsets, in_view_at, stop_offset
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.experiments.experiment import show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.mechanical_trials import links_and_readings, mechanical_trials
from stereoservo_sim.world.mechanics import Mechanics
from stereoservo_sim.world.random_cells import MIN_SHOWN, RandomCase, hidden_out_of_view, random_case
from stereoservo_sim.world.synthetic import FIRST_MARKER

SEEDS = 10
"""Cases of the command by default: two of each mechanism."""
NOISES = (0.01, 0.5)
"""[px], log-uniform."""
MECHANISMS = ("ripple", "encoder", "play", "sag", "coupling")
"""The mechanism of seed k is the one at k modulo their number."""
TOGETHER = 16
"""Stops of all joints at once, as a cell file has by default."""
INSIDE = 5.991
"""Squared distance that holds 95 % of two Gaussian coordinates."""
WELL = 0.85
"""Share inside their ellipses below which a model must not be called good."""


class MechanicsVerdict(msgspec.Struct, frozen=True):
    """Outcome of a case: ``size`` of its mechanism [rad or share], ``inside``: share of unseen markers inside their
    95 % ellipses, ``code`` and ``message`` of a refusal. ``over_told``: error of these markers over that of a fit which
    is told where the joints stood in the trials, a perfect arm's, and ``seconds_told`` of its CPU beside ``seconds`` of
    ours; 0 where it fails.
    """

    seed: int
    mechanism: str
    size: float
    sigma_px: float
    usable: bool
    inside: float = 0.0
    grade: str = ""
    stratum: str = ""
    code: str = ""
    message: str = ""
    seconds: float = 0.0
    over_told: float = 0.0
    seconds_told: float = 0.0


def random_mechanics(seed: int) -> tuple[RandomCase, str, float, tuple[Mechanics, ...], float]:
    """Case of ``seed``, its mechanism with its size, the mechanics of all joints, and the noise [px]."""
    case = random_case(seed)
    rng = np.random.default_rng([seed, 4])
    sigma = float(np.exp(rng.uniform(*np.log(NOISES))))
    mechanism, n = MECHANISMS[seed % len(MECHANISMS)], len(case.cell.home)
    if mechanism == "ripple":
        size = float(np.exp(rng.uniform(*np.log((0.02e-3, 1e-3)))))
        orders, phases = rng.uniform(100.0, 320.0, n), rng.uniform(0.0, 2.0 * np.pi, n)
        gears = [
            Mechanics(ripple=size, ripple_order=order, ripple_phase=phase)
            for order, phase in zip(orders.tolist(), phases.tolist(), strict=True)
        ]
    elif mechanism == "encoder":
        size = float(2.0 * np.pi / 4096)
        gears = [Mechanics(encoder_step=size, encoder_side="joint")] * n
    elif mechanism == "play":
        size = float(np.deg2rad(rng.uniform(0.0, 1.5)))
        gears = [Mechanics(play=size)] * n
    elif mechanism == "sag":
        size = float(np.deg2rad(rng.uniform(0.0, 2.5)))
        gears = [Mechanics(sag=size)] * n
    else:
        size = float(rng.uniform(0.0, 0.05))
        gears = [*[Mechanics()] * (n - 1), Mechanics(coupling=size)]
    return case, mechanism, size, tuple(gears), sigma


def judged_mechanics(seed: int) -> MechanicsVerdict:
    """Outcome of the case of ``seed``, calibrated without prior knowledge."""
    case, mechanism, size, gears, sigma = random_mechanics(seed)
    trials = mechanical_trials(
        case.cell, gears, sigma, np.random.default_rng([seed, 1]), positions=driven_stops(case)
    )
    trials = hidden_out_of_view(case.cell, trials)
    begin = time.process_time()
    try:
        result = fit_model(trials, epoch=1)
    except CalibrationError as error:
        seconds = time.process_time() - begin
        return MechanicsVerdict(
            seed, mechanism, size, sigma, False, code=error.code, message=error.message, seconds=seconds
        )
    seconds = time.process_time() - begin
    error_px, inside = unseen(case, gears, result.model)
    told_px, seconds_told = _told(case, gears, sigma, seed)
    return MechanicsVerdict(
        seed,
        mechanism,
        size,
        sigma,
        True,
        inside,
        assess_fit(result.model, result.report).grade,
        result.model.stratum,
        seconds=seconds,
        over_told=error_px / told_px if told_px else 0.0,
        seconds_told=seconds_told,
    )


def _told(case: RandomCase, gears: tuple[Mechanics, ...], sigma: float, seed: int) -> tuple[float, float]:
    """Error of unseen markers [px], at what joints with these ``gears`` report there, of a fit that is told where they
    stood in the trials: of a perfect arm's, with the same noise; and its CPU time [s]. Zeros where it fails.
    """
    perfect = (Mechanics(),) * len(gears)
    rng = np.random.default_rng([seed, 1])
    trials = mechanical_trials(case.cell, perfect, sigma, rng, positions=driven_stops(case))
    begin = time.process_time()
    try:
        model = fit_model(hidden_out_of_view(case.cell, trials), epoch=1).model
    except CalibrationError:
        return 0.0, 0.0
    seconds = time.process_time() - begin
    return unseen(case, gears, model)[0], seconds


def driven_stops(case: RandomCase) -> tuple[FloatArray, IntArray]:
    """Positions (s, n) of the case's trials and the joint (s,) that moves, as the trial programme drives them: each
    joint from its base to one end, then beyond the base to the other; at last all at once (-1), where enough markers
    stay in view.
    """
    home, ranges = case.cell.home, case.cell.ranges
    counts = ((1, case.stops // 2), (-1, case.stops - 1 - case.stops // 2))
    shares = [0.0] + [
        stop_offset(side, k, count, 1.0 / count) for side, count in counts for k in range(1, count + 1)
    ]
    motors, moved = [], []
    for joint in range(len(home)):
        for share in shares:
            stop = home.copy()
            stop[joint] += share * ranges[joint]
            motors.append(stop)
            moved.append(joint)
    for k in range(TOGETHER):
        offsets = in_view_at(
            combined_offsets(k, -ranges, ranges),
            lambda at: bool(case.cell.in_view((home + at)[None]).all(axis=0).sum() >= MIN_SHOWN),
        )
        if offsets is not None:
            motors.append(home + offsets)
            moved.append(-1)
    return np.array(motors), np.array(moved, dtype=np.int64)


def unseen(case: RandomCase, gears: tuple[Mechanics, ...], model: CellModel) -> tuple[float, float]:
    """Root mean square error [px] of the markers in view, at what joints report at poses that the trials have not seen,
    and their share inside the ellipses that the model states for them.
    """
    links, readings = links_and_readings(case.cell, gears, case.held_out())
    kept = [i - FIRST_MARKER for i in model.marker_ids]
    pixels, covariances = pixel_covariances(model, readings)
    off = pixels - case.cell.pixels(links)[:, :, kept]
    squares = np.einsum("csma,csmab,csmb->csm", off, np.linalg.inv(covariances), off)
    shown = case.cell.in_view(links)[:, :, kept]
    return float(np.sqrt((off[shown] ** 2).sum(axis=1).mean())), float((squares[shown] < INSIDE).mean())


def run_random_mechanics(
    seeds: int = SEEDS, seed: int = 0, progress: ProgressCall | None = None
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: a row for each mechanism, the refusals by cause, every case that is not
    usable, and those called good whose ellipses hold less than ``WELL``.

    Raises ValueError for fewer than one case.
    """
    if seeds < 1:
        raise ValueError(f"{seeds} cases; at least 1 is needed")
    verdicts = []
    for k in range(seeds):
        verdicts.append(judged_mechanics(seed + k))
        if progress is not None:
            progress("cases", k + 1, seeds)
    refused = [verdict for verdict in verdicts if not verdict.usable]
    praised = [v for v in verdicts if v.usable and v.grade == "good" and v.inside < WELL]
    low, high = wilson(len(verdicts) - len(refused), len(verdicts))
    return {
        "experiment": "random-mechanics",
        "seed": seed,
        "seeds": seeds,
        "title": f"random-mechanics: cases {seed} to {seed + seeds - 1} by mechanism",
        "usable": len(verdicts) - len(refused),
        "usable_low": low,
        "usable_high": high,
        "refused_by_cause": dict(Counter(verdict.code for verdict in refused)),
        "rows": [_row(name, [v for v in verdicts if v.mechanism == name]) for name in MECHANISMS],
        "refused": [msgspec.structs.asdict(verdict) for verdict in refused],
        "good_and_not_true": [msgspec.structs.asdict(verdict) for verdict in praised],
        "thesis": {"note": "none: the thesis has joints without errors"},
    }


def _row(name: str, verdicts: list[MechanicsVerdict]) -> dict[str, Any]:
    usable = [verdict for verdict in verdicts if verdict.usable]
    shares = [verdict.inside for verdict in usable]
    return {
        "mechanism": name,
        "cases": len(verdicts),
        "usable": len(usable),
        "good": sum(verdict.grade == "good" for verdict in usable),
        "inside_mean": float(np.mean(shares)) if shares else None,
        "inside_least": min(shares, default=None),
        "over_told_median": _median([verdict.over_told for verdict in usable if verdict.over_told]),
        "seconds_median": _median([verdict.seconds for verdict in verdicts]),
        "seconds_over_told_median": _median(
            [verdict.seconds / verdict.seconds_told for verdict in usable if verdict.seconds_told]
        ),
    }


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def draw_random_mechanics(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Usable and refused cases by mechanism, as bars. Raises OSError."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    rows = answer["rows"]
    places = np.arange(len(rows))
    usable = np.array([row["usable"] for row in rows])
    refused = np.array([row["cases"] for row in rows]) - usable
    figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
    axes.barh(places, usable, label="usable")
    axes.barh(places, refused, left=usable, label="refused")
    axes.set_yticks(places, [row["mechanism"] for row in rows])
    axes.legend()
    path = folder / "random_mechanics.png"
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return [path]


def show_random_mechanics(answer: dict[str, Any], console: Console) -> None:
    """Print rows, counts, every refused case, and every one that is called good and is not."""
    show_rows(answer, console)
    causes = ", ".join(f"{code} {count}" for code, count in sorted(answer["refused_by_cause"].items()))
    console.print(
        f"{answer['usable']} of {answer['seeds']} usable ({answer['usable_low']:.1%} to {answer['usable_high']:.1%})"
        + (f"; refused: {causes}" if causes else "")
    )
    for case in answer["refused"]:
        console.print(
            f"case {case['seed']}: {case['mechanism']} {case['size']:.2g}, {case['sigma_px']:.3f} px, {case['code']} "
            f"{case['message']}"
        )
    for case in answer["good_and_not_true"]:
        console.print(
            f"case {case['seed']}: {case['mechanism']} {case['size']:.2g}, {case['sigma_px']:.3f} px, called good; "
            f"{case['inside']:.0%} inside"
        )
