"""``bench faults``: injects every fault of the CAN arm, of the service and of its inputs, and measures the time to
detection and to rest.
"""

from __future__ import annotations

import sys
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from stereoservo_sim.benchmarks.faults.inputs import run_inputs
from stereoservo_sim.benchmarks.faults.service import run_service
from stereoservo_sim.benchmarks.faults.wall import run_wall
from stereoservo_sim.emulators.bus.fault_cases import CASES
from stereoservo_sim.emulators.bus.fault_table import run_row
from stereoservo_sim.emulators.bus.fault_trials import (
    AXES,
    RAMP_COUNTS_S2,
    RATE_HZ,
    SPEED_COUNTS_S,
    TrialError,
)
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall

WALL_SHARE = 3
"""For so many trials in bit time one in real time, which takes seconds."""


def run_faults(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``rows``: of the drives in the emulator's bit time, ``repetitions`` trials a fault, alike for one seed. ``wall``:
    of the drives in real time. ``service``: of the whole daemon in real time. ``inputs``: of joint samples, camera
    frames and the clock in virtual time, ``repetitions`` trials a fault, alike for one seed.

    Raises ExperimentError where a trial cannot begin, or the emulated drives or a daemon end.
    """
    cases = [(protocol, case) for protocol, those in CASES.items() for case in those]
    rows = []
    for k, (protocol, case) in enumerate(cases):
        try:
            rows.append(run_row(case, protocol, repetitions, seed))
        except TrialError as error:
            raise ExperimentError("fault_trial", f"{protocol}, {case.name}: {error}") from error
        progress("faults in bit time", k + 1, len(cases))
    wall = run_wall(
        max(repetitions // WALL_SHARE, 1), lambda done, total: progress("faults in real time", done, total)
    )
    inputs = run_inputs(repetitions, seed, _tell_input)
    service = run_service(max(repetitions // WALL_SHARE, 1), _tell_row)
    return {
        "axes": AXES,
        "rate_hz": RATE_HZ,
        "ramp_ms": SPEED_COUNTS_S / RAMP_COUNTS_S2 * 1e3,
        "ok": all(row.ok for row in rows),
        "rows": [msgspec.to_builtins(row) for row in rows],
        "wall": wall,
        "service": service,
        "inputs": inputs,
    }


def _tell_row(row: dict[str, Any]) -> None:
    """One row of the service as it comes, on stderr."""
    print(
        f"{row['fault']}: rest {_summary(row['rest_ms'])} ms of {row['bound_ms']}, within {row['within']} of "
        f"{row['trials']}, after {', '.join(row['after'])}; a trial takes {_summary(row['trial_s'])} s",
        file=sys.stderr,
    )


def _tell_input(row: dict[str, Any]) -> None:
    """One row of the inputs as it comes, on stderr."""
    print(
        f"{row['input']}, {row['fault']}, goal by {row['goal']}: rest {_summary(row['rest_ms'])} ms of "
        f"{row['bound_ms']}, within {row['within']} of {row['trials']}, works again {row['works_again']}",
        file=sys.stderr,
    )


def show_faults(figures: dict[str, Any], console: Console) -> None:
    """The tables."""
    console.print(_bit_time_table(figures))
    for row in figures["rows"]:
        for problem in row["problems"]:
            console.print(f"{row['protocol']}, {row['fault']}: {problem}")
    console.print(_wall_table(figures["wall"]))
    console.print(_service_table(figures["service"]))
    console.print(_input_table(figures["inputs"]))
    loop = figures["wall"]["emulator_loop"]
    if loop is not None:
        console.print(
            f"the emulator's loop came {loop['latest_ns'] * 1e-6:.2f} ms late at most, "
            f"{loop['stalls']} stalls in {loop['turns']} turns"
        )


def _bit_time_table(figures: dict[str, Any]) -> Table:
    title = (
        f"{figures['axes']} axes at {figures['rate_hz']:g} Hz, ramps of {figures['ramp_ms']:g} ms, "
        f"in the emulator's bit time; "
        f"{figures['rows'][0]['trials']} trials each; [ms] after the fault, median / max"
    )
    table = Table(title=title, title_justify="left")
    for name in (
        "protocol",
        "fault",
        "known",
        "cycles",
        "all at rest",
        "bound",
        "by",
        "latched",
        "restarts",
        "ok",
    ):
        table.add_column(name, justify="right" if name in ("cycles", "bound", "restarts") else "left")
    for row in figures["rows"]:
        table.add_row(
            row["protocol"],
            row["fault"],
            _pair(row["detected_ms_median"], row["detected_ms_max"]),
            "-" if row["detected_cycles"] is None else str(row["detected_cycles"]),
            _pair(row["rest_ms_median"], row["rest_ms_max"]),
            "-" if row["bound_ms"] is None else f"{row['bound_ms']:g}",
            row["by"],
            ", ".join(f"{code} {count}" for code, count in row["codes"].items()) or "-",
            str(row["restarts"]),
            "yes" if row["ok"] else "NO",
        )
    return table


def _wall_table(wall: dict[str, Any]) -> Table:
    table = Table(title="real time, two processes, slcan over TCP; [ms], median / max", title_justify="left")
    for name in (
        "fault",
        "known",
        "all at rest",
        "bound in bit time",
        "latched",
        "restarts",
        "stalled before",
    ):
        table.add_column(name)
    for row in wall["rows"]:
        table.add_row(
            row["fault"],
            _summary(row["detected_ms"]),
            _summary(row["rest_ms"]) + (f" ({row['never_at_rest']} never)" if row["never_at_rest"] else ""),
            f"{row['bound_ms_in_bit_time']:g}",
            ", ".join(row["codes"]) or "-",
            str(row["restarts"]),
            str(len(row["stalled"])),
        )
    return table


def _service_table(rows: list[dict[str, Any]]) -> Table:
    title = "the whole service in real time: emulated drives on slcan, a joint goal; [ms], median / max"
    table = Table(title=title, title_justify="left")
    for name in (
        "fault",
        "all at rest",
        "bound",
        "within",
        "after",
        "status right",
        "status says",
        "ends of the goal",
        "void",
    ):
        table.add_column(name)
    for row in rows:
        table.add_row(
            row["fault"],
            _summary(row["rest_ms"]) if row["rest_ms"] else "goes on",
            "-" if row["bound_ms"] is None else f"{row['bound_ms']:g}",
            f"{row['within']} of {row['trials']}",
            ", ".join(row["after"]),
            f"{row['status_right']} of {row['trials']}",
            " | ".join(row["status_says"]),
            ", ".join("-" if count < 0 else str(count) for count in row["terminal_events"]),
            str(len(row["void"])),
        )
    return table


def _input_table(rows: list[dict[str, Any]]) -> Table:
    title = "inputs of the core in virtual time, fake arm and cameras in lockstep; [ms], median / max"
    table = Table(title=title, title_justify="left")
    for name in (
        "input",
        "fault",
        "goal by",
        "at rest",
        "bound",
        "within",
        "after",
        "told",
        "goal",
        "ends",
        "works again",
    ):
        table.add_column(name)
    for row in rows:
        table.add_row(
            row["input"],
            row["fault"],
            row["goal"],
            _summary(row["rest_ms"]) if row["rest_ms"] else "goes on",
            "-" if row["bound_ms"] is None else f"{row['bound_ms']:g}",
            f"{row['within']} of {row['trials']}",
            ", ".join(row["after"]),
            ", ".join(row["reasons"]) or "-",
            ", ".join(row["outcomes"]),
            ", ".join(str(count) for count in row["terminal_events"]),
            f"{row['works_again']} of {row['trials']}",
        )
    return table


def _pair(median: float | None, largest: float | None) -> str:
    return "-" if median is None or largest is None else f"{median:.1f} / {largest:.1f}"


def _summary(figures: dict[str, Any] | None) -> str:
    return "-" if figures is None else _pair(figures["median"], figures["max"])
