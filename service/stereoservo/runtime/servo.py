"""The servo process: joint driver, core, slots and sockets, at a fixed rate.

It holds nothing that could delay the arm: no zenoh, no scipy solver, no images, no log but a line at start
and end. Whatever ends it, the drives are stopped. ``python -m stereoservo.runtime.servo RUNTIME_DIRECTORY
PARENT_PID``.
"""

from __future__ import annotations

import gc
import signal
import sys
import time
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.runtime import plugins
from stereoservo.runtime.cellfile import CellFileError
from stereoservo.runtime.channel import Channel
from stereoservo.runtime.clock import MonotonicClock
from stereoservo.runtime.commands import Hold, Request
from stereoservo.runtime.core import ServoCore
from stereoservo.runtime.cycle import DriverFault, ModelUpdate, StepInputs, StepOutputs
from stereoservo.runtime.directories import DirectoryError
from stereoservo.runtime.handover import SlotError
from stereoservo.runtime.interprocess import (
    Ask,
    Heartbeat,
    Hello,
    NewModel,
    PlanError,
    RunPlan,
    ServoState,
    encode,
    load_plan,
    observation_decoder,
    to_servo_decoder,
)
from stereoservo.runtime.lifeline import Termination, die_with_parent, say
from stereoservo.runtime.locks import AlreadyRunningError, FileLock, hardware_lock_path
from stereoservo.runtime.loop import LoopClock, LoopStatistics, prepare_realtime
from stereoservo.runtime.ports import (
    CameraObservation,
    Clock,
    DriverContext,
    DriverError,
    JointDriver,
    JointState,
)
from stereoservo.runtime.servo_links import EventOutbox, ServoLinks, StepStream
from stereoservo.runtime.warmup import warm_up

GATEWAY_SILENCE_S = 0.5
"""Without a heartbeat of the gateway for so long, a moving arm is held."""
SILENCE = f"the servo process: its gateway said nothing for {GATEWAY_SILENCE_S:g} s (a busy computer?)"
"""Who holds then, as the event `held` tells it."""
STATE_RATE_HZ = 50.0
STATISTICS_EVERY_S = 0.5
FAULT_READ_EVERY_S = 0.1
REST_TIMEOUT_S = 1.5
"""How long a shutdown waits for the core to bring the arm to rest before the driver's own stop."""
CONFIGURE_TRIES = 20
EXIT_SETUP = 3


class ServoProcess:
    """One cycle after the other: read, step, write, tell. Driver and time are given, so that tests can
    drive it.
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
    ) -> None:
        self.core = core
        self.driver = driver
        self.links = links
        self._clock = clock
        self._period_ns = round(1e9 / rate_hz)
        self._dry_run = dry_run
        self._outbox = EventOutbox()
        self._stream = StepStream(core.settings, rate_hz)
        self._configured = False
        self._active = False
        self._fault: DriverFault | None = None
        self._faulty_since_ns = 0
        self._peer: Channel | None = None
        self._heard_ns = 0
        self._silent = False
        self._moving = False
        self._differences: tuple[str, ...] = ()
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
        self._stop()
        try:
            if not self._dry_run:
                self.driver.deactivate()
        except DriverError as error:
            say("servo", f"the drives were stopped but did not switch off: {error}")
        finally:
            self.driver.close()

    def _stop(self) -> None:
        # In a dry run somebody else may be driving this arm: not even a stop is sent.
        if not self._dry_run:
            self.driver.stop()

    def _fail(self, error: DriverError, now_ns: int) -> None:
        self._stop()
        self._active = False
        self._fault = DriverFault(error.code, str(error))
        self._faulty_since_ns = now_ns

    def _read(self, now_ns: int) -> JointState | None:
        if not self._configured:
            return None
        if self._fault is not None and now_ns - self._faulty_since_ns < FAULT_READ_EVERY_S * 1e9:
            return None
        try:
            return self.driver.read_state()
        except DriverError as error:
            self._fail(error, now_ns)
            return None

    def _write(self, outputs: StepOutputs, now_ns: int) -> None:
        if outputs.command is None or not self._active or self._dry_run:
            return
        try:
            report = self.driver.write_velocity(outputs.command)
        except DriverError as error:
            self._fail(error, now_ns)
            return
        self._differences = report.reasons

    def _follow(self, outputs: StepOutputs, now_ns: int) -> None:
        """Do with the driver what the core asks for; a refusal of the driver is a fault in the next step."""
        request = outputs.driver_request
        if request == "":
            return
        try:
            if request == "activate":
                if not self._dry_run:
                    self.driver.activate()
                self._active = True
            elif request == "deactivate":
                self._active = False
                self._stop()
                if not self._dry_run:
                    self.driver.deactivate()
            else:
                self._active = False
                self._stop()
                if not self._dry_run:
                    self.driver.deactivate()
                self._configured = False
                self.driver.configure()
                self._configured = True
                self._fault = None
        except DriverError as error:
            self._fail(error, now_ns)

    # -- gateway --------------------------------------------------------------------------------------------

    def _listen(self, now_ns: int) -> tuple[tuple[Request, ...], ModelUpdate | None]:
        for peer in self.links.control.accept():
            self._peer = peer
            self._heard_ns = now_ns
        requests: list[Request] = []
        model: ModelUpdate | None = None
        if self._peer is not None:
            for data in self._peer.receive():
                message = to_servo_decoder.decode(data)
                self._heard_ns = now_ns
                self._silent = False
                if isinstance(message, Ask):
                    requests.append(message.request)
                elif isinstance(message, NewModel):
                    model = ModelUpdate(message.model, message.reanchored)
                elif isinstance(message, Hello):
                    self._outbox.rewind(message.last_event)
                else:
                    assert isinstance(message, Heartbeat)
        if self._heard_ns and not self._silent and now_ns - self._heard_ns > GATEWAY_SILENCE_S * 1e9:
            self._silent = True
            if self._moving:
                requests.append(Request(-1, SILENCE, Hold()))
        return tuple(requests), model

    def _observe(self) -> tuple[CameraObservation, ...]:
        found = []
        for reader in self.links.observations:
            data = reader.poll()
            if data is not None:
                found.append(observation_decoder.decode(data))
        return tuple(found)

    # -- one cycle ------------------------------------------------------------------------------------------

    def cycle(self, loop: LoopClock, *, stop: bool = False) -> StepOutputs:
        """Read, step, write, tell. ``stop`` asks the core to brake (shutdown)."""
        now_ns = self._clock.now_ns()
        joints = self._read(now_ns)
        requests, model = self._listen(now_ns)
        inputs = StepInputs(
            now_ns=now_ns,
            period_ns=self._period_ns,
            joints=joints,
            observations=self._observe(),
            requests=requests,
            model_update=model,
            stop=self.links.stop.poll() or stop,
            driver_configured=self._configured,
            driver_active=self._active,
            driver_fault=self._fault,
        )
        self._stream.before(self.links.steps, self.core, now_ns)
        outputs = self.core.step(inputs)
        self._write(outputs, now_ns)
        self._follow(outputs, now_ns)
        self._moving = outputs.status.source != "hold" or bool(np.any(outputs.status.command))
        for prior in outputs.priors:
            self.links.priors[prior.camera].write(encode(prior))
        self._tell_state(outputs, loop)  # before its events: who hears an event finds a state no older
        self._outbox.add(outputs.events)
        if self._peer is not None and self._peer.is_open:
            self._outbox.flush(self._peer)
        self._stream.after(inputs, outputs)
        return outputs

    def _tell_state(self, outputs: StepOutputs, loop: LoopClock) -> None:
        if self._statistics is None or self._cycles % self._statistics_every == 0:
            self._statistics = loop.statistics()
        if outputs.events or self._cycles % self._state_every == 0:
            state = ServoState(
                status=outputs.status,
                loop=self._statistics,
                driver_configured=self._configured,
                driver_active=self._active,
                gateway=not self._silent and self._heard_ns > 0,
                records_dropped=self._stream.dropped,
                differences=self._differences,
            )
            self.links.state.write(encode(state))
        self._cycles += 1

    def come_to_rest(self, loop: LoopClock, termination: Termination) -> None:
        """Let the core brake until its command is zero, at most ``REST_TIMEOUT_S``; a second signal cuts
        it short.
        """
        until = self._clock.now_ns() + int(REST_TIMEOUT_S * 1e9)
        first = True
        while termination.signals < 2 and self._clock.now_ns() < until:
            loop.wait()
            outputs = self.cycle(loop, stop=first)
            first = False
            if outputs.command is None or not outputs.command.any():
                return


def make_driver(plan: RunPlan, clock: Clock) -> JointDriver:
    """The cell's joint driver, constructed and not connected. Raises PluginError, DriverError."""
    kind = plugins.load(plugins.JOINT_DRIVERS, plan.cell.joints.driver)
    context = DriverContext(
        clock=clock,
        cell=plan.cell.cell.name,
        runtime_dir=Path(plan.runtime),
        cell_dir=Path(plan.cell_path).parent,
        seed=plan.seed,
    )
    driver: JointDriver = kind(plan.cell.joints.options, context)
    return driver


def _configure(process: ServoProcess, termination: Termination) -> None:
    """Connect, trying again where the driver says that this may help. Raises DriverError."""
    for attempt in range(CONFIGURE_TRIES):
        try:
            process.configure()
            return
        except DriverError as error:
            if not error.retry or attempt == CONFIGURE_TRIES - 1 or termination.asked:
                raise
            time.sleep(0.5)


def run(plan: RunPlan, termination: Termination) -> None:
    """Run until asked to end; the drives are stopped whatever happens."""
    directories = plan.directories
    clock = MonotonicClock()
    hardware = hardware_lock_path(
        directories.runtime.parent, plan.cell.joints.driver, plan.cell.joints.options
    )
    locks = [FileLock(directories.servo_lock, f"cell {plan.cell.cell.name!r}")]
    if hardware is not None:
        locks.append(FileLock(hardware, f"joint driver {plan.cell.joints.driver!r} with these options"))
    warm_up()  # compiled kernels are loaded now, not in the middle of a cycle
    core = ServoCore(plan.settings())
    driver = make_driver(plan, clock)
    rate_hz = plan.cell.servo.rate_hz
    links = ServoLinks(directories, tuple(camera.name for camera in plan.cell.camera))
    try:
        process = ServoProcess(core, driver, links, clock, rate_hz=rate_hz, dry_run=plan.dry_run)
        try:
            # Before the drives are asked for: collecting garbage holds up every thread of this process, a driver's too.
            for warning in prepare_realtime(plan.cell.servo.priority):
                say("servo", warning)
            _configure(process, termination)
            gc.freeze()
            loop = LoopClock(round(1e9 / rate_hz))
            while not termination.asked:
                loop.wait()
                process.cycle(loop)
            process.come_to_rest(loop, termination)
        finally:
            process.shut_down()
    finally:
        links.close()
        for lock in locks:
            lock.release()


def main() -> int:
    """Entry of the process."""
    runtime, parent = Path(sys.argv[1]), int(sys.argv[2])
    die_with_parent(parent, signal.SIGTERM)
    termination = Termination()
    try:
        run(load_plan(runtime), termination)
    except DriverError as error:
        say("servo", f"joint driver: {error}")
        return EXIT_SETUP
    except (
        AlreadyRunningError,
        CellFileError,
        DirectoryError,
        PlanError,
        SlotError,
        plugins.PluginError,
    ) as error:
        say("servo", str(error))
        return EXIT_SETUP
    except msgspec.MsgspecError as error:
        say("servo", f"a message of another process does not decode: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
