"""Overview image of a demonstration: a camera's view at the start, the markers' tracks, the decay of the errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereoservo_sim.demonstration.judge import Judgement
from stereoservo_sim.demonstration.report_figures import COLOURS
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import SimulatedCell


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
