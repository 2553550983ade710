"""Base class of the experiments: options, run, JSON report, figures, printed table, comparison with the thesis.

An experiment is declared once in :mod:`stereoservo_sim.experiments.catalogue`; what it computes is in the module that
the declaration names, loaded when it runs. With NAME the experiment's name in snake case, that module (or the module of
its figures) holds

- ``run_NAME(*, seed, progress, **options)``: the result,
- ``draw_NAME(result, folder)``: writes the figures, gives their paths,
- ``compare_NAME(answer)``: the thesis's figures beside ours, each with a verdict; left out where it gives none,
- ``show_NAME(answer, console)``: prints the answer for people; left out where :func:`show_rows` serves.

Where the result is not the JSON answer itself, ``reported_by`` of the declaration names the function that makes it.
Every answer has ``experiment``, ``seed``, ``rows`` and, where the thesis gives values, ``thesis``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from stereoservo_sim.experiments.comparison import Comparison, tally
from stereoservo_sim.progress import ProgressCall

LISTED, WIDEST = 200, 400
"""Rows of a table that a person still reads; its characters across at most."""


class ExperimentError(Exception):
    """Invalid, missing or insufficient input of an experiment. The text holds the cause, the value, what would be
    valid.

    Attributes:
        code: short machine-readable cause, e.g. ``"data_missing"``, ``"csv"``, ``"tag_not_seen"``.
        data: the values in the message; plain JSON types.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data


@dataclass(frozen=True)
class Option:
    """A command line option of an experiment.

    ``parse`` gives the argument from the given value and raises ExperimentError; ``argument`` is its name in
    ``run_NAME`` (default: the option's). ``default``: the value where none is given; None: ``run_NAME``'s own.
    ``required``: the error message where it is missing.
    """

    name: str
    kind: type
    help: str
    argument: str = ""
    default: Any = None
    parse: Callable[[Any], Any] = lambda value: value
    required: str = ""
    least: int | None = None

    @property
    def flag(self) -> str:
        """Name on the command line, e.g. ``--hand-tag``."""
        return f"--{self.name.replace('_', '-')}"


def repetitions(default: int) -> Option:
    """``--seeds``: how many repetitions, each with a seed of its own."""
    return Option("seeds", int, "how many repetitions", default=default, least=1)


@dataclass(frozen=True)
class Experiment:
    """An experiment by its ``name`` on the command line. ``module``, ``figures``: below ``experiments``; ``figures`` is
    given where the figures are not drawn in ``module``. ``reported_by``: the function that makes the JSON answer of the
    result; empty where the result is the answer."""

    name: str
    summary: str
    module: str
    options: tuple[Option, ...] = ()
    figures: str = ""
    reported_by: str = ""

    def run(self, seed: int, given: Mapping[str, Any], progress: ProgressCall) -> Any:
        """Run with the options that were ``given`` (None: not given). Raises ExperimentError."""
        taken = {option.name for option in self.options}
        for name, value in given.items():
            if value is not None and name not in taken:
                raise ExperimentError("option", f"{self.name} does not take --{name.replace('_', '-')}")
        arguments = {}
        for option in self.options:
            value = given.get(option.name)
            if value is None and option.required:
                raise ExperimentError("option", f"{self.name} needs {option.required}")
            if value is not None:
                arguments[option.argument or option.name] = option.parse(value)
            elif option.default is not None:
                arguments[option.argument or option.name] = option.default
        return self._function(self._named("run"))(seed=seed, progress=progress, **arguments)

    def report(self, result: Any) -> dict[str, Any]:
        """The answer as a JSON object."""
        answer: dict[str, Any] = self._function(self.reported_by)(result) if self.reported_by else result
        return answer

    def draw(self, result: Any, folder: Path) -> list[Path]:
        """Write the figures into ``folder``; their paths."""
        paths: list[Path] = self._function(self._named("draw"))(result, folder)
        return paths

    def show(self, answer: dict[str, Any], console: Console) -> None:
        """Print the report, then assumptions and written files."""
        (self._optional(self._named("show")) or show_rows)(answer, console)
        for assumption in answer.get("assumptions", []):
            console.print(f"assumed: {assumption}")
        for path in answer.get("plots", []):
            console.print(f"wrote {path}")

    def compare(self, answer: dict[str, Any]) -> list[Comparison]:
        """The thesis's figures beside those of the answer, a verdict each; empty where it has none."""
        compared = self._optional(self._named("compare"))
        found: list[Comparison] = [] if compared is None else compared(answer)
        return found

    def _named(self, what: str) -> str:
        return f"{what}_{self.name.replace('-', '_')}"

    def _optional(self, function: str) -> Callable[..., Any] | None:
        """A function of the experiment's modules, which are imported now; None where none has it."""
        for module in filter(None, (self.module, self.figures)):
            found = getattr(import_module(f"stereoservo_sim.experiments.{module}"), function, None)
            if found is not None:
                return found
        return None

    def _function(self, function: str) -> Callable[..., Any]:
        found = self._optional(function)
        if found is None:
            raise AttributeError(f"experiments.{self.module} has no {function}")
        return found


def show_rows(answer: dict[str, Any], console: Console) -> None:
    """Print the rows as a table, a spread as its median and the 16th to 84th percentile.

    ``title`` describes the rows where they are not medians over seeds. More than ``LISTED`` rows are left to ``--json``
    where a summary stands beside the thesis.
    """
    rows = answer["rows"]
    title = answer.get("title") or f"{answer['experiment']}: {answer['seeds']} seeds; medians (16 % to 84 %)"
    if len(rows) > LISTED and answer.get("beside_thesis"):
        console.print(f"{title}; all {len(rows)} rows: --json, curves: --plot DIR")
    else:
        show_table(rows, title, console)
    if answer.get("rendered"):
        show_table(answer["rendered"], "through rendered pictures", console)
    for item in answer.get("beside_thesis", []):
        console.print("summary: " + ", ".join(f"{key} {cell_text(value)}" for key, value in item.items()))


def show_table(rows: list[dict[str, Any]], title: str, console: Console) -> None:
    """Print rows as a table, a column for each key of the first."""
    names = list(rows[0])
    whole_table(
        console,
        title,
        {name: "left" if isinstance(rows[0][name], str) else "right" for name in names},
        [[cell_text(row[name]) for name in names] for row in rows],
    )


def whole_table(
    console: Console, title: str, columns: Mapping[str, Literal["left", "right"]], rows: list[list[str]]
) -> None:
    """Print a table of which nothing is cut off: on a narrow terminal its lines wrap."""
    table = Table(title=title, title_justify="left")
    for name, justify in columns.items():
        table.add_column(name, justify=justify, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    needed = Measurement.get(console, console.options.update(width=WIDEST), table).maximum
    whole = Console(
        file=console.file, width=max(console.width, needed), markup=False, record=console.record,
        force_terminal=console.is_terminal, no_color=console.no_color,
    )  # fmt: skip
    whole.print(table)


def show_comparisons(compared: list[Comparison], console: Console) -> None:
    """Print the thesis's figures beside ours, and how many rows have each verdict."""
    whole_table(
        console,
        "beside the thesis",
        dict.fromkeys(("thesis", "what", "its value", "ours", "verdict"), "left"),
        [[row.item, row.what, row.thesis, row.ours, row.verdict] for row in compared],
    )
    for row in compared:
        if row.why:
            console.print(f"{row.item}, {row.what}: {row.verdict}: {row.why}")
    counted = ", ".join(f"{count} {verdict}" for verdict, count in tally(compared).items() if count)
    console.print(f"verdicts: {counted}")


def cell_text(value: Any) -> str:
    """A value of a row as text; a spread (median, p16, p84) as ``median (p16 to p84)``."""
    if isinstance(value, dict):
        return (
            "-"
            if value["median"] is None
            else f"{value['median']:.4g} ({value['p16']:.4g} to {value['p84']:.4g})"
        )
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return " to ".join(cell_text(item) for item in value)
    return "-" if value is None else str(value)


def draw_sorted(
    curves: Mapping[str, list[float]], quantity: str, path: Path, limit: float | None = None
) -> list[Path]:
    """Draw what share of the cases has at most so much of a ``quantity``, a curve for each list of values; the path of
    the figure. Raises OSError.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, values in curves.items():
        axes.ecdf(values or [0.0], label=f"{name} ({len(values)})")
    if limit is not None:
        axes.axvline(limit, color="0.5", linestyle="--")
    axes.set_xlabel(quantity)
    axes.set_ylabel("share of the cases")
    axes.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return [path]
