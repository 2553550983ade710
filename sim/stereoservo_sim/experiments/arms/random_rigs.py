"""Experiment: success rate of self-calibration on random rigs, arms, bodies and noise, and whether reported
accuracy holds.

Each case is evaluated against the ground truth, which the calibration does not use. *Success*: a model whose
predictions of held-out configurations are as far from the exact pixels as its own covariance says, and whose stated
focal lengths and principal point are true within their deviations. *Failure*: a CalibrationError. *Wrong*: a model
that fails the judge.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from rich.console import Console
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import norm

from stereoservo.calibration.bundle_adjustment import jacobian
from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.input_corrections import solution_of
from stereoservo.calibration.rig_model import Measurements, residuals, reversed_trials, with_joints_reversed
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo_sim.experiments.experiment import show_rows
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.random_cells import BODIES, RandomCase, random_case
from stereoservo_sim.world.synthetic import FIRST_MARKER

Outcome = Literal["success", "failure", "wrong"]

TAIL = 1e-6
"""Probability with which a true model is called wrong, for each of the judge's two questions."""
SEEDS = 12
"""Cases of the command by default."""
PROMISED = 0.995
"""Share of successes that is asked for."""


class Verdict(msgspec.Struct, frozen=True):
    """Outcome of a case.

    ``error_ratio``: squared errors of held-out pixels over those that the model's covariance states; with
    ``freedom`` effective degrees of freedom it must not exceed ``limit``. ``intrinsics_sigmas``: largest error of the
    left camera's intrinsics in stated deviations (0 below the metric stratum).
    """

    seed: int
    outcome: Outcome
    arm: str
    body: str
    sigma_px: float
    stratum: str = ""
    code: str = ""
    message: str = ""
    error_ratio: float = 0.0
    freedom: float = 0.0
    limit: float = 0.0
    rms_px: float = 0.0
    intrinsics_sigmas: float = 0.0
    seconds: float = 0.0


def judged(seed: int) -> Verdict:
    """Outcome of the case of ``seed``, calibrated without prior knowledge."""
    return judged_case(random_case(seed))


def judged_case(case: RandomCase) -> Verdict:
    """Outcome of a case, calibrated without prior knowledge."""
    trials = case.trials()
    begin = time.process_time()
    try:
        result = fit_model(trials, epoch=1)
    except CalibrationError as error:
        return Verdict(
            case.seed,
            "failure",
            case.arm,
            case.body,
            case.sigma,
            code=error.code,
            message=error.message,
            seconds=time.process_time() - begin,
        )
    seconds = time.process_time() - begin
    ratio, freedom, rms = held_out_ratio(case, trials, result)
    limit = float(chi2_distribution.isf(TAIL, freedom)) / freedom
    intrinsics = intrinsics_sigmas(case, result)
    true = ratio <= limit and intrinsics <= float(norm.isf(0.5 * TAIL))
    return Verdict(
        case.seed,
        "success" if true else "wrong",
        case.arm,
        case.body,
        case.sigma,
        stratum=result.model.stratum,
        error_ratio=ratio,
        freedom=freedom,
        limit=limit,
        rms_px=rms,
        intrinsics_sigmas=intrinsics,
        seconds=seconds,
    )


def held_out_ratio(case: RandomCase, trials: TrialData, result: CalibrationFit) -> tuple[float, float, float]:
    """Squared errors of held-out pixels over their stated sum, its effective degrees of freedom, the rms error [px].

    With the errors ``L z``, ``z`` standard normal, the sum of squares has mean ``tr LᵀL`` and is taken for a
    chi-square of ``(tr LᵀL)² / tr (LᵀL)²`` degrees of freedom of the same mean (Satterthwaite). With cameras on the arm
    its joints are counted from them.
    """
    positions = order = case.held_out()
    if case.cell.mount == "eye_in_hand":
        trials, order = reversed_trials(trials), positions[:, ::-1]
        result = msgspec.structs.replace(result, model=with_joints_reversed(result.model))
    solution = solution_of(trials, result)
    kept = [i - FIRST_MARKER for i in result.model.marker_ids]
    seen = case.cell.in_view(positions)[:, :, kept]
    camera, stop, marker = np.nonzero(seen)
    exact = case.cell.pixels(positions)[:, :, kept][seen]
    data = Measurements(order - result.model.zero, camera, stop, marker, exact, np.ones(len(exact)))
    errors = residuals(solution.rig, data)
    roots = (
        jacobian(solution.rig, solution.charts, np.zeros(solution.charts.size), data)
        @ solution.determined.root
    )
    moments = roots.T @ roots * max(1.0, solution.determined.variance)
    mean = float(np.trace(moments))
    freedom = mean**2 / float((moments**2).sum())
    return float(errors @ errors) / mean, freedom, float(np.sqrt((errors**2).mean()))


def intrinsics_sigmas(case: RandomCase, result: CalibrationFit) -> float:
    """Largest error of the left camera's fx, skew, fy, u0, v0 in stated deviations; 0 below the metric stratum."""
    stated, deviations = result.report.cameras[0].intrinsics, result.report.left_intrinsics_std
    if stated is None or deviations is None:
        return 0.0
    K = case.cell.intrinsics[0]
    true = np.array([K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2]])
    return float(np.max(np.abs(np.array(stated) - true) / np.array(deviations)))


def run_random_rigs(
    seeds: int = SEEDS, seed: int = 0, progress: ProgressCall | None = None
) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: counts, Wilson's 95 % interval of the success rate, rows over noise, and
    every case that is not a success.

    Raises ValueError for fewer than one case.
    """
    if seeds < 1:
        raise ValueError(f"{seeds} cases; at least 1 is needed")
    verdicts = []
    for k in range(seeds):
        verdicts.append(judged(seed + k))
        if progress is not None:
            progress("cases", k + 1, seeds)
    counts = Counter(verdict.outcome for verdict in verdicts)
    low, high = wilson(counts["success"], seeds)
    return {
        "experiment": "random-rigs",
        "seed": seed,
        "seeds": seeds,
        "success": counts["success"],
        "failure": counts["failure"],
        "wrong": counts["wrong"],
        "success_rate": counts["success"] / seeds,
        "wilson_95": [low, high],
        "promised": PROMISED,
        "strata": dict(Counter(verdict.stratum for verdict in verdicts if verdict.stratum)),
        "seconds_median": float(np.median([verdict.seconds for verdict in verdicts])),
        "rows": _rows(verdicts),
        "failures_by_cause": dict(Counter(v.code for v in verdicts if v.outcome == "failure")),
        "not_successes": [msgspec.structs.asdict(v) for v in verdicts if v.outcome != "success"],
        "thesis": {
            "note": "none: the thesis starts from a good guess (5.4.4) and calibrates one robot (5.5)"
        },
    }


def _rows(verdicts: list[Verdict]) -> list[dict[str, Any]]:
    """One object for each decade of noise and each body: successes, and the errors of held-out pixels in sigmas."""
    rows = []
    for low, high in ((0.01, 0.1), (0.1, 1.0)):
        for body in BODIES:
            own = [v for v in verdicts if low <= v.sigma_px < high and v.body == body]
            good = [v for v in own if v.outcome == "success"]
            if not own:
                continue
            errors = [v.rms_px / v.sigma_px for v in good]
            low_error, median, high_error = np.quantile(errors, [0.16, 0.5, 0.84]) if good else [np.nan] * 3
            rows.append(
                {
                    "condition": f"{body}, {low:g} to {high:g} px",
                    "cases": len(own),
                    "success": len(good),
                    "held_out_error_sigmas": float(median) if good else None,
                    "spread": [float(low_error), float(high_error)] if good else None,
                }
            )
    return rows


def draw_random_rigs(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Successes by body and noise, as bars with the number of cases. Raises OSError."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    rows = answer["rows"]
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    places = np.arange(len(rows))
    axes.barh(places, [row["cases"] for row in rows], color="0.85", label="cases")
    axes.barh(places, [row["success"] for row in rows], height=0.5, label="model true within its covariance")
    axes.set_yticks(places, [row["condition"] for row in rows])
    axes.invert_yaxis()
    low, high = answer["wilson_95"]
    axes.set_title(
        f"{answer['success']} of {answer['seeds']} random rigs calibrated, {answer['wrong']} wrong "
        f"(95 %: {low:.2%} to {high:.2%})"
    )
    axes.legend()
    path = folder / "random_rigs.png"
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return [path]


def show_random_rigs(answer: dict[str, Any], console: Console) -> None:
    """Print the rate with its interval, rows, and the failures."""
    show_rows(answer, console)
    low, high = answer["wilson_95"]
    console.print(
        f"{answer['success']} of {answer['seeds']} succeeded ({answer['success_rate']:.2%}; Wilson 95 %: {low:.2%} to "
        f"{high:.2%}; promised {answer['promised']:.1%}), {answer['failure']} refused, {answer['wrong']} wrong"
    )
    for case in answer["not_successes"]:
        console.print(f"case {case['seed']}: {case['outcome']} {case['code']} {case['message']}")
