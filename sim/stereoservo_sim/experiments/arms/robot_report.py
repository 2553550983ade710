"""JSON report and figures of the experiment ``robot``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import norm

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.arms.robot import QUANTITIES, ProgressCall, RobotRuns, simulate
from stereoservo_sim.experiments.arms.thesis_robot import (
    ASSUMPTIONS,
    BASELINE,
    HOME_DEG,
    IMPLIED_BASELINE,
    IMPLIED_SIGMA,
    PLATE_TURNS_DEG,
    SIGMA,
    STOPS,
    STROKES_DEG,
    THESIS,
    thesis_cell,
    trial_motions,
)
from stereoservo_sim.experiments.comparison import Comparison, of_error
from stereoservo_sim.experiments.experiment import whole_table

BINS = np.linspace(-4.0, 4.0, 41)
"""Edges of the residual histograms [sigmas]."""
TAIL = 0.005
"""Of each side of the chi-square interval of 1 %."""
PARTS_OF_AXES_2_3 = ("axes 2, 3 about their normal", "axes 2, 3 in their plane")


def run_robot(seeds: int = 30, seed: int = 0, progress: ProgressCall = lambda *_: None) -> dict[str, Any]:
    """Run ``seeds`` simulated calibrations of each setting; tables 5.1 to 5.4 beside the thesis's."""
    implied = simulate(seeds, seed, progress, IMPLIED_SIGMA, IMPLIED_BASELINE)
    return answer(simulate(seeds, seed, progress), implied, seed)


def answer(runs: RobotRuns, implied: RobotRuns, seed: int) -> dict[str, Any]:
    """The JSON object of ``reproduce robot``: ``rows`` of the cameras and the noise that are assumed, ``implied`` of
    those that the thesis implies."""
    positions, _ = trial_motions(runs.cell)
    images = len(positions) * len(runs.cell.poses)
    return {
        "experiment": "robot",
        "seed": seed,
        "seeds": len(runs.values),
        "sigma_px": SIGMA,
        "trial_motions": {
            "home_deg": list(HOME_DEG),
            "strokes_deg": list(STROKES_DEG),
            "stops_per_stroke": STOPS,
            "plate_turns_deg": list(PLATE_TURNS_DEG),
            "stops": len(positions),
            "images": images,
        },
        "rows": [*_image_rows(runs), *_metric_rows(runs)],
        "implied": {
            "sigma_px": implied.sigma,
            "baseline_m": IMPLIED_BASELINE,
            "rows": [*_image_rows(implied), *_metric_rows(implied)],
            "efficiency": _efficiency(implied),
        },
        "efficiency": _efficiency(runs),
        "residual_chi2": _chi2(float(runs.chi2.sum()), runs.freedom * len(runs.chi2)),
        "histograms": {
            "edges_sigmas": BINS.tolist(),
            "axes": [_histogram(runs, j) for j in range(len(runs.cell.kinds))],
        },
        "thesis": THESIS,
        "assumptions": ASSUMPTIONS,
    }


def _image_rows(runs: RobotRuns) -> list[dict[str, Any]]:
    rows = []
    for kind, told in (("fixed", "fixed points (5.53)"), ("free", "free points (5.55)")):
        found = np.array([getattr(images, kind) for images in runs.images])
        floors = np.array([getattr(images, f"{kind}_floor") for images in runs.images])
        for j, thesis in enumerate(THESIS["5.1"][kind]):
            rows.append(
                {
                    "table": "5.1",
                    "condition": f"axis {j + 1}, {told}",
                    "unit": "px",
                    "true": None,
                    "ours": _spread(found[:, j]),
                    "rms_error": None,
                    "bound": float(floors[:, j].mean()),
                    "thesis": thesis,
                    "thesis_error": None,
                }
            )
    return rows


def _metric_rows(runs: RobotRuns) -> list[dict[str, Any]]:
    """Tables 5.2 to 5.4; the angle of axes 2 and 3, which is 0, from its two components."""
    bounds = np.sqrt(np.diag(runs.bound))
    names = [quantity.name for quantity in QUANTITIES]
    rows = []
    for k, quantity in enumerate(QUANTITIES):
        values, truth, bound, name = runs.values[:, k], float(runs.truth[k]), float(bounds[k]), quantity.name
        if name == PARTS_OF_AXES_2_3[1]:
            continue
        if name == PARTS_OF_AXES_2_3[0]:
            other = names.index(PARTS_OF_AXES_2_3[1])
            values = np.hypot(values, runs.values[:, other])
            bound, name, truth = float(np.hypot(bound, bounds[other])), "axes 2, 3", 0.0
        factory, experiment = _thesis_values(quantity.table, name)
        rows.append(
            {
                "table": quantity.table,
                "condition": name,
                "unit": quantity.unit,
                "true": _clean(truth),
                "ours": _spread(values),
                "rms_error": float(np.sqrt(np.mean((values - truth) ** 2))),
                "bound": bound,
                "thesis": experiment,
                "thesis_error": None if factory is None else abs(experiment - factory),
            }
        )
    return rows


def _clean(value: float) -> float:
    """A zero with rounding errors as exactly zero."""
    return 0.0 if abs(value) < 1e-9 else value


def _thesis_values(table: str, name: str) -> tuple[Any, Any]:
    """Published reference (factory or off-line) value and the experiment's, None where the thesis has none."""
    if table == "5.2":
        side, part = name.split()
        return tuple(THESIS["5.2"][side].get(part, (None, None)))
    return tuple(THESIS[table][name])


def compare_robot(answer: dict[str, Any]) -> list[Comparison]:
    """Tables 5.1 to 5.4 beside our errors with the noise and the baseline that the thesis implies."""
    implied, seeds = answer["implied"], answer["seeds"]
    setting = f"{implied['sigma_px']:g} px, baseline {100 * implied['baseline_m']:.0f} cm"
    found = [
        Comparison("figs 5.14, 5.15", "tracks of the markers in the images", "plotted", "drawn", "not comparable",
                   "the thesis prints no values of them"),
    ]  # fmt: skip
    for row in implied["rows"]:
        item, bound = f"table {row['table']}", row["bound"]
        if row["table"] == "5.1":
            ours = of_error(item, row["condition"], row["thesis"], row["ours"]["median"], "px",
                            f"the noise alone gives {bound:.2g} px, of one stereo image at home")  # fmt: skip
            if "free" in row["condition"]:
                ours = ours._replace(
                    verdict="not comparable",
                    why="the noise is chosen such that the mean of this column is met",
                )
            found.append(ours)
        elif row["thesis_error"] is not None and bound > 0.0:
            why = f"the Cramér-Rao bound is {bound:.2g} {row['unit']} at {setting}"
            if bound < row["thesis_error"]:
                why = f"an rms of {seeds} beside one error"
            elif row["thesis_error"] < 0.5 * bound:
                why += f"; the thesis's is one error, which chance makes small, ours an rms of {seeds}"
            found.append(
                of_error(
                    item,
                    f"{row['condition']}, error",
                    row["thesis_error"],
                    row["rms_error"],
                    row["unit"],
                    why,
                )
            )
    return found


def _efficiency(runs: RobotRuns) -> dict[str, Any]:
    """Errors of all quantities against the Cramér-Rao covariance, pooled over the seeds."""
    errors = runs.values - runs.truth
    normalised = np.linalg.solve(np.linalg.cholesky(runs.bound), errors.T)
    single = np.abs(errors) / np.sqrt(np.diag(runs.bound))
    result = _chi2(float((normalised**2).sum()), errors.size)
    result["largest_error_in_sigmas"] = float(single.max())
    result["beyond_three_sigmas"] = int((single > 3.0).sum())
    result["expected_beyond_three_sigmas"] = float(2 * norm.sf(3.0) * errors.size)
    result["reported_over_bound"] = float((runs.reported / np.sqrt(np.diag(runs.bound))).mean())
    return result


def _chi2(value: float, freedom: int) -> dict[str, Any]:
    low, high = chi2_distribution.ppf([TAIL, 1.0 - TAIL], freedom)
    return {
        "chi2": value,
        "freedom": freedom,
        "interval": [float(low), float(high)],
        "inside": bool(low <= value <= high),
    }


def _spread(values: FloatArray) -> dict[str, float]:
    low, middle, high = np.percentile(values, [16, 50, 84])
    return {"median": float(middle), "p16": float(low), "p84": float(high)}


def _histogram(runs: RobotRuns, joint: int) -> list[int]:
    residuals = np.concatenate([images.residuals[images.joint == joint].ravel() for images in runs.images])
    return [int(count) for count in np.histogram(residuals, BINS)[0]]


def show_robot(answer: dict[str, Any], console: Console) -> None:
    """Print one table for each of the thesis's in both settings, then the summary."""
    implied = answer["implied"]
    _show_tables(answer["rows"], f"{answer['sigma_px']:g} px, {100 * BASELINE:.0f} cm", console)
    _show_tables(
        implied["rows"], f"{implied['sigma_px']:g} px, {100 * implied['baseline_m']:.0f} cm", console
    )
    motions = answer["trial_motions"]
    for setting, test in (("assumed", answer["efficiency"]), ("implied", implied["efficiency"])):
        console.print(
            f"{setting} noise and baseline: {answer['seeds']} seeds, {motions['images']} images each: squared errors "
            f"over the bound {test['chi2']:.0f} for {test['freedom']}, 99 % interval {test['interval'][0]:.0f} to "
            f"{test['interval'][1]:.0f}; reported deviations {test['reported_over_bound']:.4f} of the bound"
        )


def _show_tables(rows: list[dict[str, Any]], setting: str, console: Console) -> None:
    for number, what in (
        ("5.1", "mean image distance [px], with what the noise alone gives"),
        ("5.2", "intrinsics [px]"),
        ("5.3", "angles between axes [°]"),
        ("5.4", "links [mm]"),
    ):
        first = number == "5.1"
        names = (
            ("", "ours", "noise", "thesis")
            if first
            else ("", "true", "rms error", "bound", "thesis", "error")
        )
        lines = []
        for row in rows:
            if row["table"] != number:
                continue
            ours = row["ours"]["median"] if first else row["rms_error"]
            shown = [ours, row["bound"], row["thesis"]]
            if not first:
                shown = [row["true"], *shown, row["thesis_error"]]
            lines.append([row["condition"], *("-" if value is None else f"{value:.4g}" for value in shown)])
        columns = {name: "right" if name else "left" for name in names}
        whole_table(console, f"table {number}: {what}; {setting}", columns, lines)


def draw_robot(answer: dict[str, Any], folder: Path) -> list[Path]:
    """``robot-tracks.png``, ``robot-residuals.png`` and ``robot-errors.png`` in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, painter, size in (
        ("tracks", _draw_tracks, (11, 5.8)),
        ("residuals", _draw_residuals, (11, 6)),
        ("errors", _draw_errors, (12, 5)),
    ):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        painter(answer, figure)
        paths.append(folder / f"robot-{name}.png")
        figure.savefig(paths[-1], dpi=110)
    return paths


def _draw_tracks(answer: dict[str, Any], figure: Any) -> None:
    """Figure of the dots in both images over all trial motions (figs 5.14, 5.15)."""
    cell = thesis_cell()
    positions, trials = trial_motions(cell)
    pixels = cell.pixels(positions)
    for axis, side, seen in zip(figure.subplots(1, 2), ("left", "right"), pixels, strict=True):
        for j in range(len(cell.kinds)):
            axis.plot(*seen[trials == j].reshape(-1, 2).T, ".", markersize=2, label=f"axis {j + 1}")
        axis.set(
            xlim=(0, cell.width),
            ylim=(cell.height, 0),
            aspect="equal",
            xlabel="u [px]",
            ylabel="v [px]",
            title=f"{side} camera: {answer['trial_motions']['stops']} stops",
        )
        axis.legend(markerscale=4, fontsize=8)


def _draw_residuals(answer: dict[str, Any], figure: Any) -> None:
    edges = np.array(answer["histograms"]["edges_sigmas"])
    middle, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    for j, (axis, counts) in enumerate(
        zip(figure.subplots(2, 3).ravel(), answer["histograms"]["axes"], strict=True)
    ):
        total = max(1, sum(counts))
        axis.bar(middle, np.array(counts) / (total * width), width=width, alpha=0.6)
        axis.plot(middle, norm.pdf(middle), color="black", linewidth=1)
        axis.set(title=f"axis {j + 1}: {total} residuals", xlabel=f"residual [{answer['sigma_px']} px]")


def _draw_errors(answer: dict[str, Any], figure: Any) -> None:
    """Figure of the errors of the thesis, ours and the bound, by table."""
    panels = figure.subplots(1, 3, width_ratios=[8, 5, 5])
    for axis, table, unit in zip(panels, ("5.2", "5.3", "5.4"), ("px", "deg", "mm"), strict=True):
        rows = [row for row in answer["rows"] if row["table"] == table and row["thesis_error"] is not None]
        rows = [row for row in rows if row["bound"] > 0.0]
        places = np.arange(len(rows))
        for k, (key, label) in enumerate(
            (("thesis_error", "thesis"), ("rms_error", "ours, rms"), ("bound", "bound"))
        ):
            axis.bar(places + 0.27 * (k - 1), [max(row[key], 1e-4) for row in rows], 0.27, label=label)
        axis.set_xticks(places, [row["condition"] for row in rows], rotation=60, ha="right")
        axis.set(yscale="log", ylabel=f"error [{unit}]", title=f"table {table}")
        axis.legend(fontsize=8)
