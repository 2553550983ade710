"""HTML report of a servoing session, from arrays; deterministic.

The pictures are embedded, so that the file can be mailed as it is.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.demonstration.report_data import CalibrationPlots, GoalPlots, ReportData, check_shapes
from stereoservo_sim.demonstration.report_figures import (
    draw_calibration_tracks,
    draw_errors,
    draw_goal_tracks,
    draw_paths,
    draw_residuals,
    draw_velocities,
    encode_png,
)

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
            _picture(
                draw_errors(data.goals, data.tolerance_px), "Largest pixel error of each goal over time"
            ),
            _picture(
                draw_velocities(data.goals, data.joints, data.velocity_limits),
                "Commanded joint velocities of each goal",
            ),
            _picture(
                draw_paths(data.goals), "Path of the centre, its straight line, and the distance between them"
            ),
        ]
        if any(goal.tracks for goal in data.goals):
            parts.append(
                _picture(draw_goal_tracks(data.goals), "Marker tracks in the images, from start to goal")
            )
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
    by_joint = _table(
        ("moving joint", *(f"{name}: rms [px]" for name in c.cameras), "stops"), rows, text_columns=1
    )
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
            f"<{tag}{'' if i < text_columns else ' class=n'}>{html.escape(cell)}</{tag}>"
            for i, cell in enumerate(row)
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
