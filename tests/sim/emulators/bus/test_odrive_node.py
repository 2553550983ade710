"""The emulated ODrive by itself, byte by byte."""

from __future__ import annotations

import math
import struct

import pytest

from stereoservo.ports.devices import JointSpec
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_sim.emulators.nodes.node import EmulatedAxis
from stereoservo_sim.emulators.nodes.odrive_node import OdriveNode, OdriveSettings

MS = 1_000_000
GEAR = 30.0


def drive(**settings):
    joint = CanJoint(
        name="a", node_id=2, counts_per_rev=1.0, gear_ratio=GEAR, direction=-1, offset_rad=0.5, rated_torque=60.0,
        max_velocity=1.0, max_acceleration=5.0, quick_stop_deceleration=20.0, position_min=-3.0, position_max=3.0,
    )  # fmt: skip
    axis = EmulatedAxis(JointSpec("a", "revolute", -3.0, 3.0, 1.0, 5.0), 0.2)
    node = OdriveNode(2, axis, joint, settings=OdriveSettings(**{"boot_ns": 300 * MS, **settings}))
    node.power_up(0)
    node.advance(300 * MS)
    node.outgoing()
    return node


def tell(node, command, data, t_ns):
    node.receive(CanFrame(2 * 32 + command, data), t_ns)


def ask(node, command, t_ns):
    node.outgoing()
    node.receive(CanFrame(2 * 32 + command, remote=True, length=8), t_ns)
    (answer,) = [f for f in node.outgoing() if f.id == 2 * 32 + command]
    return answer.data


def closed_loop(node, t_ns):
    tell(node, 0x0B, bytes([2, 0, 0, 0, 1, 0, 0, 0]), t_ns)
    tell(node, 0x07, bytes([8, 0, 0, 0]), t_ns)


def velocity(node, turns_s, t_ns):
    tell(node, 0x0D, struct.pack("<ff", turns_s, 0.0), t_ns)


def test_boots_silently_then_says_that_it_is_idle_ten_times_a_second():
    node = drive()
    node.power_up(1000 * MS)
    node.receive(CanFrame(2 * 32, remote=True, length=8), 1100 * MS)
    node.advance(1299 * MS)
    assert node.outgoing() == []
    assert node.due_ns() == 1300 * MS
    node.advance(1500 * MS)
    beats = node.outgoing()
    assert [f.id for f in beats] == [2 * 32 + 1] * 3
    assert all(f.data == bytes([0, 0, 0, 0, 1, 0, 0, 0]) for f in beats)


def test_estimates_are_turns_of_the_motor():
    node = drive()
    turns, turns_s = struct.unpack("<ff", ask(node, 9, 400 * MS))
    assert turns == pytest.approx(-(0.2 + 0.5) * GEAR / (2 * math.pi), rel=1e-6)
    node.axis.position, node.axis.velocity = 0.3, 0.7
    moved, turns_s = struct.unpack("<ff", ask(node, 9, 401 * MS))
    assert moved - turns == pytest.approx(-0.1 * GEAR / (2 * math.pi), rel=1e-5)
    assert turns_s == pytest.approx(-0.7 * GEAR / (2 * math.pi), rel=1e-6)
    node.axis.inverted_encoder = True
    node.axis.position = 0.4
    assert struct.unpack("<ff", ask(node, 9, 402 * MS))[0] == pytest.approx(turns, rel=1e-5)


def test_torque_is_that_of_the_motor():
    node = drive()
    node.axis.effort = 0.5
    assert struct.unpack("<ff", ask(node, 0x1C, 400 * MS))[1] == pytest.approx(-0.5 * 60.0 / GEAR, rel=1e-6)


def test_closed_loop_starts_at_rest_and_follows_velocities():
    node = drive()
    velocity(node, 3.0, 300 * MS)  # idle: no effect
    assert not node.axis.powered
    closed_loop(node, 310 * MS)
    assert node.axis.powered
    assert not node.axis.brake_closed
    assert node.axis.target == 0.0
    velocity(node, 3.0, 311 * MS)
    assert node.axis.target == pytest.approx(-3.0 / GEAR * 2 * math.pi)
    tell(node, 0x07, bytes([1, 0, 0, 0]), 312 * MS)
    assert not node.axis.powered
    assert node.axis.target == 0.0


def test_velocities_have_no_effect_in_position_control():
    node = drive()
    tell(node, 0x07, bytes([8, 0, 0, 0]), 310 * MS)
    velocity(node, 3.0, 311 * MS)
    assert node.axis.powered
    assert node.axis.target == 0.0


def test_limits_and_ramp():
    node = drive(vel_ramp_rate=5.0)
    closed_loop(node, 310 * MS)
    tell(node, 0x0F, struct.pack("<ff", 2.0, 10.0), 311 * MS)
    tell(node, 0x0B, bytes([2, 0, 0, 0, 2, 0, 0, 0]), 311 * MS)
    velocity(node, 30.0, 312 * MS)
    assert abs(node.axis.target) == pytest.approx(2.0 / GEAR * 2 * math.pi)
    assert node.axis.acceleration == pytest.approx(5.0 / GEAR * 2 * math.pi)


def test_watchdog_disarms_an_axis_that_hears_no_velocities():
    node = drive(watchdog_ns=100 * MS)
    closed_loop(node, 310 * MS)
    for t in range(311, 500, 4):
        velocity(node, 1.0, t * MS)
    node.receive(CanFrame(2 * 32 + 9, remote=True, length=8), 590 * MS)  # a poll does not feed it
    assert node.axis.powered
    assert node.due_ns() <= 600 * MS
    node.advance(600 * MS)
    assert not node.axis.powered
    assert struct.unpack("<II", ask(node, 3, 601 * MS)) == (0, 0x1000000)
    tell(node, 0x07, bytes([8, 0, 0, 0]), 602 * MS)
    assert not node.axis.powered  # errors first
    tell(node, 0x18, b"\x00", 603 * MS)
    assert not node.axis.powered
    closed_loop(node, 604 * MS)
    assert node.axis.powered


def test_estop_and_trip_and_end_stop_disarm():
    node = drive()
    for code, order in (
        (0x2000000, lambda t: tell(node, 0x02, b"", t)),
        (0x4000000, lambda t: node.trip(0x4000000, t)),
        (
            0x10000,
            lambda t: (setattr(node.axis, "limit_switch", -1), velocity(node, 1.0, t), node.advance(t)),
        ),
    ):
        tell(node, 0x18, bytes(8), 310 * MS)
        closed_loop(node, 311 * MS)
        assert node.axis.powered
        order(312 * MS)
        assert not node.axis.powered
        assert struct.unpack("<II", ask(node, 3, 313 * MS))[1] == code
        assert hex(code)[2:] in node.state()


def test_addresses_and_other_nodes():
    node = drive(serial_number=0x123456)
    assert ask(node, 6, 400 * MS) == bytes([2, 0x56, 0x34, 0x12, 0, 0, 0, 0])
    assert ask(node, 0, 400 * MS)[0] == 2
    node.receive(CanFrame(3 * 32 + 6, remote=True, length=8), 401 * MS)
    node.receive(CanFrame(2 * 32 + 6, remote=True, extended=True, length=8), 401 * MS)
    assert [f for f in node.outgoing() if f.id & 31 != 1] == []


def test_not_a_number_is_no_velocity():
    node = drive()
    closed_loop(node, 310 * MS)
    velocity(node, 1.0, 311 * MS)
    before = node.axis.target
    velocity(node, math.nan, 312 * MS)
    assert node.axis.target == before
