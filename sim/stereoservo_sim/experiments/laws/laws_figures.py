"""Figures of `laws_compared` and `goal_sketches`, small enough for the repository."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from stereoservo.control.law_registry import LAWS
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.motion_frame import progress
from stereoservo.planning.path_search import SHAPES
from stereoservo_sim.experiments.laws import goal_sketches
from stereoservo_sim.experiments.laws.goal_sketches import Drive
from stereoservo_sim.experiments.laws.laws_compared import ComparedRun, LawComparison
from stereoservo_sim.tasks.calibrations import TaskCalibration, calibrate
from stereoservo_sim.tasks.ground_truth import sight
from stereoservo_sim.tasks.options import DEFAULT_RATE_HZ
from stereoservo_sim.tasks.setting import HEIGHT, WIDTH

DPI = 100
COLOURS_KEPT = 160
COLOURS = {"stereo, current": "#56b4e9", **{name: law.colour for name, law in LAWS.items()}}
ENDINGS = {
    "OUT_OF_VIEW": "leaves the image",
    "BACK_FACE": "shows its back",
    "NOT_CONVERGED": "does not arrive",
}
AROUND_PX = 25.0
"""Drawn around the markers' tracks, so that what leaves the image shows beside its border."""
LONGEST_S, EVERY = 16.0, 5
"""Of the curves over time: their length, and every how many steps a point is drawn."""
TASKS = {
    "large": "132° and 0.32 m", "roll": "half a turn, the face tilted by 60°", "bent": "117° and 0.39 m",
}  # fmt: skip


def draw_laws(comparison: LawComparison, folder: Path) -> list[Path]:
    """Write all figures into ``folder``, which must exist."""
    calibration = calibrate("free", "exact", 0.0, comparison.seed)
    figures = {
        "laws-large": _tracks(comparison, "large"),
        "laws-roll": _tracks(comparison, "roll"),
        "laws-errors": _errors(comparison),
        "bent-way": _bent(comparison),
        "profiles": _profiles(),
        "goal-kinds": _goal_kinds(calibration),
    }
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        _save(figure, path)
        paths.append(path)
    return paths


def _save(figure: Figure, path: Path) -> None:
    """Save with a palette, to keep the repository small."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI)
    Image.open(drawn).convert("RGB").quantize(COLOURS_KEPT).save(path, optimize=True)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _image(axis: Axes, title: str, around: FloatArray | None = None) -> None:
    """An empty left image with its border; cropped to ``around`` (2, 2), least and largest, where that is given."""
    axis.add_patch(Rectangle((0, 0), WIDTH, HEIGHT, facecolor="#f4f4f4", edgecolor="#888888", linewidth=0.8))
    low, high = np.array([(-10.0, -10.0), (WIDTH + 10.0, HEIGHT + 10.0)]) if around is None else around
    axis.set_xlim(low[0], high[0])
    axis.set_ylim(high[1], low[1])
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_frame_on(False)
    axis.set_title(title, fontsize=9)


def _outline(axis: Axes, pixels: FloatArray, colour: str, style: str = "-", width: float = 1.2) -> None:
    """A plate's outline from its markers (4, 2); a dot on the first."""
    closed = np.vstack([pixels, pixels[:1]])
    axis.plot(closed[:, 0], closed[:, 1], style, color=colour, linewidth=width)
    axis.plot(*pixels[0], "o", color=colour, markersize=3)


def _marker_tracks(axis: Axes, pixels: FloatArray, colour: str, style: str = "-") -> None:
    """Draw tracks (k, 4, 2)."""
    for marker in range(pixels.shape[1]):
        axis.plot(pixels[:, marker, 0], pixels[:, marker, 1], style, color=colour, linewidth=0.9)


def _left(run: ComparedRun) -> FloatArray:
    """Left image (k, 4, 2) of a run."""
    return np.array([sight(pose).pixels[0] for pose in run.trace.poses])


def _around(runs: list[ComparedRun]) -> FloatArray:
    """Bounds (2, 2) of the markers' tracks without the most extreme ones."""
    pixels = np.concatenate([_left(run).reshape(-1, 2) for run in runs])
    ends = np.concatenate([sight(pose).pixels[0] for run in runs for pose in (run.task.start, run.task.goal)])
    least = np.minimum(np.percentile(pixels, 0.5, axis=0), ends.min(axis=0))
    largest = np.maximum(np.percentile(pixels, 99.5, axis=0), ends.max(axis=0))
    return np.array([least - AROUND_PX, largest + AROUND_PX])


def _ending(run: ComparedRun) -> str:
    result = run.result
    if result.refused:
        return "refused"
    return "arrives" if result.success else ENDINGS.get(result.reason, result.reason)


def _tracks(comparison: LawComparison, task: str) -> Figure:
    runs = comparison.runs[task]
    around = _around(list(runs.values()))
    figure = _figure(10.0, 5.6)
    axes = figure.subplots(2, 4)
    for axis, (law, run) in zip(axes.flat, runs.items(), strict=False):
        _image(axis, f"{law}: {_ending(run)}", around)
        pixels = _left(run)
        _marker_tracks(axis, pixels, COLOURS[law])
        _outline(axis, sight(run.task.start).pixels[0], "#888888")
        _outline(axis, sight(run.task.goal).pixels[0], "black")
    for axis in axes.flat[len(runs) :]:
        axis.set_axis_off()
        text = (
            f"{TASKS[task]}\n\ngrey field: left image (a part),\nwhite: beside it\n\n"
            "grey outline: start\nblack outline: goal\ndot: marker 0\ncoloured: the markers' ways"
        )
        axis.text(0.02, 0.95, text, fontsize=9, va="top", transform=axis.transAxes)
    return figure


def _off_line_mm(run: ComparedRun) -> FloatArray:
    """Distances (k,) of the plate's centre from the straight line through start and goal."""
    begin, end = run.task.start[:3, 3], run.task.goal[:3, 3]
    offset = run.trace.poses[:, :3, 3] - begin
    length = float(np.linalg.norm(end - begin))
    if length > 0.0:
        along = (end - begin) / length
        offset = offset - (offset @ along)[:, None] * along
    return np.asarray(1e3 * np.linalg.norm(offset, axis=1))


def _left_deg(run: ComparedRun) -> FloatArray:
    """Remaining angle (k,) [°] between the plate and its goal."""
    trace = np.einsum("kij,ij->k", run.trace.poses[:, :3, :3], run.task.goal[:3, :3])
    return np.asarray(np.degrees(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))))


def _errors(comparison: LawComparison) -> Figure:
    figure = _figure(10.0, 5.0)
    axes = figure.subplots(2, 3)
    for row, task in zip(axes, ("large", "roll"), strict=True):
        runs = comparison.runs[task]
        for law, run in runs.items():
            style = {"color": COLOURS[law], "linewidth": 1.1, "label": law}
            poses = run.trace.poses
            drawn = slice(None, round(LONGEST_S * DEFAULT_RATE_HZ), EVERY)
            seconds = np.arange(len(poses))[drawn] / DEFAULT_RATE_HZ
            row[0].semilogy(seconds, np.maximum(_left_deg(run)[drawn], 1e-3), **style)
            row[1].semilogy(seconds, np.maximum(_off_line_mm(run)[drawn], 1e-3), **style)
            row[2].semilogy(seconds, run.trace.errors_px[drawn], **style)
        row[0].set_title(f"{task}: turn still to be made [°]", fontsize=9)
        row[1].set_title("off its straight line [mm]", fontsize=9)
        row[2].set_title("largest error in the images [px]", fontsize=9)
        for axis in row:
            axis.set_xlim(0.0, LONGEST_S)
            axis.set_xlabel("s", fontsize=8)
            axis.tick_params(labelsize=7)
        row[0].set_ylim(3e-2, 3e2)
        row[1].set_ylim(3e-2, 1e3)
        row[2].set_ylim(3e-2, 1e3)
    axes[0, 2].legend(fontsize=7, loc="upper right")
    return figure


def _bent(comparison: LawComparison) -> Figure:
    figure = _figure(11.0, 3.2)
    axes = figure.subplots(1, 3)
    runs = comparison.runs["bent"]
    around = _around([runs["cartesian3"], runs["trajectory"]])
    for axis, law in zip(axes, ("cartesian3", "trajectory"), strict=False):
        run = runs[law]
        kind = "the straight way" if law == "cartesian3" else "the way bent in view"
        _image(axis, f"{kind} ({law}): {_ending(run)}", around)
        _marker_tracks(axis, _left(run), COLOURS[law])
        _outline(axis, sight(run.task.start).pixels[0], "#888888")
        _outline(axis, sight(run.task.goal).pixels[0], "black")
        poses = 1e3 * run.trace.poses[:, :3, 3]
        axes[2].plot(poses[:, 0], poses[:, 2], color=COLOURS[law], linewidth=1.3, label=law)
    axes[2].set_title("the centre from above [mm]", fontsize=9)
    axes[2].set_aspect("equal")
    axes[2].tick_params(labelsize=7)
    axes[2].legend(fontsize=8, loc="lower left", bbox_to_anchor=(1.0, 0.0))
    return figure


def _profiles() -> Figure:
    figure = _figure(10.0, 2.0)
    axes = figure.subplots(1, len(SHAPES), sharey=True)
    shares = np.linspace(0.0, 1.0, 101)
    names = {
        "translation": ("#d55e00", "-"),
        "hinge": ("#0072b2", "--"),
        "turn in the plane": ("#009e73", ":"),
    }
    for axis, (profile, shapes) in zip(axes, SHAPES.items(), strict=True):
        for (name, (colour, style)), shape in zip(names.items(), shapes, strict=True):
            axis.plot(
                shares, [progress(shape, s) for s in shares], style, color=colour, linewidth=2.0, label=name
            )
        axis.set_title(profile, fontsize=9)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("done of each component", fontsize=8)
    axes[0].legend(fontsize=7, loc="upper left")
    return figure


def _goal_kinds(calibration: TaskCalibration) -> Figure:
    figure = _figure(11.0, 5.4)
    axes = figure.subplots(2, 3)
    _features(axes[0, 0], goal_sketches.shown(calibration))
    _points(axes[0, 1], goal_sketches.shown(calibration, "cartesian3"))
    _displacement(axes[0, 2], *goal_sketches.displaced_twice(calibration))
    _taught(axes[1, 0], goal_sketches.carried_over(calibration))
    _incidence(axes[1, 1], goal_sketches.point_on_line(calibration))
    _streamed(axes[1, 2], goal_sketches.streamed(calibration))
    return figure


def _features(axis: Axes, drive: Drive) -> None:
    _image(axis, "features: markers at these pixels")
    pixels = drive.pixels[:, 0]
    _marker_tracks(axis, pixels, COLOURS["stereo"])
    _outline(axis, pixels[0], "#888888")
    _outline(axis, pixels[-1], "black", width=0.6)
    axis.plot(pixels[-1, :, 0], pixels[-1, :, 1], "+", color="black", markersize=9)


def _points(axis: Axes, drive: Drive) -> None:
    """Top view, with the plate as a bar of its first two markers."""
    middles = drive.poses[:, :3, 3]
    axis.plot(1e3 * middles[:, 0], 1e3 * middles[:, 2], color=COLOURS["cartesian3"], linewidth=1.2)
    for k, colour in ((0, "#888888"), (8, "#cccccc"), (20, "#cccccc"), (40, "#cccccc"), (-1, "black")):
        corners = drive.poses[k] @ np.array([(-0.05, 0.05), (0.0, 0.0), (0.0, 0.0), (1.0, 1.0)])
        axis.plot(1e3 * corners[0], 1e3 * corners[2], color=colour, linewidth=2.5)
    axis.set_aspect("equal", adjustable="datalim")
    axis.tick_params(labelsize=7)
    axis.set_title("points: they shall be there in space (from above)", fontsize=9)


def _displacement(axis: Axes, first: Drive, second: Drive) -> None:
    _image(axis, "displacement: from where it is (here twice)")
    for drive, colour in ((first, COLOURS["cartesian3"]), (second, COLOURS["cartesian2"])):
        _marker_tracks(axis, drive.pixels[:, 0], colour)
        _outline(axis, drive.pixels[-1, 0], "black")
    _outline(axis, first.pixels[0, 0], "#888888")


def _taught(axis: Axes, carried: goal_sketches.GoalSketch) -> None:
    _image(axis, "taught, relative to the workpiece")
    for pixels, goal, colour in (
        (carried.workpiece_then[0], carried.taught[0], "#bbbbbb"),
        (carried.workpiece_now[0], carried.set_points[0], "black"),
    ):
        axis.plot(pixels[:, 0], pixels[:, 1], "^", color=colour, markersize=6)
        _outline(axis, goal, colour)
    _marker_tracks(axis, carried.drive.pixels[:, 0], COLOURS["cartesian3"])
    _outline(axis, carried.drive.pixels[0, 0], "#888888")
    axis.text(10, 470, "triangles: workpiece; grey: as taught", fontsize=8)


def _incidence(axis: Axes, on_line: goal_sketches.OnLine) -> None:
    _image(axis, "incidence: marker 0 on the line, the rest free")
    a, b = on_line.line[0]
    axis.axline(a, b, color="#888888", linestyle="--", linewidth=1.0)
    for drive, colour in ((on_line.alone, COLOURS["points"]), (on_line.with_second, COLOURS["cartesian2"])):
        _marker_tracks(axis, drive.pixels[:, 0], colour)
        _outline(axis, drive.pixels[-1, 0], colour)
    _outline(axis, on_line.alone.pixels[0, 0], "#888888")
    axis.plot(on_line.set_points[0, :, 0], on_line.set_points[0, :, 1], "+", color="black", markersize=8)
    axis.text(10, 470, "green: alone; orange: second task, the crosses", fontsize=8)


def _streamed(axis: Axes, streamed: goal_sketches.Streamed) -> None:
    _image(axis, "streamed: the target moves (marker 0)")
    axis.plot(streamed.target[:, 0, 0, 0], streamed.target[:, 0, 0, 1], "--", color="black", linewidth=1.0)
    for drive, colour in ((streamed.fed_forward, COLOURS["stereo"]), (streamed.without, COLOURS["image"])):
        pixels = drive.pixels[:, 0, 0]
        axis.plot(pixels[:, 0], pixels[:, 1], color=colour, linewidth=1.2)
        axis.plot(*pixels[-1], "o", color=colour, markersize=5)
    axis.plot(*streamed.target[-1, 0, 0], "+", color="black", markersize=10)
    axis.text(10, 470, "blue: velocity fed forward; pink: without", fontsize=8)
