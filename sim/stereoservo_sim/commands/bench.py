"""``stereoservo bench WHAT``: how long things take here, with a baseline in the same run."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console

from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall, progress_bar

Bench = Callable[[int, int, ProgressCall], dict[str, Any]]


def _calibration(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.calibration import run_calibration

    return run_calibration(repetitions, seed, progress)


def _can(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.can import run_can

    return run_can(repetitions, seed, progress)


def _cycle(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.cycle import run_cycle

    return run_cycle(repetitions, seed, progress)


def _detectors(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.photographs.table import run_detectors

    return run_detectors(repetitions, seed, progress)


def _faults(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.faults.bench import run_faults

    return run_faults(repetitions, seed, progress)


def _features(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.features import run_features

    return run_features(repetitions, seed, progress)


def _idle(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.live_loop.idle import run_idle

    return run_idle(repetitions, seed, progress)


def _ik(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.experiments.arms.learnt_postures import run_ik

    return run_ik(repetitions, seed, progress)


def _loop(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.live_loop.loop import run_loop

    return run_loop(repetitions, seed, progress)


def _page(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.live_loop.page import run_page

    return run_page(repetitions, seed, progress)


def _recording(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.recording import run_recording

    return run_recording(repetitions, seed, progress)


def _scale(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.scale import run_scale

    return run_scale(repetitions, seed, progress)


def _soak(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.soak import run_soak

    return run_soak(repetitions, seed, progress)


def _kills(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.service_soak import run_kills

    return run_kills(repetitions, seed, progress)


def _soak_live(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.service_soak import run_soak_live

    return run_soak_live(repetitions, seed, progress)


def _startup(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.startup import run_startup

    return run_startup(repetitions, seed, progress)


def _watch(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.live_loop.watch import run_watch

    return run_watch(repetitions, seed, progress)


def _wire(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    from stereoservo_sim.benchmarks.wire import run_wire

    return run_wire(repetitions, seed, progress)


BENCHES: dict[str, Bench] = {
    "calibration": _calibration,
    "can": _can,
    "cycle": _cycle,
    "detectors": _detectors,
    "faults": _faults,
    "features": _features,
    "idle": _idle,
    "ik": _ik,
    "kills": _kills,
    "loop": _loop,
    "page": _page,
    "recording": _recording,
    "scale": _scale,
    "soak": _soak,
    "soak-live": _soak_live,
    "startup": _startup,
    "watch": _watch,
    "wire": _wire,
}
"""By the name given on the command line."""


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
        run = _find(what)
        # Before numpy is loaded: threads of OpenBLAS only wait for each other on such small matrices.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
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


def _find(what: str) -> Bench:
    if what not in BENCHES:
        known = sorted(BENCHES)
        raise ExperimentError("bench", f"no bench {what!r}; known: {', '.join(known)}", known=known)
    return BENCHES[what]


def _show(answer: dict[str, Any], console: Console) -> None:
    """Print one line a figure, nested names joined by points; tables of faults and of what a start compiles."""
    if answer["bench"] == "detectors":
        from stereoservo_sim.benchmarks.photographs.table import show_detectors

        show_detectors(answer, console)
        answer = {key: value for key, value in answer.items() if key not in ("rows", "left_out")}
    if answer["bench"] == "faults":
        from stereoservo_sim.benchmarks.faults.bench import show_faults

        show_faults(answer, console)
        answer = {
            key: value for key, value in answer.items() if key not in ("rows", "wall", "service", "inputs")
        }
    if answer["bench"] == "startup":
        from stereoservo_sim.benchmarks.startup import show_startup

        show_startup(answer, console)
        answer = {key: value for key, value in answer.items() if key != "kernels"}
    for name, value in _flat(answer, ""):
        console.print(f"{name:<44} {f'{value:.4g}' if isinstance(value, float) else value}", soft_wrap=True)


def _flat(value: Any, name: str) -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [
            line for key, inner in value.items() for line in _flat(inner, f"{name}.{key}" if name else key)
        ]
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [line for k, inner in enumerate(value) for line in _flat(inner, f"{name}[{k}]")]
    return [(name, value)]
