"""The last steps of `stereoservo setup`: the daemon, a calibration, the first taught goal, and the way back to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stereoservo.cli import interruption
from stereoservo.cli.output import CommandError
from stereoservo.cli.setup.dialogue import Dialogue
from stereoservo.client import Client, ClientError
from stereoservo.daemon.taught_goals import load_taught
from stereoservo.messages.directories import CELL_NAME, CellDirectories
from stereoservo.messages.discovery import DaemonError, DaemonProcess, NotRunningError, find_daemon
from stereoservo.messages.wire import EventMessage

AWAY_SHARE = 0.3
"""Of a joint's trial motion, how far the arm is sent away from its first goal; and in any case no more than"""
AWAY_MOST = {"revolute": 0.15, "prismatic": 0.05}
"""[rad or m]"""
GOAL_S = 180.0


@contextmanager
def running(file: Path, directories: CellDirectories, dialogue: Dialogue) -> Iterator[Client]:
    """A client of the cell's daemon, which is started, for the time of it, where none runs.

    Raises CommandError where it does not start; Ctrl-C stops the arm.
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
    """Calibrate the cell; returns what a report's summary holds. Raises ClientError, CommandError."""

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
        "rms_px": result.rms_px, "stratum": result.stratum, "covariance_ok": result.covariance_ok,
        "model": result.model,
    }  # fmt: skip


def first_goal(client: Client, directories: CellDirectories, dialogue: Dialogue) -> dict[str, Any]:
    """Teach a goal where the arm stands, send the arm away and back to it by the pictures. Raises ClientError."""
    known = load_taught(directories.taught)
    name = dialogue.ask(
        "goal", "A name for the goal that the cameras see now", next(iter(known), "first"), _goal_name
    )
    if name not in known:
        with dialogue.doing("averaging what the cameras see"):
            dialogue.say(f"   {client.teach(name).message}")
    if not dialogue.confirm(
        "go", "Send the arm a little way off, and back to that goal by its pictures?", True
    ):
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
    """Joint positions [rad or m] a little off the present ones, each joint towards the middle of its range."""
    info, joints = client.info(), client.joints()
    targets = {}
    for joint in info.joints:
        q = joints[joint.name]
        way = min(AWAY_SHARE * 0.5 * (joint.position_max - joint.position_min), AWAY_MOST[joint.kind])
        targets[joint.name] = q + (way if q < 0.5 * (joint.position_min + joint.position_max) else -way)
    return targets


def arm_is_off(client: Client) -> bool:
    """Whether the drives are off and the arm can be enabled. Raises ClientError where the cell is in a fault."""
    state = client.status()
    if state.lifecycle == "fault":
        raise ClientError("the cell is in a fault: " + "; ".join(reason.hint for reason in state.reasons))
    return state.lifecycle == "inactive"
