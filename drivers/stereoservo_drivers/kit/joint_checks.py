"""Checks that every joint driver must pass; `stereoservo driver-check` and the contract suite run them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from stereoservo_drivers.kit import lifecycle_checks as lifecycle
from stereoservo_drivers.kit import motion_checks as motion
from stereoservo_drivers.kit.bench import (
    RUNAWAY_REMEDY,
    CheckFailedError,
    CheckNotRunError,
    JointBench,
    JointDriverSetup,
)
from stereoservo_drivers.kit.watchdog import StallWatch

Verdict = Literal["passed", "failed", "not run"]

TRIES = 3
"""How often a check is run at most that fails where this computer stood still meanwhile."""
STALL_S = 0.02
"""[s] A process that wakes so much too late stood still: no check needs a reaction in less."""


class CheckResult(msgspec.Struct, frozen=True):
    """Result of one check; ``remedy``: what to do where it failed."""

    name: str
    verdict: Verdict
    measured: str
    remedy: str = ""


@dataclass(frozen=True)
class JointCheck:
    """One check: ``run`` returns what it measured and raises where it fails. ``connects``: it needs the device."""

    name: str
    run: Callable[[JointBench], str]
    remedy: str
    connects: bool = True


def run_check(check: JointCheck, setup: JointDriverSetup, folder: Path) -> CheckResult:
    """Run one check on drivers of its own, which are closed after it; ``folder``: an empty one.

    Where this process stood still while a check of a device in real time failed, the computer may have failed and not
    the driver: the check runs again, unless the arm ran away.
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
    JointCheck(
        "describes itself",
        lifecycle.describes_itself,
        "fill in JointDriverDescription before anything connects",
        False,
    ),
    JointCheck(
        "refuses calls before configure",
        lifecycle.refuses_before_configure,
        "DriverLifecycle.require() at the beginning of each call",
        False,
    ),
    JointCheck(
        "stop raises nothing unconnected", lifecycle.stops_unconnected, "stop() must do nothing there", False
    ),
    JointCheck("keeps its description", lifecycle.keeps_its_description, "read limits before configure()"),
    JointCheck(
        "refuses commands unless active",
        lifecycle.refuses_unless_active,
        "DriverLifecycle.require(); activate() again after deactivate()",
    ),
    JointCheck(
        "refuses calls once closed", lifecycle.refuses_once_closed, "DriverLifecycle.require(); close() twice"
    ),
    JointCheck(
        "leaves nothing behind",
        lifecycle.leaves_nothing_behind,
        "join threads, close ports and sockets in close()",
    ),
    JointCheck(
        "numbers and stamps its samples",
        lifecycle.numbers_its_samples,
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
        "stops",
        motion.stops,
        "stop() commands velocity zero, in any state, and catches what the device raises",
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
        "refuses bad commands",
        motion.refuses_bad_commands,
        "check shape and np.isfinite before anything is sent",
    ),
    JointCheck(
        "cuts velocities at the limits", motion.cuts_velocities, "clip to velocity_max and say it in reasons"
    ),
    JointCheck(
        "agrees with its velocities",
        lifecycle.agrees_with_its_velocities,
        "units [rad/s, m/s] and sign of the velocities; of a Cartesian arm, whether its three angles are a rotation "
        "vector or turns in some order",
    ),
    JointCheck(
        "states its resolution",
        lifecycle.states_its_resolution,
        "JointSpec(resolution=encoder step at the joint)",
    ),
    JointCheck(
        "keeps samples apart",
        lifecycle.keeps_samples_apart,
        "new arrays in every JointState and CommandReport",
    ),
    JointCheck(
        "is silent once closed",
        lifecycle.is_silent_once_closed,
        "end threads in close(); stop() only while open",
    ),
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
    JointCheck(
        "keeps position limits", motion.keeps_position_limits, "at a limit, send velocities inward only"
    ),
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
"""In the order in which they are run: those first that need no device, and those that may show that an arm must not
move.
"""
