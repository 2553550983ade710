"""``stereoservo reproduce EXPERIMENT``: an experiment run again, with the value to compare with beside
ours."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from stereoservo_sim.commands.progress import ProgressCall, progress_bar
from stereoservo_sim.experiments.errors import ExperimentError

LISTED, WIDEST = 200, 400
"""Rows of a table that a person still reads; its characters across at most."""


@dataclass(frozen=True)
class Options:
    """Options of the command line; an experiment takes those that its ``takes`` lists, the others must be
    unset."""

    seed: int
    plot: Path | None
    data: Path | None
    hand_tag: int | None
    table_tags: str | None
    seeds: int | None = None


@dataclass(frozen=True)
class Experiment:
    """``run`` gives the JSON object; ``show`` prints it for people."""

    summary: str
    takes: frozenset[str]
    run: Callable[[Options, ProgressCall], dict[str, Any]]
    show: Callable[[dict[str, Any], Console], None]


def run_real_franka_command(options: Options, progress: ProgressCall) -> dict[str, Any]:
    """The real-arm experiment from its options. Raises ExperimentError."""
    # Before numpy is loaded: threads of OpenBLAS only wait for each other on such small matrices.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from stereoservo_sim.experiments.real_franka import TABLE_TAGS, run_real_franka
    from stereoservo_sim.experiments.real_franka_report import draw, report

    if options.data is None:
        raise ExperimentError("option", "real-franka needs --data DIR, a folder with ee_poses.csv and images")
    table = TABLE_TAGS if options.table_tags is None else _tag_list(options.table_tags)
    hand_tag = 9 if options.hand_tag is None else options.hand_tag
    result = run_real_franka(
        options.data, hand_tag=hand_tag, table_tags=table, seed=options.seed, progress=progress
    )
    answer = report(result)
    if options.plot is not None:
        answer["plots"] = [str(path) for path in draw(result, options.plot)]
    return answer


def show_real_franka(answer: dict[str, Any], console: Console) -> None:
    """Tables of the held-out errors and of the figures beside the reference."""
    reference = answer["reference"]
    table = Table(title="real-franka: held-out poses predicted from the arm's poses", title_justify="left")
    for column in ("", "ours", "reference"):
        table.add_column(column, justify="left" if not column else "right")
    table.add_row("median [px]", f"{answer['median_px']:.3f}", f"{reference['median_px']}")
    table.add_row("rms [px]", f"{answer['rms_px']:.3f}", f"{reference['rms_px']}")
    sides = ", ".join(f"{side:.2f}" for side in answer["tag_sides_mm"])
    table.add_row("tag sides [mm]", sides, "–".join(f"{side:.2f}" for side in reference["tag_sides_mm"]))
    flat = answer["table_flatness_mm"]
    table.add_row(
        "table flatness [mm]",
        answer["table_flatness_reason"] if flat is None else f"{flat:.3f}",
        f"{reference['table_flatness_mm']}",
    )
    console.print(table)
    variants = Table(title="variants", title_justify="left")
    for column in ("", "median [px]", "rms [px]", "largest [px]"):
        variants.add_column(column, justify="left" if not column else "right")
    for name, figures in answer["variants"].items():
        variants.add_row(name, *(f"{figures[key]:.3f}" for key in ("median_px", "rms_px", "max_px")))
    console.print(variants)
    images = answer["images"]
    console.print(f"{images['with_hand_tag']} of {images['read']} images show tag {answer['hand_tag']}")
    if answer["not_predicted"]:
        console.print(
            f"{answer['not_predicted']} corners not predicted: too few views of that camera are left"
        )
    for path in answer.get("plots", []):
        console.print(f"wrote {path}")


def show_robot_tables(answer: dict[str, Any], console: Console) -> None:
    """Tables 5.1 to 5.4."""
    from stereoservo_sim.experiments.robot_report import show_robot

    show_robot(answer, console)


def show_rows(answer: dict[str, Any], console: Console) -> None:
    """The rows as a table, a spread as its median and the 16th to 84th percentile; then the thesis's values.

    ``title`` says what else the rows are. More than ``LISTED`` rows are left to ``--json`` where a summary stands
    beside the thesis.
    """
    rows = answer["rows"]
    title = answer.get("title") or f"{answer['experiment']}: {answer['seeds']} seeds; medians (16 % to 84 %)"
    if len(rows) > LISTED and answer.get("beside_thesis"):
        console.print(f"{title}; all {len(rows)} rows: --json, curves: --plot DIR")
    else:
        names = list(rows[0])
        table = Table(title=title, title_justify="left")
        for name in names:
            table.add_column(
                name, justify="left" if isinstance(rows[0][name], str) else "right", no_wrap=True
            )
        for row in rows:
            table.add_row(*(_cell(row[name]) for name in names))
        # A figure cut off says nothing: a narrow terminal wraps the lines instead.
        wide = console.options.update(width=WIDEST)
        needed = Measurement.get(console, wide, table).maximum
        Console(file=console.file, width=max(console.width, needed), markup=False).print(table)
    for item in answer.get("beside_thesis", []):
        console.print(
            "beside the thesis: " + ", ".join(f"{key} {_cell(value)}" for key, value in item.items())
        )
    console.print(f"thesis: {json.dumps(answer['thesis'])}")
    for assumption in answer.get("assumptions", []):
        console.print(f"assumed: {assumption}")
    for path in answer.get("plots", []):
        console.print(f"wrote {path}")


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
        table = Table(
            title=f"{noise} tracks, {answer['seeds']} seeds: medians [px] (thesis)", title_justify="left"
        )
        table.add_column("")
        for row in rows:
            table.add_column(row["condition"], justify="right")
        for key, name in measures.items():
            table.add_row(
                name, *(_beside(row[key], answer["thesis"][row["condition"]].get(key)) for row in rows)
            )
        console.print(table)
    for assumption in answer["assumptions"]:
        console.print(f"assumed: {assumption}")
    for path in answer.get("plots", []):
        console.print(f"wrote {path}")


def _beside(ours: dict[str, Any], thesis: float | None) -> str:
    median = "-" if ours["median"] is None else f"{ours['median']:.3f}"
    return median if thesis is None else f"{median} ({thesis:.3g})"


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return (
            "-"
            if value["median"] is None
            else f"{value['median']:.4g} ({value['p16']:.4g} to {value['p84']:.4g})"
        )
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return " to ".join(_cell(item) for item in value)
    return "-" if value is None else str(value)


def show_random_rigs(answer: dict[str, Any], console: Console) -> None:
    """The rate with its interval, rows, and what did not succeed."""
    show_rows(answer, console)
    low, high = answer["wilson_95"]
    console.print(
        f"{answer['success']} of {answer['seeds']} succeeded ({answer['success_rate']:.2%}; Wilson 95 %: {low:.2%} to "
        f"{high:.2%}; promised {answer['promised']:.1%}), {answer['failure']} refused, {answer['wrong']} wrong"
    )
    for case in answer["not_successes"]:
        console.print(f"case {case['seed']}: {case['outcome']} {case['code']} {case['message']}")


def simulated(
    name: str,
    summary: str,
    seeds: int | None,
    show: Callable[[dict[str, Any], Console], None] | None = None,
    module: str = "",
) -> Experiment:
    """An experiment in simulation: ``run_NAME`` and ``draw_NAME`` of ``module``, by default of its own name.

    Imported when it runs. ``seeds``: how many repetitions unless told, None where it has none.
    """

    def run(options: Options, progress: ProgressCall) -> dict[str, Any]:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        found = import_module(f"stereoservo_sim.experiments.{module or name}")
        repetitions = {} if seeds is None else {"seeds": options.seeds or seeds}
        answer: dict[str, Any] = getattr(found, f"run_{name}")(
            **repetitions, seed=options.seed, progress=progress
        )
        if options.plot is not None:
            answer["plots"] = [str(path) for path in getattr(found, f"draw_{name}")(answer, options.plot)]
        return answer

    takes = frozenset() if seeds is None else frozenset({"seeds"})
    return Experiment(summary, takes, run, show or show_rows)


def run_laws_command(options: Options, progress: ProgressCall) -> dict[str, Any]:
    """``laws`` from its options."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from stereoservo_sim.experiments.laws_compared import compare_laws, laws_report
    from stereoservo_sim.experiments.laws_figures import draw_laws

    comparison = compare_laws(options.seed, progress)
    answer = laws_report(comparison)
    if options.plot is not None:
        answer["plots"] = [str(path) for path in draw_laws(comparison, options.plot)]
    return answer


def show_laws_table(answer: dict[str, Any], console: Console) -> None:
    """A row a task and law."""
    from stereoservo_sim.experiments.laws_compared import show_laws

    show_laws(answer, console)


EXPERIMENTS: dict[str, Experiment] = {
    "real-franka": Experiment(
        "a real arm before uncalibrated cameras: held-out poses predicted from recorded displacements",
        frozenset({"data", "hand_tag", "table_tags"}),
        run_real_franka_command,
        show_real_franka,
    ),
    "gripper": simulated(
        "gripper",
        "fig. 3.5: affine calibration from small translations of a gripper, over noise and number of motions",
        20,
    ),
    "grid": simulated(
        "grid",
        "fig. 3.6: affine calibration before a grid, single motions beside cumulative estimates",
        20,
    ),
    "pan-tilt": simulated(
        "pan_tilt",
        "table 4.1, figs 4.8, 4.9: a pan-tilt head calibrates itself and predicts the image after a motion",
        20,
        show=show_pan_tilt,
    ),
    "homing": simulated(
        "homing",
        "fig. 4.10: a pan-tilt head finds home from one point, its errors beside the Cramer-Rao bound",
        10,
    ),
    "house": simulated(
        "house",
        "fig. 3.7: affine calibration from interest points of an unknown object, judged on the grid",
        50,
    ),
    "robot": simulated(
        "robot",
        "tables 5.1 to 5.4: self-calibration of a 6R arm from a turned plate; images, axes, links, intrinsics",
        30,
        show=show_robot_tables,
        module="robot_report",
    ),
    "random-rigs": simulated(
        "random_rigs",
        "self-calibration from nothing on random rigs, arms, bodies and noise: how often it succeeds",
        12,
        show=show_random_rigs,
    ),
    "inverse-kinematics": simulated(
        "inverse_kinematics",
        "chapter 6: all solutions of every family of arms from operators alone, judged by a metric solver",
        100,
    ),
    "tasks-abc": simulated(
        "tasks_abc",
        "figs 8.6 to 8.12: three alignments by image-based stereo control, projective and coarse calibration",
        12,
    ),
    "benchmark-180": simulated(
        "benchmark_180",
        "figs 8.13 to 8.22: half a turn of a tilted face by the classical and the Cartesian laws",
        None,
    ),
    "projective-vs-euclidean": simulated(
        "projective_vs_euclidean",
        "thesis 9.3: the same tasks with a projective model and with metric ones of growing errors",
        50,
    ),
    "unsynchronised": simulated(
        "unsynchronised",
        "cameras without a trigger beside the same with one: 15 ms skew, 40 ms latency, and a latency told wrongly",
        3,
    ),
    "mobile-cameras": simulated(
        "mobile_cameras",
        "fig. 9.1: four cameras before one tool, two of them carried about: every pair, all, and all on the move",
        3,
    ),
    "laws": Experiment(
        "every law on three demanding tasks, and a sketch of every kind of goal: docs/goals-and-laws.md",
        frozenset(),
        run_laws_command,
        show_laws_table,
    ),
}
"""By the name given on the command line."""


def reproduce(
    experiment: Annotated[str, typer.Argument(help="Which one: " + ", ".join(EXPERIMENTS) + ".")],
    data: Annotated[
        Path | None, typer.Option(help="real-franka: folder with ee_poses.csv and images.")
    ] = None,
    hand_tag: Annotated[
        int | None, typer.Option(help="real-franka: id of the tag on the hand [default: 9].")
    ] = None,
    table_tags: Annotated[
        str | None,
        typer.Option(help="real-franka: ids of tags lying on the table, by commas [default: 0,2,3]."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Simulated experiments: how many repetitions.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Write pictures into this folder.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Run an experiment again and print our figures beside those to compare with."""
    try:
        chosen = _find(experiment)
        options = Options(seed, plot, data, hand_tag, table_tags, seeds)
        for name in ("data", "hand_tag", "table_tags", "seeds"):
            if getattr(options, name) is not None and name not in chosen.takes:
                raise ExperimentError("option", f"{experiment} does not take --{name.replace('_', '-')}")
        if plot is not None:
            _make_folder(plot)
        with progress_bar() as progress:
            answer = chosen.run(options, progress)
    except (ExperimentError, OSError) as error:
        _fail(error, as_json)
    if as_json:
        print(json.dumps(answer, allow_nan=False))
    else:
        chosen.show(answer, Console(markup=False))


def _make_folder(plot: Path) -> None:
    """Before the experiment, not after it: a run may take minutes. Raises ExperimentError."""
    try:
        plot.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExperimentError(
            "option", f"--plot {str(plot)!r}: {error.strerror}; a folder, new or old, is needed"
        ) from error


def _find(name: str) -> Experiment:
    if name not in EXPERIMENTS:
        known = ", ".join(sorted(EXPERIMENTS))
        raise ExperimentError(
            "experiment", f"no experiment {name!r}; known: {known}", known=sorted(EXPERIMENTS)
        )
    return EXPERIMENTS[name]


def _fail(error: ExperimentError | OSError, as_json: bool) -> None:
    """Say what went wrong on stderr, and with ``--json`` on stdout; leave with code 1."""
    print(f"error: {error}", file=sys.stderr)
    if as_json:
        code, data = (error.code, error.data) if isinstance(error, ExperimentError) else ("file", {})
        print(json.dumps({"error": {"code": code, "message": str(error), **data}}))
    raise typer.Exit(1)


def _tag_list(text: str) -> tuple[int, ...]:
    """Tag ids from ``0,2,3``; an empty text is no tag."""
    try:
        return tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise ExperimentError("option", f"--table-tags {text!r}; needed: ids by commas, like 0,2,3") from None
