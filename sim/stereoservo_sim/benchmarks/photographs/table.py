"""``bench detectors``: what detectors find on photographs, how well, how fast, beside OpenCV's and pupil-apriltags."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from stereoservo_sim.benchmarks.photographs.boards import all_rows
from stereoservo_sim.benchmarks.photographs.pictures import photographs
from stereoservo_sim.benchmarks.photographs.plates import plate_rows
from stereoservo_sim.benchmarks.photographs.tags import tag_rows
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall


def run_detectors(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """A row for each detector and kind of pictures, and what was left out.

    ``shown``: what any of the detectors found rightly; ``false``: what is not there, or has another's id. Raises
    ExperimentError ``data_missing`` where there are no photographs at all.
    """
    shown = photographs()
    if not (shown.franka or shown.boards or shown.others or shown.sheet or shown.webots):
        raise ExperimentError(
            "data_missing", "no photographs: " + "; ".join(shown.missing), missing=shown.missing
        )
    progress("tags", 0, 3)
    rows, left_out = tag_rows(shown, repetitions)
    progress("chessboards and corners", 1, 3)
    rows += all_rows(shown, repetitions)
    progress("dots", 2, 3)
    rows += plate_rows(shown, repetitions, seed)
    progress("dots", 3, 3)
    reasons = sorted(set(shown.missing) | set(left_out))
    return {"rows": [row.report() for row in rows], "left_out": reasons}


def show_detectors(answer: dict[str, Any], console: Console) -> None:
    """Print the table, and below it what was left out."""
    table = Table("pictures", "n", "detector", "found", "of", "false", "rms [px]", "measured by", "CPU [ms]")
    last = ""
    for row in answer["rows"]:
        rms = "" if row["rms_px"] is None else f"{row['rms_px']:.3f}"
        if row["on"] != last:
            table.add_section()
        table.add_row(
            row["on"] if row["on"] != last else "", str(row["pictures"]), row["detector"],
            str(row["found"]) if row["shown"] else "", str(row["shown"] or ""), str(row["false"]), rms,
            row["accuracy"], f"{row['cpu_ms']:.3g}",
        )  # fmt: skip
        last = row["on"]
    console.print(table)
    for reason in answer["left_out"]:
        console.print(f"left out: {reason}", soft_wrap=True)
