"""``stereoservo demo``: calibrates the simulated cell, teaches goals and reaches them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import msgspec
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.learning import LearningLines, tenths
from stereoservo_sim.cells import CELLS, shipped_cell_path
from stereoservo_sim.demonstration.emulated import (
    has_emulated_cameras,
    has_emulated_drives,
    with_mechanics,
)
from stereoservo_sim.demonstration.progress import DemoFailedError, DemonstrationProgress
from stereoservo_sim.world.presets import MechanicsPreset

if TYPE_CHECKING:
    from stereoservo_sim.world.simulated_cell import SimulatedCell

# Names only, so that --help imports nothing numerical.
MechanicsChoice = StrEnum("MechanicsChoice", {name: name for name in get_args(MechanicsPreset)})  # type: ignore[misc]


def demo(
    json: Annotated[bool, typer.Option("--json", help="Print exactly one JSON object on stdout.")] = False,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="One process on a virtual clock: deterministic given the seed.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of the simulated noise.")] = 0,
    out: Annotated[
        Path, typer.Option("--out", help="Directory for report, recording and model (made where missing).")
    ] = Path("stereoservo-demo"),
    cell: Annotated[
        str,
        typer.Option("--cell", metavar="NAME|PATH", help=f"{', '.join(CELLS)}, or a .toml file of a simulated cell."),
    ] = CELLS[0],
    law: Annotated[
        str | None,
        typer.Option("--law", help="Of the first goal, in place of its own: a law that is installed."),
    ] = None,
    mechanics: Annotated[
        MechanicsChoice | None,
        typer.Option(
            "--mechanics",
            help="The arm's gears, bearings and encoders, by how such joints really are: strain_wave (ripple, encoder "
            "on the motor), planetary_qdd (play, compliance), serial_servo (play, sag, 12-bit encoder on the joint). "
            "Default: the cell's, which is perfect where it states none.",
        ),
    ] = None,
) -> None:
    """Calibrate an uncalibrated simulated cell through its rendered images, show it goals, and reach them."""
    from stereoservo.control.law_registry import LAWS, UnknownLawError
    from stereoservo_sim.demonstration.results import summary
    from stereoservo_sim.demonstration.runner import conduct_live, conduct_lockstep
    from stereoservo_sim.demonstration.scenario import shown_goals
    from stereoservo_sim.world.conveyor import ConveyorError, conveyor_of

    try:
        path = Path(cell) if cell.endswith(".toml") else shipped_cell_path(cell)
        file = load_cell_file(path)
        truth = _checked(file, path.parent, lockstep)
        conveyor = conveyor_of(file)
    except (ValueError, ConveyorError) as error:
        raise typer.BadParameter(str(error), param_hint="--cell") from error
    if law is not None and law not in LAWS:
        raise typer.BadParameter(str(UnknownLawError(law, tuple(LAWS))), param_hint="--law")
    out.mkdir(parents=True, exist_ok=True)
    if mechanics is not None:
        try:
            path = with_mechanics(path, out, mechanics.value)
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint="--mechanics") from error
    first, *others = shown_goals(truth, on_belt=conveyor is not None)
    goals = (first if law is None else replace(first, law=law), *others)
    conduct = conduct_lockstep if lockstep else conduct_live
    started = time.monotonic()
    with _telling() as stage:
        demonstration = conduct(path, out.resolve(), seed, stage, goals)
    result = summary(demonstration, seconds=time.monotonic() - started)
    if json:
        sys.stdout.write(msgspec.json.encode(result).decode() + "\n")
        sys.stdout.flush()
    else:
        _print(result)
    if not result["converged"]:
        if json:
            raise SystemExit(1)
        raise DemoFailedError(f"{'; '.join(result['problems'])}; report: {result['report']}")


def _checked(cell: CellFile, folder: Path, lockstep: bool) -> SimulatedCell:
    """Ground truth of a cell that can be demonstrated and evaluated. Raises ValueError."""
    from stereoservo_sim.demonstration.truth import true_cell

    truth = true_cell(cell, folder)
    emulated = has_emulated_drives(cell)
    streams = [camera.name for camera in cell.camera if camera.driver == "video"]
    if streams and not has_emulated_cameras(cell):
        raise ValueError(
            f"cell {cell.cell.name!r} has real cameras ({', '.join(streams)}); the demonstration needs emulated ones: "
            "[emulate.cameras]"
        )
    if streams and lockstep:
        raise ValueError(
            f"cell {cell.cell.name!r} has cameras that are streams in real time; lockstep has a virtual clock: leave "
            f"--lockstep out, or take a cell with simulated cameras, e.g. {CELLS[0]}"
        )
    if emulated and lockstep:
        raise ValueError(
            f"cell {cell.cell.name!r} drives a CAN bus, which runs in real time; lockstep has a virtual clock: leave "
            f"--lockstep out, or take a cell without [emulate.drives], e.g. {CELLS[0]}"
        )
    if cell.joints.driver == "canopen" and not emulated:
        raise ValueError(
            f"cell {cell.cell.name!r} drives real hardware; the demonstration needs emulated drives: [emulate.drives]"
        )
    return truth


@contextmanager
def _telling() -> Iterator[DemonstrationProgress]:
    """Reporter of progress: a bar on a terminal, plain lines elsewhere; both on stderr."""
    console = Console(stderr=True)
    if not console.is_terminal:
        tell_line = _line(console)
        yield DemonstrationProgress(tell_line, tenths(tell_line), LearningLines(tell_line))
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("stereoservo demo", total=1.0)

        def tell(text: str) -> None:
            bar.console.print(text, highlight=False, soft_wrap=True)
            bar.update(task, description=text[:60])

        yield DemonstrationProgress(
            tell,
            lambda fraction: bar.update(task, completed=fraction),
            lambda state: bar.update(task, description=state.picture),
        )


def _line(console: Console) -> Callable[[str], None]:
    start = time.monotonic()
    return lambda text: console.print(f"{time.monotonic() - start:6.1f} s  {text}", highlight=False, soft_wrap=True)


def _print(result: dict[str, Any]) -> None:
    console = Console()
    calibration = result["calibration"]
    console.print(
        f"calibration: residual {calibration['rms_px']:.4f} px over {calibration['images']} images, chi-square "
        f"{calibration['chi2']:.0f} for {calibration['degrees_of_freedom']} degrees of freedom",
        highlight=False,
    )
    table = Table("goal", "law", "turn °", "way mm", "error px", "error mm", "off line mm", "s", "outcome", box=None)
    for goal in result["goals"]:
        table.add_row(
            goal["name"], goal["law"], f"{goal['rotation_deg']:.0f}", f"{goal['distance_mm']:.0f}",
            f"{goal['final_error_px']:.3f}", f"{goal['final_error_mm']:.3f}", f"{goal['max_line_deviation_mm']:.2f}",
            f"{goal['seconds']:.1f}", goal["outcome"],
        )  # fmt: skip
    console.print(table)
    for goal in result["goals"]:
        steady = goal.get("steady")
        if steady is not None and steady["met_s"] is not None:
            console.print(
                f"goal {goal['name']}: met after {steady['met_s']:.1f} s on a part at {steady['speed_mm_s']:.0f} mm/s, "
                f"and held for {steady['seconds']:.1f} s: {steady['rms_px']:.2f} px rms, {steady['largest_px']:.2f} px "
                f"and {steady['largest_mm']:.2f} mm at most off the truth",
                highlight=False,
                soft_wrap=True,
            )
    console.print(f"report: {result['report']}", highlight=False, soft_wrap=True)
