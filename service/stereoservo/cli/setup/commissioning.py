"""Commissioning, joint by joint: each is moved by less than a degree, and three witnesses are compared: what its
encoder told, what the pictures saw, and what the person says moved.
"""

from __future__ import annotations

import re
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack

from stereoservo.cli.doctor.camera_findings import CameraRecord
from stereoservo.cli.doctor.cameras import WatchedCamera
from stereoservo.cli.doctor.joints import examine_joints
from stereoservo.cli.doctor.plate_motion import judge_turn, turn_between
from stereoservo.cli.setup.dialogue import Dialogue
from stereoservo.daemon.camera_setup import make_camera
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.pacing import ordinary_for_a_while
from stereoservo.daemon.plant_driver import make_driver
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverError, ExaminationFinding

SHARE = 0.45
"""Of one degree: a gear ratio that is wrong by two moves the joint by less than one."""
FRAMES = 24
"""Pictures of a look; their mean is what noise leaves."""
LOOK_S = 4.0
POLL_S = 0.002
EYE = re.compile(r"(?P<joint>\S+?)(?P<sense>[+-]?)")


class Cameras:
    """The cell's cameras, open, to look at the plate before and after a motion. A context manager."""

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
        """What each camera sees from now on, in ``FRAMES`` pictures taken from now, or as many as come."""
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
    """Findings on the drives, then on each joint's first motion, which the person permits once, and nobody where
    something was found wrong before. ``sound``: whether all findings so far are; it grows with those that come.

    ``names``: of the joints, base first.
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
                dialogue.confirm(
                    "move", "Is the arm clear all around, and a hand on the emergency stop?", False
                )
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
    """The finding that drives stand in a fault, which only a reset ends; None where they do not."""
    return next((finding for finding in findings if finding.name == "fault" and finding.ok is False), None)


def reset_drives(plan: RunPlan) -> None:
    """Clear the drives' faults; nothing is enabled. Raises DriverError where one stays."""
    driver = make_driver(plan, MonotonicClock())
    try:
        driver.configure()
        driver.configure()  # the first call reports what it finds, the next one clears it
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
    return ExaminationFinding(
        f"{joint} pictures", None, "a slide turns nothing: its travel is not judged by pictures"
    )


def asked_of_a_person(
    dialogue: Dialogue, jogged: tuple[str, float], names: Sequence[str]
) -> ExaminationFinding:
    """Finding on a jog by what a person saw."""
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
    """Parse what a person saw move: joint and sense. Raises ValueError."""
    if text.lower() in ("nothing", "none"):
        return "", ""
    match = EYE.fullmatch(text)
    if match is None or match["joint"] not in names:
        raise ValueError(f"a joint's name with + or - behind it, of {', '.join(names)}; or nothing")
    return match["joint"], match["sense"]


def eye_finding(joint: str, travel: float, answer: tuple[str, str]) -> ExaminationFinding:
    """Finding on what a person saw move while ``joint`` was driven by ``travel`` [rad or m]."""
    name = f"{joint} seen"
    moved, sense = answer
    expected = "+" if travel > 0 else "-"
    if not moved:
        return ExaminationFinding(
            name, None, "nobody saw it move; the pictures are the only witness of which joint it was"
        )
    if moved != joint:
        return ExaminationFinding(
            name, False, f"{joint} was driven, and {moved} moved: they are swapped",
            f"exchange node_id (and what else is of the drive) of {joint!r} and {moved!r}",
        )  # fmt: skip
    if sense and sense != expected:
        return ExaminationFinding(
            name, False, f"{joint} was driven to {expected} and turned to {sense}: its sign is inverted",
            f"direction of {joint!r}: the other sign; then offset_rad anew",
        )  # fmt: skip
    return ExaminationFinding(name, True, "it is the joint that moved, and the way it is counted")
