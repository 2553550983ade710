"""Results of a demonstration: evaluation, report, summary."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereoservo.calibration.trial_data import TrialData
from stereoservo.geometry.cameras import project_many
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.demonstration.judge import (
    Judgement,
    RecordedDemonstration,
    Steady,
    judge_goal,
    read_flight,
)
from stereoservo_sim.demonstration.runner import Demonstration
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import SimulatedCell

MAX_ERROR_PX = 0.3
MAX_ERROR_MM = 0.5
MAX_STEADY_PX = 1.0
"""Error limit for 99 % of the time while a part moves steadily; a busy computer may delay the arm briefly."""
MAX_MET_PX = 0.5
"""Error limit of a part that was met while it moved, after it has stopped: the cell's tolerance."""
MAX_MET_MM = 2.0
"""The same in space; depth is measured ten times less accurately than the other directions."""


def summary(demonstration: Demonstration, seconds: float) -> dict[str, Any]:
    """Evaluate, write ``report.html`` and ``overview.png``; returns what ``demo --json`` prints.

    ``seconds``: duration of the demonstration. Raises RecordingError; LookupError if a goal was never executed.
    """
    flight = read_flight(demonstration.recording)
    truth = demonstration.truth
    goals = [
        judge_goal(
            goal.name, goal.law, demonstration.outcomes[goal.name], flight, demonstration.truth_t,
            demonstration.truth_q, truth, demonstration.belt,
        )
        for goal in demonstration.goals
    ]  # fmt: skip
    verdicts = sorted({e.name for e in flight.events if e.kind == "health" and e.name != "ok"})
    report = demonstration.out / "report.html"
    write_pages(report, demonstration, flight, goals)
    write_overview(demonstration.out / "overview.png", goals, truth, demonstration.cell.servo.tolerance_px)
    model = demonstration.calibrated.model
    return {
        "converged": not (found := [*problems(model, goals), *false_verdicts(verdicts)]),
        "problems": found,
        "goals": [_row(goal) for goal in goals],
        "verdicts": verdicts,
        "calibration": _calibration(model, demonstration.calibrated.seconds),
        "loop": _loop(demonstration),
        "replay": {
            "identical": flight.result.identical,
            "steps": flight.result.steps,
            "gaps": flight.result.gaps,
            "max_relative_error": flight.result.max_relative_error,
        },
        "report": str(report),
        "recording": str(demonstration.recording),
        "model": str(demonstration.out / "model.json"),
        "seed": demonstration.seed,
        "lockstep": demonstration.lockstep,
        "seconds": seconds,
    }


def problems(model: CellModel, goals: Sequence[Judgement]) -> list[str]:
    """Reasons why a demonstration has not converged: the residual's chi-square at 99.9 %, goals, errors."""
    found = []
    statistics = model.statistics
    if statistics is None or not statistics.chi2_ok:
        values = (
            ""
            if statistics is None
            else f" (chi-square {statistics.chi2:.0f}, {statistics.degrees_of_freedom} expected)"
        )
        found.append(f"the calibration's residual is not what the measurement noise explains{values}")
    for goal in goals:
        if goal.outcome != "reached":
            found.append(f"goal {goal.name}: {goal.outcome}")
        most_px, most_mm = (MAX_ERROR_PX, MAX_ERROR_MM) if goal.steady is None else (MAX_MET_PX, MAX_MET_MM)
        if goal.final_error_px > most_px:
            found.append(f"goal {goal.name}: {goal.final_error_px:.3f} px off, {most_px} px allowed")
        if goal.final_error_mm > most_mm:
            found.append(f"goal {goal.name}: {goal.final_error_mm:.3f} mm off, {most_mm} mm allowed")
        if goal.steady is not None:
            found.extend(f"goal {goal.name}: {what}" for what in _unsteady(goal.steady))
    return found


def _unsteady(steady: Steady) -> list[str]:
    if not np.isfinite(steady.met_s):
        return ["the part was not met while the belt carried it"]
    if steady.p99_px > MAX_STEADY_PX:
        return [f"up to {steady.p99_px:.2f} px off while the part moved, {MAX_STEADY_PX} px allowed"]
    return []


def false_verdicts(verdicts: Sequence[str]) -> list[str]:
    """Faults reported by the model monitor; a simulated arm has none, so each is a problem."""
    return [f"the watch over the model named {verdict!r}, and nothing had changed" for verdict in verdicts]


def _row(goal: Judgement) -> dict[str, Any]:
    plain = ("name", "law", "outcome", "final_error_px", "final_error_mm", "max_line_deviation_mm", "rotation_deg",
             "distance_mm", "steps", "seconds")  # fmt: skip
    steady = None if goal.steady is None else {k: v if np.isfinite(v) else None for k, v in asdict(goal.steady).items()}
    return {**{name: getattr(goal, name) for name in plain}, **({} if steady is None else {"steady": steady})}


def _calibration(model: CellModel, seconds: float) -> dict[str, Any]:
    statistics = model.statistics
    if statistics is None:
        raise AssertionError("a fitted model has statistics")
    return {
        "rms_px": statistics.rms_px,
        "joints": len(model.joint_names),
        "images": statistics.images,
        "seconds": seconds,
        "chi2": statistics.chi2,
        "degrees_of_freedom": statistics.degrees_of_freedom,
        "chi2_ok": statistics.chi2_ok,
        "measurements": statistics.measurements,
        "parameters": statistics.parameters,
        "outliers": statistics.outliers,
        "per_joint_px": {joint.name: joint.rms_px for joint in statistics.joints},
        "stratum": model.stratum,
    }


def _loop(demonstration: Demonstration) -> dict[str, Any]:
    if demonstration.loop is None:  # virtual time is never late
        return {
            "rate_hz": demonstration.cell.servo.rate_hz,
            "overruns": 0,
            "lateness_us": {"p50": 0.0, "p99": 0.0, "max": 0.0},
            "virtual": True,
        }
    return {**msgspec.to_builtins(demonstration.loop), "virtual": False}


# -- overview ------------------------------------------------------------------------------------------------
# Overview image of a demonstration: a camera's view at the start, the markers' tracks, the decay of the errors.


def write_overview(path: Path, goals: Sequence[Judgement], cell: SimulatedCell, tolerance_px: float) -> None:
    """Draw the overview as a PNG. Raises OSError."""
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, width_ratios=(1, 1, 1))
    for axis, camera in zip(axes[:2], cell.rig.cameras, strict=True):
        image = Renderer(cell, camera, RenderSettings()).render(cell.base, np.random.default_rng(0))
        axis.imshow(image, cmap="gray", vmin=0, vmax=255)
        for k, goal in enumerate(goals):
            tracks = goal.tracks[camera.name]
            axis.plot(tracks[:, :, 0], tracks[:, :, 1], color=COLOURS[k], linewidth=0.8)
            axis.plot(tracks[-1, :, 0], tracks[-1, :, 1], "x", color=COLOURS[k], markersize=4)
        axis.set(
            title=f"{camera.name} camera",
            xlim=(0, camera.width),
            ylim=(camera.height, 0),
            xticks=[],
            yticks=[],
        )
    for k, goal in enumerate(goals):
        label = f"{goal.name}: {goal.law}, {goal.rotation_deg:.0f}°, {goal.distance_mm:.0f} mm"
        axes[2].semilogy(goal.times_s, goal.error_px, color=COLOURS[k], label=label)
    axes[2].axhline(tolerance_px, color="#666666", linestyle="--", linewidth=1)
    axes[2].set(title="largest pixel error [px]", xlabel="time [s]")
    axes[2].grid(alpha=0.3)
    axes[2].legend(fontsize=8)
    figure.savefig(path, dpi=90)


# -- pages of the report -------------------------------------------------------------------------------------
# Collection of the demonstration report's data from the recording, the model and the evaluation.


def write_pages(
    path: Path, demonstration: Demonstration, flight: RecordedDemonstration, goals: Sequence[Judgement]
) -> None:
    """Write the report. Raises OSError."""
    cell = demonstration.cell
    mode = "lockstep, virtual time" if demonstration.lockstep else "real processes over zenoh"
    facts = {
        "mode": mode,
        "seed": str(demonstration.seed),
        "loop": f"{cell.servo.rate_hz:g} Hz",
        "replay": f"identical: {flight.result.identical} over {flight.result.steps} steps",
    }
    if demonstration.loop is not None:
        lateness = demonstration.loop.lateness_us
        facts["lateness"] = f"p50 {lateness['p50']:.0f} µs, p99 {lateness['p99']:.0f} µs, max {lateness['max']:.0f} µs"
        facts["overruns"] = f"{demonstration.loop.overruns} of {demonstration.loop.cycles} cycles"
    data = ReportData(
        title="stereoservo demonstration",
        joints=demonstration.joint_names,
        calibration=None if flight.trials is None else _calibration_page(demonstration, flight.trials),
        goals=tuple(_goal(goal, cell.servo.gain) for goal in goals),
        tolerance_px=cell.servo.tolerance_px,
        velocity_limits=flight.velocity_max,
        summary="An arm that nobody calibrated learnt itself through two cameras that nobody calibrated, and reached "
        "goals that were only shown to it. Errors are against the simulated truth.",
        facts=facts,
    )
    write_report(data, path)


def _calibration_page(demonstration: Demonstration, trials: TrialData) -> CalibrationPlots:
    model = demonstration.calibrated.model
    statistics = model.statistics
    figures = {}
    if statistics is not None:
        figures = {
            "chi-square": f"{statistics.chi2:.0f} for {statistics.degrees_of_freedom} degrees of freedom "
            f"({'as' if statistics.chi2_ok else 'not as'} the measurement noise explains)",
            "parameters": f"{statistics.parameters} net of gauge, {statistics.measurements} measurements",
            "stratum": model.stratum,
        }
    sizes = np.array([(camera.width, camera.height) for camera in trials.cameras])
    return CalibrationPlots(
        cameras=tuple(camera.name for camera in trials.cameras),
        joints=trials.joint_names,
        sizes=sizes,
        joint=trials.trials,
        pixels=trials.pixels,
        residuals=residuals(model, trials),
        rms_px=statistics.rms_px if statistics is not None else float("nan"),
        images=statistics.images if statistics is not None else trials.images,
        seconds=demonstration.calibrated.seconds,
        sigma_px=float(np.sqrt(np.nanmean(trials.sigmas**2))),
        figures=figures,
    )


def residuals(model: CellModel, trials: TrialData) -> FloatArray:
    """Measured minus predicted raw pixels (c, s, m, 2), NaN for markers that were not seen."""
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
    matrices = np.array([camera.matrix for camera in model.cameras])
    rows = [model.marker_ids.index(marker) for marker in trials.marker_ids]
    predicted = np.array(
        [project_many(matrices, model.marker_points[rows] @ chain.displacement(q).T) for q in trials.positions]
    )
    raw = [
        distort(camera.lens, ideal)
        for camera, ideal in zip(model.cameras, predicted.transpose(1, 0, 2, 3), strict=True)
    ]
    found: FloatArray = trials.pixels - np.array(raw)
    return found


def _goal(goal: Judgement, gain: float) -> GoalPlots:
    return GoalPlots(
        name=goal.name,
        law=goal.law,
        outcome=goal.outcome,
        times_s=goal.times_s,
        error_px=goal.error_px,
        velocities=goal.velocities,
        path_m=goal.path_m,
        line_m=goal.line_m,
        final_error_px=goal.final_error_px,
        final_error_mm=goal.final_error_mm,
        max_line_deviation_mm=goal.max_line_deviation_mm,
        rotation_deg=goal.rotation_deg,
        distance_mm=goal.distance_mm,
        steps=goal.steps,
        seconds=goal.seconds,
        gain=gain,
        tracks=goal.tracks,
    )


# -- layout of the report --------------------------------------------------------------------------------------
# HTML report of a servoing session, from arrays; deterministic.
#
# The images are embedded, so that the file can be mailed as it is.


__all__ = ["CalibrationPlots", "GoalPlots", "ReportData", "render_report", "write_report"]


def write_report(data: ReportData, path: Path) -> Path:
    """Write the report as one HTML file; folders are made. Raises ValueError on shapes that do not fit,
    OSError."""
    text = render_report(data)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def render_report(data: ReportData) -> str:
    """The HTML text. Raises ValueError on shapes that do not fit."""
    check_shapes(data)
    parts = [f"<h1>{html.escape(data.title)}</h1>"]
    if data.summary:
        parts.append(f"<p>{html.escape(data.summary)}</p>")
    if data.goals:
        parts += ["<h2>Goals</h2>", goals_table(data.goals)]
        parts += [
            _picture(draw_errors(data.goals, data.tolerance_px), "Largest pixel error of each goal over time"),
            _picture(
                draw_velocities(data.goals, data.joints, data.velocity_limits),
                "Commanded joint velocities of each goal",
            ),
            _picture(draw_paths(data.goals), "Path of the centre, its straight line, and the distance between them"),
        ]
        if any(goal.tracks for goal in data.goals):
            parts.append(_picture(draw_goal_tracks(data.goals), "Marker tracks in the images, from start to goal"))
    if data.calibration is not None:
        parts += ["<h2>Self-calibration</h2>", calibration_table(data.calibration)]
        parts += [
            _picture(
                draw_calibration_tracks(data.calibration),
                "Markers at all stops of the trial motions, by joint",
            ),
            _picture(draw_residuals(data.calibration), "Residuals of the fit, by moving joint and camera"),
        ]
    if data.facts:
        parts += ["<h2>Session</h2>", _two_columns(data.facts)]
    return _PAGE.format(title=html.escape(data.title), body="\n".join(parts))


def goals_table(goals: Sequence[GoalPlots]) -> str:
    """The goals as an HTML table."""
    head: tuple[str, ...] = (
        "goal",
        "law",
        "outcome",
        "rotation [°]",
        "distance [mm]",
        "final error [px]",
        "final error [mm]",
    )
    head += ("off the line, at most [mm]", "steps", "time [s]")
    rows = [
        (
            goal.name,
            goal.law,
            goal.outcome,
            f"{goal.rotation_deg:.1f}",
            f"{goal.distance_mm:.0f}",
            f"{goal.final_error_px:.3f}",
            f"{goal.final_error_mm:.3f}",
            f"{goal.max_line_deviation_mm:.2f}",
            str(goal.steps),
            f"{goal.seconds:.2f}",
        )
        for goal in goals
    ]
    return _table(head, rows, text_columns=3)


def calibration_table(c: CalibrationPlots) -> str:
    """Residual rms by joint and camera, and the numbers of the fit, as HTML tables."""
    rows = []
    for j, joint in enumerate(c.joints):
        moved = c.residuals[:, c.joint == j]
        rows.append((joint, *(_rms(part) for part in moved), str(int((c.joint == j).sum()))))
    by_joint = _table(("moving joint", *(f"{name}: rms [px]" for name in c.cameras), "stops"), rows, text_columns=1)
    figures = {
        "residual rms": f"{c.rms_px:.4f} px",
        "expected noise": "not stated" if c.sigma_px is None else f"{c.sigma_px:.4f} px",
        "images": str(c.images),
        "time": f"{c.seconds:.1f} s",
        **c.figures,
    }
    return _two_columns(figures) + by_joint


def _picture(figure: Figure, caption: str) -> str:
    text = html.escape(caption)
    data = base64.b64encode(encode_png(figure)).decode("ascii")
    image = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def _rms(values: FloatArray) -> str:
    finite = values[np.isfinite(values)]
    return f"{np.sqrt(np.mean(finite**2)):.4f}" if finite.size else "–"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int) -> str:
    """An HTML table; cells after the first ``text_columns`` are numbers."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{'' if i < text_columns else ' class=n'}>{html.escape(cell)}</{tag}>" for i, cell in enumerate(row)
        )

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<table><thead><tr>{cells('th', head)}</tr></thead><tbody>{body}</tbody></table>"


def _two_columns(figures: Mapping[str, str]) -> str:
    rows = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in figures.items())
    return f"<table><tbody>{rows}</tbody></table>"


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,
initial-scale=1"> <title>{title}</title> <style> body {{ font: 15px/1.5 system-ui, sans-serif; color: #222;
background: #fff; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }} h1 {{ font-size: 1.5rem; }} h2 {{
font-size: 1.15rem; margin-top: 2.2rem; }} table {{ border-collapse: collapse; margin: .8rem 0; font-size:
.85rem; display: block; overflow-x: auto; }} th, td {{ padding: .25rem .8rem; border-bottom: 1px solid #ddd;
text-align: left; vertical-align: top; }} th.n, td.n {{ text-align: right; font-variant-numeric: tabular-nums;
}} thead th {{ border-bottom: 2px solid #888; }} figure {{ margin: 1.2rem 0; }} img {{ max-width: 100%;
height: auto; }} figcaption {{ color: #555; font-size: .85rem; }} </style></head><body> {body} </body></html>
"""


# -- figures -------------------------------------------------------------------------------------------------
# Figures of a session report, by matplotlib without a display.


COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666", "#8b5a2b")
"""One colour per joint, in this order everywhere; distinguishable for colour-blind readers (Okabe and Ito)."""

DPI = 110
LEAST_ERROR_PX = 1e-4
"""Floor of the logarithmic axis: smaller errors appear as zero."""


def draw_calibration_tracks(c: CalibrationPlots) -> Figure:
    """All measured markers in each image, coloured by the joint that moved (thesis, figure 5.14)."""
    figure = _figure(5.2 * len(c.cameras), 4.6)
    axes = np.ravel(figure.subplots(1, len(c.cameras), squeeze=False))
    for axis, name, size, pixels in zip(axes, c.cameras, c.sizes, c.pixels, strict=True):
        for j, joint in enumerate(c.joints):
            at = pixels[c.joint == j]
            axis.plot(at[..., 0], at[..., 1], "-", color=COLOURS[j % len(COLOURS)], linewidth=0.6, alpha=0.6)
            points = at.reshape(-1, 2)
            axis.plot(*points.T, ".", color=COLOURS[j % len(COLOURS)], markersize=3, label=joint)
        rest = pixels[(c.joint < 0) | (c.joint >= len(c.joints))].reshape(-1, 2)
        if np.isfinite(rest).any():
            axis.plot(*rest.T, "+", color="0.4", markersize=4, label="none")
        _image_axis(axis, name, size)
    axes[-1].legend(title="moving joint", fontsize=7, title_fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def draw_residuals(c: CalibrationPlots) -> Figure:
    """Histograms of residual coordinates: a row per joint, a column per camera; with the expected Gaussian."""
    groups = [(j, name) for j, name in enumerate(c.joints) if (c.joint == j).any()]
    figure = _figure(4.2 * len(c.cameras), 0.7 + 1.25 * max(len(groups), 1))
    axes = figure.subplots(max(len(groups), 1), len(c.cameras), squeeze=False, sharex=True)
    finite = np.abs(c.residuals[np.isfinite(c.residuals)])
    reach = 1.1 * max(float(finite.max(initial=0.0)), 4.0 * (c.sigma_px or 0.0), 1e-6)
    edges = np.linspace(-reach, reach, 42)
    for row, (j, joint) in zip(axes, groups, strict=False):
        for axis, name, residuals in zip(row, c.cameras, c.residuals, strict=True):
            values = residuals[c.joint == j]
            values = values[np.isfinite(values)]
            axis.hist(values, bins=edges, color=COLOURS[j % len(COLOURS)], alpha=0.8)
            if c.sigma_px:
                x = np.linspace(-reach, reach, 200)
                bell = np.exp(-0.5 * (x / c.sigma_px) ** 2) / (c.sigma_px * np.sqrt(2 * np.pi))
                axis.plot(x, bell * values.size * (edges[1] - edges[0]), color="black", linewidth=0.8)
            rms = float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
            note = f"{joint}, {name}\nn = {values.size}\nrms {rms:.4f} px"
            axis.text(0.02, 0.93, note, transform=axis.transAxes, fontsize=7, va="top")
            axis.tick_params(labelsize=7)
            _plain(axis)
    for axis in axes[-1]:
        axis.set_xlabel("residual coordinate [px]" + (", line: expected noise" if c.sigma_px else ""), fontsize=8)
    return figure


def draw_errors(goals: Sequence[GoalPlots], tolerance_px: float | None) -> Figure:
    """Error over time on a logarithmic axis, one panel per goal: a straight line is exponential decay."""
    figure = _figure(4.2 * len(goals), 3.0)
    axes = np.ravel(figure.subplots(1, len(goals), squeeze=False, sharey=True))
    for axis, goal in zip(axes, goals, strict=True):
        error = np.maximum(goal.error_px, LEAST_ERROR_PX)
        axis.semilogy(goal.times_s, error, color=COLOURS[0], linewidth=1.2, label="measured")
        known = np.flatnonzero(np.isfinite(error))
        if goal.gain is not None and known.size:
            first = known[0]
            promised = error[first] * np.exp(-goal.gain * (goal.times_s - goal.times_s[first]))
            floor = max(float(np.nanmin(error)) / 2, LEAST_ERROR_PX)
            axis.semilogy(
                goal.times_s,
                np.maximum(promised, floor),
                ":",
                color="0.4",
                linewidth=1,
                label=f"exp(−{goal.gain:g} t)",
            )
        if tolerance_px is not None:
            axis.axhline(tolerance_px, color=COLOURS[1], linewidth=0.9, linestyle="--", label="tolerance")
        axis.set_title(f"{goal.name} · {goal.law}", fontsize=9)
        axis.set_xlabel("time [s]", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(which="both", alpha=0.2)
        _plain(axis)
    axes[0].set_ylabel("largest pixel error [px]", fontsize=8)
    max(axes, key=lambda axis: len(axis.lines)).legend(fontsize=7)
    return figure


def draw_velocities(goals: Sequence[GoalPlots], joints: Sequence[str], limits: FloatArray | None) -> Figure:
    """Joint velocities over time, one panel per goal; limits dashed if all joints share one."""
    figure = _figure(4.2 * len(goals), 3.0)
    axes = np.ravel(figure.subplots(1, len(goals), squeeze=False, sharey=True))
    shared = limits is not None and len(limits) > 0 and bool(np.allclose(limits, limits[0]))
    for axis, goal in zip(axes, goals, strict=True):
        for j, joint in enumerate(joints):
            axis.plot(
                goal.times_s,
                goal.velocities[:, j],
                color=COLOURS[j % len(COLOURS)],
                linewidth=1.0,
                label=joint,
            )
        if shared and limits is not None:
            largest = np.abs(goal.velocities).max(initial=0.0)
            if largest > 0.3 * limits[0]:  # otherwise the limit would flatten the curves
                for bound in (-limits[0], limits[0]):
                    axis.axhline(bound, color="0.4", linewidth=0.8, linestyle="--")
        axis.set_title(f"{goal.name} · {goal.law}", fontsize=9)
        axis.set_xlabel("time [s]", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.2)
        _plain(axis)
    axes[0].set_ylabel("joint velocity [rad/s or m/s]", fontsize=8)
    axes[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def draw_paths(goals: Sequence[GoalPlots]) -> Figure:
    """Path of the centre: one row per goal; two projections with the straight line, and the distance from it."""
    figure = _figure(11.0, 2.9 * len(goals))
    rows = figure.subplots(len(goals), 3, squeeze=False)
    for row, goal in zip(rows, goals, strict=True):
        for axis, (a, b), names in zip(row[:2], ((0, 1), (0, 2)), ("xy", "xz"), strict=True):
            axis.plot(*goal.line_m[:, (a, b)].T, "--", color="0.4", linewidth=1.0, label="straight line")
            axis.plot(*goal.path_m[:, (a, b)].T, color=COLOURS[0], linewidth=1.4, label="path of the centre")
            axis.plot(*goal.line_m[1, [a, b]], "o", color=COLOURS[1], markersize=5, label="goal")
            axis.set_aspect("equal", adjustable="datalim")
            axis.set_xlabel(f"{names[0]} [m]", fontsize=8)
            axis.set_ylabel(f"{names[1]} [m]", fontsize=8)
        along, across = _along_and_across(goal.path_m, goal.line_m)
        row[2].plot(1e3 * along, 1e3 * across, color=COLOURS[0], linewidth=1.2)
        row[2].set_xlabel("way along the line [mm]", fontsize=8)
        row[2].set_ylabel("distance from it [mm]", fontsize=8)
        row[2].set_ylim(bottom=0)
        row[0].set_title(f"{goal.name} · {goal.law}", fontsize=9)
        for axis in row:
            axis.tick_params(labelsize=7)
            axis.grid(alpha=0.2)
            _plain(axis)
    rows[0, 0].legend(fontsize=7)
    return figure


def draw_goal_tracks(goals: Sequence[GoalPlots]) -> Figure:
    """Marker tracks of each goal in each image: a dot at the start of a track, a cross at its end."""
    names = list(dict.fromkeys(name for goal in goals for name in goal.tracks))
    figure = _figure(4.4 * len(names), 3.5 * len(goals))
    rows = figure.subplots(len(goals), len(names), squeeze=False)
    for row, goal in zip(rows, goals, strict=True):
        for axis, name in zip(row, names, strict=True):
            track = goal.tracks.get(name, np.zeros((0, 0, 2)))
            for m in range(track.shape[1]):
                seen = track[:, m][np.isfinite(track[:, m]).all(axis=1)]
                if not len(seen):
                    continue
                colour = COLOURS[m % len(COLOURS)]
                axis.plot(*track[:, m].T, color=colour, linewidth=1.0)
                axis.plot(*seen[0], "o", color=colour, markersize=3)
                axis.plot(*seen[-1], "x", color=colour, markersize=6)
            axis.set_title(f"{goal.name} · {name}", fontsize=9)
            axis.set_aspect("equal", adjustable="datalim")
            axis.invert_yaxis()
            axis.set_xlabel("u [px]", fontsize=8)
            axis.set_ylabel("v [px]", fontsize=8)
            axis.tick_params(labelsize=7)
            _plain(axis)
    return figure


def encode_png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _plain(axis: Any) -> None:
    axis.spines[["top", "right"]].set_visible(False)


def _image_axis(axis: Any, name: str, size: IntArray) -> None:
    width, height = (int(v) for v in size)
    axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axis.set_title(name, fontsize=9)
    axis.set_xlabel("u [px]", fontsize=8)
    axis.set_ylabel("v [px]", fontsize=8)
    axis.tick_params(labelsize=7)


def _along_and_across(path: FloatArray, line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance along the line and from it, (p,) each [m]; along is 0 for a line of no length."""
    direction = line[1] - line[0]
    length = float(np.linalg.norm(direction))
    offset = path - line[0]
    along = offset @ direction / length if length > 0 else np.zeros(len(path))
    across = offset - np.outer(along, direction / length if length > 0 else direction)
    return along, np.asarray(np.linalg.norm(across, axis=1))


# -- data ----------------------------------------------------------------------------------------------------
# Data of a session report as plain arrays, with a check of their shapes.


@dataclass(frozen=True)
class CalibrationPlots:
    """Data of a self-calibration. Missing pixels and residuals are NaN.

    ``pixels`` and ``residuals`` (cameras, stops, markers, 2) [px]; ``joint`` (stops,) is the index of the
    joint that moved, -1 for a stop that belongs to none; ``sizes`` (cameras, 2) image width and height [px].
    ``sigma_px``: expected noise [px] per coordinate, to which residuals are compared, or None. ``figures``: further
    lines of the table, name to value.
    """

    cameras: tuple[str, ...]
    joints: tuple[str, ...]
    sizes: IntArray
    joint: IntArray
    pixels: FloatArray
    residuals: FloatArray
    rms_px: float
    images: int
    seconds: float
    sigma_px: float | None = None
    figures: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class GoalPlots:
    """Data of one goal. ``times_s`` (t,), ``error_px`` (t,) NaN if unknown, ``velocities`` (t, joints) [rad/s or
    m/s].

    ``path_m`` (p, 3) of the centre and ``line_m`` (2, 3), start and end of its straight line [m]. ``gain``
    [1/s] draws the exponential decay expected of the law. ``tracks`` maps a camera's name to pixels (t', markers,
    2) [px].
    """

    name: str
    law: str
    outcome: str
    times_s: FloatArray
    error_px: FloatArray
    velocities: FloatArray
    path_m: FloatArray
    line_m: FloatArray
    final_error_px: float
    final_error_mm: float
    max_line_deviation_mm: float
    rotation_deg: float
    distance_mm: float
    steps: int
    seconds: float
    gain: float | None = None
    tracks: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class ReportData:
    """All data of one report. ``facts``: lines of the last table (seed, loop, versions), name to value.

    ``velocity_limits`` (joints,) [rad/s or m/s] or None; ``tolerance_px``: error at which a goal counts as reached.
    """

    title: str
    joints: tuple[str, ...]
    calibration: CalibrationPlots | None
    goals: tuple[GoalPlots, ...]
    tolerance_px: float | None = None
    velocity_limits: FloatArray | None = None
    summary: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)


def check_shapes(data: ReportData) -> None:
    """Raise ValueError that names the array whose shape does not fit the others."""
    n = len(data.joints)
    if data.velocity_limits is not None:
        _expect("velocity_limits", data.velocity_limits, (n,))
    for goal in data.goals:
        t = len(goal.times_s)
        _expect(f"error_px of goal {goal.name!r}", goal.error_px, (t,))
        _expect(f"velocities of goal {goal.name!r}", goal.velocities, (t, n))
        _expect(f"path_m of goal {goal.name!r}", goal.path_m, (len(goal.path_m), 3))
        _expect(f"line_m of goal {goal.name!r}", goal.line_m, (2, 3))
    c = data.calibration
    if c is not None:
        cameras, stops = len(c.cameras), len(c.joint)
        markers = c.pixels.shape[2] if c.pixels.ndim == 4 else -1
        _expect("sizes of the calibration", c.sizes, (cameras, 2))
        _expect("pixels of the calibration", c.pixels, (cameras, stops, markers, 2))
        _expect("residuals of the calibration", c.residuals, (cameras, stops, markers, 2))


def _expect(what: str, array: FloatArray | IntArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}; {shape} is needed")
