"""Makes ``docs/reliability.md`` of what ``bench faults`` has measured:

``stereoservo bench faults --json | python -m stereoservo_sim.benchmarks.faults.page > docs/reliability.md``.
"""

from __future__ import annotations

import json
import re
import sys
from typing import Any

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
SERVICE_COLUMNS = (
    "fault", "at rest", "bound", "within", "a second later", "status right", "ends", "what `status` says", "void",
)  # fmt: skip
INPUT_COLUMNS = (
    "input", "fault", "goal by", "at rest", "bound", "within", "after", "told", "the goal", "ends", "works again",
)  # fmt: skip
PLACEHOLDERS = (
    (re.compile(r"\b\d{8}T\d{6}(?:\.\d+)?Z?"), "STAMP"),
    (re.compile(r"\b\d{4}-\d{2}-\d{2}\b"), "YYYY-MM-DD"),
    (re.compile(r"\b\d{2}:\d{2}:\d{2}\b"), "HH:MM:SS"),
)
NUMBER = re.compile(r"(?<![A-Za-z\d.])\d+(?:\.\d+)?(?![A-Za-z\d])")
"""Not one of a name (`j1`, `taught2`), nor of a unit or version behind it."""
DRIVE_COLUMNS = ("protocol", "fault", "noticed", "at rest", "bound", "by", "latched", "within")


def reliability_page(figures: dict[str, Any]) -> str:
    """The page of the figures that ``bench faults --json`` has printed."""
    machine = figures["machine"]
    return PAGE.format(
        machine=f"{machine['processor']}, {machine['cores']} cores",
        service=max(row["trials"] for row in figures["service"]),
        drives=max(row["trials"] for row in figures["rows"]),
        inputs=max(row["trials"] for row in figures["inputs"]),
        fastest=f"{max(row['fastest_of_limit'] for row in figures['inputs']):.2f}",
        service_table=_table(SERVICE_COLUMNS, [_service_cells(row) for row in figures["service"]]),
        input_table=_table(INPUT_COLUMNS, [_input_cells(row) for row in figures["inputs"]]),
        drive_table=_table(DRIVE_COLUMNS, [_drive_cells(row) for row in figures["rows"]]),
    )


def _service_cells(row: dict[str, Any]) -> list[str]:
    rest = row["rest_ms"]
    on = "goes on" if row["trials"] else "no trial"
    ends = ", ".join("-" if count < 0 else str(count) for count in row["terminal_events"])
    return [
        row["fault"],
        on if rest is None else _pair(rest["median"], rest["max"]),
        "-" if row["bound_ms"] is None else f"{row['bound_ms']:g}",
        f"{row['within']} of {row['trials']}",
        ", ".join(row["after"]),
        f"{row['status_right']} of {row['trials']}",
        ends,
        "<br>".join(distinct_sentences(row["status_says"])),
        str(len(row["void"])),
    ]


def distinct_sentences(said: list[str]) -> list[str]:
    """Each sentence once, in order. Times become placeholders; sentences that then differ in numbers alone become one,
    with `N` for each number that differs.
    """
    alike: dict[str, list[str]] = {}
    for sentence in said:
        for pattern, word in PLACEHOLDERS:
            sentence = pattern.sub(word, sentence)
        alike.setdefault(NUMBER.sub("N", sentence), []).append(sentence)
    return [_in_common(sentences) for sentences in alike.values()]


def _in_common(sentences: list[str]) -> str:
    """Sentences that differ in numbers alone as one, with `N` for each number that differs."""
    numbers = [NUMBER.findall(sentence) for sentence in sentences]
    common = iter([given[0] if len(set(given)) == 1 else "N" for given in zip(*numbers, strict=True)])
    return NUMBER.sub(lambda _: next(common), sentences[0])


def _input_cells(row: dict[str, Any]) -> list[str]:
    rest = row["rest_ms"]
    return [
        row["input"],
        row["fault"],
        row["goal"],
        "goes on" if rest is None else _pair(rest["median"], rest["max"]),
        "-" if row["bound_ms"] is None else f"{row['bound_ms']:g}",
        f"{row['within']} of {row['trials']}",
        ", ".join(row["after"]),
        ", ".join(row["reasons"]) or "-",
        ", ".join(row["outcomes"]),
        ", ".join(str(count) for count in row["terminal_events"]),
        f"{row['works_again']} of {row['trials']}",
    ]


def _drive_cells(row: dict[str, Any]) -> list[str]:
    return [
        row["protocol"],
        row["fault"],
        _pair(row["detected_ms_median"], row["detected_ms_max"]),
        _pair(row["rest_ms_median"], row["rest_ms_max"]),
        "-" if row["bound_ms"] is None else f"{row['bound_ms']:g}",
        row["by"],
        ", ".join(row["codes"]) or "-",
        "yes" if row["ok"] else "NO",
    ]


def _pair(median: float | None, largest: float | None) -> str:
    return "-" if median is None or largest is None else f"{median:.0f} / {largest:.0f}"


def _table(columns: tuple[str, ...], rows: list[list[str]]) -> str:
    return "\n".join(_line(cells) for cells in (list(columns), ["---"] * len(columns), *rows))


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


if __name__ == "__main__":
    print(reliability_page(json.load(sys.stdin)), end="")
