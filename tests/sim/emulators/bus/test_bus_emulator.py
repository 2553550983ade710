"""The emulated bus with scripted nodes: events in bus time, and what orders do."""

import numpy as np
import pytest

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.load import frame_bits
from stereoservo_sim.emulators.bus.bus_emulator import BABBLE_FRAME, BusEmulatorError
from stereoservo_sim.emulators.fault_engine import FaultCommandError
from stereoservo_sim.emulators.nodes.node import NEVER_NS

MS = 1_000_000
SYNC = CanFrame(0x80)


def answers(emulator, t_ns, for_ms=3):
    """Ids that the master hears after a SYNC at ``t_ns``, heartbeats and boot-ups left out."""
    emulator.run_until(t_ns)
    emulator.delivered()
    emulator.inject(SYNC, t_ns)
    emulator.run_until(t_ns + for_ms * MS)
    return [frame.id for _, frame in emulator.delivered() if frame.id < 0x700]


BOTH = [0x181, 0x182, 0x281, 0x282]


def test_a_sync_is_answered_at_once_where_frames_take_no_time(scripted):
    emulator = scripted.emulator(2)
    emulator.inject(SYNC, 5 * MS)
    emulator.run_until(5 * MS)
    assert [(t, f.id) for t, f in emulator.delivered()] == [(0, 0x701), (0, 0x702)] + [(5 * MS, i) for i in BOTH]


def test_frames_end_when_their_bits_are_sent(scripted):
    """SYNC, then two TPDOs of each of six drives in the order of their ids, back to back."""
    emulator = scripted.emulator(6, bitrate=1_000_000)
    emulator.run_until(5 * MS)
    emulator.delivered()
    emulator.inject(SYNC, 5 * MS)
    emulator.run_until(9 * MS)
    heard = emulator.delivered()
    assert [frame.id for _, frame in heard] == [0x180 + k for k in range(1, 7)] + [0x280 + k for k in range(1, 7)]
    ends = 5 * MS + 1000 * np.cumsum([frame_bits(frame) for frame in (SYNC, *(frame for _, frame in heard))])
    assert [t for t, _ in heard] == ends[1:].tolist()


def test_the_master_does_not_hear_itself_and_all_nodes_hear_each_other(scripted):
    emulator = scripted.emulator(3)
    emulator.inject(CanFrame(0x555, b"x"), MS)
    emulator.run_until(2 * MS)
    assert all(frame.id != 0x555 for _, frame in emulator.delivered())
    for node in emulator.nodes:
        heard = [frame.id for _, frame in node.heard]
        assert heard.count(0x555) == 1
        assert sorted(i for i in heard if i > 0x700) == [0x700 + k for k in (1, 2, 3) if k != node.node_id]


def test_the_same_calls_give_the_same_frames_and_events(scripted):
    def trial():
        emulator = scripted.emulator(6, bitrate=1_000_000)
        rng = np.random.default_rng(3)
        emulator.order("lose 2 tpdo1 3 @ 20ms", 0)
        emulator.order("flood 5 3000 @ 30ms", 0)
        for k in range(1, 100):
            emulator.inject(SYNC, k * MS)
            emulator.inject(scripted.command(int(rng.integers(1, 7)), float(rng.uniform(-1, 1))), k * MS)
        return emulator.delivered(), list(emulator.events), [node.axis.position for node in emulator.nodes]

    assert trial() == trial()


def test_arm_and_events_follow_a_command(scripted):
    emulator = scripted.emulator(2)
    emulator.inject(scripted.command(1, 0.5), 10 * MS)
    emulator.run_until(509 * MS)
    emulator.inject(scripted.command(1, 0.0), 509 * MS)
    emulator.run_until(1000 * MS)
    told = {(event.kind, event.node): event.t_ns for event in emulator.events}
    assert told["power_on", 1] == 10 * MS
    assert told["state", 1] == 10 * MS
    assert 10 * MS < told["moves", 1] <= 12 * MS
    ramp = 500 * MS // 4
    assert 509 * MS + ramp <= told["rest", 1] <= 510 * MS + ramp + MS
    assert told["rest", 1] == told["all_rest", 0]
    assert ("moves", 2) not in told
    assert np.isclose(emulator.nodes[0].axis.position, 0.5 * 0.499, atol=1e-9)


def test_silence_and_speak(scripted):
    emulator = scripted.emulator(2)
    emulator.order("silence 2", MS)
    assert answers(emulator, 2 * MS) == [0x181, 0x281]
    assert SYNC in [frame for _, frame in emulator.nodes[1].heard]  # it still hears
    emulator.order("speak 2", 8 * MS)
    assert answers(emulator, 9 * MS) == BOTH


def test_lost_frames_are_counted(scripted):
    emulator = scripted.emulator(2)
    emulator.order("lose 2 tpdo1 2", MS)
    assert [answers(emulator, k * 10 * MS).count(0x182) for k in range(1, 5)] == [0, 0, 1, 1]
    emulator.order("lose 1 0x281", 50 * MS)
    assert [answers(emulator, k * 10 * MS).count(0x281) for k in range(6, 8)] == [0, 1]


def test_a_late_node_is_late_by_what_was_ordered(scripted):
    emulator = scripted.emulator(2)
    emulator.order("late 2 6ms", MS)
    emulator.delivered()
    emulator.inject(SYNC, 10 * MS)
    emulator.run_until(30 * MS)
    when = {frame.id: t for t, frame in emulator.delivered() if frame.id < 0x700}
    assert when == {0x181: 10 * MS, 0x281: 10 * MS, 0x182: 16 * MS, 0x282: 16 * MS}
    emulator.order("late 2 0", 30 * MS)
    assert answers(emulator, 31 * MS) == BOTH


@pytest.mark.parametrize("boots", [True, False])
def test_a_duplicate_answers_too(scripted, boots):
    emulator = scripted.emulator(2)
    emulator.run_until(MS)
    emulator.delivered()
    emulator.order("duplicate 2" if boots else "duplicate 2 running", 2 * MS)
    emulator.run_until(3 * MS)
    assert [frame.id for _, frame in emulator.delivered()] == [0x702] * boots
    assert answers(emulator, 4 * MS) == [0x181, 0x182, 0x182, 0x281, 0x282, 0x282]
    emulator.inject(scripted.command(2, 0.5), 10 * MS)
    emulator.run_until(300 * MS)
    assert emulator.nodes[1].axis.position > 0.05
    assert emulator.nodes[2].axis.position == 0.0  # the double has no arm
    emulator.order("duplicate 2 off", 300 * MS)
    assert answers(emulator, 301 * MS) == BOTH


def test_cables(scripted):
    emulator = scripted.emulator(2)
    emulator.order("cable out", MS)
    assert answers(emulator, 2 * MS) == []
    assert SYNC not in [frame for _, frame in emulator.nodes[0].heard]
    emulator.run_until(30 * MS)
    assert CanFrame(0x702, b"\x05") in [frame for _, frame in emulator.nodes[0].heard]  # the drives hear each other
    emulator.order("cable in", 31 * MS)
    emulator.order("cable 2 out", 31 * MS)
    assert answers(emulator, 32 * MS) == [0x181, 0x281]
    heard = len(emulator.nodes[1].heard)
    emulator.run_until(80 * MS)
    assert len(emulator.nodes[1].heard) == heard
    emulator.order("cable 2 in", 81 * MS)
    assert answers(emulator, 82 * MS) == BOTH


def test_sync_alone_is_dropped(scripted):
    emulator = scripted.emulator(2)
    emulator.order("drop-sync", MS)
    assert answers(emulator, 2 * MS) == []
    emulator.inject(scripted.command(1, 0.5), 6 * MS)
    emulator.run_until(6 * MS)
    assert emulator.nodes[0].axis.powered
    emulator.order("pass-sync", 7 * MS)
    assert answers(emulator, 8 * MS) == BOTH


def test_faults_reach_the_node_and_the_events(scripted):
    emulator = scripted.emulator(2)
    emulator.inject(scripted.command(2, 0.5), MS)
    emulator.order("fault node 2 0x3210", 100 * MS)
    emulator.run_until(200 * MS)
    kinds = [(event.kind, event.node, event.t_ns) for event in emulator.events if event.t_ns >= 100 * MS]
    assert kinds[:2] == [("power_off", 2, 100 * MS), ("state", 2, 100 * MS)]
    assert ("order", 2, 100 * MS) in kinds
    assert ("all_rest", 0) in [kind[:2] for kind in kinds]
    assert emulator.at_rest()


def test_a_cause_that_stays_trips_again_after_a_reset(scripted):
    emulator = scripted.emulator(1)
    emulator.order("sticky 1 0x4310", MS)
    node = emulator.nodes[0]
    node.error = 0  # a reset
    emulator.inject(scripted.command(1, 0.0), 2 * MS)
    emulator.run_until(2 * MS)
    assert node.error == 0x4310
    emulator.order("sticky 1 off", 3 * MS)
    node.error = 0
    emulator.inject(scripted.command(1, 0.0), 4 * MS)
    emulator.run_until(4 * MS)
    assert node.error == 0


def test_axis_orders_reach_the_axis(scripted):
    emulator = scripted.emulator(2)
    axis = emulator.nodes[1].axis
    for text, name, value in (
        ("limit 2 +", "limit_switch", 1), ("limit 2 -", "limit_switch", -1), ("limit 2 off", "limit_switch", 0),
        ("invert 2", "inverted_encoder", True), ("invert 2 off", "inverted_encoder", False),
        ("block 2", "blocked", True), ("free 2", "blocked", False),
    ):  # fmt: skip
        emulator.order(text, emulator.t_ns + MS)
        assert getattr(axis, name) == value
    assert emulator.nodes[0].axis.limit_switch == 0


def test_a_reboot_says_so(scripted):
    emulator = scripted.emulator(2)
    emulator.inject(scripted.command(2, 0.5), MS)
    emulator.run_until(9 * MS)
    emulator.delivered()
    emulator.order("reboot 2", 10 * MS)
    emulator.run_until(10 * MS)
    assert emulator.delivered() == [(10 * MS, CanFrame(0x702, b"\0"))]
    assert not emulator.nodes[1].axis.powered


def test_foreign_frames_reach_everybody(scripted):
    emulator = scripted.emulator(2)
    emulator.delivered()
    emulator.order("nmt stop 2", 5 * MS)
    emulator.order("emcy 1 0x8611", 6 * MS)
    emulator.run_until(7 * MS)
    stop, emergency = CanFrame(0, b"\x02\x02"), CanFrame(0x81, b"\x11\x86\x01" + bytes(5))
    heard = [frame for _, frame in emulator.delivered()]
    assert stop in heard
    assert emergency in heard
    assert {stop} <= {frame for _, frame in emulator.nodes[0].heard}
    assert emergency in [frame for _, frame in emulator.nodes[1].heard]


def test_a_babbling_node_delays_what_has_a_higher_id_only(scripted):
    emulator = scripted.emulator(2, bitrate=250_000)
    emulator.order("flood 2 20000", 5 * MS)
    heard = answers(emulator, 10 * MS, for_ms=20)
    assert set(heard) == {BABBLE_FRAME.id}  # the bus is full: no TPDO gets through
    assert SYNC in [frame for _, frame in emulator.nodes[0].heard]  # but SYNC does
    assert emulator.wire.busy_ns > 24 * MS
    emulator.order("calm 2", 40 * MS)
    emulator.run_until(50 * MS)
    assert {0x181, 0x182, 0x281, 0x282} <= {frame.id for _, frame in emulator.delivered()}


def test_orders_come_at_their_time(scripted):
    emulator = scripted.emulator(2)
    assert emulator.order("silence 2 @ 20ms", 0) == "silence at 0.02 s"
    assert answers(emulator, 10 * MS) == BOTH
    assert answers(emulator, 20 * MS) == [0x181, 0x281]
    assert [event.t_ns for event in emulator.events if event.kind == "order"] == [20 * MS]


def test_what_lasts_on_the_bus_ends_by_itself(scripted):
    emulator = scripted.emulator(2)
    assert emulator.order("late 2 6ms for 20ms @ 5ms", 0) == "late at 0.005 s"
    assert emulator.order("silence 1 for 20ms", MS) == "node 1: silent for 0.02 s"
    assert emulator.order("block 2 for 20ms", MS) == "node 2: blocked for 0.02 s"
    emulator.run_until(10 * MS)
    assert emulator.disturbances.late_ns == {2: 6 * MS}
    assert emulator.disturbances.silent == {1}
    assert emulator.slot(2).node.axis.blocked
    emulator.run_until(30 * MS)
    assert emulator.disturbances.late_ns == {2: 0}
    assert not emulator.disturbances.silent
    assert not emulator.slot(2).node.axis.blocked
    ended = [(event.t_ns, event.node, event.text) for event in emulator.events if event.kind == "ended"]
    assert ended == [(21 * MS, 1, "silence"), (21 * MS, 2, "block"), (25 * MS, 2, "late")]


def test_orders_for_nodes_that_are_not_there_are_refused(scripted):
    emulator = scripted.emulator(2)
    for text in ("silence 9", "flood 3", "silence 9 @ 1s", "remap 4"):
        with pytest.raises(FaultCommandError, match="nodes: 1, 2"):
            emulator.order(text, MS)
    with pytest.raises(FaultCommandError, match="no mapping"):
        emulator.order("remap 2", MS)


def test_status_and_help_tell_everything(scripted):
    emulator = scripted.emulator(2)
    emulator.order("late 2 6ms", MS)
    emulator.order("silence 2", MS)
    lines = emulator.order("status", MS).splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("node 1 j1: off, off, at 0.0000")
    assert lines[1].endswith("[silenced, late by 6 ms]")
    assert "fault [node] N CODE" in emulator.order("help", MS)


def test_the_adapter_is_not_the_racks(scripted):
    emulator = scripted.emulator(1)
    told = []
    emulator.on_adapter = told.append
    emulator.order("adapter out", MS)
    emulator.order("adapter in", MS)
    assert told == [False, True]


def test_a_node_that_asks_for_time_that_is_past_is_named(scripted):
    emulator = scripted.emulator(2)
    emulator.nodes[1].due_ns = lambda: MS
    with pytest.raises(BusEmulatorError, match="node 2"):
        emulator.inject(SYNC, 2 * MS)
    assert emulator.nodes[0].due_ns() != NEVER_NS


def test_power_off_brings_the_arm_to_rest_unheard(scripted):
    emulator = scripted.emulator(2)
    for k in (1, 2):
        emulator.inject(scripted.command(k, 0.5), MS)
    emulator.run_until(300 * MS)
    emulator.delivered()
    emulator.power_off(300 * MS)
    emulator.run_until(400 * MS)
    assert emulator.delivered() == []
    assert emulator.at_rest()
    assert not any(node.axis.powered for node in emulator.nodes)
