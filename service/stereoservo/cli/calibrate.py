"""``stereoservo calibrate``: by the running daemon, or by one that is started for it."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from stereoservo.cli.output import CellArgument, EndpointOption, JsonOption, OperatorOption, emit, note
from stereoservo.gateway.client import Client
from stereoservo.gateway.messages import CalibrationResult, EventMessage
from stereoservo.runtime.daemon import DaemonProcess, NotRunningError, find_daemon

TRIALS_SHARE = 0.9


def calibrate(
    cell: CellArgument,
    endpoint: EndpointOption = None,
    operator: OperatorOption = None,
    json: JsonOption = False,
) -> None:
    """Move each joint alone, watch the markers, fit the cell's model. Ctrl-C stops the arm.

    With the path of a cell file and no daemon running, one is started for the time of it.
    """
    with ExitStack() as stack:
        if endpoint is None and cell.endswith(".toml"):
            try:
                find_daemon(cell)
            except NotRunningError:
                note("no daemon runs for this cell: starting one")
                stack.enter_context(DaemonProcess(Path(cell))).wait_ready()
        client = stack.enter_context(Client(cell, endpoint=endpoint, operator=operator))
        if client.status().lifecycle == "inactive":
            client.enable()
        try:
            result = _calibrate(client)
        except KeyboardInterrupt:
            client.stop()
            raise
    emit(result, _table(result), json)


def _calibrate(client: Client) -> CalibrationResult:
    console = Console(file=sys.stderr)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("trial motions", total=1.0)

        def progress(event: EventMessage) -> None:
            if event.kind == "warning":
                note(event.message)
            if event.progress is None:
                return
            fitting = event.kind.startswith("fit")
            done = (
                TRIALS_SHARE + (1 - TRIALS_SHARE) * event.progress
                if fitting
                else TRIALS_SHARE * event.progress
            )
            bar.update(task, completed=done, description=event.message or "trial motions")

        return client.calibrate(progress)


def _table(result: CalibrationResult) -> str:
    lines = [
        f"model epoch {result.epoch} ({result.stratum}): {result.rms_px:.4f} px rms over "
        f"{result.measurements} "
        f"measurements, {result.outliers} left out, chi-square "
        f"{'as expected' if result.covariance_ok else 'NOT as expected'}",
        *(f"  {name:16} {rms:.4f} px" for name, rms in result.per_joint_px.items()),
        f"  {result.model}",
    ]
    return "\n".join(lines)
