"""Checks of joint drivers that move the arm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import AuxiliaryDriver, DriverError, JointDriver, JointState
from stereoservo_drivers.kit.bench import (
    FRESH_SHARE,
    CheckFailedError,
    CheckNotRunError,
    JointBench,
    call_stop,
    call_times_us,
    refused,
    require,
    resolutions,
    zero,
)

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
