"""Test bench of joint drivers: data on the device, and calls with verified results."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.messages.cell_file import SafetySection
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.clock import MonotonicClock, VirtualClock
from stereoservo.ports.devices import CommandReport, DriverContext, DriverError, JointDriver, JointState

RUNAWAY, RUNAWAY_TIMES = 0.03, 3.0
"""[rad or m], and multiple of the commanded travel: an arm that travels farther is stopped."""
FUTURE_NS = 1_000_000
"""Tolerance of stamps in the future: several reads at one time of a virtual clock may have increasing stamps."""
FRESH_SHARE = 0.5
"""Share of ``safety.joint_timeout_s`` that is the largest age of samples when read; the rest is for a cycle and stalls.
"""
STAMP_REMEDY = (
    "stamps are times of context.clock, never later than now, and rise; a device's own clock is brought to it by "
    "kit.timing"
)
RUNAWAY_REMEDY = (
    "units [rad, m] and gear of commands and positions; of a Cartesian arm, units and axes of its pose and its twists; "
    "where it is one sample only, an answer was taken that is torn or has a wrong checksum"
)
RAISED = {
    "describe": "describe() tells the joints before anything connects",
    "configure": "mend what it tells of the device: power, cable, ids, modes, options",
    "activate": "mend what it tells of the device: supply, faults, emergency stop, brakes",
    "read_state": "mend what it tells; answers that are lost now and then give the sample before once more (Freshness)",
    "write_velocity": "mend what it tells; finite commands while active are carried out, cut at the limits",
    "stop": "stop() raises nothing, in any state: catch there whatever the device raises",
    "deactivate": "deactivate() may be called in any state, twice, too",
    "close": "close() raises nothing, in any state: catch there whatever the device raises",
}
"""Call -> remedy if it raises."""


class CheckFailedError(Exception):
    """A check has failed; the text has the finding and the requirement.

    ``remedy``: if it differs from that of the check.
    """

    def __init__(self, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.remedy = remedy


class CheckNotRunError(Exception):
    """A check cannot be run here; the text has the reason."""


class Paced:
    """Time and context of a device under check."""

    real_time = False
    """True: the device runs in real time (hardware, another process). False: it follows the context's clock."""

    def make_context(self, folder: Path) -> DriverContext:
        """The context given to the driver."""
        clock = MonotonicClock() if self.real_time else VirtualClock()
        return DriverContext(clock=clock, cell="contract", runtime_dir=folder, cell_dir=folder, seed=1)

    def wait(self, context: DriverContext, seconds: float) -> None:
        """Let ``seconds`` pass on the driver's clock."""
        if isinstance(context.clock, VirtualClock):
            context.clock.advance_to(context.clock.now_ns() + round(seconds * 1e9))
        else:
            time.sleep(seconds)


class JointDriverSetup(Paced):
    """Data that the checks of a joint driver need: override :meth:`make_driver`, and anything else that differs."""

    speed = 0.05
    """Fraction of each joint's largest velocity at which the checks move the arm."""
    rest_velocity = 1e-3
    """Velocity [rad/s or m/s] below which the arm counts as at rest."""
    brake_s = 1.0
    """Time [s] in which the arm must come to rest from ``speed``."""
    joint_timeout_s = SafetySection().joint_timeout_s
    """``safety.joint_timeout_s`` of the driver's cells: older samples stop the arm."""
    enforces_timeout = True
    """Whether the device stops by itself when commands cease. Every device should; set False only with a reason."""
    fault_s = 1.0
    """Time limit for reporting a lost device."""
    whole_range: bool | None = None
    """Whether joints may be driven to their limits (None: only if the device is simulated)."""

    def make_driver(self, context: DriverContext) -> JointDriver:
        """A new driver, not connected."""
        raise NotImplementedError("override make_driver(context)")

    def configure(self, driver: JointDriver) -> None:
        """Configure a driver; override it if a device needs more."""
        driver.configure()

    def unplug(self, driver: JointDriver) -> bool:
        """Make the device disappear, as if its cable were pulled; returns whether that was possible."""
        return False

    def plug_in(self, driver: JointDriver) -> None:
        """Undo :meth:`unplug`, once the driver is closed."""

    def break_down(self, driver: JointDriver) -> bool:
        """Make the device report a failure (protective stop, hardware error); returns whether that was possible."""
        return False

    def mend(self, driver: JointDriver) -> None:
        """Undo :meth:`break_down`, as a person at the device does, once the driver is deactivated."""

    def device_writes(self, driver: JointDriver) -> int | None:
        """Number of writes received by the device so far; None if they are not counted."""
        return None

    def true_positions(self, driver: JointDriver) -> FloatArray | None:
        """Current joint positions (n,), in the driver's joint coordinates, measured independently of it, also after it
        is closed; None if there is no such measurement.
        """
        return None


class JointBench:
    """Drivers under check, with the results of every call verified. ``close`` closes them."""

    def __init__(self, setup: JointDriverSetup, context: DriverContext) -> None:
        self.setup = setup
        self.context = context
        self._drivers: list[JointDriver] = []
        self._last: dict[int, JointState] = {}

    def new(self) -> JointDriver:
        """A new driver, not connected."""
        try:
            driver = self.setup.make_driver(self.context)
        except Exception as error:  # whatever a third party's constructor raises
            raise CheckFailedError(
                f"the driver cannot be made: {told(error)}", "its options: `--options`, `--cell`, make_driver()"
            ) from error
        self._drivers.append(driver)
        return driver

    def configured(self) -> JointDriver:
        """A configured driver."""
        driver = self.new()
        self.setup.configure(driver)
        return driver

    def active(self) -> JointDriver:
        """An active driver."""
        driver = self.configured()
        driver.activate()
        return driver

    def close(self) -> None:
        """Close all drivers. Raises CheckFailedError, once all are closed, if close() raises."""
        raised: list[Exception] = []
        for driver in self._drivers:
            try:
                driver.close()
            except Exception as error:  # the others must be closed, too
                raised.append(error)
        try:
            if raised:
                raise self.failure(raised[0]) from raised[0]
        finally:
            self._drivers.clear()

    def failure(self, error: Exception) -> CheckFailedError:
        """The failure for an exception of a driver's call, by the calls in its traceback."""
        calls, trace = [], error.__traceback__
        while trace is not None:
            frame, trace = trace.tb_frame, trace.tb_next
            name = frame.f_code.co_name
            if name in RAISED and any(frame.f_locals.get("self") is driver for driver in self._drivers):
                calls.append(name)
        if not calls:
            return CheckFailedError(f"raised {told(error)}")
        through = f", which {calls[0]}() calls," if calls[0] != calls[-1] else ""
        return CheckFailedError(f"{calls[-1]}(){through} raised {told(error)}", RAISED[calls[-1]])

    def now_ns(self) -> int:
        """Current time of the driver's clock."""
        return self.context.clock.now_ns()

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.setup.wait(self.context, seconds)

    def read(self, driver: JointDriver) -> JointState:
        """A joint sample. Raises CheckFailedError if it has another shape, is not finite, or goes back in time."""
        state = driver.read_state()
        count = len(driver.describe().joints)
        self._verify_arrays(state, count)
        ahead_ns = state.t_ns - self.now_ns()
        require(ahead_ns <= FUTURE_NS, f"a sample is stamped {ahead_ns * 1e-6:.3g} ms in the future", STAMP_REMEDY)
        before = self._last.get(id(driver))
        if before is not None:
            require(
                state.t_ns >= before.t_ns,
                f"stamps go back by {(before.t_ns - state.t_ns) * 1e-6:.3g} ms between samples",
                STAMP_REMEDY,
            )
            require(state.seq >= before.seq, f"sequence numbers go back from {before.seq} to {state.seq}")
        self._last[id(driver)] = state
        return state

    @staticmethod
    def _verify_arrays(state: JointState, count: int) -> None:
        arrays: dict[str, Any] = {"positions": state.positions, "velocities": state.velocities}
        arrays |= {
            name: value for name in ("efforts", "following_errors") if (value := getattr(state, name)) is not None
        }
        for name, array in arrays.items():
            require(
                isinstance(array, np.ndarray) and array.shape == (count,) and array.dtype == np.float64,
                f"{name} of a sample are {array!r}; float64 of shape ({count},) are required",
            )
            require(bool(np.isfinite(array).all()), f"{name} of a sample are {array.tolist()}, not finite")

    def write(self, driver: JointDriver, velocity: FloatArray) -> CommandReport:
        """Command velocities (n,). Raises CheckFailedError if the returned report differs from the command."""
        report = driver.write_velocity(velocity)
        require(
            isinstance(report, CommandReport) and np.array_equal(report.asked, velocity),
            f"write_velocity({velocity.tolist()}) reports {report!r}",
        )
        return report

    def slow(self, driver: JointDriver) -> FloatArray:
        """A small velocity of every joint (n,), away from its nearer limit."""
        joints = driver.describe().joints
        positions = self.read(driver).positions
        middle = np.array([(j.position_min + j.position_max) / 2 for j in joints])
        signs = np.where(positions <= middle, 1.0, -1.0)
        return signs * self.setup.speed * np.array([j.velocity_max for j in joints])

    def drive(self, driver: JointDriver, velocity: FloatArray, seconds: float) -> list[JointState]:
        """Command ``velocity`` (n,) at the driver's rate for ``seconds``; returns the samples.

        Raises CheckFailedError, with the arm stopped, if a joint moves much farther than commanded.
        """
        period = 1.0 / driver.describe().rate_hz
        states: list[JointState] = []
        start_ns = self.now_ns()
        for _ in range(max(round(seconds / period), 1)):
            states.append(self.read(driver))
            asked = np.abs(velocity) * (self.now_ns() - start_ns) * 1e-9
            travel = np.abs(states[-1].positions - states[0].positions)
            if (travel > RUNAWAY_TIMES * asked + RUNAWAY).any():
                driver.stop()
                k = int(np.argmax(travel - RUNAWAY_TIMES * asked))
                raise CheckFailedError(
                    f"the arm runs away, and was stopped: joint {k} by {travel[k]:.3g} rad or m, {asked[k]:.3g} was "
                    "commanded",
                    RUNAWAY_REMEDY,
                )
            self.write(driver, velocity)
            self.wait(period)
        return states

    def settle(self, driver: JointDriver, seconds: float) -> JointState:
        """Only read, for ``seconds``; returns the last sample."""
        period = 1.0 / driver.describe().rate_hz
        for _ in range(max(round(seconds / period), 1)):
            self.wait(period)
            state = self.read(driver)
        return state

    def require_rest(self, driver: JointDriver, after: str) -> None:
        """Raise CheckFailedError if the arm is not at rest."""
        before = self.read(driver)
        state = self.settle(driver, 0.1)
        speed = float(np.abs(state.velocities).max())
        travel = float(np.abs(state.positions - before.positions).max())
        steps = max(joint.resolution for joint in driver.describe().joints)
        require(
            speed < self.setup.rest_velocity and travel < 1e-4 + steps,
            f"{after} the arm still moves: {speed:.3g} rad/s or m/s, {travel:.3g} rad or m in 0.1 s",
        )


def require(condition: bool, message: str, remedy: str = "") -> None:
    """Raise CheckFailedError unless ``condition``."""
    if not condition:
        raise CheckFailedError(message, remedy)


def told(error: Exception) -> str:
    """Kind, code and text of an exception."""
    code = f" ({error.code})" if isinstance(error, DriverError) else ""
    return f"{type(error).__name__}{code}: {error}"


def refused(call: Callable[[], Any], what: str) -> str:
    """Code of the DriverError that ``call`` must raise. Raises CheckFailedError if it does not."""
    try:
        call()
    except DriverError as error:
        require(bool(error.code and str(error)), f"{what} is refused without a code or text")
        return error.code
    except Exception as error:
        raise CheckFailedError(f"{what} raises {told(error)}; DriverError is needed") from error
    raise CheckFailedError(f"{what} is not refused")


def call_stop(driver: JointDriver, when: str) -> None:
    """Call stop(). Raises CheckFailedError if it raises."""
    try:
        driver.stop()
    except Exception as error:
        raise CheckFailedError(f"stop() {when} raised {told(error)}", RAISED["stop"]) from error


def zero(driver: JointDriver) -> FloatArray:
    """Velocity zero of every joint (n,)."""
    return np.zeros(len(driver.describe().joints))


def resolutions(driver: JointDriver) -> FloatArray:
    """Stated encoder steps (n,)."""
    return np.array([joint.resolution for joint in driver.describe().joints])


def call_times_us(calls: int, call: Callable[[], Any], before: Callable[[], Any]) -> FloatArray:
    """Durations [us] of ``calls`` calls (calls,), each after an untimed ``before``."""
    times = np.empty(calls)
    for i in range(calls):
        before()
        start = time.perf_counter_ns()
        call()
        times[i] = (time.perf_counter_ns() - start) * 1e-3
    return times
