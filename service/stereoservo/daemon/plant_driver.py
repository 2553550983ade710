"""The joint driver of a simulated cell in the servo process: the drives themselves run in the process `plant`, as real
drives are outside this computer; and the records that the two exchange.

Only the newest record is kept in each direction. `Orders` hold the commanded state and counters of requests, so a
missed record loses nothing; a plant executes only orders that are addressed to its session, and starts without power.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np

from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.seqlock import SlotReader, SlotWriter
from stereoservo.messages.directories import CellDirectories
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import plugins
from stereoservo.ports.devices import (
    Clock,
    CommandReport,
    DriverError,
    JointDriver,
    JointDriverDescription,
    JointState,
)

PLANT_STATE_LAYOUT, PLANT_ORDERS_LAYOUT = "PlantState.1", "PlantOrders.1"
PLANT_CAPACITY = 1 << 14
_ORDERS = struct.Struct("=7q")
_STATE = struct.Struct("=6q??6x")

ENDED = "plant_ended"
"""Error code if the plant's process has ended."""
APPEARS_S = 4.0
"""Time for which a call waits for a plant that is being started [s]; the call may be repeated."""
CALL_S = 10.0
"""Time for which a call waits for its answer [s]."""
POLL_S = 0.0005
SILENT_NS = 20_000_000
"""Time without a sample after which the plant's process is checked [ns]."""


class Orders(msgspec.Struct, eq=False):
    """Orders of the servo process to the drives of plant ``session``: numbers of the newest lifecycle ``call``, of the
    ``stops``, of the newest velocity and auxiliary orders, and of ``auxiliary_stops``; ``active``: drives on.
    ``velocities`` (n,); ``auxiliary`` (m,), NaN where nothing is ordered.
    """

    session: int
    call: int
    active: bool
    stops: int
    velocity_number: int
    auxiliary_number: int
    auxiliary_stops: int
    velocities: FloatArray
    auxiliary: FloatArray

    def encoded(self) -> bytes:
        """As a record."""
        head = _ORDERS.pack(
            self.session,
            self.call,
            self.active,
            self.stops,
            self.velocity_number,
            self.auxiliary_number,
            self.auxiliary_stops,
        )
        return head + self.velocities.tobytes() + self.auxiliary.tobytes()

    @classmethod
    def decoded(cls, record: bytes, joints: int) -> Self:
        """From a record for a plant with ``joints`` joints."""
        session, call, active, stops, velocity, auxiliary, halts = _ORDERS.unpack_from(record)
        values = np.frombuffer(record, dtype=np.float64, offset=_ORDERS.size)
        return cls(session, call, bool(active), stops, velocity, auxiliary, halts, values[:joints], values[joints:])


class Remarks(msgspec.Struct, frozen=True, array_like=True):
    """Remarks of a plant's state: its last failure, and the reasons why the last velocities were sent as ``sent`` and
    not as ordered; empty: they were sent as ordered.
    """

    code: str = ""
    message: str = ""
    retry: bool = False
    reasons: tuple[str, ...] = ()
    sent: tuple[float, ...] = ()


class PlantState(NamedTuple):
    """State of a plant's drives: its ``session``, the last answered ``call``, the number of ``failures`` so far, and
    the newest sample (``seq`` 0: none). ``numbers``: bytes, decoded on demand: positions, velocities, efforts and
    following errors of ``joints`` joints, of which the last two may be missing; then auxiliary values, NaN where
    unknown. ``remarks``: `Remarks`, encoded.
    """

    session: int
    call: int
    failures: int
    seq: int
    t_ns: int
    joints: int
    has_efforts: bool
    has_following: bool
    numbers: bytes
    remarks: bytes

    def encoded(self) -> bytes:
        """As a record."""
        return _STATE.pack(*self[:8]) + self.numbers + self.remarks

    @classmethod
    def decoded(cls, record: bytes, auxiliaries: int) -> Self:
        """From a record with ``auxiliaries`` auxiliary values."""
        head = _STATE.unpack_from(record)
        end = _STATE.size + 8 * (4 * head[5] + auxiliaries)
        return cls._make((*head, record[_STATE.size : end], record[end:]))

    def sample(self) -> JointState:
        """The newest joint sample, in new arrays."""
        values = np.frombuffer(bytearray(self.numbers), np.float64, 4 * self.joints)
        positions, velocities, efforts, following = values.reshape(4, -1)
        return JointState(
            self.seq,
            self.t_ns,
            positions,
            velocities,
            efforts if self.has_efforts else None,
            following if self.has_following else None,
        )

    def auxiliary(self) -> FloatArray:
        """Auxiliary values (m,)."""
        return np.frombuffer(self.numbers, np.float64, offset=32 * self.joints)


class PlantDriver:
    """A joint driver whose drives are in the cell's plant process. Raises SlotError.

    Velocities reach the plant's drives within its period; the command time-out is the plant's. If its process ends,
    calls raise ``plant_ended`` until :meth:`configure` finds its successor. ``sleep``: function by which calls wait
    [s].
    """

    def __init__(
        self,
        description: JointDriverDescription,
        directories: CellDirectories,
        clock: Clock,
        *,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._description = description
        self._clock = clock
        self._sleep = sleep
        self._names = [spec.name for spec in description.auxiliary]
        self._reader = SlotReader(directories.plant_state_slot, PLANT_STATE_LAYOUT)
        self._writer = SlotWriter(directories.plant_orders_slot, PLANT_CAPACITY, PLANT_ORDERS_LAYOUT)
        joints = len(description.joints)
        first = clock.now_ns()  # so that no number of a previous servo process is used again
        self._orders = Orders(0, first, False, first, 0, 0, first, np.zeros(joints), np.full(len(self._names), np.nan))
        self._zeros = np.zeros(joints)
        self._state: PlantState | None = None
        self._failures = 0
        self._closed = False
        self._encoded_remarks, self._remarks = b"", Remarks()

    def describe(self) -> JointDriverDescription:
        """The description of the plant's driver."""
        return self._description

    # -- lifecycle ------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Make the plant set up its drives, without power; also finds a restarted plant. Raises DriverError."""
        until_ns = self._clock.now_ns() + round(APPEARS_S * 1e9)
        while True:
            state = self._poll()
            if state is not None and self._lives():
                self._failures = state.failures
                try:
                    self._call(active=False, session=state.session)
                    return
                except DriverError as error:
                    if error.code != ENDED:  # else the state found was of a previous plant
                        raise
            if self._clock.now_ns() > until_ns:
                raise DriverError(
                    "plant_absent",
                    f"the process of the simulated drives is not up after {APPEARS_S:g} s; it is started by the "
                    "supervisor: try again",
                    retry=True,
                )
            self._sleep(POLL_S)

    def activate(self) -> None:
        """Power on, at rest. Raises DriverError."""
        self._call(active=True, session=self._orders.session)

    def deactivate(self) -> None:
        """Stop and power off. Idempotent; a plant that has ended has no power."""
        if self._orders.active:
            self.stop()
            self._send(active=False, call=self._orders.call + 1)

    def close(self) -> None:
        """Stop, power off, release. Idempotent; never raises."""
        self.deactivate()
        self._closed = True
        self._reader.close()
        self._writer.close()

    def _call(self, *, active: bool, session: int) -> None:
        """Order a lifecycle call, cancel all previous orders, and wait for the answer. Raises DriverError: the error of
        the drives, or a plant that ended or does not answer.
        """
        self._send(
            active=active,
            session=session,
            call=self._orders.call + 1,
            velocities=np.zeros_like(self._orders.velocities),
            auxiliary=np.full(len(self._names), np.nan),
        )
        until_ns = self._clock.now_ns() + round(CALL_S * 1e9)
        while True:
            state = self._state_of_session()
            if state.call == self._orders.call:
                break
            if self._clock.now_ns() > until_ns:
                raise DriverError(
                    "plant_silent",
                    f"the process of the simulated drives did not answer for {CALL_S:g} s; is the computer overloaded?",
                    retry=True,
                )
            self._sleep(POLL_S)
        self._raise_failure(state)

    # -- motion ---------------------------------------------------------------------------------------------

    def read_state(self) -> JointState:
        """The newest sample of the plant, even if it was read before. Raises DriverError."""
        state = self._state_of_session()
        self._raise_failure(state)
        if state.seq == 0:
            raise DriverError("no_sample", "the simulated drives have reported no positions yet", retry=True)
        return state.sample()

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        """Order velocities (n,); the report is on the previous order. Raises DriverError."""
        orders = self._orders
        asked = np.array(qd, dtype=np.float64)
        # a product with zeros is not zero if a factor is infinite or NaN
        if asked.shape != orders.velocities.shape or asked.dot(self._zeros) != 0.0:
            raise DriverError(
                "shape",
                f"write_velocity() got {asked.tolist()}; {orders.velocities.size} finite velocities are valid",
            )
        self._raise_failure(self._state_of_session())
        orders.velocities = asked
        orders.velocity_number = number = orders.velocity_number + 1
        if not self._closed:
            self._writer.write(orders.encoded())
        remarks = self._remarks
        sent = np.array(remarks.sent) if remarks.sent and asked.any() else asked
        return CommandReport(number, self._clock.now_ns(), asked, sent, remarks.reasons)

    def stop(self) -> None:
        """Order the drives to brake. Any state; never raises."""
        self._send(
            stops=self._orders.stops + 1,
            auxiliary_stops=self._orders.auxiliary_stops + 1,
            velocities=np.zeros_like(self._orders.velocities),
            auxiliary=np.full(len(self._names), np.nan),
        )

    # -- auxiliary joints -----------------------------------------------------------------------------------

    def write_auxiliary(self, values: Mapping[str, float]) -> None:
        """Order auxiliary joints and outputs. Raises DriverError for an unknown name, or if the plant ended."""
        asked = self._orders.auxiliary.copy()
        for name, value in values.items():
            if name not in self._names:
                known = ", ".join(self._names) or "none"
                raise DriverError("auxiliary", f"no auxiliary joint or output {name!r}; there are: {known}")
            asked[self._names.index(name)] = value
        self._raise_failure(self._state_of_session())
        self._send(auxiliary_number=self._orders.auxiliary_number + 1, auxiliary=asked)

    def read_auxiliary(self) -> dict[str, float]:
        """The newest known values by name."""
        if self._state is None:
            return {}
        found = zip(self._names, self._state.auxiliary().tolist(), strict=True)
        return {name: value for name, value in found if value == value}

    def stop_auxiliary(self) -> None:
        """Order auxiliary joints to hold their positions. Never raises."""
        self._send(auxiliary_stops=self._orders.auxiliary_stops + 1, auxiliary=np.full(len(self._names), np.nan))

    # -- records --------------------------------------------------------------------------------------------

    def _send(self, **changes: Any) -> None:
        for name, value in changes.items():
            setattr(self._orders, name, value)
        if not self._closed:  # `stop` may be called after `close`; the power is off then
            self._writer.write(self._orders.encoded())

    def _poll(self) -> PlantState | None:
        """The newest state of any plant; None before the first."""
        record = self._reader.poll()
        if record is not None:
            self._state = PlantState.decoded(record, len(self._names))
            if self._state.remarks != self._encoded_remarks:
                self._encoded_remarks = self._state.remarks
                self._remarks = msgspec.msgpack.decode(self._encoded_remarks, type=Remarks)
        return self._state

    def _state_of_session(self) -> PlantState:
        """The newest state of the configured plant. Raises DriverError if it has ended."""
        state = self._poll()
        if state is None or state.session != self._orders.session or not self._lives():
            raise DriverError(
                ENDED,
                "the process of the simulated drives ended, and they stopped; the supervisor starts it again: see what "
                "it logged last, reset, then enable",
            )
        return state

    def _lives(self) -> bool:
        """Whether the process that wrote the newest state lives; checked only if it has been silent."""
        state = self._state
        if state is not None and self._clock.now_ns() - state.t_ns < SILENT_NS:
            return True
        return self._reader.writer_lives()

    def _raise_failure(self, state: PlantState) -> None:
        """Raise the drives' newest failure, once."""
        if state.failures != self._failures:
            self._failures = state.failures
            raise DriverError(self._remarks.code, self._remarks.message, retry=self._remarks.retry)


def make_driver(plan: RunPlan, clock: Clock) -> JointDriver:
    """The cell's joint driver, constructed and not connected. Raises PluginError, DriverError."""
    kind = plugins.load(plugins.JOINT_DRIVERS, plan.cell.joints.driver)
    driver: JointDriver = kind(plan.cell.joints.options, plan.driver_context(clock))
    return driver
