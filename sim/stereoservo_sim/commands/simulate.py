"""``stereoservo simulate TASKS.csv``: runs alignment tasks in closed loop and evaluates them against ground truth."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from rich.console import Console
from rich.table import Table

from stereoservo.messages.goals import DEFAULT_LAW
from stereoservo.ports import plugins
from stereoservo_sim.progress import progress_bar
from stereoservo_sim.tasks.options import DEFAULT_GAIN, DEFAULT_RATE_HZ, FRAMES, STOPS, SettingsError
from stereoservo_sim.world.presets import MechanicsPreset

if TYPE_CHECKING:
    from stereoservo_sim.tasks.closed_loop import LoopSettings
    from stereoservo_sim.tasks.task_file import AlignmentTask

# Names only, so that --help imports no law, and nothing numerical.
LawOption = StrEnum("LawOption", {name: name for name in plugins.names(plugins.LAWS)})  # type: ignore[misc]
LAW = LawOption(DEFAULT_LAW)
MechanicsChoice = StrEnum("MechanicsChoice", {name: name for name in get_args(MechanicsPreset)})  # type: ignore[misc]


class ArmOption(StrEnum):
    """Values of --arm."""

    FREE = "free"
    RX90 = "rx90"
    TWIST = "twist"


class CalibrationOption(StrEnum):
    """Values of --calibration."""

    SELF = "self"
    EXACT = "exact"
    COARSE = "coarse"


class JacobianOption(StrEnum):
    """Values of --jacobian."""

    CURRENT = "current"
    DESIRED = "desired"
    MEAN = "mean"
    FIXED_DEPTH = "fixed-depth"


class PointsOption(StrEnum):
    """Values of --points."""

    PREDICTED = "predicted"
    TRIANGULATED = "triangulated"


TaskFile = Annotated[Path | None, typer.Argument(metavar="TASKS.csv", help="A task file; or --draw.")]
ArmChoice = Annotated[
    ArmOption,
    typer.Option(
        help="free: six Cartesian generators; rx90: six revolute joints; twist: the same arm behind an "
        "interface of Cartesian velocities."
    ),
]
Draw = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=100_000,
        help="In place of a file: so many random tasks, up to 150° and 0.4 m, by --seed.",
    ),
]


@dataclass(frozen=True)
class SimulateOptions:
    """Options of the command; each field is one of the command line."""

    tasks: TaskFile = None
    arm: ArmChoice = ArmOption.FREE
    calibration: Annotated[
        CalibrationOption,
        typer.Option(
            help=f"self: learnt once from trial motions, {STOPS} stops a joint, {FRAMES} frames averaged at each; "
            "exact: from the truth; coarse: metric, with 10 % focal and 5° hand-eye error."
        ),
    ] = CalibrationOption.SELF
    law: Annotated[LawOption, typer.Option(help="The law.")] = LAW
    jacobian: Annotated[JacobianOption, typer.Option(help="Of laws in the images.")] = JacobianOption.MEAN
    centre: Annotated[
        str, typer.Option(help="Point that goes straight: middle (of the markers), or a marker, 0 to 3.")
    ] = "middle"
    points: Annotated[
        PointsOption, typer.Option(help="predicted by kinematics and corrected, or triangulated anew.")
    ] = PointsOption.PREDICTED
    gain: Annotated[float, typer.Option(help="[1/s]")] = DEFAULT_GAIN
    rate: Annotated[float, typer.Option(help="Of the loop [Hz].")] = DEFAULT_RATE_HZ
    noise_px: Annotated[float, typer.Option(help="Standard deviation of each pixel coordinate [px].")] = 0.1
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of everything random.")] = 0
    jobs: Annotated[
        int,
        typer.Option(min=0, max=256, help="Processes; the results do not depend on it [0: one a processor]."),
    ] = 0
    drop_camera: Annotated[
        str | None,
        typer.Option(metavar="START:SECONDS", help="The second camera is dropped for a time [s]."),
    ] = None
    mechanics: Annotated[
        MechanicsChoice | None,
        typer.Option(help="Of the arm rx90: gears and encoders as such joints have them; docs/simulation.md."),
    ] = None
    law_only: Annotated[
        bool,
        typer.Option(help="The law alone, without goal, monitors and safety stage; the arm free has no others."),
    ] = False
    learn: Annotated[
        bool, typer.Option("--learn", help="self: learn again, although a model of the same trial motions is kept.")
    ] = False
    draw: Draw = None
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first so many tasks.")] = None
    ids: Annotated[str | None, typer.Option(help="Only these tasks: ids by commas.")] = None
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False


SIMULATE_OPTIONS = SimulateOptions()


def simulate(given: SimulateOptions = SIMULATE_OPTIONS) -> None:
    """Run every task of a file in closed loop; the controller sees noisy pixels only, the judge the truth.

    The arms rx90 and twist are driven by the servo core, as in the daemon, the arm free by the law alone.
    """
    # Before numpy is loaded by the workers: threads of OpenBLAS only wait for each other on such small matrices.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from stereoservo_sim.kept_models import relearning
    from stereoservo_sim.tasks.closed_loop import LoopSettings

    settings = LoopSettings(
        law=_usable(given.law),
        arm=given.arm.value,
        calibration=given.calibration.value,
        jacobian=given.jacobian.value,
        centre=_centre(given.centre),
        points=given.points.value,
        gain=_within("--gain", given.gain, 1e-3, 50.0),
        rate_hz=_within("--rate", given.rate, 1.0, 10_000.0),
        noise_px=_within("--noise-px", given.noise_px, 0.0, 100.0),
        seed=given.seed,
        drop_camera=_drop(given.drop_camera),
        mechanics=_mechanics(given.mechanics, given.arm),
        core=_by_core(given.arm, given.law_only, given.calibration, given.centre),
    )
    with relearning(given.learn):
        answer = _answer(_given(given.tasks, given.draw, given.seed), given.limit, given.ids, settings, given.jobs)
    answer = {"file": None if given.tasks is None else str(given.tasks), "draw": given.draw, **answer}
    if given.as_json:
        sys.stdout.write(json.dumps(answer, allow_nan=False) + "\n")
    else:
        _show(answer, Console(markup=False, highlight=False))


def _given(file: Path | None, draw: int | None, seed: int) -> tuple[AlignmentTask, ...]:
    """Tasks of a file, or random ones."""
    from stereoservo_sim.tasks.random_tasks import random_tasks
    from stereoservo_sim.tasks.task_file import read_tasks

    if (file is None) == (draw is None):
        raise SettingsError("either a task file or --draw N is needed")
    return random_tasks(seed, draw) if file is None and draw is not None else read_tasks(file)


def _answer(
    tasks: tuple[AlignmentTask, ...], limit: int | None, ids: str | None, settings: LoopSettings, jobs: int
) -> dict[str, Any]:
    """Results of the tasks."""
    from stereoservo_sim.tasks.campaign import default_jobs, run_campaign

    chosen = _chosen(tasks, limit, ids)
    with progress_bar() as progress:
        answer = run_campaign(
            chosen, settings, jobs or default_jobs(), lambda done, total: progress("tasks", done, total)
        )
    return answer


def _usable(law: LawOption) -> str:
    """Name of a law that is installed and can be loaded."""
    from stereoservo.control.law_registry import LAWS

    name = str(law.value)
    if name not in LAWS:
        raise SettingsError(f"--law: {LAWS.unknown(name)}")
    return name


def _mechanics(chosen: MechanicsChoice | None, arm: ArmOption) -> MechanicsPreset | None:
    if chosen is None:
        return None
    if arm is not ArmOption.RX90:
        raise SettingsError(f"--mechanics {chosen.value}: --arm {arm.value} has none; take --arm rx90")
    return chosen.value


def _by_core(arm: ArmOption, law_only: bool, calibration: CalibrationOption, centre: str) -> bool:
    """Whether the servo core drives the arm."""
    if arm is ArmOption.FREE or law_only:
        return False
    if calibration is CalibrationOption.COARSE:
        raise SettingsError("--calibration coarse: the servo core needs a model of the arm; take --law-only")
    if centre != "middle":
        raise SettingsError(f"--centre {centre}: the servo core takes the middle; take --law-only")
    return True


def _centre(text: str) -> str:
    if text not in ("middle", "0", "1", "2", "3"):
        raise SettingsError(f"--centre {text!r}: middle, or a marker from 0 to 3, is needed")
    return text


def _within(name: str, value: float, low: float, high: float) -> float:
    if not low <= value <= high:
        raise SettingsError(f"{name} {value:g}: a number from {low:g} to {high:g} is needed")
    return value


def _drop(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    start, _, duration = text.partition(":")
    try:
        found = float(start), float(duration)
    except ValueError:
        found = (-1.0, -1.0)
    if not all(0.0 <= value < 1e6 for value in found):
        raise SettingsError(f"--drop-camera {text!r}: START:SECONDS, like 2:2, is needed")
    return found


def _chosen(tasks: tuple[AlignmentTask, ...], limit: int | None, ids: str | None) -> tuple[AlignmentTask, ...]:
    if ids is not None:
        by_id = {task.id: task for task in tasks}
        try:
            wanted = dict.fromkeys(int(part) for part in ids.split(","))
        except ValueError:
            raise SettingsError(f"--ids {ids!r}: ids by commas, like 3,14,15, are needed") from None
        unknown = [number for number in wanted if number not in by_id]
        if unknown:
            raise SettingsError(f"--ids: the file has no task {unknown[0]}; it has {len(tasks)} others")
        tasks = tuple(by_id[number] for number in wanted)
    return tasks[:limit]


def _show(answer: dict[str, Any], console: Console) -> None:
    failed = [task for task in answer["tasks"] if task["success"] is False]
    if failed:
        table = Table("id", "reason", "steps", "error px", "back face", "out of view", "off line mm", box=None)
        for task in failed:
            table.add_row(
                str(task["id"]),
                task["refused"] or task["stopped"] or task["reason"],
                str(task["iterations"]),
                _number(task["final_error_px"]),
                str(task["back_face"]),
                str(task["out_of_view"]),
                _number(task["line_deviation_mm"]),
            )
        console.print(table)
    judged = len(answer["tasks"]) - answer["unreachable"]
    rate = "no task can be reached" if answer["success_rate"] is None else f"{answer['success_rate']:.2%}"
    low, high = answer["wilson_95"]
    console.print(
        f"{answer['solved']} of {judged} solved ({rate}; Wilson 95 %: {low:.2%} to {high:.2%}), {answer['refused']} "
        f"refused before moving, {answer['failed_moving']} failed on the way, {answer['unreachable']} out of reach"
    )
    for key, (name, unit) in SHOWN.items():
        if answer[key] is not None:
            console.print(f"{name}: median {answer[key]['median']:.3g}{unit}, max {answer[key]['max']:.3g}{unit}")
    if model := answer["calibration"].get("model"):
        source = f"kept in {model['file']}; --learn learns again" if model["kept"] else "by this command"
        console.print(f"model learnt {model['learnt']}, {source}", soft_wrap=True)
    console.print(f"{answer['seconds']:.1f} s")


SHOWN = {
    "line_deviation_mm": ("deviation from the line", " mm"),
    "final_error_px": ("error at rest", " px"),
    "error_over_floor": ("error at rest over what image noise leaves", ""),
    "rest_mm_s": ("velocity at rest, rms", " mm/s"),
    "rest_mrad_s": ("turn rate at rest, rms", " mrad/s"),
    "iterations": ("steps", ""),
}
"""Names and units of the answer's values, for people."""


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
