"""The master's cycle over a scripted protocol: modes, freshness, samples, the latch."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import pytest

from stereoservo.core.cycle import DriverFault, StepInputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import core_settings
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.goals import Enable, Jog, Request, Reset, Resume
from stereoservo.ports.devices import CameraDescription, JointDriverDescription
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import AxisFault
from stereoservo_drivers.canopen.master import MasterFault, Mode

if TYPE_CHECKING:
    from collections.abc import Callable


def test_off_until_enabled_and_then_at_rest(bus) -> None:
    bus.cycle(5)
    assert bus.master.mode is Mode.OFF
    assert {word for word, _ in bus.orders} == {"idle"}
    bus.orders.clear()
    bus.master.request_enable(bus.t_ns)
    bus.cycle(4)
    assert bus.master.mode is Mode.RUNNING
    words = [word for word, _ in bus.orders]
    assert words[0] == "enable"
    assert words[-1] == "command"
    assert all(not any(speeds) for _, speeds in bus.orders)


def test_a_command_from_before_enabling_is_not_obeyed(bus) -> None:
    bus.cycle(2)
    bus.command(0.5, 0.5)
    bus.master.request_enable(bus.t_ns)
    bus.cycle(5)
    assert bus.master.mode is Mode.RUNNING
    assert not np.any(bus.positions)


def test_commands_move_and_samples_tell_with_the_stamp_of_their_poll(bus) -> None:
    bus.enable()
    bus.run(0.5, -0.25, cycles=10)
    poll_ns = bus.t_ns - bus.period_ns
    sample = bus.master.sample()
    assert sample.t_ns == poll_ns
    assert sample.velocities == pytest.approx([0.5, -0.25])
    assert sample.positions == pytest.approx(bus.positions - np.array([0.5, -0.25]) * 0.004, abs=1e-6)
    bus.run(0.5, -0.25)
    newer = bus.master.sample()
    assert newer.seq == sample.seq + 1
    assert newer.t_ns == poll_ns + bus.period_ns
    assert not np.array_equal(newer.positions, sample.positions)


def test_stale_commands_stop_the_arm_and_new_ones_move_it_again(bus) -> None:
    bus.enable()
    bus.run(0.5, 0.5, cycles=3)
    bus.orders.clear()
    bus.cycle(40)
    moving = [any(speeds) for _, speeds in bus.orders]
    # 0.1 s at 250 Hz: the command is obeyed for 25 more cycles, not one longer.
    assert moving == [True] * 25 + [False] * 15
    assert bus.master.mode is Mode.RUNNING
    bus.run(0.5, 0.5)
    assert bus.orders[-1] == ("command", [0.5, 0.5])


def test_disabling_ramps_down_before_the_power_goes(bus) -> None:
    bus.enable()
    bus.run(0.5, 0.5, cycles=3)
    bus.orders.clear()
    bus.master.request_disable()
    bus.cycle(10)
    words = [word for word, _ in bus.orders]
    off = words.index("idle")
    assert off >= 3
    assert words == ["command"] * off + ["idle"] * (10 - off)
    assert not any(any(speeds) for _, speeds in bus.orders)
    assert bus.master.mode is Mode.OFF
    assert bus.codec.at_rest_unpowered()


def test_disabling_does_not_wait_for_ever_for_rest(make_bus: Callable) -> None:
    bus = make_bus(max_acceleration=10.0)
    bus.enable()

    def creeping(cycle: int, answers: list) -> list:
        speed = struct.pack("<f", 0.05)
        return [(delay, CanFrame(f.id, speed) if f.id & 0x280 == 0x280 else f) for delay, f in answers]

    bus.answers = creeping
    bus.master.request_disable()
    # The ramp from full speed takes 0.1 s; with its margin of 0.1 s that is 50 cycles.
    bus.cycle(48)
    assert bus.master.mode is Mode.STOPPING
    bus.cycle(8)
    assert bus.master.mode is Mode.OFF
    assert bus.orders[-1][0] == "idle"


def test_a_drive_fault_stops_all_axes_every_cycle_until_cleared(bus) -> None:
    bus.enable()
    bus.run(0.5, 0.5, cycles=3)
    bus.codec.pending.append(AxisFault(1, "drive_fault", "node 2: overcurrent", 0x2310, "check the motor"))
    bus.orders.clear()
    bus.run(0.5, 0.5, cycles=50)
    assert {word for word, _ in bus.orders} == {"quick stop"}
    assert not any(any(speeds) for _, speeds in bus.orders)
    fault = bus.master.fault
    assert (fault.code, fault.axis, fault.value) == ("drive_fault", "j2", 0x2310)
    assert "check the motor" in fault.text()
    bus.master.request_enable(bus.t_ns)
    bus.cycle(5)
    assert bus.master.mode is Mode.LATCHED
    bus.master.clear()
    bus.orders.clear()
    bus.run(0.5, 0.5, cycles=10)
    assert bus.master.mode is Mode.OFF  # a reset never enables
    assert {word for word, _ in bus.orders} == {"idle"}
    bus.enable()


def test_the_first_fault_stands_and_later_ones_are_kept(bus) -> None:
    bus.enable()
    bus.codec.pending.append(AxisFault(0, "emergency", "first"))
    bus.cycle()
    bus.codec.pending += [AxisFault(1, "emergency", "second"), AxisFault(1, "emergency", "again")]
    bus.cycle()
    assert bus.master.fault.message == "joint 'j1': first"
    assert [fault.message for fault in bus.master.later_faults] == ["joint 'j2': second"]


def test_what_a_reset_itself_provoked_does_not_latch_again(bus) -> None:
    bus.enable()
    bus.master.latch(MasterFault("drive_fault", "x"))
    bus.cycle(2)
    bus.codec.pending.append(AxisFault(0, "rebooted", "node 1 booted: told to"))
    bus.master.clear()
    bus.cycle(3)
    assert bus.master.fault is None


def test_a_fault_latched_from_outside_stops_quickly_and_lasts(bus) -> None:
    bus.enable()
    bus.run(0.5, 0.5, cycles=2)
    bus.master.latch(MasterFault("quick_stop", "a quick stop was asked for"))
    bus.run(0.5, 0.5, cycles=2)
    assert bus.orders[-1][0] == "quick stop"
    assert bus.master.fault.code == "quick_stop"


def test_a_drive_that_leaves_its_enabled_state_latches(bus) -> None:
    bus.enable()
    bus.on[1] = False
    bus.run(0.1, 0.1, cycles=2)
    assert bus.master.fault.code == "disabled"
    assert "j2: off" in bus.master.fault.message
    assert bus.orders[-1][0] == "quick stop"


def test_drives_that_do_not_enable_in_time_latch(bus) -> None:
    def without_power(cycle: int, answers: list) -> list:
        return [
            (delay, CanFrame(frame.id, b"\x00" + frame.data[1:]) if len(frame.data) == 5 else frame)
            for delay, frame in answers
        ]

    bus.answers = without_power
    bus.cycle(2)
    bus.master.request_enable(bus.t_ns)
    bus.cycle(300)
    assert bus.master.mode is Mode.ENABLING
    bus.cycle(100)
    assert bus.master.fault.code == "enable_timeout"
    assert "j1: off" in bus.master.fault.message


def test_a_loop_that_does_not_call_latches_within_its_limit(bus) -> None:
    bus.enable()
    bus.run(0.5, 0.5, cycles=3)
    bus.calls_port = False
    start = bus.cycles
    while bus.master.fault is None and bus.cycles < start + 100:
        bus.cycle()
    assert bus.master.fault.code == "loop_hung"
    assert bus.cycles - start <= 27
    assert bus.orders[-1][0] == "quick stop"


class Loop:
    """A control core that commands the bus's axes in every cycle, as the servo process does."""

    def __init__(self, bus) -> None:
        settings = bus.master.settings
        joints = JointDriverDescription(
            "canopen", tuple(joint.spec() for joint in settings.joints), settings.rate_hz, "clock",
            settings.command_timeout_s, 100.0,
        )  # fmt: skip
        limits = [
            {"joint": j.name, "min": -2.9, "max": 2.9, "velocity": 1.0, "acceleration": 50.0} for j in joints.joints
        ]
        cell = check_cell(
            {
                "schema": 1,
                "cell": {"name": "bus"},
                "joints": {"driver": "canopen"},
                "camera": [{"name": "left", "driver": "fake"}],
                "safety": {"limit": limits},
            }
        )
        camera = CameraDescription("fake", "left", 640, 480, 30.0, "observations", 100.0, (0, 1, 2))
        self.bus = bus
        self.core = ServoCore(core_settings(cell, joints, (camera,)))
        self.active = False
        self.asked = 0
        bus.calls_port = False  # but by this loop
        bus.cycle(2)

    def step(self, *commands):
        """A cycle of the bus, then one of the core; returns the core's outputs."""
        bus = self.bus
        bus.cycle()
        bus.master.port_called(bus.t_ns)
        fault = bus.master.fault
        self.asked += len(commands)
        outputs = self.core.step(
            StepInputs(
                bus.t_ns, bus.period_ns, bus.master.sample(),
                requests=tuple(Request(self.asked, "test", command) for command in commands),
                driver_active=self.active and fault is None,
                driver_fault=None if fault is None else DriverFault(fault.code, fault.text()),
            )
        )  # fmt: skip
        if outputs.driver_request == "activate":
            bus.master.request_enable(bus.t_ns)
            bus.cycle(4)
            self.active = bus.master.mode is Mode.RUNNING
        elif outputs.driver_request:
            self.active = False
            if outputs.driver_request == "reset":
                bus.master.clear()
        elif outputs.command is not None and self.active and fault is None:
            bus.master.set_command(outputs.command, bus.t_ns)
        return outputs

    def run(self, cycles: int):
        for _ in range(cycles):
            outputs = self.step()
        return outputs

    def ask(self, command) -> bool:
        return next(e.accepted for e in self.step(command).events if e.kind == "reply")


@pytest.mark.parametrize("gap_ms", [200, 500])
def test_a_loop_that_stood_still_finds_the_arm_at_rest_and_moves_it_only_when_told_to(bus, gap_ms) -> None:
    """The bus thread commands zero from the command's time-out (100 ms) on, and from the loop's (300 ms) on latches."""
    bus.master.settings = msgspec.structs.replace(bus.master.settings, loop_timeout_ms=300)
    loop = Loop(bus)
    assert loop.ask(Enable())
    loop.run(5)
    assert loop.ask(Jog({"j1": 0.5}, 60.0))
    loop.run(20)
    bus.orders.clear()
    bus.cycle(gap_ms // 4)
    words = [word for word, _ in bus.orders]
    assert all(speeds[0] == pytest.approx(0.5) for _, speeds in bus.orders[:25])
    assert not any(speeds[0] for _, speeds in bus.orders[27:])
    assert set(words[:75]) == {"command"}
    assert set(words[77:]) == (set() if gap_ms < 300 else {"quick stop"})
    at_rest = bus.positions.copy()
    outputs = loop.step()
    first = "LOOP_GAP"
    if gap_ms > 300:
        assert "loop_hung" in outputs.status.reasons[0].hint
        first = "DRIVER_FAULT"
    assert first in [reason.code for reason in outputs.status.reasons]
    assert not loop.ask(Jog({"j1": 0.5}, 60.0))
    if gap_ms > 300:
        loop.ask(Resume())
        assert not loop.ask(Jog({"j1": 0.5}, 60.0))
        assert not loop.ask(Enable())
        assert loop.ask(Reset())
        loop.run(5)
        assert not loop.ask(Jog({"j1": 0.5}, 60.0))
        assert loop.ask(Enable())
    loop.run(50)
    np.testing.assert_array_equal(bus.positions, at_rest)
    loop.ask(Resume())
    outputs = loop.step(Jog({"j1": 0.5}, 60.0))
    assert 0.0 < outputs.command[0] <= 50.0 * 0.004 * (1.0 + 1e-9)
    loop.run(20)
    assert bus.positions[0] > at_rest[0] + 0.01


def test_nobody_needs_to_call_while_the_arm_is_off(bus) -> None:
    bus.calls_port = False
    bus.cycle(100)
    assert bus.master.fault is None


def test_a_joint_at_its_limit_only_moves_inward(bus) -> None:
    bus.enable()
    bus.positions = np.array([2.9, -2.95])
    bus.master.clear()  # the jump was ours
    bus.enable()
    bus.run(0.5, 0.5, cycles=2)
    assert bus.orders[-1][1] == [0.0, 0.5]
    sent, reasons = bus.master.limited(np.array([0.5, -0.5]))
    assert sent == pytest.approx([0.0, 0.0])
    assert reasons == ("position_limit",)
    bus.run(-0.5, -0.5, cycles=2)
    assert bus.orders[-1][1] == [-0.5, 0.0]


def test_too_fast_is_scaled_alike(bus) -> None:
    bus.enable()
    sent, reasons = bus.master.limited(np.array([4.0, -1.0]))
    assert sent == pytest.approx([1.0, -0.25])
    assert reasons == ("drive_velocity_limit",)
    bus.run(4.0, -1.0, cycles=2)
    assert bus.orders[-1][1] == pytest.approx([1.0, -0.25])


def test_before_the_first_sample_nothing_may_move(bus) -> None:
    sent, reasons = bus.master.limited(np.array([0.1, 0.1]))
    assert not sent.any()
    assert reasons == ("no_position",)


def test_heartbeats_come_every_20_ms_and_end_with_the_answers(bus) -> None:
    bus.cycle(101)
    assert bus.heartbeats == pytest.approx(21, abs=1)
    bus.answers = lambda cycle, answers: []
    bus.cycle(4)
    before = bus.heartbeats
    bus.cycle(100)
    assert bus.heartbeats <= before + 1
    assert bus.master.fault.code == "bus_silent"


def test_a_set_with_a_missing_axis_is_no_new_sample(bus) -> None:
    bus.enable()
    bus.run(0.5, 0.5, cycles=3)
    before = bus.master.sample()
    bus.answers = lambda cycle, answers: answers[1:]
    bus.run(0.5, 0.5, cycles=2)
    assert bus.master.sample() is before
    bus.answers = None
    bus.run(0.5, 0.5)
    assert bus.master.sample().t_ns == before.t_ns + 3 * bus.period_ns


def test_drives_that_do_not_tell_their_velocity(bus) -> None:
    bus.enable()
    receive = bus.codec.receive

    def without_velocity(frame: CanFrame) -> int:
        bit = receive(frame)
        bus.codec.feedback.velocities[:] = np.nan
        return bit

    bus.codec.receive = without_velocity
    bus.run(0.5, -0.5, cycles=10)
    assert bus.master.sample().velocities == pytest.approx([0.5, -0.5], abs=1e-3)
