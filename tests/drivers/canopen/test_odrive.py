"""ODrive codec and bring-up against frames written byte by byte from the CANSimple tables."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import NOT_CYCLIC
from stereoservo_drivers.canopen.odrive import OdriveBringup, OdriveCodec
from stereoservo_drivers.canopen.options import CanJoint, CanOptions

MS = 1_000_000


def joint(name="a", node_id=3, **changes):
    values = {
        "name": name, "node_id": node_id, "counts_per_rev": 1.0, "gear_ratio": 50.0, "max_velocity": 1.0,
        "max_acceleration": 5.0, "quick_stop_deceleration": 20.0, "position_min": -3.0, "position_max": 3.0,
    }  # fmt: skip
    return CanJoint(**{**values, **changes})


def options(*joints, **changes):
    return CanOptions(
        **{
            "protocol": "odrive",
            "interface": "virtual",
            "channel": "x",
            "joint": joints or (joint(),),
            **changes,
        }
    )


def heartbeat(node, state, errors=0):
    return CanFrame(node * 32 + 1, errors.to_bytes(4, "little") + bytes([state, 0, 0, 0]))


def estimates(node, turns, turns_s):
    return CanFrame(node * 32 + 9, struct.pack("<ff", turns, turns_s))


def velocity_of(frames, node):
    (frame,) = [f for f in frames if f.id == node * 32 + 0x0D]
    return struct.unpack("<ff", frame.data)[0]


def states_asked(frames, node):
    return [int.from_bytes(f.data[:4], "little") for f in frames if f.id == node * 32 + 7]


def test_estimates_become_joint_angles():
    codec = OdriveCodec(options(joint(direction=-1, offset_rad=0.25), joint("b", 4)))
    assert codec.receive(estimates(3, 10.0, -5.0)) == 0
    assert codec.receive(estimates(4, 10.0, -5.0)) == 1
    angle = 10.0 / 50.0 * 2 * math.pi
    assert np.allclose(codec.feedback.positions, [-angle - 0.25, angle])
    assert np.allclose(codec.feedback.velocities, [angle / 2, -angle / 2])
    assert codec.expected == 0b11


def test_a_prismatic_axis_has_turns_per_metre():
    codec = OdriveCodec(options(joint(kind="prismatic", gear_ratio=200.0, rated_torque=10.0)))
    codec.receive(estimates(3, 40.0, 2.0))
    assert codec.feedback.positions[0] == pytest.approx(0.2)
    codec.receive(CanFrame(3 * 32 + 0x1C, struct.pack("<ff", 0.0, 0.5)))
    assert codec.feedback.efforts[0] == pytest.approx(0.5 * 2 * math.pi * 200.0, rel=1e-6)


def test_torque_estimate_is_geared_to_the_joint():
    codec = OdriveCodec(options(joint(direction=-1)))
    assert codec.receive(CanFrame(3 * 32 + 0x1C, struct.pack("<ff", 9.0, 0.2))) == NOT_CYCLIC
    assert codec.feedback.efforts[0] == pytest.approx(-0.2 * 50.0, rel=1e-6)


def test_poll_asks_all_for_estimates_and_a_share_for_the_rest():
    codec = OdriveCodec(options(*(joint(f"j{k}", k) for k in range(1, 7))))
    asked = [codec.poll() for _ in range(3)]
    for frames in asked:
        assert all(f.remote for f in frames)
        assert [f.id for f in frames[:6]] == [k * 32 + 9 for k in range(1, 7)]
        assert len(frames) == 6 + 4
    rest = {f.id for frames in asked for f in frames[6:]}
    assert rest == {k * 32 + c for k in range(1, 7) for c in (0x03, 0x1C)}


def test_without_effort_no_torques_are_asked_for():
    codec = OdriveCodec(options(feedback=("velocity",)))
    assert codec.feedback.efforts is None
    assert {f.id & 31 for f in codec.poll()} == {9, 3}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_none_are_a_fault_and_not_taken(bad):
    codec = OdriveCodec(options())
    codec.receive(estimates(3, 1.0, 0.0))
    before = codec.feedback.positions.copy()
    assert codec.receive(estimates(3, bad, 0.0)) == NOT_CYCLIC
    assert codec.receive(estimates(3, 0.0, bad)) == NOT_CYCLIC
    assert np.array_equal(codec.feedback.positions, before)
    assert [fault.code for fault in codec.faults()] == ["feedback", "feedback"]
    assert codec.faults() == ()


def test_short_frames_are_a_fault_foreign_ones_are_nobodys():
    codec = OdriveCodec(options())
    assert codec.receive(CanFrame(3 * 32 + 9, bytes(6))) == NOT_CYCLIC
    assert [fault.code for fault in codec.faults()] == ["mapping"]
    for frame in (estimates(5, 1.0, 1.0), CanFrame(3 * 32 + 9, remote=True, length=8), CanFrame(0x80)):
        assert codec.receive(frame) == NOT_CYCLIC
    assert codec.faults() == ()


def test_errors_are_a_fault_as_long_as_they_stand():
    codec = OdriveCodec(options())
    codec.receive(CanFrame(3 * 32 + 3, struct.pack("<II", 0, 0x1000000)))
    (fault,) = codec.faults()
    assert (fault.axis, fault.code, fault.value) == (0, "drive_fault", 0x1000000)
    assert "watchdog" in fault.message
    assert len(codec.faults()) == 1
    codec.receive(heartbeat(3, 1))
    assert codec.faults() == ()


def test_enabling_asks_idle_axes_without_errors_once_and_believes_only_heartbeats():
    codec = OdriveCodec(options(joint(), joint("b", 4)))
    assert states_asked(codec.enable(), 3) == []  # nothing heard yet
    codec.receive(heartbeat(3, 1))
    codec.receive(heartbeat(4, 1, errors=0x20))
    frames = codec.enable()
    assert states_asked(frames, 3) == [8]
    assert states_asked(frames, 4) == []
    assert velocity_of(frames, 3) == 0.0
    assert states_asked(codec.enable(), 3) == []
    codec.receive(heartbeat(3, 8))
    assert not codec.enabled()
    codec.receive(heartbeat(4, 8))
    assert codec.enabled()


def test_idle_never_takes_the_last_heartbeat_for_the_state_after_enabling():
    codec = OdriveCodec(options())
    codec.receive(heartbeat(3, 1))
    assert codec.at_rest_unpowered()
    codec.enable()
    assert not codec.at_rest_unpowered()
    assert states_asked(codec.idle(), 3) == [1]


def test_commands_ramp_and_are_clamped():
    codec = OdriveCodec(options(joint(direction=-1), rate_hz=100.0))
    turns = -50.0 / (2 * math.pi)
    sent = [velocity_of(codec.command(np.array([7.0])), 3) for _ in range(25)]
    assert np.allclose(sent[:19], [0.05 * (k + 1) * turns for k in range(19)], rtol=1e-5)
    assert np.allclose(sent[20:], turns, rtol=1e-5)  # 1 rad/s, not 7


def test_quick_stop_ramps_to_zero_and_stays_in_closed_loop():
    codec = OdriveCodec(options(rate_hz=100.0, joint=(joint(max_acceleration=1000.0),)))
    codec.command(np.array([1.0]))
    frames = [codec.quick_stop() for _ in range(8)]
    turns = 50.0 / (2 * math.pi)
    sent = [velocity_of(f, 3) for f in frames]
    assert np.allclose(sent, np.maximum(1.0 - 0.2 * np.arange(1, 9), 0.0) * turns, atol=1e-5)
    assert {f.id & 31 for cycle in frames for f in cycle} == {0x0D}  # neither Estop nor a state


def test_sendable_is_float32_within_the_limits():
    codec = OdriveCodec(options())
    turns = 50.0 / (2 * math.pi)
    exact = struct.unpack("<f", struct.pack("<f", 0.123 * turns))[0] / turns
    assert codec.sendable(np.array([0.123]))[0] == pytest.approx(exact, abs=1e-15)
    assert codec.sendable(np.array([9.0]))[0] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"joint": (joint(node_id=63),)}, "node_id"),
        ({"joint": (joint(counts_per_rev=4096.0),)}, "counts_per_rev"),
        ({"joint": (joint(velocity_units_per_rev_s=60.0),)}, "velocity_units_per_rev_s"),
        ({"joint": (joint(vendor_id=1),)}, "vendor_id"),
        ({"joint": (joint(sdo={"0x60C2:1": 4}),)}, "sdo"),
        ({"feedback": ("following_error",)}, "following error"),
    ],
)
def test_options_that_do_not_fit_are_refused(changes, word):
    with pytest.raises(DriverError, match=word) as refusal:
        OdriveCodec(options(**changes))
    assert refusal.value.code == "option"


class Drives:
    """A link whose drives answer from a table; heartbeats every 100 ms."""

    def __init__(self, nodes=(3,), **table):
        self.nodes = nodes
        self.table = {
            0x00: [bytes([2, 4, 4, 58, 0, 6, 10, 0])],
            0x03: [bytes(8)],
            0x06: [bytes([3, 1, 2, 3, 4, 5, 6, 0])],
            0x09: [struct.pack("<ff", 1.0, 0.0)],
            **{int(k[1:], 16): v for k, v in table.items()},
        }
        self.t_ns = 0
        self.sent = []
        self.heard = []
        self.state = 1
        self.stubborn = 0
        self.unasked = False
        self.properties = {}

    def deliver(self, frame):
        for can_id, frames in self.heard:
            if can_id == frame.id:
                frames.append(frame)

    def send(self, frames):
        for frame in frames:
            self.sent.append(frame)
            node, command = divmod(frame.id, 32)
            if frame.remote and node in self.nodes:
                for data in self.table.get(command, []):
                    self.deliver(CanFrame(frame.id, data))
            elif command == 4 and frame.data[0] == 0 and frame.data[3] == 0:
                number = frame.data[2] << 8 | frame.data[1]
                if number in self.properties:
                    self.deliver(CanFrame(node * 32 + 5, bytes([0, *frame.data[1:3], 0]) + self.properties[number]))
            elif command == 7:
                self.state = frame.data[0]
            elif command == 0x18:
                self.table[3] = [struct.pack("<II", self.stubborn, 0)]

    def subscribe(self, can_id, heard):
        self.heard.append((can_id, heard))

    def unsubscribe(self, can_id, heard):
        self.heard = [(i, h) for i, h in self.heard if not (i == can_id and h is heard)]

    def wait(self, seconds):
        end = self.t_ns + round(seconds * 1e9)
        while self.t_ns + 10 * MS <= end:
            self.t_ns += 10 * MS
            for node in self.nodes:
                if self.t_ns % (100 * MS) == 0:
                    errors = int.from_bytes(self.table[3][0][:4], "little")
                    self.deliver(heartbeat(node, self.state, errors))
                if self.unasked:
                    self.deliver(estimates(node, 0.0, 0.0))

    def now_ns(self):
        return self.t_ns


def bringup(*joints, **changes):
    chosen = options(*joints, **changes)
    return OdriveBringup(chosen, OdriveCodec(chosen), Path())


def test_bring_up_sets_velocity_control_and_limits_and_never_enables():
    link, start = Drives(), bringup(joint(current_limit=12.5))
    start.connect(link)
    assert start.firmware == {3: "0.6.10"}
    data = {f.id & 31: f.data for f in link.sent if not f.remote}
    assert data[0x0B] == bytes([2, 0, 0, 0, 1, 0, 0, 0])
    assert struct.unpack("<ff", data[0x0F]) == pytest.approx((50.0 / (2 * math.pi), 12.5), rel=1e-6)
    assert states_asked(link.sent, 3) == [1]
    assert not [f for f in link.sent if f.id & 31 == 0x18]
    assert not link.heard


def test_without_a_current_limit_no_limits_are_sent():
    link = Drives()
    bringup().connect(link)
    assert not [f for f in link.sent if f.id & 31 == 0x0F]


@pytest.mark.parametrize(
    ("drives", "joints", "code"),
    [
        (Drives(nodes=(5, 9)), (joint(),), "node_missing"),
        (Drives(x06=[bytes(8), bytes([3, 9, 9, 9, 9, 9, 9, 0])]), (joint(),), "duplicate_node"),
        (Drives(x00=[bytes([2, 4, 4, 58, 0, 6, 10, 0])] * 2), (joint(),), "duplicate_node"),
        (Drives(), (joint(serial_number=5),), "identity"),
        (Drives(x00=[bytes([1, 0, 0, 0, 0, 5, 6, 0])]), (joint(),), "version"),
        (Drives(x09=[struct.pack("<ff", math.nan, 0.0)]), (joint(),), "no_feedback"),
        (Drives(x06=[]), (joint(),), "no_answer"),
    ],
)
def test_bring_up_refuses(drives, joints, code):
    with pytest.raises(DriverError) as refusal:
        bringup(*joints).connect(drives)
    assert refusal.value.code == code
    assert not states_asked(drives.sent, 3)


def test_a_missing_node_names_who_was_heard():
    with pytest.raises(DriverError, match="node 5, node 9"):
        bringup().connect(Drives(nodes=(5, 9)))


def test_estimates_that_come_unasked_are_refused_with_the_cure():
    link = Drives()
    link.unasked = True
    with pytest.raises(DriverError, match="encoder_msg_rate_ms") as refusal:
        bringup().connect(link)
    assert refusal.value.code == "cyclic_messages"


def test_errors_at_the_start_are_told_and_not_cleared():
    link, start = Drives(x03=[struct.pack("<II", 0x20, 0)]), bringup()
    start.connect(link)
    assert [fault.code for fault in start.codec.faults()] == ["drive_fault"]
    assert not [f for f in link.sent if f.id & 31 == 0x18]
    start.reset(link)
    assert start.codec.faults() == ()
    assert 8 not in states_asked(link.sent, 3)


def test_an_error_that_stays_refuses_the_reset():
    link, start = Drives(x03=[struct.pack("<II", 0x20, 0)]), bringup()
    start.connect(link)
    link.stubborn = 0x20
    with pytest.raises(DriverError, match="gate driver") as refusal:
        start.reset(link)
    assert refusal.value.code == "reset_refused"


def test_axes_that_somebody_else_commands_are_left_alone():
    link = Drives()
    wait = link.wait

    def wait_beside_another(seconds):
        wait(seconds)
        link.deliver(CanFrame(3 << 5 | 0x0D, struct.pack("<ff", 1.0, 0.0)))

    link.wait = wait_beside_another
    with pytest.raises(DriverError, match="another daemon") as refusal:
        bringup().connect(link)
    assert refusal.value.code == "second_master"
    assert link.sent == []


def test_axes_that_were_left_moving_are_stopped_though_one_is_missing():
    link = Drives(nodes=(3,))
    with pytest.raises(DriverError) as refusal:
        bringup(joint(), joint(name="other", node_id=4)).connect(link)
    assert refusal.value.code == "node_missing"
    stops = [f for f in link.sent if f.id & 31 == 0x0D]
    assert [(f.id >> 5, struct.unpack("<ff", f.data)) for f in stops] == [(3, (0.0, 0.0)), (4, (0.0, 0.0))]
    assert states_asked(link.sent, 3) == []


PROPERTIES = {
    "axis0.config.enable_watchdog": (300, "bool", b"\x01"),
    "axis0.config.watchdog_timeout": (301, "float", struct.pack("<f", 0.1)),
    "axis0.controller.config.vel_limit": (400, "float", struct.pack("<f", 10.0)),
    "axis0.controller.config.vel_ramp_rate": (401, "float", struct.pack("<f", 3.0)),
    "axis0.controller.config.control_mode": (402, "uint8", b"\x02"),
    "axis0.controller.config.input_mode": (403, "uint8", b"\x01"),
}
"""Of a release: numbers, types and values of its drive."""


def with_endpoints(folder, *, firmware="0.6.10", hardware="4.4.58", axis=None, **changed):
    """A drive with these properties, and a bring-up that has its release's file."""
    link = Drives()
    link.properties = {
        number: changed.get(path.split(".")[-1], value) for path, (number, _, value) in PROPERTIES.items()
    }
    endpoints = {path: {"id": n, "type": kind, "access": "rw"} for path, (n, kind, _) in PROPERTIES.items()}
    endpoints["save_configuration"] = {"id": 9, "type": "function", "inputs": [], "outputs": []}
    release = {"fw_version": firmware, "hw_version": hardware, "endpoints": endpoints}
    (folder / "flat_endpoints.json").write_text(json.dumps(release))
    chosen = options(axis or joint(), endpoints=("flat_endpoints.json",))
    return link, OdriveBringup(chosen, OdriveCodec(chosen), folder)


def test_watchdog_limit_and_mode_are_read_back_where_the_release_is_known(tmp_path):
    link, start = with_endpoints(tmp_path)
    start.connect(link)
    well, told = start.safety[3]
    assert well
    assert "watchdog 0.1 s; velocity limit 10 turns/s, 1.26 rad/s" in told
    assert not [f for f in link.sent if f.id & 31 == 4 and f.data[0] != 0]  # nothing is written


@pytest.mark.parametrize(
    ("changed", "code", "words"),
    [
        ({"enable_watchdog": b"\x00"}, "no_watch", "accept_missing"),
        ({"watchdog_timeout": struct.pack("<f", 0.0)}, "no_watch", "0 s"),
        ({"watchdog_timeout": struct.pack("<f", 2.0)}, "watchdog", "heartbeat_timeout_ms"),
        ({"watchdog_timeout": struct.pack("<f", 0.005)}, "watchdog", "cycles"),
        ({"watchdog_timeout": struct.pack("<f", math.nan)}, "no_watch", "nan"),
        ({"vel_limit": struct.pack("<f", 2.0)}, "limit", "0.251 rad/s"),
        ({"vel_limit": struct.pack("<f", math.nan)}, "limit", "nan"),
        ({"input_mode": b"\x02"}, "mode", r"\(2, 2\)"),
    ],
)
def test_settings_that_do_not_keep_an_axis_safe_are_refused(tmp_path, changed, code, words):
    link, start = with_endpoints(tmp_path, **changed)
    with pytest.raises(DriverError, match=words) as refusal:
        start.connect(link)
    assert refusal.value.code == code
    assert not states_asked(link.sent, 3).count(8)


@pytest.mark.parametrize("changed", [{"enable_watchdog": b"\x00"}, {"watchdog_timeout": struct.pack("<f", 0.0)}])
def test_an_axis_without_watchdog_is_used_where_the_cell_file_says_that_it_is_known(tmp_path, changed):
    link, start = with_endpoints(tmp_path, axis=joint(accept_missing=("watch",)), **changed)
    start.connect(link)
    assert start.safety[3][0] is False
    assert "accept_missing" in start.safety[3][1]


@pytest.mark.parametrize("release", [{"firmware": "0.6.9"}, {"hardware": "5.2.0"}])
def test_settings_of_another_release_are_unknown_and_told_so(tmp_path, release):
    link, start = with_endpoints(tmp_path, **release)
    start.connect(link)
    assert start.safety[3][0] is False
    assert "unknown (firmware 0.6.10, hardware 4.4.58)" in start.safety[3][1]
    assert not [f for f in link.sent if f.id & 31 == 4]


def test_a_drive_that_does_not_answer_on_its_settings_is_told(tmp_path):
    link, start = with_endpoints(tmp_path)
    link.properties = {}
    start.connect(link)
    assert start.safety[3][0] is False
    assert "no answer on axis0.config.enable_watchdog" in start.safety[3][1]


@pytest.mark.parametrize("text", ["", "[1]", '{"fw_version": "0.6.10", "hw_version": "4.4.58", "endpoints": {}}'])
def test_a_file_that_is_no_list_of_endpoints_is_refused(tmp_path, text):
    (tmp_path / "flat.json").write_text(text)
    chosen = options(endpoints=("flat.json",))
    with pytest.raises(DriverError, match=r"flat\.json") as refusal:
        OdriveBringup(chosen, OdriveCodec(chosen), tmp_path)
    assert refusal.value.code == "endpoints"
