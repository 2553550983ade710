"""Drives with their makers' own dictionaries, played by the `canopen` package: every one comes up with the options'
defaults, moves as commanded, and stops by its own watch where the cable is cut.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import canopen
import numpy as np
import pytest

from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import Cia402Codec
from stereoservo_drivers.canopen.cia402_bringup import Cia402Bringup, DigitalOutputs
from stereoservo_drivers.canopen.cia402_configuration import SHIPPED_EDS
from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive
from stereoservo_drivers.canopen.codec import Subscriptions
from stereoservo_drivers.canopen.master import Master, MasterSettings, Mode
from stereoservo_drivers.canopen.options import CanJoint, CanOptions, CanOutput

from .maker_drive import MakerBus, MakerDrive

COUNTS, GEAR = 4096, 10.0
COUNTS_PER_RAD = COUNTS * GEAR / (2 * math.pi)
SPEED, TRAVEL = 0.4, 0.2

MAKERS = {
    "epos2": (1, 3, 6, 7),
    "epos4": (1, 3, 6, 8, 9, 10),
    "erb415": (1, 3, 6, 8),
    "everest_xcr": (1, 3, 6, 7, 8, 9, 10),
    "eyou": (1, 3, 4, 7, 8, 9, 10),
    "schunk_lwa4p": (1, 2, 7),
    "technosoft": (1, 3, 6, 7),
}
"""File -> modes of operation that its drive has, where the file does not tell."""


def eds(name: str) -> Path:
    """A maker's file, which is not part of the project."""
    root = Path(os.environ.get("STEREOSERVO_DATA", Path(__file__).parents[4] / "shared" / "data"))
    path = root / "eds" / f"{name}.eds"
    if not path.is_file():
        pytest.skip(f"no {path}; $STEREOSERVO_DATA names the folder of the makers' EDS files")
    return path


def joint(**changes: object) -> CanJoint:
    values: dict[str, object] = {
        "name": "elbow", "node_id": 5, "counts_per_rev": COUNTS, "gear_ratio": GEAR, "max_velocity": 1.0,
        "max_acceleration": 4.0, "quick_stop_deceleration": 10.0, "position_min": -3.0, "position_max": 3.0,
    }  # fmt: skip
    return CanJoint(**(values | changes))  # type: ignore[arg-type]


class Bench:
    """One drive of a maker and a master that meets it for the first time."""

    def __init__(
        self, path: Path, modes: tuple[int, ...], *, lacking: tuple[int, ...] = (), axis: CanJoint | None = None,
        period: tuple[int, int] | None = None, **options: object,
    ) -> None:  # fmt: skip
        values = {(0x1000, 0): 0x00020192, (0x6502, 0): sum(1 << mode - 1 for mode in modes), (0x6060, 0): 0}
        if period is not None:
            values |= {(0x60C2, 1): period[0], (0x60C2, 2): period[1]}
        self.drive = MakerDrive(5, path, values, lacking, (0x60C2,) * (period is not None))
        of = self.drive.node.object_dictionary.device_information
        for sub, number in ((1, of.vendor_number), (2, of.product_number)):
            if number:
                self.drive.put(0x1018, sub, number)
        named = {} if path == SHIPPED_EDS else {"eds": str(path)}
        self.options = CanOptions(
            interface="virtual", channel="x", joint=(axis or joint(),), **named, **options  # type: ignore[arg-type]
        )  # fmt: skip
        self.codec = Cia402Codec(self.options)
        self.master = Master(self.codec, MasterSettings.of(self.options))
        self.bringup = Cia402Bringup(self.options, self.codec, path.parent)
        self.bus = MakerBus([self.drive], self.master)

    def run(self) -> None:
        self.bringup.connect(self.bus)
        self.bus.begin_cycle()
        self.go(0.05)
        self.master.request_enable(self.bus.t_ns)
        self.go(0.2)
        assert self.master.mode is Mode.RUNNING, self.master.fault

    def go(self, seconds: float, velocity: float = 0.0) -> None:
        self.bus.velocities = np.array([velocity])
        self.bus.wait(seconds)

    @property
    def position(self) -> float:
        return self.drive.counts / COUNTS_PER_RAD


@pytest.mark.parametrize("name", MAKERS)
def test_a_makers_drive_comes_up_with_default_options_and_moves_as_commanded(name):
    bench = Bench(eds(name), MAKERS[name])
    bench.run()
    start = bench.position
    bench.go(TRAVEL / SPEED, SPEED)
    bench.go(0.5)
    assert bench.master.fault is None
    assert bench.position - start == pytest.approx(TRAVEL, rel=0.01)
    sample = bench.master.sample()
    assert sample is not None
    assert sample.positions[0] == pytest.approx(bench.position, abs=2 / COUNTS_PER_RAD)
    told = bench.bringup.setups[5]
    assert (told.losses == ()) == (name in ("epos4", "technosoft"))


@pytest.mark.parametrize("name", MAKERS)
def test_a_cut_cable_stops_a_makers_drive_by_its_own_watch(name):
    bench = Bench(eds(name), MAKERS[name])
    bench.run()
    bench.go(0.3, SPEED)
    bench.bus.cut = True
    cut, before = bench.bus.t_ns, bench.position
    while abs(bench.drive.speed) > 1.0 and bench.bus.t_ns - cut < 10**9:
        bench.bus.wait(0.001)
    watches = bench.bringup.setups[5].watches
    assert watches
    if bench.codec.axes[0].mode in ("csv", "pv"):
        assert bench.drive.reason in watches
        assert (bench.bus.t_ns - cut) * 1e-9 < 0.15
    else:
        assert abs(bench.position - before) <= bench.options.joint[0].lead + bench.options.joint[0].largest_load_offset


def test_a_drive_without_any_watch_is_refused_until_the_cell_file_says_that_it_is_known():
    lacking = (0x1016, 0x100C, 0x100D)
    deaf = {"lacking": lacking, "rpdo_deadline_ms": 0}
    with pytest.raises(DriverError, match=r"accept_missing = \[\"watch\"\]") as refusal:
        Bench(SHIPPED_EDS, (3, 9), **deaf).run()
    assert refusal.value.code == "no_watch"
    with pytest.raises(DriverError, match=r"deadline of commands \(0x1400:5\) is set, but CiA 301"):
        Bench(SHIPPED_EDS, (3, 9), lacking=lacking).run()
    bench = Bench(SHIPPED_EDS, (3, 9), **deaf, axis=joint(accept_missing=("watch",)))
    bench.run()
    assert "acknowledges" in bench.bringup.setups[5].losses[0]


@pytest.mark.parametrize(
    ("missing", "told"), [(0x6007, "0x6007"), (0x605A, "0x605A"), (0x6085, "0x6085"), (0x6077, "")]
)
def test_what_cia_402_leaves_optional_may_be_missing_and_is_told(missing, told):
    bench = Bench(SHIPPED_EDS, (3, 9), lacking=(missing,))
    bench.run()
    assert told in bench.bringup.setups[5].safety()
    assert bench.master.fault is None
    sample = bench.master.sample()
    assert sample is not None
    assert (sample.efforts is None) == (missing == 0x6077)


@pytest.mark.parametrize(
    ("asked", "modes", "used"),
    [("auto", (3, 9), 9), ("auto", (3, 8), 3), ("auto", (8,), 8), ("pv", (3, 9), 3), ("csp", (8, 9), 8)],
)
def test_the_first_mode_that_a_drive_has_is_used(asked, modes, used):
    bench = Bench(SHIPPED_EDS, modes, mode=asked)
    bench.run()
    assert bench.drive.get(0x6060) == used


def test_limits_that_act_while_it_accelerates_are_no_fault_but_a_joint_that_stands_is():
    bench = Bench(SHIPPED_EDS, (9,), feedback=("velocity", "switches"))
    bench.run()
    bench.drive.word = 0x800
    bench.go(1.0, SPEED)
    assert bench.master.fault is None
    bench.drive.blocked = True
    bench.go(0.5, SPEED)
    assert bench.master.fault is not None
    assert bench.master.fault.code == "limit_switch"
    assert "the joint stands" in bench.master.fault.message


@pytest.mark.parametrize("off_ms", [0, 12])
def test_a_limit_that_lasts_is_a_fault_where_nothing_tells_it_from_a_switch(off_ms):
    """Its drive leaves the braking to the master, and the joint goes on; the bit may flicker."""
    bench = Bench(SHIPPED_EDS, (9,))
    bench.run()
    bench.drive.word = 0x800
    bench.go(0.048, SPEED)
    assert bench.master.fault is None
    for _ in range(3):
        bench.drive.word = 0
        bench.go(off_ms * 1e-3, SPEED)
        bench.drive.word = 0x800
        bench.go(0.048, SPEED)
    assert bench.master.fault is not None
    assert bench.master.fault.code == "limit_switch"
    assert '"switches" in feedback' in bench.master.fault.hint + bench.master.fault.message


def test_a_drive_that_says_that_it_ignores_its_set_points_is_a_fault_of_that_name():
    bench = Bench(SHIPPED_EDS, (9,))
    bench.run()
    bench.go(0.1, SPEED)
    bench.drive.word = 0x1000
    bench.go(0.08, SPEED)
    assert bench.master.fault is None
    bench.go(0.05, SPEED)
    assert bench.master.fault is not None
    assert bench.master.fault.code == "target_ignored"


@pytest.mark.parametrize(("rate_hz", "value", "exponent"), [(250.0, 4, -3), (1000.0, 1, -3), (400.0, 25, -4)])
def test_the_interpolation_period_follows_the_rate(rate_hz, value, exponent):
    bench = Bench(SHIPPED_EDS, (9,), rate_hz=rate_hz)
    bench.run()
    assert (bench.drive.get(0x60C2, 1), bench.drive.get(0x60C2, 2)) == (value, exponent)


def test_a_fixed_interpolation_period_is_used_where_it_fits_and_told_where_it_does_not():
    fits = Bench(SHIPPED_EDS, (9,), period=(40, -4))
    fits.run()
    assert fits.bringup.setups[5].losses == ()
    other = Bench(SHIPPED_EDS, (9,), period=(2, -3))
    other.run()
    assert "0x60C2 is fixed at 2 ms, and a cycle has 4 ms" in other.bringup.setups[5].safety()
    with pytest.raises(DriverError, match=r"0x60C2.*rate_hz"):
        Bench(SHIPPED_EDS, (8,), period=(2, -3)).run()


def test_switches_are_taken_from_the_drives_that_have_them():
    joints = (joint(), joint(name="wrist", node_id=6))
    options = CanOptions(interface="virtual", channel="x", joint=joints, feedback=("velocity", "switches"))
    values = {(0x1000, 0): 0x00020192, (0x6502, 0): 1 << 8}
    drives = [
        MakerDrive(5, SHIPPED_EDS, values, (0x60FD,)),
        MakerDrive(6, SHIPPED_EDS, values | {(0x60FD, 0): 2}),
    ]
    codec = Cia402Codec(options)
    master = Master(codec, MasterSettings.of(options))
    bringup, bus = Cia402Bringup(options, codec, Path()), MakerBus(drives, master)
    bringup.connect(bus)
    bus.begin_cycle()
    bus.velocities = np.zeros(2)
    bus.wait(0.1)
    assert master.fault is None
    assert [axis.switches for axis in codec.axes] == [None, 2]
    assert ["0x60FD" in bringup.setups[node].safety() for node in (5, 6)] == [True, False]


# -- process data that a drive restricts ---------------------------------------------------------------------------


def pdo_bench(entries: int, *, pdos: int = 4, **options: object) -> Bench:
    """A drive with so many PDOs in each direction, of so many mapping entries each."""
    bench = Bench(SHIPPED_EDS, (9,), **options)  # type: ignore[arg-type]
    dictionary = bench.drive.node.object_dictionary
    for base in (0x1400, 0x1800):
        for number in range(4):
            mapping = dictionary[base + 0x200 + number]
            for sub in [sub for sub in mapping if sub > entries]:
                del mapping.subindices[sub]
            if number >= pdos:
                del dictionary.indices[base + number], dictionary.indices[base + 0x200 + number]
    return bench


def fix(bench: Bench, index: int, *mapping: int) -> None:
    """Give a PDO of the drive a mapping that cannot be changed."""
    for sub, value in enumerate((len(mapping), *mapping)):
        bench.drive.put(index, sub, value)
    for variable in bench.drive.node.object_dictionary[index].values():
        variable.access_type = "ro"


def moves_as_commanded(bench: Bench) -> None:
    bench.run()
    start = bench.position
    bench.go(TRAVEL / SPEED, SPEED)
    bench.go(0.5)
    assert bench.master.fault is None
    assert bench.position - start == pytest.approx(TRAVEL, rel=0.01)
    sample = bench.master.sample()
    assert sample is not None
    assert sample.positions[0] == pytest.approx(bench.position, abs=2 / COUNTS_PER_RAD)


@pytest.mark.parametrize("entries", [1, 2, 3, 8])
def test_process_data_are_spread_over_as_many_pdos_as_a_drive_needs(entries):
    bench = pdo_bench(entries)
    moves_as_commanded(bench)
    counts = [bench.drive.get(0x1A00 + n) * (not bench.drive.get(0x1800 + n, 1) >> 31) for n in range(4)]
    assert counts == ([1, 1, 1, 1] if entries == 1 else [2, 2, 0, 0])
    sample = bench.master.sample()
    assert sample is not None
    assert sample.efforts is not None
    assert bench.bringup.setups[5].losses == ()


def test_feedback_without_a_place_is_left_out_and_reported():
    bench = pdo_bench(1, pdos=3)
    moves_as_commanded(bench)
    assert bench.bringup.setups[5].losses == ("effort is not sent: the drive's TPDOs have no place for it",)
    sample = bench.master.sample()
    assert sample is not None
    assert sample.efforts is None


def test_a_drive_without_place_for_its_set_point_is_refused_with_what_it_refused():
    bench = pdo_bench(1, pdos=1)
    with pytest.raises(DriverError, match=r"PDOs cannot carry control word.*0x1401:1.*does not exist") as e:
        bench.run()
    assert e.value.code == "no_pdos"


def test_an_object_that_cannot_be_mapped_is_left_out():
    bench = Bench(SHIPPED_EDS, (9,))

    def refuse(index: int, subindex: int, od: object, data: bytes) -> None:
        if 0x1A00 <= index < 0x1A04 and int.from_bytes(data, "little") == 0x60770010:
            raise canopen.SdoAbortedError(0x06040041)

    bench.drive.node.add_write_callback(refuse)
    moves_as_commanded(bench)
    assert any("effort is not sent" in text for text in bench.bringup.setups[5].losses)


def test_mappings_that_cannot_be_changed_are_used_and_what_else_they_hold_stays():
    bench = Bench(SHIPPED_EDS, (9,))
    fix(bench, 0x1600, 0x60400010)
    fix(bench, 0x1601, 0x60400010, 0x60600008)
    fix(bench, 0x1602, 0x60400010, 0x00050008, 0x60FF0020)
    fix(bench, 0x1A00, 0x60410010)
    fix(bench, 0x1A01, 0x60410010, 0x60610008, 0x60640020)
    moves_as_commanded(bench)
    on = [number for number in range(4) if not bench.drive.get(0x1400 + number, 1) >> 31]
    assert on == [2], "the one that holds both, beside a dummy"
    other = Bench(SHIPPED_EDS, (9,))
    for index, mapping in ((0x1600, (0x60400010,)), (0x1601, (0x60FF0020, 0x60600008)), (0x1602, ()), (0x1603, ())):
        fix(other, index, *mapping)
    moves_as_commanded(other)
    assert other.drive.get(0x6060) == 9, "the mode in the PDO is the one that was set"


@pytest.mark.parametrize(("value", "words"), [(0, "lets its axis run out"), (1, "is fixed at 1: 2 was to be written")])
def test_an_object_that_cannot_be_changed_is_a_loss_whatever_the_eds_says(value, words):
    """The shipped EDS, which describes the object as writable, is what the master knows."""
    bench = Bench(SHIPPED_EDS, (9,))
    bench.drive.put(0x605E, 0, value)
    bench.drive.node.object_dictionary[0x605E].access_type = "ro"
    bench.run()
    assert words in bench.bringup.setups[5].safety()
    assert bench.drive.get(0x605E) == value


def output_bench(name: str = "valve", bit: int = 16, **changes: object) -> Bench:
    outputs = (CanOutput(name=name, node_id=5, bit=bit), CanOutput(name="light", node_id=5, bit=17))
    return Bench(SHIPPED_EDS, (9,), output=outputs, **changes)  # type: ignore[arg-type]


def test_digital_outputs_are_switched_beside_the_cycle_and_told_once_confirmed():
    bench = output_bench()
    bench.drive.put(0x60FE, 1, 0x0008_0001)
    bench.run()
    outputs = bench.bringup.outputs
    assert bench.drive.get(0x60FE, 2) == 0x0003_0000
    assert outputs.values() == {"valve": 0.0, "light": 0.0}
    outputs.write(bench.bus, {"valve": 1.0})
    outputs.write(bench.bus, {"light": 1.0, "valve": 1.0})
    assert outputs.values() == {"valve": 0.0, "light": 0.0}, "nothing has been confirmed yet"
    bench.go(0.02, SPEED)
    outputs.values()
    bench.go(0.02, SPEED)
    assert bench.drive.get(0x60FE, 1) == 0x000B_0001, "the other bits stay"
    assert outputs.values() == {"valve": 1.0, "light": 1.0}
    outputs.write(bench.bus, {"valve": 0.0})
    bench.go(0.02, SPEED)
    assert outputs.values() == {"valve": 0.0, "light": 1.0}
    assert bench.master.fault is None
    with pytest.raises(DriverError, match="valve, light"):
        outputs.write(bench.bus, {"nobody": 1.0})


def test_an_output_that_the_drive_refuses_is_not_told_as_switched():
    bench = output_bench()
    bench.run()
    bench.drive.node.object_dictionary[0x60FE][1].access_type = "ro"
    bench.bringup.outputs.write(bench.bus, {"valve": 1.0})
    bench.go(0.02)
    assert bench.bringup.outputs.values()["valve"] == 0.0


class SilentLine(Subscriptions):
    """A bus whose drive answers what the test says, one order at a time; ``orders``: bits as they came."""

    def __init__(self) -> None:
        super().__init__()
        self.orders: list[int] = []
        self.t_ns = 0

    def send(self, frames: list[CanFrame]) -> None:
        self.orders += [int.from_bytes(frame.data[4:], "little") for frame in frames]

    def now_ns(self) -> int:
        return self.t_ns

    def answer(self, command: int) -> None:
        self.tell(CanFrame(0x585, bytes([command, 0xFE, 0x60, 1]) + bytes(4)))


@pytest.fixture
def line() -> tuple[SilentLine, DigitalOutputs]:
    names = ("valve", "light")
    outputs = DigitalOutputs(tuple(CanOutput(name=n, node_id=5, bit=16 + k) for k, n in enumerate(names)))
    bench, found = Bench(SHIPPED_EDS, (9,)), SilentLine()
    bench.run()
    with RemoteDrive(bench.bus, bench.codec.axes[0], bench.drive.node.object_dictionary) as drive:
        outputs.prepare(drive)
    outputs.listen(found)
    return found, outputs


def test_an_output_that_was_taken_stays_though_the_one_before_it_was_refused(line):
    bus, outputs = line
    outputs.write(bus, {"valve": 1.0})
    outputs.write(bus, {"light": 1.0})
    bus.answer(0x80)
    outputs.values()
    bus.answer(0x60)
    outputs.write(bus, {"light": 0.0})
    assert bus.orders[-1] & 0x1_0000, "the valve that was switched on by the second order"


def test_an_answer_that_is_lost_does_not_shift_those_that_follow(line):
    bus, outputs = line
    outputs.write(bus, {"valve": 1.0})
    bus.t_ns += 1_000_000_000
    outputs.write(bus, {"valve": 0.0})
    bus.answer(0x60)
    assert outputs.values()["valve"] == 0.0
    assert bus.orders == [0x1_0000, 0]


def test_outputs_of_a_drive_without_any_are_refused():
    with pytest.raises(DriverError, match=r"no digital outputs \(0x60FE:1\); leave out: valve, light"):
        output_bench(lacking=(0x60FE,)).run()
