"""``reproduce all``: every experiment of the thesis, and one self-contained page with its tables and figures beside
ours.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from stereoservo_sim.experiments.catalogue import CONTENTS, REPRODUCED, find_experiment
from stereoservo_sim.experiments.experiment import COLUMNS, MEANINGS, Comparison, Experiment, Verdict, cell_text, tally
from stereoservo_sim.progress import ProgressCall


class Reproduction(NamedTuple):
    """One experiment that was run: its JSON ``answer``, the rows beside the thesis, its figures as PNG files' bytes."""

    experiment: Experiment
    answer: dict[str, Any]
    compared: list[Comparison]
    figures: dict[str, bytes]


def reproduce_all(
    seed: int,
    seeds: int | None,
    progress: ProgressCall,
    done: Callable[[Reproduction], None] = lambda _: None,
    names: Iterable[str] = REPRODUCED,
) -> list[Reproduction]:
    """Run the experiments of these names, with ``seeds`` repetitions if given; raises the errors of their runs."""
    found = []
    for name in names:
        experiment = find_experiment(name)
        result = experiment.run(seed, {"seeds": seeds} if experiment.seeds else {}, progress)
        answer = experiment.report(result)
        figures = experiment.figures(result)
        found.append(Reproduction(experiment, answer, experiment.compare(answer), figures))
        done(found[-1])
    return found


def answer_of_all(found: list[Reproduction], seed: int) -> dict[str, Any]:
    """The JSON object of ``reproduce all``."""
    return {
        "experiment": "all",
        "seed": seed,
        "rows": [{"experiment": one.experiment.name, **row._asdict()} for one in found for row in one.compared],
        "verdicts": _tally(found),
        "thesis": {item.number: item.experiment or item.instead for item in CONTENTS},
    }


def _tally(found: list[Reproduction]) -> dict[Verdict, int]:
    return tally(row.verdict for one in found for row in one.compared)


STYLE = """
:root { color-scheme: light dark; --line: #8886; --soft: #8881; }
body { font: 15px/1.45 system-ui, sans-serif; max-width: 70rem; margin: 0 auto; padding: 1rem; }
table { border-collapse: collapse; margin: .6rem 0; display: block; overflow-x: auto; }
th, td { border: 1px solid var(--line); padding: .2rem .5rem; text-align: left; vertical-align: top; }
th { background: var(--soft); }
img { max-width: 100%; height: auto; background: white; }
.agrees, .better, .derived { color: #197a35; } .worse, .not-reproduced { color: #b3261e; font-weight: 600; }
@media (prefers-color-scheme: dark) {
.agrees, .better, .derived { color: #6fd08b; } .worse, .not-reproduced { color: #ff8a80; }
}
"""


def page(found: list[Reproduction], seed: int) -> str:
    """HTML page of all results (one file: images embedded, no external resources)."""
    counts = _tally(found)
    parts = [
        "<!doctype html><html lang=en><head><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width, initial-scale=1">',
        f"<title>The thesis, reproduced</title><style>{STYLE}</style></head><body>",
        "<h1>The thesis, reproduced</h1>",
        f"<p>Ruf's thesis of 2001, its tables and figures beside those of <code>stereoservo reproduce all --seed {seed}"
        "</code>. Everything of ours is simulated; errors are ours, never bounds.</p>",
        "<h2>Verdicts</h2>",
        _table(
            ("verdict", "rows", "meaning"),
            [(_word(word), str(counts[word]), escape(MEANINGS[word])) for word in MEANINGS],
        ),
        "<h2>Contents of the thesis</h2>",
        _table(("number", "shows", "here"), [_contents_line(item, found) for item in CONTENTS]),
        *(_section(one) for one in found),
        "</body></html>",
    ]
    return "\n".join(parts)


def _contents_line(item: Any, found: list[Reproduction]) -> tuple[str, str, str]:
    here = escape(item.instead)
    if item.experiment:
        ran = any(one.experiment.name == item.experiment for one in found)
        link = f'<a href="#{item.experiment}">{item.experiment}</a>'
        here = link if ran else f"{item.experiment}: not run"
    return escape(item.number), escape(item.shows), here


def _section(one: Reproduction) -> str:
    """One experiment: verdicts, figures, its rows, its assumptions."""
    name = one.experiment.name
    rows = [(*map(escape, row[:5]), _word(row.verdict), escape(row.why)) for row in one.compared]
    figures = [
        f'<figure><img alt="{escape(file)}" src="data:image/png;base64,{base64.b64encode(data).decode()}">'
        f"<figcaption>{escape(Path(file).stem.replace('-', ' '))}</figcaption></figure>"
        for file, data in one.figures.items()
    ]
    assumed = "".join(f"<li>{escape(str(line))}</li>" for line in one.answer.get("assumptions", []))
    return "\n".join(
        [
            f"<h2 id={name}>{name}</h2><p>{escape(one.experiment.summary)}</p>",
            _table(COLUMNS, rows),
            *figures,
            *(
                f"<details><summary>{escape(title)}</summary>{_rows_table(listed)}</details>"
                for title, listed in _listed(one.answer)
            ),
            f"<details><summary>assumed</summary><ul>{assumed}</ul></details>" if assumed else "",
        ]
    )


def _listed(answer: dict[str, Any]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Lists of rows of an answer, with their titles."""
    found = [(f"all {len(answer['rows'])} rows", answer["rows"])]
    if "implied" in answer:
        implied = answer["implied"]
        found.append((f"the same with {implied['sigma_px']:g} px and {implied['baseline_m']:g} m", implied["rows"]))
    if answer.get("rendered"):
        found.append(("through rendered pictures", answer["rendered"]))
    return found


def _rows_table(rows: list[dict[str, Any]]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row))
    return _table([escape(n) for n in names], [[escape(cell_text(row.get(n))) for n in names] for row in rows])


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """HTML table of cells that are already HTML."""
    lines = ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<table><tr>{''.join(f'<th>{name}</th>' for name in head)}</tr>{''.join(lines)}</table>"


def _word(verdict: str) -> str:
    return f'<span class="{verdict.replace(" ", "-")}">{verdict}</span>'
