"""``bench startup``: a cell's first start with an empty cache of compiled kernels beside its second one, from ``run``
to the first goal reached; memory of its processes, the kernels compiled in each, and the base cost of commands.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import uuid
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from stereoservo.client import Client, ClientError
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import DaemonError, DaemonProcess
from stereoservo.messages.goals import Calibrate
from stereoservo.messages.wire import StateMessage, encode
from stereoservo.numerics.compilation import LOG_VARIABLE
from stereoservo_sim.benchmarks.service_bench import directories_in, environment, processes_of
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.cells import CELLS, shipped_cell_path
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall

COMMANDS = (
    ("--help",), ("status", "--help"), ("goal", "--help"), ("run", "--help"), ("calibrate", "--help"),
    ("warmup", "--help"), ("demo", "--help"), ("simulate", "--help"),
)  # fmt: skip
COMPILED_S = 900.0
LEARNT_S = 900.0
ASIDE = 0.1
"""Way of the first joint [rad] from which the first goal returns."""


def wait_compiled(client: Client) -> StateMessage:
    """The state of a cell once it has all kernels; the first start on a computer compiles them.

    Raises TimedOutError.
    """
    return client.wait_state(
        lambda state: all(reason.code != "COMPILING" for reason in state.reasons), "all kernels", COMPILED_S
    )


def run_startup(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``first``, ``second``: start of the demo's cell with an empty and with the full cache. ``kernels``: compiled by
    the first, ``modules``: their sums. ``commands``: CPU seconds, beside those of an interpreter that does nothing.

    Raises ExperimentError if the daemon does not start.
    """
    commands = _commands(repetitions, progress)
    with tempfile.TemporaryDirectory(prefix="stereoservo-startup-") as scratch:
        folder = Path(scratch)
        variables = {**directories_in(folder), "NUMBA_CACHE_DIR": str(folder / "cache")}
        with environment(variables):
            starts = []
            for k, name in enumerate(("first", "second")):
                progress("starts", k, 2)
                starts.append(_start(folder, name, seed))
            progress("starts", 2, 2)
        kernels = compiled_kernels(folder / "first.log")
        again = compiled_kernels(folder / "second.log")
    return {
        "first": starts[0],
        "second": starts[1] | {"signatures": sum(row["signatures"] for row in again)},
        "signatures": sum(row["signatures"] for row in kernels),
        "compile_cpu_s": sum(row["seconds"] for row in kernels),
        "modules": modules_of(kernels),
        "repeated": [row["kernel"] for row in kernels if row["repeated"]],
        "commands": commands,
        "kernels": kernels,
    }


def _start(folder: Path, name: str, seed: int) -> dict[str, Any]:
    """Wall and CPU seconds of a start, and memory.

    Wall seconds from the start of ``stereoservo run`` until clients are answered, until the arm makes trial motions,
    until all kernels are loaded, until it rests with a model, and until the first goal, set-points taught there, is
    reached. CPU seconds of the preparation of the start, of background compilation, and of the others until the trial
    motions. ``memory_mb``: of each process after the goal, resident and (``pss``) with its share of what others use,
    too. ``peak_mb``: largest resident memory of preparation and compilation. ``overruns``: late cycles, including those
    due to a kernel that was loaded at rest.
    """
    began = time.monotonic()
    text, log = folder / f"{name}.txt", folder / f"{name}.log"
    try:
        with DaemonProcess(
            shipped_cell_path(CELLS[0]), options=("--seed", str(seed)), log=text, environment={LOG_VARIABLE: str(log)}
        ) as daemon:
            info = daemon.wait_ready()
            ready = time.monotonic()
            with Client(info.cell) as client:
                client.enable()
                command = encode(Calibrate(str(uuid.uuid4())))
                client.request("calibrate", client.keys.command("calibrate", client.operator), command)
                client.wait_state(lambda state: state.source == "calibrate", "trial motions", 10.0)
                calibrating = time.monotonic()
                others = sum(_cpu_of(pid) for role, pid in _processes(daemon.process.pid, info.cell))
                wait_compiled(client)
                compiled = time.monotonic()
                state = client.wait_state(
                    lambda state: state.model == "valid" and state.source == "hold", "at rest with a model", LEARNT_S
                )
                learnt = time.monotonic()
                first_goal(client)
                reached = time.monotonic()
                memory = {role: memory_of(pid) for role, pid in sorted(_processes(daemon.process.pid, info.cell))}
            code = daemon.stop()
    except (ClientError, DaemonError) as error:
        raise ExperimentError("startup", f"the {name} start: {error}; {text.read_text()[-2000:]}") from error
    if code != 0:
        raise ExperimentError("startup", f"the daemon ended with exit code {code}: {text.read_text()[-2000:]}")
    ended = {line["process"]: line for line in _lines(log) if "cpu_s" in line}
    cpu = {process: line["cpu_s"] for process, line in ended.items()}
    spent = {
        "preparation_cpu_s": cpu["cell_preparation"],
        "compilation_cpu_s": cpu["kernel_compilation"],
        "others_cpu_s": others,
    }
    return {
        "ready_s": ready - began,
        "calibrating_s": calibrating - began,
        "compiled_s": compiled - began,
        "learnt_s": learnt - began,
        "first_goal_s": reached - began,
        **spent,
        "cpu_s": sum(spent.values()),
        "peak_mb": {name: ended[name]["peak_mb"] for name in ("cell_preparation", "kernel_compilation")},
        "memory_mb": memory,
        "cycles": state.loop.cycles,
        "overruns": state.loop.overruns,
    }


def first_goal(client: Client) -> None:
    """Teach the set-points seen now, move the first joint aside, and return to them. Raises ClientError."""
    client.teach("startup")
    joint, position = next(iter(client.joints().items()))
    client.goal({joint: position + ASIDE}).reached()
    client.goal("startup").reached()


def _processes(daemon: int, cell: str) -> Iterator[tuple[str, int]]:
    """Role and id of each live process of a cell, those that compile aside."""
    yield "supervisor", daemon
    found = processes_of(cell_directories(cell).runtime)
    yield from ((role, pid) for role, pid in found.items() if role != "kernel_compilation")


def memory_of(pid: int) -> dict[str, float]:
    """Memory of a process [MB]: resident, and with its share of what other processes use, too."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    kilobytes = {key: float(value.split()[0]) for key, _, value in (line.partition(":") for line in lines[1:])}
    return {name.lower(): round(kilobytes[name] / 1024.0, 1) for name in ("Rss", "Pss")}


def _cpu_of(pid: int) -> float:
    """CPU seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _children_cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def compiled_kernels(log: Path) -> list[dict[str, Any]]:
    """The kernels compiled by the processes with this log, the longest first. ``repeated``: a signature that two
    processes compiled, or one kernel of this package that was compiled for two signatures.

    numba compiles its own functions, such as ``np.zeros``, in each process; they are not cached.
    """
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for line in _lines(log):
        if "kernel" in line:
            found[f"{line['module']}.{line['kernel']}"].append(line)
    rows = [
        {
            "kernel": name,
            "module": those[0]["module"],
            "signatures": len(those),
            "repeated": name.startswith("stereoservo") and len(those) > 1,
            "seconds": sum(line["seconds"] for line in those),
            "processes": sorted({line["process"] for line in those}),
        }
        for name, those in found.items()
    ]
    return sorted(rows, key=lambda row: -row["seconds"])


def modules_of(kernels: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Signatures and CPU seconds of `compiled_kernels` by module, the longest first; numba's modules as one."""
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in kernels:
        module = row["module"] if row["module"].startswith("stereoservo") else "numba"
        found[module].append(row)
    sums = [
        {"module": name} | {key: sum(row[key] for row in rows) for key in ("signatures", "seconds")}
        for name, rows in found.items()
    ]
    return sorted(sums, key=lambda row: -row["seconds"])


def _lines(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def _commands(repetitions: int, progress: ProgressCall) -> dict[str, Any]:
    """CPU seconds of commands."""
    calls = {"python -c pass": ["-c", "pass"]}
    calls |= {" ".join(words): ["-m", "stereoservo.cli.main", *words] for words in COMMANDS}
    found = {}
    for k, (name, arguments) in enumerate(calls.items()):
        samples = []
        for _ in range(repetitions + 1):
            before = _children_cpu()
            subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)
            samples.append(_children_cpu() - before)
        found[name] = summary(samples[1:], digits=3)  # the first one writes bytecode
        progress("commands", k + 1, len(calls))
    return found


def show_startup(figures: dict[str, Any], console: Console) -> dict[str, Any]:
    """Print the tables of compiled kernels and of their modules; returns the rest of the figures."""
    table = Table("kernel", "signatures", "seconds", "processes", box=None)
    for row in figures["kernels"]:
        table.add_row(row["kernel"], str(row["signatures"]), f"{row['seconds']:.2f}", " ".join(row["processes"]))
    console.print(table)
    sums = Table("module", "signatures", "seconds", box=None)
    for row in figures["modules"]:
        sums.add_row(row["module"], str(row["signatures"]), f"{row['seconds']:.2f}")
    console.print(sums)
    return {key: value for key, value in figures.items() if key not in ("kernels", "modules")}
