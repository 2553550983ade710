"""The plant of a simulated cell: its drives and mechanism, in a separate process with its own rate, as real drives are
outside the servo process.

`PlantProcess` runs any simulated joint driver, found by the cell's entry point, for a `plant_driver.PlantDriver`;
`main` is the entry of the process. Without orders the drives stop by their own command time-out.
``python -m stereoservo.daemon.plant RUNTIME_DIRECTORY PARENT_PID``.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.daemon.heartbeat import DRIVER_CALL_S, PLANT_HANG_S, HeartbeatWriter
from stereoservo.daemon.ipc_messages import PlanError, RunPlan, load_plan
from stereoservo.daemon.pacing import prepare_realtime
from stereoservo.daemon.plant_driver import (
    PLANT_CAPACITY,
    PLANT_ORDERS_LAYOUT,
    PLANT_STATE_LAYOUT,
    Orders,
    PlantState,
    Remarks,
    make_driver,
)
from stereoservo.daemon.process_control import Termination, die_with_parent, write_log
from stereoservo.daemon.seqlock import SlotError, SlotReader, SlotWriter
from stereoservo.messages.directories import CellDirectories
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import AuxiliaryDriver, Clock, DriverError, JointDriver

MOVING_RATE_HZ = 1000.0
"""Minimum rate while the arm moves: its period is the largest age of an order or a sample."""
SETTLES_NS = 500_000_000
"""Time after the last motion for which the plant keeps this rate."""
FAILED_READ_EVERY_NS = 100_000_000
REPEAT_NS = 20_000_000
"""Largest interval at rest between repetitions of the order to the drives to stay: a quarter of their time-out."""
EXIT_SETUP = 3


class PlantProcess:
    """The drives of one cell behind two records: orders in, state out. Raises SlotError.

    It executes only orders that are addressed to its ``session``; there are none before a `PlantDriver` has found it.
    ``beat``: called in every step, and before longer operations, with the time limit of its next call [s].
    """

    def __init__(
        self,
        driver: JointDriver,
        directories: CellDirectories,
        clock: Clock,
        *,
        beat: Callable[[float], None] = lambda limit_s: None,
    ) -> None:
        self.driver = driver
        self._auxiliary = driver if isinstance(driver, AuxiliaryDriver) else None
        self._description = driver.describe()
        self._names = [spec.name for spec in self._description.auxiliary]
        self._clock = clock
        self._beat = beat
        self.session = clock.now_ns()
        joints = len(self._description.joints)
        self._done = Orders(self.session, 0, False, 0, 0, 0, 0, np.zeros(joints), np.full(len(self._names), np.nan))
        """The newest executed orders."""
        self._values = np.zeros((4, joints))
        self._remarks = Remarks()
        self._state = PlantState(
            self.session, 0, 0, 0, 0, joints, False, False,
            self._values.tobytes() + self._done.auxiliary.tobytes(), msgspec.msgpack.encode(self._remarks),
        )  # fmt: skip
        self._configured = False
        self._moved_ns = self._read_ns = self._ordered_ns = 0
        self._repeat_ns = min(REPEAT_NS, round(0.25e9 * self._description.command_timeout_s))
        self._orders = SlotReader(directories.plant_orders_slot, PLANT_ORDERS_LAYOUT)
        self._slot = SlotWriter(directories.plant_state_slot, PLANT_CAPACITY, PLANT_STATE_LAYOUT)

    def step(self) -> None:
        """Execute the orders since the last step, advance the drives to the current time, and publish their state."""
        record = self._orders.poll()
        try:
            if record is not None:
                orders = Orders.decoded(record, len(self._done.velocities))
                if orders.session == self.session and not self._repeats(orders):
                    self._obey(orders)
            if self._configured and self._clock.now_ns() >= self._read_ns:
                self._read()
        except DriverError as error:
            self._fail(error)
        self._slot.write(self._state.encoded())
        self._beat(PLANT_HANG_S)

    @property
    def moves(self) -> bool:
        """Whether the arm moves, or moved a short time ago."""
        return self._clock.now_ns() - self._moved_ns < SETTLES_NS

    def _repeats(self, orders: Orders) -> bool:
        """Whether these orders only repeat the order to stay at rest, which was sent to the drives just before."""
        done = self._done
        return (
            orders.velocity_number != done.velocity_number  # nothing else is new
            and (orders.call, orders.stops) == (done.call, done.stops)
            and (orders.auxiliary_number, orders.auxiliary_stops) == (done.auxiliary_number, done.auxiliary_stops)
            and not (orders.velocities.any() or done.velocities.any())
            and 0 <= self._clock.now_ns() - self._ordered_ns < self._repeat_ns
        )

    def _obey(self, orders: Orders) -> None:
        """Execute orders that were not executed yet: the stop first, then lifecycle calls, then motion. Raises
        DriverError.
        """
        done, self._done = self._done, orders
        if orders.stops != done.stops:
            self.driver.stop()
        if orders.auxiliary_stops != done.auxiliary_stops and self._auxiliary is not None:
            self._auxiliary.stop_auxiliary()
        if orders.call != done.call:
            self._state = self._state._replace(call=orders.call)
            self._read_ns = 0
            self._beat(DRIVER_CALL_S)
            self._change(active=orders.active)
        if orders.velocity_number != done.velocity_number and orders.active:
            self._ordered_ns = self._clock.now_ns()
            report = self.driver.write_velocity(orders.velocities)
            differs = not np.array_equal(report.sent, orders.velocities)
            sent = tuple(report.sent.tolist()) if differs else ()
            if (report.reasons, sent) != (self._remarks.reasons, self._remarks.sent):
                self._remark(Remarks(reasons=report.reasons, sent=sent))
        if orders.auxiliary_number != done.auxiliary_number and self._auxiliary is not None:
            values = dict(zip(self._names, orders.auxiliary.tolist(), strict=True))
            asked = {name: value for name, value in values.items() if value == value}
            if asked:
                self._auxiliary.write_auxiliary(asked)

    def _change(self, *, active: bool) -> None:
        if active:
            self.driver.activate()
            return
        if self._configured:
            self.driver.deactivate()
        self.driver.configure()
        self._configured = True

    def _read(self) -> None:
        sample = self.driver.read_state()
        values = self._values
        values[0], values[1] = sample.positions, sample.velocities
        values[2] = 0.0 if sample.efforts is None else sample.efforts
        values[3] = 0.0 if sample.following_errors is None else sample.following_errors
        if self._done.velocities.any() or values[1].any():
            self._moved_ns = self._clock.now_ns()
        self._state = self._state._replace(
            seq=sample.seq,
            t_ns=sample.t_ns,
            numbers=values.tobytes() + self._auxiliary_values(),
            has_efforts=sample.efforts is not None,
            has_following=sample.following_errors is not None,
        )

    def _auxiliary_values(self) -> bytes:
        if not self._names:
            return b""
        found = {} if self._auxiliary is None else self._auxiliary.read_auxiliary()
        return np.array([found.get(name, np.nan) for name in self._names]).tobytes()

    def _remark(self, remarks: Remarks) -> None:
        self._remarks = remarks
        self._state = self._state._replace(remarks=msgspec.msgpack.encode(remarks))

    def _fail(self, error: DriverError) -> None:
        """Stop the drives and report their error; a sample is requested again after a pause."""
        self.driver.stop()
        self._remark(Remarks(error.code, str(error), error.retry, self._remarks.reasons, self._remarks.sent))
        self._state = self._state._replace(failures=self._state.failures + 1)
        self._read_ns = self._clock.now_ns() + FAILED_READ_EVERY_NS

    def close(self) -> None:
        """Brake, release. Idempotent."""
        self.driver.close()
        self._orders.close()
        self._slot.close()


def run(plan: RunPlan, termination: Termination) -> None:
    """Run until terminated: at the drives' rate at rest, at ``MOVING_RATE_HZ`` at least while the arm moves."""
    directories, clock = plan.directories, MonotonicClock()
    at_rest_ns = round(1e9 / plan.joints.rate_hz)
    moving_ns = min(round(1e9 / MOVING_RATE_HZ), at_rest_ns)
    with closing(HeartbeatWriter(directories.heartbeat_slot("plant"))) as heartbeat:
        plant = PlantProcess(make_driver(plan, clock), directories, clock, beat=heartbeat.beat)
        with closing(plant):
            # Real drives do not depend on the computer's load; priority below the servo loop, which must not wait.
            for warning in prepare_realtime(max(plan.cell.servo.priority - 1, 0)):
                write_log("plant", warning)
            due_ns = clock.now_ns()
            while not termination.asked:
                plant.step()
                now_ns = clock.now_ns()
                due_ns = max(due_ns + (moving_ns if plant.moves else at_rest_ns), now_ns)
                clock.sleep((due_ns - now_ns) * 1e-9)


def main() -> int:
    """Entry of the process."""
    runtime, parent = Path(sys.argv[1]), int(sys.argv[2])
    die_with_parent(parent, signal.SIGTERM)
    termination = Termination()
    try:
        run(load_plan(runtime), termination)
    except (DriverError, PlanError, SlotError, plugins.PluginError) as error:
        write_log("plant", str(error))
        return EXIT_SETUP
    return 0


if __name__ == "__main__":
    sys.exit(main())
