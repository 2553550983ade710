"""Command ``stereoservo setup``: from a box of hardware to the first goal, guided in the terminal.

Each step checks itself. What it continues from, when it is run again, is the cell file, the models and taught goals of
the cell, and the note that its joints were commissioned as the file has them.
"""

from __future__ import annotations

import hashlib
import sys
import tomllib
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from stereoservo.cli.doctor.command import examine_file, examine_pictures, line_of
from stereoservo.cli.init import toml_options
from stereoservo.cli.output import CommandError, JsonOption, emit
from stereoservo.cli.setup.commissioning import commission, in_fault, reset_drives
from stereoservo.cli.setup.dialogue import Dialogue, answers_text, read_answers
from stereoservo.cli.setup.first_goal import arm_is_off, calibrated, first_goal, running
from stereoservo.cli.setup.interview import interview
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.gateway.persistence import ModelStore
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.directories import CELL_NAME, CellDirectories, cell_directories, create_directories
from stereoservo.messages.locks import holder
from stereoservo.ports import plugins
from stereoservo.ports.devices import DriverError, ExaminationFinding
from stereoservo.ports.discovery import DriveFinder

WATCH_S = 2.0


def setup(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="The cell file to write, e.g. mycell.toml, or to go on with."),
    ],
    answers: Annotated[
        Path | None,
        typer.Option(
            "--answers", metavar="FILE", help='Answers (KEY = "TEXT" in TOML) instead of a person\'s.'
        ),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(
            "--option", metavar="KEY=VALUE", help="An option of the joint driver, as `init` takes it."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Guide from unknown hardware to a goal: cameras, drives, cell file, checks, first motions, calibration, a goal.

    Nothing moves before a person has said so. What was found wrong is told with its cure, and the same command goes on.
    """
    if file.suffix != ".toml" or not CELL_NAME.fullmatch(file.stem):
        raise CommandError("argument", f"{file}: NAME.toml is valid, NAME of letters, digits, '_' and '-'")
    given = None if answers is None else read_answers(answers)
    extra = tomllib.loads(toml_options(option or []))
    with Dialogue(sys.stderr if json else sys.stdout, given) as dialogue:
        try:
            result = _steps(file, dialogue, extra)
        finally:
            _keep_answers(file, dialogue)
        result |= {
            "cell": file.stem, "file": str(file), "answers": len(dialogue.asked),
            "longest_silence_s": round(dialogue.longest_silence_s, 2),
        }  # fmt: skip
    emit(result, "", json)


def _steps(file: Path, dialogue: Dialogue, extra: dict[str, Any]) -> dict[str, Any]:
    """All steps; returns what the command's JSON holds. Raises CommandError and what the steps raise."""
    dialogue.say(
        f"Setting up {file}. Ctrl-C ends it at any time, and stops the arm; the same command goes on from there.\n"
        "This is no safety function: an emergency stop that takes the drives' power away comes before all of it."
    )
    if file.exists():
        dialogue.say(f"{file} is there already: its cameras and drives are taken as it has them")
    else:
        interview(file, dialogue, extra)
    dialogue.heading("Checks")
    findings: list[ExaminationFinding] = []
    plan, directories = _examined(file, dialogue, findings)
    if holder(directories.daemon_lock) is None:
        _commissioned(plan, directories, dialogue, findings)
    _stop_where_failed(findings, dialogue, file)
    model, _ = ModelStore(directories.models).newest_fitting(plan.settings())
    result: dict[str, Any] = {"checks": findings, "calibration": None}
    dialogue.heading("Calibration and the first goal")
    again = "The cell has a model already. Calibrate anew?"
    fresh = "Each joint is going to move alone, as far as the plate stays in the pictures. Is the arm clear: calibrate?"
    calibrate = dialogue.confirm("calibrate", fresh if model is None else again, False)
    if model is None and not calibrate:
        raise CommandError(
            "not_calibrated", "without a model there is no goal; the same command goes on from here"
        )
    with running(file, directories, dialogue) as client:
        if arm_is_off(client):
            with dialogue.doing("switching the drives on"):
                client.enable()
        if calibrate:
            result["calibration"] = calibrated(client, dialogue)
        result["goal"] = first_goal(client, directories, dialogue)
    dialogue.say(
        f"\nDone. From now on: `stereoservo run {file}`, then `stereoservo goal {plan.cell.cell.name} "
        f"{result['goal']['name']}`; in a browser: `stereoservo web {plan.cell.cell.name}`"
    )
    return result


def _commissioned(
    plan: RunPlan, directories: CellDirectories, dialogue: Dialogue, findings: list[ExaminationFinding]
) -> None:
    """Look at cameras and drives, and move each joint for the first time, unless that was done with this cell file.

    Raises CommandError where nothing is wrong and not every joint was moved.
    """
    sound: list[bool] = [not _failed(findings)]
    _all(examine_pictures(plan, directories, WATCH_S), dialogue, findings, sound)
    if plan.joints.simulated:
        dialogue.say("   the arm is simulated: there is nothing to commission")
        return
    note, mark = directories.state / "setup.json", commissioning_mark(plan.cell)
    if note.is_file() and note.read_text(encoding="utf-8") == mark:
        dialogue.say("   the joints were commissioned before, with cameras and drives as the file has them")
        return
    names = [joint.name for joint in plan.joints.joints]
    found: list[ExaminationFinding] = []
    _all(commission(plan, dialogue, sound, names), dialogue, found, sound)
    fault = in_fault(found)
    if fault is not None and dialogue.confirm(
        "reset", "Is the cause of that fault gone: reset the drives?", False
    ):
        with dialogue.doing("resetting the drives"):
            reset_drives(plan)
        found, sound = [], [not _failed(findings)]
        _all(commission(plan, dialogue, sound, names), dialogue, found, sound)
    findings += found
    moved = {finding.jogged[0] for finding in findings if finding.jogged is not None}
    if _failed(findings):
        return
    if moved == set(names):
        note.write_text(mark, encoding="utf-8")
    elif any(finding.name.endswith(" jog") for finding in findings):
        raise CommandError(
            "not_commissioned", "not every joint was moved; the same command goes on from here"
        )
    elif not dialogue.confirm(
        "unexamined",
        f"Driver {plan.joints.driver!r} moves no joint for setup. Was each tried by itself?",
        False,
    ):
        raise CommandError("not_commissioned", "`stereoservo driver-check --cell FILE --hardware` tries them")


def _examined(
    file: Path, dialogue: Dialogue, findings: list[ExaminationFinding]
) -> tuple[RunPlan, CellDirectories]:
    """The plan of the cell, with the findings on file and computer told."""
    examination = examine_file(file)
    with dialogue.doing("loading drivers and detectors"):
        while True:
            try:
                finding = next(examination)
            except StopIteration as end:
                plan, directories = end.value
                return plan, directories
            except DriverError as error:
                findings.append(ExaminationFinding("drivers", False, str(error)))
                findings += bus_findings(load_cell_file(file))
                _stop_where_failed(findings, dialogue, file)
                raise
            findings.append(finding)
            dialogue.say(line_of(finding))


def bus_findings(cell: CellFile) -> tuple[ExaminationFinding, ...]:
    """Findings on the bus that a cell file names, whose further options its driver refuses: what may be behind that."""
    finder = plugins.load(plugins.JOINT_DRIVERS, cell.joints.driver)
    if not isinstance(finder, DriveFinder):
        return ()
    try:
        return tuple(finder.scan_bus(cell.joints.options).findings)
    except DriverError as error:
        return (ExaminationFinding("bus", False, str(error)),)


def _all(
    found: Generator[ExaminationFinding, None, None],
    dialogue: Dialogue,
    findings: list[ExaminationFinding],
    sound: list[bool],
) -> None:
    """Tell findings as they come."""
    with dialogue.doing("checking"), closing(found):
        for finding in found:
            findings.append(finding)
            sound.append(finding.ok is not False)
            dialogue.say(line_of(finding))


def _failed(findings: list[ExaminationFinding]) -> list[ExaminationFinding]:
    return [finding for finding in findings if finding.ok is False]


def _stop_where_failed(findings: list[ExaminationFinding], dialogue: Dialogue, file: Path) -> None:
    """Raise CommandError with everything that was found wrong, and what to do."""
    failed = _failed(findings)
    if not failed:
        return
    dialogue.heading(
        f"{len(failed)} found wrong; mend {file} or the hardware, then run the same command again"
    )
    for finding in failed:
        dialogue.say(line_of(finding))
    raise CommandError(
        "checks_failed",
        "; ".join(f"{finding.name}: {finding.message}" for finding in failed),
        checks=msgspec.to_builtins(findings),
        answers=len(dialogue.asked),
    )


def commissioning_mark(cell: CellFile) -> str:
    """What of a cell file a commissioning is good for: its drives and their options, its cameras."""
    told = msgspec.json.encode([cell.joints, cell.camera], enc_hook=str, order="sorted")
    return hashlib.sha256(told).hexdigest()


def _keep_answers(file: Path, dialogue: Dialogue) -> None:
    """Write the answers down, to be repeated by --answers."""
    if dialogue.asked:
        directories = cell_directories(file.stem)
        create_directories(directories)
        path = directories.state / "setup-answers.toml"
        path.write_text(answers_text(dialogue.asked), encoding="utf-8")
        dialogue.say(f"   the answers so far: {path}")
