"""An emulated drive on a bench: its axis is moved by an exact ramp, frames go in and come out."""

import struct
from pathlib import Path

import pytest

import stereoservo_drivers.canopen
from stereoservo.ports.devices import JointSpec
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_sim.emulators.nodes.cia402_node import Cia402Node
from stereoservo_sim.emulators.nodes.node import EmulatedAxis, NodeSettings

EDS = Path(stereoservo_drivers.canopen.__file__).parent / "drive402.eds"
MS = 1_000_000


class Bench:
    """A node and its axis; ``heard``: (time [ns], frame) of everything that the node has sent."""

    def __init__(self, *, node_id=3, position=0.1, joint=None, **settings):
        options = {
            "name": "a", "node_id": node_id, "counts_per_rev": 4096, "gear_ratio": 100.0, "max_velocity": 1.0,
            "max_acceleration": 4.0, "quick_stop_deceleration": 10.0, "position_min": -3.0, "position_max": 3.0,
        } | (joint or {})  # fmt: skip
        self.joint = CanJoint(**options)
        self.axis = EmulatedAxis(JointSpec("a", "revolute", -3.0, 3.0, 1.0, 4.0), position, set_position=position)
        self.node = Cia402Node(node_id, self.axis, self.joint, eds=EDS, settings=NodeSettings(**settings))
        self.id = node_id
        self.t = 0
        self.heard = []
        self.node.power_up(0)
        self._collect()

    def _collect(self):
        new = self.node.outgoing()
        self.heard += [(self.t, frame) for frame in new]
        return new

    def _move(self, h_ns):
        axis, h = self.axis, h_ns * 1e-9
        if not axis.powered:
            axis.set_velocity = 0.0
            axis.set_position = axis.position
        else:
            gap = axis.target - axis.set_velocity
            ramp = min(abs(gap) / axis.acceleration, h)
            reached = (
                axis.target if ramp < h else axis.set_velocity + (axis.acceleration * ramp) * (1 if gap > 0 else -1)
            )
            axis.set_position += 0.5 * (axis.set_velocity + reached) * ramp + reached * (h - ramp)
            axis.set_velocity = reached
            if not axis.blocked:
                axis.position = axis.set_position
        axis.velocity = 0.0 if axis.blocked else axis.set_velocity

    def run(self, ms):
        """Let so much time pass; gives the frames sent."""
        end, new = self.t + round(ms * MS), []
        while self.t < end:
            step = max(min(self.node.due_ns(), end), self.t + 1)
            self._move(step - self.t)
            self.t = step
            self.node.advance(self.t)
            new += self._collect()
        return new

    def send(self, can_id, *data, **kind):
        """A frame to the node; gives its answers."""
        self.node.receive(CanFrame(id=can_id, data=bytes(data), **kind), self.t)
        return self._collect()

    def nmt(self, command, node=None):
        return self.send(0, command, self.id if node is None else node)

    def word(self, word):
        """The control word by RPDO 1 as the EDS maps it."""
        return self.send(0x200 + self.id, *word.to_bytes(2, "little"))

    def sync(self):
        return self.send(0x80)

    def trip(self, code, **kind):
        """An ordered fault; gives the frames it makes."""
        self.node.trip(code, self.t, **kind)
        return self._collect()

    def sdo(self, command, index, sub, data=bytes(4)):
        """The answer to one request."""
        answers = self.send(0x600 + self.id, *struct.pack("<BHB4s", command, index, sub, data))
        (answer,) = (f for f in answers if f.id == 0x580 + self.id)
        return answer.data

    def write(self, index, sub, value, size):
        """By SDO; the abort code, 0 where it was taken."""
        data = value.to_bytes(size, "little", signed=value < 0)
        answer = self.sdo(0x23 | (4 - size) << 2, index, sub, data)
        return struct.unpack_from("<L", answer, 4)[0] if answer[0] == 0x80 else 0

    def read(self, index, sub=0, *, signed=False):
        """By SDO, up to four bytes. Raises LookupError with the abort code."""
        answer = self.sdo(0x40, index, sub)
        if answer[0] == 0x80:
            raise LookupError(hex(struct.unpack_from("<L", answer, 4)[0]))
        size = 4 - (answer[0] >> 2 & 3)
        return int.from_bytes(answer[4 : 4 + size], "little", signed=signed)

    def quiet_pdos(self):
        """All PDOs but RPDO 1 off."""
        for index in (0x1401, 0x1402, 0x1403, 0x1800, 0x1801, 0x1802, 0x1803):
            assert self.write(index, 1, self.read(index, 1) | 1 << 31, 4) == 0

    def enable(self, mode=9, **objects):
        """Operational and enabled in ``mode``, with further objects ``x605A=6`` written before."""
        sizes = {0x605A: 2, 0x605B: 2, 0x605C: 2, 0x605D: 2, 0x605E: 2, 0x6007: 2, 0x6066: 2}
        self.quiet_pdos()
        assert self.write(0x6060, 0, mode, 1) == 0
        for name, value in objects.items():
            index = int(name[1:5], 16)
            sub = int(name[6:] or 0) if "_" in name else 0
            assert self.write(index, sub, value, sizes.get(index, 4)) == 0
        self.nmt(1)
        for word in (0x06, 0x07, 0x0F):
            self.word(word)
        self.run(self.node.settings.brake_ms + 3)
        assert "operation enabled" in self.node.state()

    def velocity(self, units):
        assert self.write(0x60FF, 0, units, 4) == 0

    def emergencies(self):
        """(code, register) of all so far."""
        return [struct.unpack_from("<HB", f.data) for _, f in self.heard if f.id == 0x80 + self.id]

    @property
    def power_state(self):
        return str(self.node.machine.state)

    def run_to_rest(self, most_ms=3000):
        """Until the drive's ramp is at zero; the time it took [ms]."""
        start = self.t
        while self.axis.set_velocity != 0.0:
            assert self.t - start < most_ms * MS, "the axis does not come to rest"
            self.run(0.1)
        return (self.t - start) / MS


@pytest.fixture
def make_bench():
    return Bench


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def eds():
    return EDS


@pytest.fixture(scope="session")
def fuzz_bench():
    """For hypothesis, which takes no fixtures of function scope."""
    return Bench
