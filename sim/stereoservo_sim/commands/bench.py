"""``stereoservo bench WHAT``: how long things take here, with a baseline in the same run."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Annotated, Any

import typer
from rich.console import Console

from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import progress_bar

BENCHES = {
    "calibration": "stereoservo_sim.benchmarks.calibration:run_calibration",
    "can": "stereoservo_sim.benchmarks.can:run_can",
    "cycle": "stereoservo_sim.benchmarks.cycle:run_cycle",
    "detectors": "stereoservo_sim.benchmarks.photographs:run_detectors",
    "faults": "stereoservo_sim.benchmarks.faults.bench:run_faults",
    "features": "stereoservo_sim.benchmarks.features:run_features",
    "idle": "stereoservo_sim.benchmarks.live_loop:run_idle",
    "ik": "stereoservo_sim.experiments.learnt_postures:run_ik",
    "kills": "stereoservo_sim.benchmarks.soak:run_kills",
    "loop": "stereoservo_sim.benchmarks.live_loop:run_loop",
    "page": "stereoservo_sim.benchmarks.live_loop:run_page",
    "recording": "stereoservo_sim.benchmarks.recording:run_recording",
    "scale": "stereoservo_sim.benchmarks.cycle:run_scale",
    "soak": "stereoservo_sim.benchmarks.soak:run_soak",
    "soak-live": "stereoservo_sim.benchmarks.soak:run_soak_live",
    "startup": "stereoservo_sim.benchmarks.startup:run_startup",
    "watch": "stereoservo_sim.benchmarks.live_loop:run_watch",
    "wire": "stereoservo_sim.benchmarks.wire:run_wire",
}
"""Benches by name: functions of ``(repetitions, seed, progress)`` that return the figures, loaded when run."""
SHOWN = {
    "detectors": "stereoservo_sim.benchmarks.photographs:show_detectors",
    "faults": "stereoservo_sim.benchmarks.faults.bench:show_faults",
    "startup": "stereoservo_sim.benchmarks.startup:show_startup",
}
"""Functions that print part of an answer in a special form, and return the rest."""


def bench(
    what: Annotated[str, typer.Argument(help="Which one: " + ", ".join(BENCHES) + ".")],
    repetitions: Annotated[
        int,
        typer.Option(
            min=1,
            help="Timed fits of `calibration`, trials of each of `faults`, ten of `kills`, two virtual minutes of "
            "`soak`, two real ones of `soak-live`, commands of `startup`, segments of `idle`, pairs of them of `loop`, "
            "`page` and `watch`; the others take a multiple.",
        ),
    ] = 7,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Time one part on this machine, beside a baseline. Nothing is judged: machines are shared and stall."""
    try:
        if what not in BENCHES:
            known = sorted(BENCHES)
            raise ExperimentError("bench", f"no bench {what!r}; known: {', '.join(known)}", known=known)
        # Before numpy is loaded: threads of OpenBLAS only wait for each other on such small matrices.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        run = _loaded(BENCHES[what])
        from stereoservo_sim.benchmarks.timing import machine, stolen_share, stolen_ticks

        before = stolen_ticks()
        with progress_bar() as progress:
            figures = run(repetitions, seed, progress)
    except ExperimentError as error:
        print(f"error: {error}", file=sys.stderr)
        if as_json:
            print(json.dumps({"error": {"code": error.code, "message": str(error), **error.data}}))
        raise typer.Exit(1) from error
    facts = machine()
    facts["stolen_share"] = stolen_share(before, stolen_ticks())
    answer = {"bench": what, "seed": seed, **figures, "machine": facts}
    if as_json:
        print(json.dumps(answer, allow_nan=False))
    else:
        _show(answer, Console(markup=False, highlight=False))


def _loaded(name: str) -> Callable[..., Any]:
    """A function by its module and name."""
    module, _, function = name.partition(":")
    found: Callable[..., Any] = getattr(import_module(module), function)
    return found


def _show(answer: dict[str, Any], console: Console) -> None:
    """Print one line per figure, nested names joined by points; after the bench's own output, if any."""
    if answer["bench"] in SHOWN:
        answer = _loaded(SHOWN[answer["bench"]])(answer, console)
    for name, value in _flat(answer, ""):
        console.print(f"{name:<44} {f'{value:.4g}' if isinstance(value, float) else value}", soft_wrap=True)


def _flat(value: Any, name: str) -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [line for key, inner in value.items() for line in _flat(inner, f"{name}.{key}" if name else key)]
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [line for k, inner in enumerate(value) for line in _flat(inner, f"{name}[{k}]")]
    return [(name, value)]
