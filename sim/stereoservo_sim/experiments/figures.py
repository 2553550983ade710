"""Figures of the experiments: empty figures, axes in their sizes, and drawings used by several of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stereoservo.numerics.arrays import FloatArray

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
Figures = dict[str, Figure]
"""Figures by file name."""


def picture(width: float, height: float, dpi: float = 110.0) -> Figure:
    """An empty figure [inch] that needs no display."""
    return Figure(figsize=(width, height), layout="constrained", dpi=dpi)


def labelled(axis: Axes, title: str, across: str, up: str) -> None:
    """Set title and labels in the experiments' sizes."""
    axis.set_title(title, fontsize=9)
    axis.set_xlabel(across, fontsize=8)
    axis.set_ylabel(up, fontsize=8)
    axis.tick_params(labelsize=7)


def draw_medians(
    axis: Axes, across: list[float], spreads: list[dict[str, float]], style: str, colour: str, label: str
) -> None:
    """Draw medians over ``across``, with a band from the 16th to the 84th percentile."""
    axis.plot(across, [one["median"] for one in spreads], style, color=colour, label=label, markersize=3)
    low, high = ([one[side] for one in spreads] for side in ("p16", "p84"))
    axis.fill_between(across, low, high, color=colour, alpha=0.12)


def draw_images(axis: Axes, pixels: FloatArray, colour: str, label: str) -> None:
    """Draw tracks of markers (k, m, 2) in one image: a line each, a ring where they end."""
    for p in range(pixels.shape[1]):
        axis.plot(*pixels[:, p].T, color=colour, linewidth=0.9, label=label if p == 0 else None)
        axis.plot(*pixels[-1, p], "o", color=colour, markersize=4, fillstyle="none")
    axis.set_aspect("equal")


def sorted_values(curves: Mapping[str, list[float]], quantity: str, limit: float | None = None) -> Figure:
    """Draw the share of cases up to each value of a ``quantity``, a curve for each list of values."""
    figure = picture(6, 4)
    axes = figure.subplots()
    for name, values in curves.items():
        axes.ecdf(values or [0.0], label=f"{name} ({len(values)})")
    if limit is not None:
        axes.axvline(limit, color="0.5", linestyle="--")
    axes.set_xlabel(quantity)
    axes.set_ylabel("share of the cases")
    axes.legend()
    return figure


def drawing_sorted(
    name: str, key: str, quantity: str, limit: float | None = None
) -> Callable[[dict[str, Any]], Figures]:
    """A ``draw_NAME`` of the curves in an answer's ``key``, into the file ``name``."""
    return lambda answer: {name: sorted_values(answer[key], quantity, limit)}


def stacked_bars(rows: Sequence[Mapping[str, Any]], labels: Sequence[str], counts: Sequence[str]) -> Figure:
    """A bar per row, of its stacked ``counts``."""
    figure = picture(8, 1.5 + 0.5 * len(rows))
    axis = figure.subplots()
    left = np.zeros(len(rows))
    for count in counts:
        widths = np.array([row[count] for row in rows], dtype=np.float64)
        axis.barh(labels, widths, left=left, label=count)
        left += widths
    axis.invert_yaxis()
    axis.legend()
    return figure


def by_condition(answer: dict[str, Any], condition: str, measure: str) -> dict[str, list[float]]:
    """A ``measure`` of an answer's ``goals``, by each ``condition`` in its rows."""
    return {
        row[condition]: [goal[measure] for goal in answer["goals"] if goal["condition"] == row[condition]]
        for row in answer["rows"]
    }


def draw_points(axis: Axes, values: Mapping[str, list[float]], title: str, unit: str) -> None:
    """Draw a column of points for each list of values, from 0 up."""
    for k, several in enumerate(values.values()):
        axis.plot(np.full(len(several), k), several, "o", markersize=3, alpha=0.6)
    names = [name.replace(", ", "\n").replace(" + ", "\n").replace(" on the", "\non the") for name in values]
    axis.set_xticks(range(len(names)), names)
    labelled(axis, title, "", unit)
    axis.set_ylim(bottom=0.0)
