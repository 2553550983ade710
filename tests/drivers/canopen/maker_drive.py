"""CiA 402 drives played by the `canopen` package on makers' EDS files, in virtual time.

Independent of the emulator of this project: object dictionary, SDO server and NMT slave are the package's; SYNC,
process data, guarding and the power state machine are written here from CiA 301 and CiA 402-2.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import canopen
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import Subscriptions
from stereoservo_drivers.canopen.master import Master

STEP_NS = 500_000
DELAY_NS = 150_000
"""Until an answer is there."""


class Periodic:
    """A frame that the package sends periodically."""

    def __init__(self, can_id: int, data: Any, period_s: float, now_ns: int) -> None:
        self.can_id, self.data = can_id, bytes(data)
        self.period_ns = round(period_s * 1e9)
        self.next_ns = now_ns + self.period_ns
        self.on = True

    def stop(self) -> None:
        self.on = False

    def update(self, data: Any) -> None:
        self.data = bytes(data)


class Wire(canopen.Network):
    """The package's network without a bus."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = 0
        self.sent: list[CanFrame] = []
        self.periodic: list[Periodic] = []

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        self.sent.append(CanFrame(can_id, bytes(data), remote=remote))

    def send_periodic(self, can_id: int, data: Any, period: float, remote: bool = False) -> Any:
        self.periodic.append(Periodic(can_id, data, period, self.now_ns))
        return self.periodic[-1]


class MakerDrive:
    """One drive with the dictionary of ``eds``. ``values``: what its EDS leaves open.

    ``sag``: counts by which it stands off its position set-point; ``blocked``: its shaft does not turn; ``word``: bits
    of the status word that it sets beside its state.
    """

    def __init__(
        self, node_id: int, eds: Path, values: dict[tuple[int, int], int], lacking: tuple[int, ...] = (),
        fixed: tuple[int, ...] = (),
    ) -> None:  # fmt: skip
        self.wire = Wire()
        self.node = canopen.LocalNode(node_id, canopen.import_od(str(eds), node_id))
        self.node_id = node_id
        dictionary = self.node.object_dictionary
        for index in lacking:
            if index in dictionary:
                del dictionary.indices[index]
        for index in dictionary:
            entry = dictionary[index]
            for variable in [entry] if isinstance(entry, canopen.objectdictionary.ODVariable) else entry.values():
                if variable.value is None and variable.default is None and variable.fixed_size:
                    variable.default = 0
        for (index, subindex), value in values.items():
            self.put(index, subindex, value)
        for index in fixed:
            for variable in dictionary[index].values():
                variable.access_type = "ro"
        self.node.associate_network(self.wire)
        self.node.add_read_callback(self._live)
        self.node.nmt.send_command(0)
        self.node.nmt.send_command(128)
        self.state = 0x40
        self.counts, self.speed = 0.0, 0.0
        self.sag, self.blocked, self.word = 0.0, False, 0
        self.heard_ns: int | None = None
        self.guarded_ns: int | None = None
        self.rpdo_ns: int | None = None
        self._toggle = 0
        self._syncs = [0] * 4
        self._goal: int | None = None
        self._taken = False
        self.reason = ""
        self.cut = False

    # -- dictionary -----------------------------------------------------------------------------------------

    def has(self, index: int, subindex: int = 0) -> bool:
        return self.node.object_dictionary.get_variable(index, subindex) is not None

    def get(self, index: int, subindex: int = 0) -> int:
        """An object's value; 0 where it is not there."""
        variable = self.node.object_dictionary.get_variable(index, subindex)
        return 0 if variable is None else int(variable.decode_raw(self.node.get_data(index, subindex)))

    def put(self, index: int, subindex: int, value: int) -> None:
        variable = self.node.object_dictionary.get_variable(index, subindex)
        if variable is not None:
            self.node.set_data(index, subindex, variable.encode_raw(value))

    def _live(self, index: int, subindex: int, **_: Any) -> int | None:
        live: dict[int, Callable[[], int]] = {
            0x6041: self._status,
            0x6064: lambda: round(self.counts),
            0x606C: lambda: round(self.speed),
            0x6061: lambda: self.get(0x6060),
        }
        return live[index]() if index in live else None

    def _status(self) -> int:
        following = 0x1000 if self.state == 0x27 and self.get(0x6060) in (7, 8, 9) else 0
        if self.get(0x6060) == 1:
            following = 0x1000 * self._taken
        return self.state | 0x10 * (self.state != 0x40) | 0x200 | (following & ~self.word) | (self.word & ~0x1000)

    # -- bus ------------------------------------------------------------------------------------------------

    def receive(self, frame: CanFrame, t_ns: int) -> list[CanFrame]:
        """Answers to a frame."""
        self.wire.now_ns = t_ns
        if self.cut:
            return []
        operational = self.node.nmt.state == "OPERATIONAL"
        if frame.remote:
            if frame.id == 0x700 + self.node_id and not self.get(0x1017):
                self.guarded_ns = t_ns
                state = {"OPERATIONAL": 5, "PRE-OPERATIONAL": 127, "STOPPED": 4}[self.node.nmt.state]
                self.wire.send_message(frame.id, [state | self._toggle])
                self._toggle ^= 0x80
        elif frame.id == 0x80:
            self._answer_sync(operational)
        elif frame.id == 0x77F:
            self.heard_ns = t_ns
        elif operational and (number := self._received(frame.id)) is not None:
            self.rpdo_ns = t_ns
            self._take(number, frame.data)
        else:
            self.wire.notify(frame.id, bytearray(frame.data), t_ns * 1e-9)
            if frame.id == 0x600 + self.node_id:
                self._control(self.get(0x6040))
        return self._flush()

    def _flush(self) -> list[CanFrame]:
        sent, self.wire.sent = self.wire.sent, []
        return [] if self.cut else sent

    def _answer_sync(self, operational: bool) -> None:
        for number in range(4):
            cob_id = self.get(0x1800 + number, 1)
            every = self.get(0x1800 + number, 2)
            if not operational or cob_id >> 31 or not self.get(0x1A00 + number) or not 1 <= every <= 240:
                continue
            self._syncs[number] += 1
            if self._syncs[number] % every:
                continue
            data = b""
            for sub in range(1, self.get(0x1A00 + number) + 1):
                entry = self.get(0x1A00 + number, sub)
                data += self.node.get_data(entry >> 16, entry >> 8 & 0xFF)
            self.wire.send_message(cob_id & 0x7FF, data)

    def _received(self, can_id: int) -> int | None:
        """Number of the RPDO with this COB-ID, if it is on."""
        for number in range(4):
            cob_id = self.get(0x1400 + number, 1)
            if self.has(0x1400 + number, 1) and cob_id & 0x7FF == can_id and not cob_id >> 31:
                return number
        return None

    def _take(self, number: int, data: bytes) -> None:
        for sub in range(1, self.get(0x1600 + number) + 1):
            entry = self.get(0x1600 + number, sub)
            size = (entry & 0xFF) // 8
            if entry >> 16 >= 0x20:  # those below are dummies
                self.node.set_data(entry >> 16, entry >> 8 & 0xFF, data[:size])
            data = data[size:]
        assert not data
        self._control(self.get(0x6040))

    def _control(self, word: int) -> None:
        """The power state machine of CiA 402-2, figure 2."""
        if word & 0x80 and self.state == 0x08:
            self.state = 0x40
        elif self.state == 0x08:
            return
        elif not word & 0x02:
            self.state = 0x40
        elif not word & 0x04:
            self.state = 0x07 if self.state in (0x27, 0x07) else 0x40
        elif word & 0x0F == 0x06:
            self.state = 0x21
        elif word & 0x0F == 0x07 and self.state in (0x21, 0x27):
            self.state = 0x23
        elif word & 0x0F == 0x0F and self.state in (0x23, 0x27):
            self.state = 0x27
        strobe = bool(word & 0x10) and self.state == 0x27
        if self.get(0x6060) == 1 and strobe and not self._taken:  # CiA 402-2, profile position
            self._goal = self.get(0x607A)
        self._taken = strobe
        if self.state != 0x27:
            self._goal = None

    # -- time -----------------------------------------------------------------------------------------------

    def step(self, t_ns: int, dt: float) -> list[CanFrame]:
        """Advance to ``t_ns``; frames that it sends by itself."""
        self.wire.now_ns = t_ns
        for task in self.wire.periodic:
            if task.on and t_ns >= task.next_ns:
                task.next_ns += task.period_ns
                self.wire.send_message(task.can_id, task.data)
        self._watch(t_ns)
        self._move(dt)
        return self._flush()

    def _watch(self, t_ns: int) -> None:
        """Stop on what is overdue, as far as the drive can know."""
        if self.state != 0x27:
            return
        consumer = self.get(0x1016, 1)
        limits = (
            ("heartbeat", self.heard_ns, (consumer & 0xFFFF) * (consumer >> 16 == 0x7F)),
            ("guarding", self.guarded_ns, self.get(0x100C) * self.get(0x100D)),
            ("deadline", self.rpdo_ns, self.get(0x1400, 5)),
        )
        for name, heard_ns, limit_ms in limits:
            if limit_ms and heard_ns is not None and t_ns - heard_ns > limit_ms * 1_000_000:
                self.reason = name
                quick = self.get(0x6007) == 3 and self.get(0x605A) > 4 and name == "heartbeat"
                self.state = 0x07 if quick else 0x08

    def _move(self, dt: float) -> None:
        mode = self.get(0x6060)
        ramp = self.get(0x6085) or 1e6
        if self.state == 0x27 and mode in (3, 9):
            wanted = float(self.get(0x60FF))
        elif self.state == 0x27 and (mode == 8 or (mode == 7 and self.get(0x6040) & 0x10)):
            order = self.get(0x607A) if mode == 8 else self.get(0x60C1, 1)
            wanted = (order - self.sag - self.counts) / 0.02
        elif self.state == 0x27 and mode == 1 and self._goal is not None and not self.get(0x6040) & 0x100:
            gap, ramp = self._goal - self.counts, self.get(0x6083) or 1e6
            fastest = min(float(self.get(0x6081)), (1.6 * ramp * abs(gap)) ** 0.5, abs(gap) / (2.0 * dt))
            wanted = fastest if gap > 0 else -fastest
        else:
            wanted = 0.0
        self.speed += (
            float(np.clip(wanted - self.speed, -ramp * dt, ramp * dt)) if mode in (1, 3, 9) else wanted - self.speed
        )
        if self.blocked:
            self.speed = 0.0
        self.counts += self.speed * dt


class MakerBus(Subscriptions):
    """A link for bring-up, and the ticks of a master, beside drives in one virtual time."""

    def __init__(self, drives: list[MakerDrive], master: Master) -> None:
        super().__init__()
        self.drives, self.master = drives, master
        self.t_ns = 1_000_000_000
        self.velocities: FloatArray | None = None
        self.cycling = False
        self.cut = False
        self._coming: list[tuple[int, CanFrame]] = []
        self._tick_ns = self._heartbeat_ns = self.t_ns

    def send(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            for drive in self.drives:
                if not self.cut:
                    self._queue(drive.receive(frame, self.t_ns))

    def _queue(self, frames: list[CanFrame]) -> None:
        self._coming += [(self.t_ns + DELAY_NS, frame) for frame in frames if not self.cut]

    def now_ns(self) -> int:
        return self.t_ns

    def wait(self, seconds: float) -> None:
        end = self.t_ns + max(round(seconds * 1e9), 1)
        while self.t_ns < end:
            step = min(STEP_NS, end - self.t_ns)
            self.t_ns += step
            for drive in self.drives:
                self._queue(drive.step(self.t_ns, step * 1e-9))
            due = [frame for at, frame in self._coming if at <= self.t_ns]
            self._coming = [(at, frame) for at, frame in self._coming if at > self.t_ns]
            for frame in due:
                self.master.receive(frame, self.t_ns)
                self.tell(frame)
            self._act()

    def _act(self) -> None:
        if self.cycling and self.t_ns >= self._tick_ns:
            self._tick_ns += round(1e9 / self.master.settings.rate_hz)
            if self.velocities is not None:
                self.master.set_command(self.velocities, self.t_ns)
            self.send(self.master.tick(self.t_ns))
        elif not self.cycling and self.t_ns >= self._heartbeat_ns:
            self._heartbeat_ns += self.master.settings.heartbeat_ms * 1_000_000
            self.send(self.master.codec.heartbeat())

    def begin_cycle(self) -> None:
        self.master.clear()
        self._tick_ns = self.t_ns
        self.cycling = True
