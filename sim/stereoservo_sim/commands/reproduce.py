"""``stereoservo reproduce EXPERIMENT``: runs an experiment and prints its figures beside the published ones."""

from __future__ import annotations

import inspect
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from stereoservo_sim.experiments.catalogue import EXPERIMENTS, find_experiment
from stereoservo_sim.experiments.experiment import ExperimentError, Option, show_comparisons, tally_text
from stereoservo_sim.progress import progress_bar

ALL = "all"
COMMON = {
    "seed": (0, Annotated[int, typer.Option(min=0, help="Seed of everything random.")]),
    "plot": (None, Annotated[Path | None, typer.Option(help="Write pictures into this folder.")]),
    "html": (
        None,
        Annotated[Path | None, typer.Option(help="all: write one page with every table and figure.")],
    ),
    "learn": (
        False,
        Annotated[bool, typer.Option("--learn", help="Learn again what is kept of earlier runs; docs/simulation.md.")],
    ),
    "as_json": (False, Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]),
}
"""Options that every experiment takes: default and type."""


def reproduce(
    experiment: str, seed: int, plot: Path | None, html: Path | None, learn: bool, as_json: bool, **given: Any
) -> None:
    """Run an experiment again and print our figures beside those to compare with."""
    # Before numpy is loaded: threads of OpenBLAS only wait for each other on such small matrices.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from stereoservo_sim.kept_models import relearning

    with relearning(learn):
        _reproduce(experiment, seed, plot, html, as_json, given)


def _reproduce(
    experiment: str, seed: int, plot: Path | None, html: Path | None, as_json: bool, given: dict[str, Any]
) -> None:
    try:
        if experiment == ALL:
            _all(seed, plot, html, as_json, given)
            return
        if html is not None:
            raise ExperimentError("option", f"--html writes the page of `reproduce {ALL}`; {experiment}: --plot DIR")
        chosen = find_experiment(experiment)
        if plot is not None:
            _make_folder(plot)
        with progress_bar() as progress:
            result = chosen.run(seed, given, progress)
        answer = chosen.report(result)
        if plot is not None:
            answer["plots"] = [str(path) for path in chosen.draw(result, plot)]
    except (ExperimentError, OSError) as error:
        _fail(error, as_json)
    compared = chosen.compare(answer)
    if as_json:
        if compared:
            answer["compared"] = [row._asdict() for row in compared]
        print(json.dumps(answer, allow_nan=False))
        return
    console = Console(markup=False)
    chosen.show(answer, console)
    if compared:
        show_comparisons(compared, console)


def _all(seed: int, plot: Path | None, html: Path | None, as_json: bool, given: dict[str, Any]) -> None:
    """Run every experiment of the thesis; print the rows of each when complete. Raises ExperimentError, OSError."""
    from stereoservo_sim.experiments.thesis_page import Reproduction, answer_of_all, page, reproduce_all

    if plot is not None:
        raise ExperimentError("option", f"`reproduce {ALL}` takes --html FILE, which holds the figures, not --plot")
    seeds = given.pop("seeds", None)
    if asked := [name for name, value in given.items() if value is not None]:
        raise ExperimentError("option", f"{ALL} does not take --{asked[0].replace('_', '-')}")
    if html is not None:
        _make_folder(html.parent)
        with html.open("a"):  # an unwritable file is reported before a run of minutes
            pass
    console = Console(markup=False)

    def done(one: Reproduction) -> None:
        if not as_json:
            console.print(f"{one.experiment.name}: {one.experiment.summary}")
            show_comparisons(one.compared, console)

    with progress_bar() as progress:
        found = reproduce_all(seed, seeds, progress, done)
    if html is not None:
        html.write_text(page(found, seed), encoding="utf-8")
    answer = answer_of_all(found, seed)
    if as_json:
        print(json.dumps(answer | ({} if html is None else {"html": str(html)}), allow_nan=False))
        return
    console.print(f"all: {tally_text(answer['verdicts'])}")
    if html is not None:
        console.print(f"wrote {html}")


def _signature() -> inspect.Signature:
    """The command's options: the common ones, and those declared by experiments."""
    takers: dict[str, list[str]] = {}
    options: dict[str, Option] = {}
    for declared in EXPERIMENTS.values():
        for option in declared.options:
            options.setdefault(option.name, option)
            takers.setdefault(option.name, []).append(declared.name)
    which = typer.Argument(
        help=f"{ALL} (every table and figure of the thesis), or one: " + ", ".join(EXPERIMENTS) + "."
    )
    parameters = [_parameter("experiment", Annotated[str, which], inspect.Parameter.empty)]
    for name, option in options.items():
        owner = takers[name][0] if len(takers[name]) == 1 else "Simulated experiments"
        told = typer.Option(option.flag, min=option.least, help=f"{owner}: {option.help}.")
        parameters.append(_parameter(name, Annotated[option.kind | None, told], None))
    parameters += [_parameter(name, kind, default) for name, (default, kind) in COMMON.items()]
    return inspect.Signature(parameters, return_annotation=None)


def _parameter(name: str, kind: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=kind, default=default)


reproduce.__signature__ = _signature()  # type: ignore[attr-defined]
reproduce.__annotations__ = {
    name: parameter.annotation for name, parameter in inspect.signature(reproduce).parameters.items()
}


def _make_folder(plot: Path) -> None:
    """Make the folder before the experiment, which may take minutes. Raises ExperimentError."""
    try:
        plot.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExperimentError(
            "option", f"--plot {str(plot)!r}: {error.strerror}; a folder, new or old, is needed"
        ) from error


def _fail(error: ExperimentError | OSError, as_json: bool) -> None:
    """Print the error on stderr, and with ``--json`` on stdout; exit with code 1."""
    print(f"error: {error}", file=sys.stderr)
    if as_json:
        code, data = (error.code, error.data) if isinstance(error, ExperimentError) else ("file", {})
        print(json.dumps({"error": {"code": code, "message": str(error), **data}}))
    raise typer.Exit(1)
