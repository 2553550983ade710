"""Generates ``docs/reliability.md`` from the results of ``bench faults``:

``stereoservo bench faults --json | python -m stereoservo_sim.benchmarks.faults.page > docs/reliability.md``.
"""

from __future__ import annotations

import json
import re
import sys
from typing import Any

from stereoservo_sim.benchmarks.faults.bench import drive_cells, input_cells, service_cells

PAGE = """# Reliability: what happens when something fails

Made by `stereoservo bench faults --json | python -m stereoservo_sim.benchmarks.faults.page`; nothing on this page
is written by hand. What the service does against each of these, and why: [safety.md](safety.md).
How long things take: [performance.md](performance.md).

Times are from the fault to the last motion of any axis, by the emulated arm's true joints, in milliseconds: median /
max. They hold the ramp to rest. Machine: {machine}. Trials of the service in real time: {service} each; of the drives:
{drives} each.

## The service

A daemon with emulated drives moves to a joint goal, or is jogged, when the fault comes. *A second later*: what
`stereoservo status` told then, the cell's state or the code of its error. *Ends*: terminal events of the goal, by this
daemon or the next; one is right. *Notes*: those of `status` then; *later*: once the daemon is ready again. What
differs between trials stands as `N` (a number), `HH:MM:SS`, `YYYY-MM-DD` or `STAMP` (a time). *Void*: trials in which
the machine stalled, or that cannot be made on it; they count for nothing.

{service_table}

## The inputs

What the core is told is wrong in one way from one moment on: joint samples, camera frames, the clock. The servo and
vision loops run in virtual time before a fake arm and fake cameras, with a goal by joints, by images, or by either as
the trial draws; trials: {inputs} each. *After*: the cell's state 2 s later; *told*: the reasons in `status`. *Ends*:
terminal events of the goal in the end; one is right. *Works again*: the cause gone, an operator resumes, or resets and
enables, and the arm reaches a goal. The fastest joint ever had {fastest} of its velocity limit.

{input_table}

## The drives

The driver and emulated drives on a CAN bus, in the emulator's bit time: what they do of themselves.

{drive_table}
"""


SERVICE = {
    "fault": "fault", "all at rest": "at rest", "bound": "bound", "within": "within", "after": "a second later",
    "status right": "status right", "ends of the goal": "ends", "status says": "what `status` says", "void": "void",
}  # fmt: skip
"""Cells of each table that are on the page, and their headings."""
INPUTS = {
    name: name for name in
    ("input", "fault", "goal by", "at rest", "bound", "within", "after", "told", "goal", "ends", "works again")
} | {"goal": "the goal"}  # fmt: skip
DRIVES = {
    "protocol": "protocol", "fault": "fault", "known": "noticed", "all at rest": "at rest", "bound": "bound",
    "by": "by", "latched": "latched", "ok": "within",
}  # fmt: skip
PLACEHOLDERS = (
    (re.compile(r"\b\d{8}T\d{6}(?:\.\d+)?Z?"), "STAMP"),
    (re.compile(r"\b\d{4}-\d{2}-\d{2}\b"), "YYYY-MM-DD"),
    (re.compile(r"\b\d{2}:\d{2}:\d{2}\b"), "HH:MM:SS"),
)
NUMBER = re.compile(r"(?<![A-Za-z\d.])\d+(?:\.\d+)?(?![A-Za-z\d])")
"""A number that is not part of a name (`j1`, `taught2`), nor before a unit or version."""


def reliability_page(figures: dict[str, Any]) -> str:
    """The page of the figures printed by ``bench faults --json``."""
    machine = figures["machine"]
    return PAGE.format(
        machine=f"{machine['processor']}, {machine['cores']} cores",
        service=max(row["trials"] for row in figures["service"]),
        drives=max(row["trials"] for row in figures["rows"]),
        inputs=max(row["trials"] for row in figures["inputs"]),
        fastest=f"{max(row['fastest_of_limit'] for row in figures['inputs']):.2f}",
        service_table=_table(SERVICE, [_of_service(row) for row in figures["service"]]),
        input_table=_table(INPUTS, [input_cells(row, 0) for row in figures["inputs"]]),
        drive_table=_table(DRIVES, [_of_drives(row) for row in figures["rows"]]),
    )


def _of_service(row: dict[str, Any]) -> dict[str, str]:
    cells = service_cells(row, 0)
    cells["status says"] = "<br>".join(distinct_sentences(row["status_says"]))
    if not row["trials"] and row["rest_ms"] is None:
        cells["all at rest"] = "no trial"
    return cells


def _of_drives(row: dict[str, Any]) -> dict[str, str]:
    return drive_cells(row, 0) | {"latched": ", ".join(row["codes"]) or "-"}


def distinct_sentences(said: list[str]) -> list[str]:
    """Each sentence once, in order. Times become placeholders; sentences that then differ only in numbers become one,
    with `N` for each number that differs.
    """
    alike: dict[str, list[str]] = {}
    for sentence in said:
        for pattern, word in PLACEHOLDERS:
            sentence = pattern.sub(word, sentence)
        alike.setdefault(NUMBER.sub("N", sentence), []).append(sentence)
    return [_in_common(sentences) for sentences in alike.values()]


def _in_common(sentences: list[str]) -> str:
    """Sentences that differ only in numbers, merged, with `N` for each number that differs."""
    numbers = [NUMBER.findall(sentence) for sentence in sentences]
    common = iter([given[0] if len(set(given)) == 1 else "N" for given in zip(*numbers, strict=True)])
    return NUMBER.sub(lambda _: next(common), sentences[0])


def _table(columns: dict[str, str], rows: list[dict[str, str]]) -> str:
    """A table of ``columns``, heading by cell."""
    lines = [
        list(columns.values()),
        ["---"] * len(columns),
        *([row[name] for name in columns] for row in rows),
    ]
    return "\n".join(map(_line, lines))


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


if __name__ == "__main__":
    print(reliability_page(json.load(sys.stdin)), end="")
