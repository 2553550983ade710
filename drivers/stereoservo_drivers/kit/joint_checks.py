"""Checks that every joint driver must pass; `stereoservo driver-check` and the contract suite run them."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import AuxiliaryDriver, DriverError, JointDriver, JointSpec, JointState
from stereoservo_drivers.kit.bench import (
    FRESH_SHARE,
    RUNAWAY_REMEDY,
    CheckFailedError,
    CheckNotRunError,
    JointBench,
    JointDriverSetup,
    call_stop,
    call_times_us,
    refused,
    require,
    resolutions,
    told,
    zero,
)
from stereoservo_drivers.kit.timing import StallWatch

MOVED_SHARE = (0.3, 1.5)
"""Least and largest share of the commanded travel that a joint must move."""
SLACK = 1e-3
"""[rad or m] Tolerance added to derived bounds."""
APART = 0.02
"""[rad or m] Largest difference of a joint's true and reported positions, in addition to its resolution: play, sag,
noise.
"""
LONGEST_DRIVE_S = 12.0
REACT_S = 0.02
"""Largest delay of the effect of a call compared with stop() [s]."""
SILENCE_S, LONGER_S = 0.2, 0.6
"""Waiting time beyond the allowed time of motion [s]: at least, and largest addition for slow joints."""
CALLS = 50
TRUTH_REMEDY = (
    "sign, zero, unit or order of the joints is wrong in commands and positions alike: the driver agrees with itself, "
    "not with true_positions()"
)


def stands_when_activated(bench: JointBench) -> str:
    """Check that configure() and activate() move nothing."""
    driver = bench.configured()
    stood = bench.settle(driver, 0.1).positions
    driver.close()
    driver = bench.configured()
    before = bench.settle(driver, 0.1).positions
    steps = float(resolutions(driver).max())
    travel = float(np.abs(before - stood).max())
    require(
        travel < SLACK + steps,
        f"between one configure() and the next the arm moves by {travel:.3g} rad or m",
        "configure() connects, asks and reads; it switches nothing on and commands no motion",
    )
    driver.activate()
    state = bench.settle(driver, 0.2)
    travel = float(np.abs(state.positions - before).max())
    require(travel < SLACK + steps, f"activate() alone moves the arm by {travel:.3g} rad or m")
    speed = float(np.abs(state.velocities).max())
    require(speed < bench.setup.rest_velocity, f"after activate() the arm moves at {speed:.3g} rad/s or m/s")
    return f"moved {travel:.2g} rad or m"


def moves_as_told(bench: JointBench) -> str:
    """Check that each joint moves in the commanded direction, approximately by the commanded and by the reported
    travel.
    """
    driver = bench.active()
    velocity = bench.slow(driver)
    start_ns, before = bench.now_ns(), bench.read(driver).positions
    start = _true_start(bench, driver, before)
    seconds = 0.3
    states = bench.drive(driver, velocity, seconds)
    moved = (bench.read(driver).positions - before) * np.sign(velocity)
    truth = bench.setup.true_positions(driver)
    elapsed = (bench.now_ns() - start_ns) * 1e-9  # more than requested on a machine that stalls
    steps = resolutions(driver)
    least = np.maximum(MOVED_SHARE[0] * seconds * np.abs(velocity) - 2.0 * steps, 1e-9)
    most = MOVED_SHARE[1] * elapsed * np.abs(velocity) + 2.0 * steps + SLACK
    _require_travel(moved, least, most, "moved", "")
    if start is not None and truth is not None:
        _require_travel((truth - start) * np.sign(velocity), least, most, "truly moved", TRUTH_REMEDY)
    shares = moved / (elapsed * np.abs(velocity))
    late = _lateness(bench, driver, velocity)
    return f"{shares.min():.0%} to {shares.max():.0%} of the commanded travel, from {_reaction(states):.0f} ms on{late}"


def _true_start(bench: JointBench, driver: JointDriver, told: FloatArray) -> FloatArray | None:
    """True positions (n,) of the arm at rest; None if they are not measured.

    Raises CheckFailedError if they differ from the reported ones, ``told`` (n,).
    """
    truth = bench.setup.true_positions(driver)
    if truth is not None:
        apart = np.abs(truth - told) - resolutions(driver)
        k = int(np.argmax(apart))
        require(
            bool(apart[k] <= APART),
            f"joint {k} stands at {truth[k]:+.4g} by true_positions(), the driver tells {told[k]:+.4g} rad or m",
            TRUTH_REMEDY,
        )
    return truth


def _require_travel(travel: FloatArray, least: FloatArray, most: FloatArray, verb: str, remedy: str) -> None:
    """Raise CheckFailedError unless every joint's travel in the commanded direction (n,) is within its bounds (n,)."""
    for k, (moved, low, high) in enumerate(zip(travel, least, most, strict=True)):
        require(
            low <= moved <= high,
            f"joint {k} {verb} {moved:+.4g} rad or m in the commanded direction; {low:.4g} to {high:.4g} is required",
            remedy,
        )


def _reaction(states: list[JointState]) -> float:
    """Time [ms] from the first sample until all joints have changed."""
    changed = np.array([state.positions != states[0].positions for state in states])
    first = int(np.argmax(changed, axis=0).max())
    return (states[first].t_ns - states[0].t_ns) * 1e-6


def _lateness(bench: JointBench, driver: JointDriver, velocity: FloatArray) -> str:
    """Text on how much older than their stamps positions are, compared with the true ones; empty if those are not
    measured.

    Raises CheckFailedError if that exceeds the allowed age of samples.
    """
    ages = []
    for _ in range(20):
        bench.write(driver, velocity)
        bench.wait(1.0 / driver.describe().rate_hz)
        state, truth = bench.read(driver), bench.setup.true_positions(driver)
        if truth is None:
            return ""
        behind = float(np.median((truth - state.positions) / velocity))
        ages.append(behind - (bench.now_ns() - state.t_ns) * 1e-9)
    age, most = float(np.median(ages)), FRESH_SHARE * bench.setup.joint_timeout_s
    require(
        age <= most,
        f"positions are {age * 1e3:.0f} ms older than their stamps (median), {most * 1e3:.0f} ms are allowed",
        "stamp positions with the time at which the device measured them, not with that of the call",
    )
    return f"; positions {age * 1e3:.1f} ms older than their stamps"


def cuts_velocities(bench: JointBench) -> str:
    """Check that velocities beyond the limits are clipped, with a reason."""
    driver = bench.active()
    limits = np.array([joint.velocity_max for joint in driver.describe().joints])
    velocity = bench.slow(driver)
    report = bench.write(driver, velocity)
    require(report.sent.shape == velocity.shape, f"sent has shape {report.sent.shape}")
    plain = bool(report.reasons) or np.allclose(report.sent, velocity, atol=SLACK)
    require(plain, f"sent is {report.sent.tolist()} for {velocity.tolist()}, without a reason")
    report = bench.write(driver, 3.0 * limits * np.sign(velocity))
    bench.write(driver, np.zeros_like(limits))
    require(
        bool(np.all(np.abs(report.sent) <= limits * (1 + 1e-6))),
        f"sent {report.sent.tolist()} exceeds the limits {limits.tolist()}",
    )
    require(bool(report.reasons), "a command that was cut has no reason in its report")
    return f"cut to the limits: {', '.join(report.reasons)}"


def refuses_bad_commands(bench: JointBench) -> str:
    """Check that commands of another shape, or with values that are not finite, are refused."""
    driver = bench.active()
    rest = zero(driver)
    codes = [refused(lambda: driver.write_velocity(np.zeros(len(rest) + 1)), "a command of another shape")]
    for bad in (np.nan, np.inf, -np.inf):
        command = rest.copy()
        command[0] = bad
        codes.append(refused(lambda command=command: driver.write_velocity(command), f"a velocity of {bad}"))
    bench.write(driver, rest)
    return ", ".join(dict.fromkeys(codes))


def stops(bench: JointBench) -> str:
    """Check that stop() and deactivate() bring the arm to rest."""
    driver = bench.active()
    velocity = bench.slow(driver)

    def stop() -> None:
        call_stop(driver, "while moving")
        call_stop(driver, "while stopping")

    stopped, _ = _travel_after(bench, driver, velocity, stop, "stop()")
    off, elapsed = _travel_after(bench, driver, velocity, driver.deactivate, "deactivate()")
    call_stop(driver, "after deactivate()")
    reaction = elapsed + max(REACT_S, 1.0 / driver.describe().rate_hz)
    allowed = stopped + np.abs(velocity) * reaction + resolutions(driver) + SLACK
    worst = int(np.argmax(off - allowed))
    require(
        bool(off[worst] <= allowed[worst]),
        f"joint {worst} goes on by {off[worst]:.3g} rad or m after deactivate(), {allowed[worst]:.3g} is allowed; "
        f"after stop() it is {stopped[worst]:.3g}",
        "deactivate() begins with stop()",
    )
    travel = float(np.maximum(stopped, off).max())
    return f"at rest after {bench.setup.brake_s:g} s and {travel:.2g} rad or m, by stop() and by deactivate()"


def _travel_after(
    bench: JointBench, driver: JointDriver, velocity: FloatArray, halt: Callable[[], None], what: str
) -> tuple[FloatArray, float]:
    """Travel (n,) from before the call ``halt`` of the moving arm until it rests, and the duration of the call [s]."""
    bench.drive(driver, velocity, 0.2)
    before = bench.read(driver)
    halt()
    elapsed = (bench.now_ns() - before.t_ns) * 1e-9
    state = bench.settle(driver, bench.setup.brake_s)
    bench.require_rest(driver, f"{bench.setup.brake_s:g} s after {what}")
    return np.abs(state.positions - before.positions), elapsed


def stops_when_commands_cease(bench: JointBench) -> str:
    """Check that the arm comes to rest by itself when commands cease, with or without reads; a new command moves it
    again or is refused.
    """
    if not bench.setup.enforces_timeout:
        raise CheckNotRunError("this device has no command time-out of its own (enforces_timeout)")
    driver = bench.active()
    timeout = driver.describe().command_timeout_s
    velocity = bench.slow(driver)
    bench.drive(driver, velocity, 0.2)
    read = bench.settle(driver, timeout + bench.setup.brake_s)
    bench.require_rest(
        driver, f"{timeout:g} s (time-out) and {bench.setup.brake_s:g} s after the last command, while it is read,"
    )
    after_reads = _recovery(bench, driver, velocity, read.positions)
    driver.close()
    driver = bench.active()
    travel, silent = _travel_in_silence(bench, driver, bench.slow(driver))
    after_silence = _recovery(bench, driver, bench.slow(driver), silent)
    told = after_reads if after_reads == after_silence else f"{after_reads}; {after_silence} after silence"
    return f"travelled {travel:.2g} rad or m with neither reads nor commands; a new command {told}"


def _travel_in_silence(bench: JointBench, driver: JointDriver, velocity: FloatArray) -> tuple[float, FloatArray]:
    """Largest travel from the last command on, without any call of the driver, and the final positions (n,).

    Raises CheckFailedError if the travel exceeds that of the time-out and braking.
    """
    bench.drive(driver, velocity, 0.2)
    before, start = bench.read(driver), bench.setup.true_positions(driver)
    bench.write(driver, velocity)
    allowed, silence = _silence(bench, driver, velocity, before)
    bench.wait(silence)
    truth = bench.setup.true_positions(driver)
    after = _settled(bench, driver)
    travel = np.abs(after - before.positions)
    if start is not None and truth is not None:
        travel = np.maximum(travel, np.abs(truth - start))
    worst = int(np.argmax(travel / allowed))
    require(
        bool(travel[worst] <= allowed[worst]),
        f"joint {worst} goes on by {travel[worst]:.3g} rad or m in {silence:.2g} s with neither reads nor commands; "
        f"{allowed[worst]:.3g} is allowed (time-out and braking): where this process ends, the arm does not stop",
        "what stops the arm must not be a call of the driver: the device's own watchdog, or positions within a lead of "
        "the joint (PositionOutput)",
    )
    return float(travel.max()), after


def _silence(
    bench: JointBench, driver: JointDriver, velocity: FloatArray, before: JointState
) -> tuple[FloatArray, float]:
    """Largest allowed travel (n,) of joints from ``before``, with the last command now, and the time to wait for it
    [s].
    """
    timeout, brake = driver.describe().command_timeout_s, bench.setup.brake_s
    speed, slack = np.abs(velocity), resolutions(driver) + SLACK
    elapsed = (bench.now_ns() - before.t_ns) * 1e-9
    slowest = min(2.0 * float((slack / speed).max()), LONGER_S)
    allowed = speed * (elapsed + 1.5 * timeout + 0.5 * brake) + slack
    return allowed, 2.0 * timeout + brake + SILENCE_S + slowest


def stands_once_closed(bench: JointBench) -> str:
    """Check that close() of a moving arm leaves it at rest, stopped by the driver or at the latest by the device's
    time-out.
    """
    driver = bench.active()
    velocity = bench.slow(driver)
    bench.drive(driver, velocity, 0.2)
    before, start = bench.read(driver), bench.setup.true_positions(driver)
    if start is None and not bench.setup.real_time:
        driver.stop()
        raise CheckNotRunError("nobody tells where the arm is once the driver is closed: true_positions()")
    bench.write(driver, velocity)
    allowed, silence = _silence(bench, driver, velocity, before)
    driver.close()
    bench.wait(silence)
    truth = bench.setup.true_positions(driver)
    again = bench.configured()
    after = _settled(bench, again).copy()
    call_stop(again, "of another driver of the same arm")
    travel = np.abs(after - before.positions) if start is None or truth is None else np.abs(truth - start)
    worst = int(np.argmax(travel / allowed))
    require(
        bool(travel[worst] <= allowed[worst]),
        f"joint {worst} goes on by {travel[worst]:.3g} rad or m in {silence:.2g} s after close(); "
        f"{allowed[worst]:.3g} is allowed (time-out and braking)",
    )
    return f"travelled {float(travel.max()):.2g} rad or m after close()"


def _settled(bench: JointBench, driver: JointDriver) -> FloatArray:
    """Positions (n,) by the fifth sample after a silence; earlier ones may be old, or refused as too old."""
    period, refusal = 1.0 / driver.describe().rate_hz, None
    for _ in range(max(5, round(bench.setup.joint_timeout_s / period))):
        try:
            return bench.settle(driver, 5 * period).positions
        except DriverError as error:
            refusal = error
    assert refusal is not None
    raise refusal


def _recovery(bench: JointBench, driver: JointDriver, velocity: FloatArray, positions: FloatArray) -> str:
    """Text on the effect of a new command on an arm at rest at ``positions`` (n,) since commands ceased.

    Raises CheckFailedError if it neither moves it nor raises DriverError.
    """
    try:
        bench.drive(driver, velocity, 0.3)
        moved = (bench.read(driver).positions - positions) * np.sign(velocity)
    except DriverError as error:
        return f"is refused ({error.code})"
    require(
        bool(np.all(moved > 0.0)),
        "after a time-out new commands neither move every joint as commanded nor raise DriverError: "
        f"{', '.join(f'{travel:+.3g}' for travel in moved)} rad or m",
        "clear the device's watchdog before the next command, or raise DriverError in write_velocity()",
    )
    return "moves it again"


def keeps_position_limits(bench: JointBench) -> str:
    """Check that a joint that is driven against its limit stops there, and returns."""
    allowed_here = bench.setup.whole_range
    if not (not bench.setup.real_time if allowed_here is None else allowed_here):
        raise CheckNotRunError("drives every joint to a limit: whole_range, `--whole-range`")
    driver = bench.active()
    description = driver.describe()
    period = 1.0 / description.rate_hz
    low, high = (np.array([getattr(j, f"position_{end}") for j in description.joints]) for end in ("min", "max"))
    outward = -np.sign(bench.slow(driver))
    limit = np.where(outward > 0.0, high, low)
    speed = 0.5 * np.array([joint.velocity_max for joint in description.joints])
    acceleration = np.array([joint.acceleration_max for joint in description.joints])
    distance = np.abs(limit - bench.read(driver).positions)
    seconds = min(float((distance / speed).max()) + 0.5, LONGEST_DRIVE_S)
    states = bench.drive(driver, outward * speed, seconds)
    bench.write(driver, zero(driver))
    times_ns = [*(s.t_ns for s in states), bench.now_ns()]
    state = bench.settle(driver, bench.setup.brake_s)
    beyond = np.max([(s.positions - limit) * outward for s in (*states, state)], axis=0)
    steps = resolutions(driver)
    silence = float(np.diff(times_ns).max()) * 1e-9  # longer than a cycle on a machine that stalls
    unled = period + min(max(silence, period), 1.5 * description.command_timeout_s)
    allowed = unled * speed + 0.5 * speed**2 / acceleration + steps + SLACK
    worst = int(np.argmax(beyond - allowed))
    name = description.joints[worst].name
    require(
        bool(beyond[worst] <= allowed[worst]),
        f"joint {name} goes {beyond[worst]:.3g} rad or m beyond its limit; {allowed[worst]:.3g} is allowed (braking, "
        f"and {1e3 * unled:.3g} ms until the next command)",
    )
    before = bench.read(driver).positions
    bench.drive(driver, -outward * 0.2 * speed, 0.3)
    inward = (before - bench.read(driver).positions) * outward
    require(bool(np.all(inward > 0.0)), f"at their limits joints do not move inward again: {inward.tolist()}")
    reached = int((distance < speed * seconds).sum())
    return f"{reached} joints driven to a limit, at most {float(beyond.max()):+.2g} rad or m beyond"


def orders_auxiliary(bench: JointBench) -> str:
    """Check that auxiliary joints move to commanded positions, and stop."""
    driver = bench.active()
    specs = driver.describe().auxiliary
    if not specs:
        raise CheckNotRunError("it declares no auxiliary joints or outputs")
    if not isinstance(driver, AuxiliaryDriver):
        raise CheckFailedError("it declares auxiliary joints, and has not the methods of AuxiliaryDriver")
    before = driver.read_auxiliary()
    require(set(before) == {spec.name for spec in specs}, f"read_auxiliary() tells {before}")
    ends = {s.name: s.high if before[s.name] - s.low < s.high - before[s.name] else s.low for s in specs}
    refused(lambda: driver.write_auxiliary({"nobody": 0.0}), "an order to an auxiliary joint that is not there")
    for spec in specs:
        too_far = {spec.name: spec.high + 1.0}
        refused(lambda too_far=too_far: driver.write_auxiliary(too_far), f"{too_far} beyond its limits")
    try:
        driver.write_auxiliary(ends)
        bench.drive(driver, zero(driver), 0.1)
        call_stop(driver, "while an auxiliary joint moves")
        bench.settle(driver, 0.2)
        stopped = driver.read_auxiliary()
        bench.settle(driver, 0.3)
        after = driver.read_auxiliary()
    finally:  # outputs remain switched after a stop
        outputs = {spec.name: before[spec.name] for spec in specs if spec.kind == "digital"}
        if outputs:
            driver.write_auxiliary(outputs)
    for spec in specs:
        now, was = stopped[spec.name], before[spec.name]
        require(
            (now - was) * (ends[spec.name] - was) > 0.0, f"{spec.name} is at {now:g}, ordered to {ends[spec.name]:g}"
        )
        still = abs(after[spec.name] - now) <= 1e-3 * (spec.high - spec.low)
        require(still, f"{spec.name} moves on after stop(), from {now:g} to {after[spec.name]:g}")
    driver.deactivate()
    refused(lambda: driver.write_auxiliary(before), "an order to auxiliary joints of an arm that is off")
    return ", ".join(f"{name} {value:.3g}" for name, value in after.items())


def answers_in_time(bench: JointBench) -> str:
    """Check that calls take no longer than stated, and both fit into a cycle."""
    driver = bench.active()
    description = driver.describe()
    period, velocity = 1.0 / description.rate_hz, bench.slow(driver)

    def written() -> None:
        bench.write(driver, velocity)
        bench.wait(period)

    def read() -> None:
        bench.wait(period)
        bench.read(driver)

    reads = call_times_us(CALLS, driver.read_state, written)
    writes = call_times_us(CALLS, lambda: driver.write_velocity(velocity), read)
    driver.stop()
    budget, texts, medians = description.call_budget_us, [], []
    for name, times in (("read_state", reads), ("write_velocity", writes)):
        median, p99 = np.percentile(times, [50, 99])
        require(
            bool(median <= budget),
            f"{name}() takes {median:.0f} us (median of {CALLS}); call_budget_us states {budget:.0f}",
        )
        texts.append(f"{name} {median:.0f} us (median of {CALLS}; p99 {p99:.0f})")
        medians.append(median)
    require(
        sum(medians) <= 1e6 * period,
        f"{' and '.join(texts)} take more than a cycle, which has {1e6 * period:.0f} us at {description.rate_hz:g} Hz",
    )
    return f"{', '.join(texts)}; budget of each {budget:.0f} us, cycle {1e6 * period:.0f} us"


def tells_faults_of_the_device(bench: JointBench) -> str:
    """Check that a fault of the device raises DriverError; after its repair the driver is configured and activated
    again.
    """
    driver = bench.active()
    missing = "nobody makes the device fail (protective stop, hardware error): break_down()"
    setup = bench.setup
    with _failed(bench, driver, setup.break_down, setup.mend, missing, "the device has a fault") as told:
        call_stop(driver, "with a fault of the device")
        driver.deactivate()
    setup.configure(driver)  # as by the command `reset`
    driver.activate()
    bench.drive(driver, zero(driver), 0.05)
    return f"{told}; mended, it is configured and activated again"


def reports_a_lost_device(bench: JointBench) -> str:
    """Check that a lost device raises DriverError, and that stop() and close() then raise nothing."""
    driver = bench.active()
    missing = "nobody pulls the cable: override unplug(), or `--pull`"
    setup = bench.setup
    with _failed(bench, driver, setup.unplug, setup.plug_in, missing, "the device has gone") as told:
        call_stop(driver, "with the device gone")
        call_stop(driver, "with the device gone, a second time")
        driver.close()
    return f"{told}; stop() and close() raise nothing"


@contextmanager
def _failed(
    bench: JointBench,
    driver: JointDriver,
    fail: Callable[[JointDriver], bool],
    undo: Callable[[JointDriver], None],
    missing: str,
    since: str,
) -> Iterator[str]:
    """Context manager with the arm in motion while its device fails, until the failure is undone; yields the reported
    code and its delay as text.

    Raises CheckNotRunError with the ``missing`` function, CheckFailedError.
    """
    velocity, period = bench.slow(driver), 1.0 / driver.describe().rate_hz
    bench.drive(driver, velocity, 0.1)
    if not fail(driver):
        raise CheckNotRunError(missing)
    start_ns = bench.now_ns()
    try:
        code = _await_fault(bench, driver, velocity, period, since)
        yield f"{code} after {(bench.now_ns() - start_ns) * 1e-9:.2f} s"
    finally:
        undo(driver)


def _await_fault(bench: JointBench, driver: JointDriver, velocity: Any, period: float, since: str) -> str:
    for _ in range(max(round(bench.setup.fault_s / period), 1)):
        try:
            driver.read_state()
            driver.write_velocity(velocity)
        except DriverError as error:
            return error.code
        except Exception as error:
            text = f"{since}, and {type(error).__name__} is raised, not DriverError: {error}"
            raise CheckFailedError(text) from error
        bench.wait(period)
    raise CheckFailedError(f"{since} since {bench.setup.fault_s:g} s, and no call has raised DriverError")


# -- joint checks ------------------------------------------------------------------------------------------


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
    JointCheck("refuses calls before configure", refuses_before_configure,
               "DriverLifecycle.require() at the beginning of each call", False),
    JointCheck("stop raises nothing unconnected", stops_unconnected, "stop() must do nothing there", False),
    JointCheck("keeps its description", keeps_its_description, "read limits before configure()"),
    JointCheck("refuses commands unless active", refuses_unless_active,
               "DriverLifecycle.require(); activate() again after deactivate()"),
    JointCheck("refuses calls once closed", refuses_once_closed, "DriverLifecycle.require(); close() twice"),
    JointCheck("leaves nothing behind", leaves_nothing_behind, "join threads, close ports and sockets in close()"),
    JointCheck("numbers and stamps its samples", numbers_its_samples,
               "stamp with context.clock when the device was read, and read it often enough; count each sample"),
    JointCheck("stands when activated", stands_when_activated,
               "activate() at velocity zero or where it stands; configure() connects and reads"),
    JointCheck("moves as told", moves_as_told,
               "units [rad, m], gear, and the sign of commands against positions; of a Cartesian arm, whose axes its "
               "twists are in, and whether its pose is base from tool"),
    JointCheck("stops", stops, "stop() commands velocity zero, in any state, and catches what the device raises"),
    JointCheck("stops when commands cease", stops_when_commands_cease,
               "the device's own watchdog, or positions within a lead of the joint (PositionOutput)"),
    JointCheck("stands once closed", stands_once_closed,
               "close() begins with stop(), and leaves the device's time-out armed until the arm stands"),
    JointCheck("refuses bad commands", refuses_bad_commands, "check shape and np.isfinite before anything is sent"),
    JointCheck("cuts velocities at the limits", cuts_velocities, "clip to velocity_max and say it in reasons"),
    JointCheck("agrees with its velocities", agrees_with_its_velocities,
               "units [rad/s, m/s] and sign of the velocities; of a Cartesian arm, whether its three angles are a "
               "rotation vector or turns in some order"),
    JointCheck("states its resolution", states_its_resolution, "JointSpec(resolution=encoder step at the joint)"),
    JointCheck("keeps samples apart", keeps_samples_apart, "new arrays in every JointState and CommandReport"),
    JointCheck("is silent once closed", is_silent_once_closed, "end threads in close(); stop() only while open"),
    JointCheck("answers in time", answers_in_time,
               "read in a thread, ask for less, or state the call_budget_us and rate_hz that are kept"),
    JointCheck("orders auxiliary joints", orders_auxiliary,
               "kit.auxiliary.verify_order(); stop() holds auxiliary joints, too; require ACTIVE in write_auxiliary()"),
    JointCheck("keeps position limits", keeps_position_limits, "at a limit, send velocities inward only"),
    JointCheck("tells faults of the device", tells_faults_of_the_device,
               "read_state() looks at the device's error and safety bits, and raises DriverError; configure() clears "
               "what can be cleared"),
    JointCheck("reports a lost device", reports_a_lost_device,
               "raise DriverError('connection_lost') when answers cease; catch everything in stop() and close()"),
)  # fmt: skip
"""Checks in the order of execution: first those that need no device, and those that may show that an arm must not move.
"""
