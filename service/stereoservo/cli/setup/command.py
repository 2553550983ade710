"""Command ``stereoservo setup``: from unknown hardware to the first goal, guided in the terminal.

Each step checks itself. When it is run again it continues from the cell file, the models and taught goals of the cell,
and the record that its joints were commissioned with this file.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import sys
import time
import tomllib
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from stereoservo.cli import interruption
from stereoservo.cli.doctor.camera_findings import CameraRecord
from stereoservo.cli.doctor.cameras import WatchedCamera
from stereoservo.cli.doctor.cell import examine_file, examine_pictures, line_of
from stereoservo.cli.doctor.joints import examine_joints
from stereoservo.cli.doctor.plate_motion import judge_turn, turn_between
from stereoservo.cli.init import cell_text, toml_lines, toml_options
from stereoservo.cli.output import CommandError, JsonOption, emit, log
from stereoservo.cli.setup.dialogue import Dialogue, answers_text, read_answers
from stereoservo.client import Client, ClientError
from stereoservo.daemon.camera_setup import make_camera
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.pacing import ordinary_for_a_while
from stereoservo.daemon.plant_driver import make_driver
from stereoservo.daemon.taught_goals import load_taught
from stereoservo.gateway.persistence import ModelStore
from stereoservo.messages.addresses import Address
from stereoservo.messages.cell_file import CameraSection, CellFile, load_cell_file
from stereoservo.messages.directories import CELL_NAME, CellDirectories, cell_directories, create_directories
from stereoservo.messages.discovery import DaemonError, DaemonProcess, NotRunningError, find_daemon
from stereoservo.messages.locks import holder
from stereoservo.messages.wire import EventMessage
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, DriverError, ExaminationFinding
from stereoservo.ports.discovery import (
    BusScan,
    CameraFinder,
    DriveFinder,
    FoundBus,
    FoundCamera,
    FoundDrive,
    JointChoice,
)

WATCH_S = 2.0


def setup(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="The cell file to write, e.g. mycell.toml, or to go on with.")
    ],
    answers: Annotated[
        Path | None,
        typer.Option("--answers", metavar="FILE", help='Answers (KEY = "TEXT" in TOML) instead of a person\'s.'),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="KEY=VALUE", help="An option of the joint driver, as `init` takes it."),
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
            "cell": file.stem,
            "file": str(file),
            "answers": len(dialogue.asked),
            "longest_silence_s": round(dialogue.longest_silence_s, 2),
        }
    emit(result, "", json)


def _steps(file: Path, dialogue: Dialogue, extra: dict[str, Any]) -> dict[str, Any]:
    """All steps; returns the command's JSON. Raises CommandError and the errors of the steps."""
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
        raise CommandError("not_calibrated", "without a model there is no goal; the same command goes on from here")
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
    """Check cameras and drives, and move each joint for the first time, unless that was done with this cell file.

    Raises CommandError if no check failed and yet not every joint was moved.
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
    if fault is not None and dialogue.confirm("reset", "Is the cause of that fault gone: reset the drives?", False):
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
        raise CommandError("not_commissioned", "not every joint was moved; the same command goes on from here")
    elif not dialogue.confirm(
        "unexamined", f"Driver {plan.joints.driver!r} moves no joint for setup. Was each tried by itself?", False
    ):
        raise CommandError("not_commissioned", "`stereoservo driver-check --cell FILE --hardware` tries them")


def _examined(file: Path, dialogue: Dialogue, findings: list[ExaminationFinding]) -> tuple[RunPlan, CellDirectories]:
    """The plan of the cell; findings on file and computer are printed."""
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
    """Findings on the bus of a cell file whose other options its driver refuses: possible causes."""
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
    """Print findings as they come."""
    with dialogue.doing("checking"), closing(found):
        for finding in found:
            findings.append(finding)
            sound.append(finding.ok is not False)
            dialogue.say(line_of(finding))


def _failed(findings: list[ExaminationFinding]) -> list[ExaminationFinding]:
    return [finding for finding in findings if finding.ok is False]


def _stop_where_failed(findings: list[ExaminationFinding], dialogue: Dialogue, file: Path) -> None:
    """Raise CommandError with all failed findings, and their remedies."""
    failed = _failed(findings)
    if not failed:
        return
    dialogue.heading(f"{len(failed)} found wrong; mend {file} or the hardware, then run the same command again")
    for finding in failed:
        dialogue.say(line_of(finding))
    raise CommandError(
        "checks_failed",
        "; ".join(f"{finding.name}: {finding.message}" for finding in failed),
        checks=msgspec.to_builtins(findings),
        answers=len(dialogue.asked),
    )


def commissioning_mark(cell: CellFile) -> str:
    """Hash of the parts of a cell file for which a commissioning is valid: drives with options, and cameras."""
    told = msgspec.json.encode([cell.joints, cell.camera], enc_hook=str, order="sorted")
    return hashlib.sha256(told).hexdigest()


def _keep_answers(file: Path, dialogue: Dialogue) -> None:
    """Write the answers to a file, for --answers."""
    if dialogue.asked:
        directories = cell_directories(file.stem)
        create_directories(directories)
        path = directories.state / "setup-answers.toml"
        path.write_text(answers_text(dialogue.asked), encoding="utf-8")
        dialogue.say(f"   the answers so far: {path}")


# -- commissioning -------------------------------------------------------------------------------------------
# Commissioning, joint by joint: each is moved by less than a degree, and three sources are compared: the encoder, the
# pictures, and the joint that the person saw moving.


SHARE = 0.45
"""Share of one degree: with a gear ratio that is wrong by a factor of two the joint still moves by less than one."""
FRAMES = 24
"""Pictures of an observation, averaged to reduce noise."""
LOOK_S = 4.0
POLL_S = 0.002
EYE = re.compile(r"(?P<joint>\S+?)(?P<sense>[+-]?)")


class Cameras:
    """The cell's cameras, open, to observe the plate before and after a motion. A context manager."""

    def __init__(self, plan: RunPlan) -> None:
        self._plan = plan
        self._clock = MonotonicClock()
        self._stack = ExitStack()
        self._watched: list[WatchedCamera] = []

    def __enter__(self) -> Cameras:
        for section, description in zip(self._plan.cell.camera, self._plan.cameras, strict=True):
            driver, detector = make_camera(section, self._plan.driver_context(self._clock, section))
            camera = WatchedCamera(CameraRecord(description), driver, detector)
            self._watched.append(camera)
            try:
                driver.configure()
                driver.activate()
            except DriverError as error:
                camera.record.error = str(error)
        return self

    def __exit__(self, *_: object) -> None:
        for camera in self._watched:
            camera.finish()

    def look(self) -> list[CameraRecord]:
        """Observations of each camera from now on, of ``FRAMES`` new pictures, or as many as arrive."""
        begun_ns = self._clock.now_ns()
        until_ns = begun_ns + round(LOOK_S * 1e9)
        for camera in self._watched:
            camera.record.seen.clear()
        while self._clock.now_ns() < until_ns:
            for camera in self._watched:
                camera.poll()
                seen = camera.record.seen
                while seen and seen[0].t_shutter_ns < begun_ns:
                    seen.pop(0)
            if all(len(camera.record.seen) >= FRAMES or camera.record.error for camera in self._watched):
                break
            time.sleep(POLL_S)
        records = []
        for camera in self._watched:
            record = CameraRecord(camera.record.description, list(camera.record.seen))
            record.error = camera.record.error
            records.append(record)
        return records


def commission(
    plan: RunPlan, dialogue: Dialogue, sound: Sequence[bool], names: Sequence[str]
) -> Generator[ExaminationFinding, None, None]:
    """Findings on the drives, then on each joint's first motion. The person permits the motions once; none is made
    after a failed finding. ``sound``: results of all findings so far; new ones are appended meanwhile.

    ``names``: names of the joints, base first.
    """
    asked: list[bool] = []
    before: list[CameraRecord] = []

    def look() -> list[CameraRecord]:
        with dialogue.doing("looking at the plate"), ordinary_for_a_while():
            return cameras.look()

    def may_move(_question: str) -> float:
        if not all(sound):
            return 0.0
        if not asked:
            dialogue.heading("The first motion")
            dialogue.say(
                f"Each joint is going to be enabled, moved by {SHARE:g} degrees (a slide: {2 * SHARE:g} mm), slowly, "
                "looked at, moved back and switched off, base first.\n"
                "Ctrl-C stops it. Look at the arm: which joint moves, and which way?"
            )
            asked.append(
                dialogue.confirm("move", "Is the arm clear all around, and a hand on the emergency stop?", False)
            )
        if not asked[0]:
            return 0.0
        before[:] = look()
        return SHARE

    with Cameras(plan) as cameras:
        for finding in examine_joints(plan, may_move):
            yield finding
            if finding.jogged is None:
                continue
            seen = seen_by_pictures(plan, finding.jogged, before, look())
            yield seen
            if finding.ok is not False and seen.ok is not False:
                yield asked_of_a_person(dialogue, finding.jogged, names)


def in_fault(findings: Sequence[ExaminationFinding]) -> ExaminationFinding | None:
    """The finding that drives are in a fault, which only a reset ends; None if they are not."""
    return next((finding for finding in findings if finding.name == "fault" and finding.ok is False), None)


def reset_drives(plan: RunPlan) -> None:
    """Clear the drives' faults; nothing is enabled. Raises DriverError if one remains."""
    driver = make_driver(plan, MonotonicClock())
    try:
        driver.configure()
        driver.configure()  # the first call reports it, the next one clears it
    finally:
        driver.close()


def seen_by_pictures(
    plan: RunPlan, jogged: tuple[str, float], before: list[CameraRecord], after: list[CameraRecord]
) -> ExaminationFinding:
    """Finding on a jog, a joint and its travel [rad or m], by the pictures before and after it."""
    joint, travel = jogged
    kind = next(spec.kind for spec in plan.joints.joints if spec.name == joint)
    if kind == "revolute":
        return judge_turn(joint, travel, turn_between(before, after))
    return ExaminationFinding(f"{joint} pictures", None, "a slide turns nothing: its travel is not judged by pictures")


def asked_of_a_person(dialogue: Dialogue, jogged: tuple[str, float], names: Sequence[str]) -> ExaminationFinding:
    """Finding on a jog by the person's observation."""
    joint, travel = jogged
    wanted = f"{joint}{'+' if travel > 0 else '-'}"
    answer = dialogue.ask(
        f"moved.{joint}",
        f"Which joint moved, and which way (NAME+ or NAME-, or nothing)? {wanted} was asked for",
        wanted,
        lambda text: _eye(text, names),
    )
    return eye_finding(joint, travel, answer)


def _eye(text: str, names: Sequence[str]) -> tuple[str, str]:
    """Parse the motion that a person saw: joint and sense. Raises ValueError."""
    if text.lower() in ("nothing", "none"):
        return "", ""
    match = EYE.fullmatch(text)
    if match is None or match["joint"] not in names:
        raise ValueError(f"a joint's name with + or - behind it, of {', '.join(names)}; or nothing")
    return match["joint"], match["sense"]


def eye_finding(joint: str, travel: float, answer: tuple[str, str]) -> ExaminationFinding:
    """Finding on the motion that a person saw while ``joint`` was driven by ``travel`` [rad or m]."""
    name = f"{joint} seen"
    moved, sense = answer
    expected = "+" if travel > 0 else "-"
    if not moved:
        return ExaminationFinding(
            name, None, "nobody saw it move; the pictures are the only witness of which joint it was"
        )
    if moved != joint:
        return ExaminationFinding(
            name,
            False,
            f"{joint} was driven, and {moved} moved: they are swapped",
            f"exchange node_id (and what else is of the drive) of {joint!r} and {moved!r}",
        )
    if sense and sense != expected:
        return ExaminationFinding(
            name,
            False,
            f"{joint} was driven to {expected} and turned to {sense}: its sign is inverted",
            f"direction of {joint!r}: the other sign; then offset_rad anew",
        )
    return ExaminationFinding(name, True, "it is the joint that moved, and the way it is counted")


# -- the first goal ------------------------------------------------------------------------------------------
# The last steps of `stereoservo setup`: the daemon, a calibration, the first taught goal, and the return to it.


AWAY_SHARE = 0.3
"""Displacement from the first goal as a share of a joint's trial motion, limited by `AWAY_MOST`."""
AWAY_MOST = {"revolute": 0.15, "prismatic": 0.05}
"""[rad or m] Largest displacement of a joint."""
GOAL_S = 180.0


@contextmanager
def running(file: Path, directories: CellDirectories, dialogue: Dialogue) -> Iterator[Client]:
    """A client of the cell's daemon, which is started, for this context only, if none runs.

    Raises CommandError if it does not start; Ctrl-C stops the arm.
    """
    daemon: DaemonProcess | None = None
    try:
        find_daemon(str(file))
    except NotRunningError:
        log = directories.state / "setup-daemon.log"
        daemon = DaemonProcess(file, log=log)
        dialogue.say(f"   starting the cell's daemon; its log is {log}")
    try:
        if daemon is not None:
            with dialogue.doing("the daemon starts (the first time, it compiles for half a minute)"):
                try:
                    daemon.wait_ready()
                except DaemonError as error:
                    raise CommandError("daemon", str(error)) from error
        with Client(str(file), while_waiting=interruption.check) as client:
            try:
                yield client
            except KeyboardInterrupt:
                client.stop()
                raise
    finally:
        if daemon is not None:
            with dialogue.doing("the daemon ends"):
                daemon.stop()


def calibrated(client: Client, dialogue: Dialogue) -> dict[str, Any]:
    """Calibrate the cell; returns the summary of the report. Raises ClientError, CommandError."""

    def progress(event: EventMessage) -> None:
        if event.kind == "warning":
            dialogue.say(f"   {event.message}")
        elif event.kind == "calibrated":
            dialogue.now("the report is written")
        elif event.progress is not None and event.kind.startswith("fit"):
            dialogue.say(f"   fit: {event.progress:4.0%} {event.message}")
        elif event.progress is not None:
            dialogue.now(f"trial motions, {event.progress:.0%}")

    with dialogue.doing("trial motions"):
        result = client.calibrate(progress, report=True)
    dialogue.say(
        f"   model epoch {result.epoch}, {result.stratum}: {result.rms_px:.3f} px rms over {result.measurements} "
        f"measurements. {result.verdict}\n   report: {result.report or 'none could be written'}"
    )
    return {
        "rms_px": result.rms_px,
        "stratum": result.stratum,
        "covariance_ok": result.covariance_ok,
        "model": result.model,
    }


def first_goal(client: Client, directories: CellDirectories, dialogue: Dialogue) -> dict[str, Any]:
    """Teach a goal at the arm's pose, send the arm away and back to it by the pictures. Raises ClientError."""
    known = load_taught(directories.taught)
    name = dialogue.ask("goal", "A name for the goal that the cameras see now", next(iter(known), "first"), _goal_name)
    if name not in known:
        with dialogue.doing("averaging what the cameras see"):
            dialogue.say(f"   {client.teach(name).message}")
    if not dialogue.confirm("go", "Send the arm a little way off, and back to that goal by its pictures?", True):
        return {"name": name, "outcome": "not sent"}
    with dialogue.doing("the arm moves off by its joints"):
        client.goal(away(client)).reached(GOAL_S)
    with dialogue.doing(f"the arm goes to {name!r} by its pictures"):
        handle = client.goal(name)
        dialogue.say(f"   accepted: {handle.message}")
        result = handle.reached(GOAL_S)
    error = "" if result.error_px is None else f", {result.error_px:.3f} px beside it"
    dialogue.say(f"   {name!r} is {result.outcome} after {result.seconds:.1f} s{error}")
    return {"name": name, "outcome": result.outcome, "error_px": result.error_px, "seconds": result.seconds}


def _goal_name(text: str) -> str:
    if not CELL_NAME.fullmatch(text):
        raise ValueError("letters, digits, '_' and '-', up to 64")
    return text


def away(client: Client) -> dict[str, float]:
    """Joint positions [rad or m] near the current ones, each joint displaced towards the centre of its range."""
    info, joints = client.info(), client.joints()
    targets = {}
    for joint in info.joints:
        q = joints[joint.name]
        way = min(AWAY_SHARE * 0.5 * (joint.position_max - joint.position_min), AWAY_MOST[joint.kind])
        targets[joint.name] = q + (way if q < 0.5 * (joint.position_min + joint.position_max) else -way)
    return targets


def arm_is_off(client: Client) -> bool:
    """Whether the drives are off and the arm can be enabled. Raises ClientError if the cell is in a fault."""
    state = client.status()
    if state.lifecycle == "fault":
        raise ClientError("the cell is in a fault: " + "; ".join(reason.hint for reason in state.reasons))
    return state.lifecycle == "inactive"


# -- interview -------------------------------------------------------------------------------------------------


JOINT_DRIVER, CAMERA_DRIVER, DETECTOR = "canopen", "video", "dots"
COUNTS = 65536.0
SPEED_DEG = 20.0
AROUND_DEG = 40.0
"""Proposed range to both sides of the joint's position, if a drive has no limits."""
MARGIN = 5.0
"""[degrees or mm] Least distance of every limit from the arm's position, where it starts its trial motions."""
NAMES = ("left", "right")
_NEXT_CAMERA = re.compile(r"[\s,]+(?=[A-Za-z][A-Za-z0-9+.-]*://|/dev/|[0-9]+(?:[\s,]|$))")


def interview(file: Path, dialogue: Dialogue, extra: dict[str, Any]) -> None:
    """Find cameras and drives, ask for the rest, write the cell file and its plates.

    ``extra``: further options of the joint driver. Raises CommandError, DriverError, PluginError.
    """
    _plates(file, dialogue)
    cameras = _cameras(dialogue)
    finder, scan = _drives(dialogue, extra)
    joints = _joints(dialogue, scan)
    options = {**finder.options_of(scan, joints), **extra}
    described = finder(options, _context(file)).describe()
    base = [joint_position(joint) for joint in joints]
    text = cell_text(
        file.stem, JOINT_DRIVER, "\n".join(toml_lines(options, "joints.options")), described, cameras, base
    )
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CommandError("file", f"{file}: {error.strerror}") from error
    load_cell_file(file)
    dialogue.say(f"wrote {file}: every choice stands there with a comment, and may be changed there")


def _context(file: Path) -> DriverContext:
    return DriverContext(MonotonicClock(), file.stem, Path(os.devnull), file.absolute().parent)


# -- cameras -------------------------------------------------------------------------------------------------------


def _cameras(dialogue: Dialogue) -> list[CameraSection]:
    dialogue.heading("Cameras")
    finder = plugins.load(plugins.CAMERA_DRIVERS, CAMERA_DRIVER)
    assert isinstance(finder, CameraFinder)
    with dialogue.doing("looking for cameras"):
        found = finder.find_cameras()
    for k, camera in enumerate(found):
        modes = ", ".join(f"{w}x{h} at {rate:g} Hz" for w, h, rate in camera.modes[:3])
        dialogue.say(f"   {k}: {camera.name}, {Address(str(camera.options['source']))}; {modes or 'modes unknown'}")
    if not found:
        dialogue.say(
            "   no camera is at this computer's ports; network cameras have an address (http://, rtsp://, genicam://)"
        )
    default = " ".join(str(k) for k in range(2)) if len(found) >= 2 else None
    chosen = dialogue.ask(
        "cameras",
        "Which two cameras see the arm, the left one first, as seen from behind them: numbers from above, or addresses",
        default,
        lambda text: chosen_cameras(text, found),
        lambda text: " ".join(map(Address, _camera_words(text))),
    )
    names = NAMES if len(chosen) == len(NAMES) else tuple(f"camera{k + 1}" for k in range(len(chosen)))
    sections = []
    for name, camera in zip(names, chosen, strict=True):
        options = dict(camera.options)
        if camera.modes:
            options |= dict(zip(("width", "height", "rate_hz"), camera.modes[0], strict=True))
        source = Address(str(camera.options["source"]))
        with dialogue.doing(f"opening {source}"):
            try:
                width, height, rate = finder.probe_camera(options)
            except DriverError as error:
                raise CommandError("camera", f"camera {name!r}: {error}") from error
        dialogue.say(f"   {name}: {source} gives pictures of {width}x{height} at {rate:g} Hz")
        options |= {"width": width, "height": height, "rate_hz": rate}
        sections.append(CameraSection(name, CAMERA_DRIVER, DETECTOR, options=options))
    return sections


def chosen_cameras(text: str, found: Sequence[FoundCamera]) -> list[FoundCamera]:
    """Parse numbers of found cameras and addresses, by blanks or commas. Raises ValueError."""
    chosen = []
    for word in _camera_words(text):
        if word.isdecimal() and int(word) < len(found):
            chosen.append(found[int(word)])
        elif "://" in word or word.startswith("/dev/"):
            chosen.append(FoundCamera(Address(word), {"source": word}))
        else:
            known = f"0 to {len(found) - 1}, " if found else ""
            raise ValueError(f"{Address(word)!r}; valid: {known}an address with ://, a device /dev/video0")
    if len(chosen) < 2:
        raise ValueError(f"{len(chosen)} camera; a cell needs two: one alone tells nothing of depth")
    if len({str(camera.options["source"]) for camera in chosen}) < len(chosen):
        raise ValueError("one camera is given twice; each must be another")
    return chosen


def _camera_words(text: str) -> list[str]:
    """Numbers and addresses of an answer; blanks and commas in a password do not separate."""
    return [word for word in _NEXT_CAMERA.split(text.strip(" \t,")) if word]


# -- drives --------------------------------------------------------------------------------------------------------


def _drives(dialogue: Dialogue, extra: dict[str, Any]) -> tuple[Any, BusScan]:
    dialogue.heading("Drives")
    finder = plugins.load(plugins.JOINT_DRIVERS, JOINT_DRIVER)
    assert isinstance(finder, DriveFinder)
    with dialogue.doing("looking for CAN adapters and serial ports"):
        found = finder.find_buses()
    for k, bus in enumerate(found):
        dialogue.say(f"   {k}: {bus.name}")
    if not found:
        dialogue.say("   no CAN adapter is at this computer; one on a network is named INTERFACE:CHANNEL")
    bus = dialogue.ask(
        "bus",
        "Which adapter are the drives behind: a number from above, or INTERFACE:CHANNEL of python-can",
        "0" if found else None,
        lambda text: chosen_bus(text, found),
    )
    with dialogue.doing("asking every node id, at one bit rate after the other"):
        scan = finder.scan_bus({**bus.options, **extra})
    for drive in scan.drives:
        dialogue.say(f"   {drive.name}")
    for finding in scan.findings:
        dialogue.say(line_of(finding))
    failed = [finding for finding in scan.findings if finding.ok is False]
    if failed or not scan.drives:
        words = "; ".join(f"{finding.name}: {finding.message}" for finding in failed)
        raise CommandError("drives", words or "no drive answers on this bus")
    return finder, scan


def chosen_bus(text: str, found: Sequence[FoundBus]) -> FoundBus:
    """Parse the number of a found bus, or ``INTERFACE:CHANNEL``. Raises ValueError."""
    if text.isdecimal() and int(text) < len(found):
        return found[int(text)]
    interface, separator, channel = text.partition(":")
    if separator and interface and channel:
        return FoundBus(text, {"interface": interface, "channel": channel})
    known = f"0 to {len(found) - 1}, or " if found else ""
    raise ValueError(f"{known}INTERFACE:CHANNEL, such as socketcan:can0 or stereoservo_slcan:/dev/ttyACM0")


def _joints(dialogue: Dialogue, scan: BusScan) -> list[JointChoice]:
    drives = {drive.address: drive for drive in scan.drives}
    order = dialogue.ask(
        "order",
        "Node ids of the joints, base first, grippers left out; with a p behind that of a slide (prismatic joint)",
        " ".join(str(address) for address in sorted(drives)),
        lambda text: chosen_order(text, drives),
    )
    left_out = sorted(set(drives) - {drive.address for drive, _ in order})
    if left_out:
        dialogue.say(
            f"   no joints: nodes {', '.join(map(str, left_out))}; a gripper on a drive of its own is a section "
            "[[joints.options.gripper]] of the cell file, to be added once it is written"
        )
    n = len(order)
    told = [drive.options.get("counts_per_rev") for drive, _ in order]
    counts = dialogue.ask(
        "counts_per_rev",
        "Encoder counts per motor turn as the drives tell positions (lines x 4, or 2^bits), one for all or each",
        " ".join(f"{value or COUNTS:g}" if (value or COUNTS) < 1e6 else repr(value) for value in told),
        lambda text: numbers(text, n, positive=True),
    )
    gears = dialogue.ask(
        "gear_ratio",
        "Motor turns per joint turn (per metre of a slide), one for all or each",
        None,
        lambda text: numbers(text, n, positive=True),
    )
    units = dialogue.ask(
        "velocity_units",
        "Velocity unit of the drives (0x60FF) at one motor turn a second: counts, 60 for rpm, 60000 for rpm/1000",
        "counts",
        lambda text: velocity_units(text, n),
    )
    joints = [
        JointChoice(f"j{k + 1}", drive, "prismatic" if slide else "revolute", counts[k], gears[k], units[k], 0, 0, 1)
        for k, (drive, slide) in enumerate(order)
    ]
    ranges = dialogue.ask(
        "limits",
        "Range of each joint, LOW:HIGH in degrees (slides: mm), counted from its encoder's zero; one for all or each",
        " ".join(_range_text(joint) for joint in joints),
        lambda text: chosen_ranges(text, joints),
    )
    speeds = dialogue.ask(
        "speed",
        "Largest speed in degrees/s (slides: mm/s), one for all or each; begin slowly",
        f"{SPEED_DEG:g}",
        lambda text: numbers(text, n, positive=True),
    )
    return [
        JointChoice(
            j.name, j.drive, j.kind, j.counts_per_rev, j.gear_ratio, j.velocity_units_per_rev_s,
            round(low, 5), round(high, 5), round(speed * unit(j), 5),
        )
        for j, (low, high), speed in zip(joints, ranges, speeds, strict=True)
    ]  # fmt: skip


def chosen_order(text: str, drives: dict[int, FoundDrive]) -> list[tuple[FoundDrive, bool]]:
    """Parse node ids, base first, and which of them are prismatic. Raises ValueError."""
    order = []
    for word in text.replace(",", " ").split():
        number = word.removesuffix("p")
        if not number.isdecimal() or int(number) not in drives:
            raise ValueError(f"{word!r}; nodes that answer: {', '.join(map(str, sorted(drives)))}")
        order.append((drives[int(number)], word.endswith("p")))
    if not order or len({drive.address for drive, _ in order}) < len(order):
        raise ValueError("each node once, at least one")
    return order


def numbers(text: str, count: int, *, positive: bool = False) -> list[float]:
    """Parse one number for all, or ``count`` numbers by spaces. Raises ValueError."""
    words = text.replace(",", " ").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) not in (1, count) or not all(math.isfinite(value) for value in values):
        raise ValueError(f"one number, or {count} by spaces")
    if positive and min(values) <= 0.0:
        raise ValueError("numbers above zero")
    return values * count if len(values) == 1 else values


def velocity_units(text: str, count: int) -> list[float | None]:
    """Parse ``counts`` or numbers, one for all or one for each. Raises ValueError."""
    words = text.replace(",", " ").split()
    if len(words) not in (1, count):
        raise ValueError(f"one, or {count} by spaces: counts, or a number")
    units = [None if word == "counts" else numbers(word, 1, positive=True)[0] for word in words]
    return units * count if len(units) == 1 else units


def unit(joint: JointChoice) -> float:
    """A person's unit of a joint, degree or millimetre, in [rad or m]."""
    return math.radians(1.0) if joint.kind == "revolute" else 1e-3


def joint_position(joint: JointChoice, counts: int | None = None) -> float:
    """Position [rad or m] of a joint at ``counts`` of its drive, or at the counts when it was found."""
    at = joint.drive.position or 0 if counts is None else counts
    turns = at / (joint.counts_per_rev * joint.gear_ratio)
    return turns * 2.0 * math.pi if joint.kind == "revolute" else turns


def _range_text(joint: JointChoice) -> str:
    low, high = proposed_range(joint)
    return f"{low / unit(joint):.1f}:{high / unit(joint):.1f}"


def proposed_range(joint: JointChoice) -> tuple[float, float]:
    """The drive's own limits [rad or m]; if it has none, a range to both sides of the joint's position."""
    limits = joint.drive.limits
    if limits is not None:
        low, high = (joint_position(joint, counts) for counts in limits)
        return low, high
    here, way = joint_position(joint), AROUND_DEG * unit(joint)
    return here - way, here + way


def chosen_ranges(text: str, joints: Sequence[JointChoice]) -> list[tuple[float, float]]:
    """Parse ranges LOW:HIGH, within the drives' own limits. Raises ValueError."""
    words = text.replace(",", " ").split()
    if len(words) not in (1, len(joints)):
        raise ValueError(f"one LOW:HIGH, or {len(joints)} by spaces")
    ranges = []
    for joint, word in zip(joints, words * (len(joints) if len(words) == 1 else 1), strict=True):
        ends = word.split(":")
        if len(ends) != 2:
            raise ValueError(f"{joint.name}: {word!r}; LOW:HIGH is valid")
        low, high = (value * unit(joint) for value in numbers(" ".join(ends), 2))
        if low >= high:
            raise ValueError(f"{joint.name}: {word!r}; LOW must be below HIGH")
        own = proposed_range(joint)
        step = 0.1 * unit(joint)
        if joint.drive.limits is not None and (low < own[0] - step or high > own[1] + step):
            raise ValueError(
                f"{joint.name}: {word!r} reaches beyond the drive's own limits (0x607D), {_range_text(joint)}"
            )
        here = joint_position(joint)
        if not low + MARGIN * unit(joint) <= here <= high - MARGIN * unit(joint):
            raise ValueError(
                f"{joint.name}: {word!r}; it stands at {here / unit(joint):.1f} now, which must be {MARGIN:g} inside"
            )
        ranges.append((low, high))
    return ranges


# -- plates --------------------------------------------------------------------------------------------------------


def _plates(file: Path, dialogue: Dialogue) -> None:
    """Write the marker plates beside the cell file, and wait until the person has mounted them on the arm."""
    dialogue.heading("Markers")
    plate = file.with_name(f"{file.stem}-plate.pdf")
    printing: Callable[..., None] = plugins.load(plugins.COMMANDS, "print-plate")
    with suppress(SystemExit), redirect_stdout(StringIO()) as told:
        printing(
            plate, faces=None, dot_mm=None, spacing=None, polarity="light", tags=None, tag_mm=50.0, page="a4",
            force=True, as_json=False,
        )  # fmt: skip
    if not plate.exists():
        log(told.getvalue())
        raise CommandError("file", f"{plate} could not be written")
    dialogue.say(
        f"   {plate}: print it at 100 %, measure the bar, fold it, glue it to something stiff, fix that to the hand.\n"
        "   Bring the arm, by hand or by the drives' own tool, to where both cameras see the plate near the middle."
    )
    if not dialogue.confirm("plate", "Is the plate on the hand, and where both cameras see it?", True):
        raise CommandError("plate", "first the plate; then run the same command again")
