"""Checks that every joint driver must pass; `stereoservo driver-check` and the contract suite run them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.ports.devices import AuxiliaryDriver, DriverError, JointDriver
from stereoservo_drivers.kit.bench import (
    CheckFailedError,
    CheckNotRunError,
    JointBench,
    JointDriverSetup,
    call_times_us,
    require,
)

Verdict = Literal["passed", "failed", "not run"]

MOVED_SHARE = (0.3, 1.5)
"""Of the commanded travel: what a joint must move at least, and at most."""
SLACK = 1e-3
"""[rad or m] Beside what a bound is derived from."""
FINEST = 0.6e-3
"""[rad or m] Encoders with coarser steps must state them."""
STALE_S, STALE_PERIODS = 0.1, 10
SLOW_CALLS, SLOW_CALL_US = 20.0, 20_000.0
"""A call whose median is above both so many budgets and so long blocks."""
GONE_S = 1.0
"""Time for threads to end."""
LONGEST_DRIVE_S = 12.0


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
    """Run one check on drivers of its own, which are closed after it; ``folder``: an empty one."""
    try:
        bench = JointBench(setup, setup.make_context(folder))
        try:
            measured = check.run(bench)
        finally:
            bench.close()
    except CheckNotRunError as reason:
        return CheckResult(check.name, "not run", str(reason))
    except CheckFailedError as failure:
        return CheckResult(check.name, "failed", str(failure), check.remedy)
    except Exception as error:  # whatever a third party's driver raises is a finding
        return CheckResult(check.name, "failed", f"raised {type(error).__name__}: {error}", check.remedy)
    return CheckResult(check.name, "passed", measured)


def refused(call: Callable[[], Any], what: str) -> str:
    """Code of the DriverError that ``call`` must raise. Raises CheckFailedError where it does not."""
    try:
        call()
    except DriverError as error:
        require(bool(error.code and str(error)), f"{what} is refused without a code or text")
        return error.code
    except Exception as error:
        raise CheckFailedError(f"{what} raises {type(error).__name__}, not DriverError: {error}") from error
    raise CheckFailedError(f"{what} is not refused")


def _zero(driver: JointDriver) -> Any:
    return np.zeros(len(driver.describe().joints))


# -- without the device ----------------------------------------------------------------------------------------


def _describes_itself(bench: JointBench) -> str:
    driver = bench.new()
    require(isinstance(driver, JointDriver), f"{type(driver).__name__} lacks methods of JointDriver")
    description = driver.describe()
    names = [joint.name for joint in description.joints]
    require(bool(names) and len(set(names)) == len(names), f"joints are called {names}")
    for joint in description.joints:
        require(joint.position_min < joint.position_max, f"{joint.name}: empty range of positions")
        require(
            joint.velocity_max > 0 and joint.acceleration_max > 0, f"{joint.name}: limits must be above 0"
        )
        require(
            joint.resolution < joint.position_max - joint.position_min,
            f"{joint.name}: resolution above its range",
        )
    for name in ("rate_hz", "command_timeout_s", "call_budget_us"):
        require(getattr(description, name) > 0, f"{name} must be above 0")
    require(len(description.effort_units) in (0, len(names)), "effort_units: none, or one for each joint")
    return f"{len(names)} joints at {description.rate_hz:g} Hz, time-out {description.command_timeout_s:g} s"


def _refuses_before_configure(bench: JointBench) -> str:
    driver = bench.new()
    codes = [
        refused(call, f"{name}() before configure()")
        for name, call in (
            ("read_state", driver.read_state),
            ("activate", driver.activate),
            ("write_velocity", lambda: driver.write_velocity(_zero(driver))),
        )
    ]
    return ", ".join(dict.fromkeys(codes))


def _stops_unconnected(bench: JointBench) -> str:
    driver = bench.new()
    for state in ("before configure()", "after close()"):
        for _ in range(2):
            _call_stop(driver, state)
        driver.close()
    return "stop() and close(), twice each"


def _call_stop(driver: JointDriver, when: str) -> None:
    try:
        driver.stop()
    except Exception as error:
        raise CheckFailedError(f"stop() {when} raises {type(error).__name__}: {error}") from error


# -- lifecycle ---------------------------------------------------------------------------------------------------


def _keeps_its_description(bench: JointBench) -> str:
    driver = bench.new()
    before = driver.describe()
    bench.setup.configure(driver)
    require(driver.describe() == before, "describe() changes with configure()")
    driver.activate()
    require(driver.describe() == before, "describe() changes with activate()")
    return "the same in three states"


def _refuses_unless_active(bench: JointBench) -> str:
    driver = bench.configured()
    codes = [refused(lambda: driver.write_velocity(_zero(driver)), "write_velocity() before activate()")]
    driver.activate()
    driver.deactivate()
    driver.deactivate()
    codes.append(refused(lambda: driver.write_velocity(_zero(driver)), "write_velocity() after deactivate()"))
    driver.activate()
    bench.drive(driver, _zero(driver), 0.05)
    return f"{codes[0]}, {codes[1]}; activated again"


def _refuses_once_closed(bench: JointBench) -> str:
    driver = bench.active()
    driver.close()
    driver.close()
    codes = [refused(driver.read_state, "read_state() after close()")]
    codes.append(refused(lambda: driver.write_velocity(_zero(driver)), "write_velocity() after close()"))
    return ", ".join(dict.fromkeys(codes))


def _is_silent_once_closed(bench: JointBench) -> str:
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


def _leaves_nothing_behind(bench: JointBench) -> str:
    for first in (True, False):  # what is loaded once, by the first driver, is no leak
        threads, files = set(threading.enumerate()), _open_files()
        driver = bench.active()
        bench.drive(driver, _zero(driver), 0.05)
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


def _numbers_its_samples(bench: JointBench) -> str:
    driver = bench.active()
    period = 1.0 / driver.describe().rate_hz
    states, ages = [], []
    for _ in range(20):
        bench.wait(period)
        states.append(bench.read(driver))
        ages.append((bench.now_ns() - states[-1].t_ns) * 1e-9)
    require(states[-1].t_ns > states[0].t_ns, "stamps stand still")
    require(states[-1].seq > states[0].seq, "sequence numbers stand still")
    age, most = float(np.median(ages)), max(STALE_S, STALE_PERIODS * period)
    require(age <= most, f"samples are {age:.3g} s old (median), at most {most:g} s is allowed")
    return f"age {age * 1e3:.2f} ms (median)"


def _keeps_samples_apart(bench: JointBench) -> str:
    driver = bench.active()
    velocity = bench.slow(driver)
    state = bench.read(driver)
    positions = state.positions.copy()
    bench.drive(driver, velocity, 0.2)
    require(
        np.array_equal(state.positions, positions), "a later read changes the arrays of an earlier sample"
    )
    report = bench.write(driver, velocity)
    asked = velocity.copy()
    velocity[:] = 0.0
    require(np.array_equal(report.asked, asked), "the report keeps the caller's array, which changes")
    return "samples and reports own their arrays"


def _agrees_with_its_velocities(bench: JointBench) -> str:
    driver = bench.active()
    states = bench.drive(driver, bench.slow(driver), 0.6)
    states = states[len(states) // 2 :]
    elapsed = (states[-1].t_ns - states[0].t_ns) * 1e-9
    require(elapsed > 0.0, "stamps stand still while the arm moves")
    travelled = (states[-1].positions - states[0].positions) / elapsed
    told = np.mean([state.velocities for state in states], axis=0)
    steps = np.array([joint.resolution for joint in driver.describe().joints])
    error = np.abs(told - travelled)
    allowed = 0.3 * np.abs(travelled) + 2.0 * steps / elapsed + bench.setup.rest_velocity
    worst = int(np.argmax(error / allowed))
    require(
        bool(error[worst] <= allowed[worst]),
        f"joint {worst}: velocities say {told[worst]:.4g}, positions {travelled[worst]:.4g} rad/s or m/s",
    )
    return f"velocities within {float(error.max()):.2g} rad/s or m/s of the positions' change"


def _states_its_resolution(bench: JointBench) -> str:
    driver = bench.active()
    description = driver.describe()
    period = 1.0 / description.rate_hz
    stated = np.array([joint.resolution for joint in description.joints])
    slow = bench.slow(driver)
    creep = np.minimum(0.15 * np.maximum(stated, FINEST) / period, np.abs(slow))
    bench.drive(driver, np.sign(slow) * creep, 0.2)
    states = bench.drive(driver, np.sign(slow) * creep, max(0.6, 60 * period))
    changes = np.abs(np.diff([state.positions for state in states], axis=0))
    steps = np.array(
        [np.median(column[column > 0.0]) if (column > 0.0).any() else 0.0 for column in changes.T]
    )
    if not steps.all():
        raise CheckNotRunError("a joint does not move when it is commanded to creep; its steps are unknown")
    allowed = np.maximum(1.6 * np.maximum(stated, FINEST), 3.0 * creep * period)
    worst = int(np.argmax(steps / allowed))
    require(
        bool(steps[worst] <= allowed[worst]),
        f"joint {worst} changes by {steps[worst]:.3g} rad or m at a time, resolution states {stated[worst]:.3g}",
    )
    return f"steps of {', '.join(f'{step:.2g}' for step in steps)} rad or m"


# -- motion ------------------------------------------------------------------------------------------------------


def _stands_when_activated(bench: JointBench) -> str:
    driver = bench.configured()
    before = bench.read(driver).positions
    driver.activate()
    state = bench.settle(driver, 0.2)
    travel = float(np.abs(state.positions - before).max())
    steps = max(joint.resolution for joint in driver.describe().joints)
    require(travel < SLACK + steps, f"activate() alone moves the arm by {travel:.3g} rad or m")
    speed = float(np.abs(state.velocities).max())
    require(speed < bench.setup.rest_velocity, f"after activate() the arm moves at {speed:.3g} rad/s or m/s")
    return f"moved {travel:.2g} rad or m"


def _moves_as_told(bench: JointBench) -> str:
    driver = bench.active()
    velocity = bench.slow(driver)
    start_ns, before = bench.now_ns(), bench.read(driver).positions
    seconds = 0.3
    bench.drive(driver, velocity, seconds)
    moved = (bench.read(driver).positions - before) * np.sign(velocity)
    elapsed = (bench.now_ns() - start_ns) * 1e-9  # more than asked for on a machine that stalls
    steps = np.array([joint.resolution for joint in driver.describe().joints])
    least = MOVED_SHARE[0] * seconds * np.abs(velocity) - 2.0 * steps
    most = MOVED_SHARE[1] * elapsed * np.abs(velocity) + 2.0 * steps + SLACK
    for k, (travel, low, high) in enumerate(zip(moved, np.maximum(least, 1e-9), most, strict=True)):
        require(
            low <= travel <= high,
            f"joint {k} moved {travel:+.4g} rad or m in the commanded direction; {low:.4g} to {high:.4g} is required",
        )
    shares = moved / (elapsed * np.abs(velocity))
    return f"{shares.min():.0%} to {shares.max():.0%} of the commanded travel"


def _cuts_velocities(bench: JointBench) -> str:
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


def _refuses_bad_commands(bench: JointBench) -> str:
    driver = bench.active()
    zero = _zero(driver)
    codes = [refused(lambda: driver.write_velocity(np.zeros(len(zero) + 1)), "a command of another shape")]
    for bad in (np.nan, np.inf, -np.inf):
        command = zero.copy()
        command[0] = bad
        codes.append(refused(lambda command=command: driver.write_velocity(command), f"a velocity of {bad}"))
    bench.write(driver, zero)
    return ", ".join(dict.fromkeys(codes))


def _stops(bench: JointBench) -> str:
    driver = bench.active()
    velocity = bench.slow(driver)
    bench.drive(driver, velocity, 0.2)
    _call_stop(driver, "while moving")
    _call_stop(driver, "while stopping")
    state = bench.settle(driver, bench.setup.brake_s)
    bench.require_rest(driver, f"{bench.setup.brake_s:g} s after stop()")
    bench.drive(driver, velocity, 0.2)
    driver.deactivate()
    _call_stop(driver, "after deactivate()")
    bench.settle(driver, bench.setup.brake_s)
    bench.require_rest(driver, "after deactivate()")
    return (
        f"at rest after {bench.setup.brake_s:g} s, {float(np.abs(state.velocities).max()):.2g} rad/s or m/s"
    )


def _stops_when_commands_cease(bench: JointBench) -> str:
    if not bench.setup.enforces_timeout:
        raise CheckNotRunError("this device has no command time-out of its own (enforces_timeout)")
    driver = bench.active()
    timeout = driver.describe().command_timeout_s
    velocity = bench.slow(driver)
    bench.drive(driver, velocity, 0.2)
    before, start_ns = bench.read(driver).positions, bench.now_ns()
    after = bench.settle(driver, timeout + bench.setup.brake_s)
    bench.require_rest(
        driver, f"{timeout:g} s (time-out) and {bench.setup.brake_s:g} s after the last command"
    )
    travel = np.abs(after.positions - before)
    bench.drive(driver, velocity, 0.3)
    again = (bench.read(driver).positions - after.positions) * np.sign(velocity)
    require(bool(np.all(again > 0)), f"after a time-out the arm does not move again: {again.tolist()}")
    elapsed = (bench.now_ns() - start_ns) * 1e-9
    return (
        f"travelled {float(travel.max()):.2g} rad or m without commands; moved again within {elapsed:.1f} s"
    )


def _keeps_position_limits(bench: JointBench) -> str:
    allowed_here = bench.setup.whole_range
    if not (not bench.setup.real_time if allowed_here is None else allowed_here):
        raise CheckNotRunError("drives every joint to a limit: whole_range, `--whole-range`")
    driver = bench.active()
    description = driver.describe()
    period = 1.0 / description.rate_hz
    low, high = (
        np.array([getattr(j, f"position_{end}") for j in description.joints]) for end in ("min", "max")
    )
    outward = -np.sign(bench.slow(driver))
    limit = np.where(outward > 0.0, high, low)
    speed = 0.5 * np.array([joint.velocity_max for joint in description.joints])
    acceleration = np.array([joint.acceleration_max for joint in description.joints])
    distance = np.abs(limit - bench.read(driver).positions)
    seconds = min(float((distance / speed).max()) + 0.5, LONGEST_DRIVE_S)
    states = bench.drive(driver, outward * speed, seconds)
    bench.write(driver, _zero(driver))
    state = bench.settle(driver, bench.setup.brake_s)
    beyond = np.max([(s.positions - limit) * outward for s in (*states, state)], axis=0)
    steps = np.array([joint.resolution for joint in description.joints])
    allowed = 2.0 * speed * period + 0.5 * speed**2 / acceleration + steps + SLACK
    worst = int(np.argmax(beyond - allowed))
    name = description.joints[worst].name
    require(
        bool(beyond[worst] <= allowed[worst]),
        f"joint {name} goes {beyond[worst]:.3g} rad or m beyond its limit; {allowed[worst]:.3g} is allowed (braking)",
    )
    before = bench.read(driver).positions
    bench.drive(driver, -outward * 0.2 * speed, 0.3)
    inward = (before - bench.read(driver).positions) * outward
    require(bool(np.all(inward > 0.0)), f"at their limits joints do not move inward again: {inward.tolist()}")
    reached = int((distance < speed * seconds).sum())
    return f"{reached} joints driven to a limit, at most {float(beyond.max()):+.2g} rad or m beyond"


def _orders_auxiliary(bench: JointBench) -> str:
    driver = bench.active()
    specs = driver.describe().auxiliary
    if not specs:
        raise CheckNotRunError("it declares no auxiliary joints or outputs")
    if not isinstance(driver, AuxiliaryDriver):
        raise CheckFailedError("it declares auxiliary joints, and has not the methods of AuxiliaryDriver")
    before = driver.read_auxiliary()
    require(set(before) == {spec.name for spec in specs}, f"read_auxiliary() tells {before}")
    ends = {s.name: s.high if before[s.name] - s.low < s.high - before[s.name] else s.low for s in specs}
    refused(
        lambda: driver.write_auxiliary({"nobody": 0.0}), "an order to an auxiliary joint that is not there"
    )
    for spec in specs:
        too_far = {spec.name: spec.high + 1.0}
        refused(lambda too_far=too_far: driver.write_auxiliary(too_far), f"{too_far} beyond its limits")
    try:
        driver.write_auxiliary(ends)
        bench.drive(driver, _zero(driver), 0.1)
        _call_stop(driver, "while an auxiliary joint moves")
        bench.settle(driver, 0.2)
        stopped = driver.read_auxiliary()
        bench.settle(driver, 0.3)
        after = driver.read_auxiliary()
    finally:  # a stop leaves outputs switched
        outputs = {spec.name: before[spec.name] for spec in specs if spec.kind == "digital"}
        if outputs:
            driver.write_auxiliary(outputs)
    for spec in specs:
        now, was = stopped[spec.name], before[spec.name]
        require(
            (now - was) * (ends[spec.name] - was) > 0.0,
            f"{spec.name} is at {now:g}, ordered to {ends[spec.name]:g}",
        )
        still = abs(after[spec.name] - now) <= 1e-3 * (spec.high - spec.low)
        require(still, f"{spec.name} moves on after stop(), from {now:g} to {after[spec.name]:g}")
    driver.deactivate()
    refused(lambda: driver.write_auxiliary(before), "an order to auxiliary joints of an arm that is off")
    return ", ".join(f"{name} {value:.3g}" for name, value in after.items())


def _answers_in_time(bench: JointBench) -> str:
    driver = bench.active()
    description = driver.describe()
    period, velocity = 1.0 / description.rate_hz, bench.slow(driver)

    def written() -> None:
        bench.write(driver, velocity)
        bench.wait(period)

    def read() -> None:
        bench.wait(period)
        bench.read(driver)

    reads = call_times_us(50, driver.read_state, written)
    writes = call_times_us(50, lambda: driver.write_velocity(velocity), read)
    driver.stop()
    most = max(SLOW_CALLS * description.call_budget_us, SLOW_CALL_US)
    texts = []
    for name, times in (("read_state", reads), ("write_velocity", writes)):
        median, p99 = np.percentile(times, [50, 99])
        require(
            bool(median <= most),
            f"{name}() takes {median:.0f} us (median); call_budget_us states {description.call_budget_us:.0f}",
        )
        texts.append(f"{name} {median:.0f} us, p99 {p99:.0f}")
    return f"{'; '.join(texts)}; budget {description.call_budget_us:.0f} us"


def _reports_a_lost_device(bench: JointBench) -> str:
    driver = bench.active()
    velocity, period = bench.slow(driver), 1.0 / driver.describe().rate_hz
    bench.drive(driver, velocity, 0.1)
    if not bench.setup.unplug(driver):
        raise CheckNotRunError("nobody pulls the cable: override unplug(), or `--pull`")
    start_ns = bench.now_ns()
    try:
        code = _await_fault(bench, driver, velocity, period)
        waited = (bench.now_ns() - start_ns) * 1e-9
        _call_stop(driver, "with the device gone")
        _call_stop(driver, "with the device gone, a second time")
        driver.close()
    finally:
        bench.setup.plug_in(driver)
    return f"{code} after {waited:.2f} s; stop() and close() raise nothing"


def _await_fault(bench: JointBench, driver: JointDriver, velocity: Any, period: float) -> str:
    for _ in range(max(round(bench.setup.fault_s / period), 1)):
        try:
            driver.read_state()
            driver.write_velocity(velocity)
        except DriverError as error:
            return error.code
        except Exception as error:
            text = f"with the device gone, {type(error).__name__} is raised, not DriverError: {error}"
            raise CheckFailedError(text) from error
        bench.wait(period)
    raise CheckFailedError(
        f"{bench.setup.fault_s:g} s after the device has gone, no call has raised DriverError"
    )


JOINT_CHECKS = (
    JointCheck(
        "describes itself", _describes_itself, "fill in JointDriverDescription before anything connects", False
    ),
    JointCheck(
        "refuses calls before configure", _refuses_before_configure,
        "DriverLifecycle.require() at the beginning of each call", False,
    ),
    JointCheck("stop raises nothing unconnected", _stops_unconnected, "stop() must do nothing there", False),
    JointCheck("keeps its description", _keeps_its_description, "read limits before configure()"),
    JointCheck(
        "refuses commands unless active", _refuses_unless_active,
        "DriverLifecycle.require(); activate() again after deactivate()",
    ),
    JointCheck("refuses calls once closed", _refuses_once_closed, "DriverLifecycle.require(); close() twice"),
    JointCheck("leaves nothing behind", _leaves_nothing_behind, "join threads, close ports and sockets in close()"),
    JointCheck(
        "numbers and stamps its samples", _numbers_its_samples,
        "stamp with context.clock when the device was read; count each sample",
    ),
    JointCheck("stands when activated", _stands_when_activated, "activate() at velocity zero or where it stands"),
    JointCheck("moves as told", _moves_as_told, "units [rad, m], gear, and the sign of commands against positions"),
    JointCheck("stops", _stops, "stop() commands velocity zero, in any state, and catches what the device raises"),
    JointCheck(
        "stops when commands cease", _stops_when_commands_cease,
        "the device's own watchdog, or positions within a lead of the joint (PositionOutput)",
    ),
    JointCheck("refuses bad commands", _refuses_bad_commands, "check shape and np.isfinite before anything is sent"),
    JointCheck("cuts velocities at the limits", _cuts_velocities, "clip to velocity_max and say it in reasons"),
    JointCheck(
        "agrees with its velocities", _agrees_with_its_velocities, "units [rad/s, m/s] and sign of the velocities"
    ),
    JointCheck("states its resolution", _states_its_resolution, "JointSpec(resolution=encoder step at the joint)"),
    JointCheck("keeps samples apart", _keeps_samples_apart, "new arrays in every JointState and CommandReport"),
    JointCheck("is silent once closed", _is_silent_once_closed, "end threads in close(); stop() only while open"),
    JointCheck("answers in time", _answers_in_time, "read in a thread, or state a call_budget_us that is kept"),
    JointCheck(
        "orders auxiliary joints", _orders_auxiliary,
        "kit.auxiliary.verify_order(); stop() holds auxiliary joints, too; require ACTIVE in write_auxiliary()",
    ),
    JointCheck("keeps position limits", _keeps_position_limits, "at a limit, send velocities inward only"),
    JointCheck(
        "reports a lost device", _reports_a_lost_device,
        "raise DriverError('connection_lost') when answers cease; catch everything in stop() and close()",
    ),
)  # fmt: skip
"""In the order in which they are run: those first that need no device, and those that may show that an arm must not
move.
"""
