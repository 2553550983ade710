"""Bring-up of CiA 402 drives against the emulated ones, in virtual time with bit times."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import Cia402Codec
from stereoservo_drivers.canopen.cia402_bringup import Cia402Bringup
from stereoservo_drivers.canopen.cia402_configuration import SHIPPED_EDS
from stereoservo_drivers.canopen.master import Master, MasterSettings, Mode
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator
from stereoservo_sim.emulators.bus.factory import DrivesSettings, make_bus_emulator
from stereoservo_sim.emulators.bus.fault_trials import VirtualHost
from stereoservo_sim.emulators.nodes.cia402_node import Cia402Node
from stereoservo_sim.emulators.nodes.communication import Abort, SdoError

COUNTS, GEAR = 4096, 100.0
COUNTS_PER_RAD = COUNTS * GEAR / (2 * math.pi)

FAULT_RESET = bytes.fromhex("2b 40 60 00 80 00 00 00")
"""SDO download of two bytes, 0x80, to 0x6040."""


class Host(VirtualHost):
    """``swallow``: SDO requests for this object do not reach the bus. ``after_reset``: ordered 15 ms after every
    fault reset.
    """

    swallow: tuple[int, int] | None = None
    after_reset = ""

    def send(self, frames: list[CanFrame]) -> None:
        kept = [frame for frame in frames if not self._swallowed(frame)]
        super().send(kept)
        if self.after_reset and any(frame.data == FAULT_RESET for frame in frames):
            at_us = (self.t_ns - self.emulator.start_ns) // 1000 + 15_000
            self.emulator.order(f"{self.after_reset} @ {at_us}us", self.t_ns)

    def _swallowed(self, frame: CanFrame) -> bool:
        if self.swallow is None or frame.id & ~0x7F != 0x600:
            return False
        return (int.from_bytes(frame.data[1:3], "little"), frame.data[3]) == self.swallow


@dataclass
class Bench:
    """An emulated bus and a host that is not connected yet."""

    options: CanOptions
    emulator: BusEmulator
    cell_dir: Path

    def __post_init__(self) -> None:
        self.plug_in(self.options)

    def plug_in(self, options: CanOptions) -> None:
        """A host that knows nothing of what was before."""
        self.codec = Cia402Codec(options)
        self.bringup = Cia402Bringup(options, self.codec, self.cell_dir)
        self.master = Master(self.codec, MasterSettings.of(options))
        self.host = Host(self.emulator, self.master)

    def node(self, number: int) -> Cia402Node:
        node = self.emulator.slot(number).node
        assert isinstance(node, Cia402Node)
        return node

    def object(self, number: int, index: int, subindex: int = 0) -> int:
        value = self.node(number).dictionary.get(index, subindex)
        assert isinstance(value, int)
        return value

    def connect(self) -> None:
        self.bringup.connect(self.host)

    def refused(self, code: str) -> str:
        """Message of the DriverError with which ``connect`` ends."""
        with pytest.raises(DriverError) as refusal:
            self.connect()
        assert refusal.value.code == code, refusal.value
        return str(refusal.value)

    def order(self, text: str) -> None:
        self.emulator.order(text, self.emulator.t_ns)

    def cycle(self, seconds: float, *velocities: float) -> None:
        self.host.velocities = np.array(velocities) if velocities else np.zeros(len(self.options.joint))
        self.host.run_until(self.host.t_ns + round(seconds * 1e9))

    def run(self) -> None:
        """Cycle, enabled."""
        self.host.begin_cycle()
        self.cycle(0.02)
        self.master.request_enable(self.host.t_ns)
        self.cycle(0.2)
        assert self.master.mode is Mode.RUNNING, self.master.fault

    def reset(self) -> None:
        self.host.end_cycle()
        try:
            self.bringup.reset(self.host)
        except DriverError:
            self.host.resume_cycle()
            raise
        self.host.begin_cycle()
        self.cycle(0.05)

    def events(self, kind: str) -> list[int]:
        return [event.node for event in self.emulator.events if event.kind == kind]


def watch_nobody(bench: Bench) -> None:
    """No drive of ``bench`` reacts to a lost master any more."""
    with bench.bringup._drives(bench.host) as drives:
        for drive in drives:
            for index, subindex in ((0x1016, 1), (0x6007, 0)):
                drive.write(index, subindex, 0)


def make_joint(number: int, **changes: object) -> CanJoint:
    values: dict[str, object] = {
        "name": f"j{number}", "node_id": number, "counts_per_rev": COUNTS, "gear_ratio": GEAR,
        "max_velocity": 1.0, "max_acceleration": 4.0, "quick_stop_deceleration": 10.0, "position_min": -3.0,
        "position_max": 3.0,
    }  # fmt: skip
    return CanJoint(**(values | changes))  # type: ignore[arg-type]


def make_options(*joints: CanJoint, **changes: object) -> CanOptions:
    given = joints or tuple(make_joint(number) for number in (1, 2, 3))
    return CanOptions(interface="virtual", channel="test", joint=given, **changes)  # type: ignore[arg-type]


Make = Callable[..., Bench]


@pytest.fixture
def make_bench(tmp_path: Path) -> Make:
    """``make_bench(options, on_bus=options of what is really there, eds=of the emulated drives)``."""

    def make(options: CanOptions | None = None, on_bus: CanOptions | None = None, eds: Path = SHIPPED_EDS) -> Bench:
        options = options or make_options()
        settings = DrivesSettings(plant="ideal", bit_time=True, brake_ms=5.0, eds=str(eds))
        emulator = make_bus_emulator(on_bus or options, settings, t_ns=0)
        emulator.run_until(10_000_000)
        return Bench(options, emulator, tmp_path)

    return make


@pytest.fixture
def bench(make_bench: Make) -> Bench:
    """Three drives."""
    return make_bench()


# -- configuration ----------------------------------------------------------------------------------------------


def test_drives_are_configured_as_the_options_say(bench: Bench) -> None:
    start_ns = bench.emulator.t_ns
    bench.connect()
    assert bench.emulator.t_ns - start_ns < 500_000_000
    for node in (1, 2, 3):
        expected = {
            (0x1005, 0): 0x80,
            (0x1016, 1): 127 << 16 | 100,
            (0x1017, 0): 20,
            (0x6007, 0): 3,
            (0x605A, 0): 2,
            (0x605E, 0): 2,
            (0x6061, 0): 9,
            (0x607F, 0): round(COUNTS_PER_RAD),
            (0x6080, 0): round(COUNTS_PER_RAD),
            (0x6083, 0): round(4 * COUNTS_PER_RAD),
            (0x6084, 0): round(4 * COUNTS_PER_RAD),
            (0x6085, 0): round(10 * COUNTS_PER_RAD),
            (0x1400, 2): 255,
            (0x1400, 5): 20,
            (0x1600, 0): 2,
            (0x1600, 1): 0x60400010,
            (0x1600, 2): 0x60FF0020,
            (0x1800, 2): 1,
            (0x1A00, 0): 2,
            (0x1A00, 1): 0x60410010,
            (0x1A00, 2): 0x60640020,
            (0x1801, 2): 1,
            (0x1A01, 0): 2,
            (0x1A01, 1): 0x606C0020,
            (0x1A01, 2): 0x60770010,
        }
        assert {key: bench.object(node, *key) for key in expected} == expected
        for index, cob_id in ((0x1400, 0x200), (0x1800, 0x180), (0x1801, 0x280)):
            assert bench.object(node, index, 1) & 0x800007FF == cob_id + node
        for index in (0x1401, 0x1402, 0x1403, 0x1802, 0x1803):
            assert bench.object(node, index, 1) >> 31 == 1, f"0x{index:04X} is not off"
        assert bench.node(node).nmt == 5
    assert bench.codec.status_words() == ("switch on disabled",) * 3
    assert bench.codec.faults() == ()
    assert bench.events("power_on") == []
    assert bench.bringup.identities[2].serial_number == 2


def test_all_feedback_takes_a_third_pdo(make_bench: Make) -> None:
    bench = make_bench(make_options(feedback=("velocity", "effort", "following_error"), mode="pv"))
    bench.connect()
    assert bench.object(1, 0x1A02, 1) == 0x60F40020
    assert bench.object(1, 0x1802, 1) & 0x800007FF == 0x381
    assert bench.object(1, 0x6061) == 3
    bench.run()
    bench.cycle(0.2, 0.1, -0.2, 0.3)
    sample = bench.master.sample()
    assert sample is not None
    assert sample.following_errors is not None
    assert sample.velocities == pytest.approx([0.1, -0.2, 0.3], abs=2 / COUNTS_PER_RAD)


def test_further_writes_are_made_and_replace_the_driver_s_own(make_bench: Make) -> None:
    joint = make_joint(1, sdo={"0x60C2:1": 4, "0x6080:0": 123_456, "0x607D:1": -200_000})
    bench = make_bench(make_options(joint))
    bench.connect()
    assert bench.object(1, 0x60C2, 1) == 4
    assert bench.object(1, 0x6080) == 123_456
    assert bench.object(1, 0x607D, 1) == -200_000


def test_other_identifiers_of_sync_and_emergencies_are_set_right(bench: Bench) -> None:
    bench.node(1).dictionary.set(0x1005, 0, 0x91)
    bench.node(1).dictionary.set(0x1014, 0, 0x80000081)
    bench.connect()
    assert bench.object(1, 0x1005) == 0x80
    assert bench.object(1, 0x1014) == 0x81


def test_connecting_twice_gives_the_same(bench: Bench) -> None:
    bench.connect()
    communication = [key for key in bench.node(2).dictionary.entries if 0x1005 <= key[0] < 0x2000]
    keys = [key for key in communication if not 0x1008 <= key[0] <= 0x1011]
    before = {key: bench.object(2, *key) for key in keys}
    bench.run()
    bench.master.request_disable()
    bench.cycle(0.2)
    bench.host.end_cycle()
    bench.bringup.release(bench.host)
    bench.plug_in(bench.options)
    bench.connect()
    assert {key: bench.object(2, *key) for key in keys} == before
    bench.run()


@pytest.mark.parametrize(("quick_stop_option", "absent"), [(2, "none"), (6, "none"), (6, "606C")])
def test_a_drive_that_was_left_moving_is_brought_to_rest_and_switched_off(
    make_bench: Make, tmp_path: Path, quick_stop_option: int, absent: str
) -> None:
    # no reaction of the drive's own to the lost master: all of it is the bring-up's
    joint, path = make_joint(1), tmp_path / "drive.eds"
    text = SHIPPED_EDS.read_text().replace(f"[{absent}]", "[266C]")
    path.write_text(text.replace(f"=0x{absent}\n", "=0x266C\n"))
    options = make_options(joint, quick_stop_option=quick_stop_option, rpdo_deadline_ms=0)
    bench = make_bench(options, eds=path)
    bench.connect()
    bench.run()
    bench.cycle(0.5, 0.5)
    node = bench.node(1)
    watch_nobody(bench)
    assert node.axis.velocity == pytest.approx(0.5, abs=1e-3)
    bench.plug_in(bench.options)
    bench.connect()
    assert node.axis.velocity == 0.0
    assert not node.axis.powered
    assert bench.codec.status_words()[0].startswith("switch on disabled")
    # it came to rest on its ramp and was switched off then
    ends = [event.kind for event in bench.emulator.events if event.kind in ("rest", "power_off")]
    assert ends[-2:] == ["rest", "power_off"]


# -- refusals ---------------------------------------------------------------------------------------------------


def test_a_missing_node_is_named_with_those_that_answer(make_bench: Make) -> None:
    on_bus = make_options(make_joint(1), make_joint(2), make_joint(9))
    bench = make_bench(make_options(), on_bus)
    message = bench.refused("node_missing")
    assert "node 3 (j3)" in message
    assert "1, 2, 9" in message


def test_a_silent_bus_points_at_bitrate_and_wiring(bench: Bench) -> None:
    bench.order("cable out")
    message = bench.refused("node_missing")
    assert all(word in message for word in ("no node answers", "bitrate", "termination", "node 1 (j1)"))


def test_two_nodes_of_one_id_are_refused(bench: Bench) -> None:
    bench.order("duplicate 2")
    message = bench.refused("duplicate_node")
    assert "node 2 (j2)" in message
    assert bench.events("power_on") == []


def test_a_device_that_is_no_drive_is_refused(bench: Bench) -> None:
    bench.node(3).dictionary.set(0x1000, 0, 0x00030191)  # CiA 401, an I/O module
    message = bench.refused("not_a_drive")
    assert "profile 401" in message
    assert "node_id" in message


@pytest.mark.parametrize("key", ["vendor_id", "product_code", "revision", "serial_number"])
def test_another_identity_is_refused(make_bench: Make, key: str) -> None:
    joints = [make_joint(1), make_joint(2, **{key: 0x1234})]
    message = make_bench(make_options(*joints), make_options(make_joint(1), make_joint(2))).refused("identity")
    assert key in message
    assert "4660 (0x1234)" in message
    make_bench(make_options(*joints)).connect()


def test_an_eds_of_another_drive_is_refused(make_bench: Make, tmp_path: Path) -> None:
    text = SHIPPED_EDS.read_text().replace("VendorNumber=0x53455256", "VendorNumber=0x000000FB")
    (tmp_path / "other.eds").write_text(text)
    message = make_bench(make_options(eds="other.eds")).refused("wrong_eds")
    assert "other.eds is for vendor 0xFB" in message
    assert "0x53455256" in message


def test_what_an_eds_leaves_out_and_the_drive_has_is_configured(make_bench: Make, tmp_path: Path) -> None:
    text = SHIPPED_EDS.read_text().replace("[6085]", "[2085]").replace("=0x6085", "=0x2085")
    (tmp_path / "poor.eds").write_text(text)
    bench = make_bench(make_options(eds="poor.eds"))
    bench.connect()
    scale = bench.codec.axes[0].scale
    assert bench.object(1, 0x6085) == scale.rate_units(bench.options.joint[0].quick_stop_deceleration)


GUARDED = """
[100C]
ParameterName=Guard time
ObjectType=0x7
DataType=0x0006
AccessType=rw
DefaultValue=0
[100D]
ParameterName=Life time factor
ObjectType=0x7
DataType=0x0005
AccessType=rw
DefaultValue=0
"""


def test_drives_without_consumer_heartbeat_are_guarded_and_stop_when_the_guarding_ends(
    make_bench: Make, tmp_path: Path
) -> None:
    path = tmp_path / "guarded.eds"
    path.write_text(SHIPPED_EDS.read_text().replace("1016", "2016") + GUARDED)
    bench = make_bench(make_options(rpdo_deadline_ms=0), eds=path)
    bench.connect()
    assert [bench.bringup.setups[node].watches for node in (1, 2, 3)] == [("guarding",)] * 3
    bench.run()
    bench.cycle(1.0, 0.3, 0.3, 0.3)
    assert bench.master.fault is None
    bench.host.cycling = False
    lost_ns = bench.emulator.t_ns
    bench.host.run_until(lost_ns + 600_000_000)
    rests = [event.t_ns for event in bench.emulator.events if event.kind == "rest" and event.t_ns > lost_ns]
    assert len(rests) == 3
    assert max(rests) - lost_ns <= 100_000_000 + 20_000_000 + 0.3 / 10.0 * 1e9 + 1_000_000
    bench.host.cycling = True
    bench.reset()
    bench.run()
    bench.host.end_cycle()
    bench.bringup.release(bench.host)
    bench.host.run_until(bench.host.t_ns + 500_000_000)
    assert bench.node(1).faults == []


def test_an_object_that_neither_eds_nor_standard_know_is_refused(make_bench: Make) -> None:
    message = make_bench(make_options(make_joint(1, sdo={"0x2345:1": 5}))).refused("sdo_abort")
    assert "0x2345:1" in message
    assert "option sdo" in message


@pytest.mark.parametrize("text", ["", "no section", "[DeviceInfo]\nVendorNumber=1\n", "[6040]\nObjectType=9\n"])
def test_a_file_that_is_no_eds_is_refused(make_bench: Make, tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.eds").write_text(text)
    assert "bad.eds" in make_bench(make_options(eds="bad.eds")).refused("eds")


def test_an_eds_that_is_not_there_is_refused_before_anything_is_connected(make_bench: Make) -> None:
    with pytest.raises(DriverError, match=re.escape("there is no file")) as refusal:
        make_bench(make_options(eds="nowhere.eds"))
    assert refusal.value.code == "eds"
    make_bench(make_options(eds="drive402.eds")).connect()


def test_a_drive_without_the_mode_is_refused(make_bench: Make) -> None:
    bench = make_bench(make_options(mode="csv"))
    bench.node(1).dictionary.set(0x6502, 0, 1 << 2)
    message = bench.refused("mode")
    assert "mode 9 (csv)" in message
    assert "set mode to pv" in message


def test_a_drive_that_refuses_a_mode_is_used_with_the_next_one(make_bench: Make) -> None:
    bench = make_bench(make_options(make_joint(1)))

    def velocity_only(subindex: int, value: int) -> None:
        if value == 9:
            raise SdoError(Abort.INVALID_VALUE)

    bench.node(1).dictionary.guard(0x6060, velocity_only)
    bench.connect()
    assert bench.codec.axes[0].mode == "pv"
    assert bench.object(1, 0x6061) == 3


def test_sdo_aborts_name_node_object_value_and_option(make_bench: Make) -> None:
    message = make_bench(make_options(make_joint(1, sdo={"0x1018:1": 5}))).refused("sdo_abort")
    for part in ("node 1 (j1)", "0x1018:1 (Identity object: Vendor-ID) = 5", "[option sdo]", "0x06010002"):
        assert part in message, message


@pytest.mark.parametrize(
    ("sdo", "code", "part"),
    [
        ({"0x2000:1": 5}, "sdo_abort", "0x2000:1"),
        ({"0x60C2:1": 256}, "option", "0 to 255"),
        ({"0x6007:0": 7}, "option", "0 to 3"),
    ],
)
def test_bad_further_writes_are_refused(make_bench: Make, sdo: dict[str, int], code: str, part: str) -> None:
    assert part in make_bench(make_options(make_joint(1, sdo=sdo))).refused(code)


def test_a_value_that_the_drive_changes_is_refused(bench: Bench) -> None:
    dictionary = bench.node(2).dictionary
    dictionary.changed(0x6085, lambda subindex, value: dictionary.set(0x6085, 0, value // 2))
    message = bench.refused("read_back")
    assert f"reads {round(10 * COUNTS_PER_RAD) // 2}" in message
    assert "set quick_stop_deceleration" in message


def test_a_watch_on_the_heartbeat_that_the_drive_changes_is_refused(bench: Bench) -> None:
    dictionary = bench.node(2).dictionary
    dictionary.changed(0x1016, lambda subindex, value: dictionary.set(0x1016, 1, 0))
    assert "0x1016:1" in bench.refused("read_back")


def test_a_mapping_that_the_drive_changes_is_refused(bench: Bench) -> None:
    dictionary = bench.node(2).dictionary
    dictionary.changed(0x1801, lambda subindex, value: dictionary.set(0x1A01, 1, 0x60770010))
    assert "0x1A01:1" in bench.refused("read_back")


def test_an_answer_that_does_not_come_is_told_with_its_object(bench: Bench) -> None:
    bench.host.swallow = (0x6085, 0)
    message = bench.refused("sdo_timeout")
    assert "0x6085:0 (Quick stop deceleration)" in message
    assert "powered" in message


# -- faults -----------------------------------------------------------------------------------------------------


def test_a_fault_at_the_start_is_reported_and_not_cleared(bench: Bench) -> None:
    bench.order("fault 2 0x3210")
    bench.connect()
    (fault,) = bench.codec.faults()
    assert (fault.code, fault.axis) == ("drive_fault", 1)
    assert "0x3210 DC link over-voltage" in fault.message
    bench.host.begin_cycle()
    bench.master.request_enable(bench.host.t_ns)
    bench.cycle(0.3)
    assert bench.master.mode is Mode.LATCHED
    assert bench.events("power_on") == []
    bench.reset()
    assert bench.master.fault is None
    assert bench.codec.status_words() == ("switch on disabled",) * 3
    bench.run()


def test_a_fault_whose_cause_stays_is_not_reset(bench: Bench) -> None:
    bench.connect()
    bench.run()
    bench.order("sticky 2 0x7305")
    bench.cycle(0.3, 0.1, 0.1, 0.1)
    assert bench.master.mode is Mode.LATCHED
    powered = len(bench.events("power_on"))
    for _ in range(2):
        with pytest.raises(DriverError) as refusal:
            bench.reset()
        assert refusal.value.code == "fault_stays"
        assert "node 2 (j2)" in str(refusal.value)
        assert "0x7305 incremental encoder" in str(refusal.value)
        seen = bench.master.statistics.complete
        bench.cycle(0.1)
        assert bench.master.mode is Mode.LATCHED
        assert bench.master.statistics.complete >= seen + 20  # positions are still seen
    bench.order("sticky 2 off")
    bench.reset()
    assert bench.master.fault is None
    assert len(bench.events("power_on")) == powered
    bench.run()


def test_a_cause_that_shows_itself_a_little_later_is_not_reset_either(bench: Bench) -> None:
    bench.order("fault 2 0x7305")
    bench.connect()
    bench.host.begin_cycle()
    bench.cycle(0.05)
    bench.host.after_reset = "fault 2 0x7306"
    with pytest.raises(DriverError, match=re.escape("0x7306 incremental encoder 2")) as refusal:
        bench.reset()
    assert refusal.value.code == "fault_stays"
    bench.host.after_reset = ""
    bench.reset()
    assert bench.master.fault is None, bench.master.fault


@pytest.mark.parametrize("stubborn", [False, True])
@pytest.mark.parametrize("abort_option", [1, 3])
def test_reset_after_a_lost_heartbeat(make_bench: Make, abort_option: int, stubborn: bool) -> None:
    """``stubborn``: the drives refuse a fault reset until NMT reset communication (EPOS4)."""
    bench = make_bench(make_options(abort_option=abort_option, rpdo_deadline_ms=0))
    for node in (1, 2, 3):
        object.__setattr__(bench.node(node).settings, "reset_needs_communication_reset", stubborn)
    bench.connect()
    bench.run()
    bench.host.cycling = False
    bench.cycle(0.3)
    assert bench.emulator.at_rest()
    bench.host.cycling = True
    bench.cycle(0.05)
    assert bench.master.mode is Mode.LATCHED
    powered = len(bench.events("power_on"))
    bench.reset()
    assert bench.master.fault is None, bench.master.fault
    assert bench.codec.at_rest_unpowered()
    assert len(bench.events("power_on")) == powered
    bench.run()
    bench.cycle(0.3, 0.1, 0.1, 0.1)
    assert bench.master.mode is Mode.RUNNING


@pytest.mark.parametrize("fault", ["reboot 2", "remap 2", "fault 2 0x8611", "nmt stop", "nmt preop", "nmt reset"])
def test_reset_configures_anew_whatever_has_happened(bench: Bench, fault: str) -> None:
    bench.connect()
    bench.run()
    bench.order(fault)
    bench.cycle(0.3, 0.1, 0.1, 0.1)
    assert bench.master.mode is Mode.LATCHED
    bench.reset()
    assert bench.master.fault is None, bench.master.fault
    bench.run()
    bench.cycle(0.2, 0.1, 0.1, 0.1)
    assert bench.master.mode is Mode.RUNNING, bench.master.fault


def test_reset_refuses_a_node_that_is_gone_and_one_that_is_there_twice(bench: Bench) -> None:
    bench.connect()
    bench.run()
    for order, undo, code in (
        ("silence 2", "speak 2", "node_missing"),
        ("duplicate 2", "duplicate 2 off", "duplicate_node"),
    ):
        bench.order(order)
        bench.cycle(0.3)
        assert bench.master.mode is Mode.LATCHED
        with pytest.raises(DriverError) as refusal:
            bench.reset()
        assert refusal.value.code == code
        bench.order(undo)
        bench.reset()
        assert bench.master.fault is None, bench.master.fault


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("side", [1, -1])
def test_a_limit_switch_at_the_start_lets_the_joint_go_inward_only(make_bench: Make, direction: int, side: int) -> None:
    bench = make_bench(make_options(make_joint(1, direction=direction)))
    bench.node(1).axis.limit_switch = side
    bench.connect()
    assert bench.codec.faults() == ()
    assert "internal limit" in bench.codec.status_words()[0]
    bench.run()
    bench.cycle(0.1, -0.2 * side)
    assert bench.master.mode is Mode.RUNNING, bench.master.fault
    bench.cycle(0.1, 0.2 * side)
    assert bench.master.fault is not None
    assert bench.master.fault.code == "limit_switch"


# -- release ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("abort_option", [1, 2, 3])
def test_released_drives_do_not_miss_the_master(make_bench: Make, abort_option: int) -> None:
    bench = make_bench(make_options(abort_option=abort_option))
    bench.connect()
    bench.run()
    bench.master.request_disable()
    bench.cycle(0.3)
    assert bench.codec.at_rest_unpowered()
    bench.host.end_cycle()
    bench.bringup.release(bench.host)
    bench.host.cycling = False
    bench.emulator.run_until(bench.emulator.t_ns + 2_000_000_000)
    for node in (1, 2, 3):
        assert bench.object(node, 0x6007) == (0 if abort_option == 1 else abort_option)
        assert bench.node(node).emergencies.active == []
        assert "switch on disabled" in bench.node(node).state()
    bench.plug_in(bench.options)
    bench.connect()
    assert bench.codec.faults() == ()
    bench.run()


def test_release_tells_once_of_all_drives_that_are_gone(bench: Bench) -> None:
    bench.connect()
    bench.order("silence 1")
    bench.order("silence 3")
    with pytest.raises(DriverError, match=re.escape("2 of 3 drives")) as refusal:
        bench.bringup.release(bench.host)
    assert refusal.value.code == "not_released"
    assert bench.object(2, 0x1016, 1) == 0


def test_a_drive_that_is_still_enabled_is_stopped_before_it_is_left(make_bench: Make) -> None:
    bench = make_bench(make_options(rpdo_deadline_ms=0))
    bench.connect()
    bench.run()
    bench.cycle(0.5, 0.5, 0.5, 0.5)
    bench.host.end_cycle()
    bench.bringup.release(bench.host)
    for node in (1, 2, 3):
        assert (bench.node(node).axis.velocity, bench.node(node).axis.powered) == (0.0, False)
        ends = [
            event.kind for event in bench.emulator.events if event.node == node and event.kind in ("rest", "power_off")
        ]
        assert ends[-2:] == ["rest", "power_off"]


# -- who else is there --------------------------------------------------------------------------------------------


def test_drives_that_somebody_else_commands_are_left_alone(bench: Bench, monkeypatch) -> None:
    sent: list[CanFrame] = []
    subscribe, send = bench.host.subscribe, bench.host.send

    def hear(can_id: int, heard: list[CanFrame]) -> None:
        subscribe(can_id, heard)
        if can_id == 0x202:
            heard.extend([CanFrame(0x202, bytes(6))] * 12)

    monkeypatch.setattr(bench.host, "subscribe", hear)
    monkeypatch.setattr(bench.host, "send", lambda frames: (sent.extend(frames), send(frames)))
    message = bench.refused("second_master")
    assert all(part in message for part in ("node 2 (j2)", "12 frames 0x202", "another daemon"))
    assert {frame.id for frame in sent} <= {0x700 + bench.options.master_id}


def test_a_moving_arm_is_stopped_though_another_of_its_drives_is_missing(make_bench: Make) -> None:
    bench = make_bench(make_options(rpdo_deadline_ms=0))
    bench.connect()
    bench.run()
    bench.cycle(0.5, 0.5, 0.5, 0.5)
    watch_nobody(bench)
    assert [bench.node(number).axis.velocity for number in (1, 2, 3)] == pytest.approx([0.5] * 3, abs=1e-3)
    bench.order("silence 3")
    bench.plug_in(bench.options)
    bench.refused("node_missing")
    assert [bench.node(number).axis.velocity for number in (1, 2, 3)] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("at_ms", [100, 150])
def test_a_drive_that_boots_while_it_is_configured_is_refused(bench: Bench, at_ms: int) -> None:
    bench.connect()
    bench.plug_in(bench.options)
    at_us = (bench.emulator.t_ns - bench.emulator.start_ns) // 1000 + at_ms * 1000
    bench.emulator.order(f"reboot 1 @ {at_us}us", bench.emulator.t_ns)
    with pytest.raises(DriverError) as refusal:
        bench.connect()
    assert refusal.value.code == "rebooted"
    assert refusal.value.retry
    bench.cycle(1.0)
    bench.connect()
    bench.run()


def test_a_drive_that_answers_slowly_is_found_and_configured(make_bench: Make) -> None:
    bench = make_bench(make_options(make_joint(1)))
    bench.order("late 1 80ms")
    bench.connect()
    assert bench.object(1, 0x1400, 5) == bench.options.rpdo_deadline_ms
