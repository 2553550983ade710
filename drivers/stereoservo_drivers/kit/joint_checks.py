"""Checks that every joint driver must pass; `stereoservo driver-check` and the contract suite run them."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from stereoservo.ports.devices import DriverError, JointDriver, JointSpec
from stereoservo_drivers.kit import motion_checks as motion
from stereoservo_drivers.kit.bench import (
    FRESH_SHARE,
    RUNAWAY_REMEDY,
    CheckFailedError,
    CheckNotRunError,
    JointBench,
    JointDriverSetup,
    call_stop,
    refused,
    require,
    resolutions,
    told,
    zero,
)
from stereoservo_drivers.kit.timing import StallWatch

# -- of the life cycle ---------------------------------------------------------------------------------------
# Checks of joint drivers that hardly move the arm: description, lifecycle, samples.


WIDEST_RAD, FASTEST_RAD, WIDEST_M, FASTEST_M = 16.0 * math.pi, 30.0, 20.0, 10.0
"""Range and velocity above which limits are probably in degrees or millimetres."""
FINEST = 0.6e-3
"""[rad or m] Encoders with coarser steps must state them."""
GONE_S = 1.0
"""Time limit for threads to end."""

# -- without the device ----------------------------------------------------------------------------------------


def describes_itself(bench: JointBench) -> str:
    """Check that the description is available before anything connects, and plausible; reports suspicious limits."""
    driver = bench.new()
    require(isinstance(driver, JointDriver), f"{type(driver).__name__} lacks methods of JointDriver", "all its methods")
    description = driver.describe()
    names = [joint.name for joint in description.joints]
    require(bool(names) and len(set(names)) == len(names), f"joints are called {names}")
    for joint in description.joints:
        require(joint.position_min < joint.position_max, f"{joint.name}: empty range of positions")
        require(joint.velocity_max > 0 and joint.acceleration_max > 0, f"{joint.name}: limits must be above 0")
        require(joint.resolution < joint.position_max - joint.position_min, f"{joint.name}: resolution above its range")
    for name in ("rate_hz", "command_timeout_s", "call_budget_us"):
        require(getattr(description, name) > 0, f"{name} must be above 0")
    require(len(description.effort_units) in (0, len(names)), "effort_units: none, or one for each joint")
    doubts = "".join(doubt for joint in description.joints if (doubt := _doubt(joint)))
    return f"{len(names)} joints at {description.rate_hz:g} Hz, time-out {description.command_timeout_s:g} s{doubts}"


def _doubt(joint: JointSpec) -> str:
    """Text on limits of a joint that seem to be in another unit than [rad, m, s]; empty if there are none."""
    revolute = joint.kind == "revolute"
    widest, fastest, unit = (WIDEST_RAD, FASTEST_RAD, "rad") if revolute else (WIDEST_M, FASTEST_M, "m")
    if joint.position_max - joint.position_min <= widest and joint.velocity_max <= fastest:
        return ""
    return (
        f"; WARNING: {joint.name} goes from {joint.position_min:g} to {joint.position_max:g} {unit} at "
        f"{joint.velocity_max:g} {unit}/s: {'degrees' if revolute else 'millimetres'}?"
    )


def refuses_before_configure(bench: JointBench) -> str:
    """Check that calls before configure() raise DriverError."""
    driver = bench.new()
    codes = [
        refused(call, f"{name}() before configure()")
        for name, call in (
            ("read_state", driver.read_state),
            ("activate", driver.activate),
            ("write_velocity", lambda: driver.write_velocity(zero(driver))),
        )
    ]
    return ", ".join(dict.fromkeys(codes))


def stops_unconnected(bench: JointBench) -> str:
    """Check that stop() and close() do nothing if nothing is connected."""
    driver = bench.new()
    for state in ("before configure()", "after close()"):
        for _ in range(2):
            call_stop(driver, state)
        driver.close()
    return "stop() and close(), twice each"


# -- lifecycle ---------------------------------------------------------------------------------------------------


def keeps_its_description(bench: JointBench) -> str:
    """Check that the description is the same in all states."""
    driver = bench.new()
    before = driver.describe()
    bench.setup.configure(driver)
    require(driver.describe() == before, "describe() changes with configure()")
    driver.activate()
    require(driver.describe() == before, "describe() changes with activate()")
    return "the same in three states"


def refuses_unless_active(bench: JointBench) -> str:
    """Check that commands are refused before activate() and after deactivate(); then configure and activate again."""
    driver = bench.configured()
    codes = [refused(lambda: driver.write_velocity(zero(driver)), "write_velocity() before activate()")]
    driver.activate()
    driver.deactivate()
    driver.deactivate()
    codes.append(refused(lambda: driver.write_velocity(zero(driver)), "write_velocity() after deactivate()"))
    try:
        bench.setup.configure(driver)
    except DriverError as error:
        raise CheckFailedError(
            f"configure() after deactivate(), as the command `reset` calls it, raised {told(error)}",
            'DriverLifecycle.require("configure()", CREATED, CONFIGURED): connected already, it checks the device anew',
        ) from error
    driver.activate()
    bench.drive(driver, zero(driver), 0.05)
    return f"{codes[0]}, {codes[1]}; configured and activated again"


def refuses_once_closed(bench: JointBench) -> str:
    """Check that calls after close() raise DriverError."""
    driver = bench.active()
    driver.close()
    driver.close()
    codes = [refused(driver.read_state, "read_state() after close()")]
    codes.append(refused(lambda: driver.write_velocity(zero(driver)), "write_velocity() after close()"))
    return ", ".join(dict.fromkeys(codes))


def is_silent_once_closed(bench: JointBench) -> str:
    """Check that nothing reaches the device after close()."""
    driver = bench.active()
    bench.drive(driver, bench.slow(driver), 0.05)
    driver.close()
    bench.wait(0.1)
    before = bench.setup.device_writes(driver)
    if before is None:
        raise CheckNotRunError("nobody counts what the device receives: override device_writes()")
    driver.stop()
    driver.close()
    bench.wait(0.2)
    after = bench.setup.device_writes(driver)
    require(after == before, f"{(after or 0) - before} writes reach the device after close()")
    return f"{before} writes before close(), none after"


def leaves_nothing_behind(bench: JointBench) -> str:
    """Check that no threads and file descriptors remain after close()."""
    for first in (True, False):  # objects loaded once, by the first driver, are not a leak
        threads, files = set(threading.enumerate()), _open_files()
        driver = bench.active()
        bench.drive(driver, zero(driver), 0.05)
        driver.close()
        if not first:
            break
    end = time.monotonic() + GONE_S

    def left() -> tuple[list[str], int]:
        alive = [thread.name for thread in threading.enumerate() if thread not in threads]
        return alive, _open_files() - files

    while any(left()) and time.monotonic() < end:
        time.sleep(0.01)
    alive, descriptors = left()
    require(not alive, f"threads still run after close(): {', '.join(alive)}")
    require(descriptors <= 0, f"{descriptors} file descriptors are still open after close()")
    return "no thread, no descriptor"


def _open_files() -> int:
    folder = Path("/proc/self/fd")
    return len(os.listdir(folder)) if folder.is_dir() else 0


# -- samples -----------------------------------------------------------------------------------------------------


def numbers_its_samples(bench: JointBench) -> str:
    """Check that samples are numbered, and stamped recently enough for the cell."""
    driver = bench.active()
    description = driver.describe()
    period = 1.0 / description.rate_hz
    states, ages = [], []
    for _ in range(20):
        bench.wait(period)
        states.append(bench.read(driver))
        ages.append((bench.now_ns() - states[-1].t_ns) * 1e-9)
    require(states[-1].t_ns > states[0].t_ns, "stamps stand still")
    require(states[-1].seq > states[0].seq, "sequence numbers stand still")
    age, timeout = float(np.median(ages)), bench.setup.joint_timeout_s
    most = min(FRESH_SHARE * timeout, timeout - period)
    require(
        age <= most,
        f"samples are {age * 1e3:.1f} ms old when they are read (median), {max(most, 0.0) * 1e3:.1f} ms are allowed at "
        f"{description.rate_hz:g} Hz: cells stop the arm at {timeout * 1e3:g} ms (safety.joint_timeout_s)",
    )
    return f"age {age * 1e3:.2f} ms (median), {most * 1e3:.1f} allowed"


def keeps_samples_apart(bench: JointBench) -> str:
    """Check that samples and reports own their arrays."""
    driver = bench.active()
    velocity = bench.slow(driver)
    state = bench.read(driver)
    positions = state.positions.copy()
    bench.drive(driver, velocity, 0.2)
    require(np.array_equal(state.positions, positions), "a later read changes the arrays of an earlier sample")
    report = bench.write(driver, velocity)
    asked = velocity.copy()
    velocity[:] = 0.0
    require(np.array_equal(report.asked, asked), "the report keeps the caller's array, which changes")
    return "samples and reports own their arrays"


def agrees_with_its_velocities(bench: JointBench) -> str:
    """Check that velocities of the samples are the change of their positions."""
    driver = bench.active()
    states = bench.drive(driver, bench.slow(driver), 0.6)
    states = states[len(states) // 2 :]
    seconds = np.diff([state.t_ns for state in states]) * 1e-9
    # Not if this machine, and with it the arm, was suspended.
    led = seconds < driver.describe().command_timeout_s
    elapsed = float(seconds[led].sum())
    require(elapsed > 0.0, "stamps stand still while the arm moves")
    travelled = np.diff([state.positions for state in states], axis=0)[led].sum(axis=0) / elapsed
    speeds = np.mean([state.velocities for state in states], axis=0)
    steps = resolutions(driver)
    error = np.abs(speeds - travelled)
    allowed = 0.3 * np.abs(travelled) + 2.0 * steps / elapsed + bench.setup.rest_velocity
    worst = int(np.argmax(error / allowed))
    require(
        bool(error[worst] <= allowed[worst]),
        f"joint {worst}: velocities say {speeds[worst]:.4g}, positions {travelled[worst]:.4g} rad/s or m/s",
    )
    return f"velocities within {float(error.max()):.2g} rad/s or m/s of the positions' change"


def states_its_resolution(bench: JointBench) -> str:
    """Check that positions change by no more than the stated resolution at a time."""
    driver = bench.active()
    description = driver.describe()
    period = 1.0 / description.rate_hz
    stated = resolutions(driver)
    slow = bench.slow(driver)
    creep = np.minimum(0.15 * np.maximum(stated, FINEST) / period, np.abs(slow))
    bench.drive(driver, np.sign(slow) * creep, 0.2)
    states = bench.drive(driver, np.sign(slow) * creep, max(0.6, 60 * period))
    changes = np.abs(np.diff([state.positions for state in states], axis=0))
    steps = np.array([np.median(column[column > 0.0]) if (column > 0.0).any() else 0.0 for column in changes.T])
    if not steps.all():
        raise CheckNotRunError("a joint does not move when it is commanded to creep; its steps are unknown")
    allowed = np.maximum(1.6 * np.maximum(stated, FINEST), 3.0 * creep * period)
    worst = int(np.argmax(steps / allowed))
    require(
        bool(steps[worst] <= allowed[worst]),
        f"joint {worst} changes by {steps[worst]:.3g} rad or m at a time, resolution states {stated[worst]:.3g}",
    )
    return f"steps of {', '.join(f'{step:.2g}' for step in steps)} rad or m"


Verdict = Literal["passed", "failed", "not run"]

TRIES = 3
"""Largest number of runs of a check that fails while this computer was suspended."""
STALL_S = 0.02
"""[s] A process that wakes up this late was suspended: no check requires a faster reaction."""


class CheckResult(msgspec.Struct, frozen=True):
    """Result of one check; ``remedy``: what to do if it failed."""

    name: str
    verdict: Verdict
    measured: str
    remedy: str = ""


@dataclass(frozen=True)
class JointCheck:
    """One check: ``run`` returns the measured result and raises if it fails. ``connects``: it needs the device."""

    name: str
    run: Callable[[JointBench], str]
    remedy: str
    connects: bool = True


def run_check(check: JointCheck, setup: JointDriverSetup, folder: Path) -> CheckResult:
    """Run one check on separate drivers, which are closed after it; ``folder``: an empty one.

    If this process was suspended while a check of a device in real time failed, the computer may have caused the
    failure and not the driver: the check runs again, unless the arm ran away.
    """
    stalls: list[float] = []
    for _ in range(TRIES):
        with StallWatch() as watch:
            result = _run_once(check, setup, folder)
        if result.verdict != "failed" or not setup.real_time or watch.longest_s < STALL_S:
            return result
        stalls.append(watch.longest_s)
        if result.remedy == RUNAWAY_REMEDY:
            break
    told = ", ".join(f"{stall * 1e3:.0f} ms" for stall in stalls)
    measured = f"{result.measured}; this computer stood still meanwhile, for up to {told}"
    return msgspec.structs.replace(result, measured=measured)


def _run_once(check: JointCheck, setup: JointDriverSetup, folder: Path) -> CheckResult:
    bench = JointBench(setup, setup.make_context(folder))
    result = _verdict(check, bench, check.run)
    closed = _verdict(check, bench, JointBench.close)
    return closed if closed.verdict == "failed" and result.verdict != "failed" else result


def _verdict(check: JointCheck, bench: JointBench, run: Callable[[JointBench], str | None]) -> CheckResult:
    try:
        return CheckResult(check.name, "passed", run(bench) or "")
    except CheckNotRunError as reason:
        return CheckResult(check.name, "not run", str(reason))
    except CheckFailedError as error:
        failure = error
    except Exception as error:  # whatever a third party's driver raises is a finding
        failure = bench.failure(error)
    return CheckResult(check.name, "failed", str(failure), failure.remedy or check.remedy)


JOINT_CHECKS = (
    JointCheck("describes itself", describes_itself, "fill in JointDriverDescription before anything connects", False),
    JointCheck(
        "refuses calls before configure",
        refuses_before_configure,
        "DriverLifecycle.require() at the beginning of each call",
        False,
    ),
    JointCheck("stop raises nothing unconnected", stops_unconnected, "stop() must do nothing there", False),
    JointCheck("keeps its description", keeps_its_description, "read limits before configure()"),
    JointCheck(
        "refuses commands unless active",
        refuses_unless_active,
        "DriverLifecycle.require(); activate() again after deactivate()",
    ),
    JointCheck("refuses calls once closed", refuses_once_closed, "DriverLifecycle.require(); close() twice"),
    JointCheck("leaves nothing behind", leaves_nothing_behind, "join threads, close ports and sockets in close()"),
    JointCheck(
        "numbers and stamps its samples",
        numbers_its_samples,
        "stamp with context.clock when the device was read, and read it often enough; count each sample",
    ),
    JointCheck(
        "stands when activated",
        motion.stands_when_activated,
        "activate() at velocity zero or where it stands; configure() connects and reads",
    ),
    JointCheck(
        "moves as told",
        motion.moves_as_told,
        "units [rad, m], gear, and the sign of commands against positions; of a Cartesian arm, whose axes its twists "
        "are in, and whether its pose is base from tool",
    ),
    JointCheck(
        "stops", motion.stops, "stop() commands velocity zero, in any state, and catches what the device raises"
    ),
    JointCheck(
        "stops when commands cease",
        motion.stops_when_commands_cease,
        "the device's own watchdog, or positions within a lead of the joint (PositionOutput)",
    ),
    JointCheck(
        "stands once closed",
        motion.stands_once_closed,
        "close() begins with stop(), and leaves the device's time-out armed until the arm stands",
    ),
    JointCheck(
        "refuses bad commands", motion.refuses_bad_commands, "check shape and np.isfinite before anything is sent"
    ),
    JointCheck("cuts velocities at the limits", motion.cuts_velocities, "clip to velocity_max and say it in reasons"),
    JointCheck(
        "agrees with its velocities",
        agrees_with_its_velocities,
        "units [rad/s, m/s] and sign of the velocities; of a Cartesian arm, whether its three angles are a rotation "
        "vector or turns in some order",
    ),
    JointCheck("states its resolution", states_its_resolution, "JointSpec(resolution=encoder step at the joint)"),
    JointCheck("keeps samples apart", keeps_samples_apart, "new arrays in every JointState and CommandReport"),
    JointCheck("is silent once closed", is_silent_once_closed, "end threads in close(); stop() only while open"),
    JointCheck(
        "answers in time",
        motion.answers_in_time,
        "read in a thread, ask for less, or state the call_budget_us and rate_hz that are kept",
    ),
    JointCheck(
        "orders auxiliary joints",
        motion.orders_auxiliary,
        "kit.auxiliary.verify_order(); stop() holds auxiliary joints, too; require ACTIVE in write_auxiliary()",
    ),
    JointCheck("keeps position limits", motion.keeps_position_limits, "at a limit, send velocities inward only"),
    JointCheck(
        "tells faults of the device",
        motion.tells_faults_of_the_device,
        "read_state() looks at the device's error and safety bits, and raises DriverError; configure() clears what "
        "can be cleared",
    ),
    JointCheck(
        "reports a lost device",
        motion.reports_a_lost_device,
        "raise DriverError('connection_lost') when answers cease; catch everything in stop() and close()",
    ),
)
"""Checks in the order of execution: first those that need no device, and those that may show that an arm must not move.
"""
