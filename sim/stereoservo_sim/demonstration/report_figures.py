"""Figures of a session report, by matplotlib without a display."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.demonstration.report_data import CalibrationPlots, GoalPlots

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666", "#8b5a2b")
"""One a joint, in this order everywhere; distinguishable for colour-blind readers, too (Okabe and Ito)."""

DPI = 110
LEAST_ERROR_PX = 1e-4
"""Floor of the logarithmic axis: below it an error is zero to the eye."""


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
    axes[-1].legend(
        title="moving joint", fontsize=7, title_fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5)
    )
    return figure


def draw_residuals(c: CalibrationPlots) -> Figure:
    """Histograms of residual coordinates: a row a joint, a column a camera; the expected Gaussian over
    them."""
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
        axis.set_xlabel(
            "residual coordinate [px]" + (", line: expected noise" if c.sigma_px else ""), fontsize=8
        )
    return figure


def draw_errors(goals: Sequence[GoalPlots], tolerance_px: float | None) -> Figure:
    """Error over time on a logarithmic axis, one panel a goal: a straight line is exponential decay."""
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
    """Joint velocities over time, one panel a goal; limits dashed where all joints share one."""
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
            if largest > 0.3 * limits[0]:  # else the limit would flatten the curves
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
    """Path of the centre: one row a goal; two projections with the straight line, and the distance from
    it."""
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
    """Marker tracks of each goal in each image: a dot where a track begins, a cross where it ends."""
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
