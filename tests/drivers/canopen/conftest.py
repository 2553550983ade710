"""A scripted protocol of two or more axes, so that the master is tested without any protocol's details."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import NOT_CYCLIC, AxisFault, Feedback
from stereoservo_drivers.canopen.master import Master, MasterSettings
from stereoservo_drivers.canopen.options import CanJoint

PERIOD_NS = 4_000_000
SYNC, STATE, MORE, COMMAND, HEARTBEAT = 0x80, 0x180, 0x280, 0x200, 0x77F
OFF, ON = 0, 1
WORDS = {b"I": "idle", b"E": "enable", b"C": "command", b"Q": "quick stop"}


@dataclass
class ScriptedCodec:
    """Two frames an axis and cycle: state (on, position) and velocity. Orders are one letter and a float64."""

    n: int
    feedback: Feedback = field(init=False)
    pending: list[AxisFault] = field(default_factory=list)
    on: list[bool] = field(init=False)

    def __post_init__(self) -> None:
        self.feedback = Feedback(np.full(self.n, np.nan), np.full(self.n, np.nan))
        self.on = [False] * self.n
        self.expected = (1 << 2 * self.n) - 1
        self.bit_axis = tuple(b // 2 for b in range(2 * self.n))
        self.bit_name = tuple(f"TPDO{b % 2 + 1} of node {b // 2 + 1}" for b in range(2 * self.n))

    def poll(self) -> list[CanFrame]:
        return [CanFrame(SYNC)]

    def heartbeat(self) -> list[CanFrame]:
        return [CanFrame(HEARTBEAT, b"\x05")]

    def receive(self, frame: CanFrame) -> int:
        axis = (frame.id & 0x7F) - 1
        if not 0 <= axis < self.n or frame.id & ~0x7F not in (STATE, MORE):
            return NOT_CYCLIC
        if frame.id & ~0x7F == STATE:
            on, position = struct.unpack("<Bf", frame.data)
            self.on[axis] = bool(on)
            self.feedback.positions[axis] = position
            return 2 * axis
        (self.feedback.velocities[axis],) = struct.unpack("<f", frame.data)
        return 2 * axis + 1

    def faults(self) -> tuple[AxisFault, ...]:
        pending, self.pending = self.pending, []
        return tuple(pending)

    def enabled(self) -> bool:
        return all(self.on)

    def at_rest_unpowered(self) -> bool:
        return not any(self.on)

    def _orders(self, letter: bytes, velocities: FloatArray) -> list[CanFrame]:
        return [CanFrame(COMMAND + k + 1, letter + struct.pack("<f", velocities[k])) for k in range(self.n)]

    def idle(self) -> list[CanFrame]:
        return self._orders(b"I", np.zeros(self.n))

    def enable(self) -> list[CanFrame]:
        return self._orders(b"E", np.zeros(self.n))

    def command(self, velocities: FloatArray) -> list[CanFrame]:
        return self._orders(b"C", velocities)

    def quick_stop(self) -> list[CanFrame]:
        return self._orders(b"Q", np.zeros(self.n))

    def sendable(self, velocities: FloatArray) -> FloatArray:
        return velocities.astype(np.float32).astype(np.float64)

    def status_words(self) -> tuple[str, ...]:
        return tuple("on" if on else "off" for on in self.on)


@dataclass
class ScriptedBus:
    """Master and obedient ideal axes in one virtual time; ``hooks`` change what the axes answer."""

    master: Master
    codec: ScriptedCodec
    t_ns: int = 1_000_000_000
    period_ns: int = PERIOD_NS
    calls_port: bool = True
    positions: FloatArray = field(init=False)
    velocities: FloatArray = field(init=False)
    answers: Callable[[int, list[tuple[int, CanFrame]]], list[tuple[int, CanFrame]]] | None = None
    """Of a cycle's number and its answers (delay [ns] after the poll, frame): those that come."""
    late: list[tuple[int, CanFrame]] = field(default_factory=list)
    orders: list[tuple[str, list[float]]] = field(default_factory=list)
    """What each tick told the axes: one word for all, and velocities."""
    heartbeats: int = 0
    cycles: int = 0

    def __post_init__(self) -> None:
        self.positions = np.zeros(self.codec.n)
        self.velocities = np.zeros(self.codec.n)
        self.on = [False] * self.codec.n

    def cycle(self, count: int = 1) -> None:
        for _ in range(count):
            if self.calls_port:
                self.master.port_called(self.t_ns)
            frames = self.master.tick(self.t_ns)
            assert frames[0].id == SYNC
            answers = self.answers_now()
            self._obey(frames)
            end_ns = self.t_ns + self.period_ns
            if self.answers is not None:
                answers = self.answers(self.cycles, answers)
            self.late += [(self.t_ns + delay, frame) for delay, frame in answers]
            self.late.sort(key=lambda item: item[0])
            while self.late and self.late[0][0] < end_ns:
                at, frame = self.late.pop(0)
                self.master.receive(frame, at)
            self.positions = self.positions + self.velocities * self.period_ns * 1e-9
            self.t_ns = end_ns
            self.cycles += 1

    def answers_now(self) -> list[tuple[int, CanFrame]]:
        answers = []
        for k in range(self.codec.n):
            state = struct.pack("<Bf", self.on[k], self.positions[k])
            answers.append((200_000 + 100_000 * k, CanFrame(STATE + k + 1, state)))
            speed = struct.pack("<f", self.velocities[k])
            answers.append((250_000 + 100_000 * k, CanFrame(MORE + k + 1, speed)))
        return answers

    def _obey(self, frames: list[CanFrame]) -> None:
        words = set()
        speeds = []
        for frame in frames[1:]:
            if frame.id == HEARTBEAT:
                self.heartbeats += 1
                continue
            k = frame.id - COMMAND - 1
            (speed,) = struct.unpack("<f", frame.data[1:])
            letter = frame.data[:1]
            words.add(WORDS[letter])
            speeds.append(speed)
            self.on[k] = letter in b"EC" and (letter == b"E" or self.on[k])
            self.velocities[k] = speed if self.on[k] else 0.0
        assert len(words) == 1
        assert len(speeds) == self.codec.n
        self.orders.append((words.pop(), speeds))

    def command(self, *velocities: float) -> None:
        self.master.set_command(np.array(velocities), self.t_ns)

    def run(self, *velocities: float, cycles: int = 1) -> None:
        for _ in range(cycles):
            self.command(*velocities)
            self.cycle()

    def enable(self) -> None:
        self.cycle(2)
        self.master.request_enable(self.t_ns)
        self.cycle(4)
        assert self.master.mode == "running"


def scripted_joint(k: int, **changes: object) -> CanJoint:
    values: dict[str, object] = {
        "name": f"j{k}", "node_id": k, "counts_per_rev": 4096, "gear_ratio": 100.0, "max_velocity": 1.0,
        "max_acceleration": 1e3, "quick_stop_deceleration": 1e3, "position_min": -2.9, "position_max": 2.9,
    }  # fmt: skip
    return CanJoint(**(values | changes))  # type: ignore[arg-type]


@pytest.fixture
def make_bus() -> Callable[..., ScriptedBus]:
    """``make_bus(n=2, joint changes…)``."""

    def make(n: int = 2, **changes: object) -> ScriptedBus:
        joints = tuple(scripted_joint(k + 1, **changes) for k in range(n))
        settings = MasterSettings(
            joints=joints, rate_hz=250.0, bitrate=1_000_000, heartbeat_ms=20, max_missed_cycles=3,
            command_timeout_s=0.1, loop_timeout_ms=100,
        )  # fmt: skip
        codec = ScriptedCodec(n)
        return ScriptedBus(Master(codec, settings), codec)

    return make


@pytest.fixture
def bus(make_bus: Callable[..., ScriptedBus]) -> ScriptedBus:
    """Two axes."""
    return make_bus()
