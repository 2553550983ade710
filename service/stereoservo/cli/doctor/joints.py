"""Examination of the arm by its joint driver for ``stereoservo doctor``, which moves a joint only with the user's
permission.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack

import typer

from stereoservo.cli.doctor.sampled_arm import examine_samples
from stereoservo.cli.output import CommandError
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.pacing import realtime_for_a_while
from stereoservo.daemon.plant_driver import make_driver
from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, FileLock, hardware_lock_path, holder
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverError, ExaminableJointDriver, ExaminationFinding, MayMove


def permission(jog: bool, yes: bool) -> MayMove:
    """Function that permits the examination to move a joint: never, always (``--yes``), or as the user answers.

    Raises CommandError without a terminal to ask on.
    """
    if yes and not jog:
        raise CommandError("argument", "--yes answers what --jog asks; give both")
    if not jog:
        return lambda _: False
    if yes:
        return lambda _: True
    if not sys.stdin.isatty():
        raise CommandError(
            "argument",
            "--jog asks on the terminal before anything moves, and there is none; --yes answers for it",
        )
    return lambda question: typer.confirm(question, default=False, err=True)


def examine_joints(plan: RunPlan, may_move: MayMove) -> Iterator[ExaminationFinding]:
    """Findings on the cell's arm: by its driver where that can examine it, else on its samples. Nothing is accessed
    while another process has the hardware.
    """
    clock = MonotonicClock()
    driver = make_driver(plan, clock)
    directories = plan.directories
    pid = holder(directories.daemon_lock)
    if pid is not None:
        yield ExaminationFinding(
            "drives", None, f"not examined: the daemon (process {pid}) has them", f"`kill {pid}`"
        )
        return
    hardware = hardware_lock_path(
        directories.runtime.parent, plan.cell.joints.driver, plan.cell.joints.options
    )
    with ExitStack() as locks:
        try:
            locks.enter_context(FileLock(directories.servo_lock, f"cell {plan.cell.cell.name!r}"))
            if hardware is not None:
                locks.enter_context(ChannelLock(hardware, f"joint driver {plan.cell.joints.driver!r}"))
        except AlreadyRunningError as error:
            yield ExaminationFinding("drives", None, f"not examined: {error}")
            return
        # As the servo process is scheduled, so that what is measured is what it would see; where that is not allowed,
        # the check "scheduling" says so.
        locks.enter_context(realtime_for_a_while(plan.cell.servo.priority))
        try:
            if isinstance(driver, ExaminableJointDriver):
                yield from driver.examine(may_move)
            else:
                yield from examine_samples(plan, driver, clock)
        except DriverError as error:  # `latched`: a fault that came up meanwhile, and only a reset ends
            yield ExaminationFinding("fault" if error.data.get("latched") else "drives", False, str(error))
