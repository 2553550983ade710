"""CANopen side of the emulated drive: NMT, heartbeats, SYNC watch, emergencies, identity, stored parameters."""

import struct

import pytest

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.emulators.nodes.cia402_node import Cia402Node
from stereoservo_sim.emulators.nodes.node import NEVER_NS

MASTER = 0x77F
OPERATIONAL, PRE_OPERATIONAL, STOPPED = 5, 127, 4


def watch_master(bench, ms=100):
    assert bench.write(0x1016, 1, 127 << 16 | ms, 4) == 0


def heartbeats(frames):
    return [f.data[0] for f in frames if f.id == 0x703]


def test_boot_up_comes_once_and_nothing_else(bench):
    assert bench.heard == [(0, CanFrame(id=0x703, data=b"\0"))]
    assert bench.run(1000) == []
    assert bench.node.due_ns() == NEVER_NS
    assert bench.power_state == "switch on disabled"


def test_boot_time(make_bench):
    bench = make_bench(boot_ms=300)
    assert bench.heard == []
    assert bench.send(0x603, 0x40, 0, 0x10, 0, 0, 0, 0, 0) == []
    assert bench.power_state == "not ready to switch on"
    assert bench.run(299) == []
    assert heartbeats(bench.run(2)) == [0]


def test_a_node_without_power_is_silent(bench, eds):
    dead = Cia402Node(4, bench.axis, bench.joint, eds=eds)
    dead.receive(CanFrame(id=0, data=b"\1\0"), 5)
    dead.advance(10)
    dead.trip(0x3210, 20)
    assert dead.outgoing() == []
    assert dead.due_ns() == NEVER_NS


def test_heartbeat_tells_the_nmt_state(bench):
    assert bench.write(0x1017, 0, 20, 2) == 0
    assert heartbeats(bench.run(101)) == [PRE_OPERATIONAL] * 5
    bench.nmt(1)
    assert heartbeats(bench.run(40)) == [OPERATIONAL] * 2
    bench.nmt(2, 0)
    assert heartbeats(bench.run(40)) == [STOPPED] * 2
    bench.nmt(0x80)
    assert heartbeats(bench.run(40)) == [PRE_OPERATIONAL] * 2
    assert bench.write(0x1017, 0, 0, 2) == 0
    assert bench.run(1000) == []


def test_heartbeats_that_were_missed_are_not_made_up_for(bench):
    bench.write(0x1017, 0, 10, 2)
    bench.node.advance(10_000_000_000)
    assert heartbeats(bench.node.outgoing()) == [PRE_OPERATIONAL]
    assert bench.node.due_ns() == 10_010_000_000


def test_commands_to_others_are_not_obeyed(bench):
    bench.nmt(1, 4)
    bench.send(0, 1)
    bench.send(0, 1, 3, extended=True)
    bench.send(0, remote=True)
    assert bench.node.state().startswith("pre-operational")
    bench.nmt(1, 0)
    assert bench.node.state().startswith("operational")


def test_a_stopped_node_answers_no_sdo(bench):
    bench.nmt(2)
    assert bench.send(0x603, 0x40, 0, 0x10, 0, 0, 0, 0, 0) == []


def test_reset_communication_restores_its_objects_only(bench):
    bench.write(0x1017, 0, 20, 2)
    bench.write(0x6085, 0, 777, 4)
    bench.write(0x1400, 1, 1 << 31, 4)
    assert heartbeats(bench.nmt(0x82)) == [0]
    assert bench.read(0x1017) == 0
    assert bench.read(0x1400, 1) == 0x203
    assert bench.read(0x6085) == 777
    assert bench.read(0x1018, 4) == 3


def test_reset_node_restores_everything_that_was_not_saved(bench):
    bench.write(0x6085, 0, 777, 4)
    assert heartbeats(bench.nmt(0x81)) == [0]
    assert bench.read(0x6085) == 100000
    bench.write(0x6085, 0, 777, 4)
    assert bench.write(0x1010, 1, 0x12345678, 4) == 0x08000020
    assert bench.write(0x1010, 1, int.from_bytes(b"save", "little"), 4) == 0
    bench.nmt(0x81)
    assert bench.read(0x6085) == 777
    assert bench.write(0x1011, 1, int.from_bytes(b"load", "little"), 4) == 0
    assert bench.read(0x6085) == 777  # takes effect with the reset
    bench.nmt(0x81)
    assert bench.read(0x6085) == 100000


def test_identity_is_what_the_cell_asks_for_or_ordered(make_bench):
    asked = make_bench(joint={"vendor_id": 0xFB, "serial_number": 99})
    assert [asked.read(0x1018, k) for k in (1, 4)] == [0xFB, 99]
    other = make_bench(joint={"vendor_id": 0xFB}, identity={1: 0xABC})
    assert other.read(0x1018, 1) == 0xABC


# -- heartbeat consumer ----------------------------------------------------------------------------------------------


def test_consumer_waits_for_the_first_heartbeat(bench):
    watch_master(bench)
    bench.run(1000)
    assert bench.emergencies() == []
    bench.send(MASTER, 0)  # a boot-up frame is none
    bench.run(1000)
    assert bench.emergencies() == []
    bench.send(MASTER, 5)
    bench.run(99)
    assert bench.emergencies() == []
    bench.run(2)
    assert bench.emergencies() == [(0x8130, 0x11)]
    assert bench.node.due_ns() == NEVER_NS  # told once
    bench.run(1000)
    assert bench.emergencies() == [(0x8130, 0x11)]


def test_consumer_of_others_does_not_care(bench):
    watch_master(bench)
    bench.send(MASTER, 5)
    for _ in range(5):
        bench.run(50)
        bench.send(0x77E, 5)
    assert bench.emergencies() == [(0x8130, 0x11)]


def test_regular_heartbeats_keep_it_quiet(bench):
    watch_master(bench)
    bench.enable(x6007=3)
    for _ in range(20):
        bench.send(MASTER, 5)
        bench.run(99)
    assert bench.power_state == "operation enabled"
    assert bench.emergencies() == []


@pytest.mark.parametrize(("option", "state"), [(0, "operation enabled"), (1, "fault reaction active"),
                                               (2, "switch on disabled"), (3, "quick stop active")])  # fmt: skip
def test_lost_heartbeat_obeys_0x6007(bench, option, state):
    watch_master(bench)
    bench.enable(x6007=option)
    bench.velocity(50_000)
    bench.run(500)
    bench.send(MASTER, 5)
    bench.run(101)
    assert bench.power_state == state
    assert bench.emergencies() == [(0x8130, 0x11)]
    assert bench.node.state().startswith("pre-operational")  # 0x1029:1 = 0
    if option:
        bench.run(800)
        assert bench.axis.set_velocity == 0.0
        assert not bench.axis.powered
        assert bench.axis.brake_closed


def test_lost_heartbeat_of_a_drive_without_power_is_a_fault_too(bench):
    watch_master(bench)
    assert bench.read(0x6007) == 1
    bench.send(MASTER, 5)
    bench.run(101)
    assert bench.power_state == "fault"
    assert bench.read(0x603F) == 0x8130


def test_a_heartbeat_that_returns_clears_the_error_and_enables_nothing(bench):
    watch_master(bench)
    bench.enable(x6007=3)
    bench.send(MASTER, 5)
    bench.run(300)
    assert bench.read(0x1001) == 0x11
    bench.send(MASTER, 5)
    assert bench.emergencies() == [(0x8130, 0x11), (0, 0)]
    assert bench.read(0x1001) == 0
    bench.nmt(1)
    bench.word(0x0F)
    bench.run(90)
    assert bench.power_state == "switch on disabled"
    bench.run(20)
    assert bench.emergencies()[-1] == (0x8130, 0x11)  # it is watched again


@pytest.mark.parametrize(("behaviour", "words"), [(0, "pre-operational"), (1, "operational"), (2, "stopped")])
def test_nmt_state_after_a_lost_heartbeat(bench, behaviour, words):
    watch_master(bench)
    bench.write(0x1029, 1, behaviour, 1)
    bench.nmt(1)
    bench.send(MASTER, 5)
    bench.run(101)
    assert bench.node.state().startswith(words)


def test_consumer_entries_are_checked(bench):
    watch_master(bench)
    assert bench.write(0x1016, 2, 127 << 16 | 50, 4) == 0x06040043
    assert bench.write(0x1016, 2, 126 << 16 | 50, 4) == 0
    assert bench.write(0x1016, 2, 200 << 16 | 50, 4) == 0x06090030


def test_drives_that_want_a_communication_reset_first(make_bench):
    bench = make_bench(reset_needs_communication_reset=True)
    watch_master(bench)
    bench.enable(x6007=1)
    bench.send(MASTER, 5)
    bench.run(300)
    bench.nmt(1)
    bench.word(0x00)
    bench.word(0x80)
    assert bench.power_state == "fault"
    bench.nmt(0x82)
    bench.nmt(1)
    bench.word(0x00)
    bench.word(0x80)
    assert bench.power_state == "switch on disabled"


# -- SYNC ------------------------------------------------------------------------------------------------------------


def test_sync_watch(bench):
    bench.enable()
    assert bench.write(0x1006, 0, 4000, 4) == 0
    bench.run(200)
    assert bench.emergencies() == []  # begins with the first SYNC
    for _ in range(10):
        bench.sync()
        bench.run(4)
    bench.run(15.5)
    assert bench.emergencies() == []
    bench.run(1)
    assert bench.emergencies() == [(0x8700, 0x21)]
    bench.run(100)
    assert bench.power_state == "fault"
    assert bench.read(0x603F) == 0x8700


def test_no_sync_watch_without_a_period(bench):
    bench.enable()
    bench.sync()
    bench.run(1000)
    assert bench.power_state == "operation enabled"


def test_sync_of_another_id(bench):
    assert bench.write(0x1005, 0, 0x40000080, 4) == 0x06090030
    assert bench.write(0x1005, 0, 0x81, 4) == 0
    bench.write(0x1800, 2, 1, 1)
    bench.nmt(1)
    assert [f.id for f in bench.send(0x80)] == []
    assert [f.id for f in bench.send(0x81)] == [0x183]


# -- faults and emergencies ------------------------------------------------------------------------------------------


def reset(bench):
    bench.nmt(1)
    bench.word(0x00)
    bench.word(0x80)


@pytest.mark.parametrize(("code", "register"), [(0x2310, 0x03), (0x3210, 0x05), (0x4210, 0x09), (0x8130, 0x11),
                                                (0x8611, 0x21), (0x5441, 0x01), (0xFF01, 0x81)])  # fmt: skip
def test_error_register(bench, code, register):
    bench.trip(code)
    bench.run(1)
    assert bench.emergencies() == [(code, register)]
    assert bench.read(0x1001) == register
    assert bench.read(0x603F) == code


def test_history_is_newest_first_and_can_be_cleared(bench):
    codes = [0x3210 + k for k in range(11)]
    with pytest.raises(LookupError, match="0x8000024"):
        bench.read(0x1003, 1)
    for k, code in enumerate(codes, 1):
        bench.trip(code)
        assert bench.read(0x1003, 0) == min(k, 8)
        assert [bench.read(0x1003, sub) for sub in range(1, min(k, 8) + 1)] == codes[max(k - 8, 0) : k][::-1]
    reset(bench)
    assert bench.power_state == "switch on disabled"
    assert bench.read(0x1003, 0) == 8
    assert bench.write(0x1003, 0, 3, 1) == 0x06090030
    assert bench.write(0x1003, 0, 0, 1) == 0
    assert bench.read(0x1003, 0) == 0
    with pytest.raises(LookupError, match="0x8000024"):
        bench.read(0x1003, 1)


def test_trip_and_reset(bench):
    bench.enable()
    bench.velocity(20_000)
    bench.run(400)
    bench.trip(0x3210)
    assert bench.power_state == "fault reaction active"
    assert bench.read(0x6041) & 0x4F == 0x0F
    bench.run(300)
    assert bench.power_state == "fault"
    assert bench.read(0x6041) & 0x4F == 0x08
    reset(bench)
    assert bench.power_state == "switch on disabled"
    assert bench.emergencies() == [(0x3210, 0x05), (0, 0)]
    assert bench.read(0x603F) == 0
    bench.run(500)
    assert not bench.axis.powered


def test_a_cause_that_stays_refuses_the_reset(bench):
    bench.trip(0x3210, sticky=True)
    reset(bench)
    assert bench.power_state == "fault"
    bench.nmt(0x81)
    assert bench.power_state == "fault"  # and trips again after a reboot
    bench.node.sticky.clear()
    reset(bench)
    assert bench.power_state == "switch on disabled"


def test_emergency_inhibit_time_and_switching_off(bench):
    bench.write(0x1015, 0, 100, 2)  # 10 ms
    start = bench.t
    for code in (0x3210, 0x3220, 0x3110):
        bench.trip(code)
    bench.run(50)
    times = [t - start for t, f in bench.heard if f.id == 0x83]
    assert times == [0, 10_000_000, 20_000_000]
    bench.write(0x1014, 0, 0x80000083, 4)
    bench.trip(0x4210)
    bench.run(50)
    assert len(bench.emergencies()) == 3


def test_emergencies_wait_while_the_node_is_stopped(bench):
    bench.nmt(2)
    bench.trip(0x3210)
    assert bench.run(100) == []
    bench.nmt(0x80)
    assert bench.emergencies() == [(0x3210, 0x05)]


# -- NMT commands while the arm moves --------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [0x02, 0x80, 0x82])
@pytest.mark.parametrize(("option", "state"), [(0, "operation enabled"), (1, "fault reaction active"),
                                               (2, "switch on disabled"), (3, "quick stop active")])  # fmt: skip
def test_nmt_commands_while_moving_obey_0x6007(bench, command, option, state):
    bench.enable(x6007=option)
    bench.velocity(50_000)
    bench.run(500)
    bench.nmt(command, 0)
    assert bench.power_state == state
    bench.run(700)
    assert (bench.axis.set_velocity == 0.0) is bool(option)
    assert bench.axis.powered is not bool(option)


@pytest.mark.parametrize("quick_stop", [2, 6])
def test_reset_node_while_moving_stops_by_the_ramp_first(bench, quick_stop):
    bench.enable(x6007=3, x6085=500_000, x605A=quick_stop)
    bench.velocity(50_000)
    bench.run(600)
    assert bench.axis.set_velocity > 0.5
    assert bench.nmt(0x81) == []
    assert bench.send(0x603, 0x40, 0, 0x10, 0, 0, 0, 0, 0) == []
    frames = bench.run(150)
    assert heartbeats(frames) == [0]
    assert bench.run_to_rest() == 0
    assert bench.power_state == "switch on disabled"
    assert not bench.axis.powered


def test_nmt_stop_of_an_idle_drive_is_no_fault(bench):
    bench.nmt(1)
    bench.nmt(2)
    bench.nmt(0x82)
    assert bench.power_state == "switch on disabled"
    assert bench.emergencies() == []


def test_reboot_takes_the_power_away(bench):
    bench.enable()
    bench.velocity(50_000)
    bench.run(300)
    bench.node.power_up(bench.t)
    assert [f.data for f in bench.node.outgoing()] == [b"\0"]
    assert not bench.axis.powered
    assert bench.power_state == "switch on disabled"
    bench.run(60)
    assert bench.axis.brake_closed
    bench.nmt(1)
    bench.word(0x0F)
    bench.run(100)
    assert not bench.axis.powered


def test_state_in_words(bench):
    bench.trip(0x3210)
    assert bench.node.state() == "pre-operational, fault, error 0x3210"


def test_sdo_time_out_is_told(bench):
    bench.send(0x603, 0x40, 0x08, 0x10, 0, 0, 0, 0, 0)
    (frame,) = bench.run(2000)
    assert frame.id == 0x583
    assert struct.unpack_from("<L", frame.data, 4)[0] == 0x05040000
