"""The servo loop and its process: each cycle reads joints and camera observations, runs one step of the control core,
commands the joint driver, and publishes the result.

`ServoProcess` is the loop on given links, pacing and clock; `main` is the entry of its process. The process contains
nothing that could delay the arm: no zenoh, no scipy solver, no images, and it logs only at its start and end. In every
case the drives are stopped at its end. ``python -m stereoservo.daemon.servo RUNTIME_DIRECTORY PARENT_PID``.
"""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stereoservo.core.cycle import DriverFault, StepInputs
from stereoservo.core.servo_core import NewestStep, ServoCore
from stereoservo.daemon.heartbeat import DRIVER_CALL_S, SERVO_HANG_S, HeartbeatWriter
from stereoservo.daemon.ipc_messages import PlanError, RunPlan, ServoState, load_plan, newest_stamps
from stereoservo.daemon.kernel_compilation import (
    KernelLoader,
    kernels_to_come,
    report_progress,
    wait_until_compiled,
    warm_up,
    warm_up_first,
)
from stereoservo.daemon.links import GatewayMessages, Pacing, ServoLinks
from stereoservo.daemon.pacing import clock_pacing, prepare_realtime
from stereoservo.daemon.plant_driver import PlantDriver, make_driver
from stereoservo.daemon.process_control import Termination, die_with_parent, write_log
from stereoservo.daemon.seqlock import SlotError
from stereoservo.daemon.servo_links import ProcessLinks
from stereoservo.messages.cell_file import CellFileError
from stereoservo.messages.directories import DirectoryError
from stereoservo.messages.goals import ExtendLeases, Hold, OrderAuxiliary, Request
from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, FileLock, hardware_lock_path
from stereoservo.messages.servo_state import LoopStatistics
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import AuxiliaryDriver, Clock, DriverError, JointDriver, JointState
from stereoservo.recording.step_records import StepStream

GATEWAY_SILENCE_S = 0.5
"""Time without a heartbeat of the gateway after which a moving arm is held [s]."""
SILENCE = f"the servo process: its gateway said nothing for {GATEWAY_SILENCE_S:g} s (a busy computer?)"
"""Operator name in the resulting event `held`."""
UNHEARD_S = 0.15
"""Time without a heartbeat of the gateway (three beats) after which leases do not run [s], because the gateway receives
no client messages either.
"""
RETURN_S = 2.0
"""Time that clients may need to find a restarted gateway after a silence that held the arm [s]."""
AHEAD_S = 0.05
"""Interval and lead time of lease extensions in the meantime [s]."""
STATE_RATE_HZ = 50.0
STATISTICS_EVERY_S = 0.5
FAULT_READ_EVERY_S = 0.1
"""Interval of reading a driver in fault [s]."""
REST_TIMEOUT_S = 1.5
"""Time for which a shutdown waits for the core to bring the arm to rest before the driver's own stop [s]."""
CONFIGURE_TRIES = 20
CONFIGURE_PAUSE_S = 0.5
EXIT_SETUP = 3


class ServoProcess:
    """The servo loop of one cell, cycle by cycle, on any links, pacing and clock.

    ``dry_run``: the core's commands and requests are computed, but not sent to the drives. ``beat``: called in every
    cycle, and before longer operations, with the time limit of its next call [s]. ``kernels``: loader of kernels that
    are not compiled yet; they are loaded once they are compiled, one per cycle in which nothing moves.
    """

    def __init__(
        self,
        core: ServoCore,
        driver: JointDriver,
        links: ServoLinks,
        clock: Clock,
        *,
        rate_hz: float,
        dry_run: bool = False,
        beat: Callable[[float], None] = lambda limit_s: None,
        kernels: KernelLoader | None = None,
    ) -> None:
        self.core = core
        self.driver = driver
        self._links = links
        self._clock = clock
        self._period_ns = round(1e9 / rate_hz)
        self._dry_run = dry_run
        self._beat = beat
        self._kernels = kernels
        self._stream = StepStream(core.settings, rate_hz)
        self._auxiliary = driver if isinstance(driver, AuxiliaryDriver) else None
        self._configured = False
        self._active = False
        self._fault: DriverFault | None = None
        self._fault_ns = 0
        self._heard_ns = 0
        self._silent = False
        self._unheard_until_ns = 0
        self._extended_until_ns = 0
        self._moving = False
        self._differences: tuple[str, ...] = ()
        self._sent: FloatArray | None = None
        self._joints_ns = 0
        self._frames_ns: dict[str, int] = {}
        self._state_every = max(1, round(rate_hz / STATE_RATE_HZ))
        self._statistics_every = max(1, round(rate_hz * STATISTICS_EVERY_S))
        self._cycles = 0
        self._statistics: LoopStatistics | None = None

    # -- driver ---------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Connect the driver. Raises DriverError."""
        self.driver.configure()
        self._configured = True

    def shut_down(self) -> None:
        """Stop the drives, switch off, release."""
        self._beat(DRIVER_CALL_S)
        self._stop()
        try:
            self._switch_off()
        except DriverError as error:
            write_log("servo", f"the drives were stopped but did not switch off: {error}")
        finally:
            self.driver.close()

    def _stop(self) -> None:
        # In a dry run another process may control this arm: not even a stop is sent.
        if not self._dry_run:
            self.driver.stop()

    def _switch_off(self) -> None:
        if not self._dry_run:
            self.driver.deactivate()

    def _latch_fault(self, error: DriverError, now_ns: int) -> None:
        self._stop()
        self._active = False
        self._fault = DriverFault(error.code, str(error))
        self._fault_ns = now_ns

    def _read(self, now_ns: int) -> JointState | None:
        if not self._configured:
            return None
        if self._fault is not None and now_ns - self._fault_ns < FAULT_READ_EVERY_S * 1e9:
            return None
        try:
            return self.driver.read_state()
        except DriverError as error:
            self._latch_fault(error, now_ns)
            return None

    def _write(self, newest: NewestStep, now_ns: int) -> None:
        self._sent, command = None, newest.command
        if command is None or not self._active or self._dry_run:
            return
        command = command.copy()
        try:
            report = self.driver.write_velocity(command)
        except DriverError as error:
            self._latch_fault(error, now_ns)
            return
        self._differences = report.reasons
        if report.sent is not report.asked and not np.array_equal(report.sent, command):
            self._sent = np.array(report.sent, dtype=np.float64)

    def _order_auxiliary(self, inputs: StepInputs, outputs: NewestStep, now_ns: int) -> None:
        """Pass orders of auxiliary joints that the core has accepted to the driver; a stop stops these joints, too."""
        if self._auxiliary is None or self._dry_run:
            return
        for request in inputs.requests:
            if not isinstance(request.command, OrderAuxiliary) or not self._active:  # a failed driver is stopped
                continue
            if any(event.request == request.request and event.accepted for event in outputs.events):
                try:
                    self._auxiliary.write_auxiliary(request.command.values)
                except DriverError as error:
                    self._latch_fault(error, now_ns)
        # After the orders: a stop in this cycle, for example after a collision, may follow their answers.
        if inputs.stop or any(event.kind in ("stopped", "fault") for event in outputs.events):
            self._auxiliary.stop_auxiliary()

    def _auxiliary_values(self) -> dict[str, float]:
        if self._auxiliary is None or not self._configured or self._fault is not None:
            return {}
        return self._auxiliary.read_auxiliary()

    def _apply_driver_request(self, outputs: NewestStep, now_ns: int) -> None:
        """Change the driver's state as requested by the core; if the driver refuses, the next step receives a fault."""
        request = outputs.driver_request
        if request == "":
            return
        self._beat(DRIVER_CALL_S)
        try:
            if request == "activate":
                if not self._dry_run:
                    self.driver.activate()
                self._active = True
                return
            self._active = False
            self._stop()
            self._switch_off()
            if request == "reset":
                self._configured = False
                self.configure()
                self._fault = None
        except DriverError as error:
            self._latch_fault(error, now_ns)

    # -- gateway --------------------------------------------------------------------------------------------

    def _receive(self, now_ns: int) -> GatewayMessages:
        """The gateway's messages. A hold is added if the gateway is silent while the arm moves; leases do not run while
        the gateway receives no client messages.
        """
        messages = self._links.receive()
        if messages.heard:
            if self._silent:
                self._unheard_until_ns = now_ns + round(RETURN_S * 1e9)
            self._heard_ns = now_ns
            self._silent = False
        elif self._heard_ns and not self._silent and now_ns - self._heard_ns > GATEWAY_SILENCE_S * 1e9:
            self._silent = True
            if self._moving:
                messages = messages._replace(requests=(Request(-1, SILENCE, Hold()),))
        if self._heard_ns and (now_ns - self._heard_ns > UNHEARD_S * 1e9 or now_ns < self._unheard_until_ns):
            return self._extend_leases(messages, now_ns)
        return messages

    def _extend_leases(self, messages: GatewayMessages, now_ns: int) -> GatewayMessages:
        """``messages`` and, if due, a request that extends the leases by the time in which clients are not heard."""
        if self._extended_until_ns - now_ns >= AHEAD_S * 1e9:
            return messages
        since_ns = max(self._heard_ns, self._extended_until_ns)
        self._extended_until_ns = now_ns + round(2 * AHEAD_S * 1e9)
        request = Request(-1, SILENCE, ExtendLeases((self._extended_until_ns - since_ns) * 1e-9))
        return messages._replace(requests=(request, *messages.requests))

    def _publish(self, newest: NewestStep, pacing: Pacing) -> None:
        """Publish priors to the cameras, and state and events to the gateway."""
        for prior in newest.priors:
            self._links.publish_prior(prior)
        events = newest.events
        if self._statistics is None or self._cycles % self._statistics_every == 0:
            self._statistics = pacing.statistics()
        if events or self._cycles % self._state_every == 0:
            state = ServoState(
                status=newest.status,
                loop=self._statistics,
                driver_configured=self._configured,
                driver_active=self._active,
                gateway=not self._silent and self._heard_ns > 0,
                records_dropped=self._stream.dropped,
                differences=self._differences,
                auxiliary=self._auxiliary_values(),
                joints_ns=self._joints_ns,
                frames_ns=self._frames_ns,
            )
            self._links.publish_state(state)
        self._cycles += 1
        self._links.publish_events(events)  # after the state: a receiver of an event finds a state that is not older

    # -- one cycle ------------------------------------------------------------------------------------------

    def cycle(self, pacing: Pacing, *, stop: bool = False) -> StepInputs:
        """Run one cycle: wait, read, step, write, publish; returns the inputs of its step. ``stop`` requests the core
        to brake (shutdown).
        """
        pacing.wait()
        now_ns = self._clock.now_ns()
        joints = self._read(now_ns)
        messages = self._receive(now_ns)
        observations = self._links.observations()
        inputs = StepInputs(
            now_ns=self._clock.now_ns(),  # after all reads: no stamp can be later
            period_ns=self._period_ns,
            joints=joints,
            observations=observations,
            requests=messages.requests,
            model_update=messages.model_update,
            stop=self._links.stop_raised() or stop,
            driver_configured=self._configured,
            driver_active=self._active,
            driver_fault=self._fault,
            compiling=self._kernels is not None,
            sent=self._sent,
        )
        self._joints_ns, self._frames_ns = newest_stamps(inputs, self._joints_ns, self._frames_ns)
        self._stream.before(self._links.step_recorder(), self.core, now_ns)
        self.core.advance(inputs)
        newest = self.core.newest
        self._write(newest, now_ns)
        if self._auxiliary is not None and (inputs.requests or newest.events):
            self._order_auxiliary(inputs, newest, now_ns)
        self._apply_driver_request(newest, now_ns)
        self._moving = newest.moves
        self._publish(newest, pacing)
        self._stream.after(inputs, newest)
        self._beat(SERVO_HANG_S)
        if self._kernels is not None and not self._moving:
            self._load_kernels(self._kernels, now_ns)
        return inputs

    def _load_kernels(self, kernels: KernelLoader, now_ns: int) -> None:
        """Load the next kernel, if it is time. Never compiles: the loaded kernels are in the cache."""
        kernels.advance(now_ns)
        if kernels.loaded:
            self._kernels = None

    def come_to_rest(self, pacing: Pacing, cut_short: Callable[[], bool]) -> None:
        """Run cycles until the core's command is zero, for at most ``REST_TIMEOUT_S`` or until ``cut_short``."""
        until = self._clock.now_ns() + int(REST_TIMEOUT_S * 1e9)
        first = True
        while not cut_short() and self._clock.now_ns() < until:
            self.cycle(pacing, stop=first)
            first = False
            command = self.core.newest.command
            if command is None or not command.any():
                return


def _configure(process: ServoProcess, termination: Termination, clock: MonotonicClock) -> None:
    """Connect, with retries if the driver's error allows it. Raises DriverError."""
    for attempt in range(CONFIGURE_TRIES):
        try:
            process.configure()
            return
        except DriverError as error:
            if not error.retry or attempt == CONFIGURE_TRIES - 1 or termination.asked:
                raise
            clock.sleep(CONFIGURE_PAUSE_S)


def run(plan: RunPlan, termination: Termination) -> None:
    """Run until terminated; the drives are stopped in any case."""
    directories = plan.directories
    clock = MonotonicClock()
    hardware = hardware_lock_path(directories.runtime.parent, plan.cell.joints.driver, plan.cell.joints.options)
    locks = [FileLock(directories.servo_lock, f"cell {plan.cell.cell.name!r}")]
    if hardware is not None:
        locks.append(ChannelLock(hardware, f"joint driver {plan.cell.joints.driver!r} with these options"))
    # Compiled kernels are loaded here, not within a cycle.
    kernels = kernels_to_come()
    if kernels is not None and hardware is not None:
        # Loading a kernel blocks all threads of this process, also a bus's, for longer than the drives' time-out.
        wait_until_compiled(lambda: termination.asked)
        kernels = None
    if kernels is None:
        warm_up()
    else:
        warm_up_first()
    core = ServoCore(plan.settings())
    driver = PlantDriver(plan.joints, directories, clock) if plan.joints.simulated else make_driver(plan, clock)
    rate_hz = plan.cell.servo.rate_hz
    links = ProcessLinks(directories, tuple(camera.name for camera in plan.cell.camera))
    heartbeat = HeartbeatWriter(directories.heartbeat_slot("servo"))
    try:
        process = ServoProcess(
            core,
            driver,
            links,
            clock,
            rate_hz=rate_hz,
            dry_run=plan.dry_run,
            beat=heartbeat.beat,
            kernels=kernels,
        )
        try:
            # Before the drives are connected: garbage collection blocks all threads of this process, also a driver's.
            for warning in prepare_realtime(plan.cell.servo.priority):
                write_log("servo", warning)
            _configure(process, termination, clock)
            gc.freeze()
            pacing = clock_pacing(round(1e9 / rate_hz))
            while not termination.asked:
                process.cycle(pacing)
            process.come_to_rest(pacing, lambda: termination.signals >= 2)
        finally:
            process.shut_down()
    finally:
        heartbeat.close()
        links.close()
        for lock in locks:
            lock.release()


def main() -> int:
    """Entry of the process."""
    runtime, parent = Path(sys.argv[1]), int(sys.argv[2])
    die_with_parent(parent, signal.SIGTERM)
    termination = Termination()
    report_progress(runtime, "servo", parent)  # of the kernels that this process compiles if no cache is writable
    try:
        run(load_plan(runtime), termination)
    except DriverError as error:
        write_log("servo", f"joint driver: {error}")
        return EXIT_SETUP
    except (
        AlreadyRunningError,
        CellFileError,
        DirectoryError,
        PlanError,
        SlotError,
        plugins.PluginError,
    ) as error:
        write_log("servo", str(error))
        return EXIT_SETUP
    return 0


if __name__ == "__main__":
    sys.exit(main())
