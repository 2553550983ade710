"""Grippers on CiA 402 drives of their own: played by the `canopen` package on makers' EDS files, and emulated.

A count of the drive is 10 um, its velocity unit a count a second.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import AuxiliaryDriver, DriverContext, DriverError
from stereoservo_drivers.canopen.cia402 import Cia402Codec
from stereoservo_drivers.canopen.cia402_bringup import Cia402Bringup
from stereoservo_drivers.canopen.cia402_configuration import SHIPPED_EDS
from stereoservo_drivers.canopen.codec import AxisFault
from stereoservo_drivers.canopen.driver import CanJointDriver
from stereoservo_drivers.canopen.master import Master, MasterSettings, Mode
from stereoservo_drivers.canopen.option_checks import check_options
from stereoservo_drivers.canopen.options import CanGripper, CanOptions, can_options
from stereoservo_drivers.lifecycle import LifecycleState
from stereoservo_sim.emulators.bus.factory import DrivesSettings, make_bus_emulator
from stereoservo_sim.emulators.bus.fault_trials import VirtualHost

from .maker_drive import MakerBus, MakerDrive
from .test_makers_dictionaries import MAKERS, eds, joint

COUNTS_PER_M, SPEED = 1e5, 0.05
GRIPPER: dict[str, Any] = {
    "name": "gripper", "node_id": 9, "counts_per_rev": 1000, "gear_ratio": 100.0, "velocity": SPEED,
    "acceleration": 1.0, "quick_stop_deceleration": 2.0, "position_min": 0.0, "position_max": 0.08,
}  # fmt: skip


class Bench:
    """An arm's joint on the shipped dictionary, and a gripper on that of ``path``, both played by the package."""

    def __init__(self, path: Path, lacking: tuple[int, ...] = (), modes: int = 0x1, **changes: Any) -> None:
        values = {(0x1000, 0): 0x00020192, (0x6060, 0): 0}
        arm = MakerDrive(5, SHIPPED_EDS, values | {(0x6502, 0): 1 << 8})
        self.drive = MakerDrive(9, path, values | {(0x6502, 0): modes}, lacking)
        of = self.drive.node.object_dictionary.device_information
        for sub, number in ((1, of.vendor_number), (2, of.product_number)):
            if number:
                self.drive.put(0x1018, sub, number)
        named = {} if path == SHIPPED_EDS else {"eds": path.name}
        self.options = CanOptions(
            interface="virtual",
            channel="x",
            joint=(joint(),),
            gripper=(CanGripper(**GRIPPER | named | changes),),
        )
        codec = Cia402Codec(self.options)
        self.master = Master(codec, MasterSettings.of(self.options))
        self.bringup = Cia402Bringup(self.options, codec, path.parent)
        self.gripper = self.bringup.grippers[9]
        self.bus = MakerBus([arm, self.drive], self.master)
        self.fault: AxisFault | None = None
        self.fastest = 0.0

    def run(self) -> None:
        self.bringup.connect(self.bus)
        self.bus.velocities = np.zeros(1)
        self.bus.begin_cycle()
        self.gripper.enable(self.bus.t_ns)
        self.go(0.12)
        assert (self.fault, self.drive.state) == (None, 0x27)

    def go(self, seconds: float) -> None:
        """The servo loop's cycles, until there is a fault."""
        end = self.bus.t_ns + round(seconds * 1e9)
        while self.bus.t_ns < end:
            self.bus.wait(0.004)
            self.fault = self.fault or self.gripper.poll(self.bus)
            self.fastest = max(self.fastest, abs(self.drive.speed) / COUNTS_PER_M)

    @property
    def position(self) -> float:
        return self.drive.counts / COUNTS_PER_M


@pytest.mark.parametrize("name", ["", *MAKERS])
def test_a_gripper_goes_where_it_is_ordered_at_its_own_velocity(name):
    bench = Bench(eds(name) if name else SHIPPED_EDS)
    bench.run()
    assert bench.position == 0.0, "enabled where it stands"
    for ordered in (0.012, 0.004):
        bench.gripper.order(ordered, bench.bus.t_ns)
        bench.go(0.45)
        assert bench.fault is None
        assert bench.position == pytest.approx(ordered, abs=2e-5)
        assert bench.gripper.position == pytest.approx(ordered, abs=2e-5)
    assert bench.fastest == pytest.approx(SPEED, rel=0.01)
    assert bench.master.fault is None, "the arm's cycle does not see it"


def test_an_order_on_the_way_is_taken_at_once_and_a_stop_holds_it_where_it_is():
    bench = Bench(SHIPPED_EDS)
    bench.run()
    bench.gripper.order(0.06, bench.bus.t_ns)
    bench.go(0.3)
    bench.gripper.order(0.0, bench.bus.t_ns)
    bench.go(0.2)
    back = bench.position
    assert back < 0.012
    bench.gripper.order(0.07, bench.bus.t_ns)
    bench.go(0.3)
    assert bench.position > back
    bench.gripper.stop(bench.bus)
    stopped = bench.position
    bench.go(0.1)
    held = bench.position
    assert held == pytest.approx(stopped, abs=0.004), "its ramp, and a cycle"
    bench.go(0.2)
    assert (bench.position, bench.drive.state, bench.fault) == (held, 0x27, None)
    bench.gripper.order(held + 0.004, bench.bus.t_ns)
    bench.go(0.3)
    assert bench.position == pytest.approx(held + 0.004, abs=2e-5)


def test_a_gripper_whose_master_is_gone_stops_by_its_watch_and_keeps_its_torque():
    bench = Bench(SHIPPED_EDS)
    bench.run()
    assert bench.bringup.setups[9].watches == ("heartbeat",)
    bench.gripper.order(0.08, bench.bus.t_ns)
    bench.go(0.2)
    bench.bus.cut = True
    before = bench.position
    bench.bus.wait(0.15)
    assert (bench.drive.reason, bench.drive.state) == ("heartbeat", 0x07), "quick stop active, option 6"
    assert bench.drive.speed == 0.0
    assert bench.position - before < SPEED * 0.15


def test_a_gripper_without_a_watch_goes_on_to_what_was_ordered_and_this_is_told():
    bench = Bench(SHIPPED_EDS, lacking=(0x1016,))
    bench.run()
    assert "goes on to the position that it was ordered to" in bench.bringup.setups[9].safety()
    bench.gripper.order(0.02, bench.bus.t_ns)
    bench.go(0.1)
    bench.bus.cut = True
    assert bench.position < 0.01
    bench.bus.wait(0.6)
    assert bench.position == pytest.approx(0.02, abs=2e-5)


def _silent(bench: Bench) -> None:
    bench.drive.cut = True


def _faulty(bench: Bench) -> None:
    bench.drive.state = 0x08


def _rebooted(bench: Bench) -> None:
    bench.drive.wire.send_message(0x709, b"\0")


def _emergency(bench: Bench) -> None:
    bench.drive.wire.send_message(0x89, bytes([0x10, 0x23, 1, 0, 0, 0, 0, 0]))


def _off(bench: Bench) -> None:
    bench.drive.state = 0x40


def _deaf(bench: Bench) -> None:
    bench.drive._taken = True
    bench.gripper.order(0.02, bench.bus.t_ns)
    bench.drive._control = lambda word: None  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("what", "codes"),
    [
        (_silent, ("heartbeat_lost", "silent")),
        (_faulty, ("drive_fault",)),
        (_rebooted, ("rebooted",)),
        (_emergency, ("emergency",)),
        (_off, ("disabled",)),
        (_deaf, ("target_ignored",)),
    ],
)
def test_what_is_wrong_with_a_gripper_is_told_by_name(what, codes):
    bench = Bench(SHIPPED_EDS)
    bench.run()
    what(bench)
    while bench.fault is None and bench.bus.t_ns < 3_000_000_000:
        bench.go(0.004)
    assert bench.fault is not None
    assert bench.fault.code in codes
    assert bench.fault.message.startswith("gripper 'gripper' (node 9): ")
    assert bench.fault.hint
    assert bench.master.fault is None, "of itself the arm's cycle goes on: the driver stops it"


def test_a_drive_without_profile_position_is_refused():
    with pytest.raises(DriverError, match=r"node 9 \(gripper\).*profile position.*0x00000100"):
        Bench(SHIPPED_EDS, modes=0x100).run()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"node_id": 5}, "node_id = 5; valid: one that joint 'elbow'"),
        ({"name": "elbow"}, "name = elbow; valid: one that joint 'elbow'"),
        ({"position_min": 0.08}, "position_min = 0.08; valid: less than position_max"),
        ({"node_id": 127}, "profile|node_id"),
        ({"velocity": 1e-9}, "drive units, which is nothing"),
        ({"profile": "none.toml"}, "profile = 'none.toml'.*a TOML file beside the cell file"),
    ],
)
def test_grippers_that_cannot_be_are_refused(tmp_path, changes, words):
    arm = {"name": "elbow", "node_id": 5, "counts_per_rev": 4096, "gear_ratio": 10.0, "max_velocity": 1.0,
           "max_acceleration": 4.0, "quick_stop_deceleration": 10.0, "position_min": -3.0,
           "position_max": 3.0}  # fmt: skip
    options = {"interface": "virtual", "channel": "x", "joint": [arm], "gripper": [GRIPPER | changes]}
    with pytest.raises(DriverError, match=words):
        check_options(can_options(options, tmp_path))


def test_a_profile_file_holds_what_the_cell_file_need_not_say(tmp_path):
    of_the_maker = {key: value for key, value in GRIPPER.items() if key not in ("name", "node_id")}
    lines = [f"{key} = {value!r}" for key, value in of_the_maker.items()]
    (tmp_path / "claw.toml").write_text("\n".join([*lines, "torque_limit = 300"]), encoding="utf-8")
    here = {"name": "gripper", "node_id": 9, "profile": "claw.toml", "position_max": 0.06}
    options = {"interface": "virtual", "channel": "x", "joint": [], "gripper": [here]}
    (found,) = can_options(options, tmp_path).gripper
    assert (found.torque_limit, found.velocity, found.position_max) == (300, SPEED, 0.06)


class Arm:
    """The driver of two emulated joints and a gripper, on a bus in virtual time."""

    def __init__(self, folder: Path) -> None:
        joints = [
            {
                "name": f"j{k}", "node_id": k, "counts_per_rev": 65536, "gear_ratio": 100.0, "max_velocity": 1.0,
                "max_acceleration": 10.0, "quick_stop_deceleration": 20.0, "position_min": -2.0,
                "position_max": 2.5,
            }
            for k in (1, 2)
        ]  # fmt: skip
        options = {
            "interface": "virtual", "channel": "x", "joint": joints, "gripper": [GRIPPER],
            "command_timeout_s": 60.0, "loop_timeout_ms": 5000,
        }  # fmt: skip
        self.driver = CanJointDriver(options, DriverContext(MonotonicClock(), "test", folder, folder))
        self.emulator = make_bus_emulator(
            self.driver.options, DrivesSettings(plant="ideal", brake_ms=5.0), t_ns=time.monotonic_ns()
        )
        self.axes = [node.axis for node in self.emulator.nodes]
        self.host = VirtualHost(self.emulator, self.driver.master)
        self.host.alive = True  # type: ignore[attr-defined]
        self.driver.bus = self.host  # type: ignore[assignment]
        self.driver.bringup.connect(self.host)
        self._enable()

    def _enable(self) -> None:
        """As `activate`, which waits in real time."""
        self.host.begin_cycle()
        self.host.wait(0.02)
        self.driver.master.request_enable(self.host.t_ns)
        for gripper in self.driver._grippers.values():
            gripper.enable(self.host.t_ns)
        self.driver._life.state = LifecycleState.ACTIVE
        self.cycles(0.15)

    def reset(self) -> None:
        self.host.end_cycle()
        self.driver.bringup.reset(self.host)
        self._enable()

    def cycles(self, seconds: float, speed: float = 0.0) -> None:
        """Of the servo loop."""
        end = self.host.t_ns + round(seconds * 1e9)
        while self.host.t_ns < end:
            self.driver.read_state()
            self.driver.write_velocity(np.full(2, speed)) if self.driver.master.mode is Mode.RUNNING else None
            self.host.wait(0.004)


def test_a_grippers_fault_stops_the_arm_with_its_name_until_a_reset(tmp_path):
    arm = Arm(tmp_path)
    driver, (*joints, claw) = arm.driver, arm.axes
    assert isinstance(driver, AuxiliaryDriver)
    assert driver.describe().auxiliary[0].velocity == SPEED
    assert driver.read_auxiliary() == {"gripper": pytest.approx(0.08, abs=2e-5)}, "it begins open"
    driver.write_auxiliary({"gripper": 0.07})
    arm.cycles(0.4, 0.1)
    assert claw.position == pytest.approx(0.07, abs=2e-5)
    assert driver.read_auxiliary() == {"gripper": pytest.approx(0.07, abs=2e-5)}
    assert all(joint.velocity == pytest.approx(0.1, rel=0.01) for joint in joints)
    with pytest.raises(DriverError, match=r"gripper: 0\.5; 0 to 0\.08 is valid"):
        driver.write_auxiliary({"gripper": 0.5})
    driver.write_auxiliary({"gripper": 0.0})
    arm.cycles(0.2, 0.1)
    driver.stop()
    arm.cycles(0.1)
    stood = claw.position
    assert 0.0 < stood < 0.07
    arm.cycles(0.1)
    assert claw.position == stood
    arm.cycles(0.1, 0.1)
    arm.emulator.order("fault 9 0x2310", arm.emulator.t_ns)
    with pytest.raises(DriverError, match=r"gripper 'gripper' \(node 9\).*over-current") as caught:
        arm.cycles(0.2, 0.1)
    assert caught.value.data["axis"] == "gripper"
    with pytest.raises(DriverError, match="gripper"):
        driver.write_auxiliary({"gripper": 0.0})
    arm.host.wait(0.2)
    assert not any(axis.velocity for axis in arm.axes)
    arm.reset()
    driver.write_auxiliary({"gripper": stood + 0.004})
    arm.cycles(0.3)
    assert claw.position == pytest.approx(stood + 0.004, abs=2e-5)
