"""Examination of the arm through its joint driver for ``stereoservo doctor``, which moves a joint only with the user's
permission.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import typer

from stereoservo.cli.output import CommandError
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.pacing import realtime_for_a_while
from stereoservo.daemon.plant_driver import make_driver
from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, FileLock, hardware_lock_path, holder
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    Clock,
    DriverError,
    ExaminableJointDriver,
    ExaminationFinding,
    JointDriver,
    JointState,
    MayMove,
)


def permission(jog: bool, yes: bool) -> MayMove:
    """Function that permits the examination to move a joint: never, always (``--yes``), or by the user's answer.

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
            "argument", "--jog asks on the terminal before anything moves, and there is none; --yes answers for it"
        )
    return lambda question: typer.confirm(question, default=False, err=True)


def examine_joints(plan: RunPlan, may_move: MayMove) -> Iterator[ExaminationFinding]:
    """Findings on the cell's arm: by its driver if that can examine it, else from its samples. Nothing is accessed
    while another process uses the hardware.
    """
    clock = MonotonicClock()
    driver = make_driver(plan, clock)
    directories = plan.directories
    pid = holder(directories.daemon_lock)
    if pid is not None:
        yield ExaminationFinding("drives", None, f"not examined: the daemon (process {pid}) has them", f"`kill {pid}`")
        return
    hardware = hardware_lock_path(directories.runtime.parent, plan.cell.joints.driver, plan.cell.joints.options)
    with ExitStack() as locks:
        try:
            locks.enter_context(FileLock(directories.servo_lock, f"cell {plan.cell.cell.name!r}"))
            if hardware is not None:
                locks.enter_context(ChannelLock(hardware, f"joint driver {plan.cell.joints.driver!r}"))
        except AlreadyRunningError as error:
            yield ExaminationFinding("drives", None, f"not examined: {error}")
            return
        # Scheduled like the servo process, so that the measured timing is the same as there; if that is not allowed,
        # the check "scheduling" reports it.
        locks.enter_context(realtime_for_a_while(plan.cell.servo.priority))
        try:
            if isinstance(driver, ExaminableJointDriver):
                yield from driver.examine(may_move)
            else:
                yield from examine_samples(plan, driver, clock)
        except DriverError as error:  # `latched`: a fault that occurred meanwhile, and that only a reset ends
            yield ExaminationFinding("fault" if error.data.get("latched") else "drives", False, str(error))


# -- by its samples ------------------------------------------------------------------------------------------
# Examination of an arm whose joint driver cannot examine it: connected, read for a short time, closed; nothing moves.


SAMPLED_S = 0.3
NOT_LOOKED_AT = (
    "units, directions, speeds, brakes, what stops the arm when commands cease: `stereoservo driver-check --cell CELL "
    "--hardware` looks at that, and moves the arm"
)


def examine_samples(plan: RunPlan, driver: JointDriver, clock: Clock) -> Iterator[ExaminationFinding]:
    """Findings on a driver's joint samples: shape, finite values, limits, stamps. Configures and closes the driver.

    Never raises whatever the driver does: a failure is a finding.
    """
    name = plan.joints.driver
    if plan.joints.simulated:
        yield ExaminationFinding("drives", None, f"not connected: driver {name!r} simulates them")
        return
    states: list[JointState] = []
    ages: list[float] = []
    call = "configure()"
    try:
        driver.configure()
        call = "read_state()"
        end_ns = clock.now_ns() + round(SAMPLED_S * 1e9)
        while clock.now_ns() < end_ns or len(states) < 2:
            time.sleep(1.0 / plan.joints.rate_hz)
            states.append(driver.read_state())
            ages.append((clock.now_ns() - states[-1].t_ns) * 1e-9)
    except Exception as error:  # whatever a third party's driver raises
        yield ExaminationFinding("drives", False, _raised(name, call, error))
        return
    finally:
        try:
            driver.close()
        except Exception as error:  # likewise
            yield ExaminationFinding("drives", False, _raised(name, "close()", error))
    yield from (_values(plan, states), _stamps(plan, states, ages))
    yield ExaminationFinding("drives", None, f"not looked at: {NOT_LOOKED_AT}")


def _raised(name: str, call: str, error: Exception) -> str:
    return f"driver {name!r}: {call} raised {type(error).__name__}: {error}"


def _values(plan: RunPlan, states: list[JointState]) -> ExaminationFinding:
    """Finding on the newest positions: number of joints, finite values, within the cell's limits."""
    names = [joint.name for joint in plan.joints.joints]
    newest = states[-1]
    for what, values in (("positions", newest.positions), ("velocities", newest.velocities)):
        if np.shape(values) != (len(names),) or not np.isfinite(values).all():
            return ExaminationFinding(
                "joint positions",
                False,
                f"{what} are {np.asarray(values).tolist()}; {len(names)} finite ones are needed",
                f"the joint driver {plan.joints.driver!r}",
            )
    limits = {limit.joint: limit for limit in plan.cell.safety.limit}
    outside = [
        f"{name} is at {q:.4g}, its limits are {limits[name].min:g} to {limits[name].max:g}"
        for name, q in zip(names, newest.positions.tolist(), strict=True)
        if name in limits and not limits[name].min <= q <= limits[name].max
    ]
    if outside:
        return ExaminationFinding(
            "joint positions",
            False,
            "; ".join(outside),
            "move the arm by hand, or mend zeros, directions and units of [joints.options], or [[safety.limit]]",
        )
    told = ", ".join(f"{name} {q:.4g}" for name, q in zip(names, newest.positions.tolist(), strict=True))
    return ExaminationFinding("joint positions", True, f"{told} [rad or m], within the cell's limits")


def _stamps(plan: RunPlan, states: list[JointState], ages: list[float]) -> ExaminationFinding:
    """Finding on numbers, stamps and ages of the samples."""
    age_ms, timeout_ms = float(np.median(ages)) * 1e3, plan.cell.safety.joint_timeout_s * 1e3
    summary = f"{len(states)} read in {SAMPLED_S:g} s, {age_ms:.1f} ms old (median)"
    stands = states[-1].t_ns <= states[0].t_ns or states[-1].seq <= states[0].seq
    cure = f"the joint driver {plan.joints.driver!r}: stamps of context.clock when the device was read, a number each"
    if stands:
        return ExaminationFinding("joint samples", False, f"{summary}: stamps or numbers stand still", cure)
    if not -1.0 <= age_ms <= timeout_ms:
        what = f"the arm stops at {timeout_ms:g} ms" if age_ms > 0.0 else "stamps are in the future"
        return ExaminationFinding("joint samples", False, f"{summary}; {what} (safety.joint_timeout_s)", cure)
    if age_ms > 0.5 * timeout_ms:
        return ExaminationFinding(
            "joint samples",
            None,
            f"{summary}; the arm stops at {timeout_ms:g} ms",
            "a larger safety.joint_timeout_s, or a device that is read more often",
        )
    return ExaminationFinding("joint samples", True, f"{summary}; the arm stops at {timeout_ms:g} ms")
