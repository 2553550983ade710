"""A scripted node of the emulated bus's protocol, and emulated buses of them."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from stereoservo.ports.devices import JointSpec
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator
from stereoservo_sim.emulators.bus.plant import AxisPlant
from stereoservo_sim.emulators.nodes.node import NEVER_NS, EmulatedAxis
from stereoservo_sim.world.velocity_drives import IdealPlant

MS = 1_000_000


def make_axis(k: int = 0, position: float = 0.0) -> EmulatedAxis:
    """A joint of 1 rad/s and 4 rad/s² between -2 and 2 rad."""
    return EmulatedAxis(JointSpec(f"j{k + 1}", "revolute", -2.0, 2.0, 1.0, 4.0), position)


class ScriptedNode:
    """Two frames on each SYNC, one each ``beat_ns``; obeys 0x200 + id: power on or off, target [mrad/s]."""

    def __init__(self, node_id: int, axis: EmulatedAxis, beat_ns: int = 20 * MS) -> None:
        self.node_id = node_id
        self.axis = axis
        self.beat_ns = beat_ns
        self.heard: list[tuple[int, CanFrame]] = []
        self.error = 0
        self._out: list[CanFrame] = []
        self._beat = NEVER_NS

    def power_up(self, t_ns: int) -> None:
        self.axis.powered = False
        self.axis.brake_closed = True
        self._out.append(CanFrame(0x700 + self.node_id, b"\0"))
        self._beat = t_ns + self.beat_ns

    def accepts(self, frame: CanFrame) -> bool:
        return True

    def receive(self, frame: CanFrame, t_ns: int) -> None:
        self.heard.append((t_ns, frame))
        if frame.id == 0x80:
            position = round(self.axis.position * 1e6).to_bytes(8, "little", signed=True)
            self._out.append(CanFrame(0x180 + self.node_id, position))
            self._out.append(CanFrame(0x280 + self.node_id, b"\x55" * 4))
        elif frame.id == 0x200 + self.node_id:
            self.axis.powered = bool(frame.data[0])
            self.axis.brake_closed = not self.axis.powered
            self.axis.acceleration = 4.0
            self.axis.target = int.from_bytes(frame.data[1:5], "little", signed=True) * 1e-3
        elif frame.id == 0 and frame.data[:1] == b"\x02" and frame.data[1] in (0, self.node_id):
            self.axis.target = 0.0

    def advance(self, t_ns: int) -> None:
        while self._beat <= t_ns:
            self._out.append(CanFrame(0x700 + self.node_id, b"\x05"))
            self._beat += self.beat_ns

    def due_ns(self) -> int:
        return self._beat

    def outgoing(self) -> list[CanFrame]:
        out, self._out = self._out, []
        return out

    def trip(self, code: int, t_ns: int) -> None:
        self.error = code
        self.axis.powered = False
        self.axis.brake_closed = True

    def state(self) -> str:
        return f"fault {self.error:#x}" if self.error else "on" if self.axis.powered else "off"

    def __deepcopy__(self, memo: dict) -> ScriptedNode:
        double = ScriptedNode(self.node_id, copy.copy(self.axis), self.beat_ns)
        double._beat = self._beat
        return double


def command(node_id: int, velocity: float, powered: bool = True) -> CanFrame:
    """Power and target velocity [rad/s] for a scripted node."""
    target = round(velocity * 1e3).to_bytes(4, "little", signed=True)
    return CanFrame(0x200 + node_id, bytes([powered]) + target)


def make_bus_emulator_of(count: int, bitrate: int | None = None, **plant_options) -> BusEmulator:
    axes = [make_axis(k) for k in range(count)]
    nodes = [ScriptedNode(k + 1, axis) for k, axis in enumerate(axes)]
    plant = AxisPlant(axes, IdealPlant(np.zeros(count)), t_ns=0, **plant_options)
    return BusEmulator(nodes, plant, bitrate=bitrate, t_ns=0)


@pytest.fixture
def scripted():
    """Makes emulated buses of scripted nodes; ``command`` makes their commands, ``axis`` a joint."""

    class Kit:
        emulator = staticmethod(make_bus_emulator_of)
        command = staticmethod(command)
        axis = staticmethod(make_axis)
        node = ScriptedNode

    return Kit
