"""Base of the experiments: their declaration, how they are run, and how answers are shown and compared with the thesis.

An experiment is declared once in :mod:`stereoservo_sim.experiments.catalogue`; its computation is in the module that
the declaration names, loaded when it runs. With NAME the experiment's name in snake case, that module has

- ``run_NAME(*, seed, progress, **options)``: the result, plain JSON types; or an object,
- ``report_NAME(result)``: the JSON answer of such an object,
- ``draw_NAME(result)``: the figures by name, those of matplotlib or PNG files' bytes,
- ``compare_NAME(answer)``: the thesis's figures beside ours, each with a verdict; omitted if the thesis gives none,
- ``notes_NAME(answer)``: lines below the rows, for people; or ``show_NAME(answer, console)`` if `show_rows` is not
  suitable.

Every answer has ``experiment``, ``seed``, ``seeds`` if it takes ``--seeds``, ``rows`` and, if the thesis gives
values, ``thesis``.

A comparison is a value or statement at a place of the thesis (table, figure, section) beside ours, with the criterion
and a verdict of one word. Our error is compared with the thesis's, never with the bound of an error; a bound is
a reason if no estimator can do better. Quantities are compared only if they are the same: an error against the
simulation's truth beside a difference of two measurements is `not_comparable`. Every verdict but ``agrees`` has
a reason; tests find a row whose verdict changes, and its reason is then written.
"""

from __future__ import annotations

import io
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from stereoservo_sim.progress import ProgressCall

Case = TypeVar("Case")
Condition = TypeVar("Condition")
Verdict = Literal["agrees", "better", "worse", "not reproduced", "not comparable", "derived"]
MEANINGS: dict[Verdict, str] = {
    "agrees": "the row's criterion is met",
    "better": "an error of ours at least a fifth smaller than the thesis's",
    "worse": "an error of ours more than a quarter larger than the thesis's, or above a limit that it states",
    "not reproduced": "what the thesis saw is not seen here",
    "not comparable": "the quantity is another one, simulated images beside real ones for instance, or the thesis "
    "prints no value",
    "derived": "the thesis derives it and measures nothing; it is confirmed here",
}
MARGIN = 1.25
"""Largest ratio of errors, to either side, that still agrees."""


class Comparison(NamedTuple):
    """A row: ``item`` of the thesis (table, figure, section), ``what`` is compared, both values as text, the criterion
    of agreement, the verdict and its reason.
    """

    item: str
    what: str
    thesis: str
    ours: str
    criterion: str
    verdict: Verdict
    why: str


COLUMNS = ("thesis", "what", "its value", "ours", "agrees if", "verdict", "why")
"""Titles of a comparison's columns."""


def of_error(item: str, what: str, thesis: float, ours: float, unit: str, why: str) -> Comparison:
    """Comparison of two errors [unit] of the same quantity; ``why``: the reason if they do not agree."""
    verdict: Verdict = "worse" if ours > MARGIN * thesis else "better" if MARGIN * ours < thesis else "agrees"
    values = f"{thesis:.4g} {unit}", f"{ours:.4g} {unit}"
    return Comparison(item, what, *values, "within a quarter", verdict, "" if verdict == "agrees" else why)


def of_limit(
    item: str, what: str, limit: float, ours: float, unit: str, why: str = "", said: str = "below"
) -> Comparison:
    """Comparison of our error [unit] with the limit stated in the thesis; ``why``: the reason if it is exceeded."""
    held, stated = ours <= limit, f"{limit:.4g} {unit}"
    values = f"{said} {stated}".strip(), f"{ours:.4g} {unit}"
    return Comparison(item, what, *values, f"at most {stated}", "agrees" if held else "worse", "" if held else why)


def of_statement(item: str, what: str, thesis: str, ours: str, criterion: str, seen: bool, why: str = "") -> Comparison:
    """Comparison of an observation of the thesis with ``seen`` here; ``why``: the reason if it is not seen."""
    return Comparison(item, what, thesis, ours, criterion, "agrees" if seen else "not reproduced", "" if seen else why)


def not_comparable(item: str, what: str, thesis: str, ours: str, why: str) -> Comparison:
    """Values of two quantities, or ours without one of the thesis; ``why``: how they differ."""
    return Comparison(item, what, thesis, ours, "-", "not comparable", why)


def tally(verdicts: Iterable[Verdict]) -> dict[Verdict, int]:
    """Number of rows with each verdict, in the order of their meanings."""
    counts = Counter(verdicts)
    return {verdict: counts[verdict] for verdict in MEANINGS}


def tally_text(counts: dict[Verdict, int]) -> str:
    """A tally as printed: ``135 rows: 60 agrees, …``."""
    return f"{sum(counts.values())} rows: " + ", ".join(f"{n} {verdict}" for verdict, n in counts.items() if n)


LISTED, WIDEST = 200, 400
"""Largest number of table rows printed for people; largest width in characters."""


class ExperimentError(Exception):
    """Invalid, missing or insufficient input of an experiment. The text states the cause, the value, and what would be
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

    ``parse`` returns the argument from the given value and raises ExperimentError; ``argument`` is its name in
    ``run_NAME`` (default: the option's). ``default``: the value if none is given; None: ``run_NAME``'s own.
    ``required``: the error message if it is missing.
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


@dataclass(frozen=True)
class Experiment:
    """An experiment by its ``name`` on the command line. ``seeds``: default number of repetitions, each with its own
    seed; 0: it takes no ``--seeds``. ``module``: below ``experiments``. ``own``: its options beside these.
    ``timed``: the answer has the CPU time, ``cpu_s``.
    """

    name: str
    seeds: int
    module: str
    summary: str
    own: tuple[Option, ...] = ()
    timed: bool = False

    @property
    def options(self) -> tuple[Option, ...]:
        """All its options."""
        repetitions = Option("seeds", int, "how many repetitions", default=self.seeds, least=1)
        return (repetitions, *self.own) if self.seeds else self.own

    def run(self, seed: int, given: Mapping[str, Any], progress: ProgressCall) -> Any:
        """Run with the ``given`` options (None: not given). Raises ExperimentError."""
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
        started = time.process_time()
        found = self._function("run")(seed=seed, progress=progress, **arguments)
        if not isinstance(found, dict):
            return found
        repeated = {"seeds": arguments["seeds"]} if self.seeds else {}
        timed = {"cpu_s": round(time.process_time() - started, 1)} if self.timed else {}
        return {"experiment": self.name, "seed": seed, **repeated, **found, **timed}

    def report(self, result: Any) -> dict[str, Any]:
        """The answer as a JSON object."""
        answer: dict[str, Any] = self._function("report")(result) if not isinstance(result, dict) else result
        return answer

    def figures(self, result: Any) -> dict[str, bytes]:
        """PNG files by name."""
        return {f"{name}.png": _png(figure) for name, figure in self._function("draw")(result).items()}

    def draw(self, result: Any, folder: Path) -> list[Path]:
        """Write the figures into ``folder``; returns their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = []
        for name, data in self.figures(result).items():
            paths.append(folder / name)
            paths[-1].write_bytes(data)
        return paths

    def show(self, answer: dict[str, Any], console: Console) -> None:
        """Print the report, then assumptions and written files."""
        self._function("show", show_rows)(answer, console)
        for note in self._function("notes", lambda answer: ())(answer):
            console.print(note)
        for assumption in answer.get("assumptions", []):
            console.print(f"assumed: {assumption}")
        for path in answer.get("plots", []):
            console.print(f"wrote {path}")

    def compare(self, answer: dict[str, Any]) -> list[Comparison]:
        """The thesis's figures beside those of the answer, with a verdict each; empty if the thesis has none."""
        found: list[Comparison] = self._function("compare", lambda answer: [])(answer)
        return found

    def _function(self, what: str, otherwise: Callable[..., Any] | None = None) -> Callable[..., Any]:
        """A function of the experiment's module, imported now. Raises AttributeError."""
        name = self.name.replace("-", "_")
        module = import_module(f"stereoservo_sim.experiments.{self.module}")
        found: Callable[..., Any] | None = getattr(module, f"{what}_{name}", otherwise)
        if found is None:
            raise AttributeError(f"{module.__name__} has no {what}_{name}")
        return found


def _png(figure: Any) -> bytes:
    """A figure's file; PNG bytes are returned unchanged."""
    if isinstance(figure, bytes):
        return figure
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return data.getvalue()


def cases(
    judge: Callable[[int], Case], seeds: int, seed: int, progress: ProgressCall, stage: str = "cases"
) -> list[Case]:
    """Results of ``judge`` for seeds ``seed`` to ``seed + seeds - 1``. Raises ValueError for fewer than one."""
    return crossed(lambda _, k: judge(k), (None,), seeds, seed, progress, stage)[0]


def crossed(
    judge: Callable[[Condition, int], Case],
    conditions: Sequence[Condition],
    seeds: int,
    seed: int,
    progress: ProgressCall,
    stage: str = "conditions and seeds",
) -> list[list[Case]]:
    """Results of ``judge`` for each of the ``conditions`` and seeds ``seed`` to ``seed + seeds - 1``: a list per
    condition. Raises ValueError for fewer than one seed.
    """
    if seeds < 1:
        raise ValueError(f"{seeds} cases; at least 1 is needed")
    found: list[list[Case]] = []
    for condition in conditions:
        found.append([])
        for k in range(seeds):
            found[-1].append(judge(condition, seed + k))
            progress(stage, (len(found) - 1) * seeds + k + 1, len(conditions) * seeds)
    return found


def show_rows(answer: dict[str, Any], console: Console) -> None:
    """Print the rows as a table, a spread as its median and the 16th to 84th percentile.

    ``title`` describes the rows if they are not medians over seeds. More than ``LISTED`` rows are left to ``--json``
    if there is a summary beside the thesis.
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
    """Print a table without truncation: on a narrow terminal its lines wrap."""
    table = Table(title=title, title_justify="left")
    for name, justify in columns.items():
        table.add_column(name, justify=justify, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    needed = Measurement.get(console, console.options.update(width=WIDEST), table).maximum
    whole = Console(
        file=console.file,
        width=max(console.width, needed),
        markup=False,
        record=console.record,
        force_terminal=console.is_terminal,
        no_color=console.no_color,
    )
    whole.print(table)


def show_comparisons(compared: list[Comparison], console: Console) -> None:
    """Print the thesis's figures beside ours, and the number of rows with each verdict."""
    whole_table(
        console,
        "beside the thesis",
        dict.fromkeys(COLUMNS[:-1], "left"),
        [list(row[:-1]) for row in compared],
    )
    for row in compared:
        if row.why:
            console.print(f"{row.item}, {row.what}: {row.verdict}: {row.why}")
    console.print(f"verdicts: {tally_text(tally(row.verdict for row in compared))}")


def cell_text(value: Any) -> str:
    """A value of a row as text; a spread (median, p16, p84) as ``median (p16 to p84)``, counts as ``name count``."""
    if isinstance(value, dict) and "median" not in value:
        return ", ".join(f"{name} {cell_text(count)}" for name, count in value.items())
    if isinstance(value, dict):
        if value["median"] is None:
            return "-"
        return f"{value['median']:.4g} ({value['p16']:.4g} to {value['p84']:.4g})"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return " to ".join(cell_text(item) for item in value)
    return "-" if value is None else str(value)
