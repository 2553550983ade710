"""Command ``stereoservo run``: runs the daemon of a cell (servo loop, cameras, gateway) until it is terminated."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoservo.cli.output import CommandError, JsonOption, emit, log, shipped_or_path
from stereoservo.messages.servo_state import COMMISSIONING_SPEED

if TYPE_CHECKING:
    from stereoservo.daemon.ipc_messages import RunPlan


def run(
    cell: Annotated[
        str, typer.Argument(metavar="NAME|PATH", help="A cell file (.toml), or the name of a shipped one.")
    ],
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Compute everything, write nothing to the drives.")
    ] = False,
    commissioning: Annotated[
        bool, typer.Option("--commissioning", help=f"Cap speed at {COMMISSIONING_SPEED:.0%} of the cell's.")
    ] = False,
    record: Annotated[
        str, typer.Option("--record", metavar="FILE", help="Record the flight; 'auto' names the file itself.")
    ] = "",
    seed: Annotated[int, typer.Option("--seed", help="Seed for simulated drivers.", min=0, max=(1 << 63) - 1)] = 0,
    json: JsonOption = False,
) -> None:
    """Run a cell until SIGTERM or Ctrl-C; either ends it with the arm stopped."""
    from stereoservo.daemon.supervisor import run_cell

    def ready(plan: RunPlan) -> None:
        mode = " (dry run: nothing is written to the drives)" if dry_run else ""
        log(f"cell {plan.cell.cell.name!r} is up{mode}")

    path = shipped_or_path(cell)
    file = record if record in ("", "auto") else str(Path(record).absolute())
    if file not in ("", "auto") and Path(file).exists():
        raise CommandError("exists", f"{file} exists already; a recording is not written over")
    ended_by = run_cell(path, seed=seed, dry_run=dry_run, commissioning=commissioning, record=file, on_ready=ready)
    if ended_by == signal.SIGINT:
        raise KeyboardInterrupt
    emit({"cell": str(path), "ended_by": signal.Signals(ended_by).name if ended_by else ""}, "", json)
