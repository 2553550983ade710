"""The CiA 402 codec: frames read and written by ``struct`` beside it, faults, directions, the enable sequence."""

from __future__ import annotations

import math
import struct

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import Cia402Codec
from stereoservo_drivers.canopen.codec import NOT_CYCLIC
from stereoservo_drivers.canopen.options import CanJoint, CanOptions

COUNTS, GEAR = 4096, 100.0
COUNTS_PER_RAD = COUNTS * GEAR / (2 * math.pi)
ENABLED, DISABLED, FAULT = 0x0027, 0x0040, 0x0008


def options(n: int = 2, joint: dict[str, object] | None = None, **changes: object) -> CanOptions:
    values: dict[str, object] = {
        "counts_per_rev": COUNTS, "gear_ratio": GEAR, "max_velocity": 1.0, "max_acceleration": 4.0,
        "quick_stop_deceleration": 10.0, "position_min": -3.0, "position_max": 3.0,
    }  # fmt: skip
    joints = tuple(
        CanJoint(name=f"j{k}", node_id=k, **(values | (joint or {})))  # type: ignore[arg-type]
        for k in range(1, n + 1)
    )
    return CanOptions(interface="virtual", channel="test", joint=joints, **changes)  # type: ignore[arg-type]


def tpdo1(node: int, word: int, counts: int = 0) -> CanFrame:
    return CanFrame(0x180 + node, struct.pack("<Hi", word, counts))


def codec_of(**changes: object) -> Cia402Codec:
    return Cia402Codec(options(**changes))  # type: ignore[arg-type]


@pytest.fixture
def enabled() -> Cia402Codec:
    """Two axes, enabled, watched, commanded to stand."""
    codec = codec_of()
    codec.watch()
    for node in (1, 2):
        codec.receive(tpdo1(node, ENABLED))
    codec.command(np.zeros(2))
    assert codec.faults() == ()
    return codec


# -- process data -----------------------------------------------------------------------------------------------


def test_bits_are_named_after_node_and_pdo() -> None:
    codec = codec_of()
    assert codec.bit_axis == (0, 0, 1, 1)
    assert codec.bit_name == ("TPDO1 of node 1", "TPDO2 of node 1", "TPDO1 of node 2", "TPDO2 of node 2")


def test_poll_is_sync_and_the_heartbeat_says_operational() -> None:
    codec = codec_of(master_id=111)
    assert codec.poll() == [CanFrame(0x80)]
    assert codec.heartbeat() == [CanFrame(0x700 + 111, b"\x05")]


def test_feedback_in_joint_units() -> None:
    codec = codec_of(
        joint={"rated_torque": 80.0, "direction": -1, "offset_rad": 0.25, "velocity_units_per_rev_s": 60.0},
        feedback=("velocity", "effort", "following_error"),
    )
    assert codec.feedback.efforts is not None
    assert codec.feedback.following_errors is not None
    assert codec.receive(tpdo1(2, ENABLED, -12_345)) == 3
    assert codec.receive(CanFrame(0x282, struct.pack("<ih", -3000, 250))) == 4
    assert codec.receive(CanFrame(0x382, struct.pack("<i", 77))) == 5
    turns = 2 * math.pi / GEAR
    assert codec.feedback.positions[1] == pytest.approx(12_345 / COUNTS * turns - 0.25, rel=1e-12)
    assert codec.feedback.velocities[1] == pytest.approx(3000 / 60.0 * turns, rel=1e-12)  # rpm of the motor
    assert codec.feedback.efforts[1] == pytest.approx(-20.0, rel=1e-12)
    assert codec.feedback.following_errors[1] == pytest.approx(-77 / COUNTS * turns, rel=1e-12)
    assert np.isnan(codec.feedback.positions[0])


def test_efforts_without_a_rated_torque_are_shares_of_it() -> None:
    codec = codec_of()
    codec.receive(CanFrame(0x281, struct.pack("<ih", 0, -1500)))
    assert codec.feedback.efforts is not None
    assert codec.feedback.efforts[0] == pytest.approx(-1.5)


@given(
    start=st.integers(-(2**31), 2**31 - 1),
    steps=st.lists(st.integers(-(2**31) + 1, 2**31 - 1), max_size=20),
)
def test_positions_go_on_across_the_wrap(start: int, steps: list[int]) -> None:
    codec = codec_of(n=1)
    counts = start
    codec.receive(tpdo1(1, DISABLED, start))
    for step in steps:
        counts += step
        codec.receive(tpdo1(1, DISABLED, (counts + 2**31) % 2**32 - 2**31))
        assert codec.feedback.positions[0] == pytest.approx(counts / COUNTS_PER_RAD, rel=1e-12, abs=1e-9)


@given(st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=2), st.sampled_from([1, -1]))
def test_commands_on_the_wire(velocities: list[float], direction: int) -> None:
    codec = codec_of(joint={"direction": direction})
    frames = codec.command(np.array(velocities))
    assert [frame.id for frame in frames] == [0x201, 0x202]
    for velocity, frame, wire in zip(velocities, frames, codec.sendable(np.array(velocities)), strict=True):
        word, units = struct.unpack("<Hi", frame.data)
        assert word == 0x000F
        assert abs(units - direction * velocity * COUNTS_PER_RAD) <= 0.5 + 1e-6
        assert wire == pytest.approx(direction * units / COUNTS_PER_RAD, rel=1e-12, abs=1e-15)


def test_standing_words_carry_target_zero_and_never_the_fault_reset() -> None:
    codec = codec_of()
    codec.command(np.array([0.5, -0.5]))
    for frames, word in ((codec.quick_stop(), 0x0002), (codec.idle(), 0x0000)):
        assert [struct.unpack("<Hi", frame.data) for frame in frames] == [(word, 0), (word, 0)]
    for status in range(1 << 16):
        codec.receive(tpdo1(1, status))
        word, target = struct.unpack("<Hi", codec.enable()[0].data)
        assert target == 0
        assert not word & 0x80


def test_foreign_frames_are_not_of_the_cycle() -> None:
    codec = codec_of()
    codec.watch()
    for frame in (
        CanFrame(0x183, bytes(6)),
        CanFrame(0x201, bytes(6)),
        CanFrame(0x581, bytes(8)),
        CanFrame(0x181, remote=True, length=6),
        CanFrame(0x181, bytes(6), extended=True),
        CanFrame(0x77F, b"\x05"),
    ):
        assert codec.receive(frame) == NOT_CYCLIC
    assert codec.faults() == ()
    assert np.isnan(codec.feedback.positions).all()


# -- enabling ---------------------------------------------------------------------------------------------------

TRANSITIONS = {
    # state -> (mask, value of the control word) -> next state; CiA 402-2, transitions 2, 3, 4, 7, 9, 10, 11, 12
    "disabled": [(0x87, 0x06, "ready")],
    "ready": [(0x82, 0x00, "disabled"), (0x86, 0x02, "disabled"), (0x8F, 0x07, "on")],
    "on": [
        (0x82, 0x00, "disabled"),
        (0x86, 0x02, "disabled"),
        (0x8F, 0x0F, "enabled"),
        (0x87, 0x06, "ready"),
    ],
    "enabled": [(0x82, 0x00, "disabled"), (0x86, 0x02, "stopping")],
    "stopping": [(0x82, 0x00, "disabled")],
    "fault": [],
}
STATUS = {"disabled": 0x250, "ready": 0x231, "on": 0x233, "enabled": 0x237, "stopping": 0x217, "fault": 0x218}


class Machine:
    """A drive that knows these transitions and nothing else."""

    def __init__(self, state: str) -> None:
        self.state = state

    def control(self, frame: CanFrame) -> None:
        word = struct.unpack_from("<H", frame.data)[0]
        for mask, value, state in TRANSITIONS[self.state]:
            if word & mask == value:
                self.state = state
                return


@pytest.mark.parametrize("start", [*STATUS])
def test_enabling_and_stopping_a_drive(start: str) -> None:
    codec = codec_of(n=1)
    machine = Machine(start)
    states = [start]

    def step(frames: list[CanFrame]) -> None:
        machine.control(frames[0])
        codec.receive(tpdo1(1, STATUS[machine.state]))
        if states[-1] != machine.state:
            states.append(machine.state)

    codec.receive(tpdo1(1, STATUS[machine.state]))
    for _ in range(6):
        step(codec.enable())
    if start == "fault":
        assert states == ["fault"]
        return
    assert codec.enabled()
    assert not codec.at_rest_unpowered()
    assert states[-3:] == ["ready", "on", "enabled"][-len(states) :]
    step(codec.command(np.array([0.1])))
    assert machine.state == "enabled"
    step(codec.quick_stop())
    assert machine.state == "stopping"
    step(codec.idle())
    assert machine.state == "disabled"
    assert codec.at_rest_unpowered()


def test_enabled_needs_all_axes() -> None:
    codec = codec_of()
    codec.receive(tpdo1(1, ENABLED))
    assert not codec.enabled()
    assert codec.status_words() == ("operation enabled", "no status word yet")
    codec.receive(tpdo1(2, ENABLED))
    assert codec.enabled()


# -- faults -----------------------------------------------------------------------------------------------------


def codes(codec: Cia402Codec) -> list[tuple[str, int]]:
    return [(fault.code, fault.axis) for fault in codec.faults()]


@pytest.mark.parametrize("word", [0x0008, 0x021F, 0x000F])
def test_a_fault_bit_is_a_fault_as_long_as_it_is_there(enabled: Cia402Codec, word: int) -> None:
    enabled.receive(tpdo1(2, word))
    assert codes(enabled) == [("drive_fault", 1)]
    assert codes(enabled) == [("drive_fault", 1)]
    enabled.idle()
    enabled.receive(tpdo1(2, DISABLED))
    assert codes(enabled) == []


def test_an_emergency_is_told_once_and_kept_in_the_words(enabled: Cia402Codec) -> None:
    enabled.receive(CanFrame(0x81, struct.pack("<HB5x", 0x3210, 4)))
    (fault,) = enabled.faults()
    assert (fault.code, fault.axis, fault.value) == ("emergency", 0, 0x3210)
    assert "0x3210 DC link over-voltage" in fault.message
    assert fault.hint
    assert codes(enabled) == []
    enabled.receive(tpdo1(1, FAULT))
    assert enabled.status_words()[0] == "fault 0x3210 DC link over-voltage"
    enabled.receive(CanFrame(0x81, bytes(8)))
    assert enabled.status_words()[0] == "fault"


def test_ignored_emergencies_do_not_trip_but_are_shown() -> None:
    codec = codec_of(emcy_ignore=(0x8110,))
    codec.watch()
    codec.receive(tpdo1(1, DISABLED))
    codec.receive(CanFrame(0x81, struct.pack("<HB5x", 0x8110, 0x10)))
    assert codes(codec) == []
    assert "0x8110" in codec.status_words()[0]


@pytest.mark.parametrize(("state", "code"), [(0, "rebooted"), (4, "left_operational"), (127, "left_operational")])
def test_nmt_states_while_watched(enabled: Cia402Codec, state: int, code: str) -> None:
    frame = CanFrame(0x702, bytes([state]))
    enabled.receive(frame)
    assert codes(enabled) == [(code, 1)]
    enabled.receive(CanFrame(0x702, b"\x05"))
    assert codes(enabled) == []
    enabled.ignore()
    enabled.receive(frame)
    assert codes(enabled) == []


def test_counts_of_a_drive_that_booted_unasked_start_anew() -> None:
    codec = codec_of(n=1)
    codec.watch()
    for counts in (2**31 - 10, -(2**31) + 10):
        codec.receive(tpdo1(1, DISABLED, counts))
    assert codec.feedback.positions[0] == pytest.approx((2**31 + 10) / COUNTS_PER_RAD, rel=1e-12)
    codec.receive(CanFrame(0x701, b"\0"))
    codec.receive(tpdo1(1, DISABLED, -(2**31) + 10))
    assert codec.feedback.positions[0] == pytest.approx((-(2**31) + 10) / COUNTS_PER_RAD, rel=1e-12)


@pytest.mark.parametrize("multi_turn", [False, True])
def test_a_drive_that_boots_while_nobody_watches_keeps_its_turn_only_where_it_may_have_turned(
    multi_turn: bool,
) -> None:
    plain = options(n=1)
    joint = msgspec.structs.replace(plain.joint[0], multi_turn=multi_turn)
    codec = Cia402Codec(msgspec.structs.replace(plain, joint=(joint,)))
    codec.receive(tpdo1(1, DISABLED, 2**31 - 10))
    codec.receive(CanFrame(0x701, b"\0"))
    codec.receive(tpdo1(1, DISABLED, -(2**31) + 10))
    counts = 2**31 + 10 if multi_turn else -(2**31) + 10
    assert codec.feedback.positions[0] == pytest.approx(counts / COUNTS_PER_RAD, rel=1e-12)


@pytest.mark.parametrize("data", [b"", b"\0"])
def test_an_emergency_without_a_code_is_no_error_reset(enabled: Cia402Codec, data: bytes) -> None:
    enabled.receive(CanFrame(0x81, struct.pack("<HB5x", 0x3210, 4)))
    enabled.receive(CanFrame(0x81, data))
    enabled.receive(tpdo1(1, FAULT))
    assert "0x3210" in enabled.status_words()[0]


def test_emergencies_of_bring_up_are_no_faults(enabled: Cia402Codec) -> None:
    enabled.ignore()
    enabled.receive(CanFrame(0x81, struct.pack("<HB5x", 0x8130, 0x11)))
    assert codes(enabled) == []
    assert "0x8130" in enabled.status_words()[0]


def test_what_happened_before_watching_is_forgotten() -> None:
    codec = codec_of()
    codec.receive(CanFrame(0x181, bytes(5)))
    codec.watch()
    assert codes(codec) == []


@pytest.mark.parametrize(("can_id", "mapped"), [(0x181, 6), (0x281, 6), (0x182, 6)])
def test_wrong_lengths_are_a_fault_of_the_mapping(enabled: Cia402Codec, can_id: int, mapped: int) -> None:
    for length in range(9):
        bit = enabled.receive(CanFrame(can_id, bytes(length)))
        if length == mapped:
            assert bit >= 0
            enabled.faults()
            continue
        assert bit == NOT_CYCLIC
        (fault,) = [fault for fault in enabled.faults() if fault.code == "mapping"]
        assert fault.value == length
        assert f"{mapped} are mapped" in fault.message


def test_leaving_enabled_unasked_is_a_fault_and_asked_is_none(enabled: Cia402Codec) -> None:
    enabled.receive(tpdo1(1, 0x0033))
    assert codes(enabled) == [("disabled", 0)]
    enabled.quick_stop()
    assert codes(enabled) == []


def test_silent_heartbeats_count_in_polls(enabled: Cia402Codec) -> None:
    polls = round(0.1 * 250)
    for _ in range(polls):
        enabled.poll()
        enabled.receive(CanFrame(0x701, b"\x05"))
    assert codes(enabled) == []
    enabled.poll()
    assert codes(enabled) == [("heartbeat_lost", 1)]
    enabled.receive(CanFrame(0x702, b"\x05"))
    assert codes(enabled) == []


def limited(codec: Cia402Codec, node: int, position: int, velocities: list[float]) -> list[tuple[str, int]]:
    """Faults within 120 ms in which the drive of ``node`` reports a limit at ``position`` [counts]."""
    found = []
    for _ in range(30):
        codec.receive(tpdo1(node, ENABLED | 0x0800, position))
        codec.command(np.array(velocities))
        found += codes(codec)
    return found


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("outward", [0.2, -0.2])
def test_a_limit_stops_all_and_lets_the_joint_go_inward_only(direction: int, outward: float) -> None:
    codec = codec_of(joint={"direction": direction})
    codec.watch()
    for node in (1, 2):
        codec.receive(tpdo1(node, ENABLED))
    codec.command(np.array([0.0, outward]))
    assert codes(codec) == []
    assert limited(codec, 2, 0, [0.0, outward])[0] == ("limit_switch", 1)
    codec.quick_stop()
    assert codes(codec) == []
    codec.command(np.array([0.3, -outward]))
    assert codes(codec) == []
    codec.command(np.array([0.0, outward]))
    assert codes(codec) == [("limit_switch", 1)]
    codec.receive(tpdo1(2, ENABLED))
    assert codes(codec) == []


@pytest.mark.parametrize(("switches", "hint"), [(0b10, "limit switch active"), (0, "no limit switch active")])
def test_limit_switches_that_are_sent_tell_a_switch_at_once_from_a_limit_of_the_drive(switches: int, hint: str) -> None:
    codec = codec_of(feedback=("velocity", "switches"))
    codec.watch()
    for node in (1, 2):
        codec.receive(tpdo1(node, ENABLED))
        codec.receive(CanFrame(0x280 + node, struct.pack("<iI", 0, 0)))
    frame = CanFrame(0x282, struct.pack("<iI", 0, switches))
    found: list[str] = []
    for cycle in range(30):
        codec.receive(tpdo1(2, ENABLED | 0x0800))
        codec.receive(frame)
        codec.command(np.array([0.0, 0.2]))
        found += [fault.message for fault in codec.faults() if fault.code == "limit_switch"]
        assert bool(found) == (switches != 0) or cycle > 20
    assert hint in found[0]


def test_a_drive_has_its_time_to_follow_each_time_it_is_enabled(enabled: Cia402Codec) -> None:
    """Its brake opens for 0.2 s, in which bit 12 is not set."""

    def cycles(count: int, word: int) -> None:
        for _ in range(count):
            enabled.receive(tpdo1(1, word))
            enabled.receive(tpdo1(2, ENABLED | 0x1000))
            enabled.command(np.zeros(2))
            assert codes(enabled) == []

    cycles(50, ENABLED)
    cycles(50, ENABLED | 0x1000)
    enabled.idle()
    enabled.receive(tpdo1(1, DISABLED))
    cycles(50, ENABLED)
    cycles(1, ENABLED | 0x1000)
    cycles(24, ENABLED)
    enabled.command(np.zeros(2))
    assert codes(enabled) == [("target_ignored", 0)]


def test_the_side_of_a_limit_is_forgotten_with_it(enabled: Cia402Codec) -> None:
    assert limited(enabled, 1, 0, [0.2, 0.0])[0] == ("limit_switch", 0)
    enabled.idle()
    enabled.receive(tpdo1(1, DISABLED))
    enabled.receive(tpdo1(1, DISABLED | 0x0800))  # by hand, onto whatever side
    enabled.receive(tpdo1(1, ENABLED | 0x0800))
    enabled.command(np.array([0.2, 0.0]))
    assert codes(enabled) == []
