"""Experiment ``pan-tilt`` (table 4.1, figs 4.8, 4.9): calibration of a pan-tilt head, and prediction of images
after a motion.

Points reconstructed from one stereo image are moved by the joints' difference and compared with the next image. What
is left with a perfect calibration is the noise of the two images; the calibration adds little to it.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console

from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.joint_reprojection import SeenChain, points_seen, predicted_pixels, seen_chain
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.comparison import Comparison, of_error, of_limit, of_statement
from stereoservo_sim.experiments.experiment import show_table, whole_table
from stereoservo_sim.experiments.rotations.head_pictures import ASSUMPTIONS as PICTURES_ASSUMED
from stereoservo_sim.experiments.rotations.head_pictures import head_before_pictures
from stereoservo_sim.experiments.rotations.thesis_head import (
    ASSUMPTIONS,
    CALIBRATING_POINTS,
    PAN_STEPS,
    PAN_USED,
    SIGMA,
    TILT_USED,
    Noise,
    SeenHead,
    calibrated,
    general_positions,
    head,
    separate_rotations,
    tracked,
    tracks_of,
    trial_data,
)
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import spread
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell

POSITIONS, PAIRS = 9, 35
"""General positions, and pairs of them that are predicted (fig. 4.9): one pair of the 36 is left out."""
CONDITIONS = ("pan calibration", "tilt calibration", "feed-forward")
NOISES: tuple[Noise, ...] = ("drifting", "independent")
MEASURES = ("delta_u_mean", "delta_u_sd", "delta_v_mean", "delta_v_sd", "delta_l", "delta_r", "delta_lr")
EDGES, DISTANCES = np.linspace(-3.0, 3.0, 61), np.linspace(0.0, 4.0, 41)
"""[px], of the histograms."""
FEED_FORWARD = {
    "delta_u_mean": -0.04,
    "delta_u_sd": 0.73,
    "delta_v_mean": -0.02,
    "delta_v_sd": 0.77,
    "delta_lr": 0.77,
}
THESIS = {
    "table": "4.1",
    "unit": "px",
    "pan calibration": {
        "delta_u_mean": -0.8e-4,
        "delta_u_sd": 0.36,
        "delta_v_mean": -0.01,
        "delta_v_sd": 0.71,
        "delta_lr": 0.66,
    },
    "tilt calibration": {
        "delta_u_mean": 0.02,
        "delta_u_sd": 0.42,
        "delta_v_mean": -0.04,
        "delta_v_sd": 0.50,
        "delta_lr": 0.51,
    },
    "feed-forward": FEED_FORWARD,
    "note": "the first entry is printed as -0.8e4; -0.8e-4 is meant",
}


def step_pairs(used: tuple[int, ...], steps: int) -> list[tuple[int, int]]:
    """Consecutive steps that are not used for calibration (4.5.2)."""
    return [(i, i + 1) for i in range(steps) if i not in used and i + 1 not in used]


def step_errors(
    seen: SeenChain,
    positions: FloatArray,
    pixels: FloatArray,
    target: FloatArray,
    pairs: list[tuple[int, int]],
) -> FloatArray:
    """Predicted less extracted pixels (pairs, c, m, 2) [px]: from ``pixels`` (c, s, m, 2) of one image to ``target`` of
    the other.
    """
    return np.array(
        [feed_forward(seen, positions[i], pixels[:, i], positions[j])[0] - target[:, j] for i, j in pairs]
    )


def measures(errors: FloatArray) -> dict[str, float]:
    """Mean and deviation of Δu and Δv, mean distances Δ_L, Δ_R, Δ_LR (4.5.2) of errors (..., c, m, 2) [px]."""
    distances = np.linalg.norm(errors, axis=-1)
    left, right = np.moveaxis(distances, -2, 0)
    return {
        "delta_u_mean": float(errors[..., 0].mean()),
        "delta_u_sd": float(errors[..., 0].std()),
        "delta_v_mean": float(errors[..., 1].mean()),
        "delta_v_sd": float(errors[..., 1].std()),
        "delta_l": float(left.mean()),
        "delta_r": float(right.mean()),
        "delta_lr": float(distances.mean()),
    }


def trial(cell: SyntheticCell, noise: Noise, rng: np.random.Generator) -> dict[str, dict[str, FloatArray]]:
    """Errors (pairs, c, m, 2) of each condition with the ``calibrated`` head, with one of two ``separate`` rotations,
    with the ``perfect`` one, and of the calibrated one on ``exact`` images. Raises CalibrationError, GeometryError.
    """
    tracks = tracks_of(cell, noise, rng)
    general = general_positions(cell, rng, POSITIONS)
    exact = cell.pixels(general)
    return errors_of(SeenHead(cell, tracks, general, tracked(exact, noise, rng), exact), CALIBRATING_POINTS)


def errors_of(seen: SeenHead, calibrating: int) -> dict[str, dict[str, FloatArray]]:
    """The errors of `trial` of what a head saw, of which the first ``calibrating`` points calibrate."""
    trials = trial_data(seen.cell, seen.tracks, calibrating)
    heads = {
        "calibrated": calibrated(trials).seen,
        "separate": separate_rotations(trials),
        "perfect": seen_chain(exact_model(seen.cell)),
    }
    answer: dict[str, dict[str, FloatArray]] = {}
    for condition, (positions, pixels, exact, pairs) in _sequences(seen).items():
        pixels, exact = pixels[:, :, calibrating:], exact[:, :, calibrating:]
        answer[condition] = {
            name: step_errors(head, positions, pixels, pixels, pairs) for name, head in heads.items()
        }
        answer[condition]["exact"] = step_errors(heads["calibrated"], positions, exact, exact, pairs)
    return answer


def by_pictures(rng: np.random.Generator) -> list[dict[str, Any]]:
    """The same through rendered pictures: a row a condition, with the tracker's error between consecutive pictures and
    what it has drifted by at the end of the pan trajectory, rms [px]. Raises DriverError, CalibrationError,
    GeometryError.
    """
    seen = head_before_pictures(rng, POSITIONS)
    off = seen.tracks.pan - seen.tracks.pan_exact
    calibrating = min(CALIBRATING_POINTS, off.shape[2] // 2)
    about = {
        "points": off.shape[2],
        "tracker_px": float(np.diff(off, axis=1).std()),
        "drift_px": float((off[:, -1] - off[:, 0]).std()),
    }
    return [
        {
            "condition": condition,
            **about,
            **measures(kinds["calibrated"]),
            "perfect_calibration_delta_lr": measures(kinds["perfect"])["delta_lr"],
        }
        for condition, kinds in errors_of(seen, calibrating).items()
    ]


Sequence = tuple[FloatArray, FloatArray, FloatArray, list[tuple[int, int]]]


def _sequences(seen: SeenHead) -> dict[str, Sequence]:
    """Positions, tracked and exact pixels, and the pairs to predict, of each condition."""
    tracks = seen.tracks
    return {
        "pan calibration": (
            tracks.pan_positions,
            tracks.pan,
            tracks.pan_exact,
            step_pairs(PAN_USED, len(tracks.pan_positions) - 1),
        ),
        "tilt calibration": (
            tracks.tilt_positions,
            tracks.tilt,
            tracks.tilt_exact,
            step_pairs(TILT_USED, len(tracks.tilt_positions) - 1),
        ),
        "feed-forward": (
            seen.general,
            seen.pixels,
            seen.exact,
            list(combinations(range(len(seen.general)), 2))[:PAIRS],
        ),
    }


def feed_forward(
    seen: SeenChain, q_from: FloatArray, pixels: FloatArray, q_to: FloatArray, sigma: FloatArray | float = 1.0
) -> FloatArray:
    """Predicted raw pixels (s, c, m, 2) at configurations ``q_to`` (s, n) of points seen at ``pixels`` (c, m, 2) in
    ``q_from`` (n,): reconstructed, displaced by the joints (4.44), projected. NaN where two cameras do not see a
    point.
    """
    points, _ = points_seen(seen, q_from, pixels, sigma)
    return predicted_pixels(seen, np.atleast_2d(q_to), points)


def run_pan_tilt(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Table 4.1 over ``seeds`` heads and mountains, with drifting and with independent noise."""
    found: dict[tuple[Noise, str, str], list[dict[str, float]]] = {}
    failed: list[dict[str, Any]] = []
    example: dict[str, FloatArray] = {}
    paths: list[tuple[float, float]] = []
    for i in range(seeds):
        progress("pan-tilt", i, seeds)
        for noise in NOISES:
            rng = np.random.default_rng([seed, i])
            cell = head(rng)
            try:
                errors = trial(cell, noise, rng)
            except (CalibrationError, GeometryError) as error:
                failed.append({"noise": noise, "seed": i, "code": error.code, "message": str(error)})
                continue
            for condition, kinds in errors.items():
                for kind, values in kinds.items():
                    found.setdefault((noise, condition, kind), []).append(measures(values))
                if noise == "drifting" and condition not in example:
                    example[condition] = kinds["calibrated"]
        paths.append(_path_lengths(cell))
    rendered = by_pictures(np.random.default_rng([seed, 3]))
    progress("pan-tilt", seeds, seeds)
    return {
        "experiment": "pan-tilt",
        "seed": seed,
        "seeds": seeds,
        "sigma_px": SIGMA,
        "rows": [_row(noise, condition, found) for noise in NOISES for condition in CONDITIONS],
        "rendered": rendered,
        "thesis": THESIS,
        "assumptions": [*ASSUMPTIONS, *PICTURES_ASSUMED],
        "path_px": {
            "pan": float(np.mean([p for p, _ in paths])),
            "tilt": float(np.mean([t for _, t in paths])),
        },
        "failed": failed,
        "example": {condition: _histograms(values) for condition, values in example.items()},
    }


def _histograms(errors: FloatArray) -> dict[str, Any]:
    """Counts of Δu, Δv and of Δ_L, Δ_R over ``EDGES`` and ``DISTANCES``, and the measures of each pair, of one seed."""
    left, right = np.moveaxis(np.linalg.norm(errors, axis=-1), -2, 0)
    counts = {
        "delta_u": np.histogram(errors[..., 0], EDGES)[0],
        "delta_v": np.histogram(errors[..., 1], EDGES)[0],
        "delta_l": np.histogram(left, DISTANCES)[0],
        "delta_r": np.histogram(right, DISTANCES)[0],
    }
    return {
        **{name: count.tolist() for name, count in counts.items()},
        "pairs": [measures(pair) for pair in errors],
    }


def _row(
    noise: Noise, condition: str, found: dict[tuple[Noise, str, str], list[dict[str, float]]]
) -> dict[str, Any]:
    ours = found.get((noise, condition, "calibrated"), [])
    beside = {
        "perfect_calibration_delta_lr": found.get((noise, condition, "perfect"), []),
        "separate_rotations_delta_lr": found.get((noise, condition, "separate"), []),
        "calibration_alone_delta_lr": found.get((noise, condition, "exact"), []),
    }
    return {
        "condition": condition,
        "noise": noise,
        "seeds": len(ours),
        **{name: spread([values[name] for values in ours]) for name in MEASURES},
        **{name: spread([values["delta_lr"] for values in runs]) for name, runs in beside.items()},
    }


def _path_lengths(cell: SyntheticCell) -> tuple[float, float]:
    """Mean length [px] of a point's track between the ends of the pan and of the tilt trajectory."""
    ends = cell.home + cell.ranges * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    exact = cell.pixels(ends)
    pan, tilt = (float(np.linalg.norm(exact[:, k] - exact[:, 0], axis=-1).mean()) for k in (1, 2))
    return pan, tilt


def compare_pan_tilt(answer: dict[str, Any]) -> list[Comparison]:
    """Table 4.1 beside our medians with drifting tracks, as the thesis's are."""
    names = {"delta_u_sd": "deviation of Δu", "delta_v_sd": "deviation of Δv", "delta_lr": "Δ_LR"}
    found = []
    for row in answer["rows"]:
        if row["noise"] != "drifting":
            continue
        said = answer["thesis"][row["condition"]]
        means = ("delta_u_mean", "delta_v_mean")
        found.append(
            of_limit("table 4.1", f"{row['condition']}: larger mean of Δu and Δv", max(abs(said[m]) for m in means),
                     max(abs(row[m]["median"]) for m in means), "px",
                     f"of {row['seeds']} heads, each with its own error of calibration", said="")
        )  # fmt: skip
        for key, name in names.items():
            why = f"{row['perfect_calibration_delta_lr']['median']:.2f} px with the head known: noise"
            found.append(
                of_error("table 4.1", f"{row['condition']}: {name}", said[key], row[key]["median"], "px", why)
            )
    moved = next(
        row for row in answer["rows"] if (row["condition"], row["noise"]) == ("feed-forward", "drifting")
    )
    equal = [(row["condition"], row["delta_l"]["median"], row["delta_r"]["median"]) for row in answer["rows"]
             if row["noise"] == "drifting" and row["condition"] != "feed-forward"]  # fmt: skip
    return [
        *found,
        *(
            of_statement(
                "fig. 4.8",
                f"{condition}: left and right image",
                "equal error distributions",
                f"{left:.3f} and {right:.3f} px",
                abs(left - right) < 0.1 * right,
            )
            for condition, left, right in equal
        ),
        of_limit("fig. 4.9", "mean prediction error, Δ_LR", 1.0, moved["delta_lr"]["median"], "px"),
        *_compared_pictures(answer),
    ]


def _compared_pictures(answer: dict[str, Any]) -> list[Comparison]:
    """Table 4.1, fig. 4.9 and the tracker of 4.5.1 beside what is had through pictures, the largest of all heads."""
    rows = answer["rendered"]
    largest = {
        condition: max(row["delta_lr"] for row in rows if row["condition"] == condition)
        for condition in CONDITIONS
    }
    step, drift = max(row["tracker_px"] for row in rows), min(row["drift_px"] for row in rows)
    return [
        *(of_error("table 4.1", f"rendered, {condition}: Δ_LR", answer["thesis"][condition]["delta_lr"], value, "px")
          for condition, value in largest.items()),
        of_limit("fig. 4.9", "rendered, mean prediction error, Δ_LR", 1.0, largest["feed-forward"], "px"),
        of_error("4.5.1", "rendered, tracker between consecutive images", SIGMA, step, "px"),
        of_statement("4.5.1", "rendered, drift of the tracked points", "noticeable, errors sum up",
                     f"{drift:.2g} px rms after {PAN_STEPS} steps, {step:.2g} px a step", drift > 3.0 * step),
    ]  # fmt: skip


def draw_pan_tilt(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Histograms of errors and distances of the first seed (fig. 4.8), and Δ over its 35 predictions (fig. 4.9)."""
    folder.mkdir(parents=True, exist_ok=True)
    example = answer["example"]
    figure = Figure(figsize=(10, 7), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2)
    for column, condition in enumerate(CONDITIONS[:2]):
        for axis, edges, names in (
            (panels[0, column], EDGES, ("delta_u", "delta_v")),
            (panels[1, column], DISTANCES, ("delta_l", "delta_r")),
        ):
            for name, colour in zip(names, ("#0072b2", "#d55e00"), strict=True):
                if condition in example:
                    axis.stairs(example[condition][name], edges, color=colour, label=name)
            axis.set_xlabel("[px]", fontsize=8)
            axis.legend(fontsize=8)
        panels[0, column].set_title(f"{condition} (first seed, drifting)", fontsize=9)
    paths = [folder / "pan-tilt-calibration.png", folder / "pan-tilt-prediction.png"]
    figure.savefig(paths[0], dpi=110)
    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    pairs = example["feed-forward"]["pairs"] if "feed-forward" in example else []
    for name, label, colour in (
        ("delta_u_mean", "delta_u", "#0072b2"),
        ("delta_v_mean", "delta_v", "#d55e00"),
        ("delta_lr", "delta_LR", "#009e73"),
    ):
        axis.plot([pair[name] for pair in pairs], marker="o", markersize=3, color=colour, label=label)
    axis.axhline(FEED_FORWARD["delta_lr"], color="#666666", linestyle="--", label="delta_LR, thesis (mean)")
    axis.set_title("feed-forward (first seed, drifting)", fontsize=9)
    axis.set_xlabel("prediction", fontsize=8)
    axis.set_ylabel("[px]", fontsize=8)
    axis.legend(fontsize=8)
    figure.savefig(paths[1], dpi=110)
    return paths


def show_pan_tilt(answer: dict[str, Any], console: Console) -> None:
    """Table 4.1 with medians over seeds, one table a noise; the thesis's figures in brackets."""
    measures = {
        "delta_u_mean": "u, mean",
        "delta_u_sd": "u, deviation",
        "delta_v_mean": "v, mean",
        "delta_v_sd": "v, deviation",
        "delta_lr": "LR",
        "separate_rotations_delta_lr": "LR, joints by themselves",
        "perfect_calibration_delta_lr": "LR, head known",
        "calibration_alone_delta_lr": "LR, no noise",
    }
    for noise in dict.fromkeys(row["noise"] for row in answer["rows"]):
        rows = [row for row in answer["rows"] if row["noise"] == noise]
        whole_table(
            console,
            f"{noise} tracks, {answer['seeds']} seeds: medians [px] (thesis)",
            {"": "left", **dict.fromkeys((row["condition"] for row in rows), "right")},
            [
                [name, *(_beside(row[key], answer["thesis"][row["condition"]].get(key)) for row in rows)]
                for key, name in measures.items()
            ],
        )
    show_table(answer["rendered"], "through rendered pictures", console)


def _beside(ours: dict[str, Any], thesis: float | None) -> str:
    median = "-" if ours["median"] is None else f"{ours['median']:.3f}"
    return median if thesis is None else f"{median} ({thesis:.3g})"
