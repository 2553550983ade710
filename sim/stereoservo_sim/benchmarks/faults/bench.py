"""``bench faults``: injects every fault of the CAN arm, of the service and of its inputs, and measures the time to
detection and to rest.

In real time, driver and emulated drives are two processes over serial-line CAN on TCP. Times are from the order (or the
signal) to the rest of the last axis, by the emulator's events; both are CLOCK_MONOTONIC. Machines are shared: a fault
before its order is due to a stall, is counted, and the trial is repeated; the lateness of the emulator's loop is
reported beside the times.
"""

from __future__ import annotations

import json
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
from rich.console import Console
from rich.table import Table

from stereoservo.messages.cell_file import load_cell_file
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_sim.benchmarks.faults.inputs import run_inputs
from stereoservo_sim.benchmarks.faults.service import run_service
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.emulators.bus.factory import drives_of_cell
from stereoservo_sim.emulators.bus.fault_trials import (
    AXES,
    CASES,
    RAMP_COUNTS_S2,
    RATE_HZ,
    SPEED_COUNTS_S,
    TrialError,
    run_row,
)
from stereoservo_sim.emulators.emulator_process import EmulatorProcess
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall

CELL = "hil-can"
SPEED = 0.125
"""[rad/s]; with the cell's quick-stop deceleration the ramp takes 12.5 ms."""
STRICT = {
    "heartbeat_timeout_ms": 100,
    "rpdo_deadline_ms": 0,
    "max_missed_cycles": 3,
    "command_timeout_s": 0.1,
    "loop_timeout_ms": 100,
}
"""Settings of the table: the options' defaults; the drives monitor the heartbeat alone."""
TRIES = 4
REST_LIMIT_S = 2.0
RUN_ON_S = 0.5
TOLD_LIMIT_S = 2.0
START_LIMIT_S = 60.0

ORDERED = (
    ("drive fault with emergency", "fault 3 0x3210", "", 40.0),
    ("node silent", "silence 4", "speak 4", 60.0),
    ("node reboots", "reboot 5", "", 60.0),
    ("TPDOs late by 6 ms", "late 2 6ms", "late 2 0", 150.0),
    ("duplicate node id running", "duplicate 2 running", "duplicate 2 off", 60.0),
    ("mapping changed", "remap 3", "", 40.0),
    ("bus cable out", "cable out", "cable in", 150.0),
    ("SYNC lost", "drop-sync", "pass-sync", 60.0),
    ("NMT stop by a stranger", "nmt stop", "nmt start", 60.0),
    ("babbling node", "flood 1", "calm 1", 60.0),
    ("adapter gone", "adapter out", "adapter in", 150.0),
)
"""Fault, its order, the order that ends it, bound [ms] in bit time."""
DONE_TO_THE_MASTER = ("master killed", "master process hangs", "servo loop hangs")
MASTER_BOUND_MS = 150.0


class StalledError(Exception):
    """The trial is void: the machine stalled, and a fault occurred before one was injected."""


class _Master:
    """The driver's process."""

    def __init__(self, options: CanOptions, speed: float) -> None:
        command = [sys.executable, "-m", "stereoservo_sim.benchmarks.faults.master"]
        settings = json.dumps(msgspec.to_builtins(options))
        self.process = subprocess.Popen(
            [*command, settings, repr(speed)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.lines: queue.Queue[dict[str, Any]] = queue.Queue()
        self._reader = threading.Thread(target=self._read, name="master-lines", daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(json.loads(line))
        self.lines.put({"event": "ended"})

    def expect(self, event: str, limit_s: float) -> dict[str, Any]:
        """The next line, which must be ``event``. Raises StalledError with the line received instead."""
        try:
            line = self.lines.get(timeout=limit_s)
        except queue.Empty:
            raise StalledError(f"no {event!r} within {limit_s:g} s") from None
        if line["event"] != event:
            raise StalledError(f"{line.get('code', line['event'])}: {line.get('message', '')}")
        return line

    def fault(self) -> dict[str, Any] | None:
        """The first fault reported, if any."""
        while not self.lines.empty():
            line = self.lines.get()
            if line["event"] == "fault":
                return line
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(START_LIMIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join()


def _strike(emulator: EmulatorProcess, master: _Master, fault: str, order: str) -> int:
    """Inject the fault; returns the time [ns]."""
    if order:
        asked_ns = time.monotonic_ns()
        emulator.order(order)
        until = time.monotonic() + TOLD_LIMIT_S
        while not (done := _events(emulator, asked_ns, "order")):
            if time.monotonic() > until:
                raise StalledError(f"the emulator told nothing of {order!r} within {TOLD_LIMIT_S:g} s")
            time.sleep(0.001)
        return int(done[0]["t_ns"])
    if fault == "servo loop hangs":
        assert master.process.stdin is not None
        master.process.stdin.write("hang\n")
        master.process.stdin.flush()
        return int(master.expect("hangs", 1.0)["t_ns"])
    now = time.monotonic_ns()
    master.process.send_signal(signal.SIGKILL if fault == "master killed" else signal.SIGSTOP)
    return now


def _events(emulator: EmulatorProcess, since_ns: int, *kinds: str) -> list[dict[str, Any]]:
    return [e for e in list(emulator.events) if e.get("event") in kinds and e["t_ns"] >= since_ns]


def _trial(emulator: EmulatorProcess, options: CanOptions, speed: float, fault: str, order: str) -> dict[str, Any]:
    """One trial. Raises StalledError."""
    with _Master(options, speed) as master:
        master.expect("moving", START_LIMIT_S)
        t0 = _strike(emulator, master, fault, order)
        until = time.monotonic() + REST_LIMIT_S
        while not (rests := _events(emulator, t0, "all_rest")) and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(RUN_ON_S)
        told = master.fault()
        if told is not None and told["t_ns"] < t0:
            raise StalledError(f"{told['code']}: {told['message']}")
        restarted = bool(rests and _events(emulator, rests[0]["t_ns"], "moves", "power_on"))
    return {
        "rest_ms": (rests[0]["t_ns"] - t0) * 1e-6 if rests else None,
        "detected_ms": (told["t_ns"] - t0) * 1e-6 if told is not None else None,
        "code": told["code"] if told is not None else "",
        "restarted": restarted,
    }


def _settle(emulator: EmulatorProcess, cure: str) -> None:
    """Remove the cause, and wait until the drives are at rest."""
    if cure:
        emulator.order(cure)
    time.sleep(0.2)


def run_wall(repetitions: int, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Rows of all faults, ``repetitions`` trials each, and the lateness of the emulator's loop.

    Raises ExperimentError if the emulated drives end.
    """
    cases = [*ORDERED, *((fault, "", "", MASTER_BOUND_MS) for fault in DONE_TO_THE_MASTER)]
    options, _ = drives_of_cell(load_cell_file(shipped_cell_path(CELL)))
    with tempfile.TemporaryDirectory() as folder:
        text = shipped_cell_path(CELL).read_text(encoding="utf-8")
        cell = Path(folder) / f"{CELL}.toml"
        cell.write_text(text.replace('plant = "pybullet"', 'plant = "ideal"'), encoding="utf-8")
        directories = {"STEREOSERVO_RUNTIME_DIR": folder, "STEREOSERVO_STATE_DIR": folder}
        channel = ("--channel", "socket://127.0.0.1:0", "--bit-time")
        with EmulatorProcess(cell, options=channel, environment=directories, log=Path(folder) / "log") as emulator:
            options = msgspec.structs.replace(options, channel=emulator.wait_ready(), **STRICT)
            rows = []
            for k, (fault, order, cure, bound_ms) in enumerate(cases):
                rows.append(_row(emulator, options, fault, order, cure, bound_ms, repetitions))
                progress(k + 1, len(cases))
        stalls = [event for event in emulator.events if event.get("event") == "end"]
    loop = {key: value for key, value in stalls[-1].items() if key != "event"} if stalls else None
    return {"rows": rows, "emulator_loop": loop, "load": list(os.getloadavg())}


def _row(
    emulator: EmulatorProcess, options: CanOptions, fault: str, order: str, cure: str, bound_ms: float, repetitions: int
) -> dict[str, Any]:
    trials: list[dict[str, Any]] = []
    stalled: list[str] = []
    while len(trials) < repetitions and len(stalled) < TRIES:
        speed = SPEED if (len(trials) + len(stalled)) % 2 else -SPEED
        try:
            trials.append(_trial(emulator, options, speed, fault, order))
        except StalledError as error:
            stalled.append(str(error))
        if emulator.process.poll() is not None:
            raise ExperimentError("emulator", f"{fault}: the emulated drives ended: {emulator.output()}")
        _settle(emulator, cure)
    rests = [trial["rest_ms"] for trial in trials if trial["rest_ms"] is not None]
    seen = [trial["detected_ms"] for trial in trials if trial["detected_ms"] is not None]
    return {
        "fault": fault,
        "rest_ms": summary(rests) if rests else None,
        "detected_ms": summary(seen) if seen and order else None,
        "bound_ms_in_bit_time": bound_ms,
        "never_at_rest": len(trials) - len(rests),
        "codes": sorted({trial["code"] for trial in trials if trial["code"]}),
        "restarts": sum(trial["restarted"] for trial in trials),
        "stalled": stalled,
    }


# -- the bench -------------------------------------------------------------------------------------------------

WALL_SHARE = 3
"""Trials in bit time per trial in real time, which takes seconds."""


def run_faults(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run all fault trials, reproducible for one seed except in real time.

    ``rows``: of the drives in the emulator's bit time, ``repetitions`` trials a fault. ``wall``: of the drives in real
    time. ``service``: of the whole daemon in real time. ``inputs``: of joint samples, camera frames and the clock in
    virtual time, ``repetitions`` trials a fault.

    Raises ExperimentError if a trial cannot begin, or the emulated drives or a daemon end.
    """
    cases = [(protocol, case) for protocol, those in CASES.items() for case in those]
    rows = []
    for k, (protocol, case) in enumerate(cases):
        try:
            rows.append(run_row(case, protocol, repetitions, seed))
        except TrialError as error:
            raise ExperimentError("fault_trial", f"{protocol}, {case.name}: {error}") from error
        progress("faults in bit time", k + 1, len(cases))
    wall = run_wall(max(repetitions // WALL_SHARE, 1), lambda done, total: progress("faults in real time", done, total))
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
    """Print one row of the service when it is complete, on stderr."""
    print(
        f"{row['fault']}: rest {_summary(row['rest_ms'])} ms of {row['bound_ms']}, within {row['within']} of "
        f"{row['trials']}, after {', '.join(row['after'])}; a trial takes {_summary(row['trial_s'])} s",
        file=sys.stderr,
    )


def _tell_input(row: dict[str, Any]) -> None:
    """Print one row of the inputs when it is complete, on stderr."""
    print(
        f"{row['input']}, {row['fault']}, goal by {row['goal']}: rest {_summary(row['rest_ms'])} ms of "
        f"{row['bound_ms']}, within {row['within']} of {row['trials']}, works again {row['works_again']}",
        file=sys.stderr,
    )


def show_faults(figures: dict[str, Any], console: Console) -> dict[str, Any]:
    """Print the tables; returns the remaining figures."""
    rows, wall = figures["rows"], figures["wall"]
    title = (
        f"{figures['axes']} axes at {figures['rate_hz']:g} Hz, ramps of {figures['ramp_ms']:g} ms, "
        f"in the emulator's bit time; {rows[0]['trials']} trials each; [ms] after the fault, median / max"
    )
    console.print(_table(title, [drive_cells(row) for row in rows], ("cycles", "bound", "restarts")))
    for row in rows:
        for problem in row["problems"]:
            console.print(f"{row['protocol']}, {row['fault']}: {problem}")
    title = "real time, two processes, slcan over TCP; [ms], median / max"
    console.print(_table(title, [_wall_cells(row) for row in wall["rows"]]))
    title = "the whole service in real time: emulated drives on slcan, a joint goal; [ms], median / max"
    console.print(_table(title, [service_cells(row) for row in figures["service"]]))
    title = "inputs of the core in virtual time, fake arm and cameras in lockstep; [ms], median / max"
    console.print(_table(title, [input_cells(row) for row in figures["inputs"]]))
    loop = wall["emulator_loop"]
    if loop is not None:
        console.print(
            f"the emulator's loop came {loop['latest_ns'] * 1e-6:.2f} ms late at most, "
            f"{loop['stalls']} stalls in {loop['turns']} turns"
        )
    shown = ("rows", "wall", "service", "inputs")
    return {key: value for key, value in figures.items() if key not in shown}


def _table(title: str, rows: list[dict[str, str]], right: tuple[str, ...] = ()) -> Table:
    """A table of rows of text by column."""
    table = Table(title=title, title_justify="left")
    for name in rows[0] if rows else ():
        table.add_column(name, justify="right" if name in right else "left")
    for row in rows:
        table.add_row(*row.values())
    return table


def drive_cells(row: dict[str, Any], digits: int = 1) -> dict[str, str]:
    """A row of the drives in bit time as text, by column; ``digits`` of times [ms]."""
    return {
        "protocol": row["protocol"],
        "fault": row["fault"],
        "known": _pair(row["detected_ms_median"], row["detected_ms_max"], digits),
        "cycles": "-" if row["detected_cycles"] is None else str(row["detected_cycles"]),
        "all at rest": _pair(row["rest_ms_median"], row["rest_ms_max"], digits),
        "bound": _bound(row),
        "by": row["by"],
        "latched": ", ".join(f"{code} {count}" for code, count in row["codes"].items()) or "-",
        "restarts": str(row["restarts"]),
        "ok": "yes" if row["ok"] else "NO",
    }


def _wall_cells(row: dict[str, Any]) -> dict[str, str]:
    return {
        "fault": row["fault"],
        "known": _summary(row["detected_ms"]),
        "all at rest": _summary(row["rest_ms"]) + (f" ({row['never_at_rest']} never)" if row["never_at_rest"] else ""),
        "bound in bit time": f"{row['bound_ms_in_bit_time']:g}",
        "latched": ", ".join(row["codes"]) or "-",
        "restarts": str(row["restarts"]),
        "stalled before": str(len(row["stalled"])),
    }


def service_cells(row: dict[str, Any], digits: int = 1) -> dict[str, str]:
    """A row of the service as text, by column; ``digits`` as in `drive_cells`."""
    return {
        "fault": row["fault"],
        "all at rest": _summary(row["rest_ms"], digits) if row["rest_ms"] else "goes on",
        "bound": _bound(row),
        "within": f"{row['within']} of {row['trials']}",
        "after": ", ".join(row["after"]),
        "status right": f"{row['status_right']} of {row['trials']}",
        "status says": " | ".join(row["status_says"]),
        "ends of the goal": ", ".join("-" if count < 0 else str(count) for count in row["terminal_events"]),
        "void": str(len(row["void"])),
    }


def input_cells(row: dict[str, Any], digits: int = 1) -> dict[str, str]:
    """A row of the inputs as text, by column."""
    return {
        "input": row["input"],
        "fault": row["fault"],
        "goal by": row["goal"],
        "at rest": _summary(row["rest_ms"], digits) if row["rest_ms"] else "goes on",
        "bound": _bound(row),
        "within": f"{row['within']} of {row['trials']}",
        "after": ", ".join(row["after"]),
        "told": ", ".join(row["reasons"]) or "-",
        "goal": ", ".join(row["outcomes"]),
        "ends": ", ".join(str(count) for count in row["terminal_events"]),
        "works again": f"{row['works_again']} of {row['trials']}",
    }


def _bound(row: dict[str, Any]) -> str:
    return "-" if row["bound_ms"] is None else f"{row['bound_ms']:g}"


def _pair(median: float | None, largest: float | None, digits: int = 1) -> str:
    return "-" if median is None or largest is None else f"{median:.{digits}f} / {largest:.{digits}f}"


def _summary(figures: dict[str, Any] | None, digits: int = 1) -> str:
    return "-" if figures is None else _pair(figures["median"], figures["max"], digits)


# -- page ------------------------------------------------------------------------------------------------------


PAGE = """# Reliability: what happens when something fails

Made by `stereoservo bench faults --json | python -m stereoservo_sim.benchmarks.faults.bench`; nothing on this page
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
        service_table=_markdown_table(SERVICE, [_of_service(row) for row in figures["service"]]),
        input_table=_markdown_table(INPUTS, [input_cells(row, 0) for row in figures["inputs"]]),
        drive_table=_markdown_table(DRIVES, [_of_drives(row) for row in figures["rows"]]),
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


def _markdown_table(columns: dict[str, str], rows: list[dict[str, str]]) -> str:
    """A table of ``columns``, heading by cell."""
    lines = [list(columns.values()), ["---"] * len(columns), *([row[name] for name in columns] for row in rows)]
    return "\n".join(map(_line, lines))


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


if __name__ == "__main__":
    print(reliability_page(json.load(sys.stdin)), end="")
