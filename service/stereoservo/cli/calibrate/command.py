"""Command ``stereoservo calibrate``: calibrates a cell through its daemon (started if needed), checks its model by a
short motion, or fits stored trial data or recorded images.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from stereoservo.cli import interruption
from stereoservo.cli.output import (
    CELL_OPTIONS,
    EXIT_FAILED,
    CellOptions,
    CommandError,
    cells_beginning,
    emit,
    log,
    log_hold,
)
from stereoservo.client import Client, FailedError
from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import DaemonProcess, NotRunningError, find_daemon
from stereoservo.messages.wire import CalibrationResult, EventMessage

TRIALS_SHARE = 0.9
SHOWN_CHECKS = 8


@dataclass(frozen=True)
class CalibrateOptions:
    """What is calibrated or checked, and from which data, as options of the command line."""

    cell: Annotated[
        str,
        typer.Argument(
            metavar="CELL",
            help="Name of a live cell, or path of a cell file (*.toml); none with --rig and --board.",
            autocompletion=cells_beginning,
        ),
    ] = ""
    check: Annotated[bool, typer.Option("--check", help="A short check motion: does the model in use still hold?")] = (
        False
    )
    quick: Annotated[
        bool, typer.Option("--quick", help="With --check: at most 3 s of motion, around the present posture.")
    ] = False
    reset_zeros: Annotated[
        bool,
        typer.Option(
            "--reset-zeros",
            help="With --check: where joint zeros have drifted, and nothing else, a new model with moved zeros.",
        ),
    ] = False
    unattended: Annotated[
        bool,
        typer.Option(
            "--unattended",
            help="With --check, for timers: enable nothing, disturb nobody; exit code 1 where the model does not hold.",
        ),
    ] = False
    undo_refinement: Annotated[
        bool,
        typer.Option(
            "--undo-refinement",
            help="The calibrated model again, in place of one refined from it on-line; nothing moves.",
        ),
    ] = False
    trials: Annotated[
        Path | None, typer.Option("--trials", metavar="FILE.npz", help="Fit stored trial data again; nothing moves.")
    ] = None
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="DIR",
            help="Fit trial motions recorded by `record --images`, with the cell file's detectors; nothing moves.",
        ),
    ] = None
    lines: Annotated[
        Path | None,
        typer.Option(
            "--lines",
            metavar="FILE.csv",
            help="With --trials: pixels along straight lines (camera,line,u,v) that show the lens.",
        ),
    ] = None
    lines_sigma: Annotated[float, typer.Option(help="Noise of the pixels along lines [px].")] = 0.3
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            metavar="FILE.json",
            help="With --trials, --images: where the model goes; with --rig: the cameras (default: rig.json).",
        ),
    ] = None
    enable: Annotated[
        bool,
        typer.Option("--enable", help="Switch the drives on first; else a cell whose drives are off is left alone."),
    ] = False
    rig: Annotated[
        bool,
        typer.Option(
            "--rig",
            help="Calibrate the cameras without an arm, by a body that is waved by hand: CELL.toml's cameras live, or "
            "--images of a recording, or of a folder a camera with pictures of one name for one place.",
        ),
    ] = False
    board: Annotated[
        str, typer.Option("--board", metavar="COLUMNSxROWS", help="With --rig: inner corners of a chessboard, 9x6.")
    ] = ""
    pitch: Annotated[
        float | None, typer.Option("--pitch", metavar="METRES", help="With --board: distance of its corners [m].")
    ] = None
    layout: Annotated[
        Path | None,
        typer.Option(
            "--layout", metavar="FILE.csv", help="With --rig: id,x,y [m] of a flat body's markers, where measured."
        ),
    ] = None
    length: Annotated[
        str,
        typer.Option(
            "--length", metavar="ID,ID=METRES", help="With --rig: distance of two markers of a body of unknown layout."
        ),
    ] = ""
    seconds: Annotated[float, typer.Option("--seconds", help="With --rig, live: how long to watch [s].")] = 60.0


CALIBRATE_OPTIONS = CalibrateOptions()


def calibrate(given: CalibrateOptions = CALIBRATE_OPTIONS, options: CellOptions = CELL_OPTIONS) -> None:
    """Move each joint alone, watch the markers, fit the cell's model. Ctrl-C stops the arm.

    With the path of a cell file and no daemon running, one is started for the time of it, and its drives are switched
    on. Of a daemon that runs, a person has enabled the drives before, or gives ``--enable``. With ``--rig`` no arm is
    needed, and nothing moves.
    """
    cell, trials, images = given.cell, given.trials, given.images
    if given.rig:
        from stereoservo.cli.calibrate.rig import calibrate_cameras  # imports OpenCV and more

        options.emit(*calibrate_cameras(given))
        return
    if given.board or given.pitch is not None or given.layout is not None or given.length:
        raise CommandError("argument", "--board, --pitch, --layout and --length go with --rig")
    if not cell:
        raise typer.BadParameter("CELL is needed, but for --rig with pictures of a board", param_hint="CELL")
    if given.undo_refinement:
        if given.check or trials is not None or images is not None:
            raise CommandError("argument", "--undo-refinement goes with no other option")
        with options.client(cell) as client:
            reply = client.undo_refinement()
        options.emit(msgspec.to_builtins(reply), reply.message)
        return
    if (given.reset_zeros or given.unattended or given.quick) and not given.check:
        raise CommandError("argument", "--reset-zeros, --unattended and --quick go with --check")
    if given.reset_zeros and given.quick:
        raise CommandError("argument", "zeros are reset by the whole check: --reset-zeros goes without --quick")
    if (trials is not None or images is not None) and given.check:
        raise CommandError("argument", "--check moves the arm, --trials and --images do not: give one of them")
    if trials is not None and images is not None:
        raise CommandError("argument", "--trials and --images: one of them")
    if images is not None:
        if given.lines is not None:
            raise CommandError("argument", "--lines go with --trials; --images keeps its trial data for that")
        from stereoservo.cli.calibrate.stored_trials import fit_images, source_of_images  # imports OpenCV and more

        from_images = fit_images(cell, images, given.output)
        options.emit(from_images, f"{_table(from_images)}\n{source_of_images(from_images)}")
        return
    if trials is not None:
        from stereoservo.cli.calibrate.stored_trials import fit_stored_trials, source_of_stored

        result = fit_stored_trials(cell, trials, given.lines, given.lines_sigma, given.output)
        options.emit(result, f"{_table(result)}\n{source_of_stored(result)}")
        return
    if given.lines is not None or given.output is not None:
        raise CommandError("argument", "--lines and --output go with --trials FILE.npz, --output with --images too")
    _calibrate_live(given, options)


def _calibrate_live(given: CalibrateOptions, options: CellOptions) -> None:
    """Calibrate or check the cell's model by motions of the arm, and print the result."""
    enable = given.enable
    with ExitStack() as stack:
        if not given.unattended and options.endpoint is None and given.cell.endswith(".toml"):
            try:
                find_daemon(given.cell)
            except NotRunningError:
                log("no daemon runs for this cell: starting one, and switching the drives on")
                enable = True
                stack.enter_context(DaemonProcess(Path(given.cell))).wait_ready()
        client = stack.enter_context(options.client(given.cell, interruption.check))
        if given.unattended:
            _must_be_idle(client)
        else:
            _enabled(client, enable)
        try:
            if given.reset_zeros:
                _reset_zeros(client, options.json)
                return
            if given.check:
                report = _with_bar(client, "check motion", partial(client.check_model, quick=given.quick))
                _print_check(report, client.cell, options.endpoint, options.json)
                if given.unattended and report.status == "recalibrate":
                    raise typer.Exit(EXIT_FAILED)
                return
            result = _with_bar(client, "trial motions", lambda progress: client.calibrate(progress, report=True))
        except KeyboardInterrupt:
            client.stop()
            raise
        except FailedError as error:
            raise _failure(error) from error
    options.emit(result, _table(result))


def _table(result: CalibrationResult) -> str:
    """A calibration's result as lines of text."""
    lines = [
        f"model epoch {result.epoch} ({result.stratum}): {result.rms_px:.4f} px rms over "
        f"{result.measurements} "
        f"measurements, {result.outliers} left out, chi-square "
        f"{'as expected' if result.covariance_ok else 'NOT as expected'}",
        *(f"  {name:16} {rms:.4f} px" for name, rms in result.per_joint_px.items()),
        f"  {result.verdict}",
        f"  model  {result.model}",
        f"  report {result.report or 'none could be written'}",
        f"  figures {result.figures}",
    ]
    return "\n".join(lines)


def _failure(error: FailedError, **data: Any) -> CommandError:
    """Error with the cause's own code and, if the motion ended early, the reasons with their values."""
    if error.event.reasons:
        data["reasons"] = msgspec.to_builtins(error.event.reasons)
    return CommandError(error.code, str(error), **data)


def _enabled(client: Client, enable: bool) -> None:
    """Check that the drives are on. Raises CommandError if they are off and enabling was not requested."""
    if client.status().lifecycle != "inactive":
        return
    if not enable:
        raise CommandError(
            "not_enabled",
            f"the drives of cell {client.cell!r} are off, and calibrating moves the arm: see that nobody is near it, "
            f"then `stereoservo enable {client.cell}`, or calibrate with --enable",
            lifecycle="inactive",
        )
    client.enable()


def _must_be_idle(client: Client) -> None:
    state = client.status()
    if state.lifecycle != "active" or state.source != "hold":
        doing = f"works ({state.source}{f' {state.goal}' if state.goal else ''})"
        raise CommandError(
            "not_idle",
            f"no check: the cell is {state.lifecycle if state.lifecycle != 'active' else doing}; an unattended check "
            "waits for nothing and enables nothing. Enable the cell, or choose another hour",
            lifecycle=state.lifecycle,
            source=state.source,
        )


def _with_bar(client: Client, what: str, run: Any) -> Any:
    console = Console(file=sys.stderr)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    if not console.is_terminal:
        return run(_telling(client.cell, _lines(what)))
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(what, total=1.0)
        return run(_telling(client.cell, lambda done, told: bar.update(task, completed=done, description=told or what)))


def _lines(what: str) -> Callable[[float, str], None]:
    """Progress as plain lines on stderr, one each tenth."""
    said = -1

    def tell(done: float, told: str) -> None:
        nonlocal said
        if int(10 * done) > said:
            said = int(10 * done)
            log(f"{what}: {100 * done:.0f} %{f': {told}' if told else ''}")

    return tell


def _telling(cell: str, tell: Callable[[float, str], None]) -> Callable[[EventMessage], None]:
    """Event handler that passes progress, 0 to 1 with its message, to ``tell``, and prints warnings and holds."""

    def progress(event: EventMessage) -> None:
        log_hold(event.kind, event.message, cell)
        if event.kind == "warning" or (event.kind == "calibration_report" and event.accepted is False):
            log(event.message)
        if event.progress is None:
            return
        fitting = event.kind.startswith("fit")
        share = 1 - TRIALS_SHARE if fitting else TRIALS_SHARE
        tell((TRIALS_SHARE if fitting else 0.0) + share * event.progress, event.message)

    return progress


# -- check --------------------------------------------------------------------------------------------------


def _print_check(report: CheckReport, cell: str, endpoint: str | None, json: bool) -> None:
    """Print the report of a check, with earlier checks if they are stored on this host."""
    from stereoservo.daemon.jobs.check_job import load_checks  # imports numpy and more

    past = load_checks(cell_directories(cell).checks)[0][-SHOWN_CHECKS:] if endpoint is None else [report]
    history = [
        {"created": one.created, "epoch": one.model_epoch, "status": one.status, "sigmas": one.sigmas,
         "rms_px": one.rms_px, "causes": [cause.message for cause in one.causes]}
        for one in past
    ]  # fmt: skip
    tree = {**msgspec.to_builtins(report), "holds": report.status != "recalibrate", "history": history}
    lines = [report.message]
    lines += [f"  {report.trend}"] if report.trend else []
    for what, values in (("joint", report.per_joint), ("camera", report.per_camera)):
        lines += [f"  {what:6} {name:16} {value:.2f} sigmas" for name, value in values.items()]
    worst = sorted(report.per_marker.items(), key=lambda item: -item[1])[:3]
    lines.append("  markers, worst first: " + ", ".join(f"{name} {value:.2f}" for name, value in worst) + " sigmas")
    if len(history) > 1:
        lines.append("  checks so far:")
        lines += [f"    {one.created}  epoch {one.model_epoch}  {one.sigmas:6.2f} sigmas  {one.status}" for one in past]
    emit(tree, "\n".join(lines), json)


def _reset_zeros(client: Client, json: bool) -> None:
    """Check the model, and reset joint zeros; prints the check in any case. Raises CommandError with the refusal's
    code.
    """
    checks: list[CheckReport] = []

    def reset(progress: Callable[[EventMessage], None]) -> ZeroReset:
        def on_event(event: EventMessage) -> None:
            if event.check is not None:
                checks.append(event.check)
            progress(event)

        return client.reset_zeros(on_event)

    try:
        done: ZeroReset = _with_bar(client, "check motion", reset)
    except FailedError as error:
        data = {"check": msgspec.to_builtins(checks[-1])} if checks else {}
        raise _failure(error, **data) from error
    tree = {"check": msgspec.to_builtins(checks[-1]), "reset": msgspec.to_builtins(done)}
    emit(tree, f"{checks[-1].message}\n{done.message}\n  model {done.model}", json)
